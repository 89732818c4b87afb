"""The convex QP over a trajectory of stages, stored once and read in three shapes."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import ShapeError

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

Array = NDArray[np.float64]
Entries = tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]

#: Names of the arrays that hold a QP's numbers.
ARRAYS = ("band", "gradient", "lower", "upper", "row_own", "row_next", "row_lower", "row_upper")


@lru_cache(maxsize=256)
def band_index(n: int) -> NDArray[np.intp]:
    """Where each entry of a stage's band panel stands in its stacked column blocks.

    The Hessian's columns of stage k hold, on and below the diagonal, the block
    ``[D; E]`` of shape (2n, n) (its own block and the one that couples to stage k+1).
    ``panel[c, o] = [D; E][c + o, c]`` for ``c + o < 2n`` and 0 beyond. The index points
    into the flat block followed by one zero, so that one ``take`` fills a panel (n, 2n).
    """
    column, offset = np.meshgrid(np.arange(n), np.arange(2 * n), indexing="ij")
    row = column + offset
    index: NDArray[np.intp] = np.where(row < 2 * n, row * n + column, 2 * n * n)
    return index


def band_of(columns: Array) -> Array:
    """The band panels (..., n, 2n) of stages: of their columns (..., 2n, n), or diagonal blocks."""
    *stages, height, n = columns.shape
    flat = np.zeros((*stages, 2 * n * n + 1))
    flat[..., : height * n] = columns.reshape(*stages, height * n)
    panel: Array = flat[..., band_index(n)]
    return panel


def hessian_entries(stages: int, n: int) -> Entries:
    """All of H: places of its numbers in the flat band panels, rows, and columns."""
    k, c, o = np.indices((stages, n, 2 * n))
    column = k * n + c
    row = column + o
    source = np.flatnonzero((c + o < 2 * n) & (row < stages * n))
    row, column = row.ravel()[source], column.ravel()[source]
    below = row > column
    return (
        np.append(source, source[below]), np.append(row, column[below]),
        np.append(column, row[below]),
    )


def rows_entries(stages: int, n: int, rows: int) -> Entries:
    """All of [F, G]: places in the flat own rows, then the next rows; rows, and columns."""
    k, j, c = np.indices((stages, rows, n)).reshape(3, -1)
    row, column = k * rows + j, k * n + c
    source = np.arange(2 * row.size)
    next_too = np.append(np.ones(row.size, np.bool_), k + 1 < stages)
    return (
        source[next_too], np.append(row, row)[next_too], np.append(column, column + n)[next_too]
    )


@lru_cache(maxsize=256)
def hessian_pattern(stages: int, n: int) -> csc_matrix:
    """H in full; its entries are the places of its numbers."""
    return _csc(hessian_entries(stages, n), (stages * n, stages * n))


@lru_cache(maxsize=256)
def rows_pattern(stages: int, n: int, rows: int) -> csc_matrix:
    """The general rows [F, G]; entries are the places of their numbers."""
    return _csc(rows_entries(stages, n, rows), (stages * rows, stages * n))


def _csc(entries: Entries, shape: tuple[int, int]) -> csc_matrix:
    source, row, column = entries
    from scipy.sparse import csc_matrix  # late: the banded solver does without

    matrix = csc_matrix((source, (row, column)), shape)
    matrix.sort_indices()
    return matrix


def as_csc(pattern: csc_matrix, values: Array) -> csc_matrix:
    """A matrix of these values with new indices: solvers may sort or scale in place."""
    matrix = pattern.astype(np.float64)
    matrix.data = values  # afterwards: of a view into a larger array scipy may make a copy
    return matrix


class Places(NamedTuple):
    """Where the parts of `QP.numbers` start: after the band, and the next rows after the own."""

    gradient: int
    own: int
    one: int
    lower: int
    upper: int
    end: int

    @staticmethod
    def of(stages: int, n: int, rows: int) -> Places:
        """The places in a QP of these sizes."""
        limits = stages * (n + rows)
        sizes = (2 * stages * n * n, stages * n, 2 * stages * rows * n, 1, limits, limits)
        return Places(*np.cumsum(sizes).tolist())


class QP:
    r"""A convex QP in the increments :math:`d_0, \dots, d_{K-1}` of a trajectory.

    .. math::
        \min_d \tfrac12 d^\top H d + g^\top d \quad \text{s.t.} \quad
        \ell_k \le d_k \le u_k, \quad
        a_k \le F_k d_k + G_k d_{k+1} \le b_k

    H is symmetric, block-tridiagonal and positive definite. The lower triangle is held in
    stage-wise band panels (see `band_index`), which LAPACK reads in place; the CSC and dense views
    are made from these same numbers. Assigning to an array attribute writes into the array.

    Parameters
    ----------
    stages : int
        Number K of stages, at least 1.
    n : int
        Unknowns per stage, at least 1.
    rows : int
        General rows per stage; 0 for none. Unused rows keep infinite bounds.

    Attributes
    ----------
    band : (K, n, 2n) array
        Lower band of H: ``band[k, c, o] = H[k n + c + o, k n + c]``.
    gradient : (K, n) array
        g.
    lower, upper : (K, n) array
        Bounds on d, infinite where there are none.
    row_own, row_next : (K, rows, n) array
        F and G; the last stage's G is never read.
    row_lower, row_upper : (K, rows) array
        a and b; equal entries make an equality row.
    bounded : bool
        Whether bounds are read, True in a new QP. False promises that no entry of ``lower`` and
        ``upper`` is finite, and saves time; if the promise is broken, some backends ignore the
        bounds.

    Raises
    ------
    ShapeError
        If a size is not a positive integer.
    """

    # All arrays are views of ``numbers``: the band panels, the gradient, the own rows, the next
    # rows, a 1, and the limits of all constraints, first all lower, then all upper; bounds come
    # before rows. ``key`` names the scale that they are in.
    __slots__ = (
        *ARRAYS, "all_lower", "all_upper", "bounded", "key", "limits", "n", "numbers", "rows",
        "size", "sizes", "stages",
    )

    def __init__(self, stages: int, n: int, rows: int = 0) -> None:
        for name, value, least in (("stages", stages, 1), ("n", n, 1), ("rows", rows, 0)):
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
                raise ShapeError(f"{name} is {value!r}; a QP needs an integer {name} >= {least}.")
        self.stages, self.n, self.rows, self.size = stages, n, rows, stages * n
        self.sizes, self.bounded, self.key = (stages, n, rows), True, 0
        places = Places.of(stages, n, rows)
        numbers = self.numbers = np.zeros(places.end)
        numbers[places.one] = 1.0
        self.band = numbers[: places.gradient].reshape(stages, n, 2 * n)
        self.gradient = numbers[places.gradient : places.own].reshape(stages, n)
        self.row_own, self.row_next = numbers[places.own : places.one].reshape(2, stages, rows, n)
        self.limits = numbers[places.lower :]
        self.all_lower, self.all_upper = self.limits.reshape(2, -1)
        self.all_lower[...], self.all_upper[...] = -np.inf, np.inf
        self.lower, self.row_lower = _divided(self.all_lower, stages, n, rows)
        self.upper, self.row_upper = _divided(self.all_upper, stages, n, rows)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ARRAYS and hasattr(self, name):
            getattr(self, name)[...] = value
        else:
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        # Copied views would be arrays of their own.
        return _remade, (self.sizes, self.numbers, self.bounded, self.key)

    def copy(self) -> QP:
        """A copy of the problem that shares no array."""
        return _remade(self.sizes, self.numbers, self.bounded, self.key)

    @property
    def diagonal(self) -> Array:
        """The diagonal of H (K, n), a view."""
        return self.band[:, :, 0]

    @property
    def lapack_band(self) -> Array:
        """The (2n, K n) lower band in LAPACK's layout, a view without a copy."""
        return self.band.reshape(self.size, 2 * self.n).T

    def dense(self) -> Array:
        """H as a full symmetric (K n, K n) array."""
        return self.csc().toarray()

    def csc(self) -> csc_matrix:
        """H as a full symmetric CSC matrix with new, sorted indices."""
        pattern = hessian_pattern(self.stages, self.n)
        return as_csc(pattern, self.band.ravel()[pattern.data])

    def dense_rows(self) -> Array:
        """The general rows [F, G] as a (K rows, K n) array."""
        return self.csc_rows().toarray()

    def csc_rows(self) -> csc_matrix:
        """The general rows [F, G] as a (K rows, K n) CSC matrix with sorted indices."""
        pattern = rows_pattern(self.stages, self.n, self.rows)
        numbers = np.concatenate((self.row_own, self.row_next), axis=None)
        return as_csc(pattern, numbers[pattern.data])

    def hessian_times(self, d: Array) -> Array:
        """H d, (K, n), of increments ``d`` (K, n)."""
        from scipy.linalg.blas import dsbmv

        product: Array = dsbmv(
            2 * self.n - 1, 1.0, self.lapack_band, np.ravel(d), lower=1
        )
        return product.reshape(self.stages, self.n)

    def rows_times(self, d: Array) -> Array:
        """F_k d_k + G_k d_{k+1}, (K, rows), of increments ``d`` (K, n)."""
        value: Array = np.matmul(self.row_own, d[:, :, None])[:, :, 0]
        value[:-1] += np.matmul(self.row_next[:-1], d[1:, :, None])[:, :, 0]
        return value

    def rows_transposed_times(self, y: Array) -> Array:
        """The adjoint of `rows_times`, (K, n), of multipliers ``y`` (K, rows)."""
        value: Array = np.matmul(y[:, None, :], self.row_own)[:, 0]
        value[1:] += np.matmul(y[:-1, None, :], self.row_next[:-1])[:, 0]
        return value

    def objective(self, d: Array) -> float:
        """The value of the objective at increments ``d`` (K, n)."""
        return float(np.vdot(d, 0.5 * self.hessian_times(d) + self.gradient))

    def violation(self, d: Array) -> float:
        """The largest violation of a bound or a row by increments ``d`` (K, n)."""
        value = np.concatenate((d, self.rows_times(d)), axis=None) if self.rows else d.reshape(-1)
        worst = float(np.maximum(self.all_lower - value, value - self.all_upper).max())
        # Comparisons with NaN are false: a NaN among the numbers must not pass as feasible.
        return math.inf if math.isnan(worst) else max(worst, 0.0)

    def finite(self) -> bool:
        """Whether H, g and the rows are free of NaN and infinities, and no bound is NaN."""
        data = self.numbers[: self.numbers.size - self.limits.size]
        return bool(np.isfinite(data).all()) and not np.isnan(self.limits).any()

    def fault(self) -> str:
        """Why the QP must not reach a solver: some hang on NaN, others return it as success."""
        data = self.numbers[: self.numbers.size - self.limits.size]
        # Squares may overflow where the numbers do not: then each one is looked at.
        finite = math.isfinite(data.dot(data)) or np.isfinite(data).all()
        ordered = np.logical_and.reduce(self.all_lower <= self.all_upper)
        if finite and ordered:
            return ""
        if not finite or np.isnan(self.limits).any():
            return "the QP's data are not finite"
        return "the QP is infeasible: a lower bound is above its upper bound"


def _divided(limits: Array, stages: int, n: int, rows: int) -> tuple[Array, Array]:
    """Limits of the bounds (K, n), and of the rows (K, rows)."""
    size = stages * n
    return limits[:size].reshape(stages, n), limits[size:].reshape(stages, rows)


def _remade(sizes: tuple[int, int, int], numbers: Array, bounded: bool, key: int) -> QP:
    qp = QP(*sizes)
    qp.numbers[...] = numbers
    qp.bounded, qp.key = bounded, key
    return qp
