"""At run time: what bounds the error beside each estimate, and the sample at which that ends."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import Array, record
from ..errors import InvalidInputError, OptionError, ShapeError
from ..estimation.estimate import Estimate, Status
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..model.system import System
from .certificate import Certificate
from .evidence import MismatchError
from .measured_cost import MeasuredCost
from .observer_bound import CONTRADICTION, REINITIALIZED, ObserverBound, largest_ratio
from .sizes import Size, Sizes

_RELATIVE = 1e-6
_UNITS = 8.0 * float(np.finfo(np.float64).eps)
# What rounding may make of one step of the observer, as a share of what it sums up.
_ROUNDING = 1e-9
#: A window without all its measurements has another cost.
_BROKEN = Status.MISSING | Status.MODEL_FAILED | Status.FAILED_STAGE
_MOVED = (
    "the observer's state before was changed, by a late measurement (amend), by set or by a "
    "sample's own bounds"
)


#: What the paper's bound needs at each sample, checked anew from the estimate's numbers. Whether
#: candidate and estimate are in X, W and V is no part of it: what is certified holds for any w, v.
HYPOTHESES = {
    "cost decrease": "(eq:estimator): the estimate costs no more than the candidate, and both "
    "costs are the trajectories' own",
    "complete": "all measurements of the window are there, and the model could be evaluated",
    "observer candidate": "(eq:warmstart): the candidate corrects by the certified gain, or was "
    "projected onto X in the certified metric",
    "kappa": "(eq:kappa): |L| <= kappa |v_z| where the candidate was not so projected",
    "candidate in region": "the candidate's states but the newest, and the inputs, are certified",
    "estimate in region": "the estimate's states but the newest, and the inputs, are certified",
}


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
    failed : tuple of str
        Which `HYPOTHESES` of the theorem did not hold, where a certificate is monitored.
    """

    time: int
    radius: float
    lower: Array
    upper: Array
    error: float
    kind: str = "observer"
    lost: int | None = None
    reason: str = ""
    failed: tuple[str, ...] = ()


class Monitor:
    """Follows an estimator from sample to sample, with what is proved of it.

    It takes one evaluation of f and two of h a sample; with the theorem's hypotheses, which it
    checks for a `Certificate`, some for each sample of the window.

    Parameters
    ----------
    certified : Certificate or ObserverBound
        Of the estimator's system, observer and cost; the bound of its observer is enough.
    estimator : MovingHorizonEstimator
        Where the bound begins: before its first measurement, or later for an `ObserverBound`.
    initial_error : float, (n,) array_like or set
        What bounds x - z there; see `ObserverBound.along`. Only for a certificate without a bound
        of the observer it may be left out.
    sizes : Sizes, optional
        What bounds w and v at all times; the bound's own if left out.

    Raises
    ------
    ShapeError, OptionError, SetError, InvalidInputError
        If an argument does not fit, or the certificate is not for this horizon.
    MismatchError
        If what is certified is of another system, gain or cost than the estimator's.

    Attributes
    ----------
    lost, reason : int or None, and str
        The sample after which the observer's bound no longer holds, and why.
    barred : str
        Why the theorem does not apply at all; empty if it may.
    steps, applied : int
        Samples seen, and those up to the first at which one of the `HYPOTHESES` did not hold.
    missed : dict of str to int
        At how many samples each did not.

    Examples
    --------
    >>> import qpmhe
    >>> from qpmhe.certificates import Monitor, certify
    >>> system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1,
    ...                       states=qpmhe.Box([-9.0], [9.0]))
    >>> observer = qpmhe.Luenberger([0.3])
    >>> cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
    >>> certificate = certify(system, observer, cost, horizon=5)
    >>> mhe = qpmhe.MovingHorizonEstimator(
    ...     system, observer, cost, horizon=5, initial_state=[0.0])
    >>> watch = Monitor(certificate, mhe, initial_error=1.0)
    >>> reading = watch.check(mhe.update([1.0]))
    >>> bool(reading.lower[0] < reading.upper[0]), reading.lost
    (True, None)
    """

    def __init__(
        self, certified: Certificate | ObserverBound, estimator: MovingHorizonEstimator, *,
        initial_error: Size | None = None, sizes: Sizes | None = None,
    ) -> None:
        certificate: Certificate | None = None
        if isinstance(certified, Certificate):
            certificate, bound = certified, certified.observer_bound
        elif isinstance(certified, ObserverBound):
            bound = certified
        else:
            raise InvalidInputError(
                f"certified is of type {type(certified).__name__}; expected a Certificate or an "
                "ObserverBound, such as certificate.observer_bound."
            )
        self._system: System = estimator.system
        self._horizon, self._certificate = estimator.horizon, certificate
        self._time, self._z = estimator.time, estimator.observer_state
        self.lost: int | None = None
        self.reason = ""
        self._ends = REINITIALIZED if estimator.settings.candidate != "observer" else ""
        self.bound: ObserverBound | None = None
        self._radius = math.nan
        if bound is not None:
            if initial_error is None:
                raise OptionError("initial_error is missing; expected what bounds x_0 - z_0.")
            own = bound.stability.system
            if own is not None and own is not estimator.system:
                raise MismatchError(
                    "the bound is of another System object than the estimator's; certify the very "
                    "objects that the estimator is made of."
                )
            self.bound = bound.of_observer(estimator.observer, estimator.system)
            self.sizes = chosen = bound.sizes if sizes is None else sizes
            self._entering = bound.entering(chosen.disturbance, chosen.noise)
            self._radius = bound.initial(initial_error)
        else:
            self.lost, self.reason = self._time, "there is no bound of the observer"
        self._radii = deque([self._radius], maxlen=estimator.horizon + 1)
        self.barred = ""
        self._measured: MeasuredCost | None = None
        self.steps, self.applied = 0, 0
        self.missed = dict.fromkeys(HYPOTHESES, 0)
        self._first: tuple[int, tuple[str, ...]] | None = None
        self._inputs: deque[Array] = deque(maxlen=estimator.horizon)
        self._projected: deque[bool] = deque(maxlen=estimator.horizon)
        if certificate is not None:
            self._begin(certificate, estimator)

    def _begin(self, certificate: Certificate, estimator: MovingHorizonEstimator) -> None:
        """What the theorem needs of the estimator."""
        certificate.check_estimator(estimator)
        if estimator.time:
            raise InvalidInputError(
                f"the estimator has taken {estimator.time} measurements; reset it first: the "
                "certificate's bound starts with the first one."
            )
        self.barred = _barred(estimator) or (
            "" if certificate.constants else "; ".join(certificate.failures)
        )
        if not self.barred:
            certificate.of(estimator.horizon)
        if self.barred and self.bound is None:
            raise OptionError(self.barred)
        detected, cost = certificate.detectability, certificate.cost
        if not self.barred and self.bound is not None and MeasuredCost.applies(detected, cost):
            assert detected is not None
            self._measured = MeasuredCost(detected, cost, self.bound, self.sizes)

    def check(
        self, estimate: Estimate, u: ArrayLike | None = None, *, dt: float | None = None
    ) -> Reading:
        """What is known after the estimate that an update, `amend` or `set` returned.

        Parameters
        ----------
        estimate : Estimate
            The next one.
        u : (m,) array_like, optional
            The system's input of the sample, parameters included.
        dt : float, optional
            Length of its step, if it had one of its own.

        Raises
        ------
        InvalidInputError, ShapeError
            If it is no estimate, or the input does not fit.
        MismatchError
            If its window does not fit the horizon.
        """
        if not isinstance(estimate, Estimate):
            raise InvalidInputError(
                f"estimate is of type {type(estimate).__name__}; expected what "
                "MovingHorizonEstimator.update returns."
            )
        given = np.zeros(0) if u is None else np.ravel(np.asarray(u, np.float64))
        again = estimate.time == self._time - 1
        if given.shape != (self._system.m,) and not again:
            raise ShapeError(f"u has shape {given.shape}; expected ({self._system.m},).")
        stages = estimate.trajectory.shape[0] - 1
        if self._certificate is not None and stages != min(estimate.time + 1, self._horizon):
            raise MismatchError(
                f"the estimate's window has {stages} stages at time {estimate.time}; expected "
                f"{min(estimate.time + 1, self._horizon)}, for the horizon {self._horizon}. Make "
                "the monitor for the estimator's horizon."
            )
        order = self._order(estimate.time)
        if self.lost is None:
            reason = self._ends or order
            if not reason and not again:
                reason = self._advance(estimate, given, dt)
            elif not reason and not np.array_equal(estimate.observer_state, self._z):
                reason = _MOVED
            if reason:
                self.lost, self.reason, self._radius = estimate.time, reason, math.nan
        if order or again:
            self.barred = self.barred or order or "a sample was estimated again (amend or set)"
        failed: tuple[str, ...] = ()
        if not again:
            self._inputs.append(given)
            self._radii.append(self._radius)
            self._projected.append(
                self.bound is not None and self.bound.projects
                and Status.OBSERVER_PROJECTED in estimate.status
            )
        if self._certificate is not None and not order:
            failed = self._failed(estimate, stages)
        self._time, self._z = estimate.time + 1, estimate.observer_state.copy()
        return self._reading(estimate, stages, failed)

    def _reading(self, estimate: Estimate, stages: int, failed: tuple[str, ...]) -> Reading:
        """The smaller one of the observer's bound and the one with the measured cost."""
        nothing = np.full(self._system.n, np.nan)
        lower, upper, error, kind = nothing, nothing, math.nan, "observer"
        if self.bound is not None:
            lower, upper = self.bound.around(self._radius, self._z)
            error = float(
                self.bound.farthest(self._radius, estimate.state - self._z, self._z)
            )
        if self._measured is not None and self.applies and self.lost is None:
            least = self._measured.error(self._radii[-1 - stages], stages, estimate.cost)
            if least < error:
                error, kind = least, "measured"
        return Reading(
            estimate.time, self._radius, lower, upper, error, kind, self.lost, self.reason, failed
        )

    def _order(self, time: int) -> str:
        """Why an estimate is not the next one; empty if it is, or is the same again."""
        if time in (self._time, self._time - 1):
            return ""
        if time < self._time:
            return "the estimator began again (reset, or a snapshot)"
        return f"the samples from {self._time} to {time - 1} were not shown to the monitor"

    def _advance(self, estimate: Estimate, u: Array, dt: float | None) -> str:
        """Take b(t) to b(t+1); why it cannot be, or empty."""
        bound, system, before, z = self.bound, self._system, self._z, estimate.observer_state
        assert bound is not None
        events = bound.events(
            np.array([estimate.status.value]), before[None], u[None],
            None if dt is None else [dt], system.dt,
        )
        if events:
            return events[0][1]
        if np.isnan(estimate.noises[-1]).any():
            return "not all outputs were sampled"
        if not np.array_equal(estimate.candidate[-2], before):
            return _MOVED
        if Status.OBSERVER_PROJECTED not in estimate.status:
            try:
                output = system.h(before, u)
                error = estimate.noises[-1] + system.h(estimate.trajectory[-2], u) - output
                predicted, correction = system.f(before, u), bound.gain @ error
            except Exception:  # a model that is not defined here
                return "the model could not be evaluated"
            size = np.abs(predicted) + np.abs(correction) + np.abs(bound.gain) @ (
                np.abs(error) + np.abs(output)
            )
            if not (np.abs(z - predicted - correction) <= _ROUNDING * size).all():
                return (
                    "the observer's step was not f(z) + L v: it had another length (dt), other "
                    "parameters or another gain"
                )
        self._radius = bound.advanced(self._radius, self._entering)
        return CONTRADICTION if bound.is_empty(np.array(self._radius), z) else ""

    def _failed(self, estimate: Estimate, stages: int) -> tuple[str, ...]:
        """The hypotheses that did not hold, counted."""
        assert self._certificate is not None
        failed = failed_hypotheses(
            self._certificate, estimate, np.array(self._inputs)[-stages:],
            np.array(self._projected)[-stages:],
        )
        if estimate.time >= self.steps:
            self.steps = estimate.time + 1
            for name in failed:
                self.missed[name] += 1
        if failed and self._first is None:
            self._first = estimate.time, failed
        self.applied = self.steps if self._first is None else self._first[0]
        return failed

    @property
    def applies(self) -> bool:
        """Whether the theorem's bound follows at the last sample: it goes back to the first one."""
        return not self.barred and self._first is None

    def summary(self) -> str:
        """How long the observer's bound held, and at how many samples the theorem's followed."""
        text = ""
        if self.bound is not None:
            text = f"The observer's bound held at all {self.steps} samples. "
            if self.lost is not None:
                text = f"The observer's bound held up to sample {self.lost}: there {self.reason}. "
        if self.barred:
            return f"{text}The theorem does not apply: {self.barred}".strip()
        text += f"The certificate applied at {self.applied} of {self.steps} samples"
        if self._first is not None:
            first = f"at sample {self._first[0]} it was lost ({', '.join(self._first[1])})"
            missed = ", ".join(f"{name} at {k}" for name, k in self.missed.items() if k)
            text += f": {first}. Not held: {missed}"
        return f"{text}."

    def to_dict(self) -> dict[str, Any]:
        """What the summary says, in types that JSON knows."""
        return {
            "steps": self.steps, "applied": self.applied, "barred": self.barred,
            "failed": [] if self._first is None else list(self._first[1]), "lost": self.lost,
            "reason": self.reason, "missed": self.missed, "hypotheses": HYPOTHESES,
        }

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` restores of the observer's bound, as plain numbers and arrays."""
        if self.bound is None or self._certificate is not None:
            raise InvalidInputError(
                "only a monitor of an ObserverBound has a state; pass certificate.observer_bound."
            )
        return {
            "time": self._time, "observer": self._z.copy(), "radius": self._radius,
            "lost": self.lost, "reason": self.reason, "metric": self.bound.metric.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another monitor of this observer stopped.

        It may have another P. An `InvalidInputError` is raised if it is not such a state.
        """
        mine = self.state_dict()["metric"]
        try:
            z = np.array(state["observer"], np.float64).reshape(self._z.shape)
            time, radius = int(state["time"]), float(state["radius"])
            lost = None if state["lost"] is None else int(state["lost"])
            reason = str(state["reason"])
            metric = np.array(state["metric"], np.float64).reshape(mine.shape)
            if not np.array_equal(metric, mine):  # another search found another P
                radius *= largest_ratio(mine, metric)
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInputError(
                f"the state is of no monitor of this observer: {error}."
            ) from error
        self._time, self._z, self._radius, self.lost, self.reason = time, z, radius, lost, reason


def _barred(estimator: MovingHorizonEstimator) -> str:
    """Why the theorem does not cover an estimator's options; empty if it does."""
    settings = estimator.settings
    return next((text for bars, text in (
        (settings.candidate != "observer",
         "the estimator's candidate comes from a reinitialized observer, which the theorem does "
         "not cover; make it with candidate='observer'."),
        (settings.arrival != "observer",
         "the estimator's prior is a smoothed estimate, which the theorem does not cover; make it "
         "with arrival='observer'."),
        (estimator.system.held,
         "the estimator holds parameters, a term of J that the theorem does not cover; make its "
         "system without hold."),
        (estimator.has_changed or settings.parameters,
         "the estimator has parameters, or its weights or bounds were changed by set(...); the "
         "theorem is about what stays: make the estimator with constant ones."),
    ) if bars), "")


def failed_hypotheses(
    certificate: Certificate, estimate: Estimate, inputs: ArrayLike | None = None,
    projected: ArrayLike | None = None,
) -> tuple[str, ...]:
    """Which of the `HYPOTHESES` did not hold at one sample.

    With the inputs (K, m) of the window's K samples, and at which of these the observer was
    projected onto X in the certified metric (K,). A `ShapeError` is raised if they do not fit.
    """
    system, region = certificate.system, certificate.region
    stages = estimate.trajectory.shape[0] - 1
    u = np.zeros((stages, 0)) if inputs is None else record("inputs", inputs, system.m)[-stages:]
    if u.shape != (stages, system.m):
        raise ShapeError(
            f"inputs has shape {u.shape}; expected ({stages}, {system.m}), those of the window."
        )
    moved: NDArray[np.bool_] = np.zeros(stages, np.bool_)
    if projected is not None:
        moved = np.asarray(projected, np.bool_)
    with np.errstate(all="ignore"):
        w, outputs = _along(system, estimate.trajectory, u)
        y = outputs + estimate.noises
        corrections, candidate_outputs = _along(system, estimate.candidate, u)
        fit = y - candidate_outputs
        complete = not estimate.status & _BROKEN and bool(
            np.isfinite(w).all() and np.isfinite(y).all() and np.isfinite(fit).all()
        )
        # What is missing is reported as that alone: the observer takes it for a fit.
        known = np.nan_to_num(fit, nan=0.0)
        kappa = math.inf if certificate.stability is None else certificate.stability.kappa
        allowed = kappa * np.linalg.norm(known, axis=1) * (1.0 + _RELATIVE)
        rounding = 1e-12 * np.abs(estimate.candidate).max(axis=0)
        sizes = np.linalg.norm(corrections, axis=1)
        gain, observed = certificate.gain, True
        if gain is not None and complete:
            missed = np.abs(corrections - known @ gain.T)
            right = missed <= rounding + _RELATIVE * (np.abs(known) @ np.abs(gain).T)
            observed = bool((right.all(axis=1) | moved).all())
        cheaper = estimate.cost <= estimate.candidate_cost and (not complete or all(
            _has_cost(certificate, estimate, x, w_, v, y, stated) for x, w_, v, stated in (
                (estimate.trajectory, w, estimate.noises, estimate.cost),
                (estimate.candidate, corrections, fit, estimate.candidate_cost),
            )
        ))
    low, high = region.lower[region.n :], region.upper[region.n :]
    usual = bool(((u >= low) & (u <= high)).all())
    held = (
        cheaper, complete, observed,
        bool((moved | (sizes <= allowed + np.linalg.norm(rounding))).all()),
        *(usual and bool(region.contains(x[:-1]).all())
          for x in (estimate.candidate, estimate.trajectory)),
    )
    return tuple(name for name, each in zip(HYPOTHESES, held, strict=True) if not each)


def monitored_run(
    certificate: Certificate, estimator: MovingHorizonEstimator, measurements: ArrayLike,
    inputs: ArrayLike | None = None, *, initial_error: Size | None = None,
) -> tuple[Run, Monitor]:
    """Run an estimator over a record beside a monitor; arguments as of both."""
    watch = Monitor(certificate, estimator, initial_error=initial_error)
    ys = record("measurements", measurements, estimator.system.p)
    us = [None] * len(ys) if inputs is None else record("inputs", inputs, estimator.system.m)
    if len(us) != len(ys):
        raise ShapeError(f"inputs has {len(us)} samples; expected {len(ys)}.")
    start, estimates = estimator.state.copy(), []
    observer_start = estimator.observer_state
    for y, u in zip(ys, us, strict=True):
        estimates.append(estimator.update(y, u))
        watch.check(estimates[-1], u)
    return Run.of(start, estimates, observer_start=observer_start), watch


def _along(system: System, states: Array, u: Array) -> tuple[Array, Array]:
    """Disturbances and outputs along a trajectory, NaN where the model fails."""
    w, h = np.full((len(u), system.n), np.nan), np.full((len(u), system.p), np.nan)
    for i, (x, ahead) in enumerate(pairwise(states)):
        try:
            w[i], h[i] = ahead - system.f(x, u[i]), system.h(x, u[i])
        except Exception:  # a model that is not defined here: the hypothesis does not hold
            continue
    return w, h


def _has_cost(
    certificate: Certificate, estimate: Estimate, states: Array, w: Array, v: Array, y: Array,
    stated: float,
) -> bool:
    """Whether a trajectory has the stated cost, or no less where the prior's weight varies."""
    cost, offset = certificate.cost, states[0] - estimate.candidate[0]
    total = float(np.sum(cost.stage_costs(np.hstack((w, v)), cost.stage_weight)))
    total += cost.prior_cost(offset, cost.least_prior)
    # Residuals are differences of numbers of these sizes.
    sizes = np.hstack((np.abs(states[1:]) + np.abs(w), np.abs(y) + np.abs(v)))
    each = np.diag(cost.stage_weight.diagonal())
    rounding = float(np.sum(cost.stage_costs(_UNITS * sizes, each)))
    missed = abs(total - stated) if cost.observer_prior is None else total - stated
    return bool(missed <= _RELATIVE * abs(stated) + rounding / _RELATIVE)
