"""Systems from SymPy expressions, with exact Jacobians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import positive
from ..errors import InvalidInputError, ModelError
from ..sets import ConvexSet
from ..system import System

__all__ = ["sympy_system"]

Array = NDArray[np.float64]


def sympy_system(
    f: Any,
    h: Any,
    x: Sequence[Any],
    u: Sequence[Any] = (),
    *,
    dt: float | None = None,
    method: str = "rk4",
    states: ConvexSet | None = None,
    disturbances: ConvexSet | None = None,
    noises: ConvexSet | None = None,
) -> System:
    """Make a system from SymPy expressions; see `qpmhe.System.from_sympy`.

    Parameters
    ----------
    f, h, x, u, dt, method, states, disturbances, noises
        As there.
    """
    try:
        import sympy
    except ImportError as error:
        raise InvalidInputError(
            "SymPy is not installed; pip install sympy, or give f and h to qpmhe.System as "
            "functions."
        ) from error
    state, given = list(x), list(u)
    rates, outputs = _column(sympy, "f", f), _column(sympy, "h", h)
    if len(rates) != len(state):
        raise ModelError(f"f has {len(rates)} entries; expected one for each of {state}.")
    unknown = (rates.free_symbols | outputs.free_symbols) - set(state) - set(given)
    if unknown:
        raise ModelError(
            f"f and h contain {', '.join(sorted(map(str, unknown)))}, which is neither among "
            f"the states {state} nor the inputs {given}; put numbers in place of parameters."
        )
    symbols = [*state, *given]
    n, p = len(state), len(outputs)
    functions = [
        _numeric(sympy, symbols, expression, shape) for expression, shape in (
            (rates, (n,)), (outputs, (p,)),
            (rates.jacobian(state), (n, n)), (outputs.jacobian(state), (p, n)),
        )
    ]
    step, output, step_jacobian, output_jacobian = (
        _with_inputs(function, bool(given)) for function in functions
    )
    options: dict[str, Any] = {
        "n": n, "p": p, "m": len(given), "h_jacobian": output_jacobian,
        "states": states, "disturbances": disturbances, "noises": noises,
    }
    if dt is None:
        system = System(step, output, f_jacobian=step_jacobian, **options)
    else:
        system = System.from_ode(
            step, output, dt=positive("dt", dt), method=method, rate_jacobian=step_jacobian,
            **options,
        )
    system._recipe = (sympy_system, {
        "f": rates, "h": outputs, "x": state, "u": given, "dt": dt, "method": method,
        "states": states, "disturbances": disturbances, "noises": noises,
    })
    return system


def _column(sympy: Any, name: str, value: Any) -> Any:
    try:
        entries = list(value) if hasattr(value, "__iter__") else [value]
        column = sympy.Matrix([sympy.sympify(entry) for entry in entries])
    except (TypeError, ValueError, sympy.SympifyError) as error:
        raise ModelError(f"{name} is {value!r}; expected SymPy expressions.") from error
    return column


def _numeric(
    sympy: Any, symbols: list[Any], matrix: Any, shape: tuple[int, ...]
) -> Callable[[Array, Array], Array]:
    """A matrix of expressions as a function over leading dimensions of x and u."""
    entries = sympy.lambdify(symbols, list(matrix), modules="numpy", cse=True)

    def evaluate(x: Array, u: Array) -> Array:
        columns = [x[..., i] for i in range(x.shape[-1])]
        columns += [u[..., i] for i in range(u.shape[-1])]
        values = np.stack(
            [np.broadcast_to(entry, x.shape[:-1]) for entry in entries(*columns)], axis=-1
        )
        return values.reshape(*x.shape[:-1], *shape)

    return evaluate


def _with_inputs(function: Callable[[Array, Array], Array], inputs: bool) -> Any:
    if inputs:
        return lambda x, u: function(x, u)
    return lambda x: function(x, np.empty((*x.shape[:-1], 0)))
