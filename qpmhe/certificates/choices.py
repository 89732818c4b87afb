"""What the theorem leaves free, chosen so that its bound is as tight as it gets."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import product

from ..costs import CostConstants
from ..errors import OptionError
from .decay import DecayingSums
from .theorem import TheoremConstants, theorem

__all__ = ["Sizes", "level", "tighten"]

# The search for the rate ends short of 1, where the sums of the result diverge.
_SMALLEST_GAP = 1e-6
# The level is flat about its minimum: this many values find it to a percent.
_VALUES = 12
# Pairs of detectability and observer bound in whose rates and constants is searched.
_SEARCHED = 4


@dataclass(frozen=True)
class Sizes:
    """For which errors and noises a bound is to be tight.

    Parameters
    ----------
    initial : float
        |x_0 - z_0|.
    disturbance, noise : float
        Largest |w| and |v|.

    Raises
    ------
    OptionError
        If one is negative or not finite, or all are zero.
    """

    initial: float = 1.0
    disturbance: float = 1.0
    noise: float = 1.0

    def __post_init__(self) -> None:
        values = (self.initial, self.disturbance, self.noise)
        if not all(0.0 <= value < math.inf for value in values) or not any(values):
            raise OptionError(f"sizes are {values}; expected finite numbers >= 0, not all 0.")


def level(bound: DecayingSums, sizes: Sizes) -> float:
    """What the bound cannot exceed at any time: its start, and what its sums tend to.

    Parameters
    ----------
    bound : DecayingSums
        The bound.
    sizes : Sizes
        Of initial error, disturbances and noises.
    """
    return bound.initial * sizes.initial + bound.limit(sizes.disturbance, sizes.noise)


def tighten(
    detectabilities: Iterable[DecayingSums],
    observers: Iterable[DecayingSums],
    cost: CostConstants,
    *,
    kappa: float,
    lipschitz: float,
    horizon: int,
    sizes: Sizes | None = None,
    searched: int = _SEARCHED,
) -> TheoremConstants:
    r"""The theorem's constants for the best of what it leaves free.

    Free are

    - which proved detectability and which proved observer bound to take, where there are
      several, such as one for each rate;
    - a larger C_v: L_bar = max(L_h, 1/C_v) falls until C_v = 1/L_h;
    - a larger rho, by `DecayingSums.slower`: :math:`\rho^{-N}` falls, at no price up to eta.

    A common factor of the cost's weights is no choice: no constant depends on it.

    Parameters
    ----------
    detectabilities, observers : iterable of DecayingSums
        At least one each.
    cost, kappa, lipschitz, horizon
        As of `theorem`.
    sizes : Sizes, optional
        For which errors and noises the result is to be tight; all 1 if left out.
    searched : int
        In how many pairs of the two to search, the most promising ones first.

    Returns
    -------
    TheoremConstants
        Those with the smallest `level`; its fields tell the choices.

    Raises
    ------
    OptionError
        As of `theorem`, or if there is nothing to choose from.
    """
    wanted = Sizes() if sizes is None else sizes
    best: TheoremConstants | None = None
    best_level = math.inf

    def tried(detectability: DecayingSums, observer: DecayingSums) -> float:
        nonlocal best, best_level
        constants = theorem(
            detectability, observer, cost, kappa=kappa, lipschitz=lipschitz, horizon=horizon
        )
        reached = level(constants.result, wanted)
        if best is None or reached < best_level:
            best, best_level = constants, reached
        return reached

    def guessed(pair: tuple[DecayingSums, DecayingSums]) -> float:
        detectability, observer = pair
        slower = observer.slower(max(observer.rate, detectability.rate))
        noise = max(slower.noise, 1.0 / lipschitz if lipschitz > 0.0 else 1.0)
        return tried(detectability, replace(slower, noise=noise))

    pairs = sorted(product(list(detectabilities), list(observers)), key=guessed)
    for detectability, observer in pairs[:searched]:
        _search(tried, detectability, observer, lipschitz)
    if best is None:
        raise OptionError("there is no detectability or no observer bound to choose from.")
    return best


def _search(
    tried: Callable[[DecayingSums, DecayingSums], float],
    detectability: DecayingSums,
    observer: DecayingSums,
    lipschitz: float,
) -> None:
    """Try rates and noise constants of the observer; `tried` keeps the best."""

    def with_rate(rate: float) -> float:
        slower = observer.slower(rate)
        # The smallest C_v and 1 / L_h are the ends; in between lies A / C_v + B C_v.
        enough = 1.0 / lipschitz if lipschitz > 0.0 else max(slower.noise, 1.0)

        def with_noise(log_noise: float) -> float:
            return tried(detectability, replace(slower, noise=math.exp(log_noise)))

        if slower.noise >= enough:
            return tried(detectability, slower)
        low = math.log(slower.noise) if slower.noise > 0.0 else math.log(enough) - 12.0
        return _smallest(with_noise, low, math.log(enough))

    eta = max(observer.rate, detectability.rate)
    if observer.rate < eta:
        _smallest(with_rate, observer.rate, eta)
    # Beyond eta the result's rate grows; the distance from 1 matters, on a log axis.
    _smallest(
        lambda log_gap: with_rate(max(eta, 1.0 - math.exp(log_gap))),
        math.log(min(_SMALLEST_GAP, 1.0 - eta)),
        math.log(1.0 - eta),
    )


def _smallest(function: Callable[[float], float], low: float, high: float) -> float:
    """The smallest value on an interval, its ends included."""
    from scipy.optimize import minimize_scalar

    at_ends = min(function(low), function(high))
    if not low < high:
        return at_ends
    inside = minimize_scalar(
        function, bounds=(low, high), method="bounded", options={"maxiter": _VALUES}
    )
    return min(at_ends, float(inside.fun))
