"""The theorem's constants and its lemma's (lem:boundedness_of_J), and its best free choices."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, count
from ..costs import CostConstants
from ..errors import OptionError
from .decay import DecayingSums, decaying_sums, lengths

__all__ = ["Sizes", "TheoremConstants", "level", "theorem", "tighten"]

Triple = tuple[float, float, float]

#: What each of C_1, C_2, C_3 consists of, in the order of `TheoremConstants.terms`.
TERMS = ("prior", "disturbance", "noise", "observer", "own")
# The search for the rate ends short of 1, where the sums of the result diverge.
_SMALLEST_GAP = 1e-6
# The level is flat about its minimum: this many values find it to a percent.
_VALUES = 12
# Pairs of detectability and observer bound in whose rates and constants is searched.
_SEARCHED = 4


@dataclass(frozen=True)
class TheoremConstants:
    """All constants of the theorem for one horizon, with the paper's symbols.

    Made by `theorem`. Triples are in the order initial error, disturbance, noise: p, w, v
    and 1, 2, 3 in the paper.
    """

    horizon: int
    detectability: DecayingSums
    observer: DecayingSums
    cost: CostConstants
    kappa: float
    lipschitz: float

    @cached_property
    def L_bar(self) -> float:  # noqa: N802 - the paper's symbol
        """max(L_h, 1 / C_v), before (eq:proof_2)."""
        return max(self.lipschitz, 1.0 / self.observer.noise)

    @cached_property
    def c_bar(self) -> float:
        """(3 L_bar)^a (c_w kappa^a + c_v) with the cost's upper constants, (eq:proof_rho)."""
        a = self.cost.exponent
        upper = self.cost.disturbance[1] * _power(self.kappa, a) + self.cost.noise[1]
        return _power(3.0 * self.L_bar, a) * upper

    @cached_property
    def rho_bar_1(self) -> float:
        """(rho^(-a N) - 1) / (1 - rho^a), (eq:proof_rho4)."""
        return self._geometric(self.horizon) * _power(self.observer.rate, -self.cost.exponent)

    @cached_property
    def rho_bar_2(self) -> float:
        """(rho^(-a (N-1)) - rho^a) / (1 - rho^a), (eq:proof_rho5)."""
        return self._geometric(self.horizon)

    def _geometric(self, count: int) -> float:
        """The sum of rho^(-a k) over k = 0, ..., count - 1, accurate for rho near 1."""
        slope = -self.cost.exponent * math.log(self.observer.rate)
        try:
            return math.expm1(count * slope) / math.expm1(slope)
        except OverflowError:
            return math.inf

    @cached_property
    def C_bar(self) -> Triple:  # noqa: N802
        """The constants C_bar_p(N), C_bar_w(N), C_bar_v(N) of (eq:bound_hat_x)."""
        C_p, C_w, C_v = self.observer.constants
        a, rho = self.cost.exponent, self.observer.rate
        first = _power(3.0 * self.c_bar * self.rho_bar_1, 1.0 / a)
        second = _power(3.0 * self.c_bar * self.rho_bar_2, 1.0 / a) / rho
        return C_p * first, _product(C_w, second), C_v * second

    @cached_property
    def eta_bar(self) -> float:
        """The geometric series eta / (1 - eta), (eq:proof_ali)."""
        return self.detectability.rate / (1.0 - self.detectability.rate)

    @cached_property
    def lam(self) -> float:
        """The rate max(eta, rho) of the result, lambda."""
        return max(self.detectability.rate, self.observer.rate)

    @cached_property
    def factors(self) -> Triple:
        r"""Factors from the bounds of the estimate's parts to bounds of its error.

        :math:`c_p \underline c_p^{-1/a}` (without :math:`\eta^N`),
        :math:`c_w \bar\eta\, \underline c_w^{-1/a}` and
        :math:`c_v \bar\eta\, \underline c_v^{-1/a}`.
        """
        c_p, c_w, c_v = self.detectability.constants
        inverse = [
            each[0] ** (-1.0 / self.cost.exponent)
            for each in (self.cost.prior, self.cost.disturbance, self.cost.noise)
        ]
        return (c_p * inverse[0], c_w * self.eta_bar * inverse[1], c_v * self.eta_bar * inverse[2])

    def terms(self, *, full: bool = True) -> Array:
        """What C_i'(N) or C_i''(N) is the sum of."""
        c_p, c_w, c_v = self.detectability.constants
        eta, N = self.detectability.rate, self.horizon
        prior, disturbance, noise = self.factors
        if full:
            prior *= eta**N
            observer = [c_p * (eta / self.lam) ** N * C for C in self.observer.constants]
            own = [0.0, c_w, c_v]
        else:
            observer, own = [0.0, 0.0, 0.0], [c_p, c_w, c_v]
        rows = [[_product(f, C) for C in self.C_bar] for f in (prior, disturbance, noise)]
        return np.array([*rows, observer, own])

    @cached_property
    def C_prime(self) -> Triple:  # noqa: N802
        """The constants C_1'(N), C_2'(N), C_3'(N), for t >= N."""
        return _triple(self.terms().sum(axis=0))

    @cached_property
    def C_double_prime(self) -> Triple:  # noqa: N802
        """The constants C_1''(N), C_2''(N), C_3''(N), for t < N."""
        return _triple(self.terms(full=False).sum(axis=0))

    @cached_property
    def C(self) -> Triple:  # noqa: N802
        """C_1, C_2, C_3 of (eq:RGES_result)."""
        pairs = zip(self.C_prime, self.C_double_prime, strict=True)
        return _triple([max(pair) for pair in pairs])

    @cached_property
    def result(self) -> DecayingSums:
        """(eq:RGES_result): the estimator's own robust stability."""
        return DecayingSums(self.lam, *self.C)

    def dominating(self) -> tuple[str, str, str]:
        """Which term is the largest in each of C_1, C_2, C_3; names of `TERMS`."""
        names = []
        for i in range(3):
            full = self.C_prime[i] >= self.C_double_prime[i]
            names.append(TERMS[int(np.argmax(self.terms(full=full)[:, i]))])
        return names[0], names[1], names[2]

    def cost_bound(self, initial: float, disturbances: ArrayLike, noises: ArrayLike) -> Array:
        """The lemma's bound of the estimate's cost, (eq:lem_1), at t = 0, ..., T."""
        start, w, v = lengths(initial, disturbances, noises)
        C_p, C_w, C_v = self.observer.constants
        a, rho = self.cost.exponent, self.observer.rate
        first: Array = self.rho_bar_1 * (C_p * start * rho ** np.arange(w.size + 1.0)) ** a
        second: Array = (C_w * decaying_sums(rho, w)) ** a + (C_v * decaying_sums(rho, v)) ** a
        return self.c_bar * (first + self.rho_bar_2 * second)


def theorem(
    detectability: DecayingSums, observer: DecayingSums, cost: CostConstants, *, kappa: float,
    lipschitz: float, horizon: int,
) -> TheoremConstants:
    """Compute the theorem's constants from those of its assumptions.

    Parameters
    ----------
    detectability : DecayingSums
        eta, c_p, c_w, c_v of (eq:eIOSS).
    observer : DecayingSums
        rho, C_p, C_w, C_v of (eq:RGES), with C_v > 0; a larger C_v than the smallest one
        may give smaller constants, see `tighten`.
    cost : CostConstants
        a and the constants of (eq:exp_bounds), from ``cost.constants``.
    kappa : float
        Of (eq:kappa); 0 for an observer that never corrects.
    lipschitz : float
        L_h, in units of the output per unit of the state.
    horizon : int
        N >= 1.

    Raises
    ------
    OptionError
        If a constant is outside of its range.

    Examples
    --------
    >>> from qpmhe.certificates.decay import DecayingSums
    >>> from qpmhe.costs import CostConstants
    >>> half = DecayingSums(0.5, 1.0, 2.0, 1.0)
    >>> cost = CostConstants(2.0, (1.0, 1.0), (1.0, 1.0), (1.0, 1.0))
    >>> constants = theorem(half, half, cost, kappa=0.0, lipschitz=1.0, horizon=1)
    >>> constants.c_bar, constants.rho_bar_1, constants.rho_bar_2
    (9.0, 4.0, 1.0)
    """
    count("horizon", horizon, 1)
    for name, value in (("kappa", kappa), ("lipschitz", lipschitz)):
        if not 0.0 <= value < math.inf:
            raise OptionError(f"{name} is {value!r}; expected a finite number >= 0.")
    if not 0.0 < cost.exponent < math.inf:
        raise OptionError(f"the cost's exponent is {cost.exponent!r}; expected a number > 0.")
    for name in ("prior", "disturbance", "noise"):
        lower, upper = getattr(cost, name)
        if not 0.0 < lower <= upper < math.inf:
            raise OptionError(
                f"the cost's constants of its {name} term are {(lower, upper)!r}; expected "
                "0 < lower <= upper, both finite."
            )
    if not observer.noise > 0.0:
        raise OptionError(
            "the observer's C_v is 0, which makes L_bar = max(L_h, 1/C_v) infinite; pass a "
            "larger one, which holds as well, such as 1 / L_h."
        )
    return TheoremConstants(
        int(horizon), detectability, observer, cost, float(kappa), float(lipschitz)
    )


def _power(base: float, exponent: float) -> float:
    try:
        return float(base**exponent)
    except OverflowError:
        return math.inf


def _product(one: float, other: float) -> float:
    """Nothing times something unbounded is nothing."""
    return 0.0 if one == 0.0 or other == 0.0 else one * other


def _triple(values: Array | list[float]) -> Triple:
    first, second, third = (float(value) for value in values)
    return first, second, third


@dataclass(frozen=True)
class Sizes:
    """Largest |x_0 - z_0|, |w| and |v| for which a bound is made tight.

    An `OptionError` is raised if one is negative or not finite, or all are zero.
    """

    initial: float = 1.0
    disturbance: float = 1.0
    noise: float = 1.0

    def __post_init__(self) -> None:
        values = (self.initial, self.disturbance, self.noise)
        if not all(0.0 <= value < math.inf for value in values) or not any(values):
            raise OptionError(f"sizes are {values}; expected finite numbers >= 0, not all 0.")


def level(bound: DecayingSums, sizes: Sizes) -> float:
    """What the bound cannot exceed at any time: its start, and what its sums tend to."""
    return bound.initial * sizes.initial + bound.limit(sizes.disturbance, sizes.noise)


def tighten(
    detectabilities: Iterable[DecayingSums], observers: Iterable[DecayingSums], cost: CostConstants,
    *, kappa: float, lipschitz: float, horizon: int, sizes: Sizes | None = None,
    searched: int = _SEARCHED,
) -> TheoremConstants:
    r"""The theorem's constants with the smallest `level`; their fields hold the free choices.

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
        As for `theorem`.
    sizes : Sizes, optional
        For which errors and noises the result is to be tight; all 1 if left out.
    searched : int
        In how many pairs of the two to search, the most promising ones first.

    Raises
    ------
    OptionError
        As for `theorem`, or if there is nothing to choose from.
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
    tried: Callable[[DecayingSums, DecayingSums], float], detectability: DecayingSums,
    observer: DecayingSums, lipschitz: float,
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
