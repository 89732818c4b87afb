"""States that an estimator is likely to reach, where functions are compared before it steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .._linalg import inverse
from ..costs import Cost
from ..model.points import Points
from ..model.system import System
from ..model.traces import warn_of

Array = NDArray[np.float64]

_SEED = 20210829
# Random points within one standard deviation of the prior where steps are compared.
_NEAR = 8
# How many deviations of the prior away functions are compared.
_AWAY = (1.0, 1.0, 3.0)
# The model is followed over at most so many samples.
_SAMPLES = 20


def prior_deviations(cost: Cost, covariance: Array | None) -> Array:
    """Standard deviations (n,) of the initial state, by the cost or the observer's covariance."""
    deviations: Array = np.sqrt(inverse(cost.initial_weight(covariance)).diagonal())
    return deviations


def disturbance_deviations(system: System, cost: Cost) -> Array:
    """Standard deviations (n,) of G w; 0 where there is no disturbance."""
    spread, directions = inverse(cost.disturbance), cost.directions(system.disturbance_matrix)
    if directions is not None:
        spread = directions @ spread @ directions.T
    deviations = np.sqrt(np.maximum(spread.diagonal(), 0.0))
    if directions is None and system.disturbances is not None:
        deviations[system.disturbances.fixed_components] = 0.0
    return deviations


def prior_points(system: System, state: Array, prior: Array) -> Array:
    """The initial state, and points of X within one standard deviation of the prior."""
    n, generator = state.size, np.random.default_rng(_SEED)
    inner = generator.uniform(-1.0, 1.0, (_NEAR, n))
    steps = np.concatenate((np.zeros((1, n)), np.eye(n), -np.eye(n), inner))
    return _within(system, state + prior * steps)


def reached(
    system: System, cost: Cost, covariance: Array | None, state: Array, u: Array, horizon: int
) -> Points:
    """States and inputs that an estimator may meet in its first window, without the first one.

    Points within one and three deviations of the prior; and where the model leads from the initial
    state and from the last of these points, with disturbances of one standard deviation, in a
    window of at most 20 samples: after half of it, and at its end.

    Parameters
    ----------
    system : System
        The system, as the estimator evaluates it.
    cost : Cost
        Its covariances are the units.
    covariance : (n, n) array or None
        The observer's covariance of the initial error, for a prior weight that is the observer's.
    state : (n,) array
        The initial state.
    u : (m,) array
        The usual input.
    horizon : int
        The horizon N.
    """
    generator = np.random.default_rng(_SEED)
    prior = prior_deviations(cost, covariance)
    draws = np.array(_AWAY)[:, None] * generator.uniform(-1.0, 1.0, (len(_AWAY), state.size))
    states = _within(system, state + prior * draws)
    samples = min(horizon, _SAMPLES)
    kept, followed = {(samples + 1) // 2, samples}, np.vstack((state, states[-1]))
    deviations, found = disturbance_deviations(system, cost), [states]
    inputs = np.tile(u, (len(followed), 1))
    try:
        with np.errstate(all="ignore"):
            for k in range(1, samples + 1):
                moved = deviations * generator.uniform(-1.0, 1.0, followed.shape)
                followed = _within(system, system.f.batch(followed, inputs) + moved)
                if k in kept:
                    found.append(followed)
    except Exception:  # a model outside of its domain; the steps will report that
        pass
    return [(one, u) for one in np.vstack(found) if np.isfinite(one).all()]


def compared(
    system: System, cost: Cost, covariance: Array | None, state: Array, u: Array, horizon: int
) -> System:
    """The system, its traces compared with its functions at such points; as written if they differ.

    Arguments are those of `reached`.
    """
    if not system.is_traced:
        return system
    fault = system.fault(reached(system, cost, covariance, state, u, horizon))
    if not fault:
        return system
    if system.tracing is not None:
        system.tracing.forget()
    warn_of(fault, 5)
    return system.as_written()


def _within(system: System, points: Array) -> Array:
    """The same points, moved within the bounds of X."""
    if system.states is None:
        return points
    return np.clip(points, system.states.lower, system.states.upper)
