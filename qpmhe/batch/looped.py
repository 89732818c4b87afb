"""A batch as a loop over single estimators, for all that cannot be done on vectors."""

from __future__ import annotations

from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..estimation.engine import PythonEngine
from ..estimation.estimate import Estimate
from ..estimation.settings import Settings
from ..model.system import System
from ..observers import Observer
from .results import BatchEstimate

__all__ = ["LoopedEngine"]

Array = NDArray[np.float64]


class LoopedEngine:
    """One engine of a single estimator a member; see `qpmhe.batch.engines.BatchEngine`.

    Parameters
    ----------
    system, observer, cost, settings
        What the members have in common.
    states : (K, n) array
        The initial estimates.
    """

    def __init__(
        self, system: System, observer: Observer, cost: Cost, settings: Settings, states: Array
    ) -> None:
        self._delay = settings.delay
        self._engines = [
            PythonEngine(system._private(), observer, cost, settings, state.copy())
            for state in states
        ]

    @property
    def states(self) -> Array:
        """See `qpmhe.batch.engines.BatchEngine.states`."""
        return np.array([engine.state for engine in self._engines])

    @property
    def time(self) -> int:
        """See `qpmhe.batch.engines.BatchEngine.time`."""
        return self._engines[0].time

    def reset(self, states: Array) -> None:
        """See `qpmhe.batch.engines.BatchEngine.reset`."""
        before = [engine.memory for engine in self._engines]
        try:
            for engine, state in zip(self._engines, states, strict=True):
                engine.reset(state)
        except BaseException:  # an interrupt: all members or none
            for engine, memory in zip(self._engines, before, strict=True):
                engine.replace(*memory)
            raise

    def step(self, y: Array, u: Array) -> BatchEstimate:
        """See `qpmhe.batch.engines.BatchEngine.step`."""
        time = self.time
        try:
            estimates = [
                engine.step(y[k], u[k], None, None, perf_counter())
                for k, engine in enumerate(self._engines)
            ]
            return self._collected(estimates)
        except BaseException:
            for engine in self._engines:
                if engine.time > time:
                    engine.undo()
            raise

    def _collected(self, estimates: list[Estimate]) -> BatchEstimate:
        return BatchEstimate(
            estimates[0].time,
            np.array([one.trajectory for one in estimates]),
            np.array([one.cost for one in estimates]),
            np.array([one.candidate for one in estimates]),
            np.array([one.candidate_cost for one in estimates]),
            np.array([one.status.value for one in estimates], np.int64),
            np.array([one.qps for one in estimates], np.intp),
            self._delay,
        )
