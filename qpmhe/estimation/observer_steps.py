"""The observer's step along one stage of a window, and the terms computed from it."""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from .._linalg import cholesky, inverse, least_pivot
from ..costs import Cost
from ..memory.fields import MemorySizes
from ..model.functions import contained, raised
from ..model.sets import ConvexSet
from ..model.system import Function, System
from ..observers import Observer, Sample
from ..observers.base import check_written
from ..observers.projection import ErrorMetric, NearestPoint
from ..observers.roots import VAGUE
from ..terms.base import read_only
from ..terms.forms import WholeForm
from ..terms.linearization import Stage
from .conditions import USUAL, Conditions
from .estimate import Status
from .limits import LARGEST
from .samples import WindowSamples
from .stages import StageView

Array = NDArray[np.float64]

# As integers: to combine flags of an enumeration takes longer than the rest of the step's logic.
_MISSING, _MODEL_FAILED = Status.MISSING.value, Status.MODEL_FAILED.value
_PROJECTED, _PREDICTION_OUTSIDE, _METRIC_SINGULAR = (
    Status.OBSERVER_PROJECTED.value, Status.PREDICTION_OUTSIDE.value, Status.METRIC_SINGULAR.value
)
_SENSORS_REJECTED, _ALL_REJECTED = Status.SENSORS_REJECTED.value, Status.ALL_REJECTED.value
_OBSERVER_RESET = Status.OBSERVER_RESET.value
#: Flags of the projection onto X.
OF_PROJECTION = _PROJECTED | _PREDICTION_OUTSIDE | _METRIC_SINGULAR


class ObserverSteps(WindowSamples):
    """The samples of a window, and the observer that takes them stage by stage.

    The observer's trajectory changes only with a late measurement or a restart. What depends
    on it alone is therefore computed once, when a stage enters the window: the residuals
    :math:`(L(i), v_z(i))`, their cost, the Jacobians and the Gauss-Newton terms.

    ``events`` and ``failure`` say what happened at the stage computed last, the newest one.
    """

    def __init__(
        self, system: System, observer: Observer, cost: Cost, horizon: int, initial_state: Array,
        with_terms: bool, projection: str | None, usual: Conditions, restarts: bool,
        form: WholeForm,
    ) -> None:
        n, p, m = system.n, system.p, system.m
        covariance, memory = observer.initial_covariance(), observer.initial_memory()
        sizes = MemorySizes.of(
            n, p, m, horizon, sensors=len(observer.sensors), held=len(system.held),
            covariance=covariance is not None, majorised=not cost.quadratic,
            roots=observer.propagates_roots, memory=0 if memory is None else len(memory),
            restarts=restarts,
        )._replace(shapes=form.shapes)
        super().__init__(system, cost, sizes, initial_state, covariance, with_terms, form)
        self._observer = observer
        self._with_jacobians = with_terms or observer.needs_jacobians
        # What the covariance restarts at where it is lost; C finds such a loss as no number.
        self._first_covariance, self._first_memory = covariance, memory
        self._raises_lost = covariance is not None and observer.c_form is not None
        # For observers and losses: a user's code cannot write into the window.
        self._read_only_covariance = (
            None if self.covariance is None else read_only(self.covariance)
        )
        self._read_only_weight = read_only(self.weight)
        if self.memory is not None:
            self.memory[0] = memory
            self._read_only_memory = read_only(self.memory)
        self._read_only_residuals = read_only(self.terms.residuals)
        # Time up to which running observers have taken the samples; -1 makes them start again.
        self._advanced_to = -1
        self._sample = Sample(system, np.zeros(m))
        #: Whether the observer has a gate.
        self.rejects: bool = observer.rejects
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
        self._diagonal = projection == "diagonal"
        if projection is not None and system.states is not None:
            self._usual_nearest = NearestPoint(system.states, self._diagonal)
            if self.covariance is None or observer.metric is not None:
                noise = np.sqrt(inverse(cost.noise).diagonal())
                self.metric = ErrorMetric(
                    observer, cost.initial_weight(observer.initial_covariance()), noise
                )
                self.slots["metric"] = self.metric
        #: Whether the observer is projected onto X.
        self.projects: bool = self._usual_nearest is not None
        self._nearest = self._usual_nearest
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

    def enter_states(self, k: int, time: int) -> None:
        """Project the state before stage k onto its X: no correction leads there."""
        nearest = self._projection(time)
        if nearest is None or nearest.contains(self.z[k]):
            return
        if self.metric is not None:
            self.z[k] = nearest(self.z[k], self.metric.covariance).point
        elif self.covariance is not None:
            self.z[k] = nearest(self.z[k], self.covariance[k], self.root_at(k)).point

    def _projection(self, time: int) -> NearestPoint | None:
        """The projection onto X at a time: the newest sample's before its own has come."""
        states = self.own.get(min(time, self.time - 1), USUAL).states if self.own else None
        if states is None or self._usual_nearest is None:
            return self._usual_nearest
        if id(states) not in self._projections:
            if len(self._projections) > 2 * self.horizon:
                self._projections.clear()
            self._projections[id(states)] = states, NearestPoint(states, self._diagonal)
        return self._projections[id(states)][1]

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
        if self.rejects:
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
        return self._rejected_at(self.end - 1) if self.rejects else None

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
        form = self._form
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
            view.z_next[...], output, jacobian = (
                model.evaluation.stage_by_entries(view.z, u) if form.by_entries
                else kernel.stage(view.z, u)
            )
            np.subtract(view.y, output, terms.noise)
            np.negative(jacobian, terms.slopes)
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
        following = sample.next_memory
        correction, posterior = self._corrected(k, view)
        if following is not None:
            check_written(self._observer, sample, following)
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
            self._project(view, predicted, posterior, self.root_at(k + 1))
        return True

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
        if self._observer.needs_jacobians and self.has_terms and not view.terms.minus_c.any():
            return None  # of h that does not depend on x, or where a derivative is missing
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
            np.negative(self._form.jacobian("f", f_jacobian(*arguments)), terms.minus_a)
            running = "the Jacobian of h"
            np.negative(self._form.jacobian("h", h_jacobian(*arguments)), terms.minus_c)
        except Exception as raising:  # a user's Jacobian outside its domain
            self.failure = raised(running, raising, arguments[0])
            # An observer without Jacobians goes on; `_cost_and_terms` finds the NaN.
            terms.slopes[...] = np.nan

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
            jacobian = stage.slopes.ravel()
            # Terms that overflow with finite Jacobians go into the QP, which then fails.
            cost_of_terms = terms.set_stage(stage, weight)
            if not (math.isfinite(cost_of_terms) or math.isfinite(jacobian.dot(jacobian))):
                self._jacobians_finite = False
                stage.slopes[...] = self._form.minus_stand_in
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
        stage.residual[...], stage.slopes[...] = 0.0, self._form.minus_stand_in
        self.majorising_weight[k] = self.weight[k]
        if self.has_terms:
            self.terms.set_stage(stage, self.weight[k])

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
                view.terms.slopes[...] = self._form.minus_stand_in
            view.z_next[...], view.terms.noise[...] = following, error
            self._cost_and_terms(k)
