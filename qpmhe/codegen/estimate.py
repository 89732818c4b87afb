"""The estimate of the compiled engine, read where C has written it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ObserverWarning
from ..estimation.estimate import DroppedRow, Estimate, Status, naming_missed
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


def _read(value: Callable[[CompiledEstimate], Any]) -> Any:
    """An attribute of an estimate, read when it is asked for."""
    return property(value)


class CompiledEstimate(Estimate):
    """An estimate whose arrays are views of one block, made on access."""

    __slots__ = ("_block", "_missed", "_numbers", "_sizes", "_to_disturbances", "failure")

    engine = "compiled"

    def __init__(
        self, block: Array, numbers: list[int], time: int, sizes: tuple[int, int, int],
        dropped: tuple[DroppedRow, ...] = (), to_disturbances: Array | None = None,
        rejected: NDArray[np.bool_] | None = None, missed: tuple[DroppedRow, ...] = (),
    ) -> None:
        self._block, self._numbers, self.time = block, numbers, time
        self._sizes, self.dropped = sizes, dropped
        self._to_disturbances, self._rejected = to_disturbances, rejected
        self._missed = missed
        #: What failed in words, or what finds them when they are asked for.
        self.failure: str | Callable[[], str] = ""
        n = sizes[0]
        end = _COSTS + (numbers[0] + 1) * n
        self.state = block[end - n : end]

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = (
            self._block, self._numbers, self.time, self._sizes, self.dropped,
            self._to_disturbances, self._rejected, self._missed,
        )
        return _restored, (arguments, self.step_time, self._failed())

    def _failed(self) -> str:
        if not isinstance(self.failure, str):
            self.failure = self.failure()
        return self.failure

    def _rows(self, start: int, rows: int, width: int) -> Array:
        return self._block[start : start + rows * width].reshape(rows, width)

    cost = _read(lambda self: float(self._block[0]))
    candidate_cost = _read(lambda self: float(self._block[1]))
    restored_cost = _read(lambda self: float(self._block[2]))
    trajectory = _read(lambda self: self._rows(_COSTS, self._numbers[0] + 1, self._sizes[0]))
    status = _read(lambda self: Status(self._numbers[1]))
    qps = _read(lambda self: self._numbers[2])
    solver_iterations = _read(lambda self: self._numbers[3])
    corrections = _read(lambda self: self._numbers[4])
    nearest_points = _read(lambda self: self._numbers[5])
    solve_time = math.nan  # C does not measure it

    @_read
    def message(self) -> str:
        """What failed, and which rows no trajectory satisfies."""
        if text := self._failed():
            return text
        return naming_missed(self._missed, _MESSAGE if self._numbers[1] & _SOLVER_FAILED else "")

    @_read
    def candidate(self) -> Array:
        """The observer's trajectory."""
        n, _, horizon = self._sizes
        return self._rows(_COSTS + (horizon + 1) * n, self._numbers[0] + 1, n)

    @_read
    def disturbances(self) -> Array:
        """w(i) along the trajectory."""
        n, _, horizon = self._sizes
        d = self._rows(_COSTS + 2 * (horizon + 1) * n, self._numbers[0], n)
        return d if self._to_disturbances is None else d @ self._to_disturbances.T

    @_read
    def noises(self) -> Array:
        """v(i) along the trajectory, NaN where y is missing."""
        n, p, horizon = self._sizes
        return self._rows(_COSTS + 2 * (horizon + 1) * n + horizon * n, self._numbers[0], p)

    @_read
    def filtered(self) -> Array:
        """Estimate of x(t) that has used y(t)."""
        return self._block[self._block.size - self._sizes[0] :]

    @_read
    def observer_state(self) -> Array:
        """z(t+1), the state from which the observer continues."""
        n = self._sizes[0]
        return self._block[-2 * n : self._block.size - n]


def _restored(arguments: tuple[Any, ...], step_time: float, failure: str) -> CompiledEstimate:
    estimate = CompiledEstimate(*arguments)
    estimate.step_time, estimate.failure = step_time, failure
    return estimate
