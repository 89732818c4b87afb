"""From system, observer, cost and horizon to a certificate."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from numpy.typing import ArrayLike

from .._checks import count
from ..costs import Cost, CostConstants
from ..errors import OptionError
from ..model.sets import Box, ConvexSet
from ..model.system import System
from ..models.scenario import Record
from ..observers import Observer
from .audit import audit, checked_ingredients
from .branch_and_bound import constant_output
from .certificate import Certificate
from .deadline import DEFAULT_SECONDS, Deadline
from .decay import DecayingSums
from .detectability import certify_detectability
from .evidence import CertificateError, Evidence, NotCertifiedError
from .horizon_bounds import HorizonBounds, Pairs, bounds_for
from .observer import certify_observer, constant_gain
from .properties import Detectability, ObserverStability, fitting
from .regions import Region, bounded_region
from .sdp import started
from .theorem import Sizes, level, tighten

__all__ = ["certify", "cost_sizes"]

Result = TypeVar("Result", Detectability, ObserverStability)

# Rates that are tried beside the first one found, by what is left to 1; and how many more
# the search for the best one may ask for.
_SHARES = (0.8, 0.55, 0.35)
_EVALUATIONS = 4
# So many horizons get all pairs of detectability and observer tried.
_FULL = 6
# How much of the time left the audit, the first search of each kind, and every later one take.
_AUDIT, _FIRST, _LATER = 0.25, 0.4, 0.25


def certify(
    system: System, observer: Observer, cost: Cost, *, horizon: int | Sequence[int],
    region: ConvexSet | Region | None = None, inputs: Box | None = None, sizes: Sizes | None = None,
    detectability: Detectability | None = None, stability: ObserverStability | None = None,
    run: Record | ArrayLike | None = None, initial_state: ArrayLike | None = None,
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
        For which initial errors, disturbances and noises the bounds are to be tight; left
        out, those of which each alone costs 1 in its cheapest direction.
    detectability, stability : optional
        Constants to take instead of looking for them, such as assumed ones, or those that
        were certified of this system and gain on a set that contains the region.
    run, initial_state : optional
        A record along which the candidate is checked against the sets; see `audit`.
    seconds : float or Deadline
        How long the audit and the search for constants may take, about, from when the solvers
        are loaded. What is not proved when its share is over rests on samples, and says so;
        better rates are sought in what is left. The bounds are computed after that, in a
        fraction of a second for each horizon (longer for N in the hundreds): up to six horizons
        try all pairs of rates, more only those that were best at the smallest, the middle and
        the largest one.

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
    horizons = _horizons(horizon)
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
    findings = audit(
        system, observer, cost, place, run, initial_state=initial_state,
        seconds=deadline.part(_AUDIT),
    )
    constants, lipschitz = findings.constants, findings.lipschitz
    if constants is None:
        raise CertificateError(f"{findings['cost bounds'].text}; the theorem needs them.")
    if lipschitz is None:
        raise CertificateError("h has no Lipschitz constant on the region.")
    wanted = cost_sizes(constants) if sizes is None else sizes
    root = -1.0 / constants.exponent
    weights = constants.disturbance[0] ** root, constants.noise[0] ** root
    small = 1e-3 * max(wanted.disturbance, wanted.noise) or 1.0
    noisy = max(wanted.disturbance, small), max(wanted.noise, small)

    def detected_at(rate: float | None) -> Detectability:
        share = deadline.part(_FIRST if rate is None else _LATER)
        return certify_detectability(system, place, eta=rate, weights=weights, seconds=share)

    def observed_at(rate: float | None) -> ObserverStability:
        share = deadline.part(_FIRST if rate is None else _LATER)
        return certify_observer(system, observer, place, rho=rate, weights=noisy, seconds=share)

    # One of each before the others: what cannot be certified fails soon.
    detected = [detected_at(None) if detectability is None else detectability]
    observing = [observed_at(None) if stability is None else stability]

    def reached(one: Detectability, other: ObserverStability) -> float:
        best = tighten(
            [DecayingSums(one.eta, one.c_p, one.c_w, one.c_v)],
            [DecayingSums(other.rho, other.C_p, other.C_w, other.C_v)],
            constants, kappa=other.kappa, lipschitz=lipschitz, horizon=horizons[-1], sizes=wanted,
        )
        return level(best.result, wanted)

    if detectability is None:
        detected = _refined(
            _family(detected[0], detected_at), detected_at,
            lambda one: reached(one, observing[0]),
        )
    if stability is None:
        first = min(detected, key=lambda one: reached(one, observing[0]))
        observing = _refined(
            _family(observing[0], observed_at), observed_at, lambda one: reached(first, one)
        )
    output = constant_output(system, place)

    def bounded(N: int, pairs: Pairs) -> HorizonBounds:
        return bounds_for(
            N, detected, observing, cost, constants, lipschitz=lipschitz, sizes=wanted,
            output=output, pairs=pairs,
        )

    made = Certificate(
        system, observer, cost, findings, tuple(detected), tuple(observing),
        _at_each(horizons, bounded), wanted,
    )
    return replace(made, origin=made.ingredients)


def _horizons(horizon: Any) -> list[int]:
    """One horizon or several, checked; sorted, each once."""
    given = list(horizon) if isinstance(horizon, Iterable) else [horizon]
    if isinstance(horizon, str) or not given:
        raise OptionError(f"horizon is {horizon!r}; expected an integer >= 1, or several of them.")
    return sorted({count("horizon", each, 1) for each in given})


def _at_each(
    horizons: list[int], bounded: Callable[[int, Pairs], HorizonBounds]
) -> dict[int, HorizonBounds]:
    """The bounds at each horizon: where they are many, most try what was best at three."""
    if len(horizons) <= _FULL:
        return {N: bounded(N, Pairs()) for N in horizons}
    seen = {N: Pairs() for N in (horizons[0], horizons[len(horizons) // 2], horizons[-1])}
    found = {N: bounded(N, pairs) for N, pairs in seen.items()}
    best = Pairs().best(*seen.values())
    return {N: found[N] if N in found else bounded(N, best) for N in horizons}


def cost_sizes(constants: CostConstants) -> Sizes:
    """The errors of which each alone costs 1, in its cheapest direction."""
    root = -1.0 / constants.exponent
    return Sizes(*(
        each[0] ** root for each in (constants.prior, constants.disturbance, constants.noise)
    ))


def _rate(result: Detectability | ObserverStability) -> float:
    return result.eta if isinstance(result, Detectability) else result.rho


def _family(first: Result, certified: Callable[[float | None], Result]) -> list[Result]:
    """Results at several rates, of which each is the best for something."""
    found = [first]
    for share in _SHARES:
        try:
            found.append(certified(1.0 - share * (1.0 - _rate(first))))
        except NotCertifiedError:  # a larger rate may be beyond what the solver can do
            continue
    return _best_founded(found)


def _refined(
    found: list[Result], certified: Callable[[float | None], Result],
    value: Callable[[Result], float],
) -> list[Result]:
    """The same results, and others about the rate of the best of them."""
    from scipy.optimize import minimize_scalar

    order = sorted(found, key=_rate)
    best = min(range(len(order)), key=lambda i: value(order[i]))
    low = _rate(order[max(best - 1, 0)])
    high = _rate(order[min(best + 1, len(order) - 1)])
    if not low < high:
        return found
    more = list(found)

    def tried(log_gap: float) -> float:
        try:
            result = certified(1.0 - math.exp(log_gap))
        except NotCertifiedError:
            return math.inf
        more.append(result)
        return value(result)

    minimize_scalar(
        tried, bounds=(math.log(1.0 - high), math.log(1.0 - low)), method="bounded",
        options={"maxiter": _EVALUATIONS},
    )
    return _best_founded(more)


def _best_founded(found: list[Result]) -> list[Result]:
    """The proved ones, if any is."""
    proved = [each for each in found if each.evidence is Evidence.PROVED]
    return proved or found
