"""At run time: a bound on the error of each estimate, and the sample at which it ends."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, flag, positive, vector
from ..codegen.guard import GuardForm
from ..errors import InvalidInputError
from ..estimation.estimate import Estimate, Status
from ..estimation.estimator import MovingHorizonEstimator
from ..model.model import Model
from ..terms.hold import Hold
from ..terms.sum import further_terms
from .certificate import Certificate
from .content import Content
from .events import CONTRADICTION, REINITIALIZED
from .evidence import MismatchError
from .guard import Guard, check_guarded
from .measured_cost import MeasuredCost
from .norms import largest_ratio
from .observer_bound import ObserverBound
from .sizes import Size, Sizes
from .tube import Tube

_RELATIVE = 1e-6
_UNITS = 8.0 * float(np.finfo(np.float64).eps)
# What rounding may make of one step of the observer, as a share of what it sums up.
_ROUNDING = 1e-9
_MOVED = (
    "the observer's state before was changed, by a late measurement (amend), by set or by a "
    "sample's own bounds"
)
_NO_GUARD = "the monitor has no guard"
_UNDEFINED = "the model could not be evaluated"
_RESTORED = (
    "the candidate violated a set and was restored into it (RESTORED): the estimate's cost may be "
    "above the candidate's"
)


@dataclass(frozen=True, eq=False)
class Reading:
    """What is known about the true state x(t+1) after a sample; NaN where nothing is known.

    Attributes
    ----------
    time : int
        t, the index of the newest measurement.
    radius : float
        b(t+1), which bounds |x(t+1) - z(t+1)|_P.
    lower, upper : (n,) array
        Sides of a box that holds x(t+1): the set around the observer, within the region.
    error : float
        Upper bound on |x(t+1) - x_hat(t+1)|.
    kind : str
        The source of ``error``: ``observer``, or ``measured`` where the measured cost gives less.
    lost, reason : int or None, and str
        The sample after which the bound no longer holds, and why.
    state, filtered : (n,) array
        The estimates of x(t+1) and x(t): with ``guard=True`` within the set around the observer,
        else those of the estimate.
    guarded : tuple of str
        Which of the two the guard has moved.
    unguarded : str
        Why the guard is off; empty while it is on.
    """

    time: int
    radius: float
    lower: Array
    upper: Array
    error: float
    kind: str = "observer"
    lost: int | None = None
    reason: str = ""
    state: Array = field(default_factory=lambda: np.zeros(0))
    filtered: Array = field(default_factory=lambda: np.zeros(0))
    guarded: tuple[str, ...] = ()
    unguarded: str = _NO_GUARD


class Monitor:
    """Follows an estimator from sample to sample, with what is proved about it.

    It takes two evaluations of f and three of h a sample; for a `Certificate` with the theorem's
    constants, which need more, two for each sample of the window. One of each is at a point of the
    region, in turn, where the model must have the value that was certified: any other one at these
    eight points ends the bound within eight samples.

    Parameters
    ----------
    certified : Certificate or ObserverBound
        Of the estimator's system and observer; the bound of its observer is enough.
    estimator : MovingHorizonEstimator
        The estimator, as it is when the bound begins.
    initial_error : float, (n,) array_like or set
        Bound on x - z there; see `ObserverBound.along`.
    sizes : Sizes, optional
        Bounds on w and v at all times; those of the bound if left out.
    guard : bool
        Whether estimates that are not in the set around the observer are moved into it: then
        ``reading.state`` and ``reading.filtered`` are within 2 b of the truth, in advance, with any
        solver, cap and cost. Nothing feeds back: the estimator, its trajectory and J stay as they
        are. A `CertificateError` says where that is not proved.

    Raises
    ------
    ShapeError, OptionError, SetError, InvalidInputError
        If an argument does not fit, or there is no bound of the observer.
    MismatchError
        If the estimator's system or gain is another than was certified: see
        `ObserverStability.difference`.

    Attributes
    ----------
    lost, reason : int or None, and str
        The sample after which the observer's bound no longer holds, and why.
    barred : str
        Why the theorem's bound, which goes back to the first sample, does not follow; empty while
        it does. An estimate with `Status.RESTORED` ends it; the bound by the measured cost stays.
    steps, moved : int
        Samples seen, and those of which the guard has moved an estimate.
    unguarded : str
        Why the guard is off; empty while it is on.

    Examples
    --------
    >>> import qpmhe
    >>> from qpmhe.certificates import Monitor, certify
    >>> system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1,
    ...                       states=qpmhe.Box([-9.0], [9.0]))
    >>> observer = qpmhe.Luenberger([0.3])
    >>> cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
    >>> certificate = certify(system, observer, cost, horizon=5)
    >>> mhe = qpmhe.MovingHorizonEstimator(
    ...     system, observer, cost, horizon=5, initial_state=[0.0])
    >>> watch = Monitor(certificate, mhe, initial_error=1.0)
    >>> reading = watch.check(mhe.update([1.0]))
    >>> bool(reading.lower[0] < reading.upper[0]), reading.lost
    (True, None)
    """

    def __init__(
        self, certified: Certificate | ObserverBound, estimator: MovingHorizonEstimator, *,
        initial_error: Size, sizes: Sizes | None = None, guard: bool = False,
    ) -> None:
        bound = certified.proved if isinstance(certified, Certificate) else certified
        if not isinstance(bound, ObserverBound):
            raise InvalidInputError(
                f"certified is of type {type(certified).__name__}; expected a Certificate or an "
                "ObserverBound, such as certificate.observer_bound."
            )
        if not isinstance(estimator, MovingHorizonEstimator):
            raise InvalidInputError(
                f"estimator is of type {type(estimator).__name__}; expected the "
                "MovingHorizonEstimator whose estimates are to be checked; for a run, "
                "certificate.bound(run, initial_error=...)."
            )
        self._system = estimator.system
        self._model = bound.stability.model
        changed = bound.stability.difference(self._system)
        if not changed and bound.stability.content is None and isinstance(certified, Certificate):
            changed = Content.of_system(certified.system).difference(
                Content.of_system(self._system), certified.system is self._system
            )
        if changed:
            raise MismatchError(
                f"the estimator's system is another than was certified: {changed}; certify the "
                "system as it is now."
            )
        self.bound = bound.of_observer(
            estimator.observer, self._system, estimator.settings.projection_metric
        )
        self.sizes = bound.sizes if sizes is None else Sizes.of(sizes, self._system)
        given = self.sizes.disturbance, self.sizes.noise
        self._entering, self._added = bound.entering(*given), bound.added(*given)
        self._tube = bound.begun(initial_error)
        self._time, self._z = estimator.time, estimator.observer_state
        self._ends = REINITIALIZED if estimator.settings.candidate != "observer" else ""
        self.lost: int | None = None
        self.reason = ""
        self.steps, self.moved, self._horizon = 0, 0, estimator.horizon
        # Of the window: z and b at its states, and its inputs.
        self._before: deque[tuple[Array, float]] = deque(maxlen=estimator.horizon + 1)
        self._before.append((self._z, self._tube.radius))
        self._inputs: deque[Array] = deque(maxlen=estimator.horizon)
        self._guard: Guard | None = None
        self.unguarded = _NO_GUARD
        if flag("guard", guard):
            check_guarded(self.bound, estimator, self.sizes)
            self._guard, self.unguarded = Guard(self.bound, self._system), ""
        self._certificate: Certificate | None = None
        self._measured: MeasuredCost | None = None
        self.barred = "the monitor follows the observer's bound alone"
        if isinstance(certified, Certificate):
            self._begin(certified, estimator)

    def _begin(self, certificate: Certificate, estimator: MovingHorizonEstimator) -> None:
        """What the theorem needs of the estimator."""
        self._certificate, cost = certificate, certificate.cost
        self._evaluated = certificate.system.model()  # once: it compares traces at each call
        self.barred = _barred(estimator) or next((text for bars, text in (
            (not certificate.constants, "; ".join(certificate.failures)),
            (estimator.horizon not in certificate.constants,
             f"it was not certified for the horizon {estimator.horizon}"),
            (estimator.cost is not cost, "the certificate is of another cost"),
            (estimator.time > 0, "its bound starts with the first measurement"),
        ) if bars), "")
        detected = certificate.detectability
        if not self.barred and MeasuredCost.applies(detected, cost):
            assert detected is not None
            self._measured = MeasuredCost(
                detected, cost, self.bound, self.sizes,
                cost.least_prior(estimator.observer.initial_covariance()),
            )

    def check(
        self, estimate: Estimate, u: ArrayLike | None = None, *, dt: float | None = None
    ) -> Reading:
        """What is known after the next estimate, as an update, `amend` or `set` returned it.

        Parameters
        ----------
        estimate : Estimate
            An `InvalidInputError` is raised if it is not one, or of a system of another size.
        u : (m,) array_like, optional
            The system's input of the sample, parameters included; of another shape, a `ShapeError`
            is raised, and an `InvalidInputError` if it is no number.
        dt : float, optional
            Length of its step, if it is not the usual one; an `OptionError` if it is not above 0.
        """
        if not isinstance(estimate, Estimate):
            raise InvalidInputError(
                f"estimate is of type {type(estimate).__name__}; expected what "
                "MovingHorizonEstimator.update returns."
            )
        t, z, again = estimate.time, estimate.observer_state, estimate.time == self._time - 1
        sizes, own = (z.size, estimate.noises.shape[1]), (self._system.n, self._system.p)
        if sizes != own:
            raise InvalidInputError(
                f"estimate is of a system with (n, p) = {sizes}; expected one of the estimator "
                f"that is monitored, {own}."
            )
        given = np.zeros(0)
        if not again:
            given = vector("u", () if u is None else u, self._system.m, finite=False)
        if dt is not None:
            positive("dt", dt)
        before, first = self._z, self._tube
        if self.lost is None:
            reason = self._ends or self._order(t)
            if not reason and not again:
                reason = self._advance(estimate, given, dt)
            elif not reason and not np.array_equal(z, self._z):
                reason = _MOVED
            if reason:
                self.lost, self.reason = t, reason
                unknown = (np.full_like(each, math.nan) for each in self._tube[1:])
                self._tube = Tube(math.nan, *unknown)
        self._time, self._z = t + 1, z.copy()
        if not again:
            self.steps += 1
            self._before.append((self._z, self._tube.radius))
            self._inputs.append(given)
        if not self.barred or self._measured is not None:
            reason = self.reason or self._left(estimate, again)
            if reason:
                self._measured = None
            elif Status.RESTORED in estimate.status:
                reason = _RESTORED
            if reason and not self.barred:
                self.barred = f"from sample {t} on: {reason}"
        (radius, box, _), z = self._tube, self._z
        lower, upper = self.bound.around(radius, z, box)
        state, filtered, guarded = self._guarded(estimate, again, before, first)
        error = float(self.bound.farthest(radius, state - z, z, box))
        kind = "observer"
        if self._measured is not None:
            stages = len(self._before) - 1
            least = self._measured.error(self._before[0][1], stages, estimate.cost)
            if least < error and not guarded:
                error, kind = least, "measured"
        return Reading(
            t, radius, lower, upper, error, kind, self.lost, self.reason, state, filtered, guarded,
            self.unguarded,
        )

    def _guarded(
        self, estimate: Estimate, again: bool, before: Array, first: Tube
    ) -> tuple[Array, Array, tuple[str, ...]]:
        """The estimates of x(t+1) and x(t) that are handed on, and which of them were moved."""
        state, filtered, moved = estimate.state.copy(), estimate.filtered.copy(), []
        if not self.unguarded and self.lost is not None:
            self.unguarded = f"from sample {self.lost} on: {self.reason}"
        if not self.unguarded and again:
            self.unguarded = "a sample was estimated again (amend or set)"
        if self._guard is None or self.unguarded:
            return state, filtered, ()
        later = self._guard(state, self._z, self._tube)
        now = self._guard(filtered, before, first)
        for name, each in (("state", later), ("filtered", now)):
            if each.reason:
                self.unguarded = f"from sample {estimate.time} on: {each.reason}"
            elif each.acted:
                moved.append(name)
        if self.unguarded:
            return state, filtered, ()
        self.moved += bool(moved)
        return later.point, now.point, tuple(moved)

    def _order(self, time: int) -> str:
        """Why an estimate is not the next one; empty if it is, or is the same again."""
        if time in (self._time, self._time - 1):
            return ""
        if time < self._time:
            return "the estimator restarted (reset, or a snapshot)"
        return f"the samples from {self._time} to {time - 1} were not shown to the monitor"

    def _advance(self, estimate: Estimate, u: Array, dt: float | None) -> str:
        """Take b(t) to b(t+1); why it cannot be, or empty."""
        bound, system, before, z = self.bound, self._system, self._z, estimate.observer_state
        _, reason = bound.first_event(
            np.array([estimate.status.value]), before[None], u[None],
            None if dt is None else [dt], system.dt,
        )
        if reason:
            return reason
        if np.isnan(estimate.noises[-1]).any():
            return "not all outputs were sampled"
        if not np.array_equal(estimate.candidate[-2], before):
            return _MOVED
        if Status.OBSERVER_PROJECTED not in estimate.status:
            try:
                with np.errstate(all="ignore"):
                    output = system.h(before, u)
                    error = estimate.noises[-1] + system.h(estimate.trajectory[-2], u) - output
                    predicted, correction = system.f(before, u), bound.gain @ error
                    size = np.abs(predicted) + np.abs(correction) + np.abs(bound.gain) @ (
                        np.abs(error) + np.abs(output)
                    )
                    missed = np.abs(z - predicted - correction)
            except Exception:  # a user's function may raise anything, or return it
                return _UNDEFINED
            if not np.isfinite(missed).all():
                return _UNDEFINED
            if not (missed <= _ROUNDING * size).all():
                return (
                    "the observer's step was not f(z) + L v: it had another length (dt), other "
                    "parameters or another gain"
                )
        if self._model is not None:
            turn = self.steps % len(self._model.points)
            changed = self._model.difference(system, (turn,))
            if changed:
                return f"the system is another than was certified: {changed}"
        self._tube = bound.followed(
            self._tube, self._entering, self._added, observer=before, u=u,
            projected=Status.OBSERVER_PROJECTED in estimate.status,
        )
        return CONTRADICTION if bound.is_empty(self._tube.radius, z, self._tube.box) else ""

    def _left(self, estimate: Estimate, again: bool) -> str:
        """Which of the theorem's hypotheses does not hold of the window; empty if all do.

        All that the observer's bound needs has held at each of its samples.
        """
        assert self._certificate is not None
        if again:
            return "a sample was estimated again (amend or set)"
        window = np.array([z for z, _ in self._before])
        if estimate.candidate.shape != window.shape:
            return f"the window has other states than the horizon {self._horizon} gives"
        if Status.FAILED_STAGE in estimate.status:
            return "the model could not be evaluated in the window"
        if not np.array_equal(estimate.candidate, window):
            return "the candidate is not the observer's trajectory"
        if not self.bound.region.contains(estimate.trajectory[:-1]).all():
            return "the estimate left the region"
        with np.errstate(all="ignore"):
            costs = _costs(
                self._certificate, self._evaluated, estimate, np.array(self._inputs)
            )
        # Comparisons with NaN are false.
        most = math.inf if Status.RESTORED in estimate.status else costs[1]
        if not costs[0] <= estimate.cost <= most:
            return "the estimate's cost is not its trajectory's, or above the candidate's"
        return ""

    @property
    def applies(self) -> bool:
        """Whether the theorem's bound follows at the last sample."""
        return not self.barred

    def summary(self) -> str:
        """How long the observer's bound and the theorem's hypotheses held, and what a guard did."""
        held = f"held up to sample {self.lost}: there {self.reason}."
        if self.lost is None:
            held = f"held at all {self.steps} samples."
        theorem = f"does not apply: {self.barred}" if self.barred else "applies"
        guard = ""
        if self._guard is not None:
            off = f", and is off {self.unguarded}" if self.unguarded else ""
            guard = f" The guard moved estimates at {self.moved} of {self.steps} samples{off}."
        return f"The observer's bound {held} The theorem {theorem}.{guard}"

    def c_form(self, estimator: MovingHorizonEstimator) -> GuardForm:
        """The numbers of the guard, as `qpmhe.codegen.write` takes them with ``guard=``.

        Its bounds are those in advance, which begin at ``initial_error`` with the first sample.

        Raises
        ------
        InvalidInputError
            If it has no guard, has seen samples or has lost the bound, or this is no estimator.
        CertificateError, MismatchError
            If nothing is proved for a guard of this estimator.
        """
        if not isinstance(estimator, MovingHorizonEstimator):
            raise InvalidInputError(
                f"estimator is of type {type(estimator).__name__}; expected the "
                "MovingHorizonEstimator that is to be written."
            )
        off = self.unguarded or self.reason
        if off or self.steps or self._time:
            why = off or "it has seen samples, and a written guard begins with the first"
            raise InvalidInputError(
                f"guard is a Monitor that cannot be written: {why}. Make one with guard=True of "
                "the estimator before its first measurement."
            )
        changed = self.bound.stability.difference(estimator.system)
        if changed:
            raise MismatchError(f"the guard is of another system than the estimator's: {changed}.")
        bound = self.bound.of_observer(
            estimator.observer, estimator.system, estimator.settings.projection_metric
        )
        check_guarded(bound, estimator, self.sizes)
        return Guard(bound, estimator.system).c_form(self.sizes, self._tube)

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` restores of the observer's bound, as plain numbers and arrays."""
        if self._certificate is not None:
            raise InvalidInputError(
                "only a monitor of an ObserverBound has a state; pass certificate.observer_bound."
            )
        return {
            "time": self._time, "observer": self._z.copy(), "radius": self._tube.radius,
            "box": self._tube.box.copy(), "oblique": self._tube.oblique.copy(),
            "directions": self.bound.directions.copy(), "lost": self.lost, "reason": self.reason,
            "metric": self.bound.metric.copy(), "moved": self.moved, "unguarded": self.unguarded,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another monitor of this observer stopped.

        It may have another P, and no guard; a guard that was off stays off. An
        `InvalidInputError` is raised if it is not such a state.
        """
        mine = self.state_dict()["metric"]
        try:
            z = np.array(state["observer"], np.float64).reshape(self._z.shape)
            time, radius = int(state["time"]), float(state["radius"])
            box = np.array(state["box"], np.float64).reshape(self._z.shape)
            lost = None if state["lost"] is None else int(state["lost"])
            reason, unguarded = str(state["reason"]), str(state["unguarded"])
            moved = int(state["moved"])
            metric = np.array(state["metric"], np.float64).reshape(mine.shape)
            if lost is None and not (radius >= 0.0 and (box >= 0.0).all()):
                raise ValueError(f"its bounds are {radius} and {box.tolist()}, not lost")
            if not np.array_equal(metric, mine):  # another search found another P
                radius *= largest_ratio(mine, metric)
            tube = self.bound.tube(radius, box)
            if np.array_equal(state.get("directions", ()), self.bound.directions):
                oblique = np.array(state["oblique"], np.float64).reshape(tube.oblique.shape)
                if lost is None and not (oblique >= 0.0).all():
                    raise ValueError(f"its bounds along directions are {oblique.tolist()}")
                tube = tube._replace(oblique=np.minimum(tube.oblique, oblique))
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInputError(
                f"the state does not come from a monitor of this observer: {error}."
            ) from error
        self._time, self._z, self._tube = time, z, tube
        self.lost, self.reason, self.moved = lost, reason, moved
        if self._guard is not None and unguarded != _NO_GUARD:
            self.unguarded = unguarded


def _barred(estimator: MovingHorizonEstimator) -> str:
    """Why the theorem does not cover an estimator's options; empty if it does."""
    settings = estimator.settings
    further = further_terms(estimator.system, estimator.cost, (Hold,))
    return next((text for bars, text in (
        (settings.candidate != "observer",
         "the estimator's candidate comes from a reinitialized observer; make it with "
         "candidate='observer'"),
        (settings.arrival != "observer",
         "the estimator's prior is a smoothed estimate; make it with arrival='observer'"),
        (estimator.system.held,
         "the estimator holds parameters, a term of J; make its system without hold"),
        (estimator.has_changed or settings.parameters,
         "the estimator has parameters, or its weights or bounds were changed by set(...); make "
         "it with constant ones"),
        (further, f"J of the estimator has a term for {further}; make it without"),
    ) if bars), "")


def _costs(
    certificate: Certificate, model: Model, estimate: Estimate, u: Array
) -> tuple[float, float]:
    """J of the estimate and of the candidate, computed again: rounded down, and up.

    Where the prior's weight varies, J of the estimate is the least that it may be.
    """
    cost = certificate.cost
    x, z = estimate.trajectory, estimate.candidate
    try:
        outputs = (model.output(each[:-1], u) for each in (x, z))
        ahead = (model.step(each[:-1], u) for each in (x, z))
        (h_x, h_z), (f_x, f_z) = outputs, ahead
    except Exception:  # a model that is not defined here: the hypothesis does not hold
        return math.nan, math.nan
    y = h_x + estimate.noises
    least = cost.least_prior(certificate.observer.initial_covariance())
    own = cost.prior_cost(x[0] - z[0], least)
    found = []
    for states, following, v, start in ((x, f_x, estimate.noises, own), (z, f_z, y - h_z, 0.0)):
        w = states[1:] - following
        total = start + float(np.sum(cost.stage_costs(np.hstack((w, v)), cost.stage_weight)))
        # Residuals are differences of numbers of these sizes.
        sizes = np.hstack((np.abs(states[1:]) + np.abs(w), np.abs(y) + np.abs(v)))
        each = np.diag(cost.stage_weight.diagonal())
        rounding = float(np.sum(cost.stage_costs(_UNITS * sizes, each)))
        found.append((total, _RELATIVE * total + rounding / _RELATIVE))
    (low, less), (high, more) = found
    return low - less, high + more
