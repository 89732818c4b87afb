"""One step of the estimator in Python, and its memory between steps."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import Solver, create
from qpmhe_solvers.solver import ContainedSolver

from .._checks import check_problem
from ..costs import Cost, lifted
from ..errors import InvalidInputError, ObserverWarning
from ..memory.record import MemoryRecord
from ..memory.snapshot import reading
from ..model.captured import ComparisonTimes, Due
from ..model.derivatives import Nearby
from ..model.residuals import difference
from ..model.system import System
from ..model.traces import warn_of
from ..observers import Observer
from ..terms.forms import WholeForm
from ..terms.sum import root_of_first, weight_of_first
from .conditions import USUAL, ConditionReader, Conditions, usual_conditions
from .covariance import window_covariances
from .description import check_description, described
from .estimate import Estimate, Status
from .forms import form_for, have_form
from .optimizer import Optimizer
from .problem import Formulation, Solved
from .settings import Settings
from .start import with_scaled_constraints
from .subproblem import Subproblem
from .watch import NEAR, ObserverWatch
from .window import Window

Array = NDArray[np.float64]


class Tools(NamedTuple):
    """The objects that a step uses; rebuilt if the usual conditions change.

    ``given`` is the system without these, ``system`` the one with them; both are evaluated by a
    model of this engine's own, which notes what is taken ``nearby``.
    """

    given: System
    nearby: tuple[Nearby, Nearby]
    usual: Conditions
    system: System
    cost: Cost
    form: WholeForm
    formulation: Formulation
    subproblem: Subproblem
    optimizer: Optimizer


class PythonEngine:
    """The step in Python: window, problem, optimizer, estimate.

    `MovingHorizonEstimator` validates all arguments, and documents the methods of the same names.
    """

    name = "python"

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: Cost,
        settings: Settings,
        initial_state: Array,
    ) -> None:
        settles = settings.projection is not None and system.states is not None and (
            observer.metric is None and observer.initial_covariance() is None
        )
        if not (settings.qp_limit or observer.needs_jacobians or settles):
            # A trace saves little here, and the observer is the user's to the last bit. The metric
            # of a projection that settles needs exact Jacobians.
            system = system.as_written()
        system = _with_own_model(system)
        self._observer, self._given_cost = observer, cost
        self._cost = cost = lifted(cost, system.disturbance_matrix, observer.initial_covariance())
        self._to_disturbances = None if cost.space is None else cost.space.to_disturbances
        self._disturbances = system.r
        self._settings = settings
        given = settings.backend
        self._solver = solver = ContainedSolver(
            given if isinstance(given, Solver)
            else create(given, settings.solver_options, isolated=settings.isolated)
        )
        if settings.qp_limit:
            solver.prepare((settings.horizon + 1) * system.n)
        if system.constraints is not None and not system.constraints.is_scaled:
            system = with_scaled_constraints(system, observer, self._given_cost, initial_state)
        self._reader = ConditionReader(system, self._given_cost)
        self._tools = self._tools_for(usual_conditions(settings), system)
        system.evaluation.prepare(settings.horizon, self._tools.form.by_entries)
        penalties = self._tools.formulation.sum.penalties
        if settings.qp_limit and penalties is not None:
            solver.prepare((settings.horizon + 1) * (system.n + penalties.size))
        self._with_terms = settings.qp_limit > 0
        self._reinitialized = settings.candidate == "reinitialized"
        self._smoothed = settings.arrival == "smoothed"
        self._restarts = settings.restart
        self._window = self._fresh_window(initial_state, self._tools)
        self._watch = ObserverWatch(settings.horizon)
        # When the traces are compared with the functions that they stand for.
        self._times = ComparisonTimes(system.traced_functions, settings.time_budget is None)
        self._undo: Callable[[], None]

    def _tools_for(
        self, usual: Conditions, given: System, fits: Callable[[WholeForm], bool] = lambda _: True
    ) -> Tools:
        """What a step uses under these usual conditions, with matrices in a form that fits."""
        settings = self._settings
        system, cost = usual.applied(given, self._cost)
        form = form_for(system, self._observer, cost, settings, self._solver)
        if not fits(form):
            form = WholeForm(system.n, system.p)
        formulation = Formulation(system, self._observer, cost, form)
        subproblem = Subproblem(
            system, formulation.constraints, settings.horizon, formulation.sum.penalties, form
        )
        return Tools(
            given, _nearby(given), usual, system, cost, form, formulation, subproblem,
            Optimizer(subproblem, self._solver, settings),
        )

    def _fresh_window(self, initial_state: Array, tools: Tools) -> Window:
        settings = self._settings
        return Window(
            tools.system, self._observer, tools.cost, settings.horizon, initial_state,
            self._with_terms, settings.projection, self._reinitialized, tools.usual,
            settings.restart, tools.form,
        )

    @property
    def outpaces_c(self) -> bool:
        """Whether this step is faster than the one in C."""
        return self._tools.form.is_narrow

    @property
    def usual(self) -> Conditions:
        """The conditions of a sample that brings none."""
        return self._tools.usual

    @property
    def system(self) -> System:
        """The system with its present sets."""
        return self._tools.system

    @property
    def state(self) -> Array:
        """The current estimate."""
        window = self._window
        state: Array = window.history[window.end].copy()
        return state

    @property
    def observer_state(self) -> Array:
        """The state from which the observer continues."""
        return self._window.observer_state.copy()

    @property
    def time(self) -> int:
        """Number of measurements taken so far."""
        return self._window.time

    @property
    def length(self) -> int:
        """Number of samples in the window."""
        return self._window.length

    def step(
        self, y: Array, u: Array, dt: float | None, own: Conditions | None, began: float
    ) -> Estimate:
        """Take the sample y(t), u(t), and estimate x(t+1)."""
        if self._window.time >= self._times.next:
            self._check_trace(u)
        if own is not None and not have_form(self._tools.form, own):
            self._hold_whole(own)
        window, reinitialized = self._window, self._reinitialized
        if window.end == window.room:
            window.make_room()  # before the undo point: `undo` cannot reverse it
        # The first estimate that an observer may start at is the one of x(1).
        challenged = self._restarts and window.time - window.restarted >= self._settings.horizon
        self._set_undo_point(
            reinitialized or challenged or (window.projects and window.moves_state(own))
        )
        try:
            with np.errstate(all="ignore"):
                if window.end - window.start == window.horizon:
                    self._solver.shift()
                    if self._smoothed and window.trajectory is not None:
                        window.smoothed_prior = window.trajectory[1].copy()
                window.push(y, u, dt, own)
                if reinitialized:
                    window.reinitialize(window.history[window.start : window.end])
                elif challenged:
                    window.challenge()
                estimate = self._estimate(began)
            window.history[window.end] = estimate.state
            self._warn()
            return estimate
        except BaseException:  # an interrupt, or a warning as an error: the sample is not taken
            self.undo()
            raise

    def _check_trace(self, u: Array) -> None:
        """Compare traces and functions if it is time to."""
        due = self._times.due(self._window.time)
        if due is not Due.NOWHERE:
            self.verify(u, due is Due.EVERYWHERE, 6)

    def verify(self, u: Array, everywhere: bool = True, level: int = 4) -> bool:
        """Compare traces and functions at z(t); take the functions for good where they differ."""
        window, system = self._window, self._tools.given
        where = [(window.candidate[-1], u), *(system.usual_points() if everywhere else ())]
        fault = system.fault(where)
        if not fault:
            self._times.compared(window.time)
            return True
        self.leave_trace()
        warn_of(fault, level)
        return False

    def leave_trace(self) -> None:
        """Evaluate the original functions, along the window and from now on."""
        self._change(USUAL, None, _with_own_model(self._tools.given.as_written()))
        self._times.end()

    def _hold_whole(self, own: Conditions) -> None:
        """Hold matrices whole from now on: a sample brings weights of another pattern."""
        self.replace(*self._checked_memory(self.state_dict(), lambda form: have_form(form, own)))

    def _warn(self) -> None:
        watched = self._window.watched
        if watched == NEAR:
            return
        text = self._watch.warning(watched)
        if text is not None:
            warnings.warn(text, ObserverWarning, stacklevel=4)

    def _estimate(self, began: float) -> Estimate:
        """Solve the present window's problem."""
        window, settings = self._window, self._settings
        tools = self._tools
        problem = tools.formulation.problem(window)
        deadline = math.inf if settings.time_budget is None else began + settings.time_budget
        outcome = tools.optimizer.improve(problem, self._shifted, deadline, window.damping)
        window.damping = outcome.damping
        trial, candidate, message = outcome.trial, problem.candidate, outcome.message
        status = Status.IMPROVED if outcome.improved else Status.CANDIDATE
        if outcome.events:
            if Status.RESTORED in outcome.events:
                status = Status(0)  # better than no candidate, but in the sets
            status |= outcome.events
        if window.events:
            status |= Status(window.events)
        one, other = tools.nearby
        if one.used or other.used:
            status |= Status.DERIVATIVE_NEARBY
        if window.failure:
            message = f"{window.failure} {message}".strip()
        if candidate.values is not None and (text := problem.constraint_failure(candidate)):
            status |= Status.MODEL_FAILED
            message = f"{text} {message}".strip()
        finite = math.isfinite(candidate.cost)
        if not finite:
            status &= ~Status.NO_DECREASE  # the model failed, not the solver
            if problem.rolled_out is not None:
                status |= Status.MODEL_FAILED
                reason = problem.failure(problem.rolled_out)
                message = f"the candidate's roll-out has no finite cost. {reason} {message}".strip()
            if Status.MODEL_FAILED not in status:
                status |= Status.FAILED_STAGE
        trajectory, residuals, filtered = trial.trajectory, trial.residuals, None
        if outcome.improved:
            offset = trajectory[-1] - candidate.trajectory[-1]
            if problem.wraps:
                offset = difference(
                    tools.given.state_residual, trajectory[-1], candidate.trajectory[-1]
                )
            window.watched = self._watch.counted(
                window.watched, problem.prior.distance(offset), bool(outcome.dropped)
            )
            if window.watched[0] >= settings.horizon:
                status |= Status.OBSERVER_FAR
        else:
            window.watched = NEAR
            # The candidate's arrays are views of the window: copy.
            trajectory, residuals = trajectory.copy(), residuals.copy()
            filtered = window.filtered()
        if problem.observed is not None:
            residuals[:, tools.given.n :][~problem.observed] = np.nan
        if self._to_disturbances is not None:
            n = tools.given.n
            residuals = np.hstack((residuals[:, :n] @ self._to_disturbances.T, residuals[:, n:]))
        estimate = Estimate(
            window.time - 1,
            trajectory,
            residuals,
            trial.cost,
            candidate.trajectory.copy(),
            candidate.cost,
            status,
            message,
            outcome.qps,
            outcome.solver_iterations,
            outcome.solve_time,
            outcome.corrections,
            outcome.dropped,
            outcome.nearest_points,
            filtered,
            self._disturbances,
            window.z[window.end].copy(),
            window.rejected if window.rejects else None,
            outcome.restored_cost,
        )
        # Where the newest stage failed, J of the candidate is infinite.
        if not finite and outcome.improved and window.newest_failed:
            window.restart(estimate.state)
            estimate.observer_state = estimate.state.copy()
        if problem.hold is not None:
            window.trust(problem.hold, trajectory if outcome.improved else None)
        # The estimate's arrays are the user's.
        window.trajectory = (trajectory if outcome.followed is None else outcome.followed).copy()
        estimate.step_time = perf_counter() - began
        return estimate

    def _shifted(self) -> Array | None:
        """The previous estimate, shifted by one step of the model to the present window."""
        window = self._window
        previous = window.trajectory
        if previous is None:
            return None
        shifted = np.empty((previous.shape[0] + 1, previous.shape[1]))
        shifted[:-1] = previous
        try:
            shifted[-1] = window.model.f(previous[-1], window.inputs[-1])
        except Exception:  # the model is not defined there: no warm start
            return None
        return shifted[shifted.shape[0] - 1 - window.length :]

    def amend(self, time: int, y: Array) -> Estimate:
        """Insert a late measurement, and estimate again."""
        began, window = perf_counter(), self._window
        self._set_undo_point(True)
        try:
            with np.errstate(all="ignore"):
                window.amend(time, y)
                window.trajectory = None  # of this window already: no warm start from it
                watched = window.watched
                estimate = self._estimate(began)
                window.watched = watched  # no sample more
            window.history[window.end] = estimate.state
            return estimate
        except BaseException:
            self.undo()
            raise

    def _set_undo_point(self, whole: bool) -> None:
        """Save what `undo` needs; all stages where some will be rewritten."""
        one, other = self._tools.nearby
        one.used = other.used = False
        self._undo = self._window.undo_point(whole)

    def undo(self) -> None:
        """Undo the last step; the solver loses its warm start."""
        self._undo()
        self._tools.subproblem.forget()
        self._solver.forget()

    def reset(self, initial_state: Array, system: System | None = None) -> None:
        """Forget all measurements and start at this state."""
        self._solver.forget()
        tools = self._tools
        if system is not None and system.evaluation is not tools.given.evaluation:
            given = _with_own_model(tools.given.evaluated_like(system))
            tools = self._tools_for(tools.usual, given)
        self.replace(tools, self._fresh_window(initial_state, tools))

    def set(self, changes: Conditions, parameters: Array | None) -> Estimate | None:
        """Change the conditions of all samples in the window and of later ones."""
        return self._change(changes, parameters, self._tools.given)

    def _change(
        self, changes: Conditions, parameters: Array | None, given: System
    ) -> Estimate | None:
        """Change the conditions, and the system without them."""
        began, before, window_before = perf_counter(), self._tools, self._window
        for one in before.nearby:
            one.used = False
        usual = changes.over(before.usual)
        if parameters is not None:
            usual = usual._replace(parameters=parameters)
        try:
            with np.errstate(all="ignore"):
                own = [one.without(changes) for one in window_before.own.values()]
                tools = self._tools_for(usual, given, lambda form: have_form(form, *own))
                window = self._fresh_window(window_before.initial_state, tools)
                window.take_over(window_before, changes, parameters)
                if self._reinitialized and window.length:
                    estimates = window.history[: window.end].copy()
                    estimates[0] = window.z[0]  # in the new X
                    window.reinitialize(estimates)
                self._solver.forget()
                self._tools, self._window = tools, window
                estimate = self._estimate(began) if window.length else None
                window.history[window.end] = window.z[0] if estimate is None else estimate.state
                window.watched = window_before.watched  # no sample more
            return estimate
        except BaseException:
            self.replace(before, window_before)
            raise

    @property
    def memory(self) -> tuple[Tools, Window]:
        """What `replace` restores."""
        return self._tools, self._window

    def replace(self, tools: Tools, window: Window) -> None:
        """Replace the memory: all of it or, if interrupted, nothing."""
        before = self._tools, self._window
        try:
            self._use(tools, window)
        except BaseException:
            self._use(*before)
            raise

    def _use(self, tools: Tools, window: Window) -> None:
        self._tools, self._window = tools, window
        if tools.given.is_traced:
            self._times.restart(window.time)
        else:
            self._times.end()

    def adopt(
        self, usual: Conditions, record: MemoryRecord, residuals: Array,
        metric: tuple[Array, bool] | None, replay: bool,
    ) -> None:
        """Continue from another engine's record.

        With its joint residuals along the candidate, and the state of its `ErrorMetric`. With
        ``replay``, the observer runs through the window's samples again.
        """
        tools, own = self._tools, record.own.values()
        if usual is not tools.usual or not have_form(tools.form, *own):
            tools = self._tools_for(usual, tools.given, lambda form: have_form(form, *own))
        window = self._fresh_window(record.z[record.start], tools)
        if window.metric is not None and metric is not None:
            window.metric.state = metric
        with np.errstate(all="ignore"):
            window.adopt(record, residuals)
            if replay:
                window.replay(window.length)
                if self._reinitialized and window.length:
                    window.reinitialize(window.history[window.start : window.end])
        self.replace(tools, window)

    def run(self, ys: Array, us: Array | None) -> None:
        """None: this engine only takes one sample at a time."""

    def covariances(self) -> Array:
        """Covariances along the last estimate."""
        trajectory = self._window.trajectory
        if trajectory is None:
            raise InvalidInputError("there is no estimate yet; call update first.")
        with np.errstate(all="ignore"):
            problem = self._tools.formulation.problem(self._window)
            trial = problem.evaluate(trajectory.copy(), roll_out=False)
            if trial.violation == math.inf:
                raise InvalidInputError("the model has no finite values along the estimate.")
            return window_covariances(
                problem.model, trial.trajectory, problem.inputs,
                self._tools.form.whole(trial.weights),
                weight_of_first(problem.terms, trial),
                problem.constraints.basis, root_of_first(problem.terms, trial),
            )

    def solved(self) -> Solved:
        """The last step's problem and its estimate."""
        window, formulation = self._window, self._tools.formulation
        if window.trajectory is None:
            raise InvalidInputError("there is no estimate yet; call update first.")
        with np.errstate(all="ignore"):
            problem = formulation.problem(window)
        return Solved(problem, formulation, window.trajectory.copy(), window.conditions)

    def state_dict(self) -> dict[str, Any]:
        """The memory as plain arrays and numbers; a solver's warm start is not among them."""
        places = self._tools.form.places
        return {
            "problem": self._size(),
            "engine": self.name,
            "estimator": self._description(),
            "linearized": self._with_terms,
            "usual": self._tools.usual.state_dict(),
            "window": self._window.state_dict(),
        } | ({"places": dict(places)} if places else {})

    def forget_warm_start(self) -> None:
        """Have the next QP start without what the solver has kept."""
        self._solver.forget()

    def _description(self) -> dict[str, Any]:
        return described(self._tools.given, self._observer, self._given_cost, self._settings)

    def _size(self) -> tuple[int, ...]:
        system = self._tools.given
        return system.n, system.p, system.m, self._settings.horizon

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another estimator stopped."""
        check_problem(state, self._size())
        if str(state.get("engine", "python")) != "python":
            raise InvalidInputError(
                f"the state is from an estimator with engine={state['engine']!r}, but this "
                "one runs the Python step; create it with that engine, which needs a C "
                "compiler, or take the snapshot with engine='python'."
            )
        with reading():
            check_description(state["estimator"], self._description())
            tools, window = self._checked_memory(state)
            self._solver.forget()
        self.replace(tools, window)

    def _checked_memory(
        self, state: dict[str, Any], fits: Callable[[WholeForm], bool] = lambda _: True
    ) -> tuple[Tools, Window]:
        """The memory in a state, with matrices in a form that fits."""
        with_terms, saved, places = state["linearized"], state["window"], state.get("places", {})
        if not isinstance(with_terms, bool):
            raise TypeError(f"linearized is {with_terms!r}")
        given = self._tools.given
        tools = self._tools_for(
            self._reader.load(state["usual"], self._tools.usual), given,
            lambda form: form.holds(form.readable(saved, places)) and fits(form),
        )
        window = self._fresh_window(np.zeros(given.n), tools)
        window.load_state_dict(
            tools.form.taken(tools.form.readable(saved, places)),
            lambda own: self._reader.load(own, tools.usual),
            may_be_irregular=given.has_timed, is_smoothed=self._smoothed,
            # A graduated loss may leave the trajectory of a widened one.
            ends_alike=self._cost.graduation == 1.0,
        )
        if window.has_terms and not with_terms:
            with np.errstate(all="ignore"):
                window.restate()
        return tools, window


def _with_own_model(system: System) -> System:
    return system.evaluated_by(system.evaluation.copy())


def _nearby(system: System) -> tuple[Nearby, Nearby]:
    return system.f_jacobian.nearby, system.h_jacobian.nearby
