"""The rows of a set: one inequality at one stage each, hard or soft."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from ..model.sets import Box, ConvexSet

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Rounding of a difference, as a share of its terms: a residual may miss a row by that much more.
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)


class Rows:
    """Inequalities ``lower <= M s <= upper`` of one set.

    s is a state, a disturbance or a noise. The sides are the same at all stages, or differ.

    Bounds of components come first, then the general inequalities.

    Attributes
    ----------
    name : str
        As in `DroppedRow`.
    matrix : (r, d) array
        M, of which the first ``bounds`` rows are unit vectors.
    components : (bounds,) array
        The components that these bound.
    lower, upper : (r,) or (K, r) array
        Sides, infinite where there is none.
    scale : (r,) or (K, r) array
        The unit in which a miss of the row is measured: its width, or the standard deviation of
        M s if that is less.
    deviation : (r,) array
        The standard deviation of M s.
    fixed : (r,) bool array
        Rows that are never dropped: the components that have no width.
    numbers : (r,) array
        As in `DroppedRow`.
    kept : bool array or None
        Of rows that were mapped: which are left of those of the set.
    """

    __slots__ = (
        "_columns", "_magnitudes", "bounds", "components", "deviation", "fixed", "kept",
        "lower", "matrix", "name", "numbers", "scale", "upper",
    )

    def __init__(self, name: str, convex_set: ConvexSet, covariance: Array) -> None:
        d, components = convex_set.dimension, convex_set.bounded_components
        self.name, self.components, self.bounds = name, components, components.size
        self.matrix: Array = np.vstack((np.eye(d)[components], convex_set.matrix))
        self.kept: Mask | None = None
        self.deviation = np.sqrt(np.einsum("ri,ij,rj->r", self.matrix, covariance, self.matrix))
        self.lower, self.upper = self._sides(convex_set)
        self.scale: Array = self._scale()
        fixed = self.lower == self.upper
        self.fixed: Mask = fixed & (np.arange(fixed.size) < self.bounds)
        general = np.arange(d, d + convex_set.matrix.shape[0])
        self.numbers: NDArray[np.intp] = np.append(components, general)
        self._magnitudes = np.abs(self.matrix).T
        # Without general inequalities M s is a part of s, mostly the whole of it.
        self._columns: slice | NDArray[np.intp] | None = None
        if not convex_set.matrix.shape[0]:
            self._columns = slice(None) if components.size == d else components

    def _sides(self, convex_set: ConvexSet) -> tuple[Array, Array]:
        lower = np.append(convex_set.lower[self.components], convex_set.row_lower)
        upper = np.append(convex_set.upper[self.components], convex_set.row_upper)
        if self.kept is None:
            return lower, upper
        noise_free = np.zeros(len(self.matrix) - int(self.kept.sum()))
        return np.append(lower[self.kept], noise_free), np.append(upper[self.kept], noise_free)

    def _scale(self) -> Array:
        width, deviation = self.upper - self.lower, self.deviation
        scale: Array = np.where(width > 0.0, np.minimum(width, deviation), deviation)
        return scale

    def with_sides(self, sets: Sequence[ConvexSet | None]) -> Rows:
        """A copy with the sides of these sets, one a point; None for the present ones."""
        if all(one is None for one in sets):
            return self
        other = copy(self)
        other.lower, other.upper = (
            np.tile(side, (len(sets), 1)) for side in (self.lower, self.upper)
        )
        for k, one in enumerate(sets):
            if one is not None:
                other.lower[k], other.upper[k] = self._sides(one)
        other.scale = other._scale()
        return other

    def values(self, points: Array) -> Array:
        """M s at each point (K, r)."""
        if self._columns is None:
            return points @ self.matrix.T
        chosen: Array = points[:, self._columns]
        return chosen

    def misses(self, points: Array, sizes: Array) -> Array | None:
        """By how much points (K, d) miss each row (K, r), in its scale; None if none misses any.

        ``sizes`` (K, d) are numbers whose rounding is in the points: for w = x - f, those of x.
        """
        values = self.values(points)
        missed = np.maximum(self.lower - values, values - self.upper)
        if missed.max(initial=0.0) <= 0.0:
            return None
        missed -= _ROUNDING * (np.abs(sizes) @ self._magnitudes)
        return np.asarray(np.maximum(missed, 0.0) / self.scale)

    def without(self, left_out: Mask, points: Array | None = None) -> Rows:
        """A copy without rows (K, r) at some stages: both sides, or those that points miss."""
        other = copy(self)
        lower, upper = left_out, left_out
        if points is not None:
            values = self.values(points)
            lower, upper = left_out & (values < self.lower), left_out & (values > self.upper)
        other.lower = np.where(lower, -np.inf, self.lower)
        other.upper = np.where(upper, np.inf, self.upper)
        return other

    def touching(self, components: Mask) -> Mask:
        """Which rows (K, r) have a nonzero coefficient on these components (K, d)."""
        touched: Mask = (components @ (self._magnitudes != 0.0).astype(np.intp)) > 0
        return touched

    def mapped(self, through: Array | None, noise_free: Array, left_out: Mask) -> Rows:
        """The rows on d, where s = T d, without some; and behind them N' d = 0, noise-free."""
        other, kept, nothing = copy(self), ~left_out, np.zeros(noise_free.shape[1])
        matrix = self.matrix if through is None else self.matrix @ through
        other.kept, other.matrix = kept, np.vstack((matrix[kept], noise_free.T))
        other.lower = np.append(self.lower[kept], nothing)
        other.upper = np.append(self.upper[kept], nothing)
        # A row on a disturbance without variance has no deviation; N has a variance of 1.
        deviation = np.where(self.deviation > 0.0, self.deviation, 1.0)
        other.deviation = np.append(deviation[kept], nothing + 1.0)
        other.scale = other._scale()
        other.fixed = np.append(self.fixed[kept], nothing == 0.0)
        other.numbers = np.append(self.numbers[kept], np.full(nothing.size, -1))
        other._columns, other._magnitudes = None, np.abs(other.matrix).T
        return other


def function_rows(chosen: Mask, scale: Array) -> Rows:
    """The rows g <= 0 of the chosen ones among all rows of g; a point is all of their values."""
    upper = np.where(chosen, 0.0, np.inf)
    rows = Rows("constraints", Box(np.full(upper.size, -np.inf), upper), np.eye(upper.size))
    # Of numbers in any unit, whose squares may not be finite.
    rows.deviation = rows.scale = scale[rows.components]
    return rows
