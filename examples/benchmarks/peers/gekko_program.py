"""GEKKO with its own copy of Ipopt."""

from __future__ import annotations

from typing import Any

import numpy as np
from problems import Problem

from .base import Array, Peer, UnavailableError, WindowData

__all__ = ["Gekko"]


class Gekko(Peer):
    """The same nonlinear program in GEKKO, solved by its local executable."""

    name = "GEKKO (Ipopt)"
    package = "gekko"
    limitations = (
        "GEKKO: stated as a nonlinear program (IMODE 3): its own estimation mode (IMODE 5) has its "
        "own collocation and arrival cost, and cannot state this problem. Each solve writes "
        "files and starts a process, whose time is the wall clock's. Few steps are timed."
    )
    outside = True
    most_calls = 8

    def setup(self, problem: Problem) -> None:
        """Parameters, variables and objective."""
        try:
            from gekko import GEKKO
        except ImportError as error:
            raise UnavailableError("not installed: pip install gekko") from error
        n, p, count = problem.n, problem.p, problem.horizon
        model = self._model = GEKKO(remote=False)
        self._prior = [model.Param(0.0) for _ in range(n)]
        self._measured = [[model.Param(0.0) for _ in range(p)] for _ in range(count)]
        self._inputs = [[model.Param(0.0) for _ in range(problem.m)] for _ in range(count)]
        self._states = [[model.Var(0.0) for _ in range(n)] for _ in range(count + 1)]
        cost, states = problem.cost, self._states
        self._add(cost.prior, [x - z for x, z in zip(states[0], self._prior, strict=True)])
        expressions = _Expressions(problem)
        for i in range(count):
            moved, seen = expressions.at(model, states[i], self._inputs[i])
            w = [x - f for x, f in zip(states[i + 1], moved, strict=True)]
            v = [y - h for y, h in zip(self._measured[i], seen, strict=True)]
            self._add(cost.disturbance, w)
            self._add(cost.noise, v)
        model.options.IMODE = 3
        model.options.SOLVER = 3
        model.options.OTOL = model.options.RTOL = 1e-8

    def _add(self, weight: Array, terms: list[Any]) -> None:
        """A quadratic form in the objective, with the zeros of its weight left out."""
        for i, one in enumerate(terms):
            for j, other in enumerate(terms[: i + 1]):
                entry = float(weight[i, j]) * (1.0 if i == j else 2.0)
                if entry:
                    self._model.Minimize(entry * (one**2 if i == j else one * other))

    def update(self, window: WindowData) -> Array:
        """Set all values, solve, and read the states."""
        for parameter, value in zip(self._prior, window.prior, strict=True):
            parameter.value = float(value)
        for rows, given in (
            (self._measured, window.measurements), (self._inputs, window.inputs)
        ):
            for row, values in zip(rows, given, strict=True):
                for parameter, value in zip(row, values, strict=True):
                    parameter.value = float(value)
        for row, values in zip(self._states, window.candidate, strict=True):
            for variable, value in zip(row, values, strict=True):
                variable.value = float(value)
        self._model.solve(disp=False)
        return np.array([[float(x.value[0]) for x in row] for row in self._states])

    def close(self) -> None:
        """Remove its files."""
        if hasattr(self, "_model"):
            self._model.cleanup()


class _Expressions:
    """The CasADi model replayed, operation by operation, in GEKKO's variables.

    What is used more than once becomes an intermediate of GEKKO, so that the expressions stay
    as short as CasADi's graph.
    """

    def __init__(self, problem: Problem) -> None:
        import casadi as ca

        x, u = ca.SX.sym("x", problem.n), ca.SX.sym("u", problem.m)
        self._ca = ca
        self._sizes = (problem.n, problem.p)
        self._function = ca.Function("model", [x, u], [problem.step(x, u), problem.output(x)])

    def at(self, model: Any, x: list[Any], u: list[Any]) -> tuple[list[Any], list[Any]]:
        """The model's f and h at lists of GEKKO variables and parameters."""
        ca, function = self._ca, self._function
        binary = {
            ca.OP_ADD: lambda a, b: a + b, ca.OP_SUB: lambda a, b: a - b,
            ca.OP_MUL: lambda a, b: a * b, ca.OP_DIV: lambda a, b: a / b,
        }
        unary = {
            ca.OP_NEG: lambda a: -a, ca.OP_SQ: lambda a: a**2, ca.OP_TWICE: lambda a: 2.0 * a,
            ca.OP_SQRT: model.sqrt, ca.OP_EXP: model.exp, ca.OP_LOG: model.log,
            ca.OP_SIN: model.sin, ca.OP_COS: model.cos, ca.OP_INV: lambda a: 1.0 / a,
        }
        work: dict[int, Any] = {}
        outputs: tuple[list[Any], ...] = tuple([0.0] * size for size in self._sizes)
        for k in range(function.n_instructions()):
            operation = function.instruction_id(k)
            takes, gives = function.instruction_input(k), function.instruction_output(k)
            if operation == ca.OP_CONST:
                work[gives[0]] = function.instruction_constant(k)
            elif operation == ca.OP_INPUT:
                work[gives[0]] = (x, u)[takes[0]][takes[1]]
            elif operation == ca.OP_OUTPUT:
                outputs[gives[0]][gives[1]] = work[takes[0]]
            elif operation in binary or operation in unary:
                arguments = [work[i] for i in takes]
                table = binary if operation in binary else unary
                value = table[operation](*arguments[: 2 if operation in binary else 1])
                work[gives[0]] = self._kept(model, k, gives[0], value)
            else:
                raise UnavailableError(f"CasADi's operation {operation} is not translated")
        return outputs[0], outputs[1]

    def _kept(self, model: Any, k: int, place: int, value: Any) -> Any:
        return model.Intermediate(value) if k in self._shared() else value

    def _shared(self) -> set[int]:
        """Instructions whose result is read more than once."""
        if not hasattr(self, "_shared_ones"):
            function, writer, reads = self._function, {}, {}
            for k in range(function.n_instructions()):
                operation = function.instruction_id(k)
                if operation not in (self._ca.OP_INPUT, self._ca.OP_CONST):
                    for i in set(function.instruction_input(k)):
                        reads[writer[i]] = reads.get(writer[i], 0) + 1
                if operation != self._ca.OP_OUTPUT:
                    writer[function.instruction_output(k)[0]] = k
            inputs = {
                k for k in range(function.n_instructions())
                if function.instruction_id(k) in (self._ca.OP_INPUT, self._ca.OP_CONST)
            }
            self._shared_ones = {k for k, count in reads.items() if count > 1} - inputs
        return self._shared_ones
