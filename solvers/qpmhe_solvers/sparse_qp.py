"""A QP without inequalities whose H is held by the entries that may be other than 0."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .qp import QP, Array

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

Index = NDArray[np.intp]

# By how much the factorisation must have less work than in the order by stages.
_GAIN = 0.5


class Order(NamedTuple):
    """Where H's entries stand when its unknowns are ordered state by state.

    Attributes
    ----------
    unknowns : (K n,) array
        Numbers by stages of the unknowns in this order.
    source, target : array
        Places of H's entries in what holds them, and in LAPACK's lower band.
    width : int
        Entries below the diagonal.
    """

    unknowns: Index
    source: Index
    target: Index
    width: int

    def band(self, flat: Array, unit: float, out: Array | None = None) -> Array:
        """``unit`` H as LAPACK's lower band, from the flat array that holds its entries."""
        if out is None:
            out = np.empty((self.unknowns.size, self.width + 1))
        out.fill(0.0)
        out.reshape(-1)[self.target] = flat[self.source] * unit
        return out.T


class Pattern:
    """Which entries of a stage's band panel (n, 2n) may be other than 0: the diagonal and others.

    Parameters
    ----------
    n : int
        Unknowns a stage.
    places : array
        Places of these entries in the flat panel.

    Attributes
    ----------
    places : (e,) array
        These places, those of the diagonal first.
    columns, rows : (e,) array
        The entries' columns, and their rows, which are from n on those of the next stage.
    """

    def __init__(self, n: int, places: Index) -> None:
        self.n, others = n, np.unique(places)
        self.places: Index = np.append(2 * n * np.arange(n), others[others % (2 * n) != 0])
        self.columns, offsets = np.divmod(self.places, 2 * n)
        self.rows: Index = self.columns + offsets

    def index(self, places: Index) -> Index:
        """Where these places of the panel stand among the entries."""
        order = np.argsort(self.places)
        return np.asarray(order[np.searchsorted(self.places, places, sorter=order)])

    def of(self, columns: Array) -> Array:
        """The entries (..., e) of columns (..., 2n, n), or of diagonal blocks (..., n, n)."""
        there = self.rows < columns.shape[-2]
        found = np.zeros((*columns.shape[:-2], self.places.size))
        found[..., there] = columns[..., self.rows[there], self.columns[there]]
        return found

    def order(self, stages: int) -> Order | None:
        """The order of the unknowns of so many stages; None if the one by stages is as good."""
        found = self.order_by_states(stages)
        return found if found.width < narrow(self.n) else None

    def order_by_states(self, stages: int) -> Order:
        """The order of the unknowns of so many stages."""
        source = np.arange(stages * self.places.size)
        stage, entry = np.divmod(source, self.places.size)
        row, column = (stage * self.n + one[entry] for one in (self.rows, self.columns))
        there = row < stages * self.n
        return order_of(stages, self._place, row[there], column[there], source[there])

    @cached_property
    def _place(self) -> Index:
        return places_of_states(self.n, self.rows % self.n, self.columns)


class SparseQP(QP):
    """A `QP` without inequalities, in memory that grows as the entries of H that may not be 0.

    Parameters
    ----------
    stages : int
        Number K of stages.
    pattern : Pattern
        Which entries of each stage's panel may be other than 0.
    order : Order
        The order of the pattern for this number of stages.

    Attributes
    ----------
    band : (K, e) array
        The entries of the panels of `QP.band`, those of the diagonal first.
    """

    __slots__ = ("order", "pattern")

    def __init__(self, stages: int, pattern: Pattern, order: Order) -> None:
        n = pattern.n
        self.stages, self.n, self.rows, self.size = stages, n, 0, stages * n
        self.sizes, self.bounded, self.key = (stages, n, 0), False, 0
        self.pattern, self.order = pattern, order
        self.band = np.zeros((stages, pattern.places.size))
        self.gradient = np.zeros((stages, n))

    def copy(self) -> SparseQP:
        """A copy of the problem that shares no array."""
        other = SparseQP(self.stages, self.pattern, self.order)
        other.band, other.gradient = self.band, self.gradient
        return other

    def __reduce__(self) -> tuple[Any, ...]:
        return self.full().__reduce__()

    def full(self) -> QP:
        """The same problem with all entries."""
        qp = QP(self.stages, self.n)
        qp.band.reshape(self.stages, -1)[:, self.pattern.places] = self.band
        qp.gradient, qp.bounded = self.gradient, False
        return qp

    @property
    def diagonal(self) -> Array:
        """The diagonal of H (K, n), a view."""
        return self.band[:, : self.n]

    @property
    def lapack_band(self) -> Array:
        """The lower band of H in LAPACK's layout, in the pattern's order: a copy."""
        return self.order.band(self.band.reshape(-1), 1.0)

    def csc(self) -> csc_matrix:
        """See `QP.csc`."""
        return self.full().csc()

    def hessian_times(self, d: Array) -> Array:
        """H d, (K, n), of increments ``d`` (K, n)."""
        n, size = self.n, self.size + self.n
        stage = n * np.arange(self.stages)[:, None]
        below, beside = ((stage + one).ravel() for one in (self.pattern.rows, self.pattern.columns))
        flat, ahead = self.band.ravel(), np.append(d.ravel(), np.zeros(n))
        found = np.bincount(below, flat * ahead[beside], size)
        found += np.bincount(beside, np.where(below > beside, flat * ahead[below], 0.0), size)
        return np.asarray(found[: self.size].reshape(self.stages, n))


def narrow(n: int) -> float:
    """The entries a column with which a factorisation has enough less work."""
    return math.sqrt(_GAIN) * 2 * n


def order_of(stages: int, place: Index, row: Index, column: Index, source: Index) -> Order:
    """The order of entries of H, with the states in these places (n,)."""
    at = (place * stages + np.arange(stages)[:, None]).ravel()
    row, column = at[row], at[column]
    low, high = np.minimum(row, column), np.maximum(row, column)
    width = int((high - low).max())
    return Order(np.argsort(at), source, low * (width + 1) + high - low, width)


def places_of_states(n: int, i: Index, j: Index) -> Index:
    """The places (n,) of states in the reverse Cuthill-McKee order of a graph."""
    from scipy.sparse import csr_matrix  # late: as LAPACK
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    graph = csr_matrix((np.ones(2 * i.size), (np.append(i, j), np.append(j, i))), (n, n))
    place = np.empty(n, np.intp)
    place[reverse_cuthill_mckee(graph, symmetric_mode=True)] = np.arange(n)
    return place
