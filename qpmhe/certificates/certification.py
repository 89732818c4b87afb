"""From system, observer, cost and horizon to a certificate."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from .._checks import count
from ..costs import Cost, CostConstants
from ..errors import OptionError
from ..model.sets import Box, ConvexSet
from ..model.system import System
from ..observers import Observer
from .audit import Audit, audit, checked_ingredients
from .branch_and_bound import constant_output
from .certificate import Certificate
from .deadline import DEFAULT_SECONDS, Deadline
from .decay import Sizes
from .detectability import certify_detectability
from .evidence import CertificateError
from .observer import certify_observer, constant_gain
from .properties import Detectability, ObserverStability, fitting
from .regions import Region, bounded_region
from .sdp import started
from .window_bounds import bounds_for

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
    gain = None
    try:
        gain = constant_gain(observer, system)
    except CertificateError:
        if stability is None:  # without one, all else would be in vain
            raise
    if detectability is not None:
        detectability = fitting(detectability, system, place, gain)
    if stability is not None:
        stability = fitting(stability, system, place, gain)
    deadline = started(seconds)
    findings = audit(system, observer, cost, place, seconds=deadline.part(_AUDIT))
    constants, _ = _needed(findings)
    wanted = cost_sizes(constants) if sizes is None else sizes
    if detectability is None:
        detectability = certify_detectability(
            system, place, weights=estimate_weights(constants),
            seconds=deadline.part(_DETECTABILITY),
        )
    if stability is None:
        stability = certify_observer(
            system, observer, place, weights=noise_weights(wanted),
            seconds=deadline.part(_OBSERVER),
        )
    return composed(
        system, observer, cost, findings, detectability, stability, horizons, wanted
    )


def composed(
    system: System, observer: Observer, cost: Cost, findings: Audit, detectability: Detectability,
    stability: ObserverStability, horizons: Sequence[int], sizes: Sizes,
) -> Certificate:
    """The certificate that follows from what was found."""
    constants, lipschitz = _needed(findings)
    output = constant_output(system, findings.region)
    return Certificate(
        system, observer, cost, findings, detectability, stability,
        {
            N: bounds_for(
                N, detectability, stability, cost, constants, lipschitz=lipschitz, output=output
            )
            for N in horizons
        },
        sizes,
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


def cost_sizes(constants: CostConstants) -> Sizes:
    """The disturbances and noises of which each alone costs 1, in its cheapest direction."""
    return Sizes(*estimate_weights(constants))


def estimate_weights(constants: CostConstants) -> tuple[float, float]:
    """How much a cost of 1 pays for: disturbances and noises of these sizes."""
    root = -1.0 / constants.exponent
    return constants.disturbance[0] ** root, constants.noise[0] ** root


def noise_weights(sizes: Sizes) -> tuple[float, float]:
    """The sizes as weights of a semidefinite program, none of them zero."""
    least = 1e-3 * max(sizes.disturbance, sizes.noise)
    return max(sizes.disturbance, least), max(sizes.noise, least)
