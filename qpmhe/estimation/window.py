"""The last N samples, the observer along them, and the terms computed from both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._linalg import cholesky, inverse, least_pivot
from ..costs import Cost
from ..memory.fields import Sizes
from ..memory.record import Mark, Record
from ..model.functions import contained, raised
from ..model.sets import ConvexSet
from ..model.system import Function, System
from ..observers import Observer, Sample
from ..observers.projection import ErrorMetric, NearestPoint
from ..observers.roots import VAGUE
from ..terms.base import read_only
from ..terms.hold import WindowHold
from ..terms.linearization import Stage, StageTerms
from .conditions import USUAL, Conditions
from .estimate import Status
from .limits import LARGEST
from .running import RunningObservers
from .stages import StageView, Views, WindowView

Array = NDArray[np.float64]

# As integers: to combine flags of an enumeration takes longer than the rest of the step's logic.
_MISSING, _MODEL_FAILED = Status.MISSING.value, Status.MODEL_FAILED.value
_PROJECTED, _PREDICTION_OUTSIDE, _METRIC_SINGULAR = (
    Status.OBSERVER_PROJECTED.value, Status.PREDICTION_OUTSIDE.value, Status.METRIC_SINGULAR.value
)
_SENSORS_REJECTED, _ALL_REJECTED = Status.SENSORS_REJECTED.value, Status.ALL_REJECTED.value
_OBSERVER_RESET = Status.OBSERVER_RESET.value
_OF_PROJECTION = _PROJECTED | _PREDICTION_OUTSIDE | _METRIC_SINGULAR
# Views are made in advance up to this horizon: beyond it they would take more memory than the
# arrays, and making them is a small part of a step.
_KEPT = 1000
# Observers run side by side if they hold at most this many numbers; otherwise `replay` does it.
_MOST_RUNNING = 2**23


class Window(Record):
    """Samples y(t-N), ..., y(t-1) with the observer's states z(t-N), ..., z(t).

    Here t is ``time``, the number of samples taken: y(t-1) is the newest, and x(t) is estimated.

    The observer's trajectory changes only with a late measurement or a restart. What depends
    on it alone is therefore computed once, when a stage enters the window: the residuals
    :math:`(L(i), v_z(i))`, their cost, the Jacobians and the Gauss-Newton terms.

    ``events`` and ``failure`` say what happened at the stage computed last, the newest one.
    """

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: Cost,
        horizon: int,
        initial_state: Array,
        with_terms: bool,
        project: bool,
        reinitialized: bool = False,
        usual: Conditions = USUAL,
    ) -> None:
        n, p, m = system.n, system.p, system.m
        self._system, self._observer, self._cost = system, observer, cost
        #: Whether the stages have the terms of QPs.
        self.has_terms: bool = with_terms
        self._n, self._m = n, m
        self._quadratic = cost.quadratic
        self._with_jacobians = with_terms or observer.needs_jacobians
        covariance, self._held = observer.initial_covariance(), list(system.held)
        memory = observer.initial_memory()
        sizes = Sizes.of(
            n, p, m, horizon, sensors=len(observer.sensors), held=len(self._held),
            covariance=covariance is not None, majorised=not cost.quadratic,
            roots=observer.propagates_roots, memory=0 if memory is None else len(memory),
        )
        super().__init__(
            sizes, initial_state, covariance, system.dt or 0.0, cost.stage_weight
        )
        # What the covariance restarts at where it is lost; C finds such a loss as no number.
        self._first_covariance = covariance
        self._raises_lost = covariance is not None and observer.c_form is not None
        room = self.room
        self.terms = StageTerms(
            room, n, p, self.linear, self.panel, self.gradient, self.next_gradient
        )
        # For observers and losses: a user's code cannot write into the window.
        self._read_only_covariance = (
            None if self.covariance is None else read_only(self.covariance)
        )
        self._read_only_weight = read_only(self.weight)
        if self.memory is not None:
            self.memory[0] = memory
            self._read_only_memory = read_only(self.memory)
        self._read_only_residuals = read_only(self.terms.residuals)
        # Views of each stage, and of each full window by its first stage.
        self._stage_views: Sequence[StageView] = Views(
            room, lambda k: StageView(self, self.terms, k)
        )
        self._window_views: Sequence[WindowView] = Views(
            room + 1 - horizon, lambda k: WindowView(self, self.terms, k, k + horizon)
        )
        if horizon <= _KEPT:
            self._stage_views = list(self._stage_views)
            self._window_views = list(self._window_views)
        #: Whether any stage may weigh its disturbance in its own way.
        self.has_disturbance_weights: bool = not cost.quadratic
        # Time up to which running observers have taken the samples; -1 makes them start again.
        self._advanced_to = -1
        self.trust_start()
        self._sample = Sample(system, np.zeros(m))
        self._rejects = observer.rejects
        self._usual = usual
        self._filled: Conditions | None = None  # those that are in the sample now
        self._evaluating = ""  # for messages: the function that is being evaluated
        #: Flags of `Status` for the stage computed last.
        self.events: int = 0
        #: Metric of the projection onto X, where the observer has no covariance.
        self.metric: ErrorMetric | None = None
        # Projects the observer onto X: usually, and at the state that is being computed.
        self._usual_nearest: NearestPoint | None = None
        self._projections: dict[int, tuple[ConvexSet, NearestPoint]] = {}  # onto X of samples
        if project and system.states is not None:
            self._usual_nearest = NearestPoint(system.states)
            if self.covariance is None or observer.metric is not None:
                noise = np.sqrt(inverse(cost.noise).diagonal())
                self.metric = ErrorMetric(
                    observer, cost.initial_weight(observer.initial_covariance()), noise
                )
                self.slots["metric"] = self.metric
        #: Whether the observer is projected onto X.
        self.projects: bool = self._usual_nearest is not None
        self._nearest = self._usual_nearest
        # For the re-initialised candidate; None where `replay` has to make it.
        self._observers: RunningObservers | None = None
        gain, simple = observer.constant_gain, not observer.needs_jacobians
        small = horizon * horizon * (2 * n + p) <= _MOST_RUNNING
        simple = simple and self.covariance is None and self.memory is None
        if reinitialized and gain is not None and small and simple:
            self._observers = RunningObservers(gain, horizon, self._nearest, self._keep_inside)
        self._output_residual, self._state_residual = system.output_residual, system.state_residual
        self._turns = system.turns
        self._correct = contained(observer.correct)
        self._has_filter = type(observer).filter is not Observer.filter
        self._evaluate_costs, self._majorise = contained(cost.stage_costs), contained(cost.majorise)
        self._functions = system.f.direct, system.h.direct
        self._jacobian_functions = system.f_jacobian.direct, system.h_jacobian.direct
        self._jacobians_finite = True  # of the stage computed last
        #: Why the model failed at the stage computed last; blank if it did not.
        self.failure = ""
        self._minus_stand_in = -np.eye(n + p, n)  # -G where the model has no Jacobians
        self._ones = np.ones(horizon)
        # gamma^N for the prior of a full window, then gamma^(N-1), ..., gamma^0 for its stages.
        self._discounts = (
            cost.discount ** np.arange(horizon, -1, -1.0) if cost.discount < 1 else None
        )

    @property
    def view(self) -> WindowView:
        """The views of the present window, which has at least one stage."""
        if self.end - self.start < self.horizon:
            return WindowView(self, self.terms, self.start, self.end)
        return self._window_views[self.start]

    @property
    def newest_failed(self) -> bool:
        """Whether the newest stage could not be evaluated."""
        return not math.isfinite(self.cost[self.end - 1])

    @property
    def candidate(self) -> Array:
        """Candidate trajectory z(t-N), ..., z(t) (eq:warmstart): a view."""
        return self.z[self.start : self.end + 1]

    @property
    def residuals(self) -> Array:
        """Joint residuals (L(i), v_z(i)) of the candidate: a view."""
        return self.terms.residuals[self.start : self.end]

    @property
    def measurements(self) -> Array:
        """y, with any number where it is missing: a view."""
        return self.y[self.start : self.end]

    @property
    def weights(self) -> Array:
        """The stages' weights, usual or not: a view."""
        return self.weight[self.start : self.end]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Which components of y are not missing: a view."""
        return self.is_observed[self.start : self.end]

    @property
    def prior_covariance(self) -> Array | None:
        """The observer's covariance at z(t-N), if it has one."""
        return None if self.covariance is None else self.covariance[self.start]

    @property
    def prior_root(self) -> Array | None:
        """A root of that covariance, where only the root has all digits."""
        return self._root_at(self.start)

    @property
    def last_covariance(self) -> Array | None:
        """The observer's covariance at z(t), if it has one."""
        return None if self.covariance is None else self.covariance[self.end]

    @property
    def initial_state(self) -> Array:
        """The first state of the window."""
        state: Array = self.z[self.start].copy()
        return state

    @property
    def has_special_weights(self) -> bool:
        """Whether some sample of the window came with another weight."""
        return self.unusual and bool(np.count_nonzero(self.is_special[self.start : self.end]))

    @property
    def has_irregular_steps(self) -> bool:
        """Whether some stage of the window has a step of unusual length."""
        return self.unusual and bool(np.count_nonzero(self.is_irregular[self.start : self.end]))

    @property
    def has_own_bounds(self) -> bool:
        """Whether some stage of the window has sets with other sides."""
        return bool(self.own) and any(own.has_bounds for own in self.own.values())

    @property
    def conditions(self) -> list[Conditions]:
        """The conditions of each stage."""
        return [self.own.get(t, USUAL) for t in range(self.time - self.length, self.time)]

    def moves_state(self, own: Conditions | None) -> bool:
        """Whether a sample with these conditions may project z(t) onto another X."""
        states = None if own is None else own.states
        return states is not self.own.get(self.time - 1, USUAL).states

    def push(
        self, y: Array, u: Array, dt: float | None = None, own: Conditions | None = None
    ) -> None:
        """Store the sample y(t), u(t), and advance the observer to z(t+1)."""
        if self.end == self.room:
            self.make_room()
        moves = self.projects and self.moves_state(own)
        failed = moves and self.time > 0 and self.newest_failed
        if self.trusted is not None:
            self.trusted = self.trusted[[1, 1]]
        k, m, time = self.end, self._m, self.time
        self.end, self.time = k + 1, time + 1
        view = self._stage_views[k]
        view.y[...] = y
        if m:
            view.u[...] = u
        if dt is not None:
            self.is_irregular[k] = self.unusual = True
            self.u[k, m] = dt
        if own is not None:
            self.own[time] = own
            if own.noise_weight is not None or own.disturbance_weight is not None:
                self._set_weight(k, time)
        if self._observers_ready:
            self._find_observed(k, time)
            if moves:
                self._advanced_to = min(self._advanced_to, time - 1)
        else:
            events = self._move_state(k, time, failed) if moves else 0
            self._compute_stage(k, time)
            self.events |= events
        if k + 1 - self.start > self.horizon:
            self.start += 1
            if self.own:
                self.own.pop(time - self.horizon, None)

    def _move_state(self, k: int, time: int, failed: bool) -> int:
        """Put z(t) into the X that has come with its sample; return flags of `Status`."""
        if time and not failed:
            self._compute_stage(k - 1, time - 1)
            return self.events & _OF_PROJECTION
        self.enter_states(k, time)
        return 0

    def enter_states(self, k: int, time: int) -> None:
        """Project the state before stage k onto its X: no correction leads there."""
        nearest = self._projection(time)
        if nearest is None or nearest.contains(self.z[k]):
            return
        if self.metric is not None:
            self.z[k] = nearest(self.z[k], self.metric.covariance).point
        elif self.covariance is not None:
            self.z[k] = nearest(self.z[k], self.covariance[k], self._root_at(k)).point

    def _projection(self, time: int) -> NearestPoint | None:
        """The projection onto X at a time: the newest sample's before its own has come."""
        states = self.own.get(min(time, self.time - 1), USUAL).states if self.own else None
        if states is None or self._usual_nearest is None:
            return self._usual_nearest
        if id(states) not in self._projections:
            if len(self._projections) > 2 * self.horizon:
                self._projections.clear()
            self._projections[id(states)] = states, NearestPoint(states)
        return self._projections[id(states)][1]

    def amend(self, time: int, y: Array) -> None:
        """Fill the finite components of y into a sample, and redo the stages from there on."""
        self._advanced_to = min(self._advanced_to, time)
        k = self.end - (self.time - time)
        new = np.abs(y) < LARGEST
        self.y[k, new] = y[new]
        self.is_observed[k] |= new
        self._set_weight(k, time)
        self.replay(self.time - time)

    def take_over(
        self, other: Window, changes: Conditions, parameters: Array | None
    ) -> None:
        """Take the samples of another window, with these changes, and process them again."""
        length, m = other.length, self._m
        kept = other.copies()
        for name in ("y", "u", "is_irregular", "is_observed"):
            self.rows[name][:length] = kept[name]
        self.history[: length + 1] = kept["history"]
        if parameters is not None:
            self.u[:length, m - parameters.size : m] = parameters
        for field in self.sizes.fields("python", "state"):
            self.rows[field.name][0] = kept[field.name][0]
        self.last_good, self.last_good_covariance = other.last_good_before(other.start)
        self.smoothed_prior, self.trusted = other.smoothed_prior, other.trusted
        self.watched, self.damping = other.watched, other.damping
        if self.metric is not None and other.metric is not None:
            self.metric.state = other.metric.state
        self.own = {time: own.without(changes) for time, own in other.own.items()}
        self.start, self.end, self.time, self.unusual = 0, length, other.time, True
        self.enter_states(0, self.time - length)
        for k in range(length):
            self._set_weight(k, self.time - length + k)
        self.replay(length)

    def replay(self, steps: int, state: Array | None = None) -> None:
        """Redo the last ``steps`` stages, from another state of the observer if one is given."""
        first = self.end - steps
        if state is not None:
            self.z[first] = state
        for k in range(first, self.end):
            self._compute_stage(k, self.time - (self.end - k))

    def reinitialize(self, estimates: Array) -> None:
        """Replay the window from its first estimate; the last ones are x(t-N), ..., x(t-1)."""
        if not self._observers_ready or not self._follow(estimates):
            self.replay(self.length, estimates[-self.length])

    @property
    def _observers_ready(self) -> bool:
        """Whether observers run side by side; not before their metric is final."""
        return self._observers is not None and (self.metric is None or self.metric.settled)

    def _follow(self, estimates: Array) -> bool:
        """Take the candidate from a running observer; False where `replay` has to make it."""
        observers, now, first = self._observers, self.time, self.time - self.length
        assert observers is not None
        # With samples that have changed, an observer that failed may work: run all of them again.
        if self._advanced_to < first or (self._advanced_to < now - 1 and observers.failed.any()):
            observers.failed[:], self._advanced_to = True, first
        for time in range(self._advanced_to, now):
            k = self.end - (now - time)
            self._fill_sample(k, time, self._find_observed(k, time))
            observers.nearest = self._nearest = self._projection(time + 1)
            observers.advance(time, estimates[time - now], self.y[k], self._sample)
        self._advanced_to = now
        self.z[self.start : self.end + 1], self.residuals[...], self.events = (
            observers.trajectory(first, now)
        )
        self.failure = ""
        observed = self._sample.observed
        if observed is not None and self._is_missing(now - 1, observed):
            self.events |= _MISSING
        return not observers.failed[first % self.horizon] and self._set_all_stages()

    def _set_all_stages(self) -> bool:
        """Compute the Jacobians, terms and costs of all stages; whether all are finite."""
        view, n, weights = self.view, self._n, self.stage_weights
        residuals, states = read_only(view.residuals), view.candidate[:-1]
        try:
            if self._with_jacobians:
                minus_jacobian, inputs, model = view.span.minus_jacobian, self.inputs, self.model
                a, c = model.evaluation.linear(states, inputs)
                np.negative(a, minus_jacobian[:, :n])
                np.negative(c, minus_jacobian[:, n:])
            if self._quadratic:
                view.costs[...] = checked = self.terms.set_all(self.length, weights, self.start)
            else:
                view.costs[...] = checked = self._evaluate_costs(residuals, read_only(weights))
                if self.has_terms:
                    weights = self._majorise(residuals, read_only(weights))
                    self.majorising_weight[self.start : self.end] = weights
                    checked = checked + self.terms.set_all(self.length, weights, self.start)
        except Exception:  # what the user wrote, at some stage
            return False
        return bool(np.isfinite(checked).all())

    def _compute_stage(self, k: int, time: int) -> None:
        """Compute stage k, of this time, from its sample and the observer's state."""
        y, observed = self._stage_views[k].y, self._find_observed(k, time)
        self.failure = ""
        if self.projects:
            self._nearest = self._projection(time + 1)
        cost = self._evaluate_stage(k, time, observed)
        if not math.isfinite(cost) and observed is None:
            small = np.abs(y) < LARGEST
            if not small.all():  # a huge component may be the reason: without it
                self._advanced_to = min(self._advanced_to, time)
                self.unusual = True
                self.is_observed[k] = observed = small
                self._set_weight(k, time)
                cost = self._evaluate_stage(k, time, observed)
        model_failed = not math.isfinite(cost)
        jacobian_failed = not model_failed and self.has_terms and not self._jacobians_finite
        if (model_failed or jacobian_failed) and not self.failure:
            what = self._not_finite(k, time, observed)
            self.failure = f"{what} at x = {self._stage_views[k].z.tolist()}."
        if model_failed:
            self.events &= ~_OBSERVER_RESET
            self._fill_failed(k)
        self.cost[k] = cost
        if observed is not None and self._is_missing(time, observed):
            self.events |= _MISSING
        if model_failed or jacobian_failed:
            self.events |= _MODEL_FAILED
        if self._rejects:
            self._report_rejected(k)

    def _not_finite(self, k: int, time: int, observed: NDArray[np.bool_] | None) -> str:
        """What is not finite at stage k: evaluates the model again to find out."""
        view = self._stage_views[k]
        with suppress(Exception), np.errstate(all="ignore"):
            model, u = self._fill_sample(k, time, observed)
            for name, function in (("f", model.f), ("h", model.h)):
                value = np.asarray(function(view.z, u))
                used = value if observed is None or name == "f" else value[observed]
                if not np.isfinite(used).all():
                    return f"{name} is {value.tolist()}"
            if self._with_jacobians:
                for name, jacobian in (("f", model.f_jacobian), ("h", model.h_jacobian)):
                    if not np.isfinite(slope := np.asarray(jacobian(view.z, u))).all():
                        return f"the Jacobian of {name} is not finite"
                    if not np.isfinite(np.square(slope)).all():
                        return f"the Jacobian of {name} has {np.abs(slope).max():.0e} in it"
            if not np.isfinite(view.terms.disturbance).all():
                return "the observer's correction is not finite"
            if not np.isfinite(view.z_next).all():
                return "the observer's next state is not finite"
            if self.memory is not None and not np.isfinite(self.memory[k + 1]).all():
                return "what the observer remembers is not finite"
        return "the observer or the cost is not finite"

    @property
    def rejected(self) -> NDArray[np.bool_] | None:
        """Which sensors the observer rejected at the newest stage; None without a gate."""
        return self._rejected_at(self.end - 1) if self._rejects else None

    def _rejected_at(self, k: int) -> NDArray[np.bool_]:
        rejections = self.rejections
        assert rejections is not None
        grown: NDArray[np.bool_] = rejections[k + 1] > rejections[k]
        return grown

    def _report_rejected(self, k: int) -> None:
        """Add the flags of sensors that were rejected at stage k."""
        rejected, observed = self._rejected_at(k), self.is_observed[k]
        if rejected.any():
            self.events |= _SENSORS_REJECTED
            sensors = zip(self._observer.sensors, rejected, strict=True)
            if all(no or not observed[list(outputs)].any() for outputs, no in sensors):
                self.events |= _ALL_REJECTED

    def _find_observed(self, k: int, time: int) -> NDArray[np.bool_] | None:
        """Mark the missing components of y at stage k; return which are there, or None for all."""
        y = self._stage_views[k].y
        if not math.isfinite(y.dot(y)):
            self.unusual = True  # first: `roll_back` makes usual again what an interrupt leaves
            self.is_observed[k] = np.abs(y) < LARGEST  # False for NaN, too
            self._set_weight(k, time)
        elif not self.unusual or False not in self.is_observed[k].tolist():
            return None
        observed: NDArray[np.bool_] = self.is_observed[k]
        return observed

    def _is_missing(self, time: int, observed: NDArray[np.bool_]) -> bool:
        """Whether a component was sampled that is not there."""
        sampled = self.own.get(time, USUAL).sampled
        if sampled is None:
            return True
        return sampled.tobytes() != observed.tobytes() and bool((sampled & ~observed).any())

    def _set_weight(self, k: int, time: int) -> None:
        """Set the weight of stage k from its observed components and its own weights."""
        own, observed = self.own.get(time, USUAL), self.is_observed[k]
        weights = own.noise_weight, own.disturbance_weight
        if weights[1] is not None:
            self.has_disturbance_weights = True
        if False in observed.tolist():  # NumPy's `all` takes ten times as long
            self._stage_views[k].y[~observed] = 0.0  # any number: its weight is zero
            self.weight[k] = self._cost.partial_weight(observed, *weights)
            self.is_special[k] = self.unusual = True
            return
        weight = usual = self._cost.stage_weight
        if any(one is not None for one in weights):
            weight = self._cost.joint_weight(*weights)
        self.weight[k] = weight
        # A usual weight that was given as its own is as good as none.
        self.is_special[k] = weight is not usual and not np.array_equal(weight, usual)
        self.unusual |= bool(self.is_special[k])

    def _evaluate_stage(self, k: int, time: int, observed: NDArray[np.bool_] | None) -> float:
        """Evaluate the model and the observer at stage k; return its cost, or infinity."""
        view = self._stage_views[k]
        self.events = 0
        try:
            self._evaluate_model(k, time, view, observed)
            self._evaluating = "the observer's correction"
            if not self._advance_observer(k, view):
                return math.inf
        except Exception as raising:  # a model function outside its domain: not bad input
            self.failure = raised(self._evaluating, raising, view.z)
            return math.inf
        self._jacobians_finite = True
        if self._quadratic:
            # Also where no QP needs terms: so the cost is the same to the last digit.
            cost = self.terms.set_stage(view.terms, view.weight)
            if math.isfinite(cost):
                return cost
        return self._cost_and_terms(k)

    def _evaluate_model(
        self, k: int, time: int, view: StageView, observed: NDArray[np.bool_] | None
    ) -> None:
        """Write y - h(z), the Jacobians and, as z(t+1), f(z); fill the observer's `Sample`."""
        terms = view.terms
        self._evaluating = "the model"
        model, u = self._fill_sample(k, time, observed)
        kernel = model.evaluation.functions.kernel if self._with_jacobians else None
        if kernel is None:
            usual = model is self._system
            arguments = view.arguments if usual else (view.arguments[0], u)
            f, h = self._functions if usual else (model.f, model.h)
            # Used at once: the functions may return the same array at each call.
            self._evaluating = "h"
            np.subtract(view.y, h(*arguments), terms.noise)
            self._evaluating = "f"
            view.z_next[...] = f(*arguments)
            if self._with_jacobians:
                self._differentiate(
                    terms,
                    self._jacobian_functions if usual else (model.f_jacobian, model.h_jacobian),
                    arguments,
                )
        else:
            view.z_next[...], output, jacobian = kernel.stage(view.z, u)
            np.subtract(view.y, output, terms.noise)
            np.negative(jacobian, terms.linear[:, 1:])
            flat = jacobian.ravel()
            if not math.isfinite(flat.dot(flat)):
                self._differentiate(terms, (model.f_jacobian, model.h_jacobian), (view.z, u))
        if self._output_residual is not None:
            self._evaluating = "output_residual"
            self._output_residual.wrap(terms.noise, view.y)
        if observed is not None:
            terms.noise[~observed] = 0.0

    def _fill_sample(
        self, k: int, time: int, observed: NDArray[np.bool_] | None
    ) -> tuple[System, Array]:
        """Fill the `Sample` that the observer gets for stage k; return its model and input."""
        model, u, sample = self._system, self._stage_views[k].u, self._sample
        own = self.own.get(time, USUAL) if self.own else USUAL
        if own is not self._filled:
            self._filled = None  # an interrupt may leave half of it
            whole = own if self._usual is USUAL else own.over(self._usual)
            sample.noise_weight, sample.states = whole.noise_weight, whole.states
            sample.disturbance_weight = whole.disturbance_weight
            self._filled = own
        if self.unusual and self.is_irregular[k]:
            model, u = self._system.timed, self.u[k]
        sample.system, sample.u, sample.observed = model, u, observed
        return model, u

    def _advance_observer(self, k: int, view: StageView) -> bool:
        """Add the correction to f(z), and project; whether state and covariance are sound."""
        sample, terms, z_next = self._sample, view.terms, view.z_next
        if self._observer.needs_jacobians:
            sample.f_jacobian, sample.h_jacobian = -terms.minus_a, -terms.minus_c
        if self._read_only_covariance is not None:
            sample.covariance = self._read_only_covariance[k]
        rejections = self.rejections
        if rejections is not None:
            rejections[k + 1] = rejections[k]
            sample.rejections, sample.next_rejections = rejections[k], rejections[k + 1]
        if self.memory is not None:
            self.memory[k + 1] = self.memory[k]
            sample.memory, sample.next_memory = self._read_only_memory[k], self.memory[k + 1]
        sample.root = sample.next_root = None
        if self.root is not None and self.is_vague[k]:
            sample.root = self.root[k]
        correction, posterior = self._corrected(k, view)
        terms.disturbance[...] = correction
        predicted = z_next.copy() if self._nearest is not None else None
        z_next += correction
        if self._state_residual is not None:
            self._evaluating = "state_residual"
            self._state_residual.wrap(terms.disturbance, z_next)
            if self._turns is not None:
                z_next[...] = self._turns(z_next)
                predicted = None if predicted is None else self._turns(predicted)
        if self.covariance is not None:
            if posterior is None:
                return False
            self.covariance[k + 1] = posterior
        if not math.isfinite(z_next.dot(z_next)):
            return False
        if self.memory is not None and not np.isfinite(self.memory[k + 1]).all():
            return False
        if predicted is not None:
            self._project(view, predicted, posterior, self._root_at(k + 1))
        return True

    def _root_at(self, k: int) -> Array | None:
        """The root of the observer's covariance of state k, where it has one."""
        return self.root[k] if self.root is not None and self.is_vague[k] else None

    def _corrected(self, k: int, view: StageView) -> tuple[Array, Array | None]:
        """The correction and the next covariance: the first one without a correction where lost."""
        sample, arguments = self._sample, (view.arguments[0], view.error)
        roots, found = self.root, 0.0
        try:
            correction, posterior = self._correct(*arguments, sample)
            if self.covariance is None or posterior is None:
                return correction, posterior
            found = least_pivot(posterior)
            if found < VAGUE and roots is not None and sample.next_root is None:
                # Digits that matter may be lost: the same from a root of what has them all.
                roots[k], self.is_vague[k] = cholesky(self.covariance[k]).T, True
                sample.root = roots[k]
                correction, posterior = self._correct(*arguments, sample)
                found = least_pivot(posterior)
        except Exception as raising:
            if not self._raises_lost:
                raise
            self.failure = raised(self._evaluating, raising, view.z)
            found = -1.0
        if found < 0.0:
            # As the prior's weight, what is no covariance would make J negative.
            self.events |= _OBSERVER_RESET
            posterior = self._first_covariance
            if self.rejections is not None:
                self.rejections[k + 1] = 0
            if self._observer.constant_gain is None:
                correction = np.zeros_like(view.z)
        if roots is not None:
            following = sample.next_root if 0.0 <= found < VAGUE else None
            self.is_vague[k + 1] = following is not None
            if following is not None:
                roots[k + 1] = following
        return correction, posterior

    def _project(
        self, view: StageView, predicted: Array, covariance: Array | None, root: Array | None
    ) -> None:
        """Settle the metric if need be, and keep z(t+1) in X."""
        nearest, metric, z_next = self._nearest, self.metric, view.z_next
        assert nearest is not None
        if metric is not None and not metric.settled:
            if self._with_jacobians:
                a, c = -view.terms.minus_a, -view.terms.minus_c
            else:
                model, u = self._sample.system, self._sample.u
                a, c = model.f_jacobian(view.z, u), model.h_jacobian(view.z, u)
            metric.settle(view.z, a, c, self._sample)
        if not nearest.contains(z_next):
            correction = view.terms.disturbance
            self.events |= self._keep_inside(predicted, z_next, correction, covariance, root)

    def _keep_inside(
        self, predicted: Array, z_next: Array, correction: Array, covariance: Array | None = None,
        root: Array | None = None,
    ) -> int:
        """Project z(t+1) onto X, and set its correction to match; return flags of `Status`."""
        nearest, events = self._nearest, _PROJECTED
        if self.metric is not None:
            covariance, root = self.metric.covariance, None
        assert nearest is not None
        assert covariance is not None
        found = nearest(z_next, covariance, root)
        if not nearest.contains(predicted):
            events |= _PREDICTION_OUTSIDE
            if found.reached and nearest.is_beyond(z_next, found.point, covariance, root):
                # Every point of X is nearer to the truth than z_next is. The prediction is then
                # so far off that it would hide the correction: correct its projection instead.
                inside = nearest(predicted, covariance, root).point
                found = nearest(inside + correction, covariance, root)
        z_next[...] = found.point
        np.subtract(z_next, predicted, correction)
        if self._state_residual is not None:
            self._state_residual.wrap(correction, z_next)
        return events if found.reached else events | _METRIC_SINGULAR

    def filtered(self) -> Array | None:
        """The observer's estimate of x(t) that has used y(t), within X; None if it has none."""
        if not self._has_filter or self.newest_failed:
            return None
        view = self._stage_views[self.end - 1]
        try:
            found = self._observer.filter(view.arguments[0], view.error, self._sample)
            if found is None:
                return None
            state = np.array(found[0], np.float64)
            if not np.isfinite(state).all():
                return None
            if self._turns is not None:
                state = self._turns(state)
            if self._nearest is not None and not self._nearest.contains(state):
                state = self._nearest(state, found[1]).point
        except Exception:  # a user's observer: z(t) serves instead
            return None
        return state

    def _differentiate(
        self, terms: Stage, jacobians: tuple[Function, Function], arguments: tuple[Array, ...]
    ) -> None:
        f_jacobian, h_jacobian = jacobians
        running = "the Jacobian of f"
        try:
            np.negative(f_jacobian(*arguments), terms.minus_a)
            running = "the Jacobian of h"
            np.negative(h_jacobian(*arguments), terms.minus_c)
        except Exception as raising:  # a user's Jacobian outside its domain
            self.failure = raised(running, raising, arguments[0])
            # An observer without Jacobians goes on; `_cost_and_terms` finds the NaN.
            terms.linear[:, 1:] = np.nan

    def _cost_and_terms(self, k: int) -> float:
        """Compute the cost of stage k, or infinity, and the terms that are still missing."""
        weight, stage = self._read_only_weight[k], self._stage_views[k].terms
        terms, residual = self.terms, self._read_only_residuals[k]
        try:
            cost = float(self._evaluate_costs(residual[None], weight)[0])
            if not math.isfinite(cost):
                return math.inf
            if self.has_terms and not self._quadratic:
                self.majorising_weight[k] = self._majorise(residual[None], weight)[0]
                weight = self.majorising_weight[k]
        except Exception as error:  # a user's loss
            self.failure = raised("the cost", error, self._stage_views[k].z)
            return math.inf
        if self.has_terms:
            jacobian = stage.linear[:, 1:].ravel()
            # Terms that overflow with finite Jacobians go into the QP, which then fails.
            cost_of_terms = terms.set_stage(stage, weight)
            if not (math.isfinite(cost_of_terms) or math.isfinite(jacobian.dot(jacobian))):
                self._jacobians_finite = False
                stage.linear[:, 1:] = self._minus_stand_in
                terms.set_stage(stage, weight)
        return cost

    def _fill_failed(self, k: int) -> None:
        """Fill a stage at which the model failed: z stays at its last good value, no residual."""
        self.z[k + 1], covariance = self.last_good_before(k)
        if self.covariance is not None:
            self.covariance[k + 1] = covariance
            self.is_vague[k + 1] = False
        if self.rejections is not None:
            self.rejections[k + 1] = self.rejections[k]
        if self.memory is not None:
            self.memory[k + 1] = self.memory[k]
        self._fill_terms(k)

    def _fill_terms(self, k: int) -> None:
        """Fill in the terms of a stage at which the model failed: no residual."""
        stage = self._stage_views[k].terms
        stage.linear[:, 0], stage.linear[:, 1:] = 0.0, self._minus_stand_in
        self.majorising_weight[k] = self.weight[k]
        if self.has_terms:
            self.terms.set_stage(stage, self.weight[k])

    @property
    def observer_state(self) -> Array:
        """z(t), the observer's newest state: a view."""
        newest: Array = self.z[self.end]
        return newest

    def roll_back(self, mark: Mark) -> None:
        """Undo all changes since a mark; see `Record.roll_back`."""
        self._advanced_to = -1
        super().roll_back(mark)

    def load_state_dict(self, *arguments: Any, **options: Any) -> None:
        """Load a snapshot; see `Record.load_state_dict`."""
        super().load_state_dict(*arguments, **options)
        self.has_disturbance_weights = True

    def trust_start(self) -> None:
        """Trust the initial state's values of the parameters that are held."""
        if self._held:
            self.trusted = np.tile(self.z[0, self._held], (2, 1))

    def trust(self, hold: WindowHold, trajectory: Array | None) -> None:
        """Let the next window's trusted values follow an estimate; None leaves them."""
        following = hold.target
        if trajectory is not None:
            following = hold.followed(trajectory[int(self.length == self.horizon)])
        self.trusted = np.stack((hold.target, following))

    def adopt(self, record: Record, residuals: Array) -> None:
        """Go on from another engine's record, with its joint residuals along the candidate."""
        self.copy_from(record)
        self.terms.residuals[: self.end] = residuals
        for k in range(self.end):
            self._set_weight(k, self.time - (self.end - k))
        self.restate()

    def restate(self) -> None:
        """Compute what QPs need of all stages, from the samples, the states and the residuals."""
        for k in range(self.start, self.end):
            view, time = self._stage_views[k], self.time - (self.end - k)
            following, error = view.z_next.copy(), view.error.copy()
            observed = self.is_observed[k]
            if not math.isfinite(self.cost[k]):
                self._fill_terms(k)
                continue
            try:
                self._evaluate_model(k, time, view, None if observed.all() else observed)
            except Exception:  # outside of the model's domain, which it was not before
                view.terms.linear[:, 1:] = self._minus_stand_in
            view.z_next[...], view.terms.noise[...] = following, error
            self._cost_and_terms(k)

    def restart(self, state: Array) -> None:
        """Set z(t), the observer's newest state, after a failed stage."""
        self.z[self.end] = state

    @property
    def candidate_cost(self) -> float:
        """J of the candidate; its prior term is 0 exactly."""
        return self.candidate_cost_of(self.view)

    def candidate_cost_of(self, view: WindowView) -> float:
        """J of the candidate, from the window's present view."""
        costs = view.costs
        if self._discounts is None:
            return float(costs.dot(self._ones[: costs.size]))
        cost = float(costs.dot(self.discounts[1:]))
        # NaN is 0 times infinity: a failed stage whose factor has underflowed.
        return math.inf if math.isnan(cost) else cost

    @property
    def discounts(self) -> Array:
        """gamma^K for the prior's cost, then gamma^(K-1), ..., gamma^0 for the K stages'."""
        if self._discounts is None:
            return np.ones(self.length + 1)
        return self._discounts[self.horizon - self.length :]

    @property
    def inputs(self) -> Array:
        """The inputs u, and the step lengths in a last column if some are irregular: a view."""
        columns = None if self.has_irregular_steps else self._m
        return self.u[self.start : self.end, :columns]

    @property
    def model(self) -> System:
        """The system that takes `inputs`, step lengths included."""
        return self._system.timed if self.has_irregular_steps else self._system

    @property
    def stage_weights(self) -> Array:
        """One weight for all stages (q, q), or one for each where some is special."""
        return self.weights if self.has_special_weights else self._cost.stage_weight

    @property
    def majorising_weights(self) -> Array:
        """`stage_weights` of the quadratic form that majorises the cost at the candidate."""
        if self._cost.quadratic:
            return self.stage_weights
        return self.majorising_weight[self.start : self.end]
