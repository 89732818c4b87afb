"""Samples at which the model itself failed: how many, which one first, and why."""

from __future__ import annotations

import traceback
from collections import deque
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .. import functions
from ..estimate import Estimate, Status
from ..system import System
from .places import place

__all__ = ["Failures"]

Array = NDArray[np.float64]

# What is raised by a mistake in writing, and not by a state at which the model has no value.
_MISTAKES = (TypeError, NameError, AttributeError, ImportError)
# Only so often is the model asked again: it may be slow.
_ATTEMPTS = 10


class Failures:
    """Steps whose status has MODEL_FAILED or FAILED_STAGE.

    Parameters
    ----------
    system : System
        The model.
    horizon : int
        Stages in the window.
    file : Path, optional
        Where the model is written down.

    Attributes
    ----------
    failed : int
        Steps at which the model failed.
    stale : int
        Steps without such a failure whose window still has one.
    is_mistake : bool
        Whether the model is wrong, rather than not defined at some states.
    where : str
        Place in the record of the first failure; whoever is told of it fills it in.
    why : str
        What happened there; blank before it, and where the model cannot be got to do it again.
    """

    def __init__(self, system: System, horizon: int, file: Path | None = None) -> None:
        self.failed = self.stale = 0
        self.is_mistake, self.where, self.why = False, "", ""
        self._system, self._file = system, file
        self._inputs: deque[tuple[Array, float | None]] = deque(maxlen=horizon)
        self._attempts = 0

    def note(self, estimate: Estimate, u: Array, length: float | None) -> bool:
        """Look at a step; whether its failure is the first one.

        Parameters
        ----------
        estimate : Estimate
            What the step gave.
        u : (m,) array
            Its input.
        length : float or None
            Its length, if it is not the usual one.
        """
        self._inputs.append((u, length))
        if Status.MODEL_FAILED not in estimate.status:
            self.stale += Status.FAILED_STAGE in estimate.status
            return False
        self.failed += 1
        if not self.why and self._attempts < _ATTEMPTS:
            self._attempts += 1
            self.why = self._ask_again(estimate)
        return self.failed == 1

    def _ask_again(self, estimate: Estimate) -> str:
        """What the model does at the states of a step; blank if nothing is wrong any more."""
        for trajectory in (estimate.candidate, estimate.trajectory):
            # The newest ones first: there most failures arise.
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
                    except Exception as error:  # a user's function may raise anything
                        own = place(error, self._file)
                        self.is_mistake = isinstance(error, _MISTAKES) or _by_shape(error)
                        return f"{own}{name} raised {type(error).__name__}: {error} {at}"
                    if value.shape != shape:
                        self.is_mistake = True
                        return f"{name} returned shape {value.shape} {at}; expected {shape}"
                    if not np.isfinite(value).all():
                        return f"{name} is {value.tolist()} {at}"
        return ""

    def told(self, samples: int) -> str:
        """All of it in a few sentences; blank if nothing failed.

        Parameters
        ----------
        samples : int
            How many there were in all.
        """
        if not self.failed:
            return ""
        text = f"the model failed at {self.failed} of {samples} samples (MODEL_FAILED)"
        if self.stale:
            text += f", which spoil the windows of {self.stale} more (FAILED_STAGE)"
        return f"{text}, first at {self.reason}"

    @property
    def reason(self) -> str:
        """Where it failed first, why, and what to do."""
        why = self.why or "asked again, it has values there; is it random?"
        remedy = (
            "Correct the model." if self.is_mistake
            else "Bound the states, or make the model defined on all of them."
        )
        return f"{self.where}: {why}. {remedy}"


def _by_shape(error: Exception) -> bool:
    """Whether a value could not be brought into the shape of one."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and frames[-1].filename == functions.__file__
