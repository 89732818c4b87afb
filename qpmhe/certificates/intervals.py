"""Interval arithmetic with outward rounding, and derivatives by it, over many cells at once."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import Array

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
    """

    __slots__ = ("high", "low")

    def __init__(self, low: Any, high: Any) -> None:
        self.low: Array = np.asarray(low, np.float64)
        self.high: Array = np.asarray(high, np.float64)

    @classmethod
    def of(cls, value: Any) -> Interval:
        """The interval itself, or a number as one."""
        return value if isinstance(value, Interval) else cls(value, value)

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
        return Interval(_sum(self.low, other.low, -np.inf), _sum(self.high, other.high, np.inf))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Interval:
        return self + (-Interval.of(other))

    def __rsub__(self, other: Any) -> Interval:
        return Interval.of(other) + (-self)

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
        return self * Interval.of(other).reciprocal()

    def __rtruediv__(self, other: Any) -> Interval:
        quotient: Interval = self.reciprocal() * other
        return quotient

    def reciprocal(self) -> Interval:
        """1 / s."""
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
        """s^k for an integer k, by squares."""
        if exponent < 0:
            return self.power(-exponent).reciprocal()
        if exponent == 0:
            return Interval(np.ones_like(self.low), np.ones_like(self.low))
        if exponent % 2 == 0:
            return self.power(exponent // 2).square()
        if exponent == 1:
            return self
        # Odd powers increase: the ends are those of the ends.
        low, high = Interval.of(self.low), Interval.of(self.high)
        return Interval((low * low.power(exponent - 1)).low, (high * high.power(exponent - 1)).high)

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
            return first <= high + slack - phase

        return Interval(
            np.where(reached(top + 0.5), -1.0, np.maximum(least, -1.0)),
            np.where(reached(top), 1.0, np.minimum(most, 1.0)),
        )


class Jet:
    r"""Enclosures of a function, its gradient and its Hessian over cells.

    NumPy calls the methods of the entries of an object array: functions that are written
    with NumPy's arithmetic, indexing, ``dot``, ``stack``, ``sin`` and the like take object
    arrays of jets as they take floats. What needs a decision that is not the same on a whole
    cell (a comparison, a rounding, a conversion to float) raises.
    """

    __slots__ = ("gradient", "hessian", "value")

    def __init__(self, value: Interval, gradient: Interval, hessian: Interval) -> None:
        self.value, self.gradient, self.hessian = value, gradient, hessian

    def __repr__(self) -> str:
        return f"Jet({self.value})"

    def __neg__(self) -> Jet:
        return Jet(-self.value, -self.gradient, -self.hessian)

    def __pos__(self) -> Jet:
        return self

    def __add__(self, other: Any) -> Any:
        if isinstance(other, Jet):
            return Jet(
                self.value + other.value, self.gradient + other.gradient,
                self.hessian + other.hessian,
            )
        number = _number(other)
        if number is None:
            return NotImplemented
        if isinstance(number, float) and number == 0.0:
            return self
        return Jet(self.value + number, self.gradient, self.hessian)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return NotImplemented if _number(other, jets=True) is None else self + (-other)

    def __rsub__(self, other: Any) -> Any:
        return NotImplemented if _number(other) is None else (-self) + other

    def __mul__(self, other: Any) -> Any:
        if other is self:
            return self**2
        if isinstance(other, Jet):
            mixed = _outer(self.gradient, other.gradient)
            return Jet(
                self.value * other.value,
                self.gradient * other.value + other.gradient * self.value,
                self.hessian * other.value + other.hessian * self.value + mixed + _turned(mixed),
            )
        number = _number(other)
        if number is None:
            return NotImplemented
        return Jet(self.value * number, self.gradient * number, self.hessian * number)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        if isinstance(other, Jet):
            return self * other._reciprocal()
        number = _number(other)
        if number is None:
            return NotImplemented
        return self * Interval.of(number).reciprocal()

    def __rtruediv__(self, other: Any) -> Any:
        return NotImplemented if _number(other) is None else self._reciprocal() * other

    def _reciprocal(self) -> Jet:
        inverse = self.value.reciprocal()
        square = inverse.square()
        return self._composed(inverse, -square, 2.0 * (square * inverse))

    def __pow__(self, exponent: Any) -> Any:
        if isinstance(exponent, Jet):
            return (exponent * self.log()).exp()
        number = _number(exponent)
        if number is None:
            return NotImplemented
        if float(number).is_integer() and abs(number) < 64:
            k = int(number)
            if k == 0:
                return self * 0.0 + 1.0
            if k == 1:
                return self
            first = float(k) * self.value.power(k - 1)
            return self._composed(
                self.value.power(k), first, float(k * (k - 1)) * self.value.power(k - 2)
            )
        return (number * self.log()).exp()

    def __rpow__(self, base: Any) -> Any:
        number = _number(base)
        if number is None:
            return NotImplemented
        if not isinstance(number, float) or number <= 0.0:
            raise OutsideDomainError(f"a power of {number}")
        return (self * Interval.of(number).log()).exp()

    def _composed(self, value: Interval, first: Interval, second: Interval) -> Jet:
        """A function of this jet, from its values and two derivatives over the jet's value."""
        return Jet(
            value, self.gradient * first,
            self.hessian * first + _outer(self.gradient, self.gradient) * second,
        )

    def sqrt(self) -> Jet:
        """The square root; its derivatives need values above zero."""
        if not self.value.positive():
            raise OutsideDomainError("a square root that may be of zero has no derivative there")
        root = self.value.sqrt()
        first = (2.0 * root).reciprocal()
        return self._composed(root, first, -(first / (2.0 * self.value)))

    def exp(self) -> Jet:
        """The exponential."""
        value = self.value.exp()
        return self._composed(value, value, value)

    def log(self) -> Jet:
        """The natural logarithm."""
        inverse = self.value.log(), self.value.reciprocal()
        return self._composed(*inverse, -inverse[1].square())

    def sin(self) -> Jet:
        """The sine."""
        sine, cosine = self.value.sin(), self.value.cos()
        return self._composed(sine, cosine, -sine)

    def cos(self) -> Jet:
        """The cosine."""
        sine, cosine = self.value.sin(), self.value.cos()
        return self._composed(cosine, -sine, -cosine)

    def tanh(self) -> Jet:
        """The hyperbolic tangent."""
        value = self.value.tanh()
        first = 1.0 - value.square()
        first = Interval(np.maximum(first.low, 0.0), first.high)
        return self._composed(value, first, -2.0 * (value * first))

    def arctan(self) -> Jet:
        """The arc tangent."""
        first = (1.0 + self.value.square()).reciprocal()
        return self._composed(self.value.arctan(), first, -2.0 * (self.value * first.square()))

    def arctan2(self, other: Any) -> Jet:
        """The angle of the point (other, self), off the cut along negative abscissas."""
        abscissa = other if isinstance(other, Jet) else self * 0.0 + other
        if abscissa.value.positive():
            angle: Jet = (self / abscissa).arctan()
            return angle
        quarter = Interval(np.nextafter(0.5 * np.pi, 0.0), np.nextafter(0.5 * np.pi, 2.0))
        if not (self.value.positive() or self.value.negative()):
            raise OutsideDomainError("an angle that may jump, or be of a point at the origin")
        side = quarter if self.value.positive() else -quarter
        return Jet.__add__(-(abscissa / self).arctan(), side)  # type: ignore[no-any-return]

    @property
    def real(self) -> Jet:
        """The jet itself."""
        return self

    def __abs__(self) -> Jet:
        if self.value.positive():
            return self
        if self.value.negative():
            return -self
        raise OutsideDomainError("an absolute value that may be of zero has no derivative there")

    def _compared(self, other: Any, holds: Callable[[Any, Any], Any]) -> bool:
        bound = other.value if isinstance(other, Jet) else Interval.of(_number(other))
        ends = self.value.low, self.value.high, bound.low, bound.high
        if any(np.isnan(end).any() for end in ends):
            raise OutsideDomainError("a comparison with what is not a number")
        # Both orders of the ends must agree, on all cells, and with room: at equality there
        # may be a kink.
        outcomes = {
            bool(outcome)
            for ends in ((self.value.low, bound.high), (self.value.high, bound.low))
            for outcome in np.atleast_1d(holds(*ends)).tolist()
        }
        touching = np.any((self.value.low <= bound.high) & (bound.low <= self.value.high))
        if len(outcomes) != 1 or touching:
            raise OutsideDomainError("a comparison whose outcome is not the same on the set")
        return outcomes.pop()

    def __bool__(self) -> bool:
        raise OutsideDomainError("a truth value of something that is not one number")

    def __float__(self) -> float:
        raise OutsideDomainError("a conversion to float, as by math functions or float arrays")


# What NumPy calls by name, composed of the above.
for _name, _function in {
    "square": lambda s: s**2,
    "expm1": lambda s: s.exp() - 1.0,
    "log1p": lambda s: (s + 1.0).log(),
    "tan": lambda s: s.sin() / s.cos(),
    "sinh": lambda s: (s.exp() - (-s).exp()) * 0.5,
    "cosh": lambda s: (s.exp() + (-s).exp()) * 0.5,
    "conjugate": lambda s: s,
}.items():
    setattr(Jet, _name, _function)
for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    _holds = getattr(operator, _name)
    setattr(Jet, f"__{_name}__", lambda s, other, holds=_holds: s._compared(other, holds))


def _number(value: Any, *, jets: bool = False) -> Any:
    """A real number as a float; intervals (and jets, if wanted) as they are; else None."""
    if isinstance(value, Interval) or (jets and isinstance(value, Jet)):
        return value
    if isinstance(value, (bool, int, float, np.number, np.bool_)) and not np.iscomplexobj(value):
        return float(value)
    return None


def _outer(a: Interval, b: Interval) -> Interval:
    if a is b:
        # The diagonal as squares, which are not negative.
        product = a[:, None] * b[None]
        squares, which = a.square(), np.arange(len(a.low))
        low, high = product.low.copy(), product.high.copy()
        low[which, which], high[which, which] = squares.low, squares.high
        return Interval(low, high)
    return a[:, None] * b[None]


def _turned(a: Interval) -> Interval:
    return Interval(np.swapaxes(a.low, 0, 1), np.swapaxes(a.high, 0, 1))


def variables(lower: Array, upper: Array) -> NDArray[np.object_]:
    """The coordinates of cells as jets."""
    cells, count = lower.shape
    made = np.empty(count, dtype=object)
    none = np.zeros((count, count, cells))
    for j in range(count):
        gradient = np.zeros((count, cells))
        gradient[j] = 1.0
        made[j] = Jet(
            Interval(lower[:, j], upper[:, j]), Interval(gradient, gradient), Interval(none, none)
        )
    return made
