"""Observers that start at each estimate of a window and run side by side."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..model.functions import BatchedFunction
from ..model.residuals import Residual
from ..observers import Sample
from ..observers.projection import NearestPoint

Array = NDArray[np.float64]


class RunningObservers:
    """N observers with a constant gain; one starts at each sample and runs for N samples.

    Each sample advances all of them by one call of f and one of h, always with N rows; the
    observer that starts at time s has row s mod N. So a row's numbers depend on its start and
    its samples alone: an observer that runs through the samples of a window a second time
    gives the same numbers.

    ``keep_inside(predicted, state, correction)`` projects one state and returns flags of `Status`.
    """

    def __init__(
        self, gain: Array, horizon: int, nearest: NearestPoint | None,
        keep_inside: Callable[[Array, Array, Array], int],
    ) -> None:
        n, p = gain.shape
        self._n, self._count, self._transposed_gain = n, horizon, gain.T.copy()
        self._keep_inside = keep_inside
        #: Projects onto X at the state to which the next call of `advance` leads.
        self.nearest = nearest
        # Rings in time: states z(t) and residuals (L(t), v(t)), one row for each observer.
        self._states = np.zeros((horizon + 1, horizon, n))
        self._residuals = np.zeros((horizon, horizon, n + p))
        self._predicted = np.zeros((horizon, n))
        self._events = [0] * horizon  # flags at the last sample
        #: Rows whose observer the model has failed, or that have no observer yet.
        self.failed = np.ones(horizon, np.bool_)

    def advance(self, time: int, start: Array, y: Array, sample: Sample) -> None:
        """Start an observer at the estimate of x(time), and advance all by the sample then."""
        n, count, failed, predicted = self._n, self._count, self.failed, self._predicted
        now, ahead = self._states[time % (count + 1)], self._states[(time + 1) % (count + 1)]
        residuals = self._residuals[time % count]
        correction, error = residuals[:, :n], residuals[:, n:]
        now[time % count], failed[time % count] = start, False
        if failed.any():
            now[failed] = start  # a state at which the model is likely to work
        self._evaluate(sample.system.h, now, sample.u, error)
        np.subtract(y, error, error)
        model = sample.system
        if model.output_residual is not None:
            self._wrap(model.output_residual, error, y)
        if sample.observed is not None:
            error[:, ~sample.observed] = 0.0
        self._evaluate(sample.system.f, now, sample.u, predicted)
        np.matmul(error, self._transposed_gain, correction)
        np.add(predicted, correction, ahead)
        if model.state_residual is not None:
            self._wrap(model.state_residual, correction, ahead)
            if model.turns is not None:
                ahead[...], predicted[...] = model.turns(ahead), model.turns(predicted)
        failed |= ~np.isfinite(np.einsum("ij,ij->i", ahead, ahead))  # its cost would overflow
        nearest = self.nearest
        if nearest is None:
            return
        self._events = [0] * count
        for i in np.flatnonzero(~(nearest.contains(ahead) | failed)):
            try:
                self._events[i] = self._keep_inside(predicted[i], ahead[i], correction[i])
            except Exception:  # of linear algebra
                failed[i] = True

    def _wrap(self, residual: Residual, differences: Array, minuends: Array) -> None:
        try:
            residual.wrap(differences, minuends)
        except Exception:  # a user's function
            self.failed[:] = True

    def _evaluate(self, function: BatchedFunction, states: Array, u: Array, values: Array) -> None:
        """Write a function's values at all states, and mark those at which it raises."""
        try:
            np.copyto(values, function.batch(states, np.broadcast_to(u, (self._count, u.size))))
        except Exception:
            # One by one, as a batch calls functions that raise at some states: same numbers.
            for i, state in enumerate(states):
                try:
                    np.copyto(values[i], function(state, u))
                except Exception:
                    self.failed[i] = True

    def trajectory(self, first: int, last: int) -> tuple[Array, Array, int]:
        """States, residuals and last flags of the observer that started at time ``first``."""
        times, row = np.arange(first, last + 1), first % self._count
        states = self._states[times % (self._count + 1), row]
        return states, self._residuals[times[:-1] % self._count, row], self._events[row]
