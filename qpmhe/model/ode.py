"""Systems from ordinary differential equations, discretised with a fixed step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import count, positive
from .derivatives import Jacobian
from .discretize import discretize
from .functions import BatchedFunction, Trusted, check_inputs
from .sets import ConvexSet
from .system import System, checked_set, probe_points

__all__ = ["ode_system"]

Array = NDArray[np.float64]
Function = Callable[..., Any]


def ode_system(
    cls: type[System],
    rate: Function | Trusted,
    h: Function | Trusted,
    *,
    dt: float,
    n: int,
    p: int,
    m: int,
    method: str,
    rate_jacobian: Function | Trusted | None,
    h_jacobian: Function | Trusted | None,
    states: ConvexSet | None,
    disturbances: ConvexSet | None,
    noises: ConvexSet | None,
) -> System:
    """Make a system of a rate; see `qpmhe.System.from_ode`.

    Parameters
    ----------
    cls : type
        `System`, or a class derived from it.
    rate, h, dt, n, p, m, method, rate_jacobian, h_jacobian, states, disturbances, noises
        As there.
    """
    n, m = count("n", n, 1), count("m", m, 0)
    probes = probe_points(checked_set("states", states, n), n, m)
    batched = BatchedFunction("rate", rate, (n,), m, probes)
    given = None
    if rate_jacobian is not None:
        Jacobian(batched, rate_jacobian, m, probes)  # compared with differences here
        given = BatchedFunction("rate_jacobian", rate_jacobian, (n, n), m, probes)
    step, step_jacobian = discretize(
        _over_leading(batched), given and _over_leading(given), method
    )
    length = positive("dt", dt)
    sets: dict[str, Any] = {
        "states": states, "disturbances": disturbances, "noises": noises
    }
    system = cls(
        Trusted(partial(step, length)), h, n=n, p=p, m=m,
        f_jacobian=step_jacobian and Trusted(partial(step_jacobian, length)),
        h_jacobian=h_jacobian, **sets,
    )
    check_inputs(m, rate=batched.takes_input, h=system.h.takes_input)
    system.dt = length
    system._recipe = (
        cls.from_ode,
        {
            "rate": rate, "h": h, "dt": dt, "n": n, "p": p, "m": m, "method": method,
            "rate_jacobian": rate_jacobian, "h_jacobian": h_jacobian, **sets,
        },
    )

    def timed() -> System:
        return cls(
            Trusted(_timed_by_input(step, m)), Trusted(_without_last(system.h.batch, m)),
            n=n, p=p, m=m + 1,
            f_jacobian=step_jacobian and Trusted(_timed_by_input(step_jacobian, m)),
            h_jacobian=Trusted(_without_last(system.h_jacobian.batch, m)), **sets,
        )

    system._timed = timed
    return system


def _over_leading(function: BatchedFunction) -> Function:
    """A function of (..., n), whatever way the user's was written."""
    if function.plain:
        return function.function

    def evaluate(x: Array, *inputs: Array) -> Any:
        u = inputs[0] if inputs else np.empty((*x.shape[:-1], 0))
        return function.batch(x, u) if x.ndim > 1 else np.asarray(function(x, u))

    return evaluate


def _timed_by_input(step: Function, m: int) -> Function:
    def evaluate(x: Array, u: Array) -> Any:
        return step(u[..., m:], x, u[..., :m]) if m else step(u, x)

    return evaluate


def _without_last(function: Function, m: int) -> Function:
    def evaluate(x: Array, u: Array) -> Any:
        return function(x, u[..., :m]) if x.ndim > 1 else function(x[None], u[None, :m])[0]

    return evaluate
