"""Kalman updates of a root of the covariance, which keep digits where the covariance has none left.

A prior of s deviations of the noise leaves a covariance with shares of s**-2 of its entries that
matter: beyond 1e8 they are below rounding. In a root of it they are shares of 1/s.
"""

from __future__ import annotations

import numpy as np

from .._checks import Array
from .._linalg import cholesky, inverse

#: A covariance is propagated by its root where a component's variance, given those before it, is
#: less than this share of its variance.
VAGUE = 2.0**-26


def least_share(noise: Array) -> float:
    """The least variance of a component given the others, as a share of its variance."""
    return float(1.0 / (inverse(noise).diagonal() * noise.diagonal()).max())


def updated(
    seen: Array, ahead: Array, noise: Array, disturbance: Array | None = None
) -> tuple[Array, Array]:
    r"""The gain (n, q) of least mean square error, and a root of the covariance that it leaves.

    A root U is upper triangular with :math:`U^\top U` the covariance. With the k deviations seen by
    the outputs and those of the state, X (k, q) and F (k, n), one QR factorisation gives all:

    .. math::
        \begin{bmatrix} U_R & 0 \\ X & F \\ 0 & U_Q \end{bmatrix}
        = \Theta \begin{bmatrix} U_S & U_S K^\top \\ 0 & U^+ \end{bmatrix}

    Parameters
    ----------
    seen, ahead : (k, q) and (k, n) array
        X and F, with at least n rows.
    noise, disturbance : (q, q) and (n, n) array
        Covariances R and Q; no Q in a measurement update.

    References
    ----------
    Kailath, Sayed and Hassibi, Linear Estimation, 2000, chapter 12 (array algorithms).
    """
    (k, q), n = seen.shape, ahead.shape[1]
    rows = np.zeros((q + k + (0 if disturbance is None else n), q + n))
    rows[:q, :q] = cholesky(noise).T
    rows[q : q + k, :q], rows[q : q + k, q:] = seen, ahead
    if disturbance is not None:
        rows[q + k :, q:] = cholesky(disturbance).T
    factor = triangle(rows)
    gain = np.asarray(np.linalg.solve(factor[:q, :q], factor[:q, q:]), np.float64).T
    root = factor[q:, q:]
    return gain, np.where(root.diagonal() < 0.0, -1.0, 1.0)[:, None] * root


def triangle(rows: Array) -> Array:
    """An upper triangular R with R'R the square of some rows, no fewer than columns.

    The longest rows come first, each in the lengths of the columns: rounding in a row is then small
    beside this row, however long others are (Cox and Higham, Stability of Householder QR
    factorization for weighted least squares problems, 1998).
    """
    sizes = np.abs(rows)
    lengths = sizes.max(axis=0)
    longest = (sizes / np.where(lengths > 0.0, lengths, 1.0)).max(axis=1)
    return np.asarray(np.linalg.qr(rows[np.argsort(-longest, kind="stable")], mode="r"))


def whitened(factor: Array, v: Array) -> Array:
    """The solution w of U'w = v, for an upper triangle U; 0 where U has a row of zeros."""
    found = np.zeros_like(v)
    for j, value in enumerate(v):
        if factor[j, j] != 0.0:
            found[j] = (value - factor[:j, j].dot(found[:j])) / factor[j, j]
    return found


def grown(root: Array, covariance: Array, larger: Array) -> Array:
    """The root of a covariance that has grown from another one by its deviations alone."""
    variances = covariance.diagonal()
    wider: Array = root * np.sqrt(larger.diagonal() / np.where(variances > 0.0, variances, 1.0))
    return wider
