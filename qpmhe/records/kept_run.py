"""The samples of an estimation that writes rows, kept as a run."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..estimation.estimate import Estimate, Status
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..estimation.steps import Steps

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

    def add(self, y: Any, u: Array, length: float | None, estimate: Estimate) -> None:
        """Take a sample; its measurement is None where it was inserted."""
        system, usual = self._estimator.system, self._estimator.usual
        self._y.append(np.full(system.p, np.nan) if y is None else np.array(y, np.float64))
        parameters = np.zeros(0) if usual.parameters is None else usual.parameters
        self._u.append(np.append(u, parameters))
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
        return run
