"""The estimate of the compiled engine, read where C has written it."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ObserverWarning
from ..estimation.estimate import DroppedRow, Estimate, Status
from ..estimation.watch import ObserverWatch

Array = NDArray[np.float64]

_SOLVER_FAILED = Status.SOLVER_FAILED.value
_MESSAGE = "the factorisation failed: H is not positive definite, or not finite"
# Numbers in the block before the trajectory: three costs.
_COSTS = 3

#: Flags of what may be worth a warning.
WATCHED = (Status.ROWS_DROPPED | Status.OBSERVER_FAR).value


class CompiledWatch(ObserverWatch):
    """The watch on an observer, where C counts."""

    def warn(self, far: int, dropped: int, level: int) -> None:
        """Warn once, at a level of the stack, if too many consecutive samples are counted."""
        text = self.warning((far, dropped))
        if text is not None:
            warnings.warn(text, ObserverWarning, stacklevel=level + 1)


class CompiledEstimate(Estimate):
    """An estimate whose arrays are views of one block, made on access."""

    __slots__ = ("_block", "_numbers", "_sizes", "_to_disturbances")

    engine = "compiled"

    def __init__(
        self, block: Array, numbers: list[int], time: int, sizes: tuple[int, int, int],
        dropped: tuple[DroppedRow, ...] = (), to_disturbances: Array | None = None,
        rejected: NDArray[np.bool_] | None = None,
    ) -> None:
        self._block, self._numbers, self.time = block, numbers, time
        self._sizes, self.dropped = sizes, dropped
        self._to_disturbances, self._rejected = to_disturbances, rejected
        n = sizes[0]
        end = _COSTS + (numbers[0] + 1) * n
        self.state = block[end - n : end]

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = (
            self._block, self._numbers, self.time, self._sizes, self.dropped,
            self._to_disturbances, self._rejected,
        )
        return _restored, (arguments, self.step_time)

    def _rows(self, start: int, rows: int, width: int) -> Array:
        return self._block[start : start + rows * width].reshape(rows, width)

    @property
    def cost(self) -> float:  # type: ignore[override]
        """True cost J of the estimate."""
        return float(self._block[0])

    @property
    def candidate_cost(self) -> float:  # type: ignore[override]
        """True cost J of the candidate."""
        return float(self._block[1])

    @property
    def restored_cost(self) -> float:  # type: ignore[override]
        """J of the trajectory into which the candidate was restored; NaN if it was not."""
        return float(self._block[2])

    @property
    def trajectory(self) -> Array:  # type: ignore[override]
        """Estimates of all states in the window."""
        return self._rows(_COSTS, self._numbers[0] + 1, self._sizes[0])

    @property
    def candidate(self) -> Array:  # type: ignore[override]
        """The observer's trajectory."""
        n, _, horizon = self._sizes
        return self._rows(_COSTS + (horizon + 1) * n, self._numbers[0] + 1, n)

    @property
    def disturbances(self) -> Array:
        """w(i) along the trajectory."""
        n, _, horizon = self._sizes
        d = self._rows(_COSTS + 2 * (horizon + 1) * n, self._numbers[0], n)
        return d if self._to_disturbances is None else d @ self._to_disturbances.T

    @property
    def noises(self) -> Array:
        """v(i) along the trajectory, NaN where y is missing."""
        n, p, horizon = self._sizes
        return self._rows(_COSTS + 2 * (horizon + 1) * n + horizon * n, self._numbers[0], p)

    @property
    def status(self) -> Status:  # type: ignore[override]
        """Outcome and events."""
        return Status(self._numbers[1])

    @property
    def message(self) -> str:  # type: ignore[override]
        """The QP solver's message where it failed."""
        return _MESSAGE if self._numbers[1] & _SOLVER_FAILED else ""

    @property
    def qps(self) -> int:  # type: ignore[override]
        """QPs solved."""
        return self._numbers[2]

    @property
    def solver_iterations(self) -> int:  # type: ignore[override]
        """Guesses of the active rows, and iterations of the interior-point method."""
        return self._numbers[3]

    @property
    def corrections(self) -> int:  # type: ignore[override]
        """Second-order corrections."""
        return self._numbers[4]

    @property
    def nearest_points(self) -> int:  # type: ignore[override]
        """QPs for a feasible trajectory near an infeasible candidate."""
        return self._numbers[5]

    @property
    def filtered(self) -> Array:
        """Estimate of x(t) that has used y(t)."""
        return self._block[self._block.size - self._sizes[0] :]

    @property
    def observer_state(self) -> Array:  # type: ignore[override]
        """z(t+1), the state from which the observer continues."""
        n = self._sizes[0]
        return self._block[-2 * n : self._block.size - n]

    @property
    def solve_time(self) -> float:  # type: ignore[override]
        """NaN: the C step does not measure it."""
        return math.nan


def _restored(arguments: tuple[Any, ...], step_time: float) -> CompiledEstimate:
    estimate = CompiledEstimate(*arguments)
    estimate.step_time = step_time
    return estimate
