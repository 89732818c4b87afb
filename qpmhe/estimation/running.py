"""Observers that start at each estimate of a window and run side by side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.functions import BatchedFunction
from ..observers import Sample
from ..observers.projection import ErrorMetric, NearestPoint
from .estimate import Status

__all__ = ["RunningObservers", "keep_inside"]

Array = NDArray[np.float64]

_PROJECTED, _PREDICTION_OUTSIDE, _METRIC_SINGULAR = (
    Status.OBSERVER_PROJECTED.value, Status.PREDICTION_OUTSIDE.value, Status.METRIC_SINGULAR.value
)


def keep_inside(
    nearest: NearestPoint, covariance: Array, predicted: Array, state: Array, correction: Array
) -> int:
    """Project z(t+1) onto X, set its correction to match, and return flags of `Status`."""
    found, events = nearest(state, covariance), _PROJECTED
    if not nearest.contains(predicted):
        events |= _PREDICTION_OUTSIDE
        if found.reached and nearest.is_beyond(state, found.point, covariance):
            # Every point of X is nearer to the truth than the state is. That prediction says
            # nothing, but would drown the correction.
            inside = nearest(predicted, covariance).point
            found = nearest(inside + correction, covariance)
    state[...] = found.point
    np.subtract(state, predicted, correction)
    return events if found.reached else events | _METRIC_SINGULAR


class RunningObservers:
    """N observers with a constant gain, of which one starts at each sample and lasts N samples.

    Each sample advances all of them by one call of f and one of h, always with N rows; the
    observer that starts at time s has row s mod N. So a row's numbers depend on its start and
    its samples alone, and observers that are restarted from the samples of a window have
    the numbers of those that ran on.
    """

    #: Beyond this many numbers, N observers take too much memory.
    LARGEST = 2**23

    def __init__(
        self, gain: Array, horizon: int, nearest: NearestPoint | None, metric: ErrorMetric | None
    ) -> None:
        n, p = gain.shape
        self._n, self._count = n, horizon
        self._transposed_gain, self._nearest, self._metric = gain.T.copy(), nearest, metric
        # Rings in time: states z(t) and residuals (L(t), v(t)), one row for each observer.
        self._states = np.zeros((horizon + 1, horizon, n))
        self._residuals = np.zeros((horizon, horizon, n + p))
        self._predicted = np.zeros((horizon, n))
        self._failed = np.zeros(horizon, np.bool_)
        self._events = [0] * horizon  # flags of `Status` at the last sample

    def restart(self, time: int, state: Array) -> None:
        """Start all observers at one state."""
        self._states[time % (self._count + 1)] = state
        self._failed[:] = False

    def advance(self, time: int, start: Array, y: Array, sample: Sample) -> None:
        """Start an observer at the estimate of x(time), and advance all by the sample then."""
        n, count, failed = self._n, self._count, self._failed
        now, ahead = self._states[time % (count + 1)], self._states[(time + 1) % (count + 1)]
        residuals, predicted = self._residuals[time % count], self._predicted
        now[time % count] = start
        failed[time % count] = False
        if failed.any():
            now[failed] = start  # where the model works, if anywhere
        correction, error = residuals[:, :n], residuals[:, n:]
        _evaluate(sample.system.h, now, sample.u, error, failed)
        np.subtract(y, error, error)
        if sample.observed is not None:
            error[:, ~sample.observed] = 0.0
        _evaluate(sample.system.f, now, sample.u, predicted, failed)
        np.matmul(error, self._transposed_gain, correction)
        np.add(predicted, correction, ahead)
        # As |z|^2 overflows, so does the cost.
        finite = np.isfinite(np.einsum("ij,ij->i", ahead, ahead))
        if not finite.all():
            failed |= ~finite
        if self._nearest is not None:
            self._project(self._nearest, predicted, ahead, correction)

    def _project(
        self, nearest: NearestPoint, predicted: Array, ahead: Array, correction: Array
    ) -> None:
        metric, failed, self._events = self._metric, self._failed, [0] * self._count
        assert metric is not None
        for i in np.flatnonzero(~(nearest.inside(ahead) | failed)):
            try:
                self._events[i] = keep_inside(
                    nearest, metric.covariance, predicted[i], ahead[i], correction[i]
                )
            except np.linalg.LinAlgError:
                failed[i] = True

    def trajectory(self, first: int, last: int) -> tuple[Array, Array, int] | None:
        """States and residuals of the observer started at ``first``, up to the last sample.

        None if it failed. The third part are its flags at that sample.
        """
        row = first % self._count
        if self._failed[row]:
            return None
        times = np.arange(first, last + 1)
        states = self._states[times % (self._count + 1), row]
        return states, self._residuals[times[:-1] % self._count, row], self._events[row]


def _evaluate(
    function: BatchedFunction, states: Array, u: Array, values: Array, failed: NDArray[np.bool_]
) -> None:
    """Write a function's values at all states, and mark those at which it raises."""
    try:
        np.copyto(values, function.batch(states, np.broadcast_to(u, (len(states), u.size))))
    except Exception:
        # Functions that raise at some states are called one by one within a batch, too.
        for i, state in enumerate(states):
            try:
                np.copyto(values[i], function(state, u))
            except Exception:  # the model is not defined there
                failed[i] = True
