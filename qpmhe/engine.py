"""One step of the estimator in Python, and all that it remembers from step to step."""

from __future__ import annotations

import math
from collections import deque
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import SolverOptions, create
from qpmhe_solvers.contained import ContainedSolver

from ._checks import check_problem
from .costs import Cost
from .covariance import window_covariances
from .errors import InvalidInputError
from .estimate import Estimate, Status
from .exact import ExactStep
from .observers import Observer
from .optimizer import Optimizer
from .problem import Problem
from .settings import Settings
from .subproblem import Subproblem
from .system import System
from .window import Window

__all__ = ["PythonEngine"]

Array = NDArray[np.float64]


class PythonEngine:
    """The loop body: sample in, observer, candidate, QPs, verdict, estimate out.

    Everything it is given was checked by `MovingHorizonEstimator`, whose methods of the
    same names document these.

    Parameters
    ----------
    system, observer, cost, settings, initial_state
        The estimator's.
    """

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
        options = SolverOptions(
            max_iterations=settings.max_solver_iterations,
            absolute_tolerance=float(settings.solver_tolerance),
            time_limit=None if settings.time_budget is None else float(settings.time_budget),
        )
        self._solver = solver = ContainedSolver(
            create(settings.backend, options, isolated=settings.isolated)
        )
        if settings.qp_limit:
            solver.prepare((settings.horizon + 1) * system.n)
        if system.joint is not None:
            system.joint.prepare(settings.horizon)
        self._problem = Problem(system, cost)
        self._subproblem = Subproblem(system, cost, settings.horizon)
        exact = None
        if settings.subproblem == "exact":
            exact = ExactStep(system, cost)
            exact.prepare(settings.horizon)
        self._optimizer = Optimizer(self._subproblem, solver, settings, exact)
        self._window = self._fresh_window(initial_state)
        self._trajectory: Array | None = None  # the last estimate's
        self._dropped: tuple[str, ...] = ()
        # Estimates of x(t-N), ..., x(t), each made at its own time.
        self._history: deque[Array] = deque([initial_state.copy()], maxlen=settings.horizon + 1)

    def reset(self, initial_state: Array) -> None:
        """Forget all measurements and start at this state."""
        self._solver.forget()
        self._window.reset(initial_state, self._observer.initial_covariance())
        self._trajectory, self._dropped = None, ()
        self._history.clear()
        self._history.append(initial_state.copy())

    def _fresh_window(self, initial_state: Array) -> Window:
        settings = self._settings
        return Window(
            self._system, self._observer, self._cost, settings.horizon, initial_state,
            settings.qp_limit > 0,
        )

    @property
    def state(self) -> Array:
        """The current estimate."""
        return self._history[-1]

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
        window = self._window
        with np.errstate(all="ignore"):
            if window.length == self._settings.horizon:
                self._solver.shift()
            missing, held, flat = window.push(y, u, dt, noise_weight)
            if self._settings.candidate == "reinitialized":
                # The history reaches back to the estimate of the window's first state.
                first = self._history[len(self._history) - window.length]
                missing, held, flat = window.replay(window.length, first)
            estimate = self._estimate(missing, held, flat, began)
        self._history.append(estimate.state.copy())  # a view would keep the trajectory
        return estimate

    def amend(self, time: int, y: Array) -> Estimate:
        """Put a late measurement in its place, and estimate again."""
        began = perf_counter()
        with np.errstate(all="ignore"):
            self._window.amend(time, y)
            self._trajectory = None  # it does not belong to the window before this one
            missing = not self._window.observed[-1].all()
            held = self._window.newest_is_held
            estimate = self._estimate(missing, held, False, began)
        self._history[-1] = estimate.state.copy()
        return estimate

    def covariances(self) -> Array:
        """Covariances along the last estimate."""
        if self._trajectory is None:
            raise InvalidInputError("there is no estimate yet; update first.")
        with np.errstate(all="ignore"):
            return window_covariances(self._problem, self._trajectory)

    def _estimate(self, missing: bool, held: bool, flat: bool, began: float) -> Estimate:
        """Solve the window's problem as it stands."""
        window, problem, settings = self._window, self._problem, self._settings
        problem.bind(window)
        start = self._shifted() if settings.start == "best" else None
        deadline = math.inf if settings.time_budget is None else began + settings.time_budget
        outcome = self._optimizer.improve(problem, window, start, deadline)
        trial, reference = outcome.trial, outcome.reference
        trajectory, residuals = trial.trajectory, trial.residuals
        status = Status.IMPROVED if outcome.improved else Status.CANDIDATE
        if outcome.events:
            status |= outcome.events
        if missing:
            status |= Status.MISSING
        if held or flat:
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
        if held and outcome.improved:
            window.restart(estimate.state)
        self._trajectory, self._dropped = trajectory, outcome.dropped
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
        return {
            "problem": self._size(),
            "window": self._window.state_dict(),
            "history": [state.copy() for state in self._history],
            "trajectory": None if self._trajectory is None else self._trajectory.copy(),
            "dropped": self._dropped,
            # How the model is called: another way of calling would round differently.
            "modes": [one.mode for system in self._systems() for one in (system.f, system.h)],
            "methods": [
                one.method for system in self._systems()
                for one in (system.f_jacobian, system.h_jacobian)
            ],
        }

    def _systems(self) -> list[System]:
        """The system, and that for steps of other lengths once it is in use."""
        timed = self._system.__dict__.get("timed")
        return [self._system] if timed is None else [self._system, timed]

    def _size(self) -> tuple[int, ...]:
        system = self._system
        return system.n, system.p, system.m, self._settings.horizon

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where another estimator stopped."""
        system = self._system
        check_problem(state, self._size())
        if state.get("engine", "python") != "python":
            raise InvalidInputError(
                f"the state is of an estimator with engine={state['engine']!r}, which is not at "
                "work here; install a C compiler, or snapshot with engine='python'."
            )
        try:
            if not self._window.fits(state["window"]):
                raise InvalidInputError(
                    "the state is of an estimator with another observer or cost."
                )
            history = [np.array(x, np.float64).reshape(system.n) for x in state["history"]]
            window = self._fresh_window(history[-1])
            window.load_state_dict(state["window"])
            trajectory, dropped = state["trajectory"], tuple(state["dropped"])
            if trajectory is not None:
                trajectory = np.array(trajectory, np.float64).reshape(-1, system.n)
            modes, methods = tuple(state["modes"]), tuple(state["methods"])
            if len(modes) not in (2, 4) or len(methods) != len(modes):
                raise ValueError("modes and methods are of other numbers of functions")
            if len(modes) == 4 and system._timed is None:
                raise ValueError("the system has no steps of other lengths")
        except (KeyError, IndexError, TypeError, ValueError) as error:
            if isinstance(error, InvalidInputError):
                raise
            raise InvalidInputError(
                f"the state is damaged ({type(error).__name__}: {error}); expected what "
                "state_dict gave, unchanged."
            ) from error
        # All of it could be read: from here on nothing fails, and nothing is half done.
        self._solver.forget()
        self._window, self._trajectory, self._dropped = window, trajectory, dropped
        self._history.clear()
        self._history.extend(history)
        systems = [system] if len(modes) == 2 else [system, system.timed]
        for k, one in enumerate(systems):
            one.f.mode, one.h.mode = modes[2 * k : 2 * k + 2]
            one.f_jacobian.use(methods[2 * k])
            one.h_jacobian.use(methods[2 * k + 1])
        if trajectory is not None:
            self._problem.bind(self._window)
            self._problem.leave_out(self._dropped)
