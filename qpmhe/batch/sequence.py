"""The sequences of QPs of all members; each accepts only what its true cost approves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import Solver, SolveStatus

from ..costs import QuadraticCost
from ..estimation.estimate import Status
from ..estimation.optimizer import LENGTHS, ROUNDING, STALLED
from ..estimation.settings import Settings
from .factor import BlockCholesky
from .fallback import member_qp
from .problems import Problems
from .terms import Terms
from .windows import Windows

__all__ = ["Outcome", "Sequence"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Flags = NDArray[np.int64]


@dataclass(slots=True)
class Outcome:
    """What the sequences came to.

    Parameters
    ----------
    cost : (K,) array
        J of the best trajectories.
    flags : (K,) int array
        Values of `Status`: why each sequence stopped, and what happened.
    qps : (K,) int array
        QPs solved.
    improved : (K,) bool array
        Whose best trajectory is not the candidate.
    trajectory : (N_t + 1, K, n) array or None
        The best trajectories; None where all are candidates.
    """

    cost: Array
    flags: Flags
    qps: Index
    improved: Mask
    trajectory: Array | None = None

    def accept(
        self, members: Index, good: Mask, trial: Array, cost: Array, candidate: Array
    ) -> None:
        """Take over the trials that are good, of some of these members.

        Parameters
        ----------
        members : (k,) int array
            The members.
        good : (k,) bool array
            Whose trial is to be taken.
        trial : (N_t + 1, k, n) array
            Trials, which are not written to afterwards.
        cost : (k,) array
            Their costs.
        candidate : (N_t + 1, K, n) array
            The candidates.
        """
        if good.all() and members.size == self.cost.size:
            self.trajectory, self.cost = trial, cost
            self.improved[...] = True
            return
        if self.trajectory is None:
            self.trajectory = candidate.copy()
        some = members[good]
        self.trajectory[:, some] = trial[:, good]
        self.cost[some] = cost[good]
        self.improved[some] = True


@dataclass(slots=True)
class _Group:
    """Members whose sequences go on, each from its best trajectory so far.

    Parameters
    ----------
    members : (k,) int array
        Who, in rising order.
    trajectory : (N_t + 1, k, n) array
        Their trajectories.
    cost : (k,) array
        J of these.
    weighted : (N_t, n + p, k) array or None
        What `Problems.evaluate` gave of them; None at the candidates.
    """

    members: Index
    trajectory: Array
    cost: Array
    weighted: Array | None = None

    def only(self, mask: Mask) -> _Group:
        """Those of the mask."""
        if mask.all():
            return self
        weighted = None if self.weighted is None else self.weighted[..., mask]
        return _Group(
            self.members[mask], self.trajectory[:, mask], self.cost[mask], weighted
        )


class Sequence:
    """Gauss-Newton steps from the candidates; see `qpmhe.estimation.optimizer.Optimizer`.

    Parameters
    ----------
    windows : Windows
        The windows.
    problems : Problems
        Their problems.
    cost : QuadraticCost
        The weights.
    solver : Solver
        Asked where the common factorisation fails.
    settings : Settings
        Cap on the QPs, and tolerance.
    """

    def __init__(
        self,
        windows: Windows,
        problems: Problems,
        cost: QuadraticCost,
        solver: Solver,
        settings: Settings,
    ) -> None:
        self._windows, self._problems, self._solver = windows, problems, solver
        self._limit, self._tolerance = settings.qp_limit, settings.tolerance
        prior: Array = np.asarray(cost.prior, np.float64)
        self._weights = prior, cost.disturbance
        self._everyone = np.arange(windows.members)
        self._again = self._limit > 1 or settings.start == "best"
        if self._limit > 0:
            self._factor = BlockCholesky(
                prior, cost.disturbance, windows.horizon, windows.members
            )
        # Of trajectories other than the candidates.
        room = windows.members if self._again else 0
        self._terms = Terms(windows.horizon, cost.n, cost.n + cost.p, room)

    def improve(self, start: Array | None = None) -> Outcome:
        """Run the sequences of all members; never raises on account of model or solver.

        Parameters
        ----------
        start : (N_t + 1, K, n) array, optional
            Trajectories to start from where they are better than the candidates.
        """
        windows, members = self._windows, self._everyone
        candidate, cost = windows.candidate, windows.candidate_cost
        outcome = Outcome(
            cost.copy(), np.zeros(cost.size, np.int64), np.zeros(cost.size, np.intp),
            np.zeros(cost.size, np.bool_),
        )
        if self._limit == 0:
            outcome.flags |= Status.NO_QPS.value
            return outcome
        groups = [_Group(members, candidate, cost)]
        if start is not None:
            begun, weighted = self._problems.evaluate(start, members)
            better = begun < _target(cost)
            outcome.accept(members, better, start, begun, candidate)
            groups = [
                groups[0].only(~better), _Group(members, start, begun, weighted).only(better)
            ]
        for group in groups:
            for _ in range(self._limit):
                if not group.members.size:
                    break
                group = self._round(group, outcome)
        return outcome

    def _round(self, group: _Group, outcome: Outcome) -> _Group:
        """Solve and judge one QP of each member; those for whom another is worth while."""
        windows, problems, flags = self._windows, self._problems, outcome.flags
        group, terms, slots, prior_gradient = self._linearized(group, flags)
        members, cost = group.members, group.cost
        if not members.size:
            return group
        steps, promised, sound = self._factor.solve(
            terms, slots, windows.discounts, prior_gradient
        )
        outcome.qps[members] += 1
        brought, solved = sound, sound
        if not sound.all():
            brought, solved = sound.copy(), sound.copy()
            for j in np.flatnonzero(~sound).tolist():
                qp = member_qp(
                    terms, slots, j, self._weights, windows.discounts, prior_gradient
                )
                solution = self._solver.solve(qp)
                steps[..., j], promised[j] = 0.0, np.inf
                if solution.d is None:
                    flags[members[j]] |= Status.SOLVER_FAILED.value
                    continue
                steps[..., j] = -solution.d
                promised[j] = abs(float(np.vdot(qp.gradient, solution.d)))
                brought[j], solved[j] = True, solution.status is SolveStatus.SOLVED
                if not solved[j]:
                    flags[members[j]] |= Status.SOLVER_STOPPED.value
        target, enough = _target(cost), self._tolerance * (cost + self._tolerance)
        enough[~np.isfinite(enough)] = -1.0  # nothing converges to what cannot be judged
        trial = np.empty_like(group.trajectory)
        np.subtract(group.trajectory, steps.transpose(0, 2, 1), out=trial)
        reached, weighted = problems.evaluate(trial, members)
        better = (reached < target) & brought
        if not better.all():
            worse = brought & ~better
            # Near a minimum J cannot be lowered beyond its rounding: not a failure.
            converged = worse & solved & (promised <= enough)
            flags[members[converged]] |= Status.CONVERGED.value
            stuck = self._shortened(
                group, steps, target, np.flatnonzero(worse & ~converged), trial, reached,
                weighted, better,
            )
            stalled = solved[stuck] & (promised[stuck] <= STALLED * enough[stuck])
            flags[members[stuck[stalled]]] |= Status.CONVERGED.value
            flags[members[stuck[~stalled]]] |= Status.NO_DECREASE.value
        done = better & solved & (cost - reached <= enough)
        flags[members[done]] |= Status.CONVERGED.value
        outcome.accept(members, better, trial, reached, windows.candidate)
        return _Group(members, trial, reached, weighted).only(better & ~done)

    def _shortened(
        self,
        group: _Group,
        steps: Array,
        target: Array,
        places: Index,
        trial: Array,
        reached: Array,
        weighted: Array,
        better: Mask,
    ) -> Index:
        """Try shorter steps for the members in these places; those whom none helps.

        The trials that are better are put among the others.
        """
        for length in LENGTHS:
            if not places.size:
                break
            shorter = np.ascontiguousarray(
                group.trajectory[:, places] - length * steps[..., places].transpose(0, 2, 1)
            )
            # Where these are all members, the products are in `weighted` already.
            cost, products = self._problems.evaluate(shorter, group.members[places])
            good = cost < target[places]
            taken = places[good]
            trial[:, taken], reached[taken] = shorter[:, good], cost[good]
            weighted[..., taken] = products[..., good]
            better[taken] = True
            places = places[~good]
        return places

    def _linearized(
        self, group: _Group, flags: Flags
    ) -> tuple[_Group, Terms, list[int], Array | None]:
        """The terms around a group's trajectories, and who can be linearised there."""
        windows = self._windows
        if group.weighted is None:
            if group.members.size == windows.members:
                return group, windows.terms, windows.slots, None
            self._terms.take(windows.terms, windows.slots, group.members)
            return group, self._terms, list(range(windows.length)), None
        finite = self._problems.linearize(
            group.trajectory, group.members, group.weighted, self._terms
        )
        flags[group.members[~finite]] |= Status.MODEL_FAILED.value
        group = group.only(finite)
        gradient = None
        if group.members.size:
            gradient = self._problems.prior_gradient(group.trajectory, group.members)
        return group, self._terms, list(range(windows.length)), gradient


def _target(cost: Array) -> Array:
    """What a trial's cost must be below to count as better."""
    return np.where(np.isfinite(cost), cost - ROUNDING * cost, np.inf)
