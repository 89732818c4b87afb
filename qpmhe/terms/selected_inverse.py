"""Entries near the diagonal of the inverse of a banded matrix, without the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class SelectedInverse:
    r"""Blocks of the inverse Z of a symmetric positive definite banded matrix.

    With the matrix as blocks :math:`D_b` on and :math:`E_b` below the diagonal, elimination gives
    :math:`S_0 = D_0, S_{b+1} = D_{b+1} - E_b S_b^{-1} E_b^\top`, and back from the last block,
    where :math:`Z = S^{-1}`,

    .. math::
        Z_{b+1,b} = -Z_{b+1} G_b, \quad Z_b = S_b^{-1} - G_b^\top Z_{b+1,b}, \qquad
        G_b = E_b S_b^{-1}

    Time and memory grow as the number of unknowns, unlike those of the inverse.

    Parameters
    ----------
    band : (width + 1, size) array
        The matrix as LAPACK's lower band.
    reach : int
        How far from the diagonal entries are wanted, at least ``width``.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a block is singular.

    References
    ----------
    K. Takahashi, J. Fagan, M.-S. Chin, "Formation of a sparse bus impedance matrix and its
    application to short circuit study", Proc. 8th PICA Conference (1973).
    """

    def __init__(self, band: Array, reach: int) -> None:
        (height, size), b = band.shape, max(reach, band.shape[0] - 1, 1)
        self._b, count = b, -(-size // b)
        own = np.zeros((count, b, b))
        below = np.zeros((count, b, b))
        column = np.arange(size)
        for offset in range(height):
            row = column[: size - offset] + offset
            at, inside = row // b, row % b
            left, c = column[: size - offset] // b, column[: size - offset] % b
            same, values = at == left, band[offset, : size - offset]
            own[at[same], inside[same], c[same]] = values[same]
            own[at[same], c[same], inside[same]] = values[same]
            below[left[~same], inside[~same], c[~same]] = values[~same]
        rest = np.arange(size, count * b) % b
        own[-1, rest, rest] = 1.0  # beyond the last unknown
        turned = np.empty_like(below)  # G
        for k in range(count):
            own[k] = np.linalg.inv(own[k])
            if k + 1 < count:
                turned[k] = below[k] @ own[k]
                own[k + 1] -= turned[k] @ below[k].T
        for k in range(count - 2, -1, -1):
            below[k] = -own[k + 1] @ turned[k]
            own[k] -= turned[k].T @ below[k]
        self._own, self._below = own, below

    def __call__(self, rows: Index, columns: Index) -> Array:
        """Entries of the inverse, which are not further from the diagonal than the reach."""
        low, high = np.minimum(rows, columns), np.maximum(rows, columns)
        (at, i), (left, j) = np.divmod(high, self._b), np.divmod(low, self._b)
        return np.where(at == left, self._own[at, i, j], self._below[left, i, j])
