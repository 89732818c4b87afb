"""Interval arithmetic with outward rounding, over many cells at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Interval", "OutsideDomainError"]

Array = NDArray[np.float64]

# Errors of elementary functions in units in the last place: the C library and NumPy's own
# vector versions stay within 4.
_LIBRARY_ULPS = 8
_TWO_PI = 2.0 * np.pi
# How far below the real phase the rounded one may lie, relative to it; pi itself is rounded.
_PHASE_ERROR = 1e-14


class OutsideDomainError(ArithmeticError):
    """An operation that is not defined, or not smooth, on all of an interval."""


def _down(value: Array, ulps: int = 1) -> Array:
    for _ in range(ulps):
        value = np.nextafter(value, -np.inf)
    return value


def _up(value: Array, ulps: int = 1) -> Array:
    for _ in range(ulps):
        value = np.nextafter(value, np.inf)
    return value


def _sum(a: Array, b: Array, direction: float) -> Array:
    total = a + b
    # Adding zero is exact: what is constant or absent stays so.
    return np.where((a == 0.0) | (b == 0.0), total, np.nextafter(total, direction))


class Interval:
    r"""Intervals :math:`[\ell, u]`, elementwise over arrays of equal shape.

    The result of every operation holds the exact results for all members of its operands:
    each is computed in the nearest rounding, and then moved outward by the next floating
    point number, or by a few of them for functions of the C library.

    Parameters
    ----------
    low, high : array
        l and u; l <= u.
    """

    __slots__ = ("high", "low")

    def __init__(self, low: Any, high: Any) -> None:
        self.low: Array = np.asarray(low, np.float64)
        self.high: Array = np.asarray(high, np.float64)

    @classmethod
    def of(cls, value: Any) -> Interval:
        """The interval itself, or a number as one.

        Parameters
        ----------
        value : Interval, float or array
            What to make one of.
        """
        return value if isinstance(value, Interval) else cls(value, value)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of low and of high."""
        return np.broadcast_shapes(self.low.shape, self.high.shape)

    def __getitem__(self, index: Any) -> Interval:
        return Interval(self.low[index], self.high[index])

    def __repr__(self) -> str:
        return f"Interval({self.low.tolist()}, {self.high.tolist()})"

    @property
    def middle(self) -> Array:
        """A number near the middle."""
        return 0.5 * self.low + 0.5 * self.high

    @property
    def radius(self) -> Array:
        """How far from `middle` members can be, rounded up."""
        middle = self.middle
        return _up(np.maximum(_up(self.high - middle), _up(middle - self.low)))

    @property
    def magnitude(self) -> Array:
        """The largest absolute value of a member."""
        return np.maximum(np.abs(self.low), np.abs(self.high))

    def positive(self) -> bool:
        """Whether every member is above zero."""
        return bool(np.all(self.low > 0.0))

    def negative(self) -> bool:
        """Whether every member is below zero."""
        return bool(np.all(self.high < 0.0))

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)

    def __add__(self, other: Any) -> Interval:
        other = Interval.of(other)
        return Interval(
            _sum(self.low, other.low, -np.inf), _sum(self.high, other.high, np.inf)
        )

    __radd__ = __add__

    def __sub__(self, other: Any) -> Interval:
        difference: Interval = self + (-Interval.of(other))
        return difference

    def __rsub__(self, other: Any) -> Interval:
        difference: Interval = Interval.of(other) + (-self)
        return difference

    def __mul__(self, other: Any) -> Interval:
        if other is self:
            squared: Interval = self.square()
            return squared
        other = Interval.of(other)
        products = (
            self.low * other.low, self.low * other.high,
            self.high * other.low, self.high * other.high,
        )
        low = np.minimum(np.minimum(*products[:2]), np.minimum(*products[2:]))
        high = np.maximum(np.maximum(*products[:2]), np.maximum(*products[2:]))
        # Zero times anything is exactly zero: sparse derivatives stay sparse.
        zero = ((self.low == 0.0) & (self.high == 0.0)) | ((other.low == 0.0) & (other.high == 0.0))
        # But for NaN, which is no number at all.
        zero &= ~(np.isnan(self.low) | np.isnan(other.low))
        return Interval(np.where(zero, 0.0, _down(low)), np.where(zero, 0.0, _up(high)))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Interval:
        quotient: Interval = self * Interval.of(other).reciprocal()
        return quotient

    def __rtruediv__(self, other: Any) -> Interval:
        quotient: Interval = self.reciprocal() * other
        return quotient

    def reciprocal(self) -> Interval:
        """1 / s.

        Raises
        ------
        OutsideDomainError
            If zero is a member.
        """
        if np.any((self.low <= 0.0) & (self.high >= 0.0)):
            raise OutsideDomainError(f"division by a value that may be zero on the set ({self})")
        return Interval(_down(1.0 / self.high), _up(1.0 / self.low))

    def square(self) -> Interval:
        """s^2, which is not s times s of two different members."""
        least = np.where(
            (self.low <= 0.0) & (self.high >= 0.0), 0.0,
            np.minimum(np.abs(self.low), np.abs(self.high)),
        )
        most = self.magnitude
        return Interval(np.maximum(0.0, _down(least * least)), _up(most * most))

    def power(self, exponent: int) -> Interval:
        """s^k for an integer k, by squares.

        Parameters
        ----------
        exponent : int
            k.
        """
        if exponent < 0:
            return self.power(-exponent).reciprocal()
        if exponent == 0:
            return Interval(np.ones(self.shape), np.ones(self.shape))
        if exponent % 2 == 0:
            return self.power(exponent // 2).square()
        if exponent == 1:
            return self
        # Odd powers increase: the ends are those of the ends.
        low, high = Interval.of(self.low), Interval.of(self.high)
        return Interval(
            (low * low.power(exponent - 1)).low, (high * high.power(exponent - 1)).high
        )

    def _increasing(self, function: Callable[[Array], Any], ulps: int = _LIBRARY_ULPS) -> Interval:
        with np.errstate(over="ignore", under="ignore"):
            low, high = np.asarray(function(self.low)), np.asarray(function(self.high))
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise OutsideDomainError(f"a value that may be infinite on the set ({self})")
        return Interval(_down(low, ulps), _up(high, ulps))

    def sqrt(self) -> Interval:
        """The square root, of positive members."""
        if np.any(self.low < 0.0):
            raise OutsideDomainError(f"a square root of a value that may be negative ({self})")
        root = self._increasing(np.sqrt, 1)
        return Interval(np.maximum(root.low, 0.0), root.high)

    def exp(self) -> Interval:
        """The exponential."""
        value = self._increasing(np.exp)
        return Interval(np.maximum(value.low, 0.0), value.high)

    def log(self) -> Interval:
        """The natural logarithm, of positive members."""
        if np.any(self.low <= 0.0):
            raise OutsideDomainError(f"a logarithm of a value that may not be positive ({self})")
        return self._increasing(np.log)

    def arctan(self) -> Interval:
        """The arc tangent."""
        return self._increasing(np.arctan)

    def tanh(self) -> Interval:
        """The hyperbolic tangent."""
        value = self._increasing(np.tanh)
        return Interval(np.maximum(value.low, -1.0), np.minimum(value.high, 1.0))

    def sin(self) -> Interval:
        """The sine."""
        return self._wave(np.sin, 0.25)

    def cos(self) -> Interval:
        """The cosine."""
        return self._wave(np.cos, 0.0)

    def _wave(self, function: Callable[[Array], Any], top: float) -> Interval:
        """Sine or cosine: 1 at the phases top + integers, -1 half a turn away."""
        low, high = self.low / _TWO_PI, self.high / _TWO_PI
        slack = _PHASE_ERROR * (1.0 + np.maximum(np.abs(low), np.abs(high)))
        ends = np.asarray(function(self.low)), np.asarray(function(self.high))
        least = _down(np.minimum(*ends), _LIBRARY_ULPS)
        most = _up(np.maximum(*ends), _LIBRARY_ULPS)

        def reached(phase: float) -> NDArray[np.bool_]:
            first = np.ceil(low - slack - phase)
            hit: NDArray[np.bool_] = first <= high + slack - phase
            return hit

        return Interval(
            np.where(reached(top + 0.5), -1.0, np.maximum(least, -1.0)),
            np.where(reached(top), 1.0, np.minimum(most, 1.0)),
        )
