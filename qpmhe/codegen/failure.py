"""What failed in a step in C, in the words of the step in Python."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..estimation.conditions import Conditions
from ..estimation.engine import PythonEngine
from ..estimation.estimate import Estimate, Status
from ..estimation.settings import Settings
from ..model.system import System
from ..observers import Observer
from .exchange import hand_over
from .library import EstimatorLibrary

#: Flags of a step in which a function of the model, the observer or the cost has failed.
FAILED = Status.MODEL_FAILED.value


class Failure:
    """The message of a failed step in C, which the Python step writes.

    The step in C returns flags and no text. When somebody reads the message, the Python step runs
    from the memory that the step in C began with, and its message is returned. A failed step in C
    costs no more than the copy of that memory, which its estimate keeps.

    Parameters
    ----------
    parts : tuple
        System, observer, cost and settings of the step, without a time budget.
    library : EstimatorLibrary
        Its library.
    usual : Conditions
        The usual conditions before the step.
    memory : array
        An ``mhe_estimator`` before the step; a copy.
    step : callable
        Takes the step with a Python engine.
    """

    def __init__(
        self, parts: tuple[System, Observer, Cost, Settings], library: EstimatorLibrary,
        usual: Conditions, memory: NDArray[Any], step: Callable[[PythonEngine], Estimate | None],
    ) -> None:
        self._parts, self._library, self._usual = parts, library, usual
        self._memory, self._step = memory, step

    def __call__(self) -> str:
        """The message; blank if the Python step does not fail."""
        system, observer, cost, settings = self._parts
        library, record = self._library, self._memory[0]
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # the step in C has given them
            engine = PythonEngine(system, observer, cost, settings, record["z_end"].copy())
            hand_over(record, library.layout, library.directions, self._usual, engine, True)
            estimate = self._step(engine)
        return "" if estimate is None else estimate.message
