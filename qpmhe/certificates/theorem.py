"""The theorem's constants, as its proof gives them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import finite, shown

from .._checks import Array, count, numbers, positive
from ..costs import CostConstants
from ..errors import OptionError, ShapeError


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
    initial, disturbance, noise : float
        c_p >= 1, c_w >= 0, and c_v >= 0 in units of the state per unit of the output. They may
        be infinite. An `OptionError` names one that is outside of its range.
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

    def bound(
        self, initial: float | np.floating[Any], disturbances: ArrayLike, noises: ArrayLike
    ) -> Array:
        """The right-hand side at t = 0, ..., T, (T + 1,), from lengths (T,) of w and v.

        A `ShapeError` or an `OptionError` names lengths that are negative or not equally many.
        """
        start = checked_length("initial", initial)
        w, v = numbers("disturbances", disturbances), numbers("noises", noises)
        if w.ndim != 1 or w.shape != v.shape:
            raise ShapeError(
                f"disturbances have shape {w.shape} and noises {v.shape}; expected (T,) each, "
                "their Euclidean lengths at one sample after another."
            )
        if (w < 0.0).any() or (v < 0.0).any():
            raise OptionError("a length is negative; expected Euclidean lengths, all >= 0.")
        if not all(map(math.isfinite, self.constants)):
            return np.full(len(w) + 1, np.inf)
        decay: Array = self.initial * start * self.rate ** np.arange(len(w) + 1.0)
        return decay + self.rate * decaying_sums(self.rate, self.disturbance * w + self.noise * v)

    def limit(self, disturbance: float, noise: float) -> float:
        """The limit of the bound as t grows, for lengths |w| and |v| up to these."""
        w, v = checked_length("disturbance", disturbance), checked_length("noise", noise)
        if not all(map(math.isfinite, self.constants)):
            return math.inf
        return self.rate / (1.0 - self.rate) * (self.disturbance * w + self.noise * v)


def decaying_sums(rate: float, entering: Array) -> Array:
    """s(t) = sum of rate^(tau - 1) entering(t - tau) over tau = 1, ..., t; at t = 0, ..., T."""
    sums = np.zeros(len(entering) + 1)
    for t, value in enumerate(entering):
        sums[t + 1] = rate * sums[t] + value
    return sums


def checked_length(name: str, value: Any) -> float:
    """A finite number >= 0, checked."""
    length = finite(value.item() if isinstance(value, np.ndarray) and not value.ndim else value)
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
    r"""All constants of the theorem for one horizon, with the paper's symbols.

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
        The constant of (eq:kappa); 0 for an observer that never corrects.
    lipschitz : float
        L_h, in units of the output per unit of the state.
    horizon : int
        N >= 1.
    model_lipschitz : float, optional
        L_f, for an observer that is projected onto X in the metric in which it contracts. Its
        corrections have no kappa; :math:`(\rho + L_f + 1 / C_w) / \bar L` takes its place.

    Attributes
    ----------
    L_bar, kappa_bar, c_bar, rho_bar_1, rho_bar_2, eta_bar : float
        As in the proof; kappa_bar is kappa or what takes its place.
    C_bar, C_prime, C_double_prime, C : (float, float, float)
        Those of (eq:bound_hat_x), those for t >= N and for t < N, and the larger ones.
    lam : float
        The rate of the result, max(eta, rho).
    result : DecayingSums
        (eq:RGES_result): the estimator's own robust stability.

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
    model_lipschitz: float | None = field(default=None, kw_only=True)
    L_bar: float = field(init=False)
    kappa_bar: float = field(init=False)
    c_bar: float = field(init=False)
    rho_bar_1: float = field(init=False)
    rho_bar_2: float = field(init=False)
    C_bar: Triple = field(init=False)
    eta_bar: float = field(init=False)
    C_prime: Triple = field(init=False)
    C_double_prime: Triple = field(init=False)
    C: Triple = field(init=False)
    lam: float = field(init=False)
    result: DecayingSums = field(init=False)

    def __post_init__(self) -> None:
        self._check()
        cost, a, N = self.cost, self.cost.exponent, self.horizon
        eta, (c_p, c_w, c_v) = self.detectability.rate, self.detectability.constants
        rho, (C_p, C_w, C_v) = self.observer.rate, self.observer.constants
        L_bar, kappa_bar = max(self.lipschitz, 1.0 / C_v), self.kappa
        if self.model_lipschitz is not None:
            kappa_bar = (rho + self.model_lipschitz + 1.0 / C_w) / L_bar
        c_bar = _power(3.0 * L_bar, a) * (
            cost.disturbance[1] * _power(kappa_bar, a) + cost.noise[1]
        )
        rho_bar_2 = _geometric(-a * math.log(rho), N)
        rho_bar_1 = rho_bar_2 * _power(rho, -a)
        later = _power(3.0 * c_bar * rho_bar_2, 1.0 / a) / rho
        C_bar = (
            C_p * _power(3.0 * c_bar * rho_bar_1, 1.0 / a), _product(C_w, later), C_v * later
        )
        eta_bar, lam = eta / (1.0 - eta), max(eta, rho)
        # From the bounds of the estimate's parts to bounds of its error.
        prior, disturbance, noise = (
            each[0] ** (-1.0 / a) for each in (cost.prior, cost.disturbance, cost.noise)
        )
        window = eta_bar * (c_w * disturbance + c_v * noise)
        begun = c_p * (eta / lam) ** N
        C_prime = tuple(
            _product(c_p * prior * eta**N + window, bar) + begun * own + direct
            for bar, own, direct in zip(C_bar, (C_p, C_w, C_v), (0.0, c_w, c_v), strict=True)
        )
        C_double_prime = tuple(
            _product(c_p * prior + window, bar) + direct
            for bar, direct in zip(C_bar, (c_p, c_w, c_v), strict=True)
        )
        C = tuple(map(max, C_prime, C_double_prime))
        vars(self).update(
            L_bar=L_bar, kappa_bar=kappa_bar, c_bar=c_bar, rho_bar_1=rho_bar_1,
            rho_bar_2=rho_bar_2, C_bar=C_bar, eta_bar=eta_bar, C_prime=C_prime,
            C_double_prime=C_double_prime, C=C, lam=lam, result=DecayingSums(lam, *C),
        )

    def _check(self) -> None:
        count("horizon", self.horizon, 1)
        checked_length("kappa", self.kappa)
        checked_length("lipschitz", self.lipschitz)
        positive("the cost's exponent", self.cost.exponent)
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
        if self.model_lipschitz is not None:
            checked_length("model_lipschitz", self.model_lipschitz)
            positive("the observer's C_w", self.observer.disturbance)


def _geometric(slope: float, count: int) -> float:
    """The sum of exp(k slope) over k = 0, ..., count - 1, accurate for small slopes."""
    try:
        return math.expm1(count * slope) / math.expm1(slope)
    except OverflowError:
        return math.inf


def _power(base: float, exponent: float) -> float:
    try:
        return float(base**exponent)
    except OverflowError:
        return math.inf


def _product(one: float, other: float) -> float:
    """Nothing times something unbounded is nothing."""
    return 0.0 if one == 0.0 or other == 0.0 else one * other
