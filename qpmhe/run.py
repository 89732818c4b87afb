"""The record of an estimator's run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .estimate import Estimate, Status

__all__ = ["Run"]

Array = NDArray[np.float64]


class Run:
    """Results of T consecutive updates, as arrays.

    Parameters
    ----------
    start : (n,) array
        The estimate before the first update.
    estimates : sequence of Estimate
        What the updates returned.
    covariances : (T, n, n) array, optional
        Covariances of their states.

    Attributes
    ----------
    states : (T + 1, n) array
        Estimates of x(0), ..., x(T), each made before y of its own time: row 0 is the start.
    filtered : (T, n) array
        Estimates of x(0), ..., x(T-1), each made with y of its own time.
    costs, candidate_costs : (T,) array
        True cost J of estimate and candidate.
    times, solve_times : (T,) array
        Seconds for each update, and for the QP solver in it.
    qps : (T,) array
        QPs solved.
    solver_iterations : (T,) array
        The solver's own iterations, -1 where it does not tell.
    statuses : list of Status
        Outcome and events of each step.
    delayed : (T, n) array
        Estimates with the estimator's delay, NaN where the window did not reach that far.
    covariances : (T, n, n) array or None
        Covariances of the estimates of x(1), ..., x(T), if they were asked for; NaN where
        the model could not be linearised.
    """

    def __init__(
        self,
        start: Array,
        estimates: Sequence[Estimate],
        covariances: Array | None = None,
    ) -> None:
        n = start.size
        self.states: Array = np.array([start, *(e.state for e in estimates)])
        self.filtered: Array = np.array([e.filtered for e in estimates]).reshape(-1, n)
        self.costs: Array = np.array([e.cost for e in estimates])
        self.candidate_costs: Array = np.array([e.candidate_cost for e in estimates])
        self.times: Array = np.array([e.step_time for e in estimates])
        self.solve_times: Array = np.array([e.solve_time for e in estimates])
        self.qps = np.array([e.qps for e in estimates], dtype=np.intp)
        self.solver_iterations = np.array(
            [-1 if e.solver_iterations is None else e.solver_iterations for e in estimates],
            dtype=np.intp,
        )
        nothing = np.full(n, np.nan)
        self.delayed: Array = np.array(
            [nothing if e.delayed is None else e.delayed for e in estimates]
        ).reshape(-1, n)
        self.covariances = covariances
        self.statuses: list[Status] = [e.status for e in estimates]

    def __len__(self) -> int:
        return len(self.statuses)

    def share(self, flag: Status) -> float:
        """The share of steps whose status has this flag."""
        return sum(flag in status for status in self.statuses) / max(1, len(self.statuses))

    def reasons(self) -> dict[str, int]:
        """How often each combination of flags occurred, the most frequent first."""
        counts = Counter(str(status).removeprefix("Status.") for status in self.statuses)
        return dict(counts.most_common())
