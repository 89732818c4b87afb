"""The interface of an engine, which runs the step, and the registry of engines."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import (
    CompilationError,
    EngineWarning,
    InvalidInputError,
    OptionError,
    QpmheError,
)
from ..model.system import System
from ..observers import Observer
from ..terms.entries import has_enough_states
from .conditions import Conditions
from .engine import PythonEngine
from .estimate import Estimate
from .problem import Solved
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
    def observer_state(self) -> Array:
        """The state from which the observer continues, a copy."""

    @property
    def time(self) -> int:
        """Number of measurements taken so far."""

    @property
    def length(self) -> int:
        """Number of samples in the window."""

    def reset(self, initial_state: Array, system: System | None = None) -> None:
        """Forget all measurements and start at this state.

        From now on with the functions as they are evaluated by this system, if one is given.
        """

    @property
    def usual(self) -> Conditions:
        """The conditions of a sample that brings none."""

    @property
    def system(self) -> System:
        """The system with its present sets."""

    def set(self, changes: Conditions, parameters: Array | None) -> Estimate | None:
        """Change the conditions of all samples in the window and of later ones."""

    def step(
        self, y: Array, u: Array, dt: float | None, own: Conditions | None, began: float
    ) -> Estimate:
        """Take the sample y(t), u(t), and estimate x(t+1)."""

    def verify(self, u: Array) -> bool:
        """Compare functions and their traces now, with this usual input; whether they agree."""

    def amend(self, time: int, y: Array) -> Estimate:
        """Insert a late measurement, and estimate again."""

    def run(self, ys: Array, us: Array | None) -> Run | None:
        """Process a whole record; None if the engine only takes one sample at a time."""

    def covariances(self) -> Array:
        """Covariances along the last estimate."""

    def solved(self) -> Solved:
        """The last step's problem and its estimate."""

    def forget_warm_start(self) -> None:
        """Have the next QP start without what a solver has kept."""

    def state_dict(self) -> dict[str, Any]:
        """The memory as plain arrays and numbers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another estimator stopped."""


class EngineChangeError(Exception):
    """A compiled engine's model has changed: another engine continues, from before the sample."""

    def __init__(self, engine: Engine, reason: str) -> None:
        super().__init__(reason)
        self.engine = engine


class ModelChangedError(Exception):
    """The functions differ from what was compiled; all members of a batch are as before."""


Make = Callable[[System, Observer, Cost, Settings, Array], Engine]
Prepare = Callable[[System, Observer, Cost, Settings, int], tuple[bool, str]]

_ENGINES: dict[str, Make] = {"python": PythonEngine}
_PREPARE: dict[str, Prepare] = {}


def register_engine(name: str, make: Make, prepare: Prepare | None = None) -> None:
    """Register a factory for ``engine=name``, which may raise `CompilationError`.

    A factory named ``compiled`` also serves ``engine="auto"``. There it must raise instead of
    compiling, and wherever it lacks a feature. Before a record of so many samples, ``prepare`` then
    makes ready what the factory needs, if that pays: it returns whether the factory can be called,
    and why, in words that are blank where there was nothing to decide.
    """
    _ENGINES[name] = make
    if prepare is not None:
        _PREPARE[name] = prepare


def engine_for(
    system: System, observer: Observer, cost: Cost, settings: Settings, initial_state: Array
) -> Engine:
    """The engine that the settings ask for, or the Python one where compilation fails."""
    if settings.engine == "auto":
        return _at_hand(system, observer, cost, settings, initial_state)
    try:
        return _ENGINES[settings.engine](system, observer, cost, settings, initial_state)
    except CompilationError as error:
        warnings.warn(
            f"engine={settings.engine!r} falls back to the Python step: {error}",
            EngineWarning,
            stacklevel=4,
        )
    return PythonEngine(system, observer, cost, settings, initial_state)


def _at_hand(
    system: System, observer: Observer, cost: Cost, settings: Settings, initial_state: Array
) -> Engine:
    """The compiled engine where it is ready, else the Python one; no word, no wait."""
    parts = system, observer, cost, settings, initial_state
    make = _ENGINES.get("compiled")
    if make is not None and not settings.needs_python and not python_only():
        found = PythonEngine(*parts) if has_enough_states(system.n) else None
        if found is not None and found.outpaces_c:
            return found
        # Nobody asked for this engine; what is wrong with the arguments, the other reports.
        with suppress(Exception):
            return make(*parts)
        if found is not None:
            return found
    return PythonEngine(*parts)


def reason_for_python(engine: Engine) -> str:
    """Why ``engine="auto"`` stays with this engine, whatever is compiled; blank where it does not.

    The step in C factorises whole blocks.
    """
    if isinstance(engine, PythonEngine) and engine.outpaces_c:
        return "its Jacobians are sparse, for which the Python step is the faster one"
    return ""


def engine_for_record(
    engine: Engine, system: System, observer: Observer, cost: Cost, settings: Settings,
    samples: int,
) -> tuple[Engine, str]:
    """The engine for a record of so many samples that begins now, and why; blank without a choice.

    With ``engine="auto"``, the compiled engine may take the place of a Python engine that has no
    sample yet: it continues with the state and the usual conditions of that one.
    """
    prepare = _PREPARE.get("compiled")
    is_free = settings.engine == "auto" and engine.name == "python" and not engine.time
    if prepare is None or not is_free or settings.needs_python or python_only():
        return engine, ""
    if reason := reason_for_python(engine):
        return engine, reason
    system = system.evaluated_like(engine.system)
    is_ready, reason = prepare(system, observer, cost, settings, samples)
    if is_ready:
        state, usual = engine.state, engine.usual
        with suppress(Exception):  # as for an engine that nobody asked for
            made = _ENGINES["compiled"](system, observer, cost, settings, state)
            made.set(usual, usual.parameters)
            made.reset(state)
            return made, reason
        reason = f"the compiled step could not be made, although {reason}"
    return engine, reason


def engine_of_snapshot(
    name: str, system: System, observer: Observer, cost: Cost, settings: Settings,
    initial_state: Array,
) -> Engine:
    """The engine that a snapshot was taken with, for an estimator whose engine is "auto"."""
    parts = system, observer, cost
    if name == "python":
        return PythonEngine(*parts, settings, initial_state)
    if name not in _ENGINES:
        raise InvalidInputError(
            f"the state is from an estimator with engine={name!r}; expected one of "
            f"{', '.join(_ENGINES)}."
        )
    try:
        if settings.needs_python:
            raise OptionError("the compiled step solves its QPs itself, without a backend.")
        return _ENGINES[name](*parts, settings, initial_state)
    except (QpmheError, OSError) as error:
        raise InvalidInputError(
            f"the state is from an estimator with engine={name!r}, which is not ready here: "
            f"{str(error).rstrip('.')}. Call qpmhe.compile with this estimator first, or create it "
            f"with engine={name!r}."
        ) from error


def python_only() -> bool:
    """Whether the environment keeps ``engine="auto"`` to the Python step."""
    wanted = os.environ.get("QPMHE_ENGINE", "auto")
    if wanted not in ("auto", "python"):
        raise OptionError(
            f"the environment variable QPMHE_ENGINE is {wanted!r}; expected 'python', which keeps "
            "engine='auto' to the Python step, or 'auto'."
        )
    return wanted == "python"
