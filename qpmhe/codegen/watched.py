"""Functions that a compiled estimator traced, compared again with their present values."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..model.system import System
from ..model.tracing import Traced
from ..observers import Observer
from .losses import loss_function

Array = NDArray[np.float64]


class WatchedFunctions:
    """f and h, and with them residual functions, losses and a correction, where they are traced.

    True if there are any.
    """

    def __init__(self, system: System, observer: Observer, cost: Cost) -> None:
        self.system, self._count = system, 0
        self._others: dict[str, Traced] = {}
        for name in ("output_residual", "state_residual"):
            residual = getattr(system, name)
            if residual is not None and residual.periods is None:
                self._others[name] = residual.expression
        losses: Any = () if cost.c_form is None else cost.c_form.losses
        for k, one in enumerate(losses):
            if one.kind == "own":
                self._others[f"loss {k}"] = loss_function(one)
        own: Any = observer.c_form
        if own is not None and own.correction is not None:
            self._others["the correction"] = own.correction(system.n, system.p)

    def __bool__(self) -> bool:
        return self.system.evaluation.is_traced or bool(self._others)

    def fault(self, z: Array, u: Array) -> str:
        """Which function differs from its trace, and how; blank if none does.

        f and h are compared at the observer's state, the others at one of the points of the first
        comparison, a different one each time.
        """
        fault = self.system.evaluation.fault(z, u)
        for name, one in self._others.items():
            text = one.fault(self._count)
            if text and not fault:
                fault = f"{name} has changed since it was traced: {text}"
        self._count += 1
        return fault
