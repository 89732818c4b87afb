"""The result of one step of the estimator."""

from __future__ import annotations

import enum

import numpy as np
from numpy.typing import NDArray

__all__ = ["Estimate", "Status"]

Array = NDArray[np.float64]


class Status(enum.Flag):
    """Outcome of a step, and everything that happened in it.

    Exactly one of IMPROVED and CANDIDATE is always set; the others are added where they
    apply, so that ``Status.IMPROVED in estimate.status`` asks for the outcome.
    `explain` says what each one means and what to do about it.
    """

    IMPROVED = enum.auto()
    CANDIDATE = enum.auto()
    NO_QPS = enum.auto()
    CONVERGED = enum.auto()
    NO_DECREASE = enum.auto()
    SOLVER_FAILED = enum.auto()
    SOLVER_STOPPED = enum.auto()
    MODEL_FAILED = enum.auto()
    FAILED_STAGE = enum.auto()
    MISSING = enum.auto()
    SETS_DROPPED = enum.auto()
    PROJECTED = enum.auto()
    CANDIDATE_OUTSIDE = enum.auto()
    TIME_UP = enum.auto()

    def explain(self) -> str:
        """What happened, and what can be done about it, in sentences."""
        return " ".join(text for flag, text in _TEXTS.items() if flag in self)


_TEXTS = {
    Status.IMPROVED: "The estimate's true cost is below the candidate's.",
    Status.CANDIDATE: "The observer's candidate is the estimate.",
    Status.NO_QPS: "No QP was asked for; raise max_qps to improve on the observer.",
    Status.CONVERGED: "The sequence of QPs converged.",
    Status.NO_DECREASE: (
        "The last trial did not lower the true cost at any step length and was dropped; "
        "raise max_solver_iterations or take another backend if this is frequent."
    ),
    Status.SOLVER_FAILED: (
        "The QP solver brought back no usable iterate; see the estimate's message."
    ),
    Status.SOLVER_STOPPED: (
        "A QP was not solved to tolerance, and its iterate was judged all the same; raise "
        "max_solver_iterations if the cost is too far from the converged one."
    ),
    Status.MODEL_FAILED: (
        "A model function raised or was not finite; bound the states, or make the model "
        "defined on all of them."
    ),
    Status.FAILED_STAGE: (
        "The model failed at an earlier stage, which is still in the window: the candidate has "
        "no finite cost, and any trajectory with a finite one is accepted."
    ),
    Status.MISSING: (
        "The measurement is missing in part or whole (not finite); its noise term was left "
        "out and the observer predicted without it."
    ),
    Status.SETS_DROPPED: (
        "The observer's candidate is outside of the sets, which were left out in this step; "
        "widen them, take another observer, or try outside='project'."
    ),
    Status.PROJECTED: (
        "The observer's candidate is outside of the sets; the nearest trajectory inside took "
        "its place as the candidate, which the theorem does not cover."
    ),
    Status.CANDIDATE_OUTSIDE: (
        "The observer's candidate is outside of the sets and was kept all the same; choose "
        "outside='drop' or 'project' to improve on it."
    ),
    Status.TIME_UP: "The time budget was spent; the best trajectory so far is the estimate.",
}


class Estimate:
    """The result of one `MovingHorizonEstimator.update`, after the measurement y(t).

    With N_t = min(t + 1, N) stages in the window, the trajectory holds the estimates of
    x(t+1-N_t), ..., x(t+1), made from the measurements y(t+1-N_t), ..., y(t).

    The arrays belong to the caller: no estimator reads them again. ``state``, ``filtered`` and
    ``delayed`` are views of ``trajectory``: copy a state to change or keep it on its own.

    Attributes
    ----------
    time : int
        t, the index of the newest measurement; the first is 0.
    state : (n,) array
        Estimate of x(t+1), the paper's estimate: a prediction one step ahead of the newest
        measurement.
    filtered : (n,) array
        Estimate of x(t), the last measured time.
    trajectory : (N_t + 1, n) array
        Estimates of all states in the window.
    disturbances : (N_t, n) array
        w(i) = x(i+1) - f(x(i)) along the trajectory.
    noises : (N_t, p) array
        v(i) = y(i) - h(x(i)) along the trajectory; NaN where y is missing.
    cost, candidate_cost : float
        True cost J of the estimate and of the observer's candidate; cost <= candidate_cost.
    candidate : (N_t + 1, n) array
        The observer's trajectory, or its projection onto the sets.
    delayed : (n,) array or None
        Estimate of x(t+1-k) for the estimator's delay k; None until the window reaches it.
    dropped : tuple of str
        Names of the sets that were left out: "states", "disturbances", "noises".
    status : Status
        Outcome and events.
    message : str
        What the model, the observer or the cost raised where it failed, and at which state;
        the QP solver's message where that failed.
    qps, corrections : int
        QPs solved, and second-order corrections solved beside them.
    solver_iterations : int or None
        Sum of the solver's own iterations; None where it reports none.
    step_time, solve_time : float
        Seconds for the whole update, and for the QP solver in it.
    """

    __slots__ = (
        "_residuals", "candidate", "candidate_cost", "corrections", "cost", "delayed", "dropped",
        "message", "qps", "solve_time", "solver_iterations", "state", "status", "step_time",
        "time", "trajectory",
    )

    def __init__(
        self,
        time: int,
        trajectory: Array,
        residuals: Array,
        cost: float,
        candidate: Array,
        candidate_cost: float,
        status: Status,
        message: str,
        qps: int,
        solver_iterations: int | None,
        solve_time: float,
        corrections: int = 0,
        dropped: tuple[str, ...] = (),
        delay: int = 0,
    ) -> None:
        self.time = time
        self.trajectory = trajectory
        self.state: Array = trajectory[-1]
        self._residuals = residuals
        self.cost, self.candidate_cost = cost, candidate_cost
        self.candidate = candidate
        self.status, self.message = status, message
        self.qps, self.solver_iterations = qps, solver_iterations
        self.corrections, self.dropped = corrections, dropped
        self.delayed: Array | None = self.state if delay == 0 else None
        if 0 < delay < trajectory.shape[0]:
            self.delayed = trajectory[trajectory.shape[0] - 1 - delay]
        self.solve_time, self.step_time = solve_time, float("nan")

    @property
    def filtered(self) -> Array:
        """Estimate of x(t), the last measured time."""
        value: Array = self.trajectory[-2]
        return value

    @property
    def disturbances(self) -> Array:
        """w(i) along the trajectory."""
        return self._residuals[:, : self.trajectory.shape[1]]

    @property
    def noises(self) -> Array:
        """v(i) along the trajectory, NaN where y is missing."""
        return self._residuals[:, self.trajectory.shape[1] :]

    @property
    def improved(self) -> bool:
        """Whether the estimate is better than the candidate."""
        return Status.IMPROVED in self.status

    def __repr__(self) -> str:
        return (
            f"Estimate(time={self.time}, state={self.state.tolist()}, cost={self.cost:.6g}, "
            f"candidate_cost={self.candidate_cost:.6g}, status={self.status!s})"
        )
