"""Whether the step by which an ODE is discretised is short enough for the disturbance's size."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import ModelWarning
from ..model.residuals import difference
from ..model.system import System
from .reach import disturbance_deviations, prior_deviations, prior_points

Array = NDArray[np.float64]

# A step that is off by more than this many standard deviations of w is too long. An Euler step is
# a coarse map by choice, which often is what the data were simulated with.
_TOO_LONG = {"euler": 10.0}
_USUALLY_TOO_LONG = 0.1


@dataclass(frozen=True)
class StepError:
    """The largest difference between one step and two half steps, over some points.

    Attributes
    ----------
    deviations : float
        The difference in standard deviations of G w, or where that has none of the prior.
    component : int
        The state in which it is so large.
    point : (n,) array
        Where it is so large.
    """

    deviations: float
    component: int
    point: Array


def step_error(
    system: System, cost: Cost, covariance: Array | None, state: Array, u: Array
) -> StepError | None:
    """Compare one step of a discretised ODE with two of half the length.

    Parameters
    ----------
    system : System
        The system; one without a model in continuous time has no error.
    cost : Cost
        Its covariances are the units.
    covariance : (n, n) array or None
        The observer's covariance of the initial error, for a prior weight that is the observer's.
    state : (n,) array
        The initial state.
    u : (m,) array
        The usual input.

    Returns
    -------
    StepError or None
        None without a model in continuous time, and where no step is finite.
    """
    if system.dt is None or not system.has_timed:
        return None
    try:
        prior = prior_deviations(cost, covariance)
        points = prior_points(system, state, prior)
        step, half = (np.tile(np.append(u, one), (len(points), 1))
                      for one in (system.dt, 0.5 * system.dt))
        with np.errstate(all="ignore"):
            f = system.timed.f.batch
            missed = np.abs(
                difference(system.state_residual, f(points, step), f(f(points, half), half))
            )
    except Exception:  # a model outside of its domain; the steps will report that
        return None
    units = disturbance_deviations(system, cost)
    shares = missed / np.where(units > 0.0, units, prior)
    shares[~np.isfinite(shares).all(axis=1)] = -1.0
    k, j = np.unravel_index(int(np.argmax(shares)), shares.shape)
    return StepError(float(shares[k, j]), int(j), points[k]) if shares[k, j] >= 0.0 else None


def warn_of_step(error: StepError | None, system: System, level: int) -> None:
    """Warn of a step that is too long, at a level of the stack."""
    most = _TOO_LONG.get(system.method or "", _USUALLY_TOO_LONG)
    if error is None or error.deviations <= most:
        return
    point = np.array2string(error.point, precision=4, separator=", ")
    warnings.warn(
        f"one integration step of dt = {system.dt:g} is too long: from x = {point} it differs from "
        f"two steps of half this length by {error.deviations:.2g} standard deviations of the "
        f"disturbance in state {error.component} (expected at most {most:g}), so estimates may "
        "be wrong though each step improves its cost. Discretise with a shorter step: call the "
        "Runge-Kutta step several times within f, or a stiff integrator, and pass f to "
        "qpmhe.System or qpmhe.from_casadi; or make the covariance of the disturbance as large "
        "as the error.",
        ModelWarning,
        stacklevel=level + 1,
    )
