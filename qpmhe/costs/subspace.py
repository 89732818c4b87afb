"""The directions in which disturbances act, if these are fewer than the states."""

from __future__ import annotations

import numpy as np

from .._checks import Array


class Subspace:
    r"""The range of B (n, s), of full rank, in which all :math:`d = x^+ - f(x)` are.

    With D the diagonal matrix of typical squares of the states, times a power of two, so that no
    unit matters, and N (n, k) a basis of the noise-free directions:

    .. math::
        B^+ = (B^\top D^{-1} B)^{-1} B^\top D^{-1}, \qquad N^\top B = 0,\ N^\top D N = I

    Parameters
    ----------
    directions : (n, s) array
        B: the system's ``disturbance_matrix`` G, times a factor of the covariance of w where that
        is singular.
    matrix : (n, r) array or None
        G; None for the identity.
    variances : (n,) array
        Typical squares of the states.

    Attributes
    ----------
    scale : (n,) array
        The square roots of D.
    directions, inverse : (n, s) and (s, n) array
        B and :math:`B^+`.
    normal : (n, k) array
        N in scaled numbers, :math:`D^{1/2} N`: orthonormal.
    noise_free : (n, k) array
        N.
    stand_in : (n, n) array
        A weight of the size of the prior's on the noise-free directions alone, N N'.
    to_disturbances : (r, n) array or None
        :math:`G^+`, which maps d to w; None for the identity.
    """

    def __init__(self, directions: Array, matrix: Array | None, variances: Array) -> None:
        self.directions = directions
        # In pairs of powers of two, which have exact roots: then no unit changes a digit.
        whole = int(np.frexp(variances[0])[1]) % 2
        self.scale: Array = np.sqrt(np.ldexp(variances, -whole))
        self.inverse, self.normal = _split(directions, self.scale)
        self.noise_free: Array = self.normal / self.scale[:, None]
        self.stand_in: Array = np.ldexp(self.noise_free @ self.noise_free.T, -whole)
        self.to_disturbances: Array | None = None
        if matrix is not None:
            self.to_disturbances = _split(matrix, self.scale)[0]


def _split(matrix: Array, scale: Array) -> tuple[Array, Array]:
    """B^+ (s, n) and, in scaled numbers, an orthonormal N (n, k), for B (n, s) of full rank.

    Where a row of B is zero, N has a column of the identity.
    """
    n, s = matrix.shape
    scaled = matrix / scale[:, None]
    noisy = scaled.any(axis=1)
    columns = np.ldexp(1.0, -np.frexp(np.abs(scaled).max(axis=0, initial=0.0))[1])
    q, r = np.linalg.qr(scaled[noisy] * columns, mode="complete")
    inverse = np.zeros((s, n))
    inverse[:, noisy] = columns[:, None] * np.linalg.solve(r[:s], q[:, :s].T)
    normal, quiet = np.zeros((n, n - s)), np.flatnonzero(~noisy)
    normal[quiet, np.arange(quiet.size)] = 1.0
    normal[np.ix_(noisy, np.arange(quiet.size, n - s))] = q[:, s:]
    return inverse / scale, normal
