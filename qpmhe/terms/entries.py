"""A stage's matrices by the entries that may be other than 0, and sums of their products."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.sparse_qp import Pattern

from ..costs.base import reduced
from .selected_inverse import SelectedInverse

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


# Below so many states, and above this share of entries, BLAS multiplies whole matrices faster.
_LEAST_STATES = 80
_MOST_FILLED = 0.05


def has_enough_states(n: int) -> bool:
    """Whether entries of matrices of so many states may be fewer than is worth it."""
    return n >= _LEAST_STATES


def is_sparse(count: int, shape: tuple[int, ...]) -> bool:
    """Whether so many entries of a matrix are few."""
    return count <= _MOST_FILLED * math.prod(shape)


class GroupedSums:
    """Sums of products of entries of two arrays; each product belongs to the sum of a key.

    Attributes
    ----------
    keys : array
        The keys, sorted: one for each sum.
    """

    def __init__(self, left: Index, right: Index, keys: Index) -> None:
        order = np.argsort(keys, kind="stable")
        self._left, self._right, keys = left[order], right[order], keys[order]
        starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
        self.keys: Index = keys[starts]
        self._starts = None if starts.size == keys.size else starts

    def __call__(self, one: Array, other: Array) -> Array:
        """The sums (..., keys) for entries (..., left) and (..., right)."""
        products: Array = one.take(self._left, -1) * other.take(self._right, -1)
        if self._starts is None:
            return products
        return np.asarray(np.add.reduceat(products, self._starts, -1))


class Entries:
    """Entries of a matrix, by rows.

    Attributes
    ----------
    rows, columns : (e,) array
        Where they are.
    """

    def __init__(self, rows: Index, columns: Index, height: int) -> None:
        order = np.lexsort((columns, rows))
        self.rows, self.columns = rows[order], columns[order]
        #: Where each row begins, and the last one ends.
        self.starts: Index = np.searchsorted(self.rows, np.arange(height + 1))

    @property
    def size(self) -> int:
        """How many there are."""
        return self.rows.size

    def of_rows(self, rows: Index) -> tuple[Index, Index]:
        """All entries of these rows: which of the rows, and which entry."""
        first, counts = self.starts[rows], np.diff(self.starts)[rows]
        which = np.repeat(np.arange(rows.size), counts)
        ends = np.cumsum(counts)
        return which, np.arange(which.size) + np.repeat(first - ends + counts, counts)


class StageWeights:
    """The entries of the weights of (w, v): of every window, whatever outputs are missing.

    Without some outputs, those that share entries of the noise's weight with them, by any number of
    steps, weigh each other: these are blocks.

    Parameters
    ----------
    disturbance, noise : array
        Weights (n, n) and (p, p) whose patterns are meant.
    """

    def __init__(self, disturbance: Array, noise: Array) -> None:
        from scipy.sparse import csr_array  # late: few models need it
        from scipy.sparse.csgraph import connected_components

        n, p = len(disturbance), len(noise)
        count, labels = connected_components(csr_array(noise), directed=False)
        block = labels.astype(np.intp)
        members = Entries(block, np.arange(p), count)
        which, other = members.of_rows(block)
        rows, columns = np.nonzero(disturbance)
        eye = np.arange(n)
        rows, columns = np.divmod(
            np.union1d(rows * n + columns, eye * n + eye), n
        )
        self.entries = Entries(
            np.append(rows, n + which), np.append(columns, n + members.columns[other]), n + p
        )
        self.n, self._of_w = n, rows.size
        #: Places of the diagonal.
        self.diagonal: Index = np.flatnonzero(self.entries.rows == self.entries.columns)
        #: Whether there is nothing else.
        self.is_diagonal: bool = self.entries.size == n + p
        sizes = np.diff(members.starts)
        self._alone = sizes[block] == 1
        self._blocks = [
            members.columns[members.starts[k] : members.starts[k + 1]]
            for k in np.flatnonzero(sizes > 1)
        ]
        self._places = [
            self.entries.of_rows(n + one)[1] for one in self._blocks
        ]
        self._times = GroupedSums(
            np.arange(self.entries.size), self.entries.columns, self.entries.rows
        )

    def of(self, disturbance: Array, noise: Array) -> Array:
        """The entries of the weights (n, n) and (p, p)."""
        rows, columns, first = self.entries.rows, self.entries.columns, self._of_w
        return np.append(
            disturbance[rows[:first], columns[:first]],
            noise[rows[first:] - self.n, columns[first:] - self.n],
        )

    def partial(self, disturbance: Array, noise: Array, observed: Mask) -> Array:
        """The same where only some outputs are observed; see `Cost.partial_weight`."""
        found = self.of(disturbance, noise)
        alone = np.flatnonzero(self._alone & ~observed)
        found[self.entries.starts[self.n + alone]] = 0.0
        for block, places in zip(self._blocks, self._places, strict=True):
            if not observed[block].all():
                found[places] = reduced(noise[np.ix_(block, block)], observed[block]).ravel()
        return found

    def fit(self, disturbance: Array | None, noise: Array | None) -> bool:
        """Whether these weights, where they are given, have no entry outside of the pattern."""
        first = self._of_w
        for one, part, start in (
            (disturbance, slice(first), 0), (noise, slice(first, None), self.n)
        ):
            if one is not None:
                rows, columns = self.entries.rows[part] - start, self.entries.columns[part] - start
                if np.count_nonzero(one[rows, columns]) != np.count_nonzero(one):
                    return False
        return True

    def spread(self, weights: Array) -> Callable[[int, Array], Array]:
        """Of a stage and a force (n,) to the solution of Q w = force there."""
        n, first = self.n, self._of_w
        if first == n:  # Q is diagonal
            with np.errstate(all="ignore"):
                inverse = np.atleast_2d(1.0 / weights[..., :n])
            return lambda i, force: np.asarray(inverse[min(i, len(inverse) - 1)] * force)
        from scipy.sparse import csc_array
        from scipy.sparse.linalg import splu

        rows, columns = self.entries.rows[:first], self.entries.columns[:first]
        matrices = [
            csc_array((one[:first], (rows, columns)), (n, n)) for one in np.atleast_2d(weights)
        ]
        try:
            factors = [splu(one) for one in matrices]
        except RuntimeError:  # one is singular
            return lambda _, force: np.full_like(force, np.nan)
        return lambda i, force: np.asarray(factors[min(i, len(factors) - 1)].solve(force))

    def times(self, residuals: Array, weights: Array) -> Array:
        """W r of residuals (..., q)."""
        return weights * residuals if self.is_diagonal else self._times(weights, residuals)


class StageProducts:
    r"""What `StageTerms` computes, of the entries of -G and of W.

    Parameters
    ----------
    n : int
        Number of states.
    slopes : Entries
        Those of G.
    weights : StageWeights
        The weights.
    prior : array
        The prior's weight (n, n): the panels have its entries, too.
    """

    def __init__(self, n: int, slopes: Entries, weights: StageWeights, prior: Array) -> None:
        self.slopes, self.weights = slopes, weights
        of, rows = weights.entries, slopes.rows
        left, right = slopes.of_rows(of.columns)
        self._weighted = GroupedSums(left, right, of.rows[left] * n + slopes.columns[right])
        row, column = np.divmod(self._weighted.keys, n)
        weighted = Entries(row, column, slopes.starts.size - 1)
        left, right = weighted.of_rows(rows)
        below = slopes.columns[left] >= column[right]
        left, right = left[below], right[below]
        self._square = GroupedSums(
            left, right, column[right] * (2 * n - 1) + slopes.columns[left]
        )
        self._rows, by_column = rows, np.argsort(slopes.columns, kind="stable")
        self._gradient = GroupedSums(by_column, rows[by_column], slopes.columns[by_column])
        # The block that couples to the next stage is -Q A, the upper part of -W G.
        own = row < n
        coupling = column[own] * 2 * n + n + row[own] - column[own]
        squares = self._square.keys
        of_w = of.rows < n
        low = of_w & (of.rows >= of.columns)
        prior_rows, prior_columns = np.nonzero(prior)
        prior_rows, prior_columns = (
            one[prior_rows >= prior_columns] for one in (prior_rows, prior_columns)
        )
        self.pattern = pattern = Pattern(n, np.concatenate((
            squares, coupling, of.columns[low] * (2 * n - 1) + of.rows[low],
            prior_columns * (2 * n - 1) + prior_rows,
        )))
        # Places of a panel's entries among [-G' W (-G), -W G, 0].
        self._panel: Index = np.full(pattern.places.size, squares.size + row.size)
        self._panel[pattern.index(squares)] = np.arange(squares.size)
        self._panel[pattern.index(coupling)] = squares.size + np.flatnonzero(own)
        self._low, self._low_places = np.flatnonzero(low), pattern.index(
            of.columns[low] * (2 * n - 1) + of.rows[low]
        )
        self.n, of_a = n, np.arange(slopes.starts[n])
        self._forwards = GroupedSums(of_a, slopes.columns[of_a], rows[of_a])
        self._backwards = GroupedSums(of_a, rows[of_a], slopes.columns[of_a])

    @staticmethod
    def work(slopes: Entries, weights: StageWeights) -> int:
        """A bound of how many products there are."""
        counts, of = np.diff(slopes.starts), weights.entries
        weighted = np.bincount(of.rows, counts[of.columns])
        return int(weighted.sum() + (weighted * counts).sum())

    def disturbance_band(self, weights: Array) -> Array:
        """The panels (..., e) of the weights of w among those of (w, v)."""
        found = np.zeros((*weights.shape[:-1], self.pattern.places.size))
        found[..., self._low_places] = weights[..., self._low]
        return found

    def times_minus_a(self, slopes: Array, states: Array) -> Array:
        """-A x of states (..., n), for entries of -G."""
        return self._forwards(slopes, states)

    def minus_a_transposed(self, slopes: Array, forces: Array) -> Array:
        """-A' f of forces (..., n), for entries of -G."""
        return self._backwards(slopes, forces)

    def damping(self, slopes: Array, weights: Array) -> Array:
        """The panels (K + 1, e) of the sum of |d(i+1) - A d(i)|^2 in the weights of w."""
        slopes = slopes.copy()
        slopes[:, self.slopes.starts[self.n] :] = 0.0
        return self._hessian(slopes, weights)

    def _hessian(self, slopes: Array, weights: Array) -> Array:
        """The panels (K + 1, e) of all stages."""
        count, n, q = len(slopes), self.n, self.slopes.starts.size - 1
        panels = np.zeros((count + 1, self.pattern.places.size))
        unused = np.empty((2, count, n))
        self.compute(np.zeros((count, q)), slopes, weights, panels[:-1], *unused)
        panels[1:] += self.disturbance_band(weights)
        return panels

    def information(self, slopes: Array, weights: Array) -> Array:
        """The diagonal (n,) of what the data of K stages say about the first state.

        With H the Hessian of J without terms in the first state, it is that of
        :math:`H_{00} - H_{01} H_{11}^{-1} H_{10}`, of which the inverse is needed only where a
        column of :math:`H_{10}` is not 0.
        """
        count, pattern, n = len(slopes), self.pattern, self.n
        band = self._hessian(slopes, weights)
        order = pattern.order_by_states(count)
        at = np.argsort(order.unknowns)
        below = np.flatnonzero(pattern.rows >= n)
        below = below[np.argsort(pattern.columns[below], kind="stable")]
        place, column = at[pattern.rows[below] - n], pattern.columns[below]
        members = Entries(column, np.arange(column.size), n)
        one, other = members.of_rows(column)
        rows, columns = place[one], place[other]
        reach = int(np.abs(rows - columns).max(initial=0))
        inverse = SelectedInverse(order.band(band[1:].reshape(-1), 1.0), reach)
        value = band[0, below]
        lost = np.bincount(
            column[one], value[one] * inverse(rows, columns) * value[other], n
        )
        return np.asarray(np.maximum(band[0, :n] - lost, 0.0))

    def compute(
        self, residuals: Array, slopes: Array, weights: Array, panel: Array, gradient: Array,
        next_gradient: Array,
    ) -> Array:
        """Write the terms of one stage or of several; return their costs, NaN if they overflow."""
        with np.errstate(all="ignore"):
            return self._computed(residuals, slopes, weights, panel, gradient, next_gradient)

    def _computed(
        self, residuals: Array, slopes: Array, weights: Array, panel: Array, gradient: Array,
        next_gradient: Array,
    ) -> Array:
        force = self.weights.times(residuals, weights)
        weighted = self._weighted(weights, slopes)
        square = self._square(slopes, weighted)
        flat = np.concatenate((square, weighted, np.zeros((*square.shape[:-1], 1))), axis=-1)
        flat.take(self._panel, -1, panel, "clip")
        gradient[...] = self._gradient(slopes, force)
        next_gradient[...] = force[..., : self.n]
        costs: Array = np.einsum("...i,...i->...", residuals, force)
        # 0 times anything that is not finite is NaN.
        for one in (flat, force, gradient):
            costs = costs + one.dot(np.zeros(one.shape[-1]))
        return costs
