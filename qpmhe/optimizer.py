"""The sequence of QPs, which accepts only what the true cost approves (eq:estimator)."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP, Solver, SolveStatus

from .estimate import Status
from .problem import Problem, Trial
from .subproblem import Subproblem
from .window import Window

__all__ = ["Optimizer", "Outcome"]

Array = NDArray[np.float64]

# Tried in turn where the full step fails; the last is short enough for any descent direction
# that is worth taking.
_LENGTHS = (0.5, 0.25, 0.125, 0.0625, 0.015625, 0.00390625)

# A decrease of J by less than this share is rounding, and no improvement.
_ROUNDING = 1e-12

_NONE = Status(0)


@dataclass(slots=True)
class Outcome:
    """What the sequence of QPs came to.

    Parameters
    ----------
    trial : Trial
        The best trajectory, the candidate itself if nothing was better.
    improved : bool
        Whether it is not the candidate.
    events : Status
        Why the sequence stopped, and what happened.
    message : str
        Words of a solver that failed.
    qps : int
        QPs solved.
    solver_iterations : int or None
        Sum of the solver's own counts, None where it does not tell.
    solve_time : float
        Seconds in the solver.
    """

    trial: Trial
    improved: bool = False
    events: Status = _NONE
    message: str = ""
    qps: int = 0
    solver_iterations: int | None = 0
    solve_time: float = 0.0


class Optimizer:
    r"""Gauss-Newton steps from the candidate, each judged by the true problem.

    A trial that does not lower J over the best trajectory so far is shortened towards it,
    and dropped if no length helps. So J of the result is never above the candidate's, and
    the result satisfies the constraints, whatever the solver returns.

    Parameters
    ----------
    subproblem : Subproblem
        Where the QPs come from.
    solver : Solver
        Where they go.
    max_qps : int
        Cap on the QPs of one window.
    tolerance : float
        The sequence has converged when a solved QP lowers J by less than this share of it.
    """

    def __init__(
        self, subproblem: Subproblem, solver: Solver, max_qps: int, tolerance: float
    ) -> None:
        self._subproblem, self._solver = subproblem, solver
        self._max_qps, self._tolerance = max_qps, tolerance

    def improve(self, problem: Problem, window: Window) -> Outcome:
        """Run the sequence on a bound problem; never raises on account of solver or model."""
        outcome = Outcome(problem.candidate(window))
        if self._max_qps == 0:
            outcome.events = Status.NO_QPS
            return outcome
        qp: QP | None = self._subproblem.at_candidate(problem, window)
        for count in range(self._max_qps):
            if count > 0:
                qp = self._subproblem.at(problem, outcome.trial)
            if qp is None:
                outcome.events |= Status.MODEL_FAILED
                break
            if not self._step(problem, qp, outcome):
                break
        return outcome

    def _step(self, problem: Problem, qp: QP, outcome: Outcome) -> bool:
        """Solve one QP and judge its iterate; whether another QP is worth while."""
        began = perf_counter()
        solution = self._solver.solve(qp)
        outcome.solve_time += perf_counter() - began
        outcome.qps += 1
        if solution.iterations is None or outcome.solver_iterations is None:
            outcome.solver_iterations = None
        else:
            outcome.solver_iterations += solution.iterations
        step = solution.d
        if step is None:
            outcome.events |= Status.SOLVER_FAILED
            outcome.message = solution.message
            return False
        best = outcome.trial
        trial = self._trial(problem, best, step)
        enough = self._tolerance * (best.cost + self._tolerance)
        solved = solution.status is SolveStatus.SOLVED
        if not solved:
            outcome.events |= Status.SOLVER_STOPPED
        target = best.cost - _ROUNDING * best.cost if best.cost < np.inf else np.inf
        if not trial.cost < target:
            # Near a minimum J cannot be lowered beyond its rounding: not a failure.
            if solved and abs(float(np.vdot(qp.gradient, step))) <= enough:
                outcome.events |= Status.CONVERGED
                return False
            for length in _LENGTHS:
                trial = self._trial(problem, best, length * step)
                if trial.cost < target:
                    break
            else:
                outcome.events |= Status.NO_DECREASE
                return False
        outcome.trial, outcome.improved = trial, True
        if solved and best.cost - trial.cost <= enough:
            outcome.events |= Status.CONVERGED
            return False
        return True

    @staticmethod
    def _trial(problem: Problem, best: Trial, step: Array) -> Trial:
        trajectory = best.trajectory + step
        if problem.states is not None:
            np.clip(trajectory, problem.states.lower, problem.states.upper, out=trajectory)
        return problem.evaluate(trajectory)
