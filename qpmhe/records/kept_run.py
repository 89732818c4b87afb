"""The samples of an estimation that writes rows, kept as a run."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..estimation.estimate import Estimate, Status
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..estimation.steps import Steps
from .measurements import Measurement, Time

Array = NDArray[np.float64]


class _Kept(NamedTuple):
    """What a run has of an estimate, without its trajectory."""

    state: Array
    filtered: Array
    observer_state: Array
    rejected: NDArray[np.bool_]
    cost: float
    candidate_cost: float
    step_time: float
    solve_time: float
    qps: int
    solver_iterations: int | None
    status: Status
    engine: str


class KeptRun:
    """Collects samples and estimates, with steps of any length."""

    def __init__(
        self, estimator: MovingHorizonEstimator, steps: Steps, time_unit: str
    ) -> None:
        self._estimator, self._steps, self._time_unit = estimator, steps, time_unit
        self._start, self._observer_start = estimator.state.copy(), estimator.observer_state.copy()
        self._estimates: list[Any] = []
        self._y: list[Array] = []
        self._u: list[Array] = []
        self._lengths: list[float | None] = []
        self._times: list[Time] = []  # of the samples of the record
        self._rows: list[int] = []  # which samples these are

    def add(self, y: Any, sample: Measurement, length: float | None, estimate: Estimate) -> None:
        """Take a sample; its measurement is None where it was inserted behind another one."""
        if y is not None:
            self._rows.append(len(self._estimates))
            self._times.append(sample.time)
        system, usual = self._estimator.system, self._estimator.usual
        self._y.append(np.full(system.p, np.nan) if y is None else np.array(y, np.float64))
        parameters = np.zeros(0) if usual.parameters is None else usual.parameters
        self._u.append(np.append(sample.u, parameters))
        self._lengths.append(length)
        self._estimates.append(_Kept(
            estimate.state.copy(), estimate.filtered.copy(), estimate.observer_state.copy(),
            estimate.rejected.copy(),
            *(getattr(estimate, name) for name in _Kept._fields[4:]),
        ))

    def run(self) -> Run:
        """All samples so far."""
        run = Run.of(self._start, self._estimates, observer_start=self._observer_start)
        system = self._estimator.system
        usual = self._steps.usual
        steps = None
        if usual is not None and any(one not in (None, usual) for one in self._lengths):
            steps = np.array([usual if one is None else one for one in self._lengths])
        inputs = np.array(self._u).reshape(len(run), system.m) if system.m else None
        y = np.array(self._y).reshape(len(run), system.p)
        run.source = self._estimator.run_source(y, inputs, steps, self._time_unit)
        run.index = self._index(len(run))
        return run

    def _index(self, samples: int) -> Any:
        """Times of the states where they are dates or durations; None without pandas."""
        times, rows = self._times, self._rows
        if len(times) < 2 or times[0].kind == "number" or find_spec("pandas") is None:
            return None
        first = int(times[0].value)
        since = np.array([int(one.value) - first for one in times], np.int64)
        pace = float(np.median(np.diff(since) / np.diff(rows)))
        # A resumed run may begin in a gap, and x(T) comes after the last sample.
        known = np.concatenate(([-rows[0] * pace], since, [since[-1] + pace]))
        found = np.interp(np.arange(samples + 1), [-1e-9, *rows, samples], known)
        nanoseconds = first + found.round().astype(np.int64)
        pandas = import_module("pandas")
        if times[0].kind == "duration":
            return pandas.to_timedelta(nanoseconds, unit="ns")
        return pandas.to_datetime(nanoseconds, unit="ns", utc=times[0].kind == "date with a zone")
