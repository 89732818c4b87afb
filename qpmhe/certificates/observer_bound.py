r"""The proved bound on the observer's error, and the set around it that contains the true state.

Where the observer is shown to contract on a region (`Form`), any two x, z of it have

.. math::
    |e^+|_P \le \rho |e|_P + |w|_W + |v|_V \quad \text{and} \quad
    |e^+|_P^2 \le \rho^2 |e|_P^2 + |w|_Q^2 + |v|_R^2, \qquad e = x - z,

with W = P or, of a system with a ``disturbance_matrix`` G, :math:`W = G^\top P G`,
so that the same recursions of b bound :math:`|x(t) - z(t)|_P` from a bound of the initial error
on, and x(t) is in :math:`\{\xi : |\xi - z(t)|_P \le b(t)\}`.
Every estimate is at most as far from x(t) as from the farthest point of this set. No cost, horizon
or detectability enters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import Array, count, numbers
from ..costs import Cost
from ..errors import InvalidInputError, OptionError, ShapeError
from ..estimation.estimate import Status
from ..estimation.run import Run
from ..model.sets import Box, ConvexSet
from ..model.system import System
from ..observers import Observer
from .content import Content
from .contraction import certify_observer, gain_if_constant
from .deadline import PART_SECONDS, Deadline
from .enclosures import evaluated
from .evidence import Evidence, MismatchError, at_most, json_ready
from .inequalities import Matrices, definite
from .invariance import Invariance, certify_invariance, inner_region
from .model_values import SAME_MODEL
from .properties import ObserverStability
from .regions import Region, bounded_region
from .sizes import (
    OUTWARD,
    UNIT,
    Size,
    Sizes,
    extent_of,
    intervals,
    lengths_of,
    weighted_lengths,
)

# How close to its limit the bound is when it is called settled, and in how many samples at most.
_SETTLED, _MOST_SAMPLES = 0.1, 10**6
# How much of the time is for the contraction, and of the rest for the region itself.
_CONTRACTION, _INVARIANCE = 0.8, 0.6
_SLACKS = (1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2)

#: Of an estimator whose observer does not run on.
REINITIALIZED = (
    "the candidate comes from an observer that restarts at each sample, whose states this bound "
    "does not cover"
)
#: Where the data contradict what is assumed.
CONTRADICTION = (
    "no state of the region fits the bound: the disturbances, the noises or the initial error were "
    "larger than stated, or the model is another one"
)
_EVENTS = {
    Status.MISSING: "a measurement was missing",
    Status.MODEL_FAILED: "the model failed, and the observer restarted",
    Status.METRIC_SINGULAR: "the observer was projected in the projection's own metric",
    Status.RESTARTED: "the observer was restarted from an estimate (RESTARTED)",
}
_PROJECTED = (
    "the observer was projected onto X in another metric than the certified one, "
    "metric=observer_bound.metric"
)


@dataclass(frozen=True, eq=False)
class Band:
    """The bound along a run, at the times 0, ..., T.

    Attributes
    ----------
    radius : (T + 1,) array
        b(t), which bounds |x(t) - z(t)|_P; NaN once the bound no longer holds.
    lower, upper : (T + 1, n) array
        Sides of a box that holds the true state.
    error : (T + 1,) array
        Upper bound on |x(t) - x_hat(t)|.
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
    """What is proved about the observer alone; it needs no cost, horizon or detectability.

    Parameters
    ----------
    stability : ObserverStability
        The certified contraction, with its P and gain.
    region : Region
        The set in which state and observer must stay.
    sizes : Sizes
        Bounds on w and v unless others are passed.
    projection : ndarray or None
        The metric in which the observer is projected onto X, if it has its own.
    invariance : Invariance or None
        Whether the true state stays in the region, for disturbances of these sizes.
    inner : Invariance or None
        The same for a smaller region, around which the observer stays in the region: within the
        bound's limit. None where there is no such region, or its invariance is not proved.
    """

    stability: ObserverStability
    region: Region
    sizes: Sizes
    projection: Array | None = None
    invariance: Invariance | None = None
    inner: Invariance | None = None

    @property
    def evidence(self) -> Evidence:
        """The evidence for the bound."""
        return self.stability.evidence

    @property
    def content(self) -> Content | None:
        """Digests of all that the bound is about; None if its constants were stated."""
        own, sizes = self.stability.content, self.sizes
        return None if own is None else own.on(
            self.region, disturbance=sizes.disturbance, noise=sizes.noise
        )

    @property
    def rate(self) -> float:
        """rho, an upper bound on the factor per step in the norm of `metric`.

        One rho serves both inequalities, and a smaller limit may take a larger rho: the error may
        contract much faster.
        """
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

    def of_observer(
        self, observer: Observer, system: System, projection_metric: str = "observer"
    ) -> ObserverBound:
        """The same for an observer with this gain, or a `MismatchError`; its metric may differ."""
        gain = gain_if_constant(observer, system)
        if gain is None or not np.array_equal(gain, self.gain):
            theirs = "not constant" if gain is None else str(gain.tolist())
            raise MismatchError(
                f"the bound is of an observer with the gain {self.gain.tolist()}; the estimator's "
                f"is {theirs}. Certify the estimator's observer."
            )
        own = projection_metric == "observer"
        return replace(self, projection=observer.metric if own else None)

    @cached_property
    def _inverse(self) -> Array:
        """A matrix G with P^-1 <= G, as P <= P G P."""
        scale = np.exp2(-np.round(0.5 * np.log2(self.metric.diagonal())))  # without rounding
        units = np.outer(scale, scale)
        P = Matrices.exact((units * self.metric)[None])
        guess = np.linalg.inv(P.middle[0])
        for slack in _SLACKS:
            G = 0.5 * (1.0 + slack) * (guess + guess.T)
            if definite(P @ Matrices.exact(G[None]) @ P - P)[0]:
                return units * G
        return np.full_like(guess, np.nan)  # no number follows

    @cached_property
    def slopes(self) -> Array:
        """The roots of P^-1's diagonal, (n,): |e_i| <= slopes[i] |e|_P, rounded outward."""
        slopes: Array = np.sqrt(self._inverse.diagonal()) * OUTWARD
        return slopes

    @cached_property
    def _longest(self) -> float:
        """The largest |e| where |e|_P = 1, rounded up."""
        return float(lengths_of("length", 1.0, self._inverse))

    def length(self, errors: ArrayLike) -> Array:
        """|e|_P of errors (..., n), rounded up."""
        return weighted_lengths(numbers("errors", errors), self.metric)

    def initial(self, error: Size) -> float:
        """b(0) from x(0) - z(0): a vector (n,), a bound on its length, or a set that holds it."""
        return initial_length(error, self.metric)

    def entering(self, disturbances: Size | None = None, noises: Size | None = None) -> Array:
        """What w and v add to the bound, always (2,) or at each sample (T, 2): see `advanced`."""
        W, V, Q, R = self.stability.entry, self.stability.V, self.stability.Q, self.stability.R
        assert W is not None
        assert V is not None
        w = self.sizes.disturbance if disturbances is None else disturbances
        v = self.sizes.noise if noises is None else noises
        first, second = lengths_of("disturbances", w, W), lengths_of("noises", v, V)
        if first.ndim and second.ndim and len(first) != len(second):
            raise ShapeError(
                f"disturbances has {len(first)} samples, and noises {len(second)}; expected the "
                "same."
            )
        if self.stability.room is not None:
            _check_wrapping(extent_of("noises", v, len(V)), self.stability.room)
        length = np.asarray(first + second)
        root = np.full(length.shape, np.inf)
        if Q is not None and R is not None:
            root = np.hypot(lengths_of("disturbances", w, Q), lengths_of("noises", v, R))
        return np.stack((length, root), axis=-1) * OUTWARD

    def radii(
        self, steps: int, initial_error: Size, disturbances: Size | None = None,
        noises: Size | None = None,
    ) -> Array:
        """b(0), ..., b(T), (T + 1,), from the arguments of `along`."""
        entering, steps = self.entering(disturbances, noises), count("steps", steps, 0)
        if entering.ndim > 1 and len(entering) != steps:
            raise ShapeError(
                f"disturbances and noises have {len(entering)} samples; expected {steps}."
            )
        found = np.empty(steps + 1)
        found[0] = self.initial(initial_error)
        for t, added in enumerate(np.broadcast_to(entering, (steps, 2)).tolist()):
            found[t + 1] = self.advanced(found[t], added)
        return found

    def advanced(self, radius: float, entering: ArrayLike) -> float:
        """b(t+1) from b(t), rounded up: rho b + |w|_W + |v|_V or the root of squares, if less."""
        length, root = map(float, np.asarray(entering))
        reached = self.rate * radius
        return min(reached + length, math.hypot(reached, root)) * OUTWARD

    def limit(self, disturbances: Size | None = None, noises: Size | None = None) -> float:
        """The limit of b(t) as t grows, for bounds on w and v that hold at all times."""
        entering = self.entering(disturbances, noises)
        if entering.ndim > 1:
            raise OptionError(
                "disturbances and noises are given sample by sample; expected bounds for all times."
            )
        (length, root), rate = map(float, entering), self.rate * OUTWARD
        return min(length / (1.0 - rate), root / math.sqrt(1.0 - rate * rate)) * OUTWARD

    def components(self, radius: ArrayLike) -> Array:
        """Upper bounds on |x_i - z_i| where |x - z|_P <= radius: (..., n) for (...)."""
        return np.multiply.outer(numbers("radius", radius, finite=False), self.slopes) * OUTWARD

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
        r"""Upper bound on the distance from x_hat to the points of the set around z, (...).

        With the offset :math:`o = \hat x - z` (..., n), the radius b and the longest half axis a of
        the set for b = 1,

        .. math::
            |o - e|^2 \le |o|^2 + 2 b |o|_{P^{-1}} + b^2 a^2 .

        With the observer's state z (..., n), only what is within the region counts.
        """
        b, o = np.asarray(radius, np.float64), np.asarray(offset, np.float64)
        across = b * weighted_lengths(o, self._inverse)
        squares = np.sum(o * o, axis=-1) + 2.0 * across + (b * self._longest) ** 2
        found: Array = np.sqrt(squares) * OUTWARD**2
        if observer is not None:
            z = np.asarray(observer, np.float64)
            lower, upper = self.around(b, z)
            away = np.maximum(np.abs(z + o - lower), np.abs(upper - z - o))
            found = np.minimum(found, np.linalg.norm(away, axis=-1) * OUTWARD)
        return found

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
            w(t) and v(t) as (T, r) and (T, p), or bounds for all times: a number for the length or
            a set, such as ``qpmhe.Box``. Left out, `sizes`.
        initial_error : float, (n,) array_like or set
            x - z at the run's first sample, a bound on its length, or a set that holds it.

        Raises
        ------
        ShapeError, OptionError, SetError, InvalidInputError
            If an argument does not fit.
        MismatchError
            If the run's estimator is known, and has another gain or another system: see
            `ObserverStability.difference`. At the run's states, values of f and h are compared
            with those of the certified system, too.
        """
        if not isinstance(run, Run):
            raise InvalidInputError(
                f"run is of type {type(run).__name__}; expected a qpmhe.Run, as "
                "MovingHorizonEstimator.run returns it."
            )
        z, source, own = run.observer_states, run.source, self
        inputs, steps, usual = None, None, None
        if source is not None:
            own = self.of_observer(
                source.observer, source.system, source.settings.projection_metric
            )
            inputs, steps, usual = source.inputs, source.steps, source.system.dt
            _check_model(self.stability, self.region, source.system, z[:-1], inputs)
        radius = self.radii(len(run), initial_error, disturbances, noises)
        lost, reason = own.first_event(run.flags, z[:-1], inputs, steps, usual)
        empty = self.is_empty(radius[1:], z[1:])
        if empty.any() and (lost is None or empty.argmax() < lost):
            lost, reason = int(empty.argmax()), CONTRADICTION
        if source is not None and source.settings.candidate != "observer":
            lost, reason = 0, REINITIALIZED
        if lost is not None:
            radius[lost + 1 :] = np.nan
        error = self.farthest(radius, run.states - z, z)
        return Band(radius, *self.around(radius, z), error, lost, reason)

    def first_event(
        self, flags: NDArray[np.integer[Any]], observer: Array, inputs: Array | None = None,
        steps: ArrayLike | None = None, usual: float | None = None,
    ) -> tuple[int | None, str]:
        """The first sample after which the bound does not follow, and why.

        From values of the statuses (T,), z(0), ..., z(T-1), inputs (T, m), and lengths of the
        steps (T,) beside the one that is certified.
        """
        events = _EVENTS if self.projects else _EVENTS | {Status.OBSERVER_PROJECTED: _PROJECTED}
        where: list[tuple[Any, str, Any]] = [
            ((flags & flag.value) != 0, text, flags) for flag, text in events.items()
        ]
        outside = "the observer was outside of the region, at {}"
        where.append((~self.region.contains(observer), outside, observer))
        if inputs is not None:
            low, high = self.region.lower[self.region.n :], self.region.upper[self.region.n :]
            beyond = ~((low <= inputs) & (inputs <= high)).all(axis=1)
            where.append((beyond, "the input {} is outside of what was certified", inputs))
        if steps is not None:
            text = f"the step had the length {{}}, and {usual or 0.0:.6g} is certified"
            where.append((np.asarray(steps) != usual, text, np.asarray(steps)))
        first = [(int(there.argmax()), *rest) for there, *rest in where if there.any()]
        if not first:
            return None, ""
        t, text, values = min(first, key=itemgetter(0))
        return t, text.format(np.round(values[t], 6).tolist())

    def is_empty(self, radius: ArrayLike, observer: Array) -> NDArray[np.bool_]:
        """Whether no state of the region is in the set around z."""
        lower, upper = self.around(radius, observer)
        return np.asarray(np.any(lower > upper, axis=-1))

    @property
    def _widths(self) -> Array:
        n = self.region.n
        return self.region.upper[:n] - self.region.lower[:n]

    @property
    def settling_samples(self) -> int | None:
        """Samples until b(t) is within 10 % of its limit, from anywhere; None where that is 0."""
        radius, limit = self.initial(Box(-self._widths, self._widths)), self.limit()
        if not limit > 0.0:
            return None
        entering, samples = self.entering(), 0
        while radius > (1.0 + _SETTLED) * limit and samples < _MOST_SAMPLES:
            radius, samples = self.advanced(radius, entering), samples + 1
        return samples

    @property
    def headline(self) -> str:
        """The bound in the limit, in the states' units, and how soon it is reached, in one line."""
        limit, after = self.components(self.limit()), self.settling_samples
        each = ", ".join(f"|x{i + 1} - z{i + 1}| <= {at_most(b, 3)}" for i, b in enumerate(limit))
        when = f" and at most 10 % more from sample {after} on" if after else ""
        wide = " x ".join(f"{width:.3g}" for width in self._widths)
        vacuous = ", ".join(f"x{i + 1}" for i in np.flatnonzero(limit >= self._widths))
        nothing = f": it says nothing about {vacuous}" if vacuous else ""
        stays = self.invariance is not None and self.invariance.holds
        how = f"{self.evidence}{'' if stays else ' while x stays in the region'}"
        return f"{each} in the limit{when} ({how}), on a region {wide} wide{nothing}"

    @property
    def condition(self) -> str:
        """Whether state and observer stay in the region, in words."""
        if self.inner is not None:
            n, place = self.region.n, self.inner.region
            start = intervals("x", place.lower[:n], place.upper[:n])
            return (
                f"x and z stay in the region (proved) from {start} on, if the initial error is at "
                "most the limit"
            )
        found = "x stays in the region (proved)"
        if self.invariance is None or not self.invariance.holds:
            why = "" if self.invariance is None else f": {self.invariance}"
            found = f"it is not proved that x stays in the region{why}"
        return f"{found}; z is checked at each sample"

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows."""
        names = ("evidence", "rate", "metric", "gain", "sizes", "condition", "invariance")
        limit = self.limit()
        content: dict[str, Any] = json_ready({name: getattr(self, name) for name in names} | {
            "limit": limit, "components": self.components(limit),
            "length": self.farthest(limit, np.zeros(len(self.gain))),
        })
        return content


def bound_observer(
    system: System, observer: Observer, cost: Cost, region: ConvexSet | Region | None = None, *,
    inputs: Box | None = None, sizes: Sizes | None = None,
    seconds: float | Deadline = PART_SECONDS,
) -> ObserverBound:
    """Certify the observer alone: the first part of `certify`, with the same arguments."""
    place, given = bounded_region(system, region, inputs), Sizes.of(sizes, system, cost)
    deadline = Deadline.of(seconds)
    stability = certify_observer(
        system, observer, place, sizes=given.typical, seconds=deadline.part(_CONTRACTION)
    )
    return with_invariance(
        ObserverBound(stability, place, given, observer.metric), system, deadline
    )


def with_invariance(
    bound: ObserverBound, system: System, seconds: float | Deadline
) -> ObserverBound:
    """The bound, with the findings on whether state and observer stay in the region."""
    deadline, size, inner = Deadline.of(seconds), bound.sizes.extent[0], None
    found = certify_invariance(
        system, bound.region, disturbance=size, seconds=deadline.part(_INVARIANCE)
    )
    region = inner_region(bound.region, bound.metric, bound.limit())
    if region is not None:
        inner = certify_invariance(system, region, disturbance=size, seconds=deadline)
    kept = inner is not None and inner.holds
    return replace(bound, invariance=found, inner=inner if kept else None)


def initial_length(error: Size, weight: Array) -> float:
    """|e|_W from an initial error: a vector (n,), a bound on its length, or a set that holds it."""
    found = lengths_of("initial_error", error, weight)
    if found.ndim:
        raise ShapeError("initial_error has several samples; expected the error at the first one.")
    return float(found)


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


def _check_wrapping(largest: Array, room: Array) -> None:
    """Refuse noises of angles with which an innovation may wrap."""
    if not (largest < room).all():
        j = int(np.argmax(largest - room))
        raise OptionError(
            f"the noise of the angle y[{j}] is up to {largest[j]:.6g}; expected less than "
            f"{room[j]:.6g}, so that no innovation wraps in the region. Certify a smaller region "
            "for a larger noise."
        )


def _check_model(
    stability: ObserverStability, region: Region, used: System, states: Array, inputs: Array | None
) -> None:
    """Refuse a run of another model: by certified values, and at the run's states by the system."""
    certified = stability.system
    for who, system in (("the system", certified), ("the run's system", used)):
        # Values of functions without an expression are compared at all states of the run below.
        changed = "" if system is None else stability.difference(system, certified is not None)
        if changed:
            raise MismatchError(
                f"{who} is another than was certified: {changed}; certify the system of the run."
            )
    points = np.hstack((states, np.zeros((len(states), 0)) if inputs is None else inputs))
    low, high, n = region.lower[region.n :], region.upper[region.n :], region.n
    # Elsewhere the bound ends, and the model need not be defined.
    usual = ((low <= points[:, n:]) & (points[:, n:] <= high)).all(axis=1)
    times = np.flatnonzero(region.contains(states) & usual)
    if certified is None or not times.size:
        return
    points = points[times]
    for name in ("f", "h"):
        mine, other = (
            evaluated(name, getattr(one, name), points, n) for one in (certified, used)
        )
        # Of each component's own unit.
        size = np.abs(mine).max(axis=0)
        if name == "f":
            size = np.maximum(size, np.abs(points[:, :n]).max(axis=0))
        same = (np.abs(mine - other) <= SAME_MODEL * size).all(axis=1)
        if not same.all():
            k = int(same.argmin())
            raise MismatchError(
                f"{name} of the run's system is {other[k].tolist()} at sample {times[k]}, and that "
                f"of the certified one {mine[k].tolist()}; certify the system of the run."
            )
