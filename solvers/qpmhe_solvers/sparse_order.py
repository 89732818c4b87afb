"""Another order of a band's unknowns, for H of models whose derivatives are sparse."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .qp import QP, Array

Index = NDArray[np.intp]

# Below so many unknowns a stage, the order by stages is factorised faster than zeros are counted.
_LEAST = 40
# By how much the factorisation must have less work than in the order by stages.
_GAIN = 0.5
# A pattern that has grown so often is not searched for again.
_MOST_GROWTHS = 8


class _Order(NamedTuple):
    """Where H's entries stand when its unknowns are ordered state by state."""

    unknowns: Index
    source: Index
    target: Index
    width: int


class SparseOrder:
    r"""H as a narrower band, with all stages of one state beside each other.

    In the order by stages, the band of H is 2 n wide, however sparse its blocks are. This class
    takes the union of the blocks' patterns as a graph of the n states, and numbers the states by
    the reverse Cuthill-McKee method [1]_, which gives the graph a small bandwidth b. The K unknowns
    of one state, one of each stage, then stand beside each other, and the band of H is about
    (b + 1) K wide. The work of a factorisation falls from :math:`K n (2 n)^2` to
    :math:`K n ((b + 1) K)^2`.

    The order is kept from QP to QP. It is made anew where an entry outside of its pattern is not 0.

    References
    ----------
    .. [1] E. Cuthill, J. McKee, "Reducing the bandwidth of sparse symmetric matrices", Proc. 24th
       National Conference of the ACM (1969).
    """

    def __init__(self) -> None:
        self._sizes, self._growths = (0, 0, 0), 0
        self._order: _Order | None = None
        self._band = self._side = np.empty(0)

    def band(self, qp: QP, unit: float) -> tuple[Array, Array] | None:
        """``unit`` H as LAPACK's lower band and -``unit`` g in this order; None if of no use."""
        if qp.n < _LEAST:
            return None
        if self._sizes != qp.sizes:
            self._sizes, self._growths, self._order = qp.sizes, 0, None
        flat = qp.band.reshape(-1)
        order = self._order
        if order is None and self._growths:
            return None
        count = np.count_nonzero(flat)
        if order is None or np.count_nonzero(flat[order.source]) != count:
            order = self._grown(qp, flat)
            if order is None:
                return None
        band, side = self._band, self._side
        band.fill(0.0)
        band.reshape(-1)[order.target] = flat[order.source] * unit
        np.multiply(qp.gradient.reshape(-1)[order.unknowns], -unit, out=side)
        return band.T, side

    def step(self, solution: Array) -> Array:
        """A solution in this order as increments d, by stages."""
        order = self._order
        assert order is not None
        step = np.empty(solution.size)
        step[order.unknowns] = solution
        return step

    def _grown(self, qp: QP, flat: Array) -> _Order | None:
        """The order of what was in the pattern before or is not zero now."""
        there = flat != 0.0
        if self._order is not None:
            there[self._order.source] = True
        self._growths += 1
        order = _order(qp, np.flatnonzero(there)) if self._growths <= _MOST_GROWTHS else None
        self._order = order
        if order is not None:
            self._band, self._side = np.empty((qp.size, order.width + 1)), np.empty(qp.size)
        return order


def _order(qp: QP, source: Index) -> _Order | None:
    """The order of a pattern, or None if the order by stages is about as good."""
    stages, n = qp.stages, qp.n
    column, offset = np.divmod(source, 2 * n)
    row = column + offset
    limit = math.sqrt(_GAIN) * 2 * n
    if not 0 < source.size <= limit * qp.size or row.max() >= qp.size:  # the last: no entry of H
        return None
    from scipy.sparse import csr_matrix  # late: as LAPACK
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    i, j = row % n, column % n
    graph = csr_matrix((np.ones(2 * i.size), (np.append(i, j), np.append(j, i))), (n, n))
    states = reverse_cuthill_mckee(graph, symmetric_mode=True)
    place = np.empty(n, np.intp)
    place[states] = np.arange(n)
    at = (place * stages + np.arange(stages)[:, None]).ravel()
    row, column = at[row], at[column]
    low, high = np.minimum(row, column), np.maximum(row, column)
    width = int((high - low).max())
    if width + 1 > limit:
        return None
    return _Order(np.argsort(at), source, low * (width + 1) + high - low, width)
