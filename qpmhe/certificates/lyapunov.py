"""Weights, discount and horizon from a Lyapunov function of detectability, and what they bound."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, count, numbers
from ..costs import QuadraticCost
from ..errors import OptionError, SetError, ShapeError
from ..estimation.estimate import Status
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system
from ..observers import Observer
from .branch_and_bound import constant_output, output_lipschitz
from .contraction import _undetectable, certify_observer, constant_gain
from .deadline import DEFAULT_SECONDS, Deadline
from .dissipation import DesignSearch, Dissipation, growth, largest_norm
from .evidence import (
    CertificateError,
    Evidence,
    MismatchError,
    NotCertifiedError,
    json_ready,
    weakest,
)
from .inequalities import norms
from .properties import ObserverStability, fitting
from .regions import Region, bounded_region
from .sdp import started
from .theorem import Sizes
from .window_bounds import _slope, largest

Kind = Literal["minimiser", "measured", "decrease"]
KINDS: tuple[Kind, ...] = ("minimiser", "measured", "decrease")

_OUTWARD = 1.0 + 1e-9  # covers the rounding of sums, products and roots
_MOST = 10_000  # samples of a horizon
_ROOM = 1.1  # how far the proposed horizon's limit may be above the one of endless horizons
_DESIGN, _OBSERVER = 0.7, 0.9  # of the time left
_BROKEN = Status.MISSING | Status.MODEL_FAILED | Status.FAILED_STAGE  # J is another cost


@dataclass(frozen=True, eq=False)
class CandidateCost:
    """What bounds the cost of an observer's trajectory by its error at the window's start.

    Parameters
    ----------
    rate : float
        The contraction of the observer's error e, in the norm O.
    norm, gain : (n, n) and (n, p) array
        O and the gain K: |e+|_O <= rate |e|_O + |w|_O + |K v|_O.
    fit : (p, p) array
        M = K^T Q K + R, what a fitting error of the observer costs.
    slope : float
        The largest |h(x) - h(z)|_M / |x - z|_O.
    entry, exit : float
        From the design's norm to the observer's, and back.
    evidence : Evidence
        What it rests on.
    """

    rate: float
    norm: Array
    gain: Array
    fit: Array
    slope: float
    entry: float
    exit: float
    evidence: Evidence


@dataclass(frozen=True, eq=False)
class Design:
    r"""A discounted cost that fits a Lyapunov function of detectability, made by `design`.

    With the weights P, Q, R and the discount :math:`\gamma`, for states of the region,

    .. math::
        |f(x_1) + w_1 - f(x_2) - w_2|_P^2 \le \gamma |x_1 - x_2|_P^2 + |w_1 - w_2|_Q^2
        + |h(x_1) - h(x_2)|_R^2,

    whence, with the window's length K and the cost J of these weights, for the truth x with its
    disturbances and noises and for any trajectory :math:`\hat x` that fits the measurements,

    .. math::
        |\hat x(t) - x(t)|_P \le \sqrt{J(\hat x)} + \sqrt{J(x)} .

    What bounds :math:`J(\hat x)` is the ``kind``: ``minimiser``, it is no more than J(x);
    ``measured``, it is known; ``decrease``, it is no more than the candidate's. Only the last
    two hold for any number of QPs, and converged QPs do not prove the first. All bounds are of
    :math:`|\hat x - x|_P`; `components` has them in the states' units. They hold while truth,
    estimates and, for ``decrease``, the observer stay in the region.

    Parameters
    ----------
    system, region
        Of what, and where.
    form : Dissipation
        The inequality that was verified.
    discount : float
        gamma.
    amplitudes : (array, array)
        The largest disturbances and noises: a length, or one for each component.
    horizon : int
        The horizon given, or the least one whose limit is at most a tenth above the smallest.
    candidate : CandidateCost or None
        For the kind ``decrease``, and for candidates of the running observer.
    evidence : Evidence
        What the inequality rests on.
    notes : tuple of str
        What else there is to say.
    """

    system: System
    region: Region
    form: Dissipation
    discount: float
    amplitudes: tuple[Array, Array]
    horizon: int
    candidate: CandidateCost | None
    evidence: Evidence
    notes: tuple[str, ...] = ()

    @property
    def prior(self) -> Array:
        """P, the weight of the prior, (n, n)."""
        return self.form.P

    @property
    def disturbance(self) -> Array:
        """Q, the weight of the disturbance, (r, r)."""
        return self.form.Q

    @property
    def noise(self) -> Array:
        """R, the weight of the noise, (p, p)."""
        return self.form.R

    def cost(self) -> QuadraticCost:
        """The cost of the design, for an estimator with ``candidate="reinitialized"``."""
        return QuadraticCost(
            prior=self.prior, disturbance=self.disturbance, noise=self.noise,
            discount=self.discount,
        )

    def contraction(self, horizon: int | None = None, kind: Kind = "decrease") -> float:
        """The factor on the error over a window whose prior is an estimate.

        An `OptionError` is raised for ``decrease`` without an observer.
        """
        N = self.horizon if horizon is None else count("horizon", horizon, 1)
        own = math.sqrt(self.discount**N)
        if _checked(kind) != "decrease":
            return own if kind == "measured" else 2.0 * own
        part, lags = self._observer(), np.arange(N)
        decay = float(self.discount ** (N - 1.0 - lags) @ part.rate ** (2.0 * lags))
        return _OUTWARD * (own + part.slope * part.entry * math.sqrt(decay))

    def least_horizon(self, kind: Kind = "decrease") -> int:
        """The least N whose contraction is below 1."""
        return _first(lambda N: self.contraction(N, kind) < 1.0)

    def limit(
        self, horizon: int | None = None, kind: Kind = "decrease", candidate: str = "reinitialized",
    ) -> float:
        """What the bound tends to for the design's largest disturbances and noises.

        Infinite where the error of a re-initialised candidate does not contract. An `OptionError`
        is raised for ``measured``, and where an observer is needed and not there.
        """
        N = self.horizon if horizon is None else count("horizon", horizon, 1)
        if _checked(kind) == "measured":
            raise OptionError(
                "kind is 'measured', but nothing is measured yet; expected 'minimiser' or "
                "'decrease'."
            )
        signals = [np.full(N, value) for value in self._signals(None, None)]
        if not _restarts(candidate):
            part = self._observer()
            error = float(signals[2][0]) / (1.0 - part.rate)
            return self._step(kind, part.exit * error, *signals, observed=error)
        factor, first = self.contraction(N, kind), self._step(kind, 0.0, *signals)
        if factor >= 1.0 or first == 0.0:
            return 0.0 if first == 0.0 else math.inf
        from scipy.optimize import brentq

        # The step is convex in the bound, and grows by the contraction at most.
        most = first / (1.0 - factor) * _OUTWARD
        return _OUTWARD * float(brentq(
            lambda bound: self._step(kind, bound, *signals) - bound, 0.0, most, rtol=1e-12
        ))

    def components(self, bound: ArrayLike) -> Array:
        """Bounds of each component's error, (..., n), from bounds in the design's norm."""
        squares = np.diag(np.linalg.inv(self.prior))
        return np.multiply.outer(numbers("bound", bound, finite=False), np.sqrt(squares))

    def length(self, bound: ArrayLike) -> Array:
        """Bounds of the error's Euclidean length, from bounds in the design's norm."""
        least = float(np.linalg.eigvalsh(self.prior)[0])
        return numbers("bound", bound, finite=False) / math.sqrt(least)

    def along(
        self, run: Run, source: MovingHorizonEstimator, *, initial_error: ArrayLike,
        disturbances: ArrayLike | None = None, noises: ArrayLike | None = None,
        kind: Kind = "measured",
    ) -> Array:
        r"""The bound of :math:`|\hat x(t) - x(t)|_P` along a run at t = 0, ..., T, (T + 1,).

        NaN from where something broke it: a missing measurement, a failed model, or a projected
        observer where kind or candidate need the observer.

        Parameters
        ----------
        run : Run
            The run, with its costs and flags.
        source : MovingHorizonEstimator
            The estimator that made it, with the design's `cost`. Its horizon and candidate
            are those of the bound.
        initial_error : (n,) array_like or float
            x(0) minus the first guess, or a bound on its length.
        disturbances, noises : array_like, optional
            w(t) and v(t) as vectors (T, r) and (T, p), lengths (T,), or a number; the design's
            largest ones if left out.
        kind : {"measured", "minimiser", "decrease"}
            What bounds the estimate's cost.

        Raises
        ------
        MismatchError
            If the estimator has another system, cost, observer or arrival than the bound is of.
        ShapeError, OptionError
            If an argument does not fit.
        """
        self._check(kind, source)
        steps, N, restarts = len(run), source.horizon, _restarts(source.settings.candidate)
        start = numbers("initial_error", initial_error)
        if start.shape not in ((), (self.system.n,)):
            raise ShapeError(
                f"initial_error has shape {start.shape}; expected ({self.system.n},) or a number."
            )
        signals = [np.broadcast_to(each, (steps,)) for each in self._signals(
            _sized("disturbances", disturbances, steps, self.disturbance.shape[0]),
            _sized("noises", noises, steps, self.system.p),
        )]
        flags, spoilt = _BROKEN, np.zeros(steps, np.bool_)
        if kind == "decrease" or not restarts:
            flags |= Status.OBSERVER_PROJECTED
        for t in np.flatnonzero(run.flags & flags.value).tolist():
            spoilt[t : t + N if restarts else steps] = True
        bound, errors = np.full(steps + 1, math.nan), np.zeros(steps + 1)  # of the running observer
        bound[0] = float(norms(start[None], self.prior)[0]) * _OUTWARD
        if not restarts:
            part = self._observer()
            errors[0] = float(norms(start[None], part.norm)[0]) * _OUTWARD
            for t in range(steps):
                errors[t + 1] = part.rate * errors[t] + signals[2][t]
        for t in (np.flatnonzero(~spoilt) + 1).tolist():
            first = max(t - N, 0)
            window, cost = [each[first:t] for each in signals], float(run.costs[t - 1])
            own, observed = float(bound[first]), None
            if not restarts:
                observed = float(errors[first])
                own = self._observer().exit * observed if first else own
            bound[t] = self._step(kind, own, *window, cost=cost, observed=observed)
        return bound

    def _step(
        self, kind: Kind, error: float, truth: Array, fit: Array, driving: Array, *,
        cost: float = math.nan, observed: float | None = None,
    ) -> float:
        """sqrt(J(estimate)) + sqrt(J(truth)) at a window's end, from the error of its prior.

        In the observer's norm, too, where it is not the error of an estimate.
        """
        ages = self.discount ** np.arange(len(truth) - 1.0, -1.0, -1.0)
        root = math.sqrt(self.discount ** len(truth) * error**2 + float(ages @ truth))
        if kind == "minimiser":
            return 2.0 * root * _OUTWARD
        if kind == "measured":
            return (root + math.sqrt(cost)) * _OUTWARD
        part = self._observer()
        errors = np.empty(len(truth))
        following = part.entry * error if observed is None else observed
        for k, enters in enumerate(driving):
            errors[k], following = following, part.rate * following + enters
        costs = np.square(part.slope * errors + fit)
        return (root + math.sqrt(float(ages @ costs))) * _OUTWARD

    def _signals(self, w: Array | None, v: Array | None) -> tuple[Array, Array, Array]:
        """The truth's stage costs, its noises in the candidate's fit, what drives the observer.

        Of vectors or lengths at each time, or of the largest ones.
        """

        def size(values: Array | None, weight: Array, which: int) -> Array:
            if values is None:
                return np.array(largest_norm(weight, self.amplitudes[which]))
            return norms(values, weight)

        truth = size(w, self.disturbance, 0) ** 2 + size(v, self.noise, 1) ** 2
        part, none = self.candidate, np.zeros_like(truth)
        if part is None:
            return truth, none, none
        corrected = size(v, part.gain.T @ part.norm @ part.gain, 1)
        return truth, none + size(v, part.fit, 1), none + size(w, part.norm, 0) + corrected

    def _observer(self) -> CandidateCost:
        if self.candidate is None:
            raise OptionError(
                "the design has no observer whose error contracts, which this bound needs; pass "
                "one with a constant gain that certify_observer accepts: design(..., observer=...)."
            )
        return self.candidate

    def _check(self, kind: str, source: MovingHorizonEstimator) -> None:
        """Raise a `MismatchError` unless the bound is of this estimator."""
        cost, settings = source.cost, source.settings
        if source.system is not self.system:
            raise MismatchError("the estimator is of another system; design for its own.")
        same = isinstance(cost, QuadraticCost) and cost.discount == self.discount and all(
            np.array_equal(getattr(cost, name), getattr(self, name))
            for name in ("prior", "disturbance", "noise")
        )
        if not same or source.has_changed or settings.arrival != "observer":
            raise MismatchError(
                "the estimator has other weights, another discount, or arrival='smoothed'; make it "
                "with cost=design.cost() and leave arrival out."
            )
        if _checked(kind) == "decrease" or not _restarts(settings.candidate):
            gain = constant_gain(source.observer, self.system)
            if not np.array_equal(gain, self._observer().gain):
                raise MismatchError(
                    f"the estimator's observer has the gain {gain.tolist()}, which is not the "
                    "design's; pass it to design(..., observer=...)."
                )

    def code(self) -> str:
        """Python that makes the cost, ready to be pasted."""

        def text(matrix: Array) -> str:
            return "[" + ", ".join(
                "[" + ", ".join(f"{value:.8g}" for value in row) + "]" for row in matrix
            ) + "]"

        return (
            "cost = qpmhe.QuadraticCost(\n"
            f"    prior={text(self.prior)},\n    disturbance={text(self.disturbance)},\n"
            f"    noise={text(self.noise)},\n    discount={self.discount!r},\n)\n"
            f"horizon = {self.horizon}\n"
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows; infinite numbers become None."""
        kinds: tuple[Kind, ...] = KINDS if self.candidate is not None else KINDS[:2]
        found: dict[str, Any] = {
            "prior": self.prior, "disturbance": self.disturbance, "noise": self.noise,
            "discount": self.discount, "horizon": self.horizon, "region": self.region.to_dict(),
            "amplitudes": list(self.amplitudes), "evidence": self.evidence.value,
            "notes": self.notes,
            "contraction": {kind: self.contraction(kind=kind) for kind in kinds},
            "least_horizon": {kind: self.least_horizon(kind) for kind in kinds},
            "limit": {
                kind: self.components(self.limit(kind=kind)) for kind in kinds if kind != "measured"
            },
        }
        if self.candidate is not None:
            found["observer"] = vars(self.candidate) | {"evidence": str(self.candidate.evidence)}
        content: dict[str, Any] = json_ready(found)
        return content


def _restarts(candidate: str) -> bool:
    if candidate not in ("reinitialized", "observer"):
        raise OptionError(f"candidate is {candidate!r}; expected 'reinitialized' or 'observer'.")
    return candidate == "reinitialized"


def _checked(kind: str) -> str:
    if kind not in KINDS:
        raise OptionError(f"kind is {kind!r}; expected one of {list(KINDS)}.")
    return kind


def _first(wanted: Callable[[int], bool]) -> int:
    """The least horizon for which something holds, or the longest one."""
    return next((N for N in range(1, _MOST) if wanted(N)), _MOST)


def _sized(name: str, values: ArrayLike | None, steps: int, width: int) -> Array | None:
    """Vectors or lengths at each sample; None where none are given."""
    if values is None:
        return None
    found = numbers(name, values)
    if found.shape not in ((), (steps,), (steps, width)):
        raise ShapeError(
            f"{name} has shape {found.shape}; expected ({steps}, {width}), lengths ({steps},), "
            "or a number."
        )
    return found if found.ndim else np.full(steps, found)


def design(
    system: System, region: ConvexSet | Region | None = None, *, observer: Observer | None = None,
    inputs: Box | None = None, sizes: Sizes | None = None, horizon: int | None = None,
    discount: float | None = None, stability: ObserverStability | None = None,
    seconds: float | Deadline = DEFAULT_SECONDS,
) -> Design:
    """Find weights, discount and horizon for which the discounted cost bounds the error.

    Parameters
    ----------
    system, region, inputs
        As for `certify`.
    observer : Observer, optional
        The candidate's, with a constant gain: for bounds that hold with any number of QPs
        before anything is measured. If its error is not shown to contract, the notes say so.
    sizes : Sizes, optional
        Largest disturbances and noises, for which the limit is to be small; the boxes W and V
        of the system if left out.
    horizon : int, optional
        N, for which the limit is to be small; proposed if left out.
    discount : float, optional
        gamma in (0, 1); left out, the one with the smallest limit of a minimiser's error.
    stability : ObserverStability, optional
        Of the observer, as from `certify_observer`, to spare the search.
    seconds : float or Deadline
        How long this may take, about, from when the solvers are loaded.

    Raises
    ------
    SetError, OptionError, ShapeError, ModelError
        If an argument does not fit, or there are no sizes.
    NotCertifiedError
        If the system is not shown detectable with a Lyapunov function of this kind.
    """
    checked_system(system)
    place, amplitudes = bounded_region(system, region, inputs), _amplitudes(system, sizes)
    if horizon is not None:
        count("horizon", horizon, 1)
    if discount is not None and not 0.0 < discount < 1.0:
        raise OptionError(f"discount is {discount!r}; expected a number in (0, 1).")
    deadline = started(seconds)
    search = DesignSearch(system, place, amplitudes, horizon, deadline.part(_DESIGN))
    rate = None if discount is None else math.sqrt(discount) * (1.0 - 1e-12)
    found = search.answer("the root of the discount", rate, (), _undetectable)
    form = found.form
    assert isinstance(form, Dissipation)
    gamma = discount if discount is not None else _short(form.rate**2)
    part: CandidateCost | None = None
    why: tuple[str, ...] = ()
    if observer is not None:
        try:
            part = _candidate_cost(system, place, form, observer, stability, deadline)
        except (CertificateError, NotCertifiedError) as error:
            why = (f"nothing holds in advance for any number of QPs: {error}",)
    proposed = _first(lambda N: growth(gamma, N) <= _ROOM**2 * growth(gamma, None))
    return Design(
        system, place, form, gamma, amplitudes, horizon or proposed, part, found.evidence,
        (*found.notes, *why),
    )


def _candidate_cost(
    system: System, region: Region, form: Dissipation, observer: Observer,
    stability: ObserverStability | None, deadline: Deadline,
) -> CandidateCost:
    """What bounds the observer's trajectory and its cost."""
    if system.disturbance_matrix is not None:
        raise CertificateError("its corrections need not lie in the system's disturbance_matrix")
    K = constant_gain(observer, system)
    if stability is None:
        stability = certify_observer(system, observer, region, seconds=deadline.part(_OBSERVER))
    stability = fitting(stability, system, region, K)
    O, P = stability.P, form.P  # noqa: E741
    if O is None:
        raise CertificateError("its constants are assumed, without a norm that contracts")
    lipschitz = output_lipschitz(system, region, seconds=deadline)
    fit = K.T @ form.Q @ K + form.R
    slope = _slope(fit, O, lipschitz.value, constant_output(system, region))
    entry, leaving = math.sqrt(largest(O, P)), math.sqrt(largest(P, O))
    return CandidateCost(
        stability.rho, O, K, fit, slope, entry, leaving,
        weakest((stability.evidence, lipschitz.evidence)),
    )


def _amplitudes(system: System, sizes: Sizes | None) -> tuple[Array, Array]:
    """The largest disturbances and noises: lengths, or one for each component."""
    if sizes is not None:
        return np.asarray(sizes.disturbance, np.float64), np.asarray(sizes.noise, np.float64)
    found = []
    for name, known in (("disturbances", system.disturbances), ("noises", system.noises)):
        size = np.full(1, np.inf) if known is None else np.maximum(-known.lower, known.upper)
        if not np.isfinite(size).all():
            raise SetError(
                f"it is not known how large the {name} may be: the system has no bounded set of "
                "them. Pass sizes=Sizes(disturbance=..., noise=...)."
            )
        found.append(np.asarray(size, np.float64))
    return found[0], found[1]


def _short(gamma: float) -> float:
    """A number a little above, with few digits; any discount above gamma will do."""
    for digits in (4, 6, 8, 10):
        short = math.ceil(gamma * 10.0**digits) / 10.0**digits
        if short < 1.0 and short >= gamma:
            return short
    return math.nextafter(gamma, 1.0)
