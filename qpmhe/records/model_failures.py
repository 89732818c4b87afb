"""Samples at which the model itself failed: how many, which one first, and why."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..estimation.estimate import Estimate, Status
from ..model.functions import EvaluationError
from ..model.system import System
from ..models.loading import code_place

__all__ = ["ModelFailures"]

Array = NDArray[np.float64]

# A mistake in the code raises these, a state at which the model has no value does not.
_MISTAKES = (TypeError, NameError, AttributeError, ImportError)
# The model is evaluated again only so often: it may be slow.
_ATTEMPTS = 10


class ModelFailures:
    """Counts steps with MODEL_FAILED (`failed`), and others with FAILED_STAGE (`stale`).

    `is_mistake` says that the model's code is wrong, rather than undefined at some states;
    `place` is where the first failure lies in the record, which the caller fills in.
    """

    def __init__(self, system: System, horizon: int, file: Path | None = None) -> None:
        self.failed = self.stale = 0
        self.is_mistake, self.place = False, ""
        self._why = ""
        self._system, self._file = system, file
        self._inputs: deque[tuple[Array, float | None]] = deque(maxlen=horizon)
        self._attempts = 0

    def note(self, estimate: Estimate, u: Array, length: float | None) -> bool:
        """Count a step with input u and unusual length; whether it is the first failure."""
        self._inputs.append((u, length))
        if Status.MODEL_FAILED not in estimate.status:
            self.stale += Status.FAILED_STAGE in estimate.status
            return False
        self.failed += 1
        if not self._why and self._attempts < _ATTEMPTS:
            self._attempts += 1
            self._why = self._evaluate_again(estimate)
        return self.failed == 1

    def _evaluate_again(self, estimate: Estimate) -> str:
        """What the model does at the states of a step; blank if nothing is wrong any more."""
        for trajectory in (estimate.candidate, estimate.trajectory):
            # Most failures arise at the newest states.
            for x, (u, length) in zip(trajectory[-2::-1], reversed(self._inputs), strict=False):
                system = self._system
                if length is not None:
                    system, u = system.timed, np.append(u, length)
                for name, function, shape in (
                    ("f", system.f, (system.n,)),
                    ("h", system.h, (system.p,)),
                    ("the Jacobian of f", system.f_jacobian, (system.n, system.n)),
                    ("the Jacobian of h", system.h_jacobian, (system.p, system.n)),
                ):
                    at = f"at x = {np.array2string(x, precision=6, separator=', ')}"
                    try:
                        with np.errstate(all="ignore"):
                            value = np.asarray(function(x.copy(), u.copy()), dtype=np.float64)
                    except EvaluationError as error:
                        self.is_mistake = error.__cause__ is None  # a wrong shape or type
                        return f"{error} {at}"
                    except Exception as error:  # a user's function may raise anything
                        self.is_mistake = isinstance(error, _MISTAKES)
                        place = code_place(error, self._file)
                        return f"{place}{name} raised {type(error).__name__}: {error} {at}"
                    if value.shape != shape:
                        self.is_mistake = True
                        return f"{name} returned shape {value.shape}; expected {shape} {at}"
                    if not np.isfinite(value).all():
                        return f"{name} is {value.tolist()} {at}"
        return ""

    def report(self, samples: int) -> str:
        """All failures among so many samples in a few sentences; blank if there are none."""
        if not self.failed:
            return ""
        text = f"the model failed at {self.failed} of {samples} samples (MODEL_FAILED)"
        if self.stale:
            text += f", which affects the windows of {self.stale} more (FAILED_STAGE)"
        return f"{text}, first at {self.reason}"

    @property
    def reason(self) -> str:
        """Where the model failed first, why, and what to do."""
        why = self._why or "evaluated again, it has values there; is it random?"
        remedy = (
            "Correct the model." if self.is_mistake
            else "Bound the states, or make the model defined on all of them."
        )
        return f"{self.place}: {why}. {remedy}"
