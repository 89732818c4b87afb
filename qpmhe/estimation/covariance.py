"""Covariances of a trajectory's states, by linearisation along it."""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from .._linalg import cholesky, unit_diagonal
from ..errors import InvalidInputError
from ..model.system import System

Array = NDArray[np.float64]
# Rows that determine less than this share of a direction leave it to rounding: variances are then
# off by more than 1e-7.
_LEAST = 5e-12
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
    prior_root: Array | None = None,
) -> Array:
    """Covariances (K + 1, n, n) of the states of a trajectory, given its window.

    Diagonal blocks of the inverse of the Gauss-Newton Hessian of J/2, by a square-root
    information filter backwards in time and covariances forwards. These subtract no squares, so
    that no variance is negative, and a vague prior costs no digits: entries are exact to about
    1e-13 of the standard deviations where the data determine all directions, and to 1e-9 where
    only a prior of up to 1e10 standard deviations of the noise determines some. Disturbances may
    have zero covariance in some directions (noise-free ones).

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
    prior_root : (j, n) array or None
        Rows whose square is ``prior_weight``, where they alone have all digits.

    Raises
    ------
    InvalidInputError
        Without finite Jacobians along the trajectory, or if the weights are so small in a
        direction that rounding decides.

    References
    ----------
    Bierman, Factorization Methods for Discrete Sequential Estimation, Academic Press, 1977, the
    square-root information filter.
    """
    states, n, count = trajectory[:-1], trajectory.shape[1], trajectory.shape[0] - 1
    try:
        a, c = (np.asarray(one) for one in model.evaluation.linear(states, inputs))
    except Exception as error:
        raise InvalidInputError(
            f"the model has no Jacobians along the estimate: {error}"
        ) from error
    if not (np.isfinite(a).all() and np.isfinite(c).all()):
        raise InvalidInputError("the Jacobians are not finite along the estimate.")
    q = weights.shape[-1]
    # In deviations of the prior, rounded to powers of two: the result then depends on no unit.
    prior_weight, units, whole = unit_diagonal(prior_weight)
    if prior_root is None:
        prior_rows = _factors(prior_weight[None])[0]
    else:
        prior_rows = np.ldexp(prior_root, -units) / math.sqrt(2.0**whole)
    a, c = np.ldexp(a, units[:, None] - units), np.ldexp(c, -units)
    unit = np.append(units, np.zeros(q - n, np.int32))
    weights = np.broadcast_to(
        np.ldexp(weights, -whole - unit[:, None] - unit), (count, q, q)
    )
    # Columns of order one, and those of the identity as they are.
    basis = np.ldexp(basis, units[:, None])
    basis = np.ldexp(basis, 1 - np.frexp(np.abs(basis).max(axis=0, initial=0.0))[1])
    try:
        covariance = _smoothed(a, c, weights, prior_rows, basis)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError(_LOST) from error
    return np.asarray(np.ldexp(covariance, -whole - units[:, None] - units))


def _smoothed(a: Array, c: Array, weights: Array, prior_rows: Array, basis: Array) -> Array:
    """Covariances from the factors of information backwards in time, and of covariances forwards.

    With disturbances B d(i), the outputs from i on and the disturbances' weights are rows
    [T(i) d(i) + F(i) x(i); U(i) x(i)] of unit variance, by one QR factorisation that takes in the
    rows of i + 1. So x(0) has the covariance of the rows of the prior and U(0), and
    x(i+1) = (A(i) - B T(i)^-1 F(i)) x(i) + B T(i)^-1 e(i): only squares are added.
    """
    (count, n), k = a.shape[:2], basis.shape[1]
    p = c.shape[1]
    rows = np.zeros((count, k + n + p, k + n))
    rows[:, :k, :k] = _factors(basis.T @ weights[:, :n, :n] @ basis)
    rows[:, k + n :, k:] = _factors(weights[:, n:, n:]) @ c
    along = np.concatenate((np.broadcast_to(basis, (count, n, k)), a), axis=2)
    turned = np.empty((count, k, k + n))
    later = np.zeros((n, n))
    for i in range(count - 1, -1, -1):
        rows[i, k : k + n] = later @ along[i]
        triangle = _triangle(rows[i])
        turned[i], later = triangle[:k], triangle[k : k + n, k:]
    pivots = turned[:, :, :k]
    _check_regular(pivots, rows[:, :, :k])
    added = basis @ _inverse(pivots)
    moved = a - added @ turned[:, :, k:]
    factor = _inverse(_pivoted(np.vstack((prior_rows, later))))
    covariance = np.empty((count + 1, n, n))
    covariance[0] = factor @ factor.T
    wide = np.empty((n + k, n))
    for i in range(count):
        wide[:n], wide[n:] = (moved[i] @ factor).T, added[i].T
        covariance[i + 1] = wide.T @ wide
        factor = _triangle(wide)[:n].T
    if not np.isfinite(covariance).all():
        raise InvalidInputError(_LOST)
    return covariance


def _triangle(rows: Array) -> Array:
    """R of a factorisation Q R of some rows, no fewer than columns.

    The longest rows come first: rounding in a row is then small beside this row, however long
    others are (Cox and Higham, Stability of Householder QR factorization for weighted least squares
    problems, 1998).
    """
    from scipy.linalg.lapack import dgeqrf  # late: the step does without SciPy

    order = np.argsort(-np.abs(rows).max(axis=1, initial=0.0), kind="stable")
    return np.triu(dgeqrf(rows[order])[0])


def _pivoted(rows: Array) -> Array:
    """A square root of the rows' information, with columns exchanged by size as well."""
    from scipy.linalg.lapack import dgeqp3

    n = rows.shape[1]
    order = np.argsort(-np.abs(rows).max(axis=1), kind="stable")
    factors, exchanged = dgeqp3(rows[order])[:2]
    triangle = np.triu(factors[:n])
    _check_regular(triangle, rows[:, exchanged - 1])
    root = np.empty((n, n))
    root[:, exchanged - 1] = triangle
    return root


def _check_regular(triangles: Array, rows: Array) -> None:
    """Refuse columns that depend on those before them, up to rounding."""
    pivots = np.abs(np.diagonal(triangles, axis1=-2, axis2=-1))
    if not (pivots > _LEAST * np.linalg.norm(rows, axis=-2)).all():
        raise InvalidInputError(_LOST)


def _inverse(matrices: Array) -> Array:
    """Inverses of regular square matrices whose rows are of any size."""
    sizes = np.abs(matrices).max(axis=-1, initial=0.0, keepdims=True)
    return np.asarray(np.linalg.inv(matrices / sizes) / np.swapaxes(sizes, -1, -2))


def _factors(weights: Array) -> Array:
    """R with R' R = W for each of many weights, positive semidefinite."""
    with suppress(np.linalg.LinAlgError):
        return np.asarray(np.swapaxes(np.linalg.cholesky(weights), -1, -2))
    return np.array([cholesky(one).T for one in weights])
