"""The result of one step of the estimator."""

from __future__ import annotations

import enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Status(enum.Flag):
    """Outcome and events of a step.

    One of IMPROVED, RESTORED and CANDIDATE is always set, and all other flags that apply. Test for
    a flag with ``Status.IMPROVED in estimate.status``. `explain` gives each flag's meaning and
    remedy.
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
    CANDIDATE_OUTSIDE = enum.auto()
    ROWS_DROPPED = enum.auto()
    OBSERVER_PROJECTED = enum.auto()
    PREDICTION_OUTSIDE = enum.auto()
    METRIC_SINGULAR = enum.auto()
    OBSERVER_FAR = enum.auto()
    TIME_UP = enum.auto()
    GRADUATED = enum.auto()
    SENSORS_REJECTED = enum.auto()
    ALL_REJECTED = enum.auto()
    UNCONVERGED = enum.auto()
    OBSERVER_RESET = enum.auto()
    DERIVATIVE_NEARBY = enum.auto()
    CAP_REACHED = enum.auto()
    RESTORED = enum.auto()
    RESTARTED = enum.auto()

    def explain(self) -> str:
        """What happened, and what to do about it, in sentences."""
        return " ".join(text for flag, text in _TEXTS.items() if flag in self)


_TEXTS = {
    Status.IMPROVED: "The estimate's true cost is below the candidate's.",
    Status.CANDIDATE: "The observer's candidate is the estimate.",
    Status.NO_QPS: "No QP was requested; raise max_qps to improve on the observer.",
    Status.CONVERGED: "The sequence of QPs converged.",
    Status.NO_DECREASE: (
        "No step lowered the true cost, however short or damped: rounding hides what is left to "
        "gain, or derivatives or QPs are inaccurate (or no trial satisfied the sets). If this "
        "happens often, check the model's derivatives, raise max_solver_iterations, or use another "
        "backend."
    ),
    Status.SOLVER_FAILED: (
        "The QP solver returned no usable iterate; see the estimate's message."
    ),
    Status.SOLVER_STOPPED: (
        "A QP was not solved to tolerance (by backend='banded': without the inequalities that "
        "its solution misses); its iterate was evaluated anyway. If the cost stays too far from "
        "the converged cost, raise max_solver_iterations, or use another backend, such as 'auto'."
    ),
    Status.MODEL_FAILED: (
        "A function of the model, a constraint, the observer or the cost raised or was not finite; "
        "bound the states, define the model and its constraints for all of them, or check the "
        "observer's gain or covariances."
    ),
    Status.FAILED_STAGE: (
        "The model failed at an earlier stage that is still in the window: the candidate has "
        "no finite cost, and any trajectory with a finite cost is accepted."
    ),
    Status.MISSING: (
        "Some or all measurement components are missing (not finite); their noise terms were "
        "left out and the observer predicted without them."
    ),
    Status.CANDIDATE_OUTSIDE: (
        "The observer's candidate violates the sets of disturbances or noises or a hard nonlinear "
        "constraint (or the set of states, with project_observer=False)."
    ),
    Status.ROWS_DROPPED: (
        "No trajectory satisfying all sets was found at a cost up to the candidate's; the "
        "inequalities in estimate.dropped were left out. Widen these sets, or raise max_qps; "
        "infeasible='restore' accepts a higher cost before it gives up an inequality."
    ),
    Status.OBSERVER_PROJECTED: "The observer's step left the set of states; it was projected.",
    Status.PREDICTION_OUTSIDE: (
        "The model's prediction from the observer's state left the set of states, so the fitting "
        "error does not bound the observer's correction at this sample; if this happens often, "
        "check that the model stays in the set."
    ),
    Status.METRIC_SINGULAR: (
        "The observer's covariance is singular, and no correction within its range reaches the set "
        "of states; the observer was projected in another metric."
    ),
    Status.OBSERVER_FAR: (
        "The observer has been far from the estimates for a whole horizon; use another gain or "
        "observer, or candidate='reinitialized', which restarts it from the estimates at each "
        "sample, or restart=True, which does where that predicts the measurements better."
    ),
    Status.TIME_UP: "The time budget was spent; the best trajectory so far is the estimate.",
    Status.GRADUATED: (
        "The first window was not full: the QPs minimised the cost with a widened loss; the "
        "minimiser is accepted only if its true cost is below the candidate's."
    ),
    Status.SENSORS_REJECTED: (
        "The observer's gate rejected the newest sample's sensors in estimate.rejected_sensors: "
        "the observer's covariance does not explain their innovations."
    ),
    Status.ALL_REJECTED: (
        "These are all sensors of the sample, so the observer only predicted. If this persists, "
        "the observer is lost until its gate reopens: raise the covariances of prior or "
        "disturbance, or lower the gate's reopen."
    ),
    Status.UNCONVERGED: (
        "With max_qps=None, the sequence of QPs ended before it converged: at 100 QPs, or where "
        "several in a row were not solved to the solver's tolerance. Use another backend, such as "
        "'auto'; or in place of a loss with a kink, as Power(1), a Huber loss."
    ),
    Status.OBSERVER_RESET: (
        "The observer's covariance was lost: it was not finite or not positive semidefinite, or "
        "the model had no value at a sigma point. The observer predicted without the sample (a "
        "constant gain corrected), and its covariance is the initial one again. Bound the states, "
        "or scale the model: no derivative is huge then."
    ),
    Status.DERIVATIVE_NEARBY: (
        "A derivative of the model, or its square, is not finite where it was needed; its row was "
        "taken nearby, "
        "inside the bounds or a tiny step aside. If this happens often, write the function so "
        "that its derivative is finite there, as sqrt(x**2 + small**2) for abs(x), or bound the "
        "states."
    ),
    Status.CAP_REACHED: (
        "The last trial did not lower the true cost and was rejected, and max_qps left no QP for a "
        "more damped step; raise max_qps if this happens often."
    ),
    Status.RESTORED: (
        "No trajectory satisfying all sets was found at a cost up to the candidate's: the nearest "
        "one to the candidate takes its place, and the estimate's true cost is at most "
        "estimate.restored_cost. The paper's theorem does not cover this sample."
    ),
    Status.RESTARTED: (
        "The observer has predicted the window's measurements far worse than another one that "
        "starts at the estimate of a horizon before, with the prior's covariance: that one "
        "continues from here on, and what is proved about the former ends. If this happens often, "
        "use another gain or observer, or larger covariances of its disturbance."
    ),
}


class DroppedRow(NamedTuple):
    """An inequality that an estimate was allowed to violate.

    Attributes
    ----------
    set : str
        ``states``, ``disturbances``, ``noises`` or ``constraints``.
    row : int
        The bounded component, or the dimension of the set plus the row of its matrix; for
        ``constraints`` the row counted through all constraints.
    side : str
        ``lower`` or ``upper``.
    time : int
        The time i of x(i), w(i) or v(i), or of the sample.
    """

    set: str
    row: int
    side: str
    time: int

    def __str__(self) -> str:
        return f"{self.side} bound of {self.set}, row {self.row}, at time {self.time}"


# A message names so many missed rows.
_NAMED = 6


def naming_missed(rows: tuple[DroppedRow, ...], message: str) -> str:
    """A message that first names the rows that no trajectory was found to satisfy, if any."""
    if not rows:
        return message
    listed = [f"the {row}" for row in rows[:_NAMED]]
    listed += [f"{len(rows) - _NAMED} more"] * (len(rows) > _NAMED)
    return (
        "no trajectory that satisfies all sets was found; the nearest to one misses "
        f"{', '.join(listed)}. {message}"
    ).strip()


class Estimate:
    """The result of one `MovingHorizonEstimator.update`, after the measurement y(t).

    With N_t = min(t + 1, N) stages in the window, the trajectory holds the estimates of
    x(t+1-N_t), ..., x(t+1), made from the measurements y(t+1-N_t), ..., y(t).

    The arrays belong to the caller: no estimator reads them again. ``state`` and
    ``filtered`` are views of ``trajectory``: copy a state to change or keep it on its own.

    Attributes
    ----------
    time : int
        t, the index of the newest measurement; the first is 0.
    state : (n,) array
        Estimate of x(t+1), the paper's estimate: a prediction one step ahead of the newest
        measurement.
    filtered : (n,) array
        Estimate of x(t) that uses y(t). Where the candidate is the estimate, this is the observer's
        measurement update, or z(t) for an observer without one.
    trajectory : (N_t + 1, n) array
        Estimates of all states in the window. ``trajectory[-1 - k]`` is the estimate of x(t+1-k):
        from k = 2 on, it has used k - 1 measurements after its own time, as a smoother does.
    disturbances : (N_t, r) array
        w(i) = x(i+1) - f(x(i)) along the trajectory; with a ``disturbance_matrix`` G, the w(i)
        for which G w(i) is nearest to this difference.
    noises : (N_t, p) array
        v(i) = y(i) - h(x(i)) along the trajectory; NaN where y is missing or was not sampled.
    cost, candidate_cost : float
        True cost J of the estimate and of the observer's candidate, including soft penalties; cost
        <= candidate_cost, but where the status has RESTORED.
    restored_cost : float
        With RESTORED, J of the nearest trajectory to the candidate that satisfies all sets; cost
        <= restored_cost. NaN otherwise.
    candidate : (N_t + 1, n) array
        The observer's trajectory.
    observer_state : (n,) array
        z(t+1), the state from which the observer continues. With ``candidate="reinitialized"`` this
        observer restarted at the window's first estimate.
    dropped : tuple of DroppedRow
        The inequalities that the estimate violates because no trajectory satisfying all of them was
        found at a cost up to the candidate's.
    rejected_sensors : tuple of int
        The sensors that the observer's gate rejected at the newest sample; see `qpmhe.Gate`.
    status : Status
        Outcome and events.
    message : str
        What a failed model, observer or cost raised, and at which state; or the message of a failed
        QP solver, or which backend did not solve the QPs; or which inequalities no trajectory was
        found to satisfy, with ``infeasible="restore"``.
    qps, corrections, nearest_points : int
        Numbers of QPs solved, of second-order corrections, and of QPs for a feasible trajectory
        near an infeasible candidate.
    solver_iterations : int or None
        Sum of the solver's own iterations; None where it reports none.
    step_time, solve_time : float
        Seconds for the whole update, and for the QP solver in it; the latter is NaN with the
        compiled step, which does not measure it.
    engine : str
        The engine that ran the step: ``python`` or ``compiled``.
    """

    __slots__ = (
        "_filtered", "_rejected", "_residuals", "_width", "candidate", "candidate_cost",
        "corrections", "cost", "dropped", "message", "nearest_points", "observer_state",
        "qps", "restored_cost", "solve_time", "solver_iterations", "state", "status", "step_time",
        "time", "trajectory",
    )

    engine = "python"

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
        dropped: tuple[DroppedRow, ...] = (),
        nearest_points: int = 0,
        filtered: Array | None = None,
        disturbances: int | None = None,
        observer_state: Array | None = None,
        rejected: NDArray[np.bool_] | None = None,
        restored_cost: float = float("nan"),
    ) -> None:
        self.time = time
        self._rejected = rejected
        self._width = trajectory.shape[1] if disturbances is None else disturbances
        self.trajectory = trajectory
        self.state: Array = trajectory[-1]
        self._residuals = residuals
        self.cost, self.candidate_cost, self.restored_cost = cost, candidate_cost, restored_cost
        self.candidate = candidate
        self.observer_state: Array = candidate[-1] if observer_state is None else observer_state
        self.status, self.message = status, message
        self.qps, self.solver_iterations = qps, solver_iterations
        self.corrections, self.nearest_points, self.dropped = corrections, nearest_points, dropped
        self._filtered = filtered
        self.solve_time, self.step_time = solve_time, float("nan")

    @property
    def filtered(self) -> Array:
        """Estimate of x(t) that uses y(t)."""
        value: Array = self.trajectory[-2] if self._filtered is None else self._filtered
        return value

    @property
    def disturbances(self) -> Array:
        """w(i) along the trajectory."""
        return self._residuals[:, : self._width]

    @property
    def noises(self) -> Array:
        """v(i) along the trajectory, NaN where y is missing."""
        return self._residuals[:, self._width :]

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """Whether the observer's gate rejected each of its sensors, (s,); empty without a gate."""
        return np.zeros(0, np.bool_) if self._rejected is None else self._rejected

    @property
    def rejected_sensors(self) -> tuple[int, ...]:
        """The sensors that the observer's gate rejected."""
        return tuple(np.flatnonzero(self.rejected).tolist())

    def explain(self) -> str:
        """What happened, and what to do about it, in sentences; with any dropped rows."""
        text = self.status.explain()
        if self.rejected_sensors:
            text += f" Rejected sensors: {', '.join(map(str, self.rejected_sensors))}."
        if self.dropped:
            text += f" Dropped: {'; '.join(map(str, self.dropped))}."
        elif Status.CANDIDATE_OUTSIDE in self.status:
            text += (
                " The estimate violates them as well." if Status.CANDIDATE in self.status
                else " The estimate satisfies all sets."
            )
        return f"{text} {self.message}".strip()

    @property
    def improved(self) -> bool:
        """Whether the estimate is better than the candidate."""
        return Status.IMPROVED in self.status

    def __repr__(self) -> str:
        return (
            f"Estimate(time={self.time}, state={self.state.tolist()}, cost={self.cost:.6g}, "
            f"candidate_cost={self.candidate_cost:.6g}, status={self.status!s})"
        )
