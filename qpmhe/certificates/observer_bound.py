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
from dataclasses import dataclass, field, replace
from functools import cached_property
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
from .events import CONTRADICTION, REINITIALIZED, check_model, first_event
from .evidence import Evidence, MismatchError, json_ready
from .faces import Faces
from .headline import condition, headline
from .inequalities import Matrices, definite
from .invariance import Invariance, certify_invariance, inner_region
from .norms import SLACKS, initial_length
from .properties import ObserverStability
from .regions import Region, beyond, bounded_region
from .rowwise import RowwiseStep
from .sizes import (
    OUTWARD,
    UNIT,
    Size,
    Sizes,
    extent_of,
    lengths_of,
    weighted_lengths,
)
from .tube import Band, Tube, across

# How close to its limit the bound is when it is called settled, and in how many samples at most.
_SETTLED, _MOST_SAMPLES = 0.1, 10**6
# Of each component: how many steps its limit may take, and by how little they change at the end.
_MOST_STEPS, _LITTLE = 3000, 1e-5
# How much of the time is for the contraction, of the rest for the components' step, and of what
# that leaves for the region itself.
_CONTRACTION, _ROWS, _INVARIANCE = 0.8, 0.5, 0.6


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
    rowwise : RowwiseStep or None
        The step of each component's bound, where it is known.
    """

    stability: ObserverStability
    region: Region
    sizes: Sizes
    projection: Array | None = None
    invariance: Invariance | None = None
    inner: Invariance | None = None
    rowwise: RowwiseStep | None = field(default=None, repr=False)

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

    def with_rows(self, system: System, seconds: float | Deadline = math.inf) -> ObserverBound:
        """The same with the step of its components, of the certified system."""
        faces, X = None, system.states
        if X is not None:
            faces = Faces(X, self.region, self.metric, self.slopes, self.limit())
        rows = RowwiseStep(system, self.region, self.gain, self._inverse, seconds, faces)
        return replace(self, rowwise=rows)

    @cached_property
    def _inverse(self) -> Array:
        """A matrix G with P^-1 <= G, as P <= P G P."""
        scale = np.exp2(-np.round(0.5 * np.log2(self.metric.diagonal())))  # without rounding
        units = np.outer(scale, scale)
        P = Matrices.exact((units * self.metric)[None])
        guess = np.linalg.inv(P.middle[0])
        for slack in SLACKS:
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

    def added(self, disturbances: Size | None = None, noises: Size | None = None) -> Array:
        """What w and v add to each component, always (n,) or at each sample (T, n).

        And, of a system with an X, along the directions of its `Faces`, behind them.
        """
        w = self.sizes.disturbance if disturbances is None else disturbances
        v = self.sizes.noise if noises is None else noises
        if self.rowwise is None:
            return np.full(self.region.n, np.inf)
        return self.rowwise.added(w, v)

    def begun(self, error: Size) -> Tube:
        """The bounds at first, from x(0) - z(0) as in `initial`."""
        radius = self.initial(error)
        extent = extent_of("initial_error", error, self.region.n)
        return self.tube(radius, np.minimum(extent * OUTWARD, self.components(radius)))

    def tube(self, radius: float, box: Array | None = None) -> Tube:
        """Bounds on |x - z|_P and on its components, of the ball if left out."""
        box = self.components(radius) if box is None else box
        faces = self._faces
        return Tube(radius, box) if faces is None else Tube(radius, box, faces.oblique(box))

    @property
    def directions(self) -> Array:
        """Those (r, n) along which a `Tube` has bounds, too."""
        return np.zeros((0, self.region.n)) if self._faces is None else self._faces.directions

    @property
    def _faces(self) -> Faces | None:
        return None if self.rowwise is None else self.rowwise.faces

    def followed(
        self, tube: Tube, entering: ArrayLike, added: Array, *, projected: bool,
        observer: Array | None = None, u: Array | None = None,
    ) -> Tube:
        """The bounds one sample later, with the observer in the region, whose state may be given.

        Where it is ``projected``, |e_i| may have grown though |e|_P has not.
        """
        return self._after(
            tube, self.advanced(tube.radius, entering), added, projected, observer, u
        )

    def _after(
        self, tube: Tube, radius: float, added: Array, projected: bool,
        observer: Array | None = None, u: Array | None = None,
    ) -> Tube:
        """The bounds one sample later, from those now and a bound on |x - z|_P then."""
        if self.rowwise is None:
            return self.tube(radius)
        now = tube._replace(box=np.minimum(tube.box, self.widths * OUTWARD))
        reached = (self.rowwise.step(now, observer, u) + added) * OUTWARD
        n, faces = self.region.n, self.rowwise.faces
        reached[:n] = np.minimum(reached[:n], self.components(radius))
        radius = min(radius, across(reached[:n], self.metric))
        box, oblique = reached[:n], reached[n:]
        if projected:
            ball = self.components(radius)
            box, oblique = (ball, oblique[:0]) if faces is None else (
                faces.projected(reached, radius)
            )
        if faces is not None:
            oblique = np.minimum(oblique, faces.oblique(box))
        return Tube(radius, box, oblique)

    @property
    def unprojected(self) -> bool:
        """Whether the observer is shown never to be projected onto X, if the `condition` holds."""
        return self.begins_within or not self._reaches_faces

    @property
    def _reaches_faces(self) -> bool:
        """Whether a face of X may be active in the limit, for all states of the region."""
        system = self.stability.system
        if system is None or system.states is None:
            return system is None
        return self._faces is None or self._faces.reached

    @property
    def begins_within(self) -> bool:
        """Whether `settled` needs an initial error within the limit of |x - z|_P.

        Where it rests on an inner region, around which the observer is not projected.
        """
        system = self.stability.system
        if self.inner is None or system is None or system.states is None or (
            not self._reaches_faces
        ):
            return False
        X = Region(system.states, system.states.lower, system.states.upper)
        states = Region(self.region.states, *(
            each[: system.n] for each in (self.region.lower, self.region.upper)
        ))
        return not beyond(states, X)

    @cached_property
    def settled(self) -> Tube:
        """The limit of the bounds as t grows, for `sizes` at all times.

        Each step of the tube increases with the tube: its limit superior is at most what a step
        makes of it, and so at most what any number of steps make of a larger one.
        """
        radius = self.limit()
        tube = self.tube(radius, np.minimum(self.components(radius), self.widths * OUTWARD))
        return self._iterated(tube, _MOST_STEPS)[0]

    def _iterated(self, tube: Tube, most: int, until: Array | None = None) -> tuple[Tube, int]:
        """Steps of a tube that holds at all times, up to a box or until they change little."""
        added, projected = self.added(), not self.unprojected
        for k in range(most):
            if self.rowwise is None or (until is not None and (tube.box <= until).all()):
                return tube, k
            following = self._after(tube, tube.radius, added, projected)
            box = np.minimum(tube.box, following.box)
            little = _LITTLE if until is None else 0.0
            if (box >= (1.0 - little) * tube.box).all():
                return following._replace(box=box), k
            tube = following._replace(box=box)
        return tube, most

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

    def around(
        self, radius: ArrayLike, observer: Array, box: Array | None = None
    ) -> tuple[Array, Array]:
        """Sides (..., n) of a box that holds the true state: around z, and within the region.

        From |x - z|_P <= radius, and |x_i - z_i| <= box[..., i] where it is given.
        """
        half = self.components(radius)
        if box is not None:
            half = np.minimum(half, box)
        n = self.region.n
        margin = UNIT * (np.abs(observer) + half)
        return (
            np.maximum(observer - half - margin, self.region.lower[:n]),
            np.minimum(observer + half + margin, self.region.upper[:n]),
        )

    def farthest(
        self, radius: ArrayLike, offset: ArrayLike, observer: ArrayLike | None = None,
        box: Array | None = None,
    ) -> Array:
        r"""Upper bound on the distance from x_hat to the points of the set around z, (...).

        With the offset :math:`o = \hat x - z` (..., n), the radius b and the longest half axis a of
        the set for b = 1,

        .. math::
            |o - e|^2 \le |o|^2 + 2 b |o|_{P^{-1}} + b^2 a^2 .

        With the observer's state z (..., n), only what is within the region and the box counts.
        """
        b, o = np.asarray(radius, np.float64), np.asarray(offset, np.float64)
        across = b * weighted_lengths(o, self._inverse)
        squares = np.sum(o * o, axis=-1) + 2.0 * across + (b * self._longest) ** 2
        found: Array = np.sqrt(squares) * OUTWARD**2
        if observer is not None:
            z = np.asarray(observer, np.float64)
            lower, upper = self.around(b, z, box)
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
            check_model(self.stability, self.region, source.system, z[:-1], inputs)
        radius, box = self._tubes(run, inputs, disturbances, noises, initial_error)
        lost, reason = own.first_event(run.flags, z[:-1], inputs, steps, usual)
        empty = self.is_empty(radius[1:], z[1:], box[1:])
        if empty.any() and (lost is None or empty.argmax() < lost):
            lost, reason = int(empty.argmax()), CONTRADICTION
        if source is not None and source.settings.candidate != "observer":
            lost, reason = 0, REINITIALIZED
        if lost is not None:
            radius[lost + 1 :] = box[lost + 1 :] = np.nan
        error = self.farthest(radius, run.states - z, z, box)
        return Band(radius, *self.around(radius, z, box), error, lost, reason)

    def _tubes(
        self, run: Run, inputs: Array | None, disturbances: Size | None, noises: Size | None,
        initial_error: Size,
    ) -> tuple[Array, Array]:
        """Radii (T + 1,) and boxes (T + 1, n) along a run, as far as its observer is in the region.

        Beyond, they are those of the ball alone, and do not count.
        """
        z, steps = run.observer_states, len(run)
        radius = self.radii(steps, initial_error, disturbances, noises)
        box = self.components(radius)
        entering = np.broadcast_to(self.entering(disturbances, noises), (steps, 2))
        added = self.added(disturbances, noises)
        added = np.broadcast_to(added, (steps, added.shape[-1]))
        within = np.append(self.region.contains(z[:-1]), False)
        projected = (run.flags & Status.OBSERVER_PROJECTED.value) != 0
        tube = self.begun(initial_error)
        for t in range(steps + 1):
            radius[t], box[t] = tube.radius, tube.box
            if not within[t]:
                break
            tube = self.followed(
                tube, entering[t], added[t], projected=bool(projected[t]), observer=z[t],
                u=None if inputs is None else inputs[t],
            )
        return radius, box

    def first_event(
        self, flags: NDArray[np.integer[Any]], observer: Array, inputs: Array | None = None,
        steps: ArrayLike | None = None, usual: float | None = None,
    ) -> tuple[int | None, str]:
        """The first sample after which the bound does not follow, and why.

        From values of the statuses (T,), z(0), ..., z(T-1), inputs (T, m), and lengths of the
        steps (T,) beside the one that is certified.
        """
        return first_event(
            self.region, self.projects, flags, observer, inputs, steps, usual
        )

    def is_empty(
        self, radius: ArrayLike, observer: Array, box: Array | None = None
    ) -> NDArray[np.bool_]:
        """Whether no state of the region is in the set around z."""
        lower, upper = self.around(radius, observer, box)
        return np.asarray(np.any(lower > upper, axis=-1))

    @property
    def widths(self) -> Array:
        """The region's widths, (n,)."""
        n = self.region.n
        return self.region.upper[:n] - self.region.lower[:n]

    @property
    def settling_samples(self) -> int | None:
        """Samples until the bounds are within 10 % of their limit, from anywhere.

        From an initial error within the limit where the bound `begins_within` it. None where the
        limit is 0, or it takes too many steps.
        """
        radius, limit = self.initial(Box(-self.widths, self.widths)), self.limit()
        if not limit > 0.0:
            return None
        rows = self.rowwise is not None
        entering, samples, room = self.entering(), 0, 0.5 * _SETTLED if rows else _SETTLED
        # While the ball is larger than its limit, it may reach faces that the limit does not reach.
        faces = self._faces if self.unprojected else None
        if self.begins_within:
            radius, faces = limit, None
        while samples < _MOST_SAMPLES and (
            radius > (1.0 + room) * limit or (faces is not None and faces.may_act(radius))
        ):
            radius, samples = self.advanced(radius, entering), samples + 1
        if faces is not None and faces.may_act(radius):
            return None
        if not rows:
            return samples
        # Then the components, which follow the radius.
        box = np.minimum(self.components(radius), self.widths * OUTWARD)
        until = (1.0 + _SETTLED) * self.settled.box
        reached, after = self._iterated(self.tube(radius, box), _MOST_STEPS, until)
        return samples + after if (reached.box <= until).all() else None

    @property
    def headline(self) -> str:
        """The bounds on the observer and on estimates, in the states' units, in one line."""
        return headline(self)

    @property
    def condition(self) -> str:
        """Whether state and observer stay in the region, in words."""
        return condition(self)

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows."""
        names = ("evidence", "rate", "metric", "gain", "sizes", "condition", "invariance")
        limit = self.limit()
        content: dict[str, Any] = json_ready({name: getattr(self, name) for name in names} | {
            "limit": limit, "components": self.settled.box,
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
    """The bound, with the findings on whether state and observer stay in the region.

    And with the step of its components.
    """
    deadline, size, inner = Deadline.of(seconds), bound.sizes.extent[0], None
    bound = bound.with_rows(system, deadline.part(_ROWS))
    found = certify_invariance(
        system, bound.region, disturbance=size, seconds=deadline.part(_INVARIANCE)
    )
    region = inner_region(bound.region, bound.metric, bound.limit())
    if region is not None:
        inner = certify_invariance(system, region, disturbance=size, seconds=deadline)
    kept = inner is not None and inner.holds
    return replace(bound, invariance=found, inner=inner if kept else None)


def _check_wrapping(largest: Array, room: Array) -> None:
    """Refuse noises of angles with which an innovation may wrap."""
    if not (largest < room).all():
        j = int(np.argmax(largest - room))
        raise OptionError(
            f"the noise of the angle y[{j}] is up to {largest[j]:.6g}; expected less than "
            f"{room[j]:.6g}, so that no innovation wraps in the region. Certify a smaller region "
            "for a larger noise."
        )
