"""Systems from SymPy expressions, with exact Jacobians."""

from __future__ import annotations

import builtins
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dis import get_instructions
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from .._checks import need, positive
from ..errors import ModelError
from ..model.augmentation import Augmentation
from ..model.functions import Trusted
from ..model.system import System
from ..model.system_arguments import SystemOptions

Array = NDArray[np.float64]


def from_sympy(
    f: Any,
    h: Any,
    x: Sequence[Any],
    u: Sequence[Any] = (),
    *,
    dt: float | None = None,
    method: str = "rk4",
    **options: Unpack[SystemOptions],
) -> System:
    """Make a system from SymPy expressions, with exact Jacobians, as NumPy functions.

    Parameters
    ----------
    f, h : sequence of expressions, or a matrix
        Entries of the next state (or of its rate, with dt) and of the output.
    x, u : symbol, or sequence of symbols or functions of time
        The states and the inputs, assumed real.
    dt : float, optional
        Sampling time. If given, f is the right-hand side of an ODE, in units of x per unit of time,
        discretised with u held over the step.
    method : {"rk4", "euler"}
        Runge-Kutta of order 4, or one explicit Euler step.
    **options
        Sets and scales, as for `qpmhe.System`.

    Returns
    -------
    System
        With one state per symbol in x, and one input per symbol in u.

    Raises
    ------
    ModelError, SetError, OptionError
        If an expression, symbol, set or option is invalid, such as a symbol that is neither state
        nor input.
    InvalidInputError
        If SymPy is not installed.
    """
    sympy = need("sympy", "from_sympy", "sympy")
    state, given = _symbols(sympy, "x", x), _symbols(sympy, "u", u)
    _check_symbols(state, given)
    rates, outputs = _column(sympy, "f", f), _column(sympy, "h", h)
    if len(rates) != len(state):
        raise ModelError(f"f has {len(rates)} entries; expected one for each of {state}.")
    real = _real_symbols(sympy, [*state, *given])
    rates, outputs = (
        _in_real_symbols(sympy, name, column, real, state, given)
        for name, column in (("f", rates), ("h", outputs))
    )
    state, given = [real[one] for one in state], [real[one] for one in given]
    symbols, names = [*state, *given], {mine: theirs for theirs, mine in real.items()}
    n, p = len(state), len(outputs)
    functions = [
        _numeric(sympy, name, symbols, expression, shape, names)
        for name, expression, shape in (
            ("f", rates, (n,)), ("h", outputs, (p,)),
            ("f", _jacobian(sympy, "f", rates, state, names), (n, n)),
            ("h", _jacobian(sympy, "h", outputs, state, names), (p, n)),
        )
    ]
    step, output, step_jacobian, output_jacobian = (
        _with_inputs(function, bool(given)) for function in functions
    )
    sizes = {"n": n, "p": p, "m": len(given)}
    if dt is None:
        system = System(
            step, output, f_jacobian=step_jacobian, h_jacobian=output_jacobian, **sizes, **options
        )
    else:
        system = System.from_ode(
            step, output, dt=positive("dt", dt), method=method, rate_jacobian=step_jacobian,
            h_jacobian=output_jacobian, **sizes, **options,
        )
    def augmented(change: Augmentation, others: SystemOptions) -> System:
        moved = [sympy.Dummy(f"m{i}", real=True) for i in range(change.n - n)]
        own = given[: change.m]

        def of(column: Any) -> Any:
            def evaluate(_: Any, v: Any) -> Any:
                return column.xreplace(dict(zip(given, map(sympy.sympify, v), strict=True)))

            return evaluate

        def join(*parts: Any) -> Any:
            return list(_flat(parts))

        step = change.of_one_state(of(rates), join, 1.0 if dt is None else 0.0)
        output, joint = change.of_one_state(of(outputs), join), [*state, *moved]
        return from_sympy(
            step(joint, own), output(joint, own), joint, own, dt=dt, method=method, **others
        )

    return system.with_origin(make_augmented=augmented, recipe=(from_sympy, {
        "f": rates, "h": outputs, "x": state, "u": given, "dt": dt, "method": method,
        **options,
    }))


def _flat(value: Any) -> Iterator[Any]:
    """Entries of a matrix, or of lists within lists; what is neither, as it is."""
    if isinstance(value, str) or not np.iterable(value):
        yield value
    else:
        for entry in value:
            yield from _flat(entry)


def _symbols(sympy: Any, name: str, value: Any) -> list[Any]:
    entries = list(_flat(value))
    for entry in entries:
        # SymPy's own mark of what can be differentiated by: symbols, functions of time.
        if not (isinstance(entry, sympy.Expr) and getattr(entry, "_diff_wrt", False)):
            raise ModelError(
                f"{name} contains {entry!r}; expected symbols such as "
                f"{name} = sympy.symbols('a b')."
            )
    return entries


def _check_symbols(state: list[Any], given: list[Any]) -> None:
    if not state:
        raise ModelError("x is empty; expected the symbols of the states, at least one.")
    for name, symbols in (("x", state), ("u", given)):
        for one, times in Counter(symbols).items():
            if times > 1:
                raise ModelError(
                    f"{name} contains {one} {times} times; expected each symbol once."
                )
    for one in given:
        if one in state:
            raise ModelError(
                f"{one} is among the states x and the inputs u; leave it in one of them."
            )


def _real_symbols(sympy: Any, symbols: list[Any]) -> dict[Any, Any]:
    """A real symbol in place of each: of a complex one, |a| has no derivative."""
    real = {}
    for i, symbol in enumerate(symbols):
        assumptions = {**symbol.assumptions0, "real": True}
        try:
            real[symbol] = sympy.Dummy(f"s{i}", **assumptions)
        except ValueError as error:  # InconsistentAssumptions
            raise ModelError(
                f"{symbol} is declared as not real; states and inputs are real numbers. Declare "
                "it with real=True."
            ) from error
    return real


def _in_real_symbols(
    sympy: Any, name: str, column: Any, real: dict[Any, Any], state: list[Any], given: list[Any]
) -> Any:
    """The column in the symbols of `_real_symbols`, and in nothing else."""
    # A rate dX/dt that is a state goes first: with X replaced, it would be the rate of a constant.
    found = column.xreplace(
        {theirs: mine for theirs, mine in real.items() if isinstance(theirs, sympy.Derivative)}
    )
    undefined = sympy.core.function.AppliedUndef
    for rate in found.atoms(sympy.Derivative):
        if rate.atoms(undefined):
            raise ModelError(
                f"{name} contains {rate}, which is neither among the states {state} nor the "
                f"inputs {given}; make it one, or solve the equations for the rates."
            )
    found = found.xreplace(real)
    unknown = (found.free_symbols - set(real.values())) | found.atoms(undefined)
    if unknown:
        words = ", ".join(sorted(map(str, unknown)))
        namesakes = {str(one) for one in real} & {str(one) for one in unknown}
        raise ModelError(
            f"{name} contains {words}, which is neither among the states {state} nor the inputs "
            f"{given}; " + (
                f"{', '.join(sorted(namesakes))} has the name of one, but not its "
                "assumptions, such as real=True: create each symbol once and reuse it."
                if namesakes else
                "replace parameters by numbers and unknown functions by "
                "expressions, and make time-varying quantities inputs."
            )
        )
    if found.has(sympy.I, sympy.zoo, sympy.nan):
        raise ModelError(f"{name} is {list(column)}; expected expressions with finite real values.")
    return found


def _column(sympy: Any, name: str, value: Any) -> Any:
    try:
        entries = [sympy.sympify(entry) for entry in _flat(value)]
    except (TypeError, ValueError, sympy.SympifyError) as error:
        raise ModelError(f"{name} is {value!r}; expected SymPy expressions.") from error
    for entry in entries:
        if not isinstance(entry, sympy.Expr):
            raise ModelError(f"{name} contains {entry!r}; expected SymPy expressions.")
    if not entries:
        raise ModelError(f"{name} is empty; expected SymPy expressions, at least one.")
    return sympy.Matrix(entries)


def _jacobian(
    sympy: Any, name: str, column: Any, state: list[Any], names: dict[Any, Any]
) -> Any:
    # The derivative of sign(a) is zero but at a jump, where there is none.
    found = column.jacobian(state).replace(sympy.DiracDelta, lambda *_: sympy.Integer(0))
    for entry in found.atoms(sympy.Derivative, sympy.Subs):
        raise ModelError(
            f"{name} has the derivative {entry.xreplace(names)}, for which SymPy has no "
            f"expression; write {name} without it (for example with sympy.Piecewise), or pass f "
            "and h to qpmhe.System as Python functions."
        )
    return found


def _numeric(
    sympy: Any, name: str, symbols: list[Any], matrix: Any, shape: tuple[int, ...],
    names: dict[Any, Any],
) -> Callable[[Array, Array], Array]:
    """A matrix of expressions as a function over leading dimensions of x and u."""
    remedy = (
        f"write {name} with functions that they have, or give f and h to qpmhe.System as Python "
        "functions."
    )
    try:
        entries = sympy.lambdify(symbols, list(matrix), modules=["scipy", "numpy"], cse=True)
    except Exception as error:  # SymPy's printers raise what they like
        raise ModelError(
            f"{name} contains {list(matrix.xreplace(names))}, which NumPy and SciPy cannot "
            f"evaluate ({error}); {remedy}"
        ) from error
    # A printer prints what it does not know as it is; without this, only a call would fail.
    called = {one.argval for one in get_instructions(entries) if one.opname == "LOAD_GLOBAL"}
    absent = called - {*entries.__globals__, *dir(builtins)}
    if absent:
        raise ModelError(
            f"{name} or its derivative contains {', '.join(sorted(absent))}, which NumPy and "
            f"SciPy do not have; {remedy}"
        )

    def evaluate(x: Array, u: Array) -> Array:
        columns = [x[..., i] for i in range(x.shape[-1])]
        columns += [u[..., i] for i in range(u.shape[-1])]
        values = np.stack(
            [np.broadcast_to(entry, x.shape[:-1]) for entry in entries(*columns)], axis=-1
        )
        if values.dtype.kind == "c":  # of Lambert's W, say, real as it may be
            values = np.where(values.imag == 0.0, values.real, np.nan)
        return values.reshape(*x.shape[:-1], *shape)

    return evaluate


def _with_inputs(function: Callable[[Array, Array], Array], inputs: bool) -> Any:
    if inputs:
        return Trusted(lambda x, u: function(x, u))
    return Trusted(lambda x: function(x, np.empty((*x.shape[:-1], 0))))
