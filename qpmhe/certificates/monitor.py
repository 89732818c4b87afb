"""At run time: the observer's bound, and which of the theorem's hypotheses hold at each step."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, count, record
from ..errors import InvalidInputError, OptionError, ShapeError
from ..estimation.constraints import Constraints
from ..estimation.estimate import Estimate
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.limits import FEASIBLE
from ..estimation.run import Run
from ..model.system import System
from .certificate import BROKEN, OUTWARD, Certificate
from .evidence import MismatchError
from .observer_monitor import ObserverMonitor, Reading, sharper
from .signal_bounds import SignalBounds, Size

_RELATIVE = 1e-6
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)



@dataclass(frozen=True)
class Hypotheses:
    """Which hypotheses held at one step; each is checked anew from the estimate's numbers.

    Parameters
    ----------
    cost_decrease : bool
        (eq:estimator): the estimate costs no more than the candidate, and the stated costs are
        those of the trajectories (which is checked where the window is complete).
    complete : bool
        All measurements of the window are there, and the model could be evaluated.
    observer_candidate : bool
        (eq:warmstart): the candidate is the observer's trajectory, not a projection of it,
        and corrects by the certificate's gain, where that is constant.
    kappa : bool
        (eq:kappa): |L| <= kappa |v_z| all along the candidate.
    candidate_in_region, estimate_in_region : bool
        All states of the window but the newest, from which nothing is concluded yet, lie in
        the certified set, and so do the inputs.
    candidate_in_sets : bool
        Assumption ass:observer: the candidate's states, corrections and fitting errors are in
        X, W and V.
    feasible : bool
        (eq:constraints): the estimate's states, disturbances and noises are in X, W and V.
    """

    cost_decrease: bool
    complete: bool
    observer_candidate: bool
    kappa: bool
    candidate_in_region: bool
    estimate_in_region: bool
    candidate_in_sets: bool
    feasible: bool

    @property
    def held(self) -> bool:
        """Whether the certificate's bound follows at this step, if it did at those before.

        The last two are no part of that: what is certified holds for any w and v.
        """
        return not self.failed

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of those that the bound needs and that did not hold."""
        return tuple(name for name in NEEDED if not getattr(self, name))


#: The hypotheses that are only reported, and those that the bound needs.
UNNEEDED = ("candidate_in_sets", "feasible")
NEEDED = tuple(each.name for each in fields(Hypotheses) if each.name not in UNNEEDED)


@dataclass(frozen=True)
class MonitorSummary:
    """For how many steps of a run the certificate applied.

    Parameters
    ----------
    steps : int
        Steps of the run.
    applied : int
        Steps from the first on, until the first at which a needed hypothesis did not hold:
        the observer's bound goes back to the start, and is lost with it.
    held : int
        Steps at which all needed hypotheses held, whatever had happened before.
    missed : dict of str to int
        At how many steps each hypothesis did not hold.
    first_failure, failed : int or None, and tuple of str
        The first step at which hypotheses failed, and which.
    observer : str
        How long the observer's bound held, and what ended it; empty if it was not followed.
    barred : str
        Why the theorem does not apply at all; empty if it may.
    """

    steps: int
    applied: int
    held: int
    missed: dict[str, int]
    first_failure: int | None
    failed: tuple[str, ...]
    observer: str = ""
    barred: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows."""
        content = vars(self) | {"failed": list(self.failed), "hypotheses": {
            name: {"needed": name in NEEDED, "failed": count, "held": self.steps - count}
            for name, count in self.missed.items()
        }}
        del content["missed"]
        return content

    def __str__(self) -> str:
        before = f"{self.observer} " if self.observer else ""
        if self.barred:
            return f"{before}The theorem does not apply: {self.barred}".strip()
        text = f"{before}The certificate applied at {self.applied} of {self.steps} steps"
        either = ""
        if self.first_failure is not None:
            reasons = ", ".join(self.failed).replace("_", " ")
            text += (
                f": at step {self.first_failure} it was lost ({reasons} did not hold). All "
                f"hypotheses that the bound needs held at {self.held} steps"
            )
            either = " either"
        return (
            f"{text}.{self._missed('Not held', NEEDED)}"
            f"{self._missed(f'Not held{either}, but the bound needs no sets', UNNEEDED)}"
        )

    def _missed(self, what: str, names: tuple[str, ...]) -> str:
        """A sentence about the hypotheses that did not hold at all steps; empty without any."""
        text = ", ".join(
            f"{name.replace('_', ' ')} at {count} step{'s' if count > 1 else ''}"
            for name in names if (count := self.missed[name])
        )
        return f" {what}: {text}." if text else ""


class Monitor:
    """Checks a run's estimates, one after another from the first.

    Parameters
    ----------
    certificate : Certificate
        Of the estimator's system, observer and cost.
    horizon : int
        The estimator's; an `OptionError` is raised if the certificate has bounds, but not for it.
    observer : ObserverMonitor, optional
        Follows the observer's bound, for `bound`.
    barred : str
        Why the theorem does not apply to the estimator, if it does not.
    """

    def __init__(
        self, certificate: Certificate, horizon: int, observer: ObserverMonitor | None = None,
        barred: str = "",
    ) -> None:
        self.horizon = count("horizon", horizon, 1)
        if certificate.bounds and not barred:
            certificate.of(self.horizon)
        elif not barred:
            barred = "; ".join(certificate.failures)
        self.certificate, self.observer = certificate, observer
        self._barred = barred
        self._inputs: deque[Array] = deque(maxlen=horizon)
        self._checks: list[Hypotheses] = []
        self._radii: deque[float] = deque(maxlen=horizon + 1)
        self._reading: Reading | None = None
        if observer is not None:
            self._radii.append(observer.radius)

    @classmethod
    def of(
        cls, certificate: Certificate, estimator: MovingHorizonEstimator, *,
        initial_error: Size | None = None, sizes: SignalBounds | None = None,
    ) -> Monitor:
        """A monitor for this estimator, before its first measurement.

        Parameters
        ----------
        certificate, estimator
            What is monitored.
        initial_error, sizes : optional
            What bounds x_0 - z_0, with which the monitor follows the observer's bound, and what
            bounds w and v, see `ObserverMonitor`.

        Raises
        ------
        MismatchError
            If the certificate is not of its system, observer and cost.
        InvalidInputError
            If the estimator has taken measurements already.
        OptionError
            If it has no bounds for its horizon, or there is no bound of the observer and the
            theorem does not cover the estimator's options.
        """
        certificate.check_estimator(estimator)
        if estimator.time:
            raise InvalidInputError(
                f"the estimator has taken {estimator.time} measurements; reset it first: the "
                "certificate's bound starts with the first one."
            )
        barred = _barred(estimator)
        proved, observer = certificate.observer_bound, None
        if barred and proved is None:
            raise OptionError(barred)
        if initial_error is not None and proved is not None:
            observer = ObserverMonitor(
                proved, estimator, initial_error=initial_error, sizes=sizes
            )
        return cls(certificate, estimator.horizon, observer, barred)

    @property
    def bound(self) -> Reading | None:
        """What is known of the true state after the last check; None if nothing is followed.

        The observer's bound or, where that is less, the one with the measured cost.
        """
        return self._reading

    def check(
        self, estimate: Estimate, u: ArrayLike | None = None, *, dt: float | None = None
    ) -> Hypotheses:
        """Check the estimate that `MovingHorizonEstimator.update` returned for the next input u.

        With ``dt``, if the step had a length of its own. A monitor that follows the observer's
        bound also takes the estimates of `amend` and `set`, and says what became of the bound.

        Raises
        ------
        MismatchError
            If it is not the next estimate, or its window does not fit the horizon.
        ShapeError
            If the input does not fit.
        """
        t, m = len(self._checks), self.certificate.system.m
        given = np.zeros(0) if u is None else np.atleast_1d(np.asarray(u, np.float64))
        if given.shape != (m,):
            raise ShapeError(f"u has shape {given.shape}; expected ({m},).")
        again = self.observer is not None and estimate.time == t - 1
        if estimate.time != t and not again:
            text = (
                f"the estimate is of the time {estimate.time}; expected {t}: a monitor sees all "
                "estimates of a run, from the first one on."
            )
            if self.observer is None:
                raise MismatchError(text)
            self._barred = text
        stages, expected = estimate.trajectory.shape[0] - 1, min(estimate.time + 1, self.horizon)
        if stages != expected:
            raise MismatchError(
                f"the estimate's window has {stages} stages at time {t}; expected {expected}, for "
                f"the horizon {self.horizon}. Make the monitor for the estimator's horizon."
            )
        if again:
            self._checks.pop()
            self._barred = self._barred or "a sample was estimated again (amend or set)"
        else:
            self._inputs.append(given)
        inputs = np.array(self._inputs)[-stages:] if len(self._inputs) >= stages else None
        self._checks.append(monitor(self.certificate, estimate, inputs))
        if self.observer is not None:
            reading = self.observer.check(estimate, None if again else given, dt=dt)
            if not again:
                self._radii.append(reading.radius)
            self._reading = sharper(reading, self._measured(estimate, stages))
        return self._checks[-1]

    def _measured(self, estimate: Estimate, stages: int) -> float:
        """The bound with the estimate's own cost, from the observer's bound N samples ago."""
        if not self.applies or self.certificate.kinds[-2:] != ("weighted", "measured"):
            return math.inf
        assert self.observer is not None
        from scipy.linalg import eigh

        window = self.certificate.of(self.horizon).beyond("measured")
        weights = window.norms
        # The initial error that counts most in detectability's norm.
        start = eigh(weights.window, weights.observer)[1][:, -1] * self._radii[-1 - stages]
        w, v = (np.full(stages, size) for size in self.observer.sizes.largest)
        costs = np.append(np.full(stages - 1, np.inf), estimate.cost)
        return OUTWARD * float(window.bound(start, w, v, costs)[-1])

    @property
    def applies(self) -> bool:
        """Whether the bound follows at the last step: all needed hypotheses held so far."""
        return not self._barred and all(check.held for check in self._checks)

    def summary(self) -> MonitorSummary:
        """For how many of the steps so far the certificate applied."""
        checks = self._checks
        held = [check.held for check in checks]
        first = held.index(False) if False in held else None
        return MonitorSummary(
            len(held), len(held) if first is None else first, sum(held),
            {
                name: sum(not getattr(check, name) for check in checks)
                for name in (*NEEDED, *UNNEEDED)
            },
            first, () if first is None else checks[first].failed, self._of_observer(),
            self._barred,
        )

    def _of_observer(self) -> str:
        """How long the observer's bound held."""
        if self.observer is None:
            return ""
        if self.observer.lost is None:
            return f"The observer's bound held at all {len(self._checks)} samples."
        return (
            f"The observer's bound held up to sample {self.observer.lost}: there "
            f"{self.observer.reason}."
        )


def _barred(estimator: MovingHorizonEstimator) -> str:
    """Why the theorem does not cover an estimator's options; empty if it does."""
    if estimator.settings.candidate != "observer":
        return (
            "the estimator's candidate comes from a reinitialized observer, which the theorem "
            "does not cover; make it with candidate='observer'."
        )
    if estimator.settings.arrival != "observer":
        return (
            "the estimator's prior is a smoothed estimate, which the theorem does not cover; "
            "make it with arrival='observer'."
        )
    if estimator.system.held:
        return (
            "the estimator holds parameters, a term of J that the theorem does not cover; make its "
            "system without hold."
        )
    if estimator.has_changed or estimator.settings.parameters:
        return (
            "the estimator has parameters, or its weights or bounds were changed by set(...); "
            "the theorem is about what stays: make the estimator with constant ones."
        )
    return ""


def monitor(
    certificate: Certificate, estimate: Estimate, inputs: ArrayLike | None = None
) -> Hypotheses:
    """Which hypotheses held at one step.

    Parameters
    ----------
    certificate : Certificate
        Of the estimator's system, observer and cost.
    estimate : Estimate
        What the step returned.
    inputs : (K, m) array_like, optional
        The inputs of the window's K samples, for a system with inputs; a `ShapeError` is raised
        if they do not fit.
    """
    system, region = certificate.system, certificate.region
    stages = estimate.trajectory.shape[0] - 1
    u = np.zeros((stages, 0)) if inputs is None else record("inputs", inputs, system.m)[-stages:]
    if u.shape != (stages, system.m):
        raise ShapeError(
            f"inputs has shape {u.shape}; expected ({stages}, {system.m}), those of the window."
        )
    with np.errstate(all="ignore"):
        w, outputs = _along(system, estimate.trajectory, u)
        y = outputs + estimate.noises
        corrections, candidate_outputs = _along(system, estimate.candidate, u)
        fit = y - candidate_outputs
        complete = not estimate.status & BROKEN and bool(
            np.isfinite(w).all() and np.isfinite(y).all() and np.isfinite(fit).all()
        )
        # What is missing is reported as that alone: the observer takes it for a fit.
        known = np.nan_to_num(fit, nan=0.0)
        kappa = math.inf if certificate.stability is None else certificate.stability.kappa
        allowed = kappa * np.linalg.norm(known, axis=1) * (1.0 + _RELATIVE)
        rounding = 1e-12 * np.abs(estimate.candidate).max(axis=0)
        bounded = bool(
            (np.linalg.norm(corrections, axis=1) <= allowed + np.linalg.norm(rounding)).all()
        )
        gain = certificate.gain
        observed = gain is None or not complete or bool(
            (np.abs(corrections - known @ gain.T)
             <= rounding + _RELATIVE * (np.abs(known) @ np.abs(gain).T)).all()
        )
        cheaper = estimate.cost <= estimate.candidate_cost and (
            not complete
            or (_costs(certificate, estimate.trajectory, estimate, w, estimate.noises, y,
                       estimate.cost)
            and _costs(certificate, estimate.candidate, estimate, corrections, fit, y,
                       estimate.candidate_cost))
        )
    low, high = region.lower[region.n :], region.upper[region.n :]
    usual = bool(((u >= low) & (u <= high)).all())
    return Hypotheses(
        cost_decrease=cheaper, complete=complete,
        observer_candidate=observed, kappa=bounded,
        candidate_in_region=usual and bool(region.contains(estimate.candidate[:-1]).all()),
        estimate_in_region=usual and bool(region.contains(estimate.trajectory[:-1]).all()),
        candidate_in_sets=_in_sets(certificate, estimate.candidate, corrections, fit, y),
        feasible=_in_sets(certificate, estimate.trajectory, w, estimate.noises, y),
    )


def monitored_run(
    certificate: Certificate, estimator: MovingHorizonEstimator, measurements: ArrayLike,
    inputs: ArrayLike | None = None, *, initial_error: Size | None = None,
) -> tuple[Run, MonitorSummary]:
    """Run an estimator over a record, and count for how many steps the certificate applied.

    Parameters
    ----------
    certificate : Certificate
        Of the estimator's system, observer and cost.
    estimator : MovingHorizonEstimator
        Before its first measurement.
    measurements, inputs
        As for `MovingHorizonEstimator.run`, which returns the same run.
    initial_error : optional
        What bounds x_0 - z_0, to follow the observer's bound as well.
    """
    watch = Monitor.of(certificate, estimator, initial_error=initial_error)
    ys = record("measurements", measurements, estimator.system.p)
    us = None if inputs is None else record("inputs", inputs, estimator.system.m)
    if us is not None and len(us) != len(ys):
        raise ShapeError(f"inputs has {len(us)} samples; expected {len(ys)}.")
    start, estimates = estimator.state.copy(), []
    observer_start = estimator.observer_state
    for t, y in enumerate(ys):
        u = None if us is None else us[t]
        estimates.append(estimator.update(y, u))
        watch.check(estimates[-1], u)
    return Run.of(start, estimates, observer_start=observer_start), watch.summary()


def _along(system: System, states: Array, u: Array) -> tuple[Array, Array]:
    """Disturbances and outputs along a trajectory, NaN where the model fails."""
    w, h = np.full((len(u), system.n), np.nan), np.full((len(u), system.p), np.nan)
    for i, (x, ahead) in enumerate(pairwise(states)):
        try:
            w[i], h[i] = ahead - system.f(x, u[i]), system.h(x, u[i])
        except Exception:  # a model that is not defined here: the hypothesis does not hold
            continue
    return w, h


def _costs(
    certificate: Certificate, states: Array, estimate: Estimate, w: Array, v: Array, y: Array,
    stated: float,
) -> bool:
    """Whether a trajectory has the stated cost, or no less where the prior's weight varies."""
    cost, offset = certificate.cost, states[0] - estimate.candidate[0]
    total = float(np.sum(cost.stage_costs(np.hstack((w, v)), cost.stage_weight)))
    total += cost.prior_cost(offset, cost.least_prior)
    # Residuals are differences of numbers of these sizes.
    sizes = np.hstack((np.abs(states[1:]) + np.abs(w), np.abs(y) + np.abs(v)))
    each = np.diag(cost.stage_weight.diagonal())
    rounding = float(np.sum(cost.stage_costs(_ROUNDING * sizes, each)))
    missed = abs(total - stated) if cost.observer_prior is None else total - stated
    return bool(missed <= _RELATIVE * abs(stated) + rounding / _RELATIVE)


def _in_sets(certificate: Certificate, states: Array, w: Array, v: Array, y: Array) -> bool:
    """Whether a trajectory is in X, W and V as the estimator itself judges it."""
    cost, covariance = certificate.cost, certificate.observer.initial_covariance()
    deviations = cost.prior_deviations(covariance)
    sets = Constraints(certificate.system, cost, np.diag(deviations**2))
    return sets.violation(states, np.hstack((w, v)), y) <= 2.0 * FEASIBLE
