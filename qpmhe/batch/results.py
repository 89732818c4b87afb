"""What the steps of a batch tell."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..estimation.estimate import Status

__all__ = ["BatchEstimate", "BatchRun"]

Array = NDArray[np.float64]
Flags = NDArray[np.int64]
Index = NDArray[np.intp]


class BatchEstimate:
    """The results of one `BatchEstimator.update`, after the measurements y(t) of K members.

    With N_t = min(t + 1, N) stages in the windows, the trajectories hold the estimates of
    x(t+1-N_t), ..., x(t+1).

    Attributes
    ----------
    time : int
        t, the index of the newest measurements; the first is 0.
    trajectories : (K, N_t + 1, n) array
        Estimates of all states in the windows.
    candidates : (K, N_t + 1, n) array
        The observers' trajectories, or their projections onto the sets.
    costs, candidate_costs : (K,) array
        True cost J of the estimates and of the candidates; costs <= candidate_costs.
    flags : (K,) int array
        Outcome and events as values of `Status`, whose sums of flags they are.
    qps : (K,) int array
        QPs solved.
    delayed : (K, n) array or None
        Estimates of x(t+1-k) for the estimator's delay k; None until the windows reach it.
    """

    def __init__(
        self,
        time: int,
        trajectories: Array,
        costs: Array,
        candidates: Array,
        candidate_costs: Array,
        flags: Flags,
        qps: Index,
        delay: int = 0,
    ) -> None:
        self.time = time
        self.trajectories, self.costs = trajectories, costs
        self.candidates, self.candidate_costs = candidates, candidate_costs
        self.flags, self.qps = flags, qps
        self.delayed: Array | None = None
        if delay < trajectories.shape[1]:
            self.delayed = trajectories[:, trajectories.shape[1] - 1 - delay]

    @property
    def states(self) -> Array:
        """Estimates of x(t+1), (K, n): predictions one step ahead of the measurements."""
        value: Array = self.trajectories[:, -1]
        return value

    @property
    def filtered(self) -> Array:
        """Estimates of x(t), (K, n), the last measured time."""
        value: Array = self.trajectories[:, -2]
        return value

    @cached_property
    def statuses(self) -> list[Status]:
        """Outcome and events of each member."""
        return statuses_of(self.flags)

    @property
    def improved(self) -> NDArray[np.bool_]:
        """Whose estimate is better than the candidate, (K,)."""
        return having(self.flags, Status.IMPROVED)

    def __len__(self) -> int:
        return self.costs.size

    def __repr__(self) -> str:
        return (
            f"BatchEstimate(time={self.time}, members={len(self)}, "
            f"improved={int(self.improved.sum())})"
        )


class BatchRun:
    """Results of T consecutive updates of K members, as arrays.

    Parameters
    ----------
    states : (K, T + 1, n) array
        Estimates of x(0), ..., x(T), each made before y of its own time: the first is the
        start.
    filtered : (K, T, n) array
        Estimates of x(0), ..., x(T-1), each made with y of its own time.
    delayed : (K, T, n) array
        Estimates with the estimator's delay, NaN where the windows did not reach that far.
    costs, candidate_costs : (K, T) array
        True cost J of estimates and candidates.
    statuses : (K, T) int array
        Outcome and events of each step as values of `Status`; ``Status(value)`` is the flag.
    qps : (K, T) int array
        QPs solved.
    """

    def __init__(
        self,
        *,
        states: Array,
        filtered: Array,
        delayed: Array,
        costs: Array,
        candidate_costs: Array,
        statuses: Flags,
        qps: Index,
    ) -> None:
        self.states, self.filtered, self.delayed = states, filtered, delayed
        self.costs, self.candidate_costs = costs, candidate_costs
        self.statuses, self.qps = statuses, qps

    @classmethod
    def of(cls, start: Array, estimates: Iterable[BatchEstimate], count: int) -> BatchRun:
        """Collect what single updates returned.

        Parameters
        ----------
        start : (K, n) array
            The estimates before the first update.
        estimates : iterable of BatchEstimate
            What the updates return; none is kept, as they hold whole windows.
        count : int
            How many there are.
        """
        members, n = start.shape
        # Time first while they are written, members first as they are read.
        states, filtered, delayed = (
            np.empty((count + more, members, n)) for more in (1, 0, 0)
        )
        costs, candidate_costs = np.empty((count, members)), np.empty((count, members))
        statuses, qps = np.empty((count, members), np.int64), np.empty((count, members), np.intp)
        states[0] = start
        for t, one in enumerate(estimates):
            states[t + 1], filtered[t] = one.states, one.filtered
            delayed[t] = np.nan if one.delayed is None else one.delayed
            costs[t], candidate_costs[t] = one.costs, one.candidate_costs
            statuses[t], qps[t] = one.flags, one.qps
        return cls(
            states=states.transpose(1, 0, 2), filtered=filtered.transpose(1, 0, 2),
            delayed=delayed.transpose(1, 0, 2), costs=costs.T,
            candidate_costs=candidate_costs.T, statuses=statuses.T, qps=qps.T,
        )

    def __len__(self) -> int:
        return int(self.costs.shape[1])

    def share(self, flag: Status) -> float:
        """The share of all members' steps whose status has this flag.

        Parameters
        ----------
        flag : Status
            The flag.
        """
        return float(having(self.statuses, flag).mean()) if self.statuses.size else 0.0


def having(flags: Flags, flag: Status) -> NDArray[np.bool_]:
    """Where values of `Status` have a flag."""
    return np.asarray((flags & flag.value) == flag.value)


def statuses_of(flags: Flags) -> list[Status]:
    """Each value of `Status` as the flag that it is."""
    known = {value: Status(value) for value in np.unique(flags).tolist()}
    return [known[value] for value in flags.tolist()]
