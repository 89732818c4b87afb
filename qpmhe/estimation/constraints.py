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
from ..model.sets import Box
from ..model.system import System
from ..terms.prior import PriorCost
from ..terms.rows import Rows, function_rows
from .conditions import Conditions
from .description import SET_NAMES
from .estimate import DroppedRow
from .limits import FEASIBLE, IN_RANGE

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A row is the combination of others if less than this share of it is not.
_DEPENDENT = 1e-9


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
    directions : NoiseFreeDirections or None
        The noise-free directions in place of these components, for a `LiftedCost`.
    """

    __slots__ = (
        "_basis", "_n", "constant", "constraints", "directions", "disturbances", "noise_free",
        "noises", "states",
    )

    def __init__(self, system: System, cost: Cost, prior: PriorCost) -> None:
        self.states: Rows | None = None
        self.noises: Rows | None = None
        if system.states is not None:
            self.states = Rows("states", system.states, prior.covariance)
        if system.noises is not None:
            self.noises = Rows("noises", system.noises, inverse(cost.noise))
        self.constraints: Rows | None = None
        self._n = system.n
        self._basis: Array | None = None
        nonlinear = system.constraints
        if nonlinear is not None and not nonlinear.soft.all():
            self.constraints = function_rows(~nonlinear.soft, nonlinear.scale)
        disturbances = system.disturbances
        self.noise_free: NDArray[np.intp] = np.empty(0, np.intp)
        self.constant: Array = np.empty(0)
        self.directions: NoiseFreeDirections | None = None
        if cost.space is None:
            self.disturbances: Rows | None = None
            if disturbances is not None:
                self.disturbances = Rows("disturbances", disturbances, inverse(cost.disturbance))
                self.noise_free = disturbances.fixed_components
                self.constant = disturbances.lower[self.noise_free]
        else:
            self._lift(system, cost.space, inverse(cost.disturbance))

    @property
    def basis(self) -> Array:
        """The directions (n, n - k) in which there are disturbances; made when first asked for."""
        if self._basis is None:
            self._basis = np.delete(np.eye(self._n), self.noise_free, axis=1)
        return self._basis

    def _lift(self, system: System, space: Subspace, spread: Array) -> None:
        """Set the rows on d and the noise-free directions of a `LiftedCost`."""
        through, disturbances = space.to_disturbances, system.disturbances
        if disturbances is None:
            unbounded = np.full(system.r, np.inf)
            disturbances = Box(-unbounded, unbounded)
        if through is not None:
            spread = through @ spread @ through.T
        rows = Rows("disturbances", disturbances, spread)
        directions = NoiseFreeDirections(rows, space)
        self._basis = directions.basis
        if self._basis.shape[1] < system.n:
            self.directions = directions
        mapped = rows.mapped(through, space.noise_free, directions.repeated)
        self.disturbances = mapped if len(mapped.matrix) else None

    def __bool__(self) -> bool:
        return any((self.states, self.disturbances, self.noises, self.constraints))

    @property
    def has_inequalities(self) -> bool:
        """Whether there are other rows than those of noise-free directions."""
        others = any((self.states, self.noises, self.constraints))
        return others or (self.disturbances is not None and not self.disturbances.fixed.all())

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


class NoiseFreeDirections:
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
    scale : (n,) array
        Typical sizes of the states.
    """

    def __init__(self, rows: Rows, space: Subspace) -> None:
        self.scale: Array = space.scale
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
