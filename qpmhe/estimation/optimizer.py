"""The sequence of QPs, which accepts an iterate only by its true cost (eq:estimator)."""

from __future__ import annotations

import math
from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP, Solution, SolveStatus
from qpmhe_solvers.contained import ContainedSolver

from .estimate import Status
from .limits import CORRECTIONS, LENGTHS, NEARLY, ROUNDING, STALLED
from .problem import Problem, Trial
from .settings import Settings
from .subproblem import Subproblem
from .window import Window

__all__ = ["Optimizer", "Outcome"]

Array = NDArray[np.float64]


class Outcome:
    """The result of the sequence of QPs, updated while it runs.

    Attributes
    ----------
    reference : Trial
        The candidate, or its projection onto the sets.
    trial : Trial
        The best trajectory so far, at first the reference.
    improved : bool
        Whether it is better than the reference.
    events : Status
        Why the sequence stopped, and what happened.
    message, qps, corrections, solver_iterations, solve_time, dropped
        As in `Estimate`.
    """

    # Class attributes as defaults: few of them change in most steps.
    improved: bool = False
    events: Status = Status(0)
    message: str = ""
    qps: int = 0
    corrections: int = 0
    solver_iterations: int | None = 0
    solve_time: float = 0.0
    dropped: tuple[str, ...] = ()

    def __init__(self, candidate: Trial, deadline: float = math.inf) -> None:
        self.reference = self.trial = candidate
        self.deadline = deadline

    def time_is_up(self) -> bool:
        """Whether the deadline has passed; adds it to the events."""
        late = self.deadline < math.inf and perf_counter() > self.deadline
        if late:
            self.events |= Status.TIME_UP
        return late

    def remaining(self, now: float) -> float | None:
        """Seconds left, None without a deadline; adds to the events if there are none."""
        if self.deadline == math.inf:
            return None
        left = self.deadline - now
        if left <= 0.0:
            self.events |= Status.TIME_UP
        return left

    def count(self, iterations: int | None, seconds: float) -> None:
        """Add a solve's iterations and time."""
        self.solve_time += seconds
        if iterations is None or self.solver_iterations is None:
            self.solver_iterations = None
        else:
            self.solver_iterations += iterations


class Optimizer:
    """Gauss-Newton steps from the candidate, each judged by the true problem.

    A step that does not lower J below the best so far is shortened, and
    dropped if no length helps. So J of the result is never above the candidate's, and the
    result satisfies the constraints, whatever the solver returns.
    """

    def __init__(
        self,
        subproblem: Subproblem,
        solver: ContainedSolver,
        settings: Settings,
    ) -> None:
        self._subproblem, self._solver = subproblem, solver
        self._limit, self._tolerance = settings.qp_limit, settings.tolerance
        self._outside = settings.outside

    def improve(
        self,
        problem: Problem,
        window: Window,
        start: Array | None = None,
        deadline: float = math.inf,
    ) -> Outcome:
        """Run the sequence on a bound problem; never raises, whatever solver and model do."""
        candidate = problem.candidate(window)
        outcome = Outcome(candidate, deadline)
        if problem.constrained and not self._treat_violated_sets(problem, window, outcome):
            return outcome
        if self._limit == 0:
            outcome.events |= Status.NO_QPS
            return outcome
        qp: QP | None = None
        if start is not None:
            trial = problem.evaluate(_clipped(problem, start.copy()))
            if trial.cost < _target(outcome.trial):
                outcome.trial, outcome.improved = trial, True
        for _ in range(self._limit):
            if outcome.time_is_up():
                break
            if outcome.trial is candidate:
                qp = self._subproblem.at_candidate(problem, window)
            else:
                qp = self._subproblem.at(problem, outcome.trial)
            if qp is None:
                outcome.events |= Status.MODEL_FAILED
                outcome.message = self._subproblem.failure
                break
            if not self._step(problem, qp, outcome):
                break
        return outcome

    def _treat_violated_sets(self, problem: Problem, window: Window, outcome: Outcome) -> bool:
        """Project a candidate outside of the sets, or leave them out; False skips the QPs."""
        violated = problem.violated_sets(outcome.trial)
        if not violated:
            return True
        if self._outside == "keep":
            outcome.events |= Status.CANDIDATE_OUTSIDE
            return False
        if self._outside == "project" and self._limit > 0:
            projected = self._project(problem, window, outcome)
            if projected.cost < math.inf:
                outcome.reference = outcome.trial = projected
                outcome.events |= Status.PROJECTED
                return True
        problem.leave_out(violated)
        outcome.dropped = violated
        outcome.events |= Status.SETS_DROPPED
        return True

    def _project(self, problem: Problem, window: Window, outcome: Outcome) -> Trial:
        """The candidate projected onto the sets by QPs; its cost is infinite if this fails."""
        candidate = outcome.trial
        qp = self._subproblem.projection(problem, window)
        trial = candidate
        for attempt in range(1 + CORRECTIONS):
            if outcome.time_is_up():
                return replace(candidate, cost=math.inf, violation=math.inf)
            solution = self._solve(qp, outcome)
            step = None if solution is None else solution.d
            if step is None:
                return replace(candidate, cost=math.inf, violation=math.inf)
            trial = self._trial(problem, candidate, step)
            if trial.cost < math.inf or not math.isfinite(trial.violation):
                return trial
            if attempt < CORRECTIONS:
                self._subproblem.correct_rows(qp, problem, candidate, trial)
                outcome.corrections += 1
        return trial

    def _step(self, problem: Problem, qp: QP, outcome: Outcome) -> bool:
        """Solve one QP and evaluate its step; whether another QP is worth solving."""
        solution = self._solve(qp, outcome)
        if solution is None:
            return False
        outcome.qps += 1
        step = solution.d
        if step is None:
            outcome.events |= Status.SOLVER_FAILED
            outcome.message = solution.message
            return False
        best = outcome.trial
        target, negligible = _target(best), self._tolerance * (best.cost + self._tolerance)
        if not math.isfinite(negligible):
            negligible = -1.0  # J is infinite here: no decrease is negligible
        solved = solution.status is SolveStatus.SOLVED
        if not solved:
            outcome.events |= Status.SOLVER_STOPPED
        trial = self._trial(problem, best, step)
        if trial.cost < target:
            return self._accept(outcome, trial, solved, negligible)
        predicted = abs(float(np.vdot(qp.gradient, step)))  # the QP's decrease of J
        if 0.0 < trial.violation < math.inf and qp.rows:
            missed = trial
            if trial.violation <= NEARLY:
                trial = self._trial(problem, best, LENGTHS[0] * step)
            # If the shortened step leaves the set, too, curvature is the reason.
            if not trial.cost < target and not (solved and predicted <= negligible):
                step = step.copy()  # the correction's solve overwrites it
                trial = self._correct(problem, qp, outcome, missed)
        if not trial.cost < target:
            # At a minimum no step lowers J by more than rounding: this is no failure.
            if solved and predicted <= negligible:
                outcome.events |= Status.CONVERGED
                return False
            for length in LENGTHS:
                trial = self._trial(problem, best, length * step)
                if trial.cost < target:
                    break
            else:
                stalled = solved and predicted <= STALLED * negligible
                outcome.events |= Status.CONVERGED if stalled else Status.NO_DECREASE
                outcome.message = problem.failure(trial)
                return False
        return self._accept(outcome, trial, solved, negligible)

    @staticmethod
    def _accept(outcome: Outcome, trial: Trial, solved: bool, negligible: float) -> bool:
        """Accept a better trajectory; whether another QP is worth solving."""
        decrease = outcome.trial.cost - trial.cost
        outcome.trial, outcome.improved = trial, True
        if solved and decrease <= negligible:
            outcome.events |= Status.CONVERGED
            return False
        return True

    def _correct(self, problem: Problem, qp: QP, outcome: Outcome, trial: Trial) -> Trial:
        """Second-order corrections of a trial that curvature takes out of a set."""
        best = outcome.trial
        for _ in range(CORRECTIONS):
            if outcome.time_is_up():
                break
            self._subproblem.correct_rows(qp, problem, best, trial)
            solution = self._solve(qp, outcome)
            if solution is None:
                break
            outcome.corrections += 1
            if solution.d is None:
                break
            trial = self._trial(problem, best, solution.d)
            if trial.cost < math.inf or not math.isfinite(trial.violation):
                break
        return trial

    def _solve(self, qp: QP, outcome: Outcome) -> Solution | None:
        """The solver's solution of a QP within the time left; None if none is left."""
        began = perf_counter()
        left = outcome.remaining(began)
        if left is not None and left <= 0.0:
            return None
        solution = self._solver.solve(qp, None, left)
        outcome.count(solution.iterations, perf_counter() - began)
        return solution

    @staticmethod
    def _trial(problem: Problem, best: Trial, step: Array) -> Trial:
        return problem.evaluate(_clipped(problem, best.trajectory + step))


def _clipped(problem: Problem, trajectory: Array) -> Array:
    if problem.states is not None:
        np.clip(trajectory, problem.states.lower, problem.states.upper, out=trajectory)
    return trajectory


def _target(best: Trial) -> float:
    """The cost below which a trial is better than the best one."""
    return best.cost - ROUNDING * best.cost if best.cost < math.inf else math.inf
