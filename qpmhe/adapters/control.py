"""Systems from python-control."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from .._checks import need, numbers, positive
from ..errors import ModelError, OptionError
from ..model.functions import Trusted
from ..model.points import FEW, points
from ..model.system import System
from ..model.system_arguments import SystemOptions

Array = NDArray[np.float64]
Function = Callable[..., Any]

_FRACTIONS = np.array([0.1, 1.0 / 3.0, 0.5, np.sqrt(0.5), np.pi, 10.0 * np.sqrt(2.0)])


def other_times(dt: float, continuous: bool = True) -> Array:
    """Times after 0 at which a model that depends on time most likely differs from that at 0."""
    times = [dt * np.unique(np.geomspace(1.0, 1e6, 25).round())]
    if continuous:
        times.append(dt * _FRACTIONS)  # what has the sampling time as its period, too
    return np.concatenate(times)


def from_control(
    system: Any,
    *,
    dt: float | None = None,
    method: str | None = None,
    **options: Unpack[SystemOptions],
) -> System:
    """Make a system from a python-control system, with the same inputs.

    Parameters
    ----------
    system : control.StateSpace or control.NonlinearIOSystem
        Used as it is in discrete time, discretised in continuous time. It must be time-invariant.
    dt : float, optional
        Sampling time, required for a system in continuous time.
    method : {"zoh", "rk4", "euler"}, optional
        Discretisation of a system in continuous time. The default is ``zoh``, exact for a
        held input, for linear systems and ``rk4`` for nonlinear ones.
    **options
        Sets and scales, as for `qpmhe.System`.

    Returns
    -------
    System
        It pickles if its functions do; a linear system always does.

    Raises
    ------
    ModelError, SetError, OptionError
        If the system, a set or an option is invalid; the message names it.
    InvalidInputError
        If python-control is not installed.
    """
    control = need("control", "from_control", "control")
    linear = isinstance(system, control.StateSpace)
    if not linear and not isinstance(system, control.NonlinearIOSystem):
        raise ModelError(
            f"system is a {type(system).__name__}; expected a control.StateSpace or a "
            "control.NonlinearIOSystem. Convert transfer functions by control.ss."
        )
    if not system.nstates:
        raise ModelError("system has no states to estimate.")
    if system.isctime(strict=True) or (system.dt is None and dt is not None):
        if dt is None:
            raise OptionError(
                "dt is missing: the system is in continuous time; pass the sampling time."
            )
        length: float | None = positive("dt", dt)
    else:
        if dt is not None and system.dt is not True and dt != system.dt:
            raise OptionError(
                f"dt is {dt!r}, but the system is in discrete time with dt = {system.dt!r}; "
                "leave it out."
            )
        length = None
    if linear:
        matrices = {name: _real(name, getattr(system, name)) for name in "ABCD"}
        return _linear(**matrices, dt=length, method=method, options=options)
    made = _nonlinear(system, length, method, options)
    _check_no_time(system, made, dt)
    arguments = {"system": system, "dt": dt, "method": method, **options}
    return made.with_origin(recipe=(from_control, arguments))


def _real(name: str, matrix: Any) -> Array:
    if np.iscomplexobj(matrix):
        raise ModelError(
            f"{name} of the system is {np.asarray(matrix).tolist()}; expected real numbers. "
            "Transform the system to real states, such as real and imaginary parts."
        )
    return numbers(f"{name} of the system", matrix)


def _linear(
    A: Array,
    B: Array,
    C: Array,
    D: Array,
    dt: float | None,
    method: str | None,
    options: SystemOptions,
) -> System:
    (n, m), p = B.shape, C.shape[0]
    a, b = A, B
    sizes = {"n": n, "p": p, "m": m}
    output, output_jacobian = _affine(C, D, m)
    if dt is None:
        if method is not None:
            raise OptionError(f"method is {method!r}, but the system is in discrete time.")
    elif method in (None, "zoh"):
        from scipy.linalg import expm

        # Exact for an input that is held: exp of [A, B; 0, 0] dt.
        both = np.zeros((n + m, n + m))
        both[:n, :n], both[:n, n:] = a, b
        held = expm(both * dt)[:n]
        a, b = held[:, :n], held[:, n:]
    else:
        rate, rate_jacobian = _affine(a, b, m)
        system = System.from_ode(
            rate, output, dt=dt, method=method, rate_jacobian=rate_jacobian,
            h_jacobian=output_jacobian, **sizes, **options,
        )
        return _with_recipe(system, A, B, C, D, dt, method, options)
    step, step_jacobian = _affine(a, b, m)
    system = System(
        step, output, f_jacobian=step_jacobian, h_jacobian=output_jacobian, **sizes, **options
    )
    return _with_recipe(system, A, B, C, D, dt, method, options)


def _with_recipe(system: System, *arguments: Any) -> System:
    names = ("A", "B", "C", "D", "dt", "method", "options")
    # A control.StateSpace does not pickle, its matrices do.
    return system.with_origin(recipe=(_linear, dict(zip(names, arguments, strict=True))))


def _affine(of_state: Array, of_input: Array, m: int) -> tuple[Trusted, Trusted]:
    """Sum of x M^T and u N^T over leading dimensions, and its derivative with respect to x."""
    by_state, by_input = of_state.T.copy(), of_input.T.copy()
    constant = of_state.copy()

    def value(x: Array, *u: Array) -> Array:
        result: Array = x @ by_state
        if u:
            result = result + u[0] @ by_input
        return result

    def slope(x: Array) -> Array:
        return np.broadcast_to(constant, (*x.shape[:-1], *constant.shape))

    if m == 0:
        return Trusted(lambda x: value(x)), Trusted(slope)
    return Trusted(lambda x, u: value(x, u)), Trusted(lambda x, _: slope(x))


def _nonlinear(
    system: Any, dt: float | None, method: str | None, options: SystemOptions
) -> System:
    m = system.ninputs
    sizes = {"n": system.nstates, "p": system.noutputs, "m": m}

    def at(function: Function) -> Function:
        # python-control's functions take one state, and a time that a System does not have.
        if m == 0:
            return lambda x: np.asarray(function(0.0, x, np.zeros(0)))
        return lambda x, u: np.asarray(function(0.0, x, u))

    update, output = at(system.dynamics), at(system.output)
    if dt is None:
        if method is not None:
            raise OptionError(f"method is {method!r}, but the system is in discrete time.")
        return System(update, output, **sizes, **options)
    return System.from_ode(update, output, dt=dt, method=method or "rk4", **sizes, **options)


def _check_no_time(system: Any, made: System, dt: float | None) -> None:
    """Check that dynamics and output do not depend on time, which a `System` cannot express."""
    unit = float(dt or (1.0 if system.dt in (None, True) else system.dt) or 1.0)
    times = other_times(unit, system.isctime())
    for name, function in (("dynamics", system.dynamics), ("output", system.output)):
        for x, u in points(FEW, made.n, made.m, made.states):
            first = _value(function, 0.0, x, u)
            if first is None:
                continue
            for time in times.tolist():
                then = _value(function, time, x, u)
                if then is None or not np.array_equal(first, then, equal_nan=True):
                    raise ModelError(
                        f"the {name} of the system at x = {x.tolist()}, u = {u.tolist()} is "
                        f"{first.tolist()} at time 0 and "
                        f"{'an error' if then is None else then.tolist()} at time {time:g}; "
                        "expected a time-invariant system. Make "
                        "time-varying quantities inputs, whose values are known at each sample."
                    )


def _value(function: Function, time: float, x: Array, u: Array) -> Array | None:
    try:
        with np.errstate(all="ignore"):
            # A copy: a function may return one and the same array every time.
            return np.array(function(time, x.copy(), u.copy()), dtype=np.float64)
    except Exception:  # outside its domain
        return None
