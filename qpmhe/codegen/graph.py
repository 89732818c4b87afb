"""A CasADi model's operations, run with numbers of any kind that NumPy's functions take."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from ..model.expressions import CasadiModel, import_casadi


def model_graph(
    model: CasadiModel, *, output_only: bool = False
) -> Callable[[Sequence[Any]], list[Any]]:
    """A CasADi model's f and h as a function of a list of n + m numbers of any kind."""
    ca = import_casadi()
    x, u = ca.SX.sym("x", model.n), ca.SX.sym("u", model.m)
    column = model.h.expand()(x, u)
    if not output_only:
        column = ca.vertcat(model.step().expand()(x, u, model.dt or 0.0), column)
    column, size = ca.densify(column), column.numel()
    function = ca.Function("model", [ca.vertcat(x, u)], [column])
    known = _operations()
    instructions = [
        (
            function.instruction_id(k), list(function.instruction_input(k)),
            list(function.instruction_output(k)),
            function.instruction_constant(k)
            if function.instruction_id(k) == ca.OP_CONST else 0.0,
        )
        for k in range(function.n_instructions())
    ]

    def evaluate(values: Sequence[Any]) -> list[Any]:
        work: dict[int, Any] = {}
        results: list[Any] = [0.0] * size
        for code, arguments, targets, constant in instructions:
            if code == ca.OP_INPUT:
                work[targets[0]] = values[arguments[1]]
            elif code == ca.OP_CONST:
                work[targets[0]] = float(constant)
            elif code == ca.OP_OUTPUT:
                results[targets[1]] = work[arguments[0]]
            elif code in known:
                work[targets[0]] = known[code](*(work[i] for i in arguments))
            else:
                raise NotImplementedError(f"operation {code} of CasADi, which is not smooth")
        return results

    return evaluate


@lru_cache(maxsize=1)
def _operations() -> dict[int, Callable[..., Any]]:
    ca = import_casadi()
    known: dict[int, Callable[..., Any]] = {
        ca.OP_ADD: operator.add, ca.OP_SUB: operator.sub, ca.OP_MUL: operator.mul,
        ca.OP_DIV: operator.truediv, ca.OP_NEG: operator.neg, ca.OP_ASSIGN: operator.pos,
        ca.OP_POW: operator.pow, ca.OP_CONSTPOW: operator.pow, ca.OP_FABS: operator.abs,
        ca.OP_SQ: lambda s: s * s, ca.OP_TWICE: lambda s: 2.0 * s, ca.OP_INV: lambda s: 1.0 / s,
    }
    smooth = "sqrt sin cos tan exp log tanh arctan sinh cosh expm1 log1p"
    for name in smooth.split():
        code = f"OP_{name.upper()}".replace("ARCTAN", "ATAN")
        if hasattr(ca, code):
            known[getattr(ca, code)] = getattr(np, name)
    return known
