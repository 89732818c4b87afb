"""The optimality conditions of a window, linearised: a banded matrix, factored once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_of

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# In place of the zeros that belong to the rows, in scaled numbers: some rows may depend on others.
_REGULAR = 2.0**-40
# The weight of rows in the test of the second-order condition, in scaled numbers.
_STIFF = 2.0**20


class OptimalityMatrix:
    r"""The matrix :math:`\begin{pmatrix} H & A^\top \\ A & 0 \end{pmatrix}` of states and rows.

    H is block-tridiagonal, and each row acts on a state and the next one. So the matrix is banded
    with the rows of a stage behind its state, and one factorisation takes O(N) time: Cholesky
    without rows, LU with them. All numbers are scaled by powers of two, so that no unit matters.

    Parameters
    ----------
    own, below : (K + 1, n, n) and (K, n, n) array
        Diagonal blocks of H, and those below them.
    stage : (R,) array of int
        The stage of each row, in ascending order.
    on_own, on_next : (R, n) array
        The rows on the state of their stage, and on the next.
    typical : (K + 1, n) array
        Positive numbers of the size of H's diagonal, for the units.
    """

    def __init__(
        self, own: Array, below: Array, stage: Index, on_own: Array, on_next: Array,
        typical: Array,
    ) -> None:
        from scipy.linalg.lapack import dgbtrf, dgbtrs, dpbtrs  # late: as the solvers do

        stages, n = typical.shape
        self._solve: Callable[[Array], Array]
        self._own, self._below = own, below
        self._units = units = np.ldexp(1.0, -(np.frexp(typical)[1] // 2))
        own = own * units[:, :, None] * units[:, None, :]
        below = below * units[1:, :, None] * units[:-1, None, :]
        following = np.minimum(stage + 1, stages - 1)
        on_own, on_next = on_own * units[stage], on_next * units[following]
        largest = np.maximum(np.abs(on_own).max(axis=1), np.abs(on_next).max(axis=1))
        self._row_units = np.ldexp(1.0, -np.frexp(largest)[1])
        on_own, on_next = on_own * self._row_units[:, None], on_next * self._row_units[:, None]
        # Where states and rows stand.
        rows_before = np.searchsorted(stage, np.arange(stages))
        self._at = (n * np.arange(stages) + rows_before)[:, None] + np.arange(n)
        self._row_at = n * (stage + 1) + np.arange(stage.size)
        size, rows = stages * n + stage.size, stage.size
        at, row_at = self._at, self._row_at
        entries = [
            (at[1:, :, None], at[:-1, None, :], below), (at[:, :, None], at[:, None, :], own),
        ]
        self.definite: bool
        if not rows:
            factor, self.definite = _cholesky(own, below)
            if self.definite:
                self._solve = lambda side: dpbtrs(factor, side, lower=1)[0]
                return
        else:
            self.definite = self._is_definite(own, below, stage, following, on_own, on_next)
        entries += [
            (row_at[:, None], at[stage], on_own),
            (row_at[:, None], row_at[:, None], np.full((rows, 1), -_REGULAR)),
        ]
        inner = stage < stages - 1
        entries += [(at[following[inner]], row_at[inner, None], on_next[inner])]
        width = 2 * n - 1 + int(np.bincount(stage, minlength=1).max())
        band = np.zeros((3 * width + 1, size))
        for i, j, values in entries:
            i, j = np.broadcast_arrays(i, j)
            band[2 * width + i - j, j] = values
            band[2 * width + j - i, i] = values
        factor, pivots, info = dgbtrf(band, width, width)
        if info != 0:  # singular: no derivative exists
            self._solve = lambda side: np.full_like(side, np.nan)
        else:
            self._solve = lambda side: dgbtrs(factor, width, width, side, pivots)[0]

    def _is_definite(
        self, own: Array, below: Array, stage: Index, following: Index, on_own: Array,
        on_next: Array,
    ) -> bool:
        """Whether H is positive definite where all rows are zero: the second-order condition."""
        own, below = own.copy(), below.copy()
        np.add.at(own, stage, _STIFF * on_own[:, :, None] * on_own[:, None, :])
        inner = stage < len(below)
        np.add.at(
            own, following[inner],
            _STIFF * on_next[inner, :, None] * on_next[inner, None, :],
        )
        np.add.at(
            below, stage[inner], _STIFF * on_next[inner, :, None] * on_own[inner, None, :]
        )
        return _cholesky(own, below)[1]

    def solve(self, states: Array, rows: Array | float = 0.0) -> tuple[Array, Array]:
        """Solutions for several right-hand sides: (B, K + 1, n) and (B, R), or 0."""
        count = len(states)
        side = np.zeros((count, self._at.size + self._row_at.size))
        side[:, self._at] = states * self._units
        side[:, self._row_at] = rows * self._row_units
        found = self._solve(side.T).T
        return found[:, self._at] * self._units, found[:, self._row_at] * self._row_units

    def square(self, step: Array) -> float:
        """The quadratic form of H at a step (K + 1, n)."""
        value = np.einsum("ki,kij,kj->", step, self._own, step)
        return float(value + 2.0 * np.einsum("ki,kij,kj->", step[1:], self._below, step[:-1]))


def _cholesky(own: Array, below: Array) -> tuple[Array, bool]:
    """The Cholesky factor of a block-tridiagonal matrix, in LAPACK's band, if it has one."""
    from scipy.linalg.lapack import dpbtrf

    columns = np.concatenate((own, np.zeros_like(own)), axis=1)
    columns[:-1, own.shape[1] :] = below
    band = band_of(columns).reshape(-1, 2 * own.shape[1]).T
    factor, info = dpbtrf(band, lower=1, overwrite_ab=1)
    return factor, bool(info == 0)
