"""The sequence of QPs, with each iterate accepted only by its true cost (eq:estimator)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP, Solution, SolveStatus
from qpmhe_solvers.solver import ContainedSolver

from ..terms.base import Trial
from .estimate import DroppedRow, Status, naming_missed
from .limits import (
    ALONG,
    CORRECTIONS,
    DAMPING,
    FEASIBLE,
    LENGTHS,
    LESS_DAMPING,
    MORE_DAMPING,
    MOST_DAMPING,
    NEARER,
    NEAREST_POINTS,
    NEARLY,
    OLD_DAMPING,
    POOR,
    RESTORING,
    ROUNDING,
    SHORTER,
    STALLED,
    TOWARDS,
)
from .outcome import Outcome
from .problem import Problem
from .region import Dogleg, Region
from .settings import Settings
from .subproblem import Subproblem

Array = NDArray[np.float64]


# Other reasons for the end of a sequence than its cap.
_ENDS = (
    Status.CONVERGED | Status.NO_DECREASE | Status.SOLVER_FAILED | Status.MODEL_FAILED
    | Status.TIME_UP
)

# Statuses of QPs that need no ridge.
_FACTORISED = SolveStatus.SOLVED, SolveStatus.UNCONSTRAINED

# What no longer holds where another sequence begins.
_OUTDATED = Status.CONVERGED | Status.NO_DECREASE | Status.SOLVER_FAILED | Status.CAP_REACHED


class Optimizer:
    """Gauss-Newton steps from the candidate, each judged by the true problem.

    A step that does not lower J below the best so far is shortened (see `Region`, without
    inequalities), and rejected if no length helps; the next QP is damped then (Levenberg and
    Marquardt), more and more until its step lowers J. So J of the result is never above the
    candidate's, whatever the solver returns.

    Where the candidate satisfies all rows, so does the result. Where it does not, the result is

    (a) a trajectory that satisfies all rows, with J no greater than the candidate's; else
    (b) with ``infeasible="restore"``, one that satisfies all rows, with J no greater than that of
        the nearest such trajectory to the candidate; else
    (c) one that satisfies all rows but those that the candidate violates, with J no greater than
        the candidate's; else
    (d) the candidate.
    """

    def __init__(
        self, subproblem: Subproblem, solver: ContainedSolver, settings: Settings
    ) -> None:
        self._subproblem, self._solver = subproblem, solver
        self._limit, self._tolerance = settings.qp_limit, settings.tolerance
        self._uncapped, self._patience = settings.max_qps is None, settings.patience
        self._backend = settings.backend_name
        self._warm_start = settings.warm_start
        self._restores = settings.infeasible == "restore"
        # Most estimators have no soft rows and no nonlinear constraints.
        self._extended = subproblem.extended
        self._solution = self._softened_solution if self._extended else self._solve
        # Without inequalities, a region in place of lengths along the step.
        self._has_region = not subproblem.has_inequalities

    def improve(
        self,
        problem: Problem,
        shifted: Callable[[], Array | None],
        deadline: float = math.inf,
        damping: float = 0.0,
    ) -> Outcome:
        """Run the sequence; never raises, whatever solver and model do.

        Parameters
        ----------
        problem : Problem
            The problem of the window.
        shifted : callable
            Returns the previous estimate, shifted to this window, or None. A warm start begins
            there; so does a second search for a feasible trajectory, if the search near the
            candidate fails.
        deadline : float
            Time, by `time.perf_counter`, after which no QP begins.
        damping : float
            What the last step has left in `Outcome.damping`.
        """
        candidate = problem.candidate
        outcome = Outcome(candidate, deadline, damping)
        feasible = candidate.violation <= FEASIBLE
        if not feasible:
            outcome.events |= Status.CANDIDATE_OUTSIDE
        if self._limit == 0:
            outcome.events |= Status.NO_QPS
            return outcome
        if self._extended:
            self._subproblem.start()
        start = shifted() if self._warm_start else None
        if feasible:
            self._search(problem, outcome, start, self._limit)
            if outcome.trial is candidate and problem.rolled_out is not None:
                self._search_from_rolled_out(problem, outcome)
            outcome.improved = outcome.trial is not candidate
        else:
            self._search_from_outside(problem, outcome, start, shifted)
        if self._uncapped and outcome.qps >= self._limit and not outcome.events & _ENDS:
            outcome.events |= Status.UNCONVERGED
        return outcome

    def _search_from_rolled_out(self, problem: Problem, outcome: Outcome) -> None:
        """Search on from the trajectory of which the candidate's cost is, after a search in vain.

        No step from the candidate itself need lower this cost, however short.
        """
        candidate, rolled_out = outcome.trial, problem.evaluate(problem.candidate.trajectory)
        if rolled_out.cost < math.inf and outcome.qps < self._limit:
            outcome.trial = rolled_out
            outcome.events &= ~_OUTDATED
            self._search(problem, outcome, None, self._limit - outcome.qps)
            if outcome.trial is rolled_out:
                outcome.trial = candidate

    def _search_from_outside(
        self,
        problem: Problem,
        outcome: Outcome,
        start: Array | None,
        shifted: Callable[[], Array | None],
    ) -> None:
        """The sequence of QPs from a candidate that violates a set."""
        candidate = problem.candidate
        outside = replace(candidate, cost=math.inf)  # any feasible trial is better
        outcome.trial = nearest = outside
        # (a) As usual; else from a feasible trajectory near the candidate or the last estimate.
        self._search(problem, outcome, start, self._limit)
        if not outcome.trial.cost < math.inf:
            outcome.trial = nearest = self._feasible_near(problem, outcome, outside)
            if not outcome.trial.cost < math.inf and (previous := shifted()) is not None:
                trial = problem.evaluate(problem.clipped(previous))
                outcome.trial = self._feasible_near(problem, outcome, trial)
            if outcome.trial.cost < math.inf:
                self._search(problem, outcome, None, self._limit - outcome.qps)
        if outcome.trial.cost < candidate.cost and outcome.trial.violation <= FEASIBLE:
            outcome.improved = True
            return
        missed: tuple[DroppedRow, ...] = ()
        if self._restores:
            missed = self._restore(problem, outcome, nearest, shifted)  # (b)
            if outcome.improved:
                return
        outcome.trial = candidate  # (d), if dropping rows does not help
        if not outcome.time_is_up():
            outcome.events &= ~_OUTDATED
            relaxed = problem.without_violated()  # (c)
            outcome.trial = relaxed.candidate
            self._search(relaxed, outcome, start, max(1, self._limit - outcome.qps))
            outcome.improved = outcome.trial is not relaxed.candidate
            if outcome.improved:
                outcome.dropped = problem.missed_rows(outcome.trial)
                if outcome.dropped:
                    outcome.events |= Status.ROWS_DROPPED
        outcome.message = naming_missed(missed, outcome.message)

    def _restore(
        self,
        problem: Problem,
        outcome: Outcome,
        nearest: Trial,
        shifted: Callable[[], Array | None],
    ) -> tuple[DroppedRow, ...]:
        """Improve the nearest feasible trajectory to the candidate, if (a) has not gone lower.

        ``nearest`` is the one that (a) has found, or the candidate. Returns the rows that the
        nearest trial misses, if no trial is feasible.
        """
        found, missed = outcome.trial, nearest
        if not nearest.cost < math.inf:
            missed = nearest = self._restored(problem, outcome, nearest)
        if not min(nearest.cost, found.cost) < math.inf and (previous := shifted()) is not None:
            trial = problem.evaluate(problem.clipped(previous))
            nearest = self._restored(problem, outcome, trial)
            if nearest.violation < missed.violation:
                missed = nearest
        if not nearest.cost < math.inf:
            nearest = found
        if not nearest.cost < math.inf:
            return problem.missed_rows(missed)
        outcome.restored_cost, outcome.improved = nearest.cost, True
        outcome.events |= Status.RESTORED
        outcome.trial = found
        if nearest.cost <= found.cost:
            outcome.trial = nearest
            outcome.events &= ~_OUTDATED
            self._search(problem, outcome, None, max(1, self._limit - outcome.qps))
        if outcome.trial.cost < problem.candidate.cost:  # (a), after all
            outcome.restored_cost = math.nan
            outcome.events &= ~Status.RESTORED
        return ()

    def _search(self, problem: Problem, outcome: Outcome, start: Array | None, limit: int) -> None:
        """Lower the cost by at most ``limit`` QPs, from the start if that is better.

        With a surrogate of the cost, its minimiser counts where the true cost is lower.
        """
        if problem.surrogate is None:
            self._descend(problem, outcome, start, limit)
            return
        best, surrogate = outcome.trial, problem.with_cost(problem.surrogate)
        outcome.trial = began = surrogate.judged(best)
        self._descend(surrogate, outcome, start, limit)
        # The candidate may break the noise-free directions; its J then belongs to its roll-out.
        found = best if outcome.trial is began else problem.judged(outcome.trial)
        if found.cost < math.inf:
            outcome.followed = found.trajectory
        outcome.trial = found if found.cost < _target(best) else best
        outcome.events |= Status.GRADUATED

    def _descend(self, problem: Problem, outcome: Outcome, start: Array | None, limit: int) -> None:
        """The suboptimal estimator of Definition def:estimator, by at most ``limit`` QPs.

        Any trajectory is an estimate that (i) satisfies the constraints, and (ii) has a cost J no
        greater than the candidate's (eq:estimator). The candidate itself is the first one. Each QP,
        built around the best trajectory so far, leads to trials; the true problem gives those that
        violate (i) an infinite J, and the first trial whose J is lower is the next best. Where
        there is none, the next QP is around the same trajectory, and damped.
        """
        best = outcome.trial
        if start is not None:
            trial = problem.evaluate(problem.clipped(start.copy()))
            if trial.cost < _target(best):
                outcome.trial = best = trial
        outcome.unsolved = 0
        if outcome.events:
            outcome.events &= ~Status.UNCONVERGED
        damping, growth, qp, region = 0.0, MORE_DAMPING, None, Region()
        # Second-order corrections and searches for feasible points overwrite a QP with rows.
        kept = not (problem.constrained or self._extended)
        for _ in range(limit):
            if outcome.time_is_up():
                return
            if not (damping and kept):
                qp = self._subproblem.at(problem, best)
            if qp is None:
                outcome.events |= Status.MODEL_FAILED
                outcome.message = self._subproblem.failure
                return
            if damping:
                self._subproblem.damp(qp, problem, best, damping)
            solution = self._solution(qp, outcome)
            if solution is None:
                return
            outcome.qps += 1
            step, solved = solution.d, solution.status is SolveStatus.SOLVED
            if step is None:
                outcome.events |= Status.SOLVER_FAILED
                outcome.message = solution.message
                return
            outcome.unsolved = 0 if solved else outcome.unsolved + 1
            if not solved:
                outcome.events |= Status.SOLVER_STOPPED
            # Where J is infinite, no decrease is negligible.
            negligible = self._tolerance * best.cost if best.cost < math.inf else -1.0
            # The decrease of J that the QP predicts: its objective is J/2.
            if self._extended:
                predicted = slope = self._subproblem.predicted(qp, best, step)
            else:
                slope = -float(np.vdot(qp.gradient, step))
                predicted = abs(slope)
            # At a minimum no step lowers J by more than rounding: it is not shortened.
            useless, target = solved and predicted <= negligible, _target(best)
            shorten = not (useless or damping)
            # An iterate that leads upwards gives no path: the solver's steps are judged, not ours.
            bounded = shorten and self._has_region and slope > 0.0
            trials = (
                self._trials_within(region, problem, qp, best, step, predicted) if bounded
                else self._trials(problem, qp, outcome, step, not useless, shorten)
            )
            for trial in trials:
                if trial.cost < target:
                    break
            if not trial.cost < target:
                little = problem.rounding_cost(best) if best.cost < math.inf else -1.0
                outcome.message = problem.failure(trial)
                if not damping and solved and predicted <= max(STALLED * negligible, little):
                    outcome.events |= Status.CONVERGED
                    return
                # Rounding hides a decrease this small, and more damping predicts less.
                if best.cost == math.inf or damping > MOST_DAMPING or (
                    (solved or damping) and not predicted > max(ROUNDING * best.cost, little)
                ):
                    outcome.events |= Status.NO_DECREASE
                    outcome.damping = 0.0
                    return
                if damping:
                    outcome.damping, growth = growth * damping, 2.0 * growth
                damping = max(outcome.damping, DAMPING)
                continue
            outcome.trial, before, best = trial, best, trial
            decrease = before.cost - best.cost
            # As long as J falls about as predicted, there is no radius.
            if bounded and (
                region.radius < math.inf or not POOR * predicted <= decrease <= predicted / POOR
            ):
                if region.radius == math.inf:
                    metric = region.scaled(self._subproblem.metric(problem, before))
                    region.length = metric.length(step)
                region.accept(decrease)
            if damping:
                region = Region()
                outcome.damping = damping * _share_left(decrease, predicted)
                outcome.message, damping, growth = "", 0.0, MORE_DAMPING
                continue
            outcome.damping *= OLD_DAMPING
            if solved and decrease <= negligible and not (bounded and region.shortened):
                outcome.events |= Status.CONVERGED
                return
            if self._patience and outcome.unsolved >= self._patience:
                outcome.events |= Status.UNCONVERGED
                outcome.message = (
                    f"Backend {self._backend!r} did not solve the last {self._patience} QPs to "
                    f"its tolerance{f': {solution.message}' if solution.message else ''}."
                )
                return
        if damping and not self._uncapped:
            outcome.events |= Status.CAP_REACHED

    def _nearest_step(self, problem: Problem, outcome: Outcome, trial: Trial) -> Array | None:
        """The step to the nearest point of the linearised sets; None where no QP gives one."""
        qp = self._subproblem.nearest_point(problem, trial)
        solution = None if qp is None else self._solve(qp, outcome)
        if solution is None:
            return None
        outcome.nearest_points += 1
        return solution.d

    def _feasible_near(self, problem: Problem, outcome: Outcome, trial: Trial) -> Trial:
        """A feasible trajectory near an infeasible one, by QPs in the metric of the Hessian.

        The trial itself where it is feasible, or where no feasible trajectory is found.
        """
        nearest = trial
        for _ in range(NEAREST_POINTS):
            if nearest.cost < math.inf or not math.isfinite(nearest.violation):
                return nearest
            if outcome.nearest_points >= NEAREST_POINTS * (1 + outcome.qps):
                break
            step = self._nearest_step(problem, outcome, nearest)
            if step is None:
                break
            before, nearest = nearest, self._trial(problem, nearest, step)
            if not nearest.violation < NEARER * before.violation:
                break
        return nearest if nearest.cost < math.inf else trial

    def _restored(self, problem: Problem, outcome: Outcome, trial: Trial) -> Trial:
        """The nearest feasible trajectory to a trial, or the last one on the way.

        As `_feasible_near`, with shorter steps where a full one does not lower the miss.
        """
        for _ in range(RESTORING):
            if trial.cost < math.inf:
                break
            step = self._nearest_step(problem, outcome, trial)
            if step is None:
                break
            for length in (1.0, *LENGTHS[1:]):
                ahead = self._trial(problem, trial, length * step)
                if ahead.violation < (1.0 - TOWARDS * length) * trial.violation:
                    break
            else:
                break
            trial = ahead
        return trial

    def _trials(
        self, problem: Problem, qp: QP, outcome: Outcome, step: Array, correct: bool, shorten: bool
    ) -> Iterator[Trial]:
        """The trials that a step leads to, one after the other until one is accepted.

        First the full step; then, if asked for, corrected ones and shorter ones.
        """
        best = outcome.trial
        full = self._trial(problem, best, step)
        yield full
        step = step.copy()  # a correction's solve overwrites it
        curved = 0.0 < full.violation < math.inf and bool(qp.rows)
        # A full step along a soft row that is curved: the penalty grows where J would not.
        bent = not curved and _is_bent(best, full)
        if curved:
            if full.violation <= NEARLY:
                yield self._trial(problem, best, LENGTHS[0] * step)
            # If the shortened step leaves the set, too, curvature is the reason.
            if correct:
                trial = self._correct(problem, qp, outcome, full)
                yield self._feasible_near(problem, outcome, trial)
        elif bent and correct:
            yield self._correct(problem, qp, outcome, full)
        # From outside, a full step ends as a rule on the boundary of the linearised sets: shorter
        # ones stay outside.
        if not shorten or best.violation > FEASIBLE:
            return
        for length in LENGTHS:
            yield (trial := self._trial(problem, best, length * step))
        if not (curved or _is_bent(best, trial)):
            return
        # Along the boundary of the curved set: the decrease of J is proportional to the length of a
        # short step, the distance from the set to its square. So the way back costs less than a
        # step gains, if the step is short enough.
        for length in ALONG:
            trial = self._trial(problem, best, length * step)
            if curved:
                yield self._feasible_near(problem, outcome, trial)
            else:  # no hard set: back to the soft rows
                yield self._correct(problem, qp, outcome, trial)

    def _trials_within(
        self, region: Region, problem: Problem, qp: QP, best: Trial, step: Array, predicted: float
    ) -> Iterator[Trial]:
        """The trials of a QP without inequalities, one after the other until one is accepted.

        First the full step where it is in the region; then shorter ones along Powell's dogleg.
        """
        path = None
        if region.radius < math.inf:
            path = self._path(region, problem, qp, best, step, predicted)
        if path is None or not path.length > region.radius:
            region.shortened, region.predicted = False, predicted
            region.length = 0.0 if path is None else path.length
            yield self._trial(problem, best, step)
            if path is None:
                path = self._path(region, problem, qp, best, step, predicted)
            region.reject(path.length)
        for _ in range(SHORTER):
            shorter = region.part(path)
            if not region.predicted > ROUNDING * best.cost:
                return
            yield self._trial(problem, best, shorter)
            region.reject(region.radius)

    def _path(
        self, region: Region, problem: Problem, qp: QP, best: Trial, step: Array, predicted: float
    ) -> Dogleg:
        metric = region.scaled(self._subproblem.metric(problem, best))
        return Dogleg(metric, qp, step, predicted)

    def _correct(self, problem: Problem, qp: QP, outcome: Outcome, trial: Trial) -> Trial:
        """Second-order corrections of a trial that curvature takes out of a set."""
        best = outcome.trial
        for _ in range(CORRECTIONS):
            if outcome.time_is_up():
                break
            self._subproblem.correct_rows(qp, problem, best, trial)
            solution = self._solution(qp, outcome)
            if solution is None:
                break
            outcome.corrections += 1
            if solution.d is None:
                break
            trial = self._trial(problem, best, solution.d)
            if not math.isfinite(trial.violation) or (
                trial.cost < math.inf and not _is_bent(best, trial)
            ):
                break
        return trial

    def _softened_solution(self, qp: QP, outcome: Outcome) -> Solution | None:
        """The solution of a QP with its soft rows, if there are any; None if no time is left.

        Where the solution without them violates none, it is the solution with them, too. Where no
        backend was named, the rows that are active are found without slack variables first.
        """
        solution, subproblem = self._solve(qp, outcome), self._subproblem
        if solution is None:
            return None
        if not subproblem.misses(solution):
            subproblem.note(qp, solution)
            return solution
        if self._solver.chooses and not outcome.time_is_up():
            began = perf_counter()
            found = subproblem.directly(qp, outcome.deadline)
            outcome.count(0 if found is None else found.iterations, perf_counter() - began)
            if found is not None:
                return found
        solution = self._solve(subproblem.softened(qp), outcome)
        return None if solution is None else subproblem.lowered(qp, solution, outcome.deadline)

    def _solve(self, qp: QP, outcome: Outcome) -> Solution | None:
        """Solve a QP within the time left; None if no time is left.

        An unsolved one is solved again if its Hessian is singular up to rounding: with a ridge.
        """
        solution = None
        while True:
            began = perf_counter()
            left = outcome.remaining(began)
            if left is not None and left <= 0.0:
                return None if solution is None or solution.d is None else solution
            solution = self._subproblem.solve(qp, self._solver, left)
            outcome.count(solution.iterations, perf_counter() - began)
            if solution.status in _FACTORISED or not self._subproblem.give_ridge(qp):
                return solution

    @staticmethod
    def _trial(problem: Problem, best: Trial, step: Array) -> Trial:
        trajectory = best.trajectory + step
        return problem.evaluate(problem.clipped(trajectory) if problem.constrained else trajectory)


def _is_bent(best: Trial, trial: Trial) -> bool:
    """Whether a trial has more penalty, by more than rounding in a row at its limit."""
    return best.penalty + ROUNDING * abs(trial.cost) < trial.penalty < math.inf


def _share_left(decrease: float, predicted: float) -> float:
    """The share of a damping that is left after a step that has lowered J."""
    missed = 2.0 * min(decrease / predicted, 1.0) - 1.0 if predicted > 0.0 else 1.0
    return max(LESS_DAMPING, 1.0 - missed * missed * missed)


def _target(best: Trial) -> float:
    """The cost below which a trial is better than the best one."""
    return best.cost - ROUNDING * abs(best.cost) if best.cost < math.inf else math.inf
