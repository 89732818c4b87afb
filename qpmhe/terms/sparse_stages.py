"""A stage's products of sparse matrices, for models of many states that depend on few others."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Below so many states, and above this share of entries, BLAS multiplies them faster.
_LEAST_STATES = 150
_MOST_FILLED = 0.05


class _Sparse:
    """Sparse copies of matrices of one shape, with the pattern of the one before."""

    __slots__ = ("_made", "_places", "_source")

    def __init__(self) -> None:
        from scipy.sparse import csr_array  # late: few models need it

        self._made = csr_array
        self._source: NDArray[np.intp] | None = None
        self._places: Any = None

    def of(self, matrix: Array) -> Any:
        """The matrix in compressed rows; None if too many of its entries are not 0."""
        flat = matrix.reshape(-1)
        count = np.count_nonzero(flat)
        if count > _MOST_FILLED * flat.size:
            return None
        if self._source is None or np.count_nonzero(flat[self._source]) != count:
            self._source = np.flatnonzero(flat)
            rows, columns = np.divmod(self._source, matrix.shape[1])
            self._places = columns, np.searchsorted(rows, np.arange(matrix.shape[0] + 1))
        return self._made((flat[self._source], *self._places), shape=matrix.shape)


class SparseStages:
    r"""What `StageTerms` computes for a stage, where [r, -G] and W are sparse."""

    __slots__ = ("_linear", "_states", "_weight")

    def __init__(self, n: int) -> None:
        self._states, self._linear, self._weight = n, _Sparse(), _Sparse()

    @classmethod
    def of(cls, n: int) -> SparseStages | None:
        """Of so many states; None where they are too few."""
        return cls(n) if n >= _LEAST_STATES else None

    def set_stage(
        self, linear: Array, weight: Array, panel: Array, gradient: Array, next_gradient: Array
    ) -> float | None:
        """See `StageTerms.set_stage`; None, and nothing set, where one of them is not sparse."""
        n = self._states
        slopes, weights = self._linear.of(linear), self._weight.of(weight)
        if slopes is None or weights is None:
            return None
        residual = linear[:, 0]
        slopes = slopes[:, 1:]
        weighted_residual, weighted = weights @ residual, (weights @ slopes).tocoo()
        square = (slopes.T @ weighted.tocsr()).tocoo()
        panel.fill(0.0)
        row, column = square.row, square.col
        lower = row >= column
        panel[column[lower], (row - column)[lower]] = square.data[lower]
        row, column = weighted.row, weighted.col
        own = row < n
        panel[column[own], (n + row - column)[own]] = weighted.data[own]
        gradient[...] = slopes.T @ weighted_residual
        next_gradient[...] = weighted_residual[:n]
        # 0 times anything that is not finite is NaN.
        with np.errstate(all="ignore"):
            zero = 0.0 * (
                slopes.data.sum() + weighted.data.sum() + square.data.sum()
                + weighted_residual.sum()
            )
            return float(residual @ weighted_residual + zero)
