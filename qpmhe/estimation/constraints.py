"""The sets X, W, V and the nonlinear constraints as rows: one inequality at one stage each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from .._linalg import inverse
from ..costs import Cost, Subspace
from ..errors import SetError
from ..model.sets import Box, ConvexSet
from ..model.system import System
from .conditions import Conditions
from .estimate import DroppedRow
from .limits import FEASIBLE, IN_RANGE
from .snapshot import SET_NAMES

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Rounding of a difference, as a share of its terms: a residual may miss a row by that much more.
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)

# A row is the combination of others if less than this share of it is not.
_DEPENDENT = 1e-9


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


class Constraints:
    """The rows of X, W, V and hard nonlinear constraints, and noise-free directions; immutable.

    Attributes
    ----------
    states, disturbances, noises : Rows or None
        The inequalities on x, on d = x+ - f(x) and on v.
    constraints : Rows or None
        Those on the values of the nonlinear constraints.
    noise_free : (k,) array
        Components whose disturbance is a constant, so that their states follow the model.
    constant : (k,) array
        These constants.
    basis : (n, n - k) array
        The directions in which there are disturbances.
    directions : Directions or None
        The noise-free directions in place of these components, for a `LiftedCost`.
    """

    __slots__ = (
        "basis", "constant", "constraints", "directions", "disturbances", "noise_free", "noises",
        "states",
    )

    def __init__(self, system: System, cost: Cost, prior_covariance: Array) -> None:
        self.states = _rows("states", system.states, prior_covariance)
        self.noises = _rows("noises", system.noises, inverse(cost.noise))
        self.constraints: Rows | None = None
        nonlinear = system.constraints
        if nonlinear is not None and not nonlinear.soft.all():
            self.constraints = function_rows(~nonlinear.soft, nonlinear.scale)
        disturbances, spread = system.disturbances, inverse(cost.disturbance)
        self.noise_free: NDArray[np.intp] = np.empty(0, np.intp)
        self.constant: Array = np.empty(0)
        self.directions: Directions | None = None
        if cost.space is None:
            self.disturbances = _rows("disturbances", disturbances, spread)
            if disturbances is not None:
                self.noise_free = disturbances.fixed_components
                self.constant = disturbances.lower[self.noise_free]
            self.basis = np.delete(np.eye(system.n), self.noise_free, axis=1)
        else:
            self._lift(system, cost.space, spread)

    def _lift(self, system: System, space: Subspace, spread: Array) -> None:
        """Set the rows on d and the noise-free directions of a `LiftedCost`."""
        through, disturbances = space.to_disturbances, system.disturbances
        if disturbances is None:
            unbounded = np.full(system.r, np.inf)
            disturbances = Box(-unbounded, unbounded)
        if through is not None:
            spread = through @ spread @ through.T
        rows = Rows("disturbances", disturbances, spread)
        directions = Directions(rows, space)
        self.basis = directions.basis
        if self.basis.shape[1] < system.n:
            self.directions = directions
        mapped = rows.mapped(through, space.noise_free, directions.repeated)
        self.disturbances = mapped if len(mapped.matrix) else None

    def __bool__(self) -> bool:
        return any((self.states, self.disturbances, self.noises, self.constraints))

    def _parts(
        self, trajectory: Array, residuals: Array, measurements: Array, values: Array | None
    ) -> Iterator[tuple[Rows, Array, Array]]:
        """Each set's rows, the points to test, and the ``sizes`` of `Rows.misses`."""
        n = trajectory.shape[1]
        if self.states is not None:
            yield self.states, trajectory, trajectory
        if self.disturbances is not None:
            yield self.disturbances, residuals[:, :n], trajectory[1:]
        if self.noises is not None:
            yield self.noises, residuals[:, n:], measurements
        if self.constraints is not None and values is not None:
            # Nothing is known about the rounding within a user's function.
            yield self.constraints, values, np.zeros(values.shape)

    def violation(
        self, trajectory: Array, residuals: Array, measurements: Array,
        values: Array | None = None,
    ) -> float:
        """The largest miss of a row in its scale; infinity where a number is not finite.

        ``values`` are those of the nonlinear constraints, if there are any.
        """
        worst = 0.0
        for rows, points, sizes in self._parts(trajectory, residuals, measurements, values):
            misses = rows.misses(points, sizes)
            if misses is not None:
                largest = float(misses.max())
                # A NaN must not pass as a member.
                worst = math.inf if math.isnan(largest) else max(worst, largest)
        return worst

    def at(self, conditions: Sequence[Conditions]) -> Constraints:
        """The constraints with the sides of each stage; those of the last for the newest state."""
        rows: dict[str, Rows] = {}
        for name in SET_NAMES:
            mine: Rows | None = getattr(self, name)
            if mine is not None:
                sets = [getattr(own, name) for own in conditions]
                rows[name] = mine.with_sides([*sets, sets[-1]] if name == "states" else sets)
        return self._replaced(**rows)

    def observed(self, observed: Mask, counting: Mask | None) -> Constraints:
        """The constraints without the rows on missing outputs; ``observed`` is (K, p) bool.

        ``counting`` (K + 1, T) says which rows of the nonlinear constraints hold.
        """
        rows = {}
        if self.noises is not None:
            rows["noises"] = self.noises.without(self.noises.touching(~observed))
        if self.constraints is not None and counting is not None:
            left_out = ~counting[:, self.constraints.components]
            rows["constraints"] = self.constraints.without(left_out)
        return self._replaced(**rows) if rows else self

    def without_violated(
        self, trajectory: Array, residuals: Array, measurements: Array, values: Array | None
    ) -> Constraints:
        """The constraints without the rows that a trajectory misses; noise-free ones stay."""
        left = {
            rows.name: rows.without((misses > FEASIBLE) & ~rows.fixed, points)
            for rows, points, sizes in self._parts(trajectory, residuals, measurements, values)
            if (misses := rows.misses(points, sizes)) is not None
        }
        return self._replaced(**left)

    def missed_rows(
        self, trajectory: Array, residuals: Array, measurements: Array, values: Array | None,
        first: int,
    ) -> tuple[DroppedRow, ...]:
        """The rows that a trajectory misses; its first state has the time ``first``."""
        found = []
        for rows, points, sizes in self._parts(trajectory, residuals, measurements, values):
            misses = rows.misses(points, sizes)
            if misses is None:
                continue
            below = rows.values(points) < rows.lower
            found += [
                DroppedRow(
                    rows.name, int(rows.numbers[r]), "lower" if below[k, r] else "upper",
                    first + int(k),
                )
                for k, r in np.argwhere(misses > FEASIBLE)
            ]
        return tuple(found)

    def _replaced(self, **rows: Rows) -> Constraints:
        other = copy(self)
        for name, mine in rows.items():
            setattr(other, name, mine)
        return other


class Directions:
    """Noise-free directions: N' d = c for all d = x+ - f(x) of an estimate.

    They are those of the cost, with c = 0, and the components of W that have no width.

    Attributes
    ----------
    projection, offset : (n, n) and (n,) array
        d becomes noise-free as ``projection @ d + offset``, in the metric of the `LiftedCost`.
    candidate_projection : (n, n) array
        The same for the directions of the cost alone.
    repeated : bool array
        Which of W's rows the cost implies.
    basis : (n, n - k) array
        The directions in which there are disturbances.
    """

    def __init__(self, rows: Rows, space: Subspace) -> None:
        scale, matrix, normal = space.scale, rows.matrix, space.normal
        if space.to_disturbances is not None:
            matrix = matrix @ space.to_disturbances
        constant = np.zeros(normal.shape[1])
        self.repeated: Mask = np.zeros(len(matrix), np.bool_)
        self.candidate_projection = _off(normal, scale)
        for j in np.flatnonzero(rows.fixed):
            row = matrix[j] * scale
            shares = normal.T @ row
            rest = row - normal @ shares
            size, value = float(np.linalg.norm(rest)), float(rows.lower[j] - shares @ constant)
            if size > _DEPENDENT * float(np.linalg.norm(row)):
                normal = np.column_stack((normal, rest / size))
                constant = np.append(constant, value / size)
                continue
            self.repeated[j] = True
            if abs(value) > _DEPENDENT * abs(rows.lower[j]):
                raise SetError(
                    f"the set of disturbances fixes component {rows.numbers[j]} at "
                    f"{rows.lower[j]:.6g}, but the covariance of the disturbance implies "
                    f"{rows.lower[j] - value:.6g}; leave it out of the set, or give it a variance."
                )
        self.projection = _off(normal, scale)
        self.offset = scale * (normal @ constant)
        k = normal.shape[1]
        self.basis = scale[:, None] * np.linalg.qr(normal, mode="complete")[0][:, k:]
        self._shown, self._sizes = space.noise_free, np.abs(space.noise_free)

    def roll_out(self, of_candidate: bool) -> tuple[Array, Array]:
        """Projection and offset of a trial, or of the candidate."""
        if of_candidate:
            return self.candidate_projection, np.zeros_like(self.offset)
        return self.projection, self.offset

    def has(self, differences: Array) -> bool:
        """Whether the cost's directions of all d (K, n) are noise-free, up to rounding."""
        missed = np.abs(differences @ self._shown)
        return bool((missed <= IN_RANGE * (np.abs(differences) @ self._sizes)).all())


def _off(normal: Array, scale: Array) -> Array:
    """The projection I - E N' along orthonormal directions, in scaled numbers."""
    projection: Array = np.eye(scale.size) - scale[:, None] * (normal @ normal.T) / scale
    return projection


def function_rows(chosen: Mask, scale: Array) -> Rows:
    """The rows g <= 0 of the chosen ones among all rows of g; a point is all of their values."""
    upper = np.where(chosen, 0.0, np.inf)
    return Rows("constraints", Box(np.full(upper.size, -np.inf), upper), np.diag(scale**2))


def _rows(name: str, convex_set: ConvexSet | None, covariance: Array) -> Rows | None:
    return None if convex_set is None else Rows(name, convex_set, covariance)
