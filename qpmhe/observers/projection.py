"""Projection of the observer onto X: the nearest point in its own metric, or a diagonal one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._checks import Array, positive_definite
from .._linalg import inverse
from ..memory.snapshot import checked_array
from ..model.sets import ConvexSet
from .base import Observer, Sample

_EPS = float(np.finfo(np.float64).eps)

# A variance below this share of the largest possible one counts as zero.
_SINGULAR = 1e-12

# A miss of a row by less than this share of the terms that it sums up is rounding.
_ROUNDING = 16.0 * _EPS

# At most this many corrections put a point on its active rows. Each takes as many digits off the
# miss as a number has.
_REFINEMENTS = 4

# E^(2^k) of a stable matrix has vanished by then, unless its spectral radius is 1 within 1e-12.
# In more products, the rounding of a matrix that is not stable could make it vanish.
_DOUBLINGS = 40


class Projected(NamedTuple):
    """A point of X; ``reached`` says whether its metric alone led there."""

    point: Array
    reached: bool


class NearestPoint:
    r"""The point of a polyhedron nearest to another one, in the metric of a covariance P.

    .. math::
        \min_\xi |\xi - \bar z|_{P^{-1}} \quad \text{s.t.} \quad A \xi \le b

    Its solution is :math:`\xi = \bar z - P A^\top \lambda`, in which P may be singular. The
    dual active-set method of Goldfarb and Idnani finds it: each change of the active set
    either raises the dual objective or removes a row, and their number is bounded.

    Parameters
    ----------
    convex_set : ConvexSet
        X, not empty.
    diagonal : bool
        Whether the metric is that of the covariance's diagonal alone.

    References
    ----------
    Goldfarb and Idnani, A numerically stable dual method for solving strictly convex quadratic
    programs, Mathematical Programming 27 (1983).
    """

    def __init__(self, convex_set: ConvexSet, diagonal: bool = False) -> None:
        self._diagonal = diagonal
        self._lower, self._upper = convex_set.lower, convex_set.upper
        eye = np.eye(convex_set.dimension)
        sides = (
            (eye, convex_set.upper), (-eye, -convex_set.lower),
            (convex_set.matrix, convex_set.row_upper), (-convex_set.matrix, -convex_set.row_lower),
        )
        finite = [np.isfinite(side) for _, side in sides]
        self._rows = np.vstack([rows[keep] for (rows, _), keep in zip(sides, finite, strict=True)])
        self._sides = np.concatenate([s[keep] for (_, s), keep in zip(sides, finite, strict=True)])
        self._sizes, self._side_sizes = np.abs(self._rows), np.abs(self._sides)
        # Of the first rows, which are bounds: the component, and its bound.
        self._components = np.concatenate([np.flatnonzero(keep) for keep in finite[:2]])
        self._bounds = np.concatenate((convex_set.upper[finite[0]], convex_set.lower[finite[1]]))
        self._has_rows = bool(convex_set.matrix.shape[0])
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(self._sizes > 0.0, self._side_sizes[:, None] / self._sizes, 0.0)
        self._largest = reach.max(axis=0, initial=0.0)  # sizes that the set gives its components
        self._widths: Array = convex_set.upper - convex_set.lower

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of the points (..., n) is in the set, up to rounding in general rows."""
        # Comparisons with NaN are false: a NaN is no member.
        inside = np.asarray(((self._lower <= points) & (points <= self._upper)).all(-1))
        return inside & ~(self._misses(points) > 0.0).any(-1) if self._has_rows else inside

    def _misses(self, points: Array) -> Array:
        """By how much points (..., n) miss each row; 0 where only by rounding."""
        missed: Array = points @ self._rows.T - self._sides
        rounding = _ROUNDING * (np.abs(points) @ self._sizes.T + self._side_sizes)
        return np.where(missed > rounding, missed, 0.0)

    def __call__(self, point: Array, covariance: Array) -> Projected:
        """The nearest point in the metric of a covariance (n, n), positive semidefinite.

        Where a singular covariance leads to no point of the set, the metric is diagonal, with the
        sizes of the components as standard deviations.
        """
        found = self._nearest(point, self._taken(covariance))
        if found is not None:
            return Projected(found, True)
        sizes = np.maximum(np.abs(point), self._largest)
        found = self._nearest(point, np.diag(sizes * sizes))
        if found is None:
            found = np.clip(point, self._lower, self._upper)
        return Projected(found, False)

    def is_beyond(self, point: Array, nearest: Array, covariance: Array) -> bool:
        """Whether a point is farther from the set than any two points of the set are apart."""
        if not np.isfinite(self._widths).all():
            return False
        try:
            metric = inverse(self._taken(covariance))
        except np.linalg.LinAlgError:
            return False
        offset = point - nearest
        # Within the set |e_i| <= w_i, so that e' M e <= w' |M| w: larger than any distance in it.
        return bool(offset @ metric @ offset > self._widths @ np.abs(metric) @ self._widths)

    def _taken(self, covariance: Array) -> Array:
        """The part of a covariance that makes the metric."""
        return np.diag(covariance.diagonal()) if self._diagonal else covariance

    def _nearest(self, point: Array, covariance: Array) -> Array | None:
        rows = self._rows
        spread: Array = covariance @ rows.T
        variances = np.einsum("ij,ji->i", rows, spread)
        # |a|' D |a| with D the diagonal is of the size that the variance of a row can have.
        possible = (self._sizes**2) @ np.abs(covariance.diagonal())
        usable = variances > _SINGULAR * possible
        scale = np.sqrt(np.where(usable, variances, 1.0))
        # In units of each row's standard deviation, so that no row's unit matters.
        gram = (rows @ spread) / np.outer(scale, scale)
        reach = np.sqrt(possible) / scale  # the largest possible deviation of each
        active: list[int] = []
        multipliers = np.zeros(0)
        current = point
        for _ in range(50 + 10 * scale.size):
            missed = self._misses(current) / scale
            if active:
                missed[active] = 0.0
            worst = int(missed.argmax())
            if not missed[worst] > 0.0:
                found: Array = np.clip(current, self._lower, self._upper)
                # Exactly on its bounds, not beside them by rounding: there, a model may have a huge
                # derivative where it has none on the bound.
                bounds = [row for row in active if row < self._bounds.size]
                found[self._components[bounds]] = self._bounds[bounds]
                return found
            if not usable[worst]:
                return None
            entering = self._enter(gram, reach, worst, float(missed[worst]), active, multipliers)
            if entering is None:
                return None
            multipliers = entering
            current = self._reached(point, multipliers, gram, spread, scale, active)
        return None

    def _reached(
        self, point: Array, multipliers: Array, gram: Array, spread: Array, scale: Array,
        active: list[int],
    ) -> Array:
        """The point that these multipliers lead to, corrected to lie on the active rows."""
        rows, sides, within = self._rows[active], self._sides[active], np.ix_(active, active)
        current = point - spread[:, active] @ (multipliers / scale[active])
        for _ in range(_REFINEMENTS):
            missed = (rows @ current - sides) / scale[active]
            rounding = _ROUNDING * (self._sizes[active] @ np.abs(current) + np.abs(sides))
            if (np.abs(missed) * scale[active] <= rounding).all():
                break
            current = current - spread[:, active] @ (
                np.linalg.solve(gram[within], missed) / scale[active]
            )
        return current

    @staticmethod
    def _enter(
        gram: Array, reach: Array, row: int, missed: float, active: list[int], multipliers: Array
    ) -> Array | None:
        """Make a violated row active, and others inactive if need be; None if that is impossible.

        Changes ``active`` in place, and returns its multipliers.
        """
        own = 0.0
        while True:
            exchange = np.linalg.solve(gram[np.ix_(active, active)], gram[active, row])
            curvature = float(gram[row, row] - gram[row, active] @ exchange)
            largest = float(reach[row] + np.abs(exchange) @ reach[active])
            full = (missed / curvature) if curvature > _SINGULAR * largest**2 else np.inf
            with np.errstate(divide="ignore", invalid="ignore"):
                limits = np.where(exchange > 0.0, multipliers / exchange, np.inf)
            blocking = int(limits.argmin()) if limits.size else -1
            length = min(full, float(limits[blocking]) if limits.size else np.inf)
            if not np.isfinite(length):
                return None
            multipliers = multipliers - length * exchange
            own += length
            missed -= length * max(curvature, 0.0)
            if length == full:
                active.append(row)
                return np.append(multipliers, own)
            del active[blocking]
            multipliers = np.delete(multipliers, blocking)


class ErrorMetric:
    r"""The metric in which an observer is projected onto X, unless that is its covariance.

    It is the observer's own `Observer.metric` where that exists. Otherwise it is the
    Lyapunov matrix of the linearised error :math:`E = A - K C`,

    .. math::
        M = E^\top M E + \Gamma

    at the first state at which E is stable; K is the constant gain or the slope of
    :math:`L(z, \cdot)` at 0, and :math:`\Gamma` the cost's prior weight, so that no unit
    matters. Parameters that the observer does not correct have an error that stays: they are
    left out of E and keep their block of :math:`\Gamma`. Until a state makes E stable,
    :math:`\Gamma` is the metric.

    Parameters
    ----------
    observer : Observer
        One with a metric, or without a covariance.
    prior_weight : (n, n) array
        :math:`\Gamma`.
    noise_deviations : (p,) array
        Standard deviations of the noise: the steps for the slope of L.
    """

    def __init__(self, observer: Observer, prior_weight: Array, noise_deviations: Array) -> None:
        self._observer, self._deviations = observer, noise_deviations
        self._prior_weight = prior_weight
        self._scale = np.sqrt(prior_weight.diagonal())
        own = observer.metric
        #: Inverse of the metric (n, n) before it is the final one.
        self.initial: Array = inverse(prior_weight if own is None else own)
        #: Inverse of the metric (n, n).
        self.covariance: Array = self.initial
        #: Whether the metric is the final one.
        self.settled: bool = own is not None

    @property
    def state(self) -> tuple[Array, bool]:
        """The covariance, and whether it is the final one; settable."""
        return self.covariance, self.settled

    @state.setter
    def state(self, state: tuple[Array, bool]) -> None:
        self.covariance, self.settled = state

    def state_dict(self) -> tuple[Array, bool]:
        """A copy of the state."""
        return self.covariance.copy(), self.settled

    def checked(self, saved: Any) -> tuple[Array, bool]:
        """The state that `state_dict` saved; raises any exception if it is damaged."""
        covariance, settled = saved
        if not isinstance(settled, bool):
            raise TypeError(f"metric is {settled!r}")
        checked = checked_array("metric", covariance, self.covariance.shape)
        return positive_definite("metric", checked), settled

    def settle(self, z: Array, a: Array, c: Array, sample: Sample) -> None:
        """Take the Lyapunov matrix at z with the Jacobians a of f and c of h, if E is stable."""
        gain = self._observer.constant_gain
        if gain is None:
            gain = self._slope(z, sample)
        if not (np.isfinite(gain).all() and np.isfinite(a).all() and np.isfinite(c).all()):
            return
        # Scaled by the prior: numbers without units.
        scale = self._scale
        error = scale[:, None] * (a - gain @ c) / scale
        weight = self._prior_weight / np.outer(scale, scale)
        moving = np.ones(scale.size, np.bool_)
        if not _stable(error):
            moving = gain.any(axis=1) | (a != np.eye(scale.size)).any(axis=1)
            error = error[np.ix_(moving, moving)]
            if not (moving.any() and _stable(error)):
                return
        metric = np.where(moving[:, None] == moving, weight, 0.0)
        block = np.ix_(moving, moving)
        metric[block] = _lyapunov(error, weight[block])
        covariance = inverse(metric) / np.outer(scale, scale)
        if np.isfinite(covariance).all():
            self.covariance, self.settled = covariance, True

    def _slope(self, z: Array, sample: Sample) -> Array:
        columns = []
        for j, step in enumerate(self._deviations):
            move = np.zeros(self._deviations.size)
            move[j] = step
            columns.append(self._observer.correct(z, move, sample)[0] / step)
        return np.array(columns).T


def _stable(error: Array) -> bool:
    """Whether a power of E halves every vector: all eigenvalues are within the unit circle."""
    power = error
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            size = np.abs(power).sum(axis=1).max()
            if not 0.5 < size < np.inf:  # also for NaN
                return bool(size <= 0.5)
            power = power @ power
    return False


def _lyapunov(error: Array, weight: Array) -> Array:
    """The sum over k of E'^k W E^k, by doubling: 2^j terms after j products."""
    total, power = weight, error
    for _ in range(_DOUBLINGS):
        added = power.T @ total @ power
        total = total + added
        power = power @ power
        if np.abs(added).max() <= _EPS * np.abs(total).max():
            break
    return 0.5 * (total + total.T)

