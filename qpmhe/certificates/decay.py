"""Bounds by decaying sums: the shape of (eq:eIOSS), (eq:RGES) and (eq:RGES_result)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import finite, shown

from .._checks import Array, numbers, positive
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
        for name in ("rate", "initial", "disturbance", "noise"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
                raise OptionError(f"{name} is {value!r}; expected a number.")
            object.__setattr__(self, name, float(value))
        if not 0.0 < self.rate < 1.0:
            raise OptionError(
                f"rate is {self.rate!r}; expected a number in (0, 1): without decay there is "
                "no bound by decaying sums."
            )
        if not self.initial >= 1.0:
            raise OptionError(
                f"initial is {self.initial!r}; expected at least 1, since at t = 0 the bound "
                "says |e(0)| <= initial |e(0)|."
            )
        for name in ("disturbance", "noise"):
            if not getattr(self, name) >= 0.0:
                raise OptionError(f"{name} is {getattr(self, name)!r}; expected at least 0.")

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
