"""From system, observer, cost and horizon to a certificate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from .._checks import count
from ..costs import Cost, CostConstants
from ..errors import OptionError, QpmheError
from ..model.sets import Box, ConvexSet
from ..model.system import System
from ..observers import Observer
from .audit import Audit, audit, checked_ingredients
from .branch_and_bound import constant_output
from .certificate import Certificate
from .deadline import DEFAULT_SECONDS, Deadline
from .decay import Sizes
from .detectability import certify_detectability
from .evidence import CertificateError, NotCertifiedError
from .observer import certify_observer, constant_gain, gain_if_constant
from .properties import Detectability, ObserverStability, fitting
from .regions import Region, bounded_region
from .sdp import started
from .window_bounds import bounds_for

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
    certificate = Ingredients(
        system, observer, cost, place, sizes, started(seconds), detectability, stability
    ).certificate(horizons)
    assert certificate is not None
    return certificate


class Ingredients:
    """What a certificate is made of: audit, detectability and the observer's stability.

    Errors are raised, or collected by the name of what could not be certified.
    """

    def __init__(
        self, system: System, observer: Observer, cost: Cost, region: Region, sizes: Sizes | None,
        deadline: Deadline, detectability: Detectability | None = None,
        stability: ObserverStability | None = None, errors: dict[str, QpmheError] | None = None,
    ) -> None:
        self.errors = errors
        self.audit = audit(system, observer, cost, region, seconds=deadline.part(_AUDIT))
        self._constants = self._attempt("", lambda: _needed(self.audit))
        weights = (1.0, 1.0)
        if self.audit.constants is not None:
            weights = estimate_weights(self.audit.constants)
        self.sizes = Sizes(*weights) if sizes is None else sizes
        self.detectability = detectability or self._attempt(
            "detectability", lambda: certify_detectability(
                system, region, weights=weights, seconds=deadline.part(_DETECTABILITY)
            ),
        )
        self.stability = stability or self._attempt(
            "the observer", lambda: certify_observer(
                system, observer, region, weights=_noise_weights(self.sizes),
                seconds=deadline.part(_OBSERVER),
            ),
        )
        self._of = system, observer, cost

    def _attempt(self, what: str, question: Callable[[], Result]) -> Result | None:
        try:
            return question()
        except (NotCertifiedError, CertificateError) as error:
            if self.errors is None:
                raise
            self.errors[what] = error
            return None

    def certificate(self, horizons: Sequence[int]) -> Certificate | None:
        """The certificate that follows; None where one of the ingredients is missing."""
        if self._constants is None or self.detectability is None or self.stability is None:
            return None
        (system, observer, cost), (constants, lipschitz) = self._of, self._constants
        output = constant_output(system, self.audit.region)
        bounds = {
            N: bounds_for(
                N, self.detectability, self.stability, cost, constants, lipschitz=lipschitz,
                output=output,
            )
            for N in horizons
        }
        return Certificate(
            system, observer, cost, self.audit, self.detectability, self.stability, bounds,
            self.sizes,
        ).sealed()


def _needed(findings: Audit) -> tuple[CostConstants, float]:
    """The cost's constants and L_h; a `CertificateError` where there are none."""
    if findings.constants is None:
        raise CertificateError(f"{findings['cost bounds'].text}; the theorem needs them.")
    if findings.lipschitz is None:
        raise CertificateError("h has no Lipschitz constant on the region.")
    return findings.constants, findings.lipschitz


def horizons_of(horizon: Any) -> list[int]:
    """One horizon or several, checked; sorted, each once."""
    given = list(horizon) if isinstance(horizon, Iterable) else [horizon]
    if isinstance(horizon, str) or not given:
        raise OptionError(f"horizon is {horizon!r}; expected an integer >= 1, or several of them.")
    return sorted({count("horizon", each, 1) for each in given})


def estimate_weights(constants: CostConstants) -> tuple[float, float]:
    """How much a cost of 1 pays for: disturbances and noises of these sizes."""
    root = -1.0 / constants.exponent
    return constants.disturbance[0] ** root, constants.noise[0] ** root


def _noise_weights(sizes: Sizes) -> tuple[float, float]:
    """The sizes as weights of a semidefinite program, none of them zero."""
    least = 1e-3 * max(sizes.disturbance, sizes.noise)
    return max(sizes.disturbance, least), max(sizes.noise, least)
