"""The sequence of QPs, which accepts only what the true cost approves (eq:estimator)."""

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

_NONE = Status(0)


class Outcome:
    """What the sequence of QPs came to.

    Attributes
    ----------
    reference : Trial
        The candidate, or its projection onto the sets.
    trial : Trial
        The best trajectory, the reference itself if nothing was better.
    improved : bool
        Whether it is not the reference.
    events : Status
        Why the sequence stopped, and what happened.
    message : str
        Words of a solver that failed.
    qps, corrections : int
        QPs solved, and second-order corrections among the solves beside them.
    solver_iterations : int or None
        Sum of the solver's own counts, None where it does not tell.
    solve_time : float
        Seconds in the solver.
    dropped : tuple of str
        Names of the sets that were left out.
    """

    # Of the class until they change, which in most steps few of them do.
    improved: bool = False
    events: Status = _NONE
    message: str = ""
    qps: int = 0
    corrections: int = 0
    solver_iterations: int | None = 0
    solve_time: float = 0.0
    dropped: tuple[str, ...] = ()

    def __init__(self, candidate: Trial, deadline: float = math.inf) -> None:
        self.reference = self.trial = candidate
        self.deadline = deadline

    def late(self) -> bool:
        """Whether the time is up, which is noted then."""
        late = self.deadline < math.inf and perf_counter() > self.deadline
        if late:
            self.events |= Status.TIME_UP
        return late

    def remaining(self, now: float) -> float | None:
        """Seconds left at a reading of the clock, noted if there are none; None for no limit."""
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

    A trial that does not lower J over the best trajectory so far is shortened towards it,
    and dropped if no length helps. So J of the result is never above the candidate's, and
    the result satisfies the constraints, whatever the solver returns.
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
        """Run the sequence on a bound problem; never raises on account of solver or model."""
        candidate = problem.candidate(window)
        outcome = Outcome(candidate, deadline)
        if problem.constrained and not self._reconcile(problem, window, outcome):
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
            if outcome.late():
                break
            if outcome.trial is candidate:
                qp = self._subproblem.at_candidate(problem, window)
            else:
                qp = self._subproblem.at(problem, outcome.trial)
            if qp is None:
                outcome.events |= Status.MODEL_FAILED
                break
            if not self._step(problem, qp, outcome):
                break
        return outcome

    def _reconcile(self, problem: Problem, window: Window, outcome: Outcome) -> bool:
        """Deal with a candidate outside of the sets; whether to go on to the QPs."""
        violated = problem.violated_sets(outcome.trial)
        if not violated:
            return True
        if self._outside == "keep":
            outcome.events |= Status.CANDIDATE_OUTSIDE
            return False
        if self._outside == "project" and self._limit > 0:
            projected = self._projected(problem, window, outcome)
            if projected.cost < math.inf:
                outcome.reference = outcome.trial = projected
                outcome.events |= Status.PROJECTED
                return True
        problem.leave_out(violated)
        outcome.dropped = violated
        outcome.events |= Status.SETS_DROPPED
        return True

    def _projected(self, problem: Problem, window: Window, outcome: Outcome) -> Trial:
        """The nearest trajectory that satisfies the linearised sets, if it does the true ones."""
        candidate = outcome.trial
        qp = self._subproblem.nearest(problem, window)
        trial = candidate
        for attempt in range(1 + CORRECTIONS):
            if outcome.late():
                return replace(candidate, cost=math.inf, violation=math.inf)
            solution = self._solve(qp, outcome)
            step = None if solution is None else solution.d
            if step is None:
                return replace(candidate, cost=math.inf, violation=math.inf)
            trial = self._trial(problem, candidate, step)
            if trial.cost < math.inf or not math.isfinite(trial.violation):
                return trial
            if attempt < CORRECTIONS:
                self._subproblem.corrected(qp, problem, candidate, trial)
                outcome.corrections += 1
        return trial

    def _solve(self, qp: QP, outcome: Outcome) -> Solution | None:
        """What the solver makes of a QP in the time that remains; None if there is none."""
        began = perf_counter()
        left = outcome.remaining(began)
        if left is not None and left <= 0.0:
            return None
        solution = self._solver.solve(qp, None, left)
        outcome.count(solution.iterations, perf_counter() - began)
        return solution

    def _step(self, problem: Problem, qp: QP, outcome: Outcome) -> bool:
        """Solve one QP and judge its iterate; whether another QP is worth while."""
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
        target, enough = _target(best), self._tolerance * (best.cost + self._tolerance)
        if not math.isfinite(enough):
            enough = -1.0  # a candidate that cannot be judged: nothing converges to it
        solved = solution.status is SolveStatus.SOLVED
        if not solved:
            outcome.events |= Status.SOLVER_STOPPED
        trial = self._trial(problem, best, step)
        if trial.cost < target:
            return self._accept(outcome, trial, solved, enough)
        promised = abs(float(np.vdot(qp.gradient, step)))
        if 0.0 < trial.violation < math.inf and qp.rows:
            missed = trial
            if trial.violation <= NEARLY:
                trial = self._trial(problem, best, LENGTHS[0] * step)
            # A set missed by its curvature is missed by the first length as well.
            if not trial.cost < target and not (solved and promised <= enough):
                step = step.copy()  # a correction's solve reuses the solver's workspace
                trial = self._corrected(problem, qp, outcome, missed)
        if not trial.cost < target:
            # Near a minimum J cannot be lowered beyond its rounding: not a failure.
            if solved and promised <= enough:
                outcome.events |= Status.CONVERGED
                return False
            for length in LENGTHS:
                trial = self._trial(problem, best, length * step)
                if trial.cost < target:
                    break
            else:
                stalled = solved and promised <= STALLED * enough
                outcome.events |= Status.CONVERGED if stalled else Status.NO_DECREASE
                return False
        return self._accept(outcome, trial, solved, enough)

    @staticmethod
    def _accept(outcome: Outcome, trial: Trial, solved: bool, enough: float) -> bool:
        """Take a better trajectory over; whether another QP is worth while."""
        gained = outcome.trial.cost - trial.cost
        outcome.trial, outcome.improved = trial, True
        if solved and gained <= enough:
            outcome.events |= Status.CONVERGED
            return False
        return True

    def _corrected(self, problem: Problem, qp: QP, outcome: Outcome, trial: Trial) -> Trial:
        """Second-order corrections of a trial that misses a set by its curvature."""
        best = outcome.trial
        for _ in range(CORRECTIONS):
            if outcome.late():
                break
            self._subproblem.corrected(qp, problem, best, trial)
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

    @staticmethod
    def _trial(problem: Problem, best: Trial, step: Array) -> Trial:
        return problem.evaluate(_clipped(problem, best.trajectory + step))


def _clipped(problem: Problem, trajectory: Array) -> Array:
    if problem.states is not None:
        np.clip(trajectory, problem.states.lower, problem.states.upper, out=trajectory)
    return trajectory


def _target(best: Trial) -> float:
    """What a trial's cost must be below to count as better."""
    return best.cost - ROUNDING * best.cost if best.cost < math.inf else math.inf
