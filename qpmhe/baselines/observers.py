"""Observers for a problem, by the names that studies and `qpmhe.tune` know."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import shown

from ..errors import ModelError
from ..models.loading import ModelSource, build
from ..observers import ExtendedKalman, Gate, Observer, SteadyStateKalman, UnscentedKalman
from .base import Problem


def extended_kalman(problem: Problem, **options: Any) -> ExtendedKalman:
    """An extended Kalman filter with the problem's covariances."""
    return ExtendedKalman(**problem.covariances, **options)


def gated_kalman(problem: Problem, **options: Any) -> ExtendedKalman:
    """An extended Kalman filter with `qpmhe.Gate`, of which these are the options."""
    return ExtendedKalman(**problem.covariances, innovation=Gate(**options))


def unscented_kalman(problem: Problem, **options: Any) -> UnscentedKalman:
    """An unscented Kalman filter with the problem's covariances."""
    return UnscentedKalman(**problem.covariances, **options)


def steady_kalman(
    problem: Problem, at: ArrayLike | None = None, u: ArrayLike | None = None
) -> SteadyStateKalman:
    """A constant gain about the state `at` (n,) and all inputs `u` (m,).

    Without them, it is about the initial state, inputs of 0 and the problem's parameters.
    """
    system, behind = problem.system, problem.parameters
    if u is None and system.m:
        u = np.concatenate((np.zeros(system.m - behind.size), behind))
    return SteadyStateKalman(
        system, problem.initial_state if at is None else at, u, **problem.covariances)


#: Short names, and the functions that make these observers; the simplest first.
KNOWN = {
    name: f"{__name__}:{function.__name__}" for name, function in (
        ("ekf", extended_kalman), ("gated", gated_kalman), ("ukf", unscented_kalman),
        ("steady", steady_kalman),
    )
}


def made(maker: ModelSource, problem: Problem) -> Any:
    """The observer or estimator that a function of the user makes; a `ModelError` if it fails."""
    found = build(maker, problem)
    if maker.kind == "observer" and not isinstance(found, Observer):
        raise ModelError(
            f"observer {maker.name!r} returned {shown(found)}; expected a qpmhe.Observer."
        )
    if maker.kind == "estimator" and not callable(getattr(found, "update", None)):
        raise ModelError(
            f"estimator {maker.name!r} returned {shown(found)}; expected an object with "
            "update(y, u)."
        )
    return found
