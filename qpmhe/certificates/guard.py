r"""An output map that moves estimates into the set that is proved to hold the true state.

The true state is in :math:`S = \{\xi \in K : |\xi - z|_P \le b\}`, with K the box of the
components, the region and X. An estimate outside of S is replaced by the point of S nearest to it
in P: with a multiplier :math:`\lambda \ge 0` of the ball, it is the projection onto K of

.. math::
    (\hat x + \lambda z) / (1 + \lambda), \qquad
    |\xi - \hat x|_P^2 + \lambda |\xi - z|_P^2
    = (1 + \lambda) \left| \xi - \frac{\hat x + \lambda z}{1 + \lambda} \right|_P^2
    + \frac{\lambda}{1 + \lambda} |\hat x - z|_P^2 ,

whose distance from z decreases with :math:`\lambda`. So two points of S, the guarded estimate and
the truth, are at most 2 b apart.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .._checks import Array
from ..codegen.guard import GuardForm
from ..estimation.estimator import MovingHorizonEstimator
from ..model.sets import ConvexSet
from ..model.system import System
from ..observers.projection import NearestPoint
from .evidence import CertificateError, Evidence
from .observer_bound import ObserverBound
from .sizes import OUTWARD, UNIT, Sizes, weighted_lengths
from .tube import Tube

# Of a written guard: how many samples have bounds of their own at most, and when they end: once the
# bounds are so close to their limits, as shares of these, and change so little.
_MOST_SAMPLES, _CLOSE, _LITTLE = 1000, 0.01, 1e-3
# Halvings of the interval in which 1 / (1 + lambda) is; and from how many radii on only the
# direction of an estimate counts: rounding of a distance would be of the set's size.
_HALVINGS, _FAR = 64, 1e6
_EMPTY = (
    "no state was found in the set around the observer: the disturbances, the noises or the "
    "initial error were larger than stated, or the model is another one"
)


class Guarded(NamedTuple):
    """An estimate within the set, whether it was moved, and why there is none."""

    point: Array
    acted: bool
    reason: str = ""


class Guard:
    """Moves estimates into the set around the observer.

    Parameters
    ----------
    bound : ObserverBound
        The proved bound.
    system : System
        The estimator's system, of which X counts as well.
    """

    def __init__(self, bound: ObserverBound, system: System) -> None:
        self._bound = bound
        self._covariance: Array = np.asarray(np.linalg.inv(bound.metric), np.float64)
        region = bound.region.states
        self._states = region if system.states is None else region & system.states
        self._in_states = NearestPoint(self._states).contains

    def c_form(self, sizes: Sizes, tube: Tube) -> GuardForm:
        """Its numbers for written C, with the bounds in advance from a first one on."""
        bound, region = self._bound, self._bound.region
        # And behind the first projection, of an observer that is projected in P.
        kinds = [
            tubes_in_advance(bound, sizes, tube, projected=each)
            for each in ((False, True) if bound.projects else (False,))
        ]
        count = max(map(len, kinds))
        kinds = [each + each[-1:] * (count - len(each)) for each in kinds]
        initial = ", ".join(f"|e{i + 1}| <= {b:.4g}" for i, b in enumerate(tube.box))
        return GuardForm(
            bound.metric, self._covariance, bound.gain, region.lower, region.upper,
            region.states, self._states, np.array([[one.radius for one in each] for each in kinds]),
            np.array([[one.box for one in each] for each in kinds]),
            f"{Sizes(sizes.disturbance, sizes.noise)}; {initial}, "
            f"|e|_P <= {tube.radius:.4g} with P = mhe_guard_metric",
        )

    def __call__(self, estimate: Array, observer: Array, tube: Tube) -> Guarded:
        """The estimate itself if it is in the set; else the nearest point that is."""
        with np.errstate(all="ignore"):  # an estimate may be so far away that its square overflows
            return self._guarded(estimate, observer, tube)

    def _guarded(self, estimate: Array, observer: Array, tube: Tube) -> Guarded:
        if self._holds(estimate, observer, tube) and self._in_states(estimate):
            return Guarded(estimate, False)
        K = self._states
        # A little narrower, so that points on its sides are in the box in spite of rounding.
        box = np.maximum((1.0 - 64.0 * UNIT) * tube.box - 4.0 * UNIT * np.abs(observer), 0.0)
        near = ConvexSet(
            np.maximum(K.lower, observer - box), np.minimum(K.upper, observer + box), K.matrix,
            K.row_lower, K.row_upper,
        )
        if (near.lower > near.upper).any():
            return Guarded(estimate, False, _EMPTY)
        nearest = NearestPoint(near)
        away = estimate - observer
        largest = np.abs(away).max()
        length = float(weighted_lengths(away / largest, self._bound.metric))
        share = _FAR * tube.radius / largest / length
        if share < 1.0:
            estimate = observer + share * away
        # The largest share of the way from z of which the projection is in S.
        found = self._moved(nearest, estimate, observer, 1.0, tube)
        if found is not None:
            return Guarded(found, True)
        best = self._moved(nearest, estimate, observer, 0.0, tube)
        if best is None:
            return Guarded(estimate, False, _EMPTY)
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            found = self._moved(nearest, estimate, observer, middle, tube)
            low, high = (low, middle) if found is None else (middle, high)
            best = best if found is None else found
        return Guarded(best, True)

    def _moved(
        self, nearest: NearestPoint, estimate: Array, observer: Array, share: float, tube: Tube
    ) -> Array | None:
        """The projection of a point between, if it is in the set."""
        target = observer + share * (estimate - observer) if 0.0 < share < 1.0 else (
            estimate if share else observer
        )
        found = target if nearest.contains(target) else nearest(target, self._covariance).point
        return found if self._holds(found, observer, tube) and self._in_states(found) else None

    def _holds(self, point: Array, observer: Array, tube: Tube) -> bool:
        """Whether a point is in ball and box, with distances rounded up."""
        difference = point - observer
        rounding = UNIT * np.abs(difference)
        length = weighted_lengths(difference, self._bound.metric) + weighted_lengths(
            rounding, np.abs(self._bound.metric)
        )
        inside = (np.abs(difference) + rounding) * OUTWARD <= tube.box
        return bool(length * OUTWARD <= tube.radius and inside.all())


def tubes_in_advance(
    bound: ObserverBound, sizes: Sizes, tube: Tube, *, projected: bool
) -> list[Tube]:
    """The bounds at the first samples; the last of them holds at all later ones, too.

    A step of the tube is larger for a larger one. So what a step makes no larger holds at all
    times from where it first contains the tube.
    """
    given = sizes.disturbance, sizes.noise
    entering, added = bound.entering(*given), bound.added(*given)

    def after(one: Tube) -> Tube:
        return bound.followed(one, entering, added, projected=projected)

    def within(one: Tube, other: Tube) -> bool:
        sides = zip(one[1:], other[1:], strict=True)
        return one.radius <= other.radius and all((low <= high).all() for low, high in sides)

    def largest(one: Tube, other: Tube) -> Tube:
        return Tube(max(one.radius, other.radius), *map(np.maximum, one[1:], other[1:]))

    def lasting(one: Tube) -> Tube:
        """One that contains it and that a step makes no larger; by the ball, if no other."""
        made = Tube(one.radius * (1.0 + _CLOSE), *((1.0 + _CLOSE) * each for each in one[1:]))
        return made if within(after(made), made) else bound.tube(made.radius)

    last, found = bound.tube(bound.limit(*given)), [tube]
    for _ in range(_MOST_SAMPLES):
        reached = after(last)
        last = Tube(last.radius, *map(np.minimum, last[1:], reached[1:]))
    last = lasting(last)
    while len(found) < _MOST_SAMPLES:
        tube = after(found[-1])
        same = abs(tube.radius - found[-1].radius) <= _LITTLE * tube.radius
        same &= bool((np.abs(tube.box - found[-1].box) <= _LITTLE * tube.box).all())
        if same and within(found[-1], last):
            break
        found.append(tube)
    if not within(found[-1], last):
        last = lasting(largest(last, found[-1]))
    return [*found, last]


def check_guarded(bound: ObserverBound, estimator: MovingHorizonEstimator, sizes: Sizes) -> None:
    """Raise a `CertificateError` where no number is proved for guarded estimates in advance."""
    settings, system = estimator.settings, estimator.system
    for refused, text in (
        (bound.evidence is not Evidence.PROVED,
         f"the observer's bound is {bound.evidence}, not proved"),
        (sizes.deviations,
         f"the sizes are {sizes.source}, and Gaussian noises are not bounded; state bounds, "
         "sizes=Sizes(disturbance=..., noise=...), or --max-disturbance and --max-noise"),
        (settings.candidate != "observer",
         "candidate='reinitialized' restarts the observer at each sample"),
        (settings.restart, "restart=True restarts the observer from estimates"),
        (settings.infeasible == "restore",
         "infeasible='restore' may leave the cost above the candidate's"),
        (system.constraints is not None,
         "the system has nonlinear constraints, whose set need not be convex"),
        (system.state_residual is not None,
         "the system has angles among its states, which are no convex set"),
    ):
        if refused:
            raise CertificateError(f"there is no guard: {text}.")
