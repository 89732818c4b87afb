"""Covariances of a trajectory's states, by linearisation along it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidInputError
from .problem import Problem

__all__ = ["window_covariances"]

Array = NDArray[np.float64]


def window_covariances(problem: Problem, trajectory: Array) -> Array:
    r"""Covariances (K + 1, n, n) of the states of a trajectory, given its window.

    Diagonal blocks of the inverse of the Gauss-Newton Hessian of J/2, by the Kalman filter
    and the Rauch-Tung-Striebel smoother of the linearisation, which is that inverse in
    covariance form and takes noise-free components (zero covariance of w) as they are.

    Parameters
    ----------
    problem : Problem
        The problem, bound to the window.
    trajectory : (K + 1, n) array
        Where to linearise.

    Raises
    ------
    InvalidInputError
        If the model cannot be evaluated along the trajectory.

    References
    ----------
    Rauch, Tung, Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA
    Journal 3 (1965).
    """
    states, n, count = trajectory[:-1], trajectory.shape[1], trajectory.shape[0] - 1
    trial = problem.evaluate(trajectory)
    try:
        a_all = np.asarray(problem.model.f_jacobian.batch(states, problem.inputs))
        c_all = np.asarray(problem.model.h_jacobian.batch(states, problem.inputs))
    except Exception as error:
        raise InvalidInputError(
            f"the model has no Jacobians along the estimate: {error}"
        ) from error
    if not (np.isfinite(a_all).all() and np.isfinite(c_all).all()):
        raise InvalidInputError("the Jacobians are not finite along the estimate.")
    q = trial.weights.shape[-1]
    weights = np.broadcast_to(trial.weights, (count, q, q))
    noisy = np.ones(n, dtype=np.bool_)
    if problem.disturbances is not None:
        noisy[problem.noise_free] = False
    filtered = np.empty((count, n, n))
    predicted = np.empty((count + 1, n, n))
    predicted[0] = np.linalg.inv(problem.prior_weight_at(trajectory[0] - problem.prior))
    for i in range(count):
        # Information form of the update: a missing component has zero weight, which no
        # covariance can say.
        c, information = c_all[i], weights[i, n:, n:]
        gain = np.linalg.solve(
            np.eye(n) + predicted[i] @ c.T @ information @ c, predicted[i]
        )
        filtered[i] = 0.5 * (gain + gain.T)
        moved = a_all[i] @ filtered[i] @ a_all[i].T
        block = np.ix_(noisy, noisy)
        moved[block] += np.linalg.inv(weights[i, :n, :n][block])
        predicted[i + 1] = 0.5 * (moved + moved.T)
    smoothed = predicted.copy()
    for i in range(count - 1, -1, -1):
        # A singular prediction (no noise, singular A) has the pseudo-inverse as its gain.
        back = filtered[i] @ a_all[i].T @ np.linalg.pinv(predicted[i + 1], hermitian=True)
        smoothed[i] = filtered[i] + back @ (smoothed[i + 1] - predicted[i + 1]) @ back.T
    return smoothed
