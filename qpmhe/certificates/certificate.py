"""From system, observer, cost and horizon to a certificate, and to bounds of the error."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import shown

from .._checks import Array, choice, count, numbers
from ..costs import Cost, CostConstants
from ..errors import InvalidInputError, OptionError, QpmheError, ShapeError
from ..estimation.estimate import Status
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..model.sets import Box, ConvexSet
from ..model.system import System
from ..observers import Observer
from .audit import Audit, audit, checked_ingredients
from .branch_and_bound import constant_output
from .contraction import (
    certify_detectability,
    constant_gain,
    gain_if_constant,
)
from .deadline import DEFAULT_SECONDS, Deadline
from .evidence import (
    CertificateError,
    Evidence,
    MismatchError,
    NotCertifiedError,
    OutOfTimeError,
    json_ready,
    weakest,
)
from .observer_bound import ObserverBound, bound_observer, with_invariance
from .properties import Detectability, ObserverStability, fitting
from .regions import Region, bounded_region
from .sdp import started
from .signal_bounds import SignalBounds, Size
from .theorem import Sizes, checked_length
from .window_bounds import HorizonBounds, bounds_for
from .window_bounds import Kind as TheoremKind

Kind = TheoremKind | Literal["observer"]
_KINDS = ("observer", "paper", "summed", "weighted", "measured")

#: The constants are upper bounds, what is computed from them is not: this covers its rounding.
OUTWARD = 1.0 + 1e-9

#: What no check can see.
ASSUMED = (
    "the true state stays in the region (and in X), and follows the model",
    "the bounds on disturbances, noises and the initial error are true",
)
#: A window without all its measurements has another cost.
BROKEN = Status.MISSING | Status.MODEL_FAILED | Status.FAILED_STAGE


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is proved of an observer, and of an estimator beside it, on a set of states.

    Made by `certify`; one that is made or changed by hand is assumed.

    Parameters
    ----------
    system, observer, cost
        What the estimator is made of.
    region : Region
        Where it holds.
    sizes : SignalBounds
        For which disturbances and noises the bounds are stated.
    observer_bound : ObserverBound or None
        The observer's own bound, and with it the set around the observer that holds the truth.
    audit, detectability, stability : optional
        The theorem's assumptions; None for what could not be examined.
    bounds : mapping of int to HorizonBounds
        The theorem's bounds for each horizon; empty where it does not apply.
    errors : mapping of str to QpmheError
        What could not be certified, and why.
    evidence : Evidence
        What the theorem's bounds rest on, the weakest evidence among their ingredients'; where
        there are none, what the observer's rests on.
    """

    system: System
    observer: Observer
    cost: Cost
    region: Region
    sizes: SignalBounds
    observer_bound: ObserverBound | None = None
    audit: Audit | None = None
    detectability: Detectability | None = None
    stability: ObserverStability | None = None
    bounds: Mapping[int, HorizonBounds] = field(default_factory=dict)
    errors: Mapping[str, QpmheError] = field(default_factory=dict)
    evidence: Evidence = field(default=Evidence.ASSUMED, init=False)

    @cached_property
    def gain(self) -> Array | None:
        """The observer's constant gain, if it has one."""
        return gain_if_constant(self.observer, self.system)

    @property
    def horizons(self) -> tuple[int, ...]:
        """The horizons with bounds of the theorem."""
        return tuple(self.bounds)

    @cached_property
    def diameter(self) -> float:
        """The largest distance of two states of the region, or a little more."""
        return self.region.diameter

    @property
    def kinds(self) -> tuple[TheoremKind, ...]:
        """The kinds of the theorem's bounds, the sharpest last; none without the theorem."""
        return next((bounds.kinds for bounds in self.bounds.values()), ())

    @property
    def holds(self) -> bool:
        """Whether anything bounds the error."""
        return self.observer_bound is not None or bool(self.bounds)

    @property
    def failures(self) -> list[str]:
        """What could not be certified, in words."""
        return [f"{what}: {each}" for what, each in self.errors.items()]

    def bound(
        self, run: Run | None, disturbances: Size | None = None, noises: Size | None = None, *,
        initial_error: Size, horizon: int | None = None, kind: Kind = "observer",
        source: MovingHorizonEstimator | None = None,
    ) -> Array:
        """The bound of the error |x(t) - x_hat(t)| along a run at t = 0, ..., T, (T + 1,).

        Parameters
        ----------
        run : Run or None
            The run. Without one, ``kind="observer"`` bounds the observer's error, and
            disturbances or noises give the number of samples.
        disturbances, noises : array_like or set, optional
            w(t) and v(t) as (T, n) and (T, p), their Euclidean lengths (T,), a number that bounds
            the length at all times or, for ``kind="observer"``, a set; `sizes` if left out.
        initial_error : (n,) array_like, float or set
            x_0 - z_0, a bound on its length or, for ``kind="observer"``, a set that holds it.
        horizon : int, optional
            N; the source's, or the only one, if left out. Not for ``kind="observer"``.
        kind : {"observer", "paper", "summed", "weighted", "measured"}
            ``observer``: the distance to the farthest point of the set around the observer that
            holds the true state, NaN from where the run shows that it no longer does, see
            `ObserverBound.along`. The others follow from the theorem: the right-hand side of
            (eq:RGES_result) with the paper's constants, or beyond the paper with the proof's
            norms kept (for other costs than quadratic ones its sums), and with the estimates'
            own costs in place of their bound.
        source : MovingHorizonEstimator, optional
            The estimator that made the run, as the run left it; it is compared with the
            certificate. Needed for ``kind="measured"``.

        Raises
        ------
        ShapeError, OptionError, InvalidInputError
            If an argument does not fit, or there is no such bound.
        MismatchError
            If the source is of another system, observer, cost or horizon, or did not make
            the run.
        """
        choice("kind", kind, _KINDS)
        if kind == "observer":
            return self._of_observer(run, disturbances, noises, initial_error, source)
        if source is not None and horizon is None:
            horizon = getattr(source, "horizon", None)
        chosen, lengths = self.of(horizon), self.sizes.lengths
        start, w, v = self._signals(
            run, initial_error, lengths.disturbance if disturbances is None else disturbances,
            lengths.noise if noises is None else noises,
        )
        costs = None
        if source is not None:
            costs = self._costs(source, run, chosen.paper.horizon)
        elif kind == "measured":
            raise InvalidInputError(
                "the measured bound has no source, and a run does not say its horizon and "
                "cost; pass the estimator that made it (source=estimator)."
            )
        if kind != "paper":
            measured = costs if kind == "measured" else None
            return OUTWARD * chosen.beyond(kind).bound(start, w, v, measured)
        sizes = [x if x.ndim == 1 else np.linalg.norm(x, axis=1) for x in (w, v)]
        return OUTWARD * chosen.paper.result.bound(float(np.linalg.norm(start)), *sizes)

    def _of_observer(
        self, run: Run | None, disturbances: Size | None, noises: Size | None,
        initial_error: Size, source: MovingHorizonEstimator | None,
    ) -> Array:
        proved = self._observer()
        if source is not None:
            self.check_estimator(source)
            if source.settings.candidate != "observer":
                raise MismatchError(
                    "the source's candidate comes from a reinitialized observer, whose states "
                    "this bound is not about; make it with candidate='observer'."
                )
            proved = proved.of_observer(source.observer)
        if run is not None:
            return proved.along(run, disturbances, noises, initial_error=initial_error).error
        entering = proved.entering(disturbances, noises)
        if entering.samples is None:
            raise ShapeError(
                "disturbances and noises are not of single samples, and there is no run; expected "
                "a sequence for one of them, to say how many samples there are."
            )
        radius = proved.radii(entering.samples, initial_error, entering)
        return proved.farthest(radius, np.zeros((len(radius), self.system.n)))

    def _observer(self) -> ObserverBound:
        """The observer's bound, or an error that says why there is none."""
        if self.observer_bound is None:
            reason = self.errors.get("the observer")
            why = (
                f"{reason}" if reason is not None else
                "its constants were stated, not certified: leave stability out."
            )
            others = f" Of the theorem's there are {list(self.kinds)}." if self.bounds else ""
            raise OptionError(
                f"kind is 'observer', but there is no bound of the observer: {why}{others}"
            )
        return self.observer_bound

    def _signals(
        self, run: Run | None, initial_error: Size, disturbances: Size, noises: Size
    ) -> tuple[Array, Array, Array]:
        """Initial error, disturbances and noises: vectors or lengths, at each sample."""
        n, p = self.system.n, self.system.p
        start, w, v = (
            numbers(name, self._number(name, given)) for name, given in (
                ("initial_error", initial_error), ("disturbances", disturbances),
                ("noises", noises),
            )
        )
        steps = len(run) if run is not None else next((len(x) for x in (w, v) if x.ndim), None)
        if steps is None:
            raise ShapeError(
                "disturbances and noises are numbers and there is no run; expected a sequence "
                "for one of them, to say how many steps there are."
            )
        known = ("initial_error", start, (), (n,)), ("disturbances", w, (steps,), (steps, n)), (
            "noises", v, (steps,), (steps, p)
        )
        found = []
        for name, x, lengths, vectors in known:
            if x.ndim and x.shape not in (lengths, vectors):
                raise ShapeError(
                    f"{name} has shape {x.shape}; expected {vectors}, lengths {lengths}, or a "
                    "number."
                )
            if x.shape != vectors and (x < 0.0).any():
                raise OptionError(f"{name} is {shown(x)}; expected Euclidean lengths, all >= 0.")
            found.append(x if x.ndim else np.full(lengths, x))
        return found[0], found[1], found[2]

    @staticmethod
    def _number(name: str, given: Size) -> ArrayLike:
        """What is no set; the theorem's bounds take lengths and vectors."""
        if isinstance(given, ConvexSet):
            raise OptionError(
                f"{name} is a set, which kind='observer' takes; expected lengths or vectors."
            )
        return given

    def _costs(self, source: MovingHorizonEstimator, run: Run | None, horizon: int) -> Array:
        """The costs of a run's estimates; NaN where a window is not what the bound is of."""
        if run is None or not isinstance(source, MovingHorizonEstimator):
            raise InvalidInputError(
                f"source is {source!r} and run {run!r}; expected an estimator and its run."
            )
        self.check_estimator(source)
        if source.horizon != horizon:
            raise MismatchError(
                f"horizon is {horizon}, but the run's estimator has {source.horizon}; take the "
                "bound for its horizon, and certify again if there is none."
            )
        if source.time != len(run) or not np.array_equal(
            source.state, run.states[-1], equal_nan=True
        ):
            raise MismatchError(
                "the source is not at the end of this run: it has seen another one, or more or "
                "less of it. Pass the estimator right after its run from the start."
            )
        costs = np.array(run.costs, np.float64)
        for t in np.flatnonzero(run.flags & BROKEN.value):
            costs[t : t + horizon] = np.nan
        return costs

    def funnel(
        self, w_max: float | None = None, v_max: float | None = None, *, initial_error: Size,
        steps: int, horizon: int | None = None, kind: Kind = "observer",
    ) -> Array:
        """The bound before anything is measured, (T + 1,).

        Parameters
        ----------
        w_max, v_max : float, optional
            Bounds on the lengths of w(t) and v(t); `sizes` if left out.
        initial_error, horizon, kind
            As for `bound`; not "measured". For "observer", the bound is of |x(t) - z(t)|.
        steps : int
            T.

        Raises
        ------
        OptionError
            If a length is negative or not finite, the steps are no integer, or there is no
            such bound.
        """
        self._check_unmeasured(kind)
        length = count("steps", steps, 1)
        w, v = self._always(w_max, v_max, kind)
        if kind == "observer":
            proved = self._observer()
            radius = proved.radii(length, initial_error, proved.entering(w, v))
            return proved.farthest(radius, np.zeros((length + 1, self.system.n)))
        return self.bound(
            None, np.full(length, w), np.full(length, v), horizon=horizon, kind=kind,
            initial_error=checked_length("initial_error", initial_error),
        )

    def limit(
        self, w_max: float | None = None, v_max: float | None = None, *,
        horizon: int | None = None, kind: Kind = "observer",
    ) -> float:
        """What the funnel tends to as t grows; arguments and errors as for `funnel`."""
        self._check_unmeasured(kind)
        w, v = self._always(w_max, v_max, kind)
        if kind == "observer":
            proved = self._observer()
            return float(proved.farthest(proved.limit(w, v), np.zeros(self.system.n)))
        chosen = self.of(horizon)
        bound = chosen.paper.result if kind == "paper" else chosen.beyond(kind)
        return OUTWARD * bound.limit(w, v)

    def _always(
        self, w_max: float | None, v_max: float | None, kind: Kind
    ) -> tuple[Any, Any]:
        """What bounds w and v at all times: sets only for the observer's bound."""
        if kind == "observer":
            usual: tuple[Any, Any] = self.sizes.disturbances, self.sizes.noises
        else:
            lengths = self.sizes.lengths
            usual = lengths.disturbance, lengths.noise
        w, v = (
            each if given is None else checked_length(name, given)
            for each, given, name in zip(usual, (w_max, v_max), ("w_max", "v_max"), strict=True)
        )
        return w, v

    def _check_unmeasured(self, kind: Kind) -> None:
        choice("kind", kind, _KINDS)
        if kind == "measured":
            kinds = ["observer", *(each for each in self.kinds if each != "measured")]
            raise OptionError(
                f"kind is 'measured', but nothing is measured yet; expected one of {kinds}."
            )

    def vacuous(
        self, w_max: float | None = None, v_max: float | None = None, *,
        horizon: int | None = None, kind: Kind = "observer",
    ) -> bool:
        """Whether the bound says nothing: its limit is no less than the region's size.

        State and estimate are both in the region, so that their distance is never more than its
        diameter. Of the observer's bound each component must be less than the region is wide.
        Arguments and errors are those of `funnel`.
        """
        if kind == "observer":
            w, v = self._always(w_max, v_max, kind)
            proved = self._observer()
            return not (proved.components(proved.limit(w, v)) < proved.widths).all()
        return not self.limit(w_max, v_max, horizon=horizon, kind=kind) < self.diameter

    def of(self, horizon: int | None = None) -> HorizonBounds:
        """The constants for a horizon N, which may be left out if there is only one.

        An `OptionError` says which there are if there are none for this one, or why there are
        none at all.
        """
        if horizon is None and len(self.bounds) == 1:
            return next(iter(self.bounds.values()))
        if not self.bounds:
            raise OptionError(
                "the theorem's bounds could not be certified, so that only kind='observer' is "
                f"there: {'; '.join(self.failures)}"
            )
        if horizon is None or horizon not in self.bounds:
            raise OptionError(
                f"horizon is {horizon!r}; expected one of {list(self.bounds)}, for which there "
                "are constants. Certify again with this horizon."
            )
        return self.bounds[horizon]

    def check_estimator(self, estimator: MovingHorizonEstimator) -> None:
        """Raise a `MismatchError` unless the estimator has this very system, observer and cost.

        An observer with the same constant gain is the same one, whatever its metric. The cost
        matters only to the theorem's bounds.
        """
        for name in ("system", "observer", "cost"):
            mine, theirs = getattr(self, name), getattr(estimator, name)
            same = mine is theirs or (
                self._has_same_gain(theirs) if name == "observer"
                else name == "cost" and not self.bounds
            )
            if not same:
                raise MismatchError(
                    f"the certificate is of another {name} than the estimator's; certify the "
                    "very objects that the estimator is made of."
                )

    def _has_same_gain(self, observer: Observer) -> bool:
        gain = gain_if_constant(observer, self.system)
        return gain is not None and self.gain is not None and np.array_equal(gain, self.gain)

    @property
    def headline(self) -> str:
        """The sharpest thing that is certified, in the states' units, in one line."""
        if self.observer_bound is None:
            return "No bound of the observer's error is proved."
        return self.observer_bound.headline

    def summary(self) -> str:
        """The headline, for what it holds, what it rests on, and what could not be certified."""
        lines = [self.headline]
        if self.observer_bound is not None:
            lines.append(f"for {self.observer_bound.sizes}")
            lines.append(self.observer_bound.condition)
        lines += [f"Not certified: {each}" for each in self.failures]
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows; infinite numbers become None."""
        system, bounds = self.system, self.bounds
        content: dict[str, Any] = json_ready({
            "system": {"n": system.n, "p": system.p, "m": system.m},
            "region": self.region.to_dict(),
            "headline": self.headline,
            "evidence": self.evidence.value,
            "assumed": list(ASSUMED),
            "failures": self.failures,
            "observer_bound": self.observer_bound and self.observer_bound.to_dict(),
            "assumptions": self.audit and self.audit.to_dict(),
            "detectability": self.detectability and self.detectability.to_dict(),
            "observer": self.stability and self.stability.to_dict(),
            "sizes": self.sizes.to_dict(),
            "horizons": [each.to_dict(self.sizes.lengths) for each in bounds.values()],
            "vacuous": {
                kind: {N: self.vacuous(horizon=N, kind=kind) for N in bounds}
                for kind in self.kinds if kind != "measured"
            },
        })
        return content


Result = TypeVar("Result")

# How much of the time left each part takes.
_OBSERVER, _AUDIT, _DETECTABILITY, _INVARIANCE = 0.6, 0.4, 0.9, 0.2


def certify(
    system: System, observer: Observer, cost: Cost, *, horizon: int | Sequence[int],
    region: ConvexSet | Region | None = None, inputs: Box | None = None,
    sizes: SignalBounds | Sizes | None = None, detectability: Detectability | None = None,
    stability: ObserverStability | None = None, seconds: float | Deadline = DEFAULT_SECONDS,
) -> Certificate:
    """Bound the observer's error on a set of states, then the estimator's by the theorem.

    The observer comes first: its bound needs neither cost nor horizon nor detectability. What
    else cannot be certified is in the certificate's ``errors``.

    Parameters
    ----------
    system, observer, cost
        What the estimator is made of.
    horizon : int or sequence of int
        N, or several of them.
    region : Box, Polytope or Region, optional
        A bounded set of states; the system's own if left out.
    inputs : Box, optional
        Bounds on the inputs, for a system with inputs.
    sizes : SignalBounds or Sizes, optional
        Which disturbances and noises the bounds are for; left out, the system's W and V, and
        three standard deviations by the cost's weights where it has none.
    detectability, stability : optional
        Constants to take instead of looking for them, such as assumed ones, or those that
        were certified of this system and gain on a set that contains the region.
    seconds : float or Deadline
        How long the audit and the search for constants may take, about, from when the solvers
        are loaded. What is not proved when its share is over rests on samples, and says so.

    Raises
    ------
    SetError, ShapeError, OptionError, InvalidInputError, ModelError
        If an argument does not fit.
    MismatchError
        If constants that are passed are of another system or gain, or of a set that does not
        contain the region and the inputs.
    CertificateError, NotCertifiedError
        If nothing bounds the error: the observer has no constant gain and no assumed constants,
        or its stability cannot be shown; the text says what may help.
    """
    horizons, place = horizons_of(horizon), bounded_region(system, region, inputs)
    if stability is None:  # without a gain, all else would be in vain
        constant_gain(observer, system)
    found = examined(
        system, observer, cost, place, horizons, sizes, started(seconds), detectability, stability
    )
    if not found.holds:
        # Where the state cannot be detected, no observer can be stable; a search that ran out of
        # time says nothing of it.
        order = ("the theorem", "detectability", "the observer")
        errors = [found.errors[what] for what in order if what in found.errors]
        raise next((each for each in errors if not isinstance(each, OutOfTimeError)), errors[-1])
    return found


def examined(
    system: System, observer: Observer, cost: Cost, region: Region, horizons: Sequence[int],
    sizes: SignalBounds | Sizes | None, deadline: Deadline,
    detectability: Detectability | None = None, stability: ObserverStability | None = None,
) -> Certificate:
    """The certificate of `certify`, also where nothing holds: its errors say why."""
    errors: dict[str, QpmheError] = {}

    def attempt(what: str, question: Callable[[], Result]) -> Result | None:
        try:
            return question()
        except (NotCertifiedError, CertificateError) as error:
            errors[what] = error
            return None

    try:
        checked_ingredients(system, observer, cost)
    except CertificateError as error:
        errors["the theorem"] = error
    bounds_of_signals = SignalBounds.of(sizes, system, cost)
    gain = gain_if_constant(observer, system)
    if detectability is not None:
        detectability = fitting(detectability, system, region, gain)
    if stability is not None:
        stability = fitting(stability, system, region, gain)
    proved = None
    if stability is None:
        proved = attempt("the observer", lambda: bound_observer(
            system, observer, cost, region, sizes=bounds_of_signals,
            seconds=deadline.part(_OBSERVER),
        ))
        stability = None if proved is None else proved.stability
    elif stability.P is not None and stability.gain is not None:
        proved = with_invariance(
            ObserverBound(stability, region, bounds_of_signals, observer.metric), system,
            deadline.part(_INVARIANCE),
        )
    findings: Audit | None = None
    constants: CostConstants | None = None
    if "the theorem" not in errors:
        findings = attempt("the theorem", lambda: audit(
            system, observer, cost, region, seconds=deadline.part(_AUDIT)
        ))
        if findings is not None:
            constants = attempt("the theorem", lambda: _needed(findings))
        weights = (1.0, 1.0) if constants is None else _cheapest(constants)
        detectability = detectability or attempt("detectability", lambda: certify_detectability(
            system, region, weights=weights, seconds=deadline.part(_DETECTABILITY)
        ))
    bounds: dict[int, HorizonBounds] = {}
    used = []
    if findings and constants and detectability is not None and stability is not None:
        output = constant_output(system, region)
        bounds = {
            N: bounds_for(
                N, detectability, stability, cost, constants, lipschitz=findings.lipschitz,
                output=output,
            )
            for N in horizons
        }
        used = [detectability.evidence] + [
            each.evidence for each in findings.findings
            if each.needed and each.evidence is not None
        ]
    certificate = Certificate(
        system, observer, cost, region, bounds_of_signals, proved, findings, detectability,
        stability, bounds, errors,
    )
    if stability is not None and (bounds or proved is not None):
        object.__setattr__(certificate, "evidence", weakest([stability.evidence, *used]))
    return certificate


def _needed(findings: Audit) -> CostConstants:
    """The cost's constants; a `CertificateError` where there are none."""
    if findings.constants is None:
        raise CertificateError(f"{findings['cost bounds'].text}; the theorem needs them.")
    return findings.constants


def _cheapest(constants: CostConstants) -> tuple[float, float]:
    """Sizes of disturbance and noise of which each alone costs 1, in its cheapest direction."""
    root = -1.0 / constants.exponent
    return constants.disturbance[0] ** root, constants.noise[0] ** root


def horizons_of(horizon: Any) -> list[int]:
    """One horizon or several, checked; sorted, each once."""
    given = list(horizon) if isinstance(horizon, Iterable) else [horizon]
    if isinstance(horizon, str) or not given:
        raise OptionError(f"horizon is {horizon!r}; expected an integer >= 1, or several of them.")
    return sorted({count("horizon", each, 1) for each in given})
