"""Covariances of a trajectory's states, by linearisation along it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidInputError
from .problem import Problem

__all__ = ["window_covariances"]

Array = NDArray[np.float64]


def window_covariances(problem: Problem, trajectory: Array) -> Array:
    """Covariances (K + 1, n, n) of the states of a trajectory, given its window.

    Diagonal blocks of the inverse of the Gauss-Newton Hessian of J/2, by the Kalman filter
    and the smoother of Bryson and Frazier of the linearisation: that inverse in covariance
    form. It inverts no covariance of a state, so that noise-free components (zero
    covariance of w) are taken as they are.

    References
    ----------
    Bierman, Fixed interval smoothing with discrete measurements, International Journal of
    Control 18 (1973), the modified Bryson-Frazier smoother.
    """
    states, n, count = trajectory[:-1], trajectory.shape[1], trajectory.shape[0] - 1
    trial = problem.evaluate(trajectory)
    if trial.violation == math.inf:
        raise InvalidInputError("the model has no finite values along the estimate.")
    try:
        a_all = np.asarray(problem.model.f_jacobian.batch(states, problem.inputs))
        c_all = np.asarray(problem.model.h_jacobian.batch(states, problem.inputs))
    except Exception as error:
        raise InvalidInputError(
            f"the model has no Jacobians along the estimate: {error}"
        ) from error
    if not (np.isfinite(a_all).all() and np.isfinite(c_all).all()):
        raise InvalidInputError("the Jacobians are not finite along the estimate.")
    q, eye = trial.weights.shape[-1], np.eye(n)
    weights = np.broadcast_to(trial.weights, (count, q, q))
    noisy = np.ones(n, dtype=np.bool_)
    if problem.disturbances is not None:
        noisy[problem.noise_free] = False
    block = np.ix_(noisy, noisy)
    prior = np.linalg.inv(problem.prior_weight_at(trajectory[0] - problem.prior))
    covariance = np.empty((count + 1, n, n))
    covariance[0] = 0.5 * (prior + prior.T)
    # Of each stage: I - K C, and C^T S^{-1} C, from the information C^T R C of its outputs,
    # which a missing component simply does not add to.
    closed, gained = np.empty((count, n, n)), np.empty((count, n, n))
    for i in range(count):
        information = c_all[i].T @ weights[i, n:, n:] @ c_all[i]
        closed[i] = np.linalg.inv(eye + covariance[i] @ information)
        gained[i] = information @ closed[i]
        moved = a_all[i] @ closed[i] @ covariance[i] @ a_all[i].T
        moved[block] += np.linalg.inv(weights[i, :n, :n][block])
        covariance[i + 1] = 0.5 * (moved + moved.T)
    later = np.zeros((n, n))  # what later outputs tell of the state
    for i in range(count - 1, -1, -1):
        through = a_all[i] @ closed[i]
        later = gained[i] + through.T @ later @ through
        covariance[i] -= covariance[i] @ later @ covariance[i]
    return 0.5 * (covariance + covariance.transpose(0, 2, 1))
