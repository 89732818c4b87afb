"""The results of a whole record."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._checks import numbers
from ..costs import Cost
from ..model.system import System
from ..observers import Observer
from .estimate import Estimate, Status
from .settings import Settings

Array = NDArray[np.float64]
Integers = NDArray[np.intp]


class RunSource(NamedTuple):
    """What a run was made from, by reference.

    Parameters
    ----------
    system, observer, cost, settings : System, Observer, Cost and Settings
        Those of the estimator, with what `MovingHorizonEstimator.set` has changed.
    measurements : (T, p) array
        y, NaN where it is missing.
    inputs : (T, m) array or None
        u, the parameters behind the rest; None for a system without inputs.
    steps : (T,) array or None
        Lengths of the steps; None where all are the usual one.
    """

    system: System
    observer: Observer
    cost: Cost
    settings: Settings
    measurements: Array
    inputs: Array | None
    steps: Array | None = None


class Run:
    """Results of T consecutive updates, as arrays.

    Parameters
    ----------
    states : (T + 1, n) array
        Estimates of x(0), ..., x(T), each made before y of its own time; row 0 is the start.
    filtered : (T, n) array
        Estimates of x(0), ..., x(T-1), each made with y of its own time.
    costs, candidate_costs : (T,) array
        True cost J of estimate and candidate.
    times, solve_times : (T,) array
        Seconds for each update, and for the QP solver in it. A compiled run gives means over
        pieces of some hundred samples, and NaN for its solver.
    qps : (T,) array
        QPs solved.
    solver_iterations : (T,) array
        The solver's own iterations, -1 where it reports none.
    delayed : (T, n) array
        Delayed estimates, NaN until the window reaches the delay.
    flags : (T,) array
        Values of the statuses.
    observer_states : (T + 1, n) array
        The observer's own states z(0), ..., z(T).
    covariances : (T, n, n) array, optional
        Covariances of the estimates of x(1), ..., x(T), if requested; NaN where the model
        could not be linearised.
    rejected_sensors : (T, s) bool array, optional
        Whether the gate of the observer rejected each of its s sensors; s is 0 without a gate.
    engine : str
        What ran the steps: ``python``, ``compiled``, or ``compiled, then python`` where a model
        has changed since it was compiled.

    Attributes
    ----------
    statuses : list of Status
        Outcome and events of each step.
    source : RunSource or None
        What it was made from, for `qpmhe.diagnose`; None for a run that was put together from
        single estimates, or unpickled.
    """

    source: RunSource | None = None

    def __init__(
        self,
        *,
        states: Array,
        filtered: Array,
        costs: Array,
        candidate_costs: Array,
        times: Array,
        solve_times: Array,
        qps: Integers,
        solver_iterations: Integers,
        delayed: Array,
        flags: NDArray[np.integer[Any]],
        observer_states: Array,
        covariances: Array | None = None,
        rejected_sensors: NDArray[np.bool_] | None = None,
        engine: str = "python",
    ) -> None:
        self.states, self.filtered, self.delayed = states, filtered, delayed
        self.costs, self.candidate_costs = costs, candidate_costs
        self.times, self.solve_times = times, solve_times
        self.qps, self.solver_iterations = qps, solver_iterations
        self.flags, self.covariances, self.engine = flags, covariances, engine
        self.observer_states = observer_states
        if rejected_sensors is None:
            rejected_sensors = np.zeros((flags.size, 0), np.bool_)
        self.rejected_sensors = rejected_sensors

    @classmethod
    def of(
        cls, start: Array, estimates: Sequence[Estimate], covariances: Array | None = None, *,
        observer_start: Array | None = None,
    ) -> Run:
        """Collect the estimates of single updates.

        Parameters
        ----------
        start : (n,) array
            The estimate before the first update.
        estimates : sequence of Estimate
            One for each update.
        covariances : (T, n, n) array, optional
            Covariances of their states.
        observer_start : (n,) array, optional
            The observer's state before the first update; the estimate if left out, as at time 0.
        """
        start = numbers("start", start)
        n = start.size
        first = start if observer_start is None else observer_start
        nothing = np.full(n, np.nan)
        return cls(
            states=np.array([start, *(e.state for e in estimates)]),
            filtered=np.array([e.filtered for e in estimates]).reshape(-1, n),
            costs=np.array([e.cost for e in estimates]),
            candidate_costs=np.array([e.candidate_cost for e in estimates]),
            times=np.array([e.step_time for e in estimates]),
            solve_times=np.array([e.solve_time for e in estimates]),
            qps=np.array([e.qps for e in estimates], dtype=np.intp),
            solver_iterations=np.array(
                [-1 if e.solver_iterations is None else e.solver_iterations for e in estimates],
                dtype=np.intp,
            ),
            delayed=np.array(
                [nothing if e.delayed is None else e.delayed for e in estimates]
            ).reshape(-1, n),
            flags=np.array([e.status.value for e in estimates], dtype=np.intp),
            observer_states=np.array([first, *(e.observer_state for e in estimates)]),
            covariances=covariances,
            rejected_sensors=np.array([e.rejected for e in estimates]) if estimates else None,
            engine=", then ".join(dict.fromkeys(one.engine for one in estimates)) or "python",
        )

    @cached_property
    def statuses(self) -> list[Status]:
        """Outcome and events of each step."""
        known = {value: Status(value) for value in np.unique(self.flags).tolist()}
        return [known[value] for value in self.flags.tolist()]

    def __getstate__(self) -> dict[str, Any]:
        # The functions of a system often cannot be pickled.
        return {name: value for name, value in vars(self).items() if name != "source"}

    def __len__(self) -> int:
        return self.flags.size

    def share(self, flag: Status) -> float:
        """The share of steps whose status has this flag."""
        has = (self.flags & flag.value) == flag.value
        return float(has.sum()) / max(1, len(self))

    def reasons(self) -> dict[str, int]:
        """Counts of each combination of flags, the most frequent first."""
        counts = Counter(str(status).removeprefix("Status.") for status in self.statuses)
        return dict(counts.most_common())
