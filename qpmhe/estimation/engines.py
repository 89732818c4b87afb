"""The interface of an engine, which runs the step, and the registry of engines."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import CompilationError, EngineWarning
from ..model.system import System
from ..observers import Observer
from .conditions import Conditions
from .engine import PythonEngine
from .estimate import Estimate
from .run import Run
from .settings import Settings

Array = NDArray[np.float64]


class Engine(Protocol):
    """The step and its memory; `MovingHorizonEstimator` validates all arguments."""

    name: str

    @property
    def state(self) -> Array:
        """The current estimate, a copy."""

    @property
    def time(self) -> int:
        """Number of measurements taken so far."""

    @property
    def length(self) -> int:
        """Number of samples in the window."""

    def reset(self, initial_state: Array) -> None:
        """Forget all measurements and start at this state."""

    @property
    def usual(self) -> Conditions:
        """What holds where a sample has nothing of its own."""

    @property
    def system(self) -> System:
        """The system with its present sets."""

    def set(self, changes: Conditions, parameters: Array | None) -> Estimate | None:
        """Let other conditions hold at all samples of the window and from now on."""

    def step(
        self, y: Array, u: Array, dt: float | None, own: Conditions | None, began: float
    ) -> Estimate:
        """Take the sample y(t), u(t), and estimate x(t+1)."""

    def amend(self, time: int, y: Array) -> Estimate:
        """Insert a late measurement, and estimate again."""

    def run(self, ys: Array, us: Array | None) -> Run | None:
        """Take a whole record; None if the engine takes samples one at a time only."""

    def covariances(self) -> Array:
        """Covariances along the last estimate."""

    def state_dict(self) -> dict[str, Any]:
        """The memory as plain arrays and numbers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another estimator stopped."""


_ENGINES: dict[str, Callable[[System, Observer, Cost, Settings, Array], Engine]] = {
    "python": PythonEngine
}


def register_engine(
    name: str, make: Callable[[System, Observer, Cost, Settings, Array], Engine]
) -> None:
    """Let ``engine=name`` use this factory, which may raise `CompilationError`."""
    _ENGINES[name] = make


def engine_for(
    system: System, observer: Observer, cost: Cost, settings: Settings, initial_state: Array
) -> Engine:
    """The engine that the settings ask for, or the Python one where compilation fails."""
    try:
        return _ENGINES[settings.engine](system, observer, cost, settings, initial_state)
    except CompilationError as error:
        warnings.warn(
            f"engine={settings.engine!r} falls back to the Python step: {error}",
            EngineWarning,
            stacklevel=4,
        )
    return PythonEngine(system, observer, cost, settings, initial_state)
