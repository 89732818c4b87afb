"""The theorem's constants and its lemma's (lem:boundedness_of_J), as the proof gives them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import finite, shown

from .._checks import Array, count, numbers, positive
from ..costs import CostConstants
from ..errors import OptionError, ShapeError


@dataclass(frozen=True)
class Sizes:
    """Largest |w| and |v| for which bounds are made tight, and called vacuous or not.

    An `OptionError` is raised if one is negative or not finite, or both are zero.
    """

    disturbance: float = 1.0
    noise: float = 1.0

    def __post_init__(self) -> None:
        w = checked_length("disturbance", self.disturbance)
        if not (checked_length("noise", self.noise) or w):
            raise OptionError("disturbance and noise are both 0; expected one of them above 0.")


@dataclass(frozen=True)
class DecayingSums:
    r"""The four constants of a bound with decaying sums.

    .. math::
        |e(t)| \le c_p |e(0)| r^t + c_w \sum_{\tau=1}^t r^\tau |w(t-\tau)|
        + c_v \sum_{\tau=1}^t r^\tau |v(t-\tau)|

    With e, w and v the differences of two trajectories, of their disturbances and of their
    outputs, this is detectability (eq:eIOSS); with e an estimator's error, it is
    robust exponential stability (eq:RGES), and the theorem's result (eq:RGES_result).

    Parameters
    ----------
    rate : float
        r in (0, 1), per step: eta, rho or lambda of the paper.
    initial : float
        c_p >= 1 (without unit); less contradicts the bound at t = 0.
    disturbance : float
        c_w >= 0 (without unit).
    noise : float
        c_v >= 0, in units of the state per unit of the output.

    Raises
    ------
    OptionError
        If a constant is outside of its range. Infinite ones are allowed: they bound nothing.
    """

    rate: float
    initial: float
    disturbance: float
    noise: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "rate", checked_rate("rate", self.rate))
        # Less than 1 contradicts the bound at t = 0, |e(0)| <= initial |e(0)|.
        for name, least in (("initial", 1.0), ("disturbance", 0.0), ("noise", 0.0)):
            value = getattr(self, name)
            number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
            if not number or not value >= least:
                raise OptionError(f"{name} is {value!r}; expected a number >= {least:g}.")
            object.__setattr__(self, name, float(value))

    @property
    def constants(self) -> tuple[float, float, float]:
        """c_p, c_w and c_v."""
        return self.initial, self.disturbance, self.noise

    def bound(self, initial: ArrayLike, disturbances: ArrayLike, noises: ArrayLike) -> Array:
        """The right-hand side at t = 0, ..., T, (T + 1, ...).

        Parameters
        ----------
        initial : float or (...) array_like
            |e(0)|; of several runs at once, if an array.
        disturbances, noises : (T, ...) array_like
            |w(0)|, ..., |w(T-1)| and |v(0)|, ..., |v(T-1)|.

        Raises
        ------
        ShapeError, InvalidInputError
            If these are not nonnegative, finite and of one length.
        """
        start, w, v = (
            numbers(name, value) for name, value in
            (("initial", initial), ("disturbances", disturbances), ("noises", noises))
        )
        if w.ndim != 1 + start.ndim or w.shape != v.shape:
            raise ShapeError(
                f"disturbances have shape {w.shape} and noises {v.shape}; expected (T,) each, "
                "their Euclidean lengths at one sample after another."
            )
        if any((each < 0.0).any() for each in (start, w, v)):
            raise OptionError("a length is negative; expected Euclidean lengths, all >= 0.")
        if not all(math.isfinite(each) for each in self.constants):
            return np.full((len(w) + 1, *start.shape), np.inf)
        sums = decaying_sums(self.rate, self.disturbance * w + self.noise * v)
        decay: Array = self.rate ** np.arange(len(w) + 1.0)
        return np.multiply.outer(decay, self.initial * start) + self.rate * sums

    def limit(self, disturbance: float, noise: float) -> float:
        """What the bound tends to for |w| <= disturbance and |v| <= noise as t grows.

        An `OptionError` names a length that is negative or not finite.
        """
        checked_length("disturbance", disturbance)
        checked_length("noise", noise)
        if not all(math.isfinite(each) for each in self.constants):
            return math.inf
        gain = self.rate / (1.0 - self.rate)
        return gain * (self.disturbance * disturbance + self.noise * noise)


def decaying_sums(rate: float, entering: Array) -> Array:
    """s(t) = sum of rate^(tau - 1) entering(t - tau) over tau = 1, ..., t; at t = 0, ..., T."""
    sums = np.zeros((len(entering) + 1, *entering.shape[1:]))
    for t, value in enumerate(entering):
        sums[t + 1] = rate * sums[t] + value
    return sums


def checked_length(name: str, value: Any) -> float:
    """A finite number >= 0, checked."""
    length = finite(value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value)
    if length is None or length < 0.0:
        raise OptionError(
            f"{name} is {shown(value)}; expected a finite number >= 0, which bounds a Euclidean "
            "length."
        )
    return length


def checked_rate(name: str, value: float) -> float:
    """A rate in (0, 1), checked."""
    rate = positive(name, value)
    if rate >= 1.0:
        raise OptionError(f"{name} is {value!r}; expected a number in (0, 1).")
    return rate


Triple = tuple[float, float, float]


@dataclass(frozen=True)
class TheoremConstants:
    """All constants of the theorem for one horizon, with the paper's symbols.

    Triples are in the order initial error, disturbance, noise: p, w, v and 1, 2, 3 in the paper.

    Parameters
    ----------
    detectability : DecayingSums
        eta, c_p, c_w, c_v of (eq:eIOSS).
    observer : DecayingSums
        rho, C_p, C_w, C_v of (eq:RGES), with C_v > 0.
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
    >>> from qpmhe.certificates.theorem import DecayingSums, TheoremConstants
    >>> from qpmhe.costs import CostConstants
    >>> half = DecayingSums(0.5, 1.0, 2.0, 1.0)
    >>> cost = CostConstants(2.0, (1.0, 1.0), (1.0, 1.0), (1.0, 1.0))
    >>> constants = TheoremConstants(half, half, cost, kappa=0.0, lipschitz=1.0, horizon=1)
    >>> constants.c_bar, constants.rho_bar_1, constants.rho_bar_2
    (9.0, 4.0, 1.0)
    """

    detectability: DecayingSums
    observer: DecayingSums
    cost: CostConstants
    kappa: float = field(kw_only=True)
    lipschitz: float = field(kw_only=True)
    horizon: int = field(kw_only=True)

    def __post_init__(self) -> None:
        count("horizon", self.horizon, 1)
        for name, value in (("kappa", self.kappa), ("lipschitz", self.lipschitz)):
            if not 0.0 <= value < math.inf:
                raise OptionError(f"{name} is {value!r}; expected a finite number >= 0.")
        if not 0.0 < self.cost.exponent < math.inf:
            raise OptionError(
                f"the cost's exponent is {self.cost.exponent!r}; expected a number > 0."
            )
        for name in ("prior", "disturbance", "noise"):
            lower, upper = getattr(self.cost, name)
            if not 0.0 < lower <= upper < math.inf:
                raise OptionError(
                    f"the cost's constants of its {name} term are {(lower, upper)!r}; expected "
                    "0 < lower <= upper, both finite."
                )
        if not self.observer.noise > 0.0:
            raise OptionError(
                "the observer's C_v is 0, which makes L_bar = max(L_h, 1/C_v) infinite; pass a "
                "larger one, which holds as well, such as 1 / L_h."
            )

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
    def C_prime(self) -> Triple:  # noqa: N802
        """The constants C_1'(N), C_2'(N), C_3'(N), for t >= N."""
        c_p, c_w, c_v = self.detectability.constants
        eta, N = self.detectability.rate, self.horizon
        start = [c_p * (eta / self.lam) ** N * C for C in self.observer.constants]
        return self._sums(eta**N, (start[0], start[1] + c_w, start[2] + c_v))

    @cached_property
    def C_double_prime(self) -> Triple:  # noqa: N802
        """The constants C_1''(N), C_2''(N), C_3''(N), for t < N."""
        return self._sums(1.0, self.detectability.constants)

    def _sums(self, decay: float, own: Triple) -> Triple:
        """What the bounds of the estimate's parts come to, and what else there is."""
        c_p, c_w, c_v = self.detectability.constants
        # From the bounds of the estimate's parts to bounds of its error.
        prior, disturbance, noise = (
            each[0] ** (-1.0 / self.cost.exponent)
            for each in (self.cost.prior, self.cost.disturbance, self.cost.noise)
        )
        factor = c_p * prior * decay + self.eta_bar * (c_w * disturbance + c_v * noise)
        first, second, third = (
            _product(factor, C) + each for C, each in zip(self.C_bar, own, strict=True)
        )
        return first, second, third

    @cached_property
    def C(self) -> Triple:  # noqa: N802
        """C_1, C_2, C_3 of (eq:RGES_result)."""
        first, second, third = map(max, self.C_prime, self.C_double_prime)
        return first, second, third

    @cached_property
    def result(self) -> DecayingSums:
        """(eq:RGES_result): the estimator's own robust stability."""
        return DecayingSums(self.lam, *self.C)


def _power(base: float, exponent: float) -> float:
    try:
        return float(base**exponent)
    except OverflowError:
        return math.inf


def _product(one: float, other: float) -> float:
    """Nothing times something unbounded is nothing."""
    return 0.0 if one == 0.0 or other == 0.0 else one * other
