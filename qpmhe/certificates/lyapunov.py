r"""Weights, discount and horizon from a Lyapunov function of detectability, and what they bound.

`docs/explanation/lyapunov.md` derives every inequality.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
from .dissipation import DesignSearch, Dissipation, growth, largest_sizes
from .evidence import (
    CertificateError,
    Evidence,
    MismatchError,
    NotCertifiedError,
    json_ready,
    weakest,
)
from .inequalities import norms
from .observer_bound import Entering, ObserverBound
from .properties import ObserverStability, fitting
from .regions import Region, bounded_region
from .sdp import started
from .signal_bounds import SignalBounds, Size, lengths_of, read_size
from .theorem import Sizes
from .window_bounds import _slope, fit_weight, largest

Kind = Literal["minimiser", "measured", "decrease"]
KINDS: tuple[Kind, ...] = ("minimiser", "measured", "decrease")

_OUTWARD = 1.0 + 1e-9  # covers the rounding of sums, products and roots
_MOST = 10_000  # samples of a horizon
_ROOM = 1.1  # how far the proposed horizon's limit may be above the one of endless horizons
_DESIGN, _OBSERVER = 0.7, 0.9  # of the time left
_BROKEN = Status.MISSING | Status.MODEL_FAILED | Status.FAILED_STAGE  # J is another cost


@dataclass(frozen=True, eq=False)
class Design:
    r"""A discounted cost that fits a Lyapunov function of detectability, made by `design`.

    With the weights P, Q, R and the discount :math:`\gamma`, for any two states of the region,

    .. math::
        |f(x_1) + w_1 - f(x_2) - w_2|_P^2 \le \gamma |x_1 - x_2|_P^2 + |w_1 - w_2|_Q^2
        + |h(x_1) - h(x_2)|_R^2 .

    So for the truth x, any trajectory :math:`\hat x` that fits the window's measurements, and the
    cost J of these weights, :math:`|\hat x - x|_P \le \sqrt{J(\hat x)} + \sqrt{J(x)}` at the
    window's end. What bounds :math:`J(\hat x)` is the ``kind``:

    - ``minimiser``: it is at most J(x), as for a global minimiser. That the QPs have converged
      does not prove it.
    - ``measured``: it is known. For any number of QPs.
    - ``decrease``: it is at most the cost of the observer's trajectory. For any number of QPs.

    Bounds are of :math:`|\hat x - x|_P`; `components` has them in the states' units. They hold
    while truth, estimates and, for ``decrease``, observers stay in the region.

    Parameters
    ----------
    system, region
        Of what, and where.
    form : Dissipation
        The inequality that was verified.
    discount : float
        gamma.
    sizes : SignalBounds
        The largest disturbances and noises.
    horizon : int
        The horizon given, or the least one whose limit for a minimiser is at most a tenth above
        that of endless horizons.
    observer : ObserverBound or None
        For ``decrease``, and for candidates of the running observer.
    slope : float
        The largest |h(x) - h(z)|_M / |x - z|_O, with M = K^T Q K + R, the observer's gain K and
        its norm O.
    evidence : Evidence
        The weakest of what it rests on.
    notes : tuple of str
        What else there is to say.
    """

    system: System
    region: Region
    form: Dissipation
    discount: float
    sizes: SignalBounds
    horizon: int
    observer: ObserverBound | None
    slope: float
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

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of bounds at hand for a re-initialised candidate."""
        return KINDS if self.observer is not None else KINDS[:2]

    def cost(self) -> QuadraticCost:
        """The cost of the design, for an estimator with ``candidate="reinitialized"``."""
        return _cost(self.form, self.discount)

    @cached_property
    def _changes(self) -> tuple[float, float]:
        """From the design's norm to the observer's at most, and back."""
        O = self._observer().metric  # noqa: E741
        return _ratio(O, self.prior), _ratio(self.prior, O)

    def contraction(self, horizon: int | None = None, kind: Kind = "decrease") -> float:
        """The factor on the error over a window whose prior is an estimate.

        An `OptionError` is raised for ``decrease`` without an observer.
        """
        N = self.horizon if horizon is None else count("horizon", horizon, 1)
        own = math.sqrt(self.discount**N)
        if _checked(kind) != "decrease":
            return own if kind == "measured" else 2.0 * own
        lags = np.arange(N)
        decay = self.discount ** (N - 1.0 - lags) @ self._observer().rate ** (2.0 * lags)
        return _OUTWARD * (own + self.slope * self._changes[0] * math.sqrt(float(decay)))

    def least_horizon(self, kind: Kind = "decrease") -> int | None:
        """The least N whose contraction is below 1; None if there is none up to 10,000."""
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
        signals = self._signals(None, None, N)
        if not _restarts(candidate):
            error = self._observer().limit(self.sizes.disturbances, self.sizes.noises)
            return self._step(kind, self._changes[1] * error, *signals, observed=error)
        factor, first = self.contraction(N, kind), self._step(kind, 0.0, *signals)
        if factor >= 1.0 or first == 0.0:
            return 0.0 if first == 0.0 else math.inf
        from scipy.optimize import brentq

        # The step is convex in the bound, and grows by the contraction at most.
        most = first / (1.0 - factor) * _OUTWARD
        return _OUTWARD * float(brentq(
            lambda bound: self._step(kind, bound, *signals) - bound, 0.0, most, rtol=1e-12
        ))

    @cached_property
    def _slopes(self) -> Array:
        return np.array([_ratio(np.outer(e, e), self.prior) for e in np.eye(len(self.prior))])

    def components(self, bound: ArrayLike) -> Array:
        """Bounds of each component's error, (..., n), from bounds in the design's norm."""
        return np.multiply.outer(numbers("bound", bound, finite=False), self._slopes)

    def length(self, bound: ArrayLike) -> Array:
        """Bounds of the error's Euclidean length, from bounds in the design's norm."""
        return _ratio(np.eye(len(self.prior)), self.prior) * numbers("bound", bound, finite=False)

    def along(
        self, run: Run, source: MovingHorizonEstimator, *, initial_error: Size,
        disturbances: Size | None = None, noises: Size | None = None, kind: Kind = "measured",
    ) -> Array:
        r"""The bound of :math:`|\hat x(t) - x(t)|_P` along a run at t = 0, ..., T, (T + 1,).

        NaN where something in the window broke it: a missing measurement, a failed model, an input
        or step that is not certified, or a projected observer where kind or candidate need it as
        it is. A window after that starts from the region's size; the running observer's bounds do
        not come back.

        Parameters
        ----------
        run : Run
            The run, with its costs and flags.
        source : MovingHorizonEstimator
            The estimator that made it, with the design's `cost`. Its horizon and candidate
            are those of the bound.
        initial_error : (n,) array_like, float or set
            x(0) minus the first guess, a bound on its length, or a set that holds it.
        disturbances, noises : optional
            w(t) and v(t) as vectors (T, r) and (T, p), lengths (T,), or bounds for all times: a
            number for the length or a set, such as ``qpmhe.Box``. Left out, `sizes`.
        kind : {"measured", "minimiser", "decrease"}
            What bounds the estimate's cost.

        Raises
        ------
        MismatchError
            If the estimator has another system, cost, observer or arrival than the bound is of.
        ShapeError, OptionError, SetError
            If an argument does not fit.
        """
        self._check(kind, source)
        steps, N, restarts = len(run), source.horizon, _restarts(source.settings.candidate)
        signals = self._signals(disturbances, noises, steps)
        flags, spoilt = _BROKEN, np.zeros(steps, np.bool_)
        if kind == "decrease" or not restarts:
            flags |= Status.OBSERVER_PROJECTED
        unusual = (run.flags & flags.value).astype(np.bool_) | self._unusual(run)
        for t in np.flatnonzero(unusual).tolist():
            spoilt[t : t + N if restarts else steps] = True
        bound, errors = np.full(steps + 1, math.nan), np.zeros(steps + 1)
        width = (self.region.upper - self.region.lower)[: self.system.n]
        widest = float(lengths_of("the region", Box(-width, width), len(width), self.prior))
        bound[0] = self._initial(initial_error)
        if not restarts:
            errors = self._observer().radii(steps, initial_error, Entering(*signals[2:]))
        for t in (np.flatnonzero(~spoilt) + 1).tolist():
            first = max(t - N, 0)
            window, observed = [each[first:t] for each in signals], None
            own = float(np.fmin(bound[first], widest)) if first else float(bound[0])
            if not restarts:
                observed = float(errors[first])
                own = self._changes[1] * observed if first else own
            cost = float(run.costs[t - 1])
            bound[t] = self._step(kind, own, *window, cost=cost, observed=observed)
        return bound

    def _initial(self, error: Size) -> float:
        """The first bound."""
        given, n = read_size("initial_error", error), self.system.n
        if isinstance(given, ConvexSet):
            return float(lengths_of("initial_error", given, n, self.prior))
        if given.shape not in ((), (n,)):
            raise ShapeError(
                f"initial_error has shape {given.shape}; expected ({n},), a length, or a set."
            )
        return float(norms(given[None], self.prior)[0]) * _OUTWARD

    def _unusual(self, run: Run) -> NDArray[np.bool_]:
        """The samples with an input outside of the region, or a step of unusual length."""
        found, source, n = np.zeros(len(run), np.bool_), run.source, self.system.n
        if source is not None and source.inputs is not None:
            low, high = self.region.lower[n:], self.region.upper[n:]
            found |= ((source.inputs < low) | (source.inputs > high)).any(axis=1)
        if source is not None and source.steps is not None:
            found |= np.asarray(source.steps) != source.system.dt
        return found

    def _step(
        self, kind: Kind, error: float, truth: Array, fit: Array, length: Array, square: Array,
        *, cost: float = math.nan, observed: float | None = None,
    ) -> float:
        """sqrt(J(estimate)) + sqrt(J(truth)) at a window's end, from the error of its prior.

        In the observer's norm, too, where that is not the error of an estimate.
        """
        ages = self.discount ** np.arange(len(truth) - 1.0, -1.0, -1.0)
        root = math.sqrt(self.discount ** len(truth) * error**2 + float(ages @ truth))
        if kind == "minimiser":
            return 2.0 * root * _OUTWARD
        if kind == "measured":
            return (root + math.sqrt(cost)) * _OUTWARD
        following = self._changes[0] * error if observed is None else observed
        errors, observer = np.empty(len(truth)), self._observer()
        for k, each in enumerate(zip(length, square, strict=True)):
            errors[k], following = following, observer.advanced(following, Entering(*each))
        costs = np.square(self.slope * errors + fit)
        return (root + math.sqrt(float(ages @ costs))) * _OUTWARD

    def _signals(self, w: Size | None, v: Size | None, steps: int) -> list[Array]:
        """At each sample: the truth's cost, its noise in the candidate's, what drives the observer.

        The last two, what `Entering` has, are zero without an observer.
        """
        w = read_size("disturbances", self.sizes.disturbances if w is None else w)
        v = read_size("noises", self.sizes.noises if v is None else v)
        p, found = self.system.p, [np.zeros(())] * 4
        found[0] = (
            lengths_of("disturbances", w, len(self.disturbance), self.disturbance) ** 2
            + lengths_of("noises", v, p, self.noise) ** 2
        )
        if self.observer is not None:
            fit = fit_weight(self.cost(), self.observer.gain)
            found[1:] = lengths_of("noises", v, p, fit), *self.observer.entering(w, v)
        if any(each.shape not in ((), (steps,)) for each in found):
            raise ShapeError(
                f"disturbances or noises are not of {steps} samples, as the run is; expected "
                f"({steps}, {len(self.disturbance)}) and ({steps}, {p}), or lengths ({steps},)."
            )
        return [np.broadcast_to(each, (steps,)) for each in found]

    def _observer(self) -> ObserverBound:
        if self.observer is None:
            raise OptionError(
                "the design has no observer whose error contracts, which this bound needs; pass "
                "one with a constant gain that certify_observer accepts: design(..., observer=...)."
            )
        return self.observer

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
        """Python that makes the cost and says which horizon and candidate belong to it."""

        def text(matrix: Array) -> str:
            rows = (", ".join(f"{value:.8g}" for value in row) for row in matrix)
            return f"[{', '.join(f'[{row}]' for row in rows)}]"

        return (
            f"cost = qpmhe.QuadraticCost(\n    prior={text(self.prior)},\n"
            f"    disturbance={text(self.disturbance)},\n    noise={text(self.noise)},\n"
            f"    discount={self.discount!r},\n)\n"
            "mhe = qpmhe.MovingHorizonEstimator(\n"
            f'    system, observer, cost, horizon={self.horizon}, candidate="reinitialized",\n'
            "    initial_state=initial_state,\n)\n"
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows; infinite numbers become None."""
        content: dict[str, Any] = json_ready({
            "prior": self.prior, "disturbance": self.disturbance, "noise": self.noise,
            "discount": self.discount, "horizon": self.horizon, "region": self.region.to_dict(),
            "sizes": self.sizes.to_dict(), "evidence": self.evidence.value, "notes": self.notes,
            "contraction": {kind: self.contraction(kind=kind) for kind in self.kinds},
            "least_horizon": {kind: self.least_horizon(kind) for kind in self.kinds},
            "limit": {
                kind: self.components(self.limit(kind=kind))
                for kind in self.kinds if kind != "measured"
            },
        } | ({} if self.observer is None else {"observer": self.observer.to_dict()}))
        return content


def _cost(form: Dissipation, discount: float) -> QuadraticCost:
    return QuadraticCost(prior=form.P, disturbance=form.Q, noise=form.R, discount=discount)


def _ratio(one: Array, other: Array) -> float:
    """The largest |s|_one / |s|_other, rounded up, whatever the units of s."""
    units = 1.0 / np.sqrt(other.diagonal())
    scale = np.outer(units, units)
    return math.sqrt(largest(scale * one, scale * other)) * _OUTWARD


def _restarts(candidate: str) -> bool:
    if candidate not in ("reinitialized", "observer"):
        raise OptionError(f"candidate is {candidate!r}; expected 'reinitialized' or 'observer'.")
    return candidate == "reinitialized"


def _checked(kind: str) -> str:
    if kind not in KINDS:
        raise OptionError(f"kind is {kind!r}; expected one of {list(KINDS)}.")
    return kind


def _first(wanted: Callable[[int], bool]) -> int | None:
    """The least horizon for which something holds."""
    return next((N for N in range(1, _MOST + 1) if wanted(N)), None)


def design(
    system: System, region: ConvexSet | Region | None = None, *, observer: Observer | None = None,
    inputs: Box | None = None, sizes: SignalBounds | Sizes | None = None,
    horizon: int | None = None, discount: float | None = None,
    stability: ObserverStability | None = None, seconds: float | Deadline = DEFAULT_SECONDS,
) -> Design:
    """Find weights, discount and horizon for which the discounted cost bounds the error.

    Parameters
    ----------
    system, region, inputs
        As for `certify`.
    observer : Observer, optional
        The candidate's, with a constant gain: for what holds in advance with any number of QPs.
        If its error is not shown to contract, the notes say so.
    sizes : SignalBounds or Sizes, optional
        Largest disturbances and noises, for which the limit is to be small; W and V of the
        system if left out.
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
    place, known = bounded_region(system, region, inputs), _sizes(system, sizes)
    if horizon is not None:
        count("horizon", horizon, 1)
    if discount is not None and not 0.0 < discount < 1.0:
        raise OptionError(f"discount is {discount!r}; expected a number in (0, 1).")
    deadline = started(seconds)
    search = DesignSearch(system, place, known, horizon, deadline.part(_DESIGN))
    rate = None if discount is None else math.sqrt(discount) * (1.0 - 1e-12)
    found = search.answer("the root of the discount", rate, (), _undetectable)
    form = found.form
    assert isinstance(form, Dissipation)
    gamma = discount if discount is not None else _short(form.rate**2)
    proposed = _first(lambda N: growth(gamma, N) <= _ROOM**2 * growth(gamma, None))
    cost = _cost(form, gamma)
    bound, slope, evidence, notes = None, math.nan, found.evidence, found.notes
    if observer is not None:
        try:
            if system.disturbance_matrix is not None:
                raise CertificateError("the system has a disturbance_matrix, not its corrections")
            K = constant_gain(observer, system)
            stability = stability or certify_observer(
                system, observer, place, sizes=largest_sizes(known),
                seconds=deadline.part(_OBSERVER),
            )
            stability = fitting(stability, system, place, K)
            if stability.P is None:
                raise CertificateError("its constants are assumed, without a norm that contracts")
            bound = ObserverBound(stability, place, known)
            lipschitz = output_lipschitz(system, place, seconds=deadline)
            slope = _slope(
                fit_weight(cost, K), stability.P, lipschitz.value, constant_output(system, place)
            )
            evidence = weakest((evidence, stability.evidence, lipschitz.evidence))
        except (CertificateError, NotCertifiedError) as error:
            notes = (*notes, f"nothing holds in advance for any number of QPs: {error}")
    return Design(
        system, place, form, gamma, known, horizon or proposed or _MOST, bound, slope, evidence,
        notes,
    )


def _sizes(system: System, sizes: SignalBounds | Sizes | None) -> SignalBounds:
    """What is stated, or else the system's W and V."""
    if sizes is not None:
        return SignalBounds.stated(sizes)
    if system.disturbances is None or system.noises is None:
        raise SetError(
            "it is not known how large disturbances and noises may be: the system has no sets of "
            "them. Pass sizes=Sizes(disturbance=..., noise=...), or SignalBounds with boxes."
        )
    return SignalBounds(system.disturbances, system.noises, "the system's W and V")


def _short(gamma: float) -> float:
    """A number a little above, with few digits; any discount above gamma will do."""
    for digits in (4, 6, 8, 10):
        short = math.ceil(gamma * 10.0**digits) / 10.0**digits
        if short < 1.0 and short >= gamma:
            return short
    return math.nextafter(gamma, 1.0)
