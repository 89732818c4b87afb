"""The auxiliary observer on a record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from ..observers import Observer, Sample
from ..system import System

__all__ = ["ObserverRun", "observe"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ObserverRun:
    """What the observer did.

    Parameters
    ----------
    states : (T + 1, n) array
        z(0), ..., z(T).
    corrections, noises : (T, n) and (T, p) array
        L(t) and v_z(t).
    """

    states: Array
    corrections: Array
    noises: Array


def observe(
    system: System, observer: Observer, initial_state: Array, y: Array, u: Array
) -> ObserverRun:
    """Run an observer on complete measurements, (eq:observer).

    Parameters
    ----------
    system, observer
        Which.
    initial_state : (n,) array
        z(0).
    y, u : (T, p) and (T, m) array
        Measurements and inputs.

    Raises
    ------
    ModelError
        If the model or the observer raises.
    """
    observer.check(system, initial_state)
    steps = y.shape[0]
    states = np.empty((steps + 1, system.n))
    corrections, noises = np.empty((steps, system.n)), np.empty((steps, system.p))
    states[0], covariance = initial_state, observer.initial_covariance()
    with np.errstate(all="ignore"):
        for t in range(steps):
            z = states[t]
            try:
                noises[t] = y[t] - system.h(z, u[t])
                sample = Sample(system, u[t], covariance=covariance)
                if observer.needs_jacobians:
                    sample.f_jacobian = system.f_jacobian(z, u[t])
                    sample.h_jacobian = system.h_jacobian(z, u[t])
                corrections[t], covariance = observer.correct(z, noises[t], sample)
                states[t + 1] = system.f(z, u[t]) + corrections[t]
            except Exception as error:  # a user's function may raise anything
                raise ModelError(
                    f"the model or the observer raises {type(error).__name__} along the run, at "
                    f"z({t}) = {z.tolist()}: {error}. Leave the run out, or make the model defined "
                    "there."
                ) from error
    return ObserverRun(states, corrections, noises)
