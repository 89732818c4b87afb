"""The result of one step's sequence of QPs, while it runs and when it has ended."""

from __future__ import annotations

import math
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from ..terms.base import Trial
from .estimate import DroppedRow, Status

Array = NDArray[np.float64]


class Outcome:
    """The result of the sequence of QPs, updated while it runs.

    Attributes
    ----------
    trial : Trial
        The best trajectory so far, at first the candidate. Its cost is infinite as long as it
        violates a constraint of the problem being solved.
    improved : bool
        Whether the trial takes the candidate's place: it is better or, with `Status.RESTORED`, in
        sets that the candidate violates.
    restored_cost : float
        J of the trajectory into which the candidate was restored; NaN if it was not.
    events : Status
        Why the sequence stopped, and what happened.
    followed : array or None
        The minimiser of a surrogate of the cost, from which the next step starts.
    damping : float
        The damping with which a search for a shorter step begins, at least; 0 for none.
    unsolved : int
        Number of the last QPs that were not solved to the solver's tolerance.
    dropped, message, qps, corrections, nearest_points, solver_iterations, solve_time
        As in `Estimate`.
    """

    # Class attributes as defaults: few of them change in most steps.
    improved: bool = False
    restored_cost: float = math.nan
    events: Status = Status(0)
    message: str = ""
    qps: int = 0
    unsolved: int = 0
    corrections: int = 0
    nearest_points: int = 0
    solver_iterations: int | None = 0
    solve_time: float = 0.0
    dropped: tuple[DroppedRow, ...] = ()
    followed: Array | None = None

    def __init__(
        self, candidate: Trial, deadline: float = math.inf, damping: float = 0.0
    ) -> None:
        self.trial, self.deadline, self.damping = candidate, deadline, damping

    def time_is_up(self) -> bool:
        """Whether the deadline has passed; adds it to the events."""
        late = self.deadline < math.inf and perf_counter() > self.deadline
        if late:
            self.events |= Status.TIME_UP
        return late

    def remaining(self, now: float) -> float | None:
        """Seconds left, None without a deadline; adds to the events if the time is up."""
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
