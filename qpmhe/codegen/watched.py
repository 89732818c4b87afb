"""Functions that a compiled estimator traced, compared again with their present values."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import CompilationError
from ..model.captured import ComparisonTimes, Due
from ..model.system import System
from ..model.tracing import Traced
from ..observers import Observer
from .losses import loss_function

Array = NDArray[np.float64]


class WatchedFunctions:
    """f, h, g, and with them residual functions, losses and a correction, where they are traced.

    Parameters
    ----------
    system, observer, cost
        Whose functions they are.
    calls : bool
        Whether they may be called after each 1000 samples.

    Raises
    ------
    CompilationError
        If one differs from its trace already.

    Attributes
    ----------
    times : ComparisonTimes
        When to call `fault`.
    """

    def __init__(self, system: System, observer: Observer, cost: Cost, calls: bool) -> None:
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
        others = [one.user_function for one in self._others.values()]
        functions = [*system.traced_functions, *(one for one in others if one)]
        if fault := self.fault(Due.EVERYWHERE, ()):
            raise CompilationError(fault)
        self.times = ComparisonTimes(functions, calls)

    def fault(self, due: Due, where: Iterable[tuple[Array, Array]]) -> str:
        """Which function differs from its trace, and how; blank if none does.

        f, h and g are compared at these states and inputs, the others at points of the first
        comparison: at one, a different one each time, or at all if ``due`` is everywhere.
        """
        everywhere = due is Due.EVERYWHERE
        points = [*where, *(self.system.usual_points() if everywhere else ())]
        fault = self.system.fault(points)
        for name, one in self._others.items():
            text = one.fault(None if everywhere else self._count)
            if text and not fault:
                fault = f"{name} has changed since it was traced: {text}"
        self._count += 1
        return fault
