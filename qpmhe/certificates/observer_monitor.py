"""At run time: the observer's bound beside each estimate, and the sample at which it ends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array
from ..errors import InvalidInputError, ShapeError
from ..estimation.estimate import Estimate, Status
from ..estimation.estimator import MovingHorizonEstimator
from ..model.system import System
from .bound_events import (
    CONTRADICTION,
    REINITIALIZED,
    event_of,
    input_beyond,
    outside,
    step_of,
)
from .evidence import MismatchError
from .observer_bound import ObserverBound, largest_ratio
from .signal_bounds import SignalBounds, Size

# What rounding may make of one step of the observer, as a share of what it sums up.
_ROUNDING = 1e-9

_MOVED = (
    "the observer's state before was changed, by a late measurement (amend), by set or by a "
    "sample's own bounds"
)
_OTHER_STEP = (
    "the observer's step was not f(z) + L v: it had another length (dt), other parameters or "
    "another gain"
)


@dataclass(frozen=True, eq=False)
class Reading:
    """What is known of the true state x(t+1) after a sample; NaN where nothing is.

    Attributes
    ----------
    time : int
        t, the index of the newest measurement.
    radius : float
        b(t+1), which bounds |x(t+1) - z(t+1)|_P.
    lower, upper : (n,) array
        Sides of a box that holds x(t+1): the set around the observer, within the region.
    error : float
        What |x(t+1) - x_hat(t+1)| is at most.
    kind : str
        What gives the last: ``observer``, or ``measured`` where the measured cost gives less.
    lost : int or None
        The sample after which the bound no longer holds.
    reason : str
        Why; empty while it holds.
    """

    time: int
    radius: float
    lower: Array
    upper: Array
    error: float
    kind: str = "observer"
    lost: int | None = None
    reason: str = ""


class ObserverMonitor:
    """Follows an observer from sample to sample with its bound.

    It needs no memory but the last state, and one evaluation of f and two of h a sample.

    Parameters
    ----------
    bound : ObserverBound
        Of the estimator's observer.
    estimator : MovingHorizonEstimator
        Where the bound begins: before its first measurement, or later.
    initial_error : float, (n,) array_like or set
        What bounds x - z there; see `ObserverBound.along`.
    sizes : SignalBounds, optional
        What bounds w and v at all times; the bound's own if left out.

    Raises
    ------
    ShapeError, OptionError, SetError, InvalidInputError
        If an argument does not fit.
    MismatchError
        If the bound is of another system or gain than the estimator's.

    Examples
    --------
    >>> import qpmhe
    >>> from qpmhe.certificates import ObserverMonitor, certify
    >>> system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1,
    ...                       states=qpmhe.Box([-9.0], [9.0]))
    >>> observer = qpmhe.Luenberger([0.3])
    >>> cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
    >>> certificate = certify(system, observer, cost, horizon=5)
    >>> mhe = qpmhe.MovingHorizonEstimator(
    ...     system, observer, cost, horizon=5, initial_state=[0.0])
    >>> watch = ObserverMonitor(certificate.observer_bound, mhe, initial_error=1.0)
    >>> reading = watch.check(mhe.update([1.0]))
    >>> bool(reading.lower[0] < reading.upper[0]), reading.lost
    (True, None)
    """

    def __init__(
        self, bound: ObserverBound, estimator: MovingHorizonEstimator, *, initial_error: Size,
        sizes: SignalBounds | None = None,
    ) -> None:
        if not isinstance(bound, ObserverBound):
            raise InvalidInputError(
                f"bound is of type {type(bound).__name__}; expected an ObserverBound, such as "
                "certificate.observer_bound."
            )
        bound.check_gain(estimator.observer, estimator.system)
        certified = bound.stability.system
        if certified is not None and certified is not estimator.system:
            raise MismatchError(
                "the bound is of another System object than the estimator's; certify the very "
                "objects that the estimator is made of."
            )
        chosen = bound.sizes if sizes is None else sizes
        entering = bound.entering(chosen.disturbances, chosen.noises)
        self.bound = bound.of_observer(estimator.observer)
        self._system: System = estimator.system
        self._entering = entering
        #: What bounds w and v.
        self.sizes = chosen
        self._time, self._z = estimator.time, estimator.observer_state
        self._radius = bound.initial(initial_error)
        self._lost: int | None = None
        self._reason = ""
        self._barred = REINITIALIZED if estimator.settings.candidate != "observer" else ""

    @property
    def radius(self) -> float:
        """b(t), NaN once the bound no longer holds."""
        return self._radius

    @property
    def lost(self) -> int | None:
        """The sample after which the bound no longer holds; None while it does."""
        return self._lost

    @property
    def reason(self) -> str:
        """Why it no longer holds; empty while it does."""
        return self._reason

    def check(
        self, estimate: Estimate, u: ArrayLike | None = None, *, dt: float | None = None
    ) -> Reading:
        """The bound after the estimate that an update, `amend` or `set` returned.

        Parameters
        ----------
        estimate : Estimate
            The next one.
        u : (m,) array_like, optional
            The system's input of the sample, parameters included.
        dt : float, optional
            Length of its step, if it had one of its own.
        """
        if not isinstance(estimate, Estimate):
            raise InvalidInputError(
                f"estimate is of type {type(estimate).__name__}; expected what "
                "MovingHorizonEstimator.update returns."
            )
        if self._lost is None:
            reason = self._barred or self._advance(estimate, u, dt)
            if reason:
                self._lost, self._reason, self._radius = estimate.time, reason, np.nan
        self._time, self._z = estimate.time + 1, estimate.observer_state.copy()
        lower, upper = self.bound.around(self._radius, self._z)
        error = self.bound.farthest(self._radius, estimate.state - self._z, self._z)
        return Reading(
            estimate.time, self._radius, lower, upper, float(error), lost=self._lost,
            reason=self._reason,
        )

    def _advance(self, estimate: Estimate, u: ArrayLike | None, dt: float | None) -> str:
        """Take b(t) to b(t+1); why it cannot be, or empty."""
        time, z = estimate.time, estimate.observer_state
        if time == self._time - 1:  # the same state, estimated again
            return "" if np.array_equal(z, self._z) else _MOVED
        if time < self._time:
            return "the estimator began again (reset, or a snapshot)"
        if time > self._time:
            return f"the samples from {self._time} to {time - 1} were not shown to the monitor"
        reason = self._fault(estimate, np.zeros(0) if u is None else np.ravel(u), dt)
        if reason:
            return reason
        self._radius = self.bound.advanced(self._radius, self._entering)
        return CONTRADICTION if self.bound.is_empty(np.array(self._radius), z) else ""

    def _fault(self, estimate: Estimate, u: Array, dt: float | None) -> str:
        """Why the inequality says nothing of this step, or empty."""
        bound, system, before = self.bound, self._system, self._z
        reason = event_of(estimate.status, bound.projects) or outside(bound.region, before)
        if reason:
            return reason
        if np.isnan(estimate.noises[-1]).any():
            return "not all outputs were sampled"
        if dt is not None and dt != system.dt:
            return step_of(dt, system.dt)
        if u.shape != (system.m,):
            raise ShapeError(f"u has shape {u.shape}; expected ({system.m},).")
        if reason := input_beyond(bound.region, u):
            return reason
        if not np.array_equal(estimate.candidate[-2], before):
            return _MOVED
        if Status.OBSERVER_PROJECTED in estimate.status:
            return ""
        try:
            output = system.h(before, u)
            error = estimate.noises[-1] + system.h(estimate.trajectory[-2], u) - output
            predicted, correction = system.f(before, u), bound.gain @ error
        except Exception:  # a model that is not defined here
            return "the model could not be evaluated"
        size = np.abs(predicted) + np.abs(correction) + np.abs(bound.gain) @ (
            np.abs(error) + np.abs(output)
        )
        missed = np.abs(estimate.observer_state - predicted - correction)
        return "" if (missed <= _ROUNDING * size).all() else _OTHER_STEP

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` restores, as plain numbers and arrays."""
        return {
            "time": self._time, "observer": self._z.copy(), "radius": self._radius,
            "lost": self._lost, "reason": self._reason, "metric": self.bound.metric.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another monitor of this observer stopped.

        It may have another P. An `InvalidInputError` is raised if it is not such a state.
        """
        try:
            z = np.array(state["observer"], np.float64).reshape(self._z.shape)
            time, radius = int(state["time"]), float(state["radius"])
            lost = None if state["lost"] is None else int(state["lost"])
            reason = str(state["reason"])
            metric = np.array(state["metric"], np.float64).reshape(self.bound.metric.shape)
            if not np.array_equal(metric, self.bound.metric):  # another search found another P
                radius *= largest_ratio(self.bound.metric, metric)
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInputError(
                f"the state is of no monitor of this observer: {error}."
            ) from error
        self._time, self._z, self._radius, self._lost, self._reason = time, z, radius, lost, reason


def sharper(reading: Reading, measured: float) -> Reading:
    """The reading with the measured bound where that is the smaller one."""
    if reading.lost is not None or not measured < reading.error:
        return reading
    return replace(reading, error=measured, kind="measured")
