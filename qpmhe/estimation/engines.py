"""Which engine carries out the steps."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import CompilationError, EngineWarning
from ..model.system import System
from ..observers import Observer
from .engine import PythonEngine
from .settings import Settings

if TYPE_CHECKING:
    from ..codegen.engine import CompiledEngine

__all__ = ["engine_for"]

Array = NDArray[np.float64]


def engine_for(
    system: System, observer: Observer, cost: Cost, settings: Settings, initial_state: Array
) -> PythonEngine | CompiledEngine:
    """The engine that the settings ask for, or the Python one where it cannot be compiled.

    Parameters
    ----------
    system, observer, cost, settings, initial_state
        The estimator's.

    Raises
    ------
    OptionError
        If the compiled engine does not cover something.
    """
    if settings.engine == "compiled":
        from ..codegen.engine import CompiledEngine  # late: most programs do without

        try:
            return CompiledEngine(system, observer, cost, settings, initial_state)
        except CompilationError as error:
            warnings.warn(
                f"engine='compiled' is carried out by the Python step: {error}",
                EngineWarning,
                stacklevel=4,
            )
    return PythonEngine(system, observer, cost, settings, initial_state)
