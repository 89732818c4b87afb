"""A stage's terms where whole matrices turn out to have few entries, of models without a trace."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .entries import Entries, StageProducts, StageWeights, has_enough_states, is_sparse

Array = NDArray[np.float64]

# A pattern that has grown so often is not searched for again.
_MOST_GROWTHS = 8


class SparseStages:
    """What `StageTerms` computes for a stage, by the entries of [r, -G] and W that are not 0.

    The pattern is kept from stage to stage, and grows where an entry outside of it is not 0.
    """

    __slots__ = ("_growths", "_products", "_states", "_there")

    def __init__(self, n: int) -> None:
        self._states, self._growths = n, 0
        self._products: StageProducts | None = None
        self._there: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None

    @classmethod
    def of(cls, n: int) -> SparseStages | None:
        """Of so many states; None where they are too few."""
        return cls(n) if has_enough_states(n) else None

    def set_stage(
        self, linear: Array, weight: Array, panel: Array, gradient: Array, next_gradient: Array
    ) -> float | None:
        """See `StageTerms.set_stage`; None, and nothing set, where one of them is not sparse."""
        residual, slopes, n = linear[:, 0], linear[:, 1:], self._states
        count = int(np.count_nonzero(linear) - np.count_nonzero(residual))
        weighed = int(np.count_nonzero(weight))
        if not (is_sparse(count, slopes.shape) and is_sparse(weighed, weight.shape)):
            return None
        for _ in range(2):
            known = self._products
            if known is not None:
                of_g, of_w = known.slopes, known.weights.entries
                entries, weights = slopes[of_g.rows, of_g.columns], weight[of_w.rows, of_w.columns]
                found = np.count_nonzero(entries), np.count_nonzero(weights)
                if found[0] == count and found[1] == weighed:
                    break
            self._grow(slopes, weight)
        else:
            return None
        values = np.empty(known.pattern.places.size)
        cost = known.compute(residual, entries, weights, values, gradient, next_gradient)
        panel.fill(0.0)
        panel.reshape(2 * n * n)[known.pattern.places] = values
        return float(cost)

    def _grow(self, slopes: Array, weight: Array) -> None:
        """Find the pattern of what was in it before or is not zero now."""
        n, self._products = self._states, None
        self._growths += 1
        if self._growths > _MOST_GROWTHS:
            return
        there, weighed = slopes != 0.0, weight != 0.0
        if self._there is not None:
            there |= self._there[0]
            weighed |= self._there[1]
        there[:n].reshape(-1)[:: n + 1] = True
        self._there = there, weighed
        rows, columns = np.nonzero(there)
        entries = Entries(rows, columns, len(there))
        weights = StageWeights(weighed[:n, :n], weighed[n:, n:])
        if StageProducts.work(entries, weights) <= there.size:
            self._products = StageProducts(n, entries, weights, np.empty((0, 0)))
