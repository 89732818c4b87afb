"""One step of the estimator in Python, and all that it remembers from step to step."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import Solver, create
from qpmhe_solvers.contained import ContainedSolver

from .._checks import check_problem
from ..costs import Cost
from ..errors import InvalidInputError
from ..model.system import System
from ..observers import Observer
from .covariance import window_covariances
from .estimate import Estimate, Status
from .optimizer import Optimizer
from .problem import Problem
from .settings import Settings
from .snapshot import SET_NAMES, check_description, described, reading, taken
from .stages import Mark
from .subproblem import Subproblem
from .window import Window

__all__ = ["PythonEngine"]

Array = NDArray[np.float64]


class PythonEngine:
    """The loop body: sample in, observer, candidate, QPs, verdict, estimate out.

    Everything it is given was checked by `MovingHorizonEstimator`, whose methods of the
    same names document these.
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
        self._system, self._observer, self._cost = system, observer, cost
        self._settings = settings
        given = settings.backend
        self._solver = solver = ContainedSolver(
            given if isinstance(given, Solver)
            else create(given, settings.solver_options, isolated=settings.isolated)
        )
        if settings.qp_limit:
            solver.prepare((settings.horizon + 1) * system.n)
        if system.kernel is not None:
            system.kernel.prepare(settings.horizon)
        self._problem = Problem(system, cost)
        self._subproblem = Subproblem(system, cost, settings.horizon)
        self._optimizer = Optimizer(self._subproblem, solver, settings)
        self._linearized = settings.qp_limit > 0
        self._window = self._fresh_window(initial_state)
        self._made = system.call_modes()  # how the model is called, as found at construction
        self._before: tuple[Mark, Array | None, tuple[str, ...], tuple[Array, ...]]
        self._trajectory: Array | None = None  # the last estimate's
        self._dropped: tuple[str, ...] = ()
        # Estimates of x(t-N), ..., x(t), each made at its own time; or the last where it suffices.
        again = settings.candidate == "reinitialized"
        self._history: deque[Array] = deque(
            [initial_state.copy()], maxlen=settings.horizon + 1 if again else 1
        )

    def run(self, ys: Array, us: Array | None) -> None:
        """Take only sample by sample."""

    def reset(self, initial_state: Array) -> None:
        """Forget all measurements and start at this state."""
        self._solver.forget()
        self.replace(self._fresh_window(initial_state), None, (), [initial_state.copy()])

    @property
    def memory(self) -> tuple[Window, Array | None, tuple[str, ...], deque[Array]]:
        """What `replace` takes."""
        return self._window, self._trajectory, self._dropped, self._history

    def replace(
        self, window: Window, trajectory: Array | None, dropped: tuple[str, ...],
        history: Iterable[Array],
    ) -> None:
        """Remember this in place of all that was; whole or, if interrupted, not at all."""
        before = self.memory
        try:
            self._window, self._trajectory, self._dropped = window, trajectory, dropped
            self._history = deque(history, maxlen=self._history.maxlen)
        except BaseException:
            self._window, self._trajectory, self._dropped, self._history = before
            raise

    def _fresh_window(self, initial_state: Array) -> Window:
        settings = self._settings
        return Window(
            self._system, self._observer, self._cost, settings.horizon, initial_state,
            self._linearized,
        )

    @property
    def state(self) -> Array:
        """The current estimate."""
        return self._history[-1].copy()

    @property
    def time(self) -> int:
        """Number of measurements taken so far."""
        return self._window.time

    @property
    def length(self) -> int:
        """Number of samples in the window."""
        return self._window.length

    def step(
        self, y: Array, u: Array, dt: float | None, noise_weight: Array | None, began: float
    ) -> Estimate:
        """Take a sample in, and estimate."""
        window, again = self._window, self._settings.candidate == "reinitialized"
        if window.end == window.room:
            window.make_room()
        self._mark(again)
        try:
            with np.errstate(all="ignore"):
                if window.length == self._settings.horizon:
                    self._solver.shift()
                missing, model_failed, jacobian_failed = window.push(y, u, dt, noise_weight)
                if again:
                    # The history reaches back to the estimate of the window's first state.
                    first = self._history[len(self._history) - window.length]
                    missing, model_failed, jacobian_failed = window.replay(window.length, first)
                estimate = self._estimate(missing, model_failed, jacobian_failed, began)
            assert self._trajectory is not None
            newest = self._trajectory[-1]
            # Of many states, views would keep as many trajectories.
            self._history.append(newest.copy() if again else newest)
            return estimate
        except BaseException:  # an interrupt: the sample is not taken
            self.undo()
            raise

    def amend(self, time: int, y: Array) -> Estimate:
        """Put a late measurement in its place, and estimate again."""
        began = perf_counter()
        self._mark(True)
        try:
            with np.errstate(all="ignore"):
                self._window.amend(time, y)
                self._trajectory = None  # it does not belong to the window before this one
                missing = not self._window.observed[-1].all()
                model_failed = self._window.newest_failed
                estimate = self._estimate(missing, model_failed, False, began)
            self._history[-1] = estimate.state.copy()
            return estimate
        except BaseException:
            self.undo()
            raise

    def _mark(self, whole: bool) -> None:
        """Note what `undo` needs; whole where stages of the window are to be rewritten."""
        window = self._window.mark(whole)
        self._before = window, self._trajectory, self._dropped, tuple(self._history)

    def undo(self) -> None:
        """Take the last step back, as far as this is in our hands: solvers start afresh."""
        window, self._trajectory, self._dropped, history = self._before
        self._window.roll_back(window)
        self._history.clear()
        self._history.extend(history)
        self._subproblem.forget()
        self._solver.forget()

    def covariances(self) -> Array:
        """Covariances along the last estimate."""
        if self._trajectory is None:
            raise InvalidInputError("there is no estimate yet; update first.")
        problem = self._problem
        with np.errstate(all="ignore"):
            problem.bind(self._window)
            problem.leave_out(self._dropped)
            return window_covariances(problem, self._trajectory.copy())

    def _estimate(
        self, missing: bool, model_failed: bool, jacobian_failed: bool, began: float
    ) -> Estimate:
        """Solve the window's problem as it stands."""
        window, problem, settings = self._window, self._problem, self._settings
        problem.bind(window)
        start = self._shifted() if settings.warm_start else None
        deadline = math.inf if settings.time_budget is None else began + settings.time_budget
        outcome = self._optimizer.improve(problem, window, start, deadline)
        trial, reference = outcome.trial, outcome.reference
        trajectory, residuals = trial.trajectory, trial.residuals
        status = Status.IMPROVED if outcome.improved else Status.CANDIDATE
        if outcome.events:
            status |= outcome.events
        if missing:
            status |= Status.MISSING
        if model_failed or jacobian_failed:
            status |= Status.MODEL_FAILED
        elif not math.isfinite(reference.cost):
            status |= Status.FAILED_STAGE
        if not math.isfinite(reference.cost):
            status &= ~Status.NO_DECREASE  # no solver is to blame where nothing can be judged
        if not outcome.improved:
            trajectory = trajectory.copy()  # of the window, which moves on
        if problem.observed is not None or not outcome.improved:
            residuals = residuals.copy()
            if problem.observed is not None:
                residuals[:, self._system.n :][~problem.observed] = np.nan
        estimate = Estimate(
            window.time - 1,
            trajectory,
            residuals,
            trial.cost,
            reference.trajectory.copy(),
            reference.cost,
            status,
            outcome.message,
            outcome.qps,
            outcome.solver_iterations,
            outcome.solve_time,
            outcome.corrections,
            outcome.dropped,
            settings.delay,
        )
        if model_failed and outcome.improved:
            window.restart(estimate.state)
        # The estimate's arrays are the user's.
        self._trajectory, self._dropped = trajectory.copy(), outcome.dropped
        estimate.step_time = perf_counter() - began
        return estimate

    def _shifted(self) -> Array | None:
        """The previous estimate, moved on by one step of the model to the present window."""
        window, before = self._window, self._trajectory
        if before is None:
            return None
        shifted = np.empty((before.shape[0] + 1, before.shape[1]))
        shifted[:-1] = before
        try:
            shifted[-1] = window.model.f(before[-1], window.inputs[-1])
        except Exception:  # the model is not defined there: no start, then
            return None
        return shifted[shifted.shape[0] - 1 - window.length :]

    def state_dict(self) -> dict[str, Any]:
        """All that was learnt from measurements so far, as plain arrays and numbers."""
        # What a solver keeps is not written down: this estimator goes on without it, too.
        self._solver.forget()
        modes, methods = self._system.call_modes()
        return {
            "problem": self._size(),
            "estimator": self._description(),
            "linearized": self._linearized,
            "window": self._window.state_dict(),
            "history": [state.copy() for state in self._history],
            "trajectory": None if self._trajectory is None else self._trajectory.copy(),
            "dropped": self._dropped,
            # How the model is called: another way of calling would round differently.
            "modes": list(modes),
            "methods": list(methods),
        }

    def _description(self) -> dict[str, Any]:
        return described(self._system, self._observer, self._cost, self._settings)

    def _size(self) -> tuple[int, ...]:
        system = self._system
        return system.n, system.p, system.m, self._settings.horizon

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where another estimator stopped."""
        check_problem(state, self._size())
        if str(state.get("engine", "python")) != "python":
            raise InvalidInputError(
                f"the state is of an estimator with engine={state['engine']!r}, which is not at "
                "work here; install a C compiler, or snapshot with engine='python'."
            )
        before = self._system.call_modes()
        try:
            with reading():
                check_description(state["estimator"], self._description())
                modes = self._checked_calling(state["modes"], state["methods"])
                self._system.use_call_modes(modes)
                found = self._read(state)
                self._solver.forget()
            self.replace(*found)
        except BaseException:
            self._system.use_call_modes(before)
            raise

    def _read(
        self, state: dict[str, Any]
    ) -> tuple[Window, Array | None, tuple[str, ...], list[Array]]:
        """What a state's estimator remembered, checked."""
        n, linearized = self._system.n, state["linearized"]
        if not isinstance(linearized, bool):
            raise TypeError(f"linearized is {linearized!r}")
        window, again = (self._fresh_window(np.zeros(n)) for _ in range(2))
        for one in (window, again):
            one.load_state_dict(state["window"], self._system.make_timed is not None)
        history = [taken("history", one, (n,)) for one in state["history"]]
        count = min(window.length + 1, self._history.maxlen or 1)
        if len(history) != count:
            raise ValueError(f"history has {len(history)} states; expected {count}")
        trajectory = state["trajectory"]
        if (trajectory is None) != (window.time == 0):
            raise TypeError("trajectory is there exactly if there was a measurement")
        if trajectory is not None:
            trajectory = taken("trajectory", trajectory, (window.length + 1, n))
            if not np.array_equal(trajectory[-1], history[-1]):
                raise ValueError("history does not end where the trajectory does")
        dropped = state["dropped"]
        if not isinstance(dropped, tuple) or not all(
            isinstance(name, str) and getattr(self._system, name, None) is not None
            and name in SET_NAMES for name in dropped
        ):
            raise ValueError(f"dropped is {dropped!r}")
        alike = linearized == self._linearized
        again.check_stages(window, alike)
        return window if alike else again, trajectory, dropped, history

    def _checked_calling(
        self, modes: Any, methods: Any
    ) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """How a state's estimator called the model, if that is how it can be called here."""
        made = self._made
        if len(modes) == 4:
            if self._system.make_timed is None:
                raise ValueError("the system has no steps of other lengths")
            timed = self._system.make_timed().call_modes()
            made = made[0] + timed[0], made[1] + timed[1]
        for name, found, known, slowest in (
            ("modes", modes, made[0], "looped"),
            ("methods", methods, made[1], "finite differences"),
        ):
            if not isinstance(found, (list, tuple)) or len(found) != len(known):
                raise ValueError(f"{name} is {found!r}; expected {len(known)} of them")
            for one, mine in zip(found, known, strict=True):
                usual = isinstance(one, str) and one in (mine, slowest)
                if not usual and not (mine == "unknown" and one in ("batched", "columns")):
                    raise ValueError(f"{name} is {found!r}; expected {known}")
        return tuple(modes), tuple(methods)
