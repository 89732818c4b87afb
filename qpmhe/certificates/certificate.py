"""From system, observer, cost and horizon to a certificate, and to bounds on the error."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from .._checks import Array, count
from ..costs import Cost, CostConstants
from ..errors import OptionError, QpmheError
from ..estimation.run import Run
from ..model.sets import Box, ConvexSet
from ..model.system import System
from ..observers import Observer
from .audit import Assumption, about_corrections, about_cost, about_slope, checked_ingredients
from .contraction import certify_detectability, constant_gain, gain_if_constant
from .deadline import DEFAULT_SECONDS, Deadline
from .evidence import (
    CertificateError,
    Evidence,
    NotCertifiedError,
    OutOfTimeError,
    json_ready,
    weakest,
)
from .observer_bound import ObserverBound, bound_observer, with_invariance
from .properties import Detectability, ObserverStability, fitting
from .regions import Region, bounded_region
from .sdp import started
from .sizes import Size, Sizes
from .theorem import TheoremConstants

#: What no check can see.
ASSUMED = (
    "the true state stays in the region (and in X), and follows the model",
    "the bounds on disturbances, noises and the initial error are true",
)


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is proved about an observer, and an estimator that uses it, on a set of states.

    Made by `certify`; one that is made or changed by hand is assumed.

    Parameters
    ----------
    system, observer, cost
        What the estimator is made of.
    region : Region
        Where it holds.
    sizes : Sizes
        The disturbances and noises for which the bounds are stated.
    observer_bound : ObserverBound or None
        The observer's own bound, which gives the set around the observer that contains the true
        state.
    assumptions : tuple of Assumption
        The findings on the theorem's assumptions about cost, output and corrections.
    detectability, stability : optional
        Detectability and the observer's stability; None for what could not be shown.
    constants : mapping of int to TheoremConstants
        The theorem's constants for each horizon; empty where it does not apply.
    errors : mapping of str to QpmheError
        What could not be certified, and why.
    evidence : Evidence
        The weakest evidence for the theorem's constants or, without any, for the observer's bound.
    """

    system: System
    observer: Observer
    cost: Cost
    region: Region
    sizes: Sizes
    observer_bound: ObserverBound | None = None
    assumptions: tuple[Assumption, ...] = ()
    detectability: Detectability | None = None
    stability: ObserverStability | None = None
    constants: Mapping[int, TheoremConstants] = field(default_factory=dict)
    errors: Mapping[str, QpmheError] = field(default_factory=dict)
    evidence: Evidence = field(default=Evidence.ASSUMED, init=False)

    @property
    def diameter(self) -> float:
        """The largest distance between two states of the region, or a little more."""
        return self.region.diameter

    @property
    def holds(self) -> bool:
        """Whether anything bounds the error."""
        return self.observer_bound is not None or bool(self.constants)

    @property
    def failures(self) -> list[str]:
        """What could not be certified, in words."""
        return [
            str(each) if str(each).startswith(what) else f"{what}: {each}"
            for what, each in self.errors.items()
        ]

    def bound(
        self, run: Run, disturbances: Size | None = None, noises: Size | None = None, *,
        initial_error: Size,
    ) -> Array:
        """The bound on the error |x(t) - x_hat(t)| along a run at t = 0, ..., T, (T + 1,).

        The distance to the farthest point of the set around the observer that holds the true
        state, NaN once the run shows that it no longer does; arguments and errors are those of
        `ObserverBound.along`. An `OptionError` is raised if there is no bound of the observer.
        """
        band = self.proved.along(run, disturbances, noises, initial_error=initial_error)
        return band.error

    @property
    def proved(self) -> ObserverBound:
        """The observer's bound; an `OptionError` says why there is none."""
        if self.observer_bound is None:
            reason = self.errors.get(
                "the observer", "its constants were stated, not certified: leave stability out."
            )
            raise OptionError(f"there is no bound of the observer: {reason}")
        return self.observer_bound

    def of(self, horizon: int | None = None) -> TheoremConstants:
        """The theorem's constants for a horizon N, which may be left out if there is only one.

        ``certificate.of(N).result.bound(...)`` is its bound (eq:RGES_result) along a run. An
        `OptionError` names the horizons that have constants, or states why there are none.
        """
        if not self.constants:
            raise OptionError(
                f"the theorem's constants could not be certified: {'; '.join(self.failures)}"
            )
        if horizon is None and len(self.constants) == 1:
            (horizon,) = self.constants
        if horizon is None or horizon not in self.constants:
            raise OptionError(
                f"horizon is {horizon!r}; expected one of {list(self.constants)}, for which there "
                "are constants. Certify again with this horizon."
            )
        return self.constants[horizon]

    @property
    def headline(self) -> str:
        """The sharpest certified bound, in the states' units, in one line."""
        if self.observer_bound is None:
            return "No bound on the observer's error is proved."
        return self.observer_bound.headline

    def __str__(self) -> str:
        """The headline, for what it holds, what it rests on, and what could not be certified."""
        bound = self.observer_bound
        lines = [] if bound is None else [f"for {bound.sizes}", bound.condition]
        failures = (f"Not certified: {each}" for each in self.failures)
        return "\n".join([self.headline, *lines, *failures])

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows; infinite numbers become None."""
        system = self.system
        content: dict[str, Any] = json_ready({
            "system": {"n": system.n, "p": system.p, "m": system.m},
            "region": self.region, "headline": self.headline, "evidence": self.evidence,
            "assumed": ASSUMED, "failures": self.failures, "observer_bound": self.observer_bound,
            "assumptions": self.assumptions, "detectability": self.detectability,
            "observer": self.stability, "sizes": self.sizes, "paper": [
                json_ready(each) | {"limit": limit, "vacuous": not limit < self.diameter}
                for each, limit in self.limits()
            ],
        })
        return content

    def limits(self) -> list[tuple[TheoremConstants, float]]:
        """Limits of the theorem's bounds for the sizes; vacuous from the diameter on."""
        sizes = self.sizes.largest
        return [(each, each.result.limit(*sizes)) for each in self.constants.values()]


Result = TypeVar("Result")

# How much of the time left each part takes.
_OBSERVER, _OUTPUT, _DETECTABILITY, _INVARIANCE = 0.6, 0.4, 0.9, 0.2


def certify(
    system: System, observer: Observer, cost: Cost, *, horizon: int | Sequence[int],
    region: ConvexSet | Region | None = None, inputs: Box | None = None,
    sizes: Sizes | None = None, detectability: Detectability | None = None,
    stability: ObserverStability | None = None, seconds: float | Deadline = DEFAULT_SECONDS,
) -> Certificate:
    """Bound the observer's error on a set of states, then the estimator's by the theorem.

    The observer comes first: its bound needs neither cost nor horizon nor detectability. The
    certificate's ``errors`` say what else cannot be certified.

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
        Which disturbances and noises the bounds are for; left out, the system's W and V, and
        three standard deviations by the cost's weights where it has none.
    detectability, stability : optional
        Constants to take instead of looking for them, such as assumed ones, or those that
        were certified of this system and gain on a set that contains the region.
    seconds : float or Deadline
        Approximate time for the search for constants, after the solvers are loaded. What is not
        proved within its share rests on samples, and says so.

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
    sizes: Sizes | None, deadline: Deadline, detectability: Detectability | None = None,
    stability: ObserverStability | None = None,
) -> Certificate:
    """The certificate of `certify`, also where nothing holds: its errors say why."""
    errors: dict[str, QpmheError] = {}

    def attempt(what: str, question: Callable[[], Result]) -> Result | None:
        try:
            return question()
        except (NotCertifiedError, CertificateError) as error:
            errors[what] = error
            return None

    attempt("the theorem", lambda: checked_ingredients(system, observer, cost))
    chosen, gain = Sizes.of(sizes, system, cost), gain_if_constant(observer, system)
    if detectability is not None:
        detectability = fitting(detectability, system, region, gain)
    proved = None
    if stability is None:
        proved = attempt("the observer", lambda: bound_observer(
            system, observer, cost, region, sizes=chosen, seconds=deadline.part(_OBSERVER)
        ))
        stability = None if proved is None else proved.stability
    else:
        stability = fitting(stability, system, region, gain)
        if stability.P is not None and stability.gain is not None:
            proved = with_invariance(
                ObserverBound(stability, region, chosen, observer.metric), system,
                deadline.part(_INVARIANCE),
            )
    assumptions: tuple[Assumption, ...] = ()
    constants: dict[int, TheoremConstants] = {}
    parts = [] if stability is None else [stability.evidence]
    if "the theorem" not in errors:
        weights, about = about_cost(cost, observer)
        if weights is None:
            errors["the theorem"] = CertificateError(f"{about.text}; the theorem needs them.")
        output = about_slope(system, region, "h", deadline.part(_OUTPUT))
        assumptions = output, *about_corrections(system, observer), about
        if detectability is None:
            detectability = attempt("detectability", lambda: certify_detectability(
                system, region, weights=_cheapest(weights), seconds=deadline.part(_DETECTABILITY)
            ))
        if weights is not None and detectability is not None and stability is not None:
            if system.states is not None and proved is not None and proved.projects:
                assumptions = *assumptions, about_slope(system, region, "f", deadline)
            constants = _theorem(assumptions, weights, detectability, stability, horizons)
            parts += [detectability.evidence, *(
                each.evidence for each in assumptions if each.evidence is not None
            )]
    found = Certificate(
        system, observer, cost, region, chosen, proved, assumptions, detectability, stability,
        constants, errors,
    )
    if found.holds:
        object.__setattr__(found, "evidence", weakest(parts))
    return found


def _theorem(
    assumptions: Sequence[Assumption], weights: CostConstants, detectability: Detectability,
    stability: ObserverStability, horizons: Sequence[int],
) -> dict[int, TheoremConstants]:
    """The constants for each horizon."""
    values = {each.label: each.value for each in assumptions}
    slope, observer = values["ass:lipschitz"] or 0.0, stability.sums
    if slope > 0.0:  # a larger C_v holds as well, and from 1 / L_h on L_bar is L_h
        observer = replace(observer, noise=max(observer.noise, 1.0 / slope))
    return {
        N: TheoremConstants(
            detectability.sums, observer, weights, kappa=stability.kappa, lipschitz=slope,
            horizon=N, model_lipschitz=values.get("in place of eq:kappa"),
        )
        for N in horizons
    }


def _cheapest(constants: CostConstants | None) -> tuple[float, float]:
    """Sizes of disturbance and noise of which each alone costs 1, in its cheapest direction."""
    if constants is None:
        return 1.0, 1.0
    root = -1.0 / constants.exponent
    return constants.disturbance[0] ** root, constants.noise[0] ** root


def horizons_of(horizon: Any) -> list[int]:
    """One horizon or several, checked; sorted, each once."""
    given = list(horizon) if isinstance(horizon, Iterable) else [horizon]
    if isinstance(horizon, str) or not given:
        raise OptionError(f"horizon is {horizon!r}; expected an integer >= 1, or several of them.")
    return sorted({count("horizon", each, 1) for each in given})
