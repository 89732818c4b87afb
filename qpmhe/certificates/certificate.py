"""From system, observer, cost and horizon to a certificate, and to bounds of the error."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import shown

from .._checks import Array, count, numbers
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
from .contraction import certify_detectability, certify_observer, constant_gain, gain_if_constant
from .deadline import DEFAULT_SECONDS, Deadline
from .evidence import (
    CertificateError,
    Evidence,
    MismatchError,
    NotCertifiedError,
    json_ready,
    weakest,
)
from .properties import Detectability, ObserverStability, fitting
from .regions import Region, bounded_region
from .sdp import started
from .theorem import Sizes, checked_length
from .window_bounds import HorizonBounds, Kind, bounds_for

# The constants are upper bounds, what is computed from them is not: this covers its rounding.
_OUTWARD = 1.0 + 1e-9

#: What no check can see.
ASSUMED = (
    "the true state stays in the region, and follows the model",
    "the bounds on disturbances and noises that are passed are true",
)
#: A window without all its measurements has another cost.
BROKEN = Status.MISSING | Status.MODEL_FAILED | Status.FAILED_STAGE


@dataclass(frozen=True, eq=False)
class Certificate:
    """The theorem's constants for a system, an observer and a cost on a set of states.

    Made by `certify`; one that is made or changed by hand is assumed.

    Parameters
    ----------
    system, observer, cost
        What the estimator is made of.
    audit : Audit
        The assumptions, one by one.
    detectability, stability
        What was certified of system and observer.
    bounds : mapping of int to HorizonBounds
        For each horizon.
    sizes : Sizes
        For which disturbances and noises the bounds are called vacuous or not.
    evidence : Evidence
        What the bounds rest on: the weakest evidence among their ingredients'.
    """

    system: System
    observer: Observer
    cost: Cost
    audit: Audit
    detectability: Detectability
    stability: ObserverStability
    bounds: Mapping[int, HorizonBounds]
    sizes: Sizes
    evidence: Evidence = field(default=Evidence.ASSUMED, init=False)

    @cached_property
    def gain(self) -> Array | None:
        """The observer's constant gain, if it has one."""
        return gain_if_constant(self.observer, self.system)

    @property
    def region(self) -> Region:
        """Where it holds."""
        return self.audit.region

    @property
    def horizons(self) -> tuple[int, ...]:
        """The horizons with bounds."""
        return tuple(self.bounds)

    @cached_property
    def diameter(self) -> float:
        """The largest distance of two states of the region, or a little more."""
        return self.region.diameter

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of bounds at hand, the sharpest last."""
        return self.bounds[self.horizons[0]].kinds

    def bound(
        self, run: Run | None, disturbances: ArrayLike, noises: ArrayLike, *,
        initial_error: ArrayLike, horizon: int | None = None, kind: Kind = "paper",
        source: MovingHorizonEstimator | None = None,
    ) -> Array:
        """The bound of the error |x(t) - x_hat(t)| along a run at t = 0, ..., T, (T + 1,).

        Parameters
        ----------
        run : Run or None
            The run, whose costs ``kind="measured"`` uses. None where there is none; then
            disturbances or noises give the length.
        disturbances, noises : array_like
            w(t) and v(t) as (T, n) and (T, p), their Euclidean lengths (T,), or a number:
            a bound on the length at all times.
        initial_error : (n,) array_like or float
            x_0 - z_0, or a bound on its length.
        horizon : int, optional
            N; the source's, or the only one, if left out.
        kind : {"paper", "summed", "weighted", "measured"}
            The right-hand side of (eq:RGES_result) with the paper's constants, or beyond the
            paper: with the proof's norms kept, where those are not known with its sums kept,
            and with the estimates' own costs in place of their bound.
        source : MovingHorizonEstimator, optional
            The estimator that made the run, as the run left it, for the horizon and cost of
            the run. Needed for ``kind="measured"``; without one, the bound is that of an
            estimator with this certificate's cost and this horizon, whatever the run.

        Raises
        ------
        ShapeError, OptionError, InvalidInputError
            If an argument does not fit, or there is no such bound.
        MismatchError
            If the source is of another system, observer, cost or horizon, or did not make
            the run.
        """
        if source is not None and horizon is None:
            horizon = getattr(source, "horizon", None)
        chosen = self.of(horizon)
        start, w, v = self._signals(run, initial_error, disturbances, noises)
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
            return _OUTWARD * chosen.beyond(kind).bound(start, w, v, measured)
        lengths = [x if x.ndim == 1 else np.linalg.norm(x, axis=1) for x in (w, v)]
        return _OUTWARD * chosen.paper.result.bound(np.linalg.norm(start), *lengths)

    def _signals(
        self, run: Run | None, initial_error: ArrayLike, disturbances: ArrayLike, noises: ArrayLike
    ) -> tuple[Array, Array, Array]:
        """Initial error, disturbances and noises: vectors or lengths, at each sample."""
        n, p = self.system.n, self.system.p
        start = numbers("initial_error", initial_error)
        w, v = numbers("disturbances", disturbances), numbers("noises", noises)
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
        self, w_max: float, v_max: float, *, initial_error: float, steps: int,
        horizon: int | None = None, kind: Kind = "paper",
    ) -> Array:
        """The bound before anything is measured, for |w| <= w_max and |v| <= v_max, (T + 1,).

        Parameters
        ----------
        w_max, v_max, initial_error : float
            Bounds on the lengths of w(t), v(t) and x_0 - z_0.
        steps : int
            T.
        horizon, kind
            As for `bound`; not "measured".

        Raises
        ------
        OptionError
            If a length is negative or not finite, the steps are no integer, or there is no
            such bound.
        """
        if kind == "measured":
            raise OptionError(
                "kind is 'measured', but nothing is measured yet; expected one of "
                f"{[each for each in self.kinds if each != 'measured']}."
            )
        length = count("steps", steps, 1)
        return self.bound(
            None, np.full(length, checked_length("w_max", w_max)),
            np.full(length, checked_length("v_max", v_max)),
            initial_error=checked_length("initial_error", initial_error), horizon=horizon,
            kind=kind,
        )

    def limit(
        self, w_max: float, v_max: float, *, horizon: int | None = None, kind: Kind = "paper"
    ) -> float:
        """What the funnel tends to as t grows; arguments and errors as for `funnel`."""
        w, v = checked_length("w_max", w_max), checked_length("v_max", v_max)
        chosen = self.of(horizon)
        bound = chosen.paper.result if kind == "paper" else chosen.beyond(kind)
        return _OUTWARD * bound.limit(w, v)

    def vacuous(
        self, w_max: float | None = None, v_max: float | None = None, *, horizon: int | None = None,
        kind: Kind = "paper",
    ) -> bool:
        """Whether the bound says nothing: its limit is no less than the region's diameter.

        State and estimate are both in the region, so that their distance is never more.
        Arguments and errors are those of `funnel`; w_max and v_max are by default those of
        the certificate's `sizes`.
        """
        w = self.sizes.disturbance if w_max is None else w_max
        v = self.sizes.noise if v_max is None else v_max
        return not self.limit(w, v, horizon=horizon, kind=kind) < self.diameter

    def of(self, horizon: int | None = None) -> HorizonBounds:
        """The constants for a horizon N, which may be left out if there is only one.

        An `OptionError` says which there are if there are none for this one.
        """
        if horizon is None and len(self.bounds) == 1:
            return next(iter(self.bounds.values()))
        if horizon is None or horizon not in self.bounds:
            raise OptionError(
                f"horizon is {horizon!r}; expected one of {list(self.bounds)}, for which there "
                "are constants. Certify again with this horizon."
            )
        return self.bounds[horizon]

    def check_estimator(self, estimator: MovingHorizonEstimator) -> None:
        """Raise a `MismatchError` unless the estimator has this very system, observer and cost."""
        for name in ("system", "observer", "cost"):
            if getattr(self, name) is not getattr(estimator, name):
                raise MismatchError(
                    f"the certificate is of another {name} than the estimator's; certify the "
                    "very objects that the estimator is made of."
                )

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows; infinite numbers become None."""
        system, bounds = self.system, self.bounds
        content: dict[str, Any] = json_ready({
            "system": {"n": system.n, "p": system.p, "m": system.m},
            "region": self.region.to_dict(),
            "evidence": self.evidence.value,
            "assumed": list(ASSUMED),
            "assumptions": self.audit.to_dict(),
            "detectability": self.detectability.to_dict(),
            "observer": self.stability.to_dict(),
            "sizes": vars(self.sizes),
            "horizons": [each.to_dict(self.sizes) for each in bounds.values()],
            "vacuous": {
                kind: {N: self.vacuous(horizon=N, kind=kind) for N in bounds}
                for kind in self.kinds if kind != "measured"
            },
        })
        return content


Result = TypeVar("Result")

# How much of the time left the audit, detectability and the observer take.
_AUDIT, _DETECTABILITY, _OBSERVER = 0.25, 0.5, 0.9


def certify(
    system: System, observer: Observer, cost: Cost, *, horizon: int | Sequence[int],
    region: ConvexSet | Region | None = None, inputs: Box | None = None, sizes: Sizes | None = None,
    detectability: Detectability | None = None, stability: ObserverStability | None = None,
    seconds: float | Deadline = DEFAULT_SECONDS,
) -> Certificate:
    """Check the theorem's assumptions on a set of states, and bound the estimator's error.

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
    sizes : Sizes, optional
        For which disturbances and noises the observer's constants are to be small, and the
        bounds are called vacuous or not; left out, those of which each alone costs 1 in its
        cheapest direction.
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
    CertificateError
        If the cost has no constants, h no Lipschitz constant, or the observer no constant
        gain and no assumed constants.
    NotCertifiedError
        If detectability or the observer's stability cannot be shown; the text says what
        may help.
    """
    checked_ingredients(system, observer, cost)
    horizons = horizons_of(horizon)
    place = bounded_region(system, region, inputs)
    gain = gain_if_constant(observer, system)
    if gain is None and stability is None:  # without one, all else would be in vain
        constant_gain(observer, system)
    if detectability is not None:
        detectability = fitting(detectability, system, place, gain)
    if stability is not None:
        stability = fitting(stability, system, place, gain)
    *_, certificate = certified(
        system, observer, cost, place, horizons, sizes, started(seconds), detectability, stability
    )
    assert certificate is not None
    return certificate


def certified(
    system: System, observer: Observer, cost: Cost, region: Region, horizons: Sequence[int],
    sizes: Sizes | None, deadline: Deadline, detectability: Detectability | None = None,
    stability: ObserverStability | None = None, errors: dict[str, QpmheError] | None = None,
) -> tuple[Audit, Detectability | None, ObserverStability | None, Certificate | None]:
    """Each ingredient, and the certificate that follows; None for what could not be certified.

    Errors are collected by the name of what could not be, or raised where nothing collects them.
    """

    def attempt(what: str, question: Callable[[], Result]) -> Result | None:
        try:
            return question()
        except (NotCertifiedError, CertificateError) as error:
            if errors is None:
                raise
            errors[what] = error
            return None

    findings = audit(system, observer, cost, region, seconds=deadline.part(_AUDIT))
    constants = attempt("", lambda: _needed(findings))
    weights = (1.0, 1.0) if constants is None else _cheapest(constants)
    sizes = Sizes(*weights) if sizes is None else sizes
    w, v = sizes.disturbance, sizes.noise
    least = 1e-3 * max(w, v)
    detectability = detectability or attempt("detectability", lambda: certify_detectability(
        system, region, weights=weights, seconds=deadline.part(_DETECTABILITY)
    ))
    stability = stability or attempt("the observer", lambda: certify_observer(
        system, observer, region, sizes=(max(w, least), max(v, least)),
        seconds=deadline.part(_OBSERVER),
    ))
    if constants is None or detectability is None or stability is None:
        return findings, detectability, stability, None
    output = constant_output(system, region)
    bounds = {
        N: bounds_for(
            N, detectability, stability, cost, constants, lipschitz=findings.lipschitz,
            output=output,
        )
        for N in horizons
    }
    certificate = Certificate(
        system, observer, cost, findings, detectability, stability, bounds, sizes
    )
    used = [detectability.evidence, stability.evidence] + [
        each.evidence for each in findings.findings if each.needed and each.evidence is not None
    ]
    object.__setattr__(certificate, "evidence", weakest(used))
    return findings, detectability, stability, certificate


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
