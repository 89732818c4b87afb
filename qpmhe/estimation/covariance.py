"""Covariances of a trajectory's states, by linearisation along it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .._linalg import unit_diagonal
from ..errors import InvalidInputError
from ..model.system import System

Array = NDArray[np.float64]
# Of the variance before smoothing: below this share, hardly a digit is left of it.
_LEAST = 1e-14
_LOST = (
    "the covariances are not defined along the estimate: the weights of prior, disturbance and "
    "noise there leave a direction of the states (nearly) undetermined. A redescending loss "
    "(Cauchy, GemanMcClure, Barron) takes the weight from a large residual: take Huber for the "
    "prior and the disturbance, or a larger threshold. Without one, increase the prior's weight."
)


def window_covariances(
    model: System,
    trajectory: Array,
    inputs: Array,
    weights: Array,
    prior_weight: Array,
    basis: Array,
) -> Array:
    """Covariances (K + 1, n, n) of the states of a trajectory, given its window.

    Diagonal blocks of the inverse of the Gauss-Newton Hessian of J/2, by the Kalman filter
    and the Bryson-Frazier smoother of the linearised model. These invert no covariance of a
    state, so that disturbances may have zero covariance in some directions (noise-free ones).

    Parameters
    ----------
    model : System
        The system that takes these inputs.
    trajectory, inputs : array
        States (K + 1, n), and inputs of the stages.
    weights, prior_weight : array
        Of the quadratic forms of the stages, (q, q) or (K, q, q) with q = n + p, and of the
        initial error (n, n).
    basis : (n, k) array
        The directions in which there are disturbances.

    Raises
    ------
    InvalidInputError
        Without finite Jacobians along the trajectory, or if the weights are so small in a
        direction that rounding decides.

    References
    ----------
    Bierman, Fixed interval smoothing with discrete measurements, International Journal of
    Control 18 (1973), the modified Bryson-Frazier smoother.
    """
    states, n, count = trajectory[:-1], trajectory.shape[1], trajectory.shape[0] - 1
    try:
        a = np.asarray(model.f_jacobian.batch(states, inputs))
        c = np.asarray(model.h_jacobian.batch(states, inputs))
    except Exception as error:
        raise InvalidInputError(
            f"the model has no Jacobians along the estimate: {error}"
        ) from error
    if not (np.isfinite(a).all() and np.isfinite(c).all()):
        raise InvalidInputError("the Jacobians are not finite along the estimate.")
    q = weights.shape[-1]
    # In deviations of the prior, rounded to powers of two: the result then depends on no unit.
    prior_weight, units, whole = unit_diagonal(prior_weight)
    a, c = np.ldexp(a, units[:, None] - units), np.ldexp(c, -units)
    unit = np.append(units, np.zeros(q - n, np.int32))
    weights = np.broadcast_to(
        np.ldexp(weights, -whole - unit[:, None] - unit), (count, q, q)
    )
    # Columns of order one, and those of the identity as they are.
    basis = np.ldexp(basis, units[:, None])
    basis = np.ldexp(basis, 1 - np.frexp(np.abs(basis).max(axis=0, initial=0.0))[1])
    try:
        covariance = _smoothed(a, c, weights, prior_weight, basis)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError(_LOST) from error
    return np.asarray(np.ldexp(covariance, -whole - units[:, None] - units))


def _smoothed(a: Array, c: Array, weights: Array, prior_weight: Array, basis: Array) -> Array:
    count, n = a.shape[:2]
    eye = np.eye(n)
    prior = np.linalg.inv(prior_weight)
    covariance = np.empty((count + 1, n, n))  # first predicted, then smoothed
    covariance[0] = 0.5 * (prior + prior.T)
    # I - K C and C^T S^{-1} C of each stage, from the information C^T R C of its outputs (R their
    # weight, S the innovation's covariance); a missing component has no weight in R.
    closed, gained = np.empty((count, n, n)), np.empty((count, n, n))
    for i in range(count):
        information = c[i].T @ weights[i, n:, n:] @ c[i]
        closed[i] = np.linalg.inv(eye + covariance[i] @ information)
        gained[i] = information @ closed[i]
        predicted = a[i] @ closed[i] @ covariance[i] @ a[i].T
        predicted += basis @ np.linalg.inv(basis.T @ weights[i, :n, :n] @ basis) @ basis.T
        covariance[i + 1] = 0.5 * (predicted + predicted.T)
    predicted_variances = np.diagonal(covariance, axis1=1, axis2=2).copy()
    later = np.zeros((n, n))  # information of this and later outputs on the state
    for i in range(count - 1, -1, -1):
        transition = a[i] @ closed[i]
        later = gained[i] + transition.T @ later @ transition
        covariance[i] -= covariance[i] @ later @ covariance[i]
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    # Noise-free components may have no variance, up to rounding, from the start.
    largest = predicted_variances.max(axis=1, keepdims=True)
    uncertain = predicted_variances > _LEAST * largest
    if not np.isfinite(covariance).all() or (
        (variances < _LEAST * predicted_variances) & uncertain
    ).any():
        raise InvalidInputError(_LOST)
    return covariance
