r"""The proved bound of the observer's error, and the set around its state that holds the truth.

Where the observer is shown to contract on a region (`Form`), any two x, z of it have

.. math::
    |e^+|_P \le \rho |e|_P + |w - L v|_P, \qquad e = x - z,

so that :math:`b(t+1) = \rho\, b(t) + |w(t) - L v(t)|_P` bounds :math:`|x(t) - z(t)|_P` from a
bound of the initial error on, and x(t) is in :math:`\{\xi : |\xi - z(t)|_P \le b(t)\}`. Every
estimate beside the observer is at most as far from x(t) as from the farthest point of this set.
No cost, horizon or detectability enters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import Array, numbers
from ..costs import Cost
from ..errors import InvalidInputError, OptionError, ShapeError
from ..estimation.estimate import Status
from ..estimation.run import Run
from ..model.sets import Box, ConvexSet
from ..model.system import System
from ..observers import Observer
from .contraction import certify_observer, gain_if_constant
from .deadline import PART_SECONDS, Deadline
from .evidence import Evidence, MismatchError, json_ready
from .inequalities import Matrices, definite
from .invariance import Invariance, certify_invariance, inner_region, supports
from .properties import ObserverStability
from .regions import Region, bounded_region
from .sizes import (
    MOST_CORNERS,
    OUTWARD,
    UNIT,
    Size,
    Sizes,
    corners_of,
    initial_length,
    lengths_of,
    read_size,
    sides_of,
    weighted_lengths,
)

# How close to its limit the bound is when it is called settled, and in how many samples at most.
_SETTLED, _MOST_SAMPLES = 0.1, 10**6
# How much of the time is for the contraction, and of the rest for the region itself.
_CONTRACTION, _INVARIANCE = 0.8, 0.6
# Halvings of the bracket of a multiplier, each value of which gives a bound.
_HALVINGS = 20
_SLACKS = (1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2)

#: Of an estimator whose observer does not run on.
REINITIALIZED = (
    "the candidate comes from an observer that starts again at each sample, whose states this "
    "bound is not about"
)
#: Where the data contradict what is assumed.
CONTRADICTION = (
    "no state of the region fits the bound: the disturbances, the noises or the initial error were "
    "larger than stated, or the model is another one"
)
_EVENTS = (
    (Status.MISSING, "a measurement was missing"),
    (Status.MODEL_FAILED, "the model failed, and the observer started again"),
    (Status.METRIC_SINGULAR, "the observer was projected in a metric of the projection's own"),
)
_PROJECTED = (
    Status.OBSERVER_PROJECTED,
    "the observer was projected onto X in another metric than the certified one, "
    "metric=observer_bound.metric",
)


class Entering(NamedTuple):
    """What w and v add at each sample (T,), or always (): |w - L v|_P and |w|_Q^2 + |v|_R^2."""

    length: Array
    square: Array  # infinite where the sum of squares is not certified


@dataclass(frozen=True, eq=False)
class Band:
    """The bound along a run, at the times 0, ..., T.

    Attributes
    ----------
    radius : (T + 1,) array
        b(t), which bounds |x(t) - z(t)|_P; NaN from where the bound no longer holds.
    lower, upper : (T + 1, n) array
        Sides of a box that holds the true state.
    error : (T + 1,) array
        What |x(t) - x_hat(t)| is at most.
    lost : int or None
        The sample after which it no longer holds.
    reason : str
        Why; empty while it holds.
    """

    radius: Array
    lower: Array
    upper: Array
    error: Array
    lost: int | None = None
    reason: str = ""

    def __str__(self) -> str:
        if self.lost is None:
            return f"the bound holds at all {len(self.radius) - 1} samples"
        return f"the bound holds up to sample {self.lost}: there {self.reason}"


@dataclass(frozen=True, eq=False)
class ObserverBound:
    """What is proved of the observer alone; it needs no cost, horizon or detectability.

    Parameters
    ----------
    stability : ObserverStability
        The certified contraction, with its P and gain.
    region : Region
        The set in which state and observer must stay.
    sizes : Sizes
        What bounds w and v unless something else is passed.
    projection : ndarray or None
        The metric in which the observer is projected onto X, if it has one of its own.
    invariance : Invariance or None
        Whether the true state stays in the region, for disturbances of these sizes.
    inner : Invariance or None
        The same of a smaller region, around which the observer stays in the region: within
        the bound's limit. None where there is no such region, or its invariance is not proved.
    """

    stability: ObserverStability
    region: Region
    sizes: Sizes
    projection: Array | None = None
    invariance: Invariance | None = None
    inner: Invariance | None = None

    @property
    def evidence(self) -> Evidence:
        """What it rests on."""
        return self.stability.evidence

    @property
    def rate(self) -> float:
        """The contraction per step in the norm of `metric`."""
        return self.stability.rho

    @property
    def metric(self) -> Array:
        """P; an observer that is to be projected onto X takes it as its ``metric``."""
        assert self.stability.P is not None
        return self.stability.P

    @property
    def gain(self) -> Array:
        """L, the observer's constant gain."""
        assert self.stability.gain is not None
        return self.stability.gain

    @property
    def projects(self) -> bool:
        """Whether a projection of the observer onto X keeps the bound: in P, it does."""
        return self.projection is not None and np.array_equal(self.projection, self.metric)

    def of_observer(self, observer: Observer, system: System) -> ObserverBound:
        """The same of an observer with this gain, or a `MismatchError`; its metric may differ."""
        gain = gain_if_constant(observer, system)
        if gain is None or not np.array_equal(gain, self.gain):
            theirs = "not constant" if gain is None else str(gain.tolist())
            raise MismatchError(
                f"the bound is of an observer with the gain {self.gain.tolist()}; the estimator's "
                f"is {theirs}. Certify the estimator's observer."
            )
        return replace(self, projection=observer.metric)

    @cached_property
    def slopes(self) -> Array:
        """The roots of P^-1's diagonal, (n,): |e_i| <= slopes[i] |e|_P, rounded outward."""
        return supports(self.metric, np.eye(len(self.metric)))

    @cached_property
    def _axes(self) -> tuple[Array, Array]:
        """Half axes of an ellipsoid around {|e|_P <= 1}, the longest first, and directions."""
        n = len(self.metric)
        ball = np.full(n, float(np.linalg.norm(self.slopes)) * OUTWARD), np.eye(n)
        try:
            factor = np.linalg.cholesky(self.metric)
            left, sizes, _ = np.linalg.svd(np.linalg.inv(factor).T)
        except np.linalg.LinAlgError:
            return ball
        vectors = Matrices.exact(left)
        turned = vectors.T @ (Matrices.exact(self.metric) @ vectors)
        for slack in _SLACKS:
            axes = (sizes + slack * sizes[0]) * (1.0 + slack)
            least = np.diag(1.0 / axes**2)
            rest = turned - Matrices(least, 4.0 * UNIT * least)
            if definite(Matrices(rest.middle[None], rest.radius[None]))[0].all():
                # The directions are orthonormal up to rounding.
                return axes * (1.0 + 16.0 * n * UNIT), left
        return ball

    def length(self, errors: ArrayLike) -> Array:
        """|e|_P of errors (..., n), rounded up."""
        return weighted_lengths(numbers("errors", errors), self.metric)

    def initial(self, error: Size) -> float:
        """b(0) from x(0) - z(0): a vector (n,), a bound on its length, or a set that holds it."""
        return initial_length(error, self.metric)

    def entering(self, disturbances: Size | None = None, noises: Size | None = None) -> Entering:
        """What disturbances and noises add to the bound; arguments as of `radii`."""
        usual, V = self.sizes, self.stability.V  # V is no less than L^T P L
        w = read_size("disturbances", usual.disturbance if disturbances is None else disturbances)
        v = read_size("noises", usual.noise if noises is None else noises)
        n, p = self.gain.shape
        assert V is not None
        if isinstance(w, ConvexSet) and isinstance(v, ConvexSet):
            ws, vs = corners_of("disturbances", w, n), corners_of("noises", v, p)
            if len(ws) * len(vs) in range(1, MOST_CORNERS + 1):
                joint = self._joint(np.repeat(ws, len(vs), 0), np.tile(vs, (len(ws), 1))).max()
                return Entering(np.array(joint), self._square(w, v))
        first, second = (
            lengths_of("disturbances", w, n, self.metric), lengths_of("noises", v, p, V)
        )
        if first.ndim and second.ndim and len(first) != len(second):
            raise ShapeError(
                f"disturbances has {len(first)} samples, and noises {len(second)}; expected the "
                "same."
            )
        if not isinstance(w, ConvexSet) and not isinstance(v, ConvexSet) and w.ndim == v.ndim == 2:
            return Entering(self._joint(w, v), self._square(w, v))
        return Entering((first + second) * OUTWARD, self._square(w, v))

    def _square(self, w: Array | ConvexSet, v: Array | ConvexSet) -> Array:
        Q, R = self.stability.Q, self.stability.R
        if Q is None or R is None or len(Q) != len(self.metric):
            return np.array(math.inf)
        first, second = lengths_of("disturbances", w, len(Q), Q), lengths_of("noises", v, len(R), R)
        return (first * first + second * second) * OUTWARD

    def _joint(self, w: Array, v: Array) -> Array:
        """|w - L v|_P, rounded up."""
        sizes = np.abs(w) + np.abs(v) @ np.abs(self.gain.T)
        error = (self.gain.shape[1] + 2) * UNIT * sizes
        rounding = weighted_lengths(error, np.abs(self.metric))
        return (weighted_lengths(w - v @ self.gain.T, self.metric) + rounding) * OUTWARD

    def radii(
        self, steps: int, initial_error: Size, disturbances: Size | None = None,
        noises: Size | None = None,
    ) -> Array:
        """b(0), ..., b(T), (T + 1,).

        Parameters
        ----------
        steps : int
            T.
        initial_error : float, (n,) array_like or set
            x(0) - z(0), a bound on its length, or a set that holds it.
        disturbances, noises : optional
            Vectors (T, n) and (T, p), lengths (T,), a length or a set; `sizes` if left out.
        """
        entering = self.entering(disturbances, noises)
        samples = {len(each) for each in entering if each.ndim} - {steps}
        if samples:
            raise ShapeError(
                f"disturbances and noises have {samples.pop()} samples; expected {steps}."
            )
        found = np.empty(steps + 1)
        lengths, squares = (np.broadcast_to(each, steps) for each in entering)
        found[0] = self.initial(initial_error)
        for t in range(steps):
            found[t + 1] = self.advanced(found[t], Entering(lengths[t], squares[t]))
        return found

    def advanced(self, radius: float, entering: Entering) -> float:
        """b(t+1) from b(t), rounded up: the smaller of the two that are certified."""
        reached = self.rate * radius
        linear = reached + float(entering.length)
        return min(linear, math.hypot(reached, math.sqrt(entering.square))) * OUTWARD

    def limit(self, disturbances: Size | None = None, noises: Size | None = None) -> float:
        """What b(t) tends to as t grows, for bounds on w and v that hold at all times."""
        entering = self.entering(disturbances, noises)
        if any(each.ndim for each in entering):
            raise OptionError(
                "disturbances and noises are of single samples; expected bounds for all times."
            )
        rate = self.rate * OUTWARD
        linear = float(entering.length) / (1.0 - rate)
        return min(linear, math.sqrt(float(entering.square) / (1.0 - rate * rate))) * OUTWARD

    def components(self, radius: ArrayLike) -> Array:
        """What each |x_i - z_i| is at most where |x - z|_P <= radius: (..., n) for (...)."""
        return np.multiply.outer(np.asarray(radius, np.float64), self.slopes) * OUTWARD

    def around(self, radius: ArrayLike, observer: Array) -> tuple[Array, Array]:
        """Sides (..., n) of a box that holds the true state: around z, and within the region."""
        half = self.components(radius)
        n = self.region.n
        margin = UNIT * (np.abs(observer) + half)
        return (
            np.maximum(observer - half - margin, self.region.lower[:n]),
            np.minimum(observer + half + margin, self.region.upper[:n]),
        )

    def farthest(
        self, radius: ArrayLike, offset: ArrayLike, observer: ArrayLike | None = None
    ) -> Array:
        r"""The largest |x_hat - xi| over the set around z, or a little more, (...).

        Over :math:`|\xi - z|_P \le b` it is, by duality, the least value of

        .. math::
            \nu (b a_1)^2 + \sum_i o_i^2 \frac{\nu r_i}{\nu r_i - 1}, \qquad \nu > 1,

        with the half axes :math:`a_i` of the set for b = 1, the longest first,
        :math:`r_i = (a_1 / a_i)^2`, and the offset's components :math:`o_i` along them. Every
        value is a bound; the one for :math:`\nu = 1 + |o| / (b a_1)` is at most
        :math:`(|o| + b a_1)^2`, the triangle's.

        The radius is b, the offset x_hat - z (..., n); with the observer's state z (..., n), only
        what is within the region counts.
        """
        b, o = np.asarray(radius, np.float64), np.asarray(offset, np.float64)
        axes, directions = self._axes
        along = (o @ directions) ** 2
        ratios = (axes[0] / axes) ** 2
        with np.errstate(all="ignore"):
            ball, length = b * axes[0], np.sqrt(along.sum(axis=-1))
            high = length / ball
            low = np.zeros_like(high)
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                # Where the sum is more than the ball's, the multiplier is too small.
                slope = (along * ratios / (ratios * (1.0 + middle)[..., None] - 1.0) ** 2).sum(-1)
                small = slope > ball * ball
                low, high = np.where(small, middle, low), np.where(small, high, middle)
            nu = (1.0 + high)[..., None]
            terms = np.where(along > 0.0, along * (nu * ratios) / (nu * ratios - 1.0), 0.0)
            found = np.sqrt(nu[..., 0] * ball * ball + terms.sum(-1))
            found = np.fmin(found, length + ball)
            found = np.where(ball > 0.0, np.where(length > 0.0, found, ball), length)
            # Of a bound without end, the region's sides are left.
            found = np.where(np.isnan(b), np.nan, np.where(np.isfinite(found), found, np.inf))
        found = found * (1.0 + 64.0 * len(axes) * UNIT)
        if observer is not None:
            z = np.asarray(observer, np.float64)
            lower, upper = self.around(b, z)
            away = np.maximum(np.abs(z + o - lower), np.abs(upper - z - o))
            found = np.minimum(found, np.linalg.norm(away, axis=-1) * OUTWARD)
        result: Array = found
        return result

    def along(
        self, run: Run, disturbances: Size | None = None, noises: Size | None = None, *,
        initial_error: Size,
    ) -> Band:
        """The bound along a run from its first sample, as far as the run shows that it holds.

        Parameters
        ----------
        run : Run
            Of an estimator with this observer, with the usual steps and inputs in the region.
        disturbances, noises : optional
            w(t) and v(t) as (T, n) and (T, p), their lengths (T,), or bounds for all times: a
            number for the length or a set, such as ``qpmhe.Box``. Left out, `sizes`.
        initial_error : float, (n,) array_like or set
            x - z at the run's first sample, a bound on its length, or a set that holds it.

        Raises
        ------
        ShapeError, OptionError, SetError, InvalidInputError
            If an argument does not fit.
        MismatchError
            If the run knows its estimator, and that had another gain.
        """
        if not isinstance(run, Run):
            raise InvalidInputError(
                f"run is of type {type(run).__name__}; expected a qpmhe.Run, as "
                "MovingHorizonEstimator.run returns it."
            )
        z, source, of_run = run.observer_states, run.source, self
        inputs, steps, usual = None, None, None
        if source is not None:
            of_run = self.of_observer(source.observer, source.system)
            inputs, steps, usual = source.inputs, source.steps, source.system.dt
        radius = self.radii(len(run), initial_error, disturbances, noises)
        events = of_run.events(run.flags, z[:-1], inputs, steps, usual)
        if source is not None and source.settings.candidate != "observer":
            events.insert(0, (0, REINITIALIZED))
        empty = self.is_empty(radius[1:], z[1:])
        if empty.any():
            events.append((int(empty.argmax()), CONTRADICTION))
        lost, reason = min(events, key=itemgetter(0), default=(None, ""))
        if lost is not None:
            radius[lost + 1 :] = np.nan
        error = self.farthest(radius, run.states - z, z)
        return Band(radius, *self.around(radius, z), error, lost, reason)

    def events(
        self, flags: NDArray[np.integer[Any]], observer: Array, inputs: Array | None = None,
        steps: ArrayLike | None = None, usual: float | None = None,
    ) -> list[tuple[int, str]]:
        """Samples after which the bound does not follow, and why: the first of each kind.

        From values of the statuses (T,), z(0), ..., z(T-1), inputs (T, m), and lengths of the
        steps (T,) beside the one that is certified.
        """
        low, high = self.region.lower[self.region.n :], self.region.upper[self.region.n :]
        where: list[tuple[Any, Callable[[int], str]]] = [
            ((flags & flag.value) != 0, lambda _, text=text: text)  # type: ignore[misc]
            for flag, text in (_EVENTS if self.projects else (*_EVENTS, _PROJECTED))
        ]
        where.append((~self.region.contains(observer), lambda t: (
            f"the observer was outside of the region, at {np.round(observer[t], 6).tolist()}"
        )))
        if inputs is not None:
            where.append((~((low <= inputs) & (inputs <= high)).all(axis=1), lambda t: (
                f"the input {inputs[t].tolist()} is outside of what was certified"
            )))
        if steps is not None:
            lengths = np.asarray(steps)
            where.append((lengths != usual, lambda t: (
                f"the step had the length {lengths[t]:.6g}, and {usual or 0.0:.6g} is certified"
            )))
        first = [(int(there.argmax()), text) for there, text in where if there.any()]
        return [(t, text(t)) for t, text in first]

    def is_empty(self, radius: Array, observer: Array) -> NDArray[np.bool_]:
        """Whether no state of the region is in the set around z."""
        lower, upper = self.around(radius, observer)
        return np.asarray(np.any(lower > upper, axis=-1))

    @property
    def widths(self) -> Array:
        """How wide the region is in each component, (n,)."""
        n = self.region.n
        return self.region.upper[:n] - self.region.lower[:n]

    @property
    def settling_samples(self) -> int | None:
        """Samples until b(t) is within 10 % of its limit, from anywhere; None where that is 0."""
        radius, limit = self.initial(Box(-self.widths, self.widths)), self.limit()
        if not limit > 0.0:
            return None
        entering, samples = self.entering(), 0
        while radius > (1.0 + _SETTLED) * limit and samples < _MOST_SAMPLES:
            radius, samples = self.advanced(radius, entering), samples + 1
        return samples

    @property
    def headline(self) -> str:
        """The bound in the limit, in the states' units, and after how many samples, in one line."""
        limit, after = self.components(self.limit()), self.settling_samples
        each = ", ".join(f"|x{i + 1} - z{i + 1}| <= {size:.2g}" for i, size in enumerate(limit))
        when = f" after {after} samples" if after else ""
        wide = " x ".join(f"{width:.3g}" for width in self.widths)
        vacuous = ", ".join(f"x{i + 1}" for i in np.flatnonzero(limit >= self.widths))
        nothing = f": it says nothing of {vacuous}" if vacuous else ""
        stays = self.invariance is not None and self.invariance.holds
        condition = "" if stays else " while x stays in the region"
        return f"{each}{when} ({self.evidence}{condition}), on a region {wide} wide{nothing}"

    @property
    def condition(self) -> str:
        """Whether state and observer stay in the region, in words."""
        if self.inner is not None:
            low, high = self.inner.region.lower, self.inner.region.upper
            start = ", ".join(
                f"x{i + 1} in [{low[i]:.4g}, {high[i]:.4g}]" for i in range(self.region.n)
            )
            return (
                f"x and z stay in the region: proved from {start} on, for an initial error of at "
                "most the limit"
            )
        found = "not proved" if self.invariance is None else f"not proved: {self.invariance}"
        if self.invariance is not None and self.invariance.holds:
            found = "proved"
        return f"x stays in the region: {found}; that z does is checked at each sample"

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows."""
        limit = self.limit()
        content: dict[str, Any] = json_ready({
            "evidence": self.evidence, "rate": self.rate, "metric": self.metric,
            "gain": self.gain, "sizes": self.sizes, "limit": limit, "condition": self.condition,
            "invariance": self.invariance, "components": self.components(limit),
            "length": self.farthest(limit, np.zeros(len(self.gain))),
        })
        return content


def bound_observer(
    system: System, observer: Observer, cost: Cost, region: ConvexSet | Region | None = None, *,
    inputs: Box | None = None, sizes: Sizes | None = None,
    seconds: float | Deadline = PART_SECONDS,
) -> ObserverBound:
    """Certify the observer alone: the first part of `certify`, with the same arguments and errors.

    A `CertificateError` or `NotCertifiedError` says why it has no bound.
    """
    place, given = bounded_region(system, region, inputs), Sizes.of(sizes, system, cost)
    deadline = Deadline.of(seconds)
    stability = certify_observer(
        system, observer, place, sizes=given.typical(system), seconds=deadline.part(_CONTRACTION)
    )
    return with_invariance(
        ObserverBound(stability, place, given, observer.metric), system, deadline
    )


def with_invariance(
    bound: ObserverBound, system: System, seconds: float | Deadline
) -> ObserverBound:
    """The bound with what is found of whether state and observer stay in the region."""
    if system.disturbance_matrix is not None:
        return bound
    deadline, w = Deadline.of(seconds), bound.sizes.disturbance
    size: Any = np.abs(sides_of("disturbances", w)).max(axis=0) if isinstance(w, ConvexSet) else w
    found = certify_invariance(
        system, bound.region, disturbance=size, seconds=deadline.part(_INVARIANCE)
    )
    kept: Invariance | None = None
    region = inner_region(bound.region, bound.metric, bound.limit())
    if region is not None:
        kept = certify_invariance(system, region, disturbance=size, seconds=deadline)
    return replace(bound, invariance=found, inner=kept if kept is not None and kept.holds else None)


def largest_ratio(metric: Array, other: Array) -> float:
    """A number c with |e|_P <= c |e|_M for all e, P the first and M the other metric."""
    from scipy.linalg import eigh

    units = 1.0 / np.sqrt(other.diagonal())
    metric, other = np.outer(units, units) * metric, np.outer(units, units) * other
    top = float(eigh(metric, other, eigvals_only=True)[-1])
    for slack in _SLACKS:
        found = top * (1.0 + slack)
        scaled = metric[None] / found
        rest = Matrices(other[None], 4.0 * UNIT * np.abs(other[None])) - Matrices(
            scaled, 6.0 * UNIT * np.abs(scaled)
        )
        if found > 0.0 and definite(rest)[0].all():
            return math.sqrt(found) * OUTWARD
    return math.inf
