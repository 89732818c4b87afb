"""Another order of a band's unknowns, for H of models whose derivatives are sparse."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .qp import QP, Array
from .sparse_qp import Order, SparseQP, narrow, order_of, places_of_states

Index = NDArray[np.intp]

#: Below so many unknowns a stage, the order by stages is factorised faster than zeros are counted.
LEAST = 40
# A pattern that has grown so often is not searched for again.
_MOST_GROWTHS = 8


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
        self._known: Order | None = None  # of the last QP whose band may have any entry
        self._order: Order | None = None
        self._band = self._side = np.empty(0)

    def band(self, qp: QP, unit: float) -> tuple[Array, Array] | None:
        """``unit`` H as LAPACK's lower band and -``unit`` g in this order; None if of no use."""
        flat = qp.band.reshape(-1)
        order = qp.order if isinstance(qp, SparseQP) else self._found(qp, flat)
        if order is None:
            return None
        if self._order is not order or self._side.size != qp.size:
            self._order = order
            self._band, self._side = np.empty((qp.size, order.width + 1)), np.empty(qp.size)
        side = self._side
        np.multiply(qp.gradient.reshape(-1)[order.unknowns], -unit, out=side)
        return order.band(flat, unit, self._band), side

    def step(self, solution: Array) -> Array:
        """A solution in this order as increments d, by stages."""
        order = self._order
        assert order is not None
        step = np.empty(solution.size)
        step[order.unknowns] = solution
        return step

    def _found(self, qp: QP, flat: Array) -> Order | None:
        """The order of a QP whose band may have any entry."""
        if self._sizes != qp.sizes:
            self._sizes, self._growths, self._known = qp.sizes, 0, None
        order = self._known
        if order is None and self._growths:
            return None
        if order is None or np.count_nonzero(flat[order.source]) != np.count_nonzero(flat):
            order = self._grown(qp, flat)
        return order

    def _grown(self, qp: QP, flat: Array) -> Order | None:
        """The order of what was in the pattern before or is not zero now."""
        there = flat != 0.0
        if self._known is not None:
            there[self._known.source] = True
        self._growths, self._known = self._growths + 1, None
        source = np.flatnonzero(there)
        if self._growths <= _MOST_GROWTHS and source.size <= narrow(qp.n) * qp.size:
            column, offset = np.divmod(source, 2 * qp.n)
            row = column + offset
            if source.size and row.max() < qp.size:  # else what is no entry of H
                place = places_of_states(qp.n, row % qp.n, column % qp.n)
                found = order_of(qp.stages, place, row, column, source)
                self._known = found if found.width < narrow(qp.n) else None
        return self._known
