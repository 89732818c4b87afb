"""Values, gradients and Hessians of NumPy-written functions over cells, by intervals."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .intervals import Interval, OutsideDomainError

__all__ = ["Jet", "variables"]

Array = NDArray[np.float64]


class Jet:
    r"""Enclosures of a function, its gradient and its Hessian over cells.

    NumPy calls the methods of the entries of an object array: functions that are written
    with NumPy's arithmetic, indexing, ``dot``, ``stack``, ``sin`` and the like take object
    arrays of jets as they take floats. What needs a decision that is not the same on a whole
    cell (a comparison, a rounding, a conversion to float) raises.

    Parameters
    ----------
    value : Interval
        Of shape (B,), one for each cell.
    gradient : Interval
        Of shape (N, B).
    hessian : Interval
        Of shape (N, N, B).
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

    def square(self) -> Jet:
        """s^2, as ``np.square`` calls it."""
        squared: Jet = self**2
        return squared

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

    def expm1(self) -> Jet:
        """The exponential minus one."""
        shifted: Jet = self.exp() - 1.0
        return shifted

    def log(self) -> Jet:
        """The natural logarithm."""
        inverse = self.value.log(), self.value.reciprocal()
        return self._composed(*inverse, -inverse[1].square())

    def log1p(self) -> Jet:
        """The natural logarithm of one plus s."""
        shifted: Jet = (self + 1.0).log()
        return shifted

    def sin(self) -> Jet:
        """The sine."""
        sine, cosine = self.value.sin(), self.value.cos()
        return self._composed(sine, cosine, -sine)

    def cos(self) -> Jet:
        """The cosine."""
        sine, cosine = self.value.sin(), self.value.cos()
        return self._composed(cosine, -sine, -cosine)

    def tan(self) -> Jet:
        """The tangent."""
        quotient: Jet = self.sin() / self.cos()
        return quotient

    def sinh(self) -> Jet:
        """The hyperbolic sine."""
        half: Jet = (self.exp() - (-self).exp()) * 0.5
        return half

    def cosh(self) -> Jet:
        """The hyperbolic cosine."""
        half: Jet = (self.exp() + (-self).exp()) * 0.5
        return half

    def tanh(self) -> Jet:
        """The hyperbolic tangent."""
        value = self.value.tanh()
        first = 1.0 - value.square()
        first = Interval(np.maximum(first.low, 0.0), first.high)
        return self._composed(value, first, -2.0 * (value * first))

    def arctan(self) -> Jet:
        """The arc tangent."""
        first = (1.0 + self.value.square()).reciprocal()
        return self._composed(
            self.value.arctan(), first, -2.0 * (self.value * first.square())
        )

    def arctan2(self, other: Any) -> Jet:
        """The angle of the point (other, self), off the cut along negative abscissas.

        Parameters
        ----------
        other : Jet or float
            The abscissa.
        """
        abscissa = other if isinstance(other, Jet) else self * 0.0 + other
        if abscissa.value.positive():
            angle: Jet = (self / abscissa).arctan()
            return angle
        quarter = Interval(np.nextafter(0.5 * np.pi, 0.0), np.nextafter(0.5 * np.pi, 2.0))
        if not (self.value.positive() or self.value.negative()):
            raise OutsideDomainError("an angle that may jump, or be of a point at the origin")
        side = quarter if self.value.positive() else -quarter
        return Jet.__add__(-(abscissa / self).arctan(), side)  # type: ignore[no-any-return]

    def conjugate(self) -> Jet:
        """The jet itself, which is real."""
        return self

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

    def __lt__(self, other: Any) -> bool:
        return self._compared(other, operator.lt)

    def __le__(self, other: Any) -> bool:
        return self._compared(other, operator.le)

    def __gt__(self, other: Any) -> bool:
        return self._compared(other, operator.gt)

    def __ge__(self, other: Any) -> bool:
        return self._compared(other, operator.ge)

    def __eq__(self, other: object) -> bool:
        return self._compared(other, operator.eq)

    def __ne__(self, other: object) -> bool:
        return self._compared(other, operator.ne)

    __hash__ = object.__hash__

    def __bool__(self) -> bool:
        raise OutsideDomainError("a truth value of something that is not one number")

    def __float__(self) -> float:
        raise OutsideDomainError("a conversion to float, as by math functions or float arrays")


def _number(value: Any, *, jets: bool = False) -> Any:
    """A real number as a float; intervals (and jets, if told) as they are; else None."""
    if isinstance(value, Interval) or (jets and isinstance(value, Jet)):
        return value
    if isinstance(value, (bool, int, float, np.number, np.bool_)) and not np.iscomplexobj(value):
        return float(value)
    return None


def _outer(a: Interval, b: Interval) -> Interval:
    if a is b:
        # The diagonal as squares, which are not negative.
        product = a[:, None] * b[None]
        squares, which = a.square(), np.arange(a.shape[0])
        low, high = product.low.copy(), product.high.copy()
        low[which, which], high[which, which] = squares.low, squares.high
        return Interval(low, high)
    return a[:, None] * b[None]


def _turned(a: Interval) -> Interval:
    return Interval(np.swapaxes(a.low, 0, 1), np.swapaxes(a.high, 0, 1))


def variables(lower: Array, upper: Array) -> NDArray[np.object_]:
    """The coordinates of cells as jets.

    Parameters
    ----------
    lower, upper : (B, N) array
        Corners of the cells.

    Returns
    -------
    (N,) object array
    """
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
