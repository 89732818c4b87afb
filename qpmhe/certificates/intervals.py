"""Interval arithmetic with outward rounding, over many cells at once."""

from __future__ import annotations

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
# One unit in the last place is this share of a number at most, or this much of a subnormal one.
_ULP, _LEAST = 2.0**-52, 2.3e-308


def _outward(low: Array, high: Array, ulps: int = 1) -> Interval:
    """The interval moved outward by so many units in the last place, in new arrays."""
    share = ulps * _ULP
    return Interval(low - (np.abs(low) * share + _LEAST), high + (np.abs(high) * share + _LEAST))


class Interval:
    r"""Intervals :math:`[\ell, u]`, elementwise over arrays of equal shape.

    The result of every operation holds the exact results for all members of its operands:
    each is computed in the nearest rounding, and then moved outward by more than the distance of
    the next floating point number, or of a few of them for functions of the C library. Where an
    operation is not defined for all members, or not finite, the ends are NaN.
    """

    __slots__ = ("high", "low")

    def __init__(self, low: Any, high: Any) -> None:
        self.low: Array = np.asarray(low, np.float64)
        self.high: Array = np.asarray(high, np.float64)

    @classmethod
    def of(cls, value: Any) -> Interval:
        """The interval itself, or a number as an interval."""
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
        return np.maximum(
            _outward(middle, self.high - middle).high, _outward(middle, middle - self.low).high
        )

    @property
    def magnitude(self) -> Array:
        """The largest absolute value of a member."""
        return np.maximum(np.abs(self.low), np.abs(self.high))

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where both ends are finite."""
        return np.isfinite(self.low) & np.isfinite(self.high)

    def hull(self, other: Interval) -> Interval:
        """The smallest interval that holds both."""
        return Interval(np.minimum(self.low, other.low), np.maximum(self.high, other.high))

    def where(self, holds: Any) -> Interval:
        """The same, and NaN where this does not hold."""
        return Interval(np.where(holds, self.low, np.nan), np.where(holds, self.high, np.nan))

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)

    def __add__(self, other: Any) -> Interval:
        other = Interval.of(other)
        return _outward(self.low + other.low, self.high + other.high)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Interval:
        other = Interval.of(other)
        return _outward(self.low - other.high, self.high - other.low)

    def __rsub__(self, other: Any) -> Interval:
        return Interval.of(other) - self

    def __mul__(self, other: Any) -> Interval:
        if other is self:
            square: Interval = self.power(2)
            return square
        other = Interval.of(other)
        first, second = self.low * other.low, self.low * other.high
        third, fourth = self.high * other.low, self.high * other.high
        return _outward(
            np.minimum(np.minimum(first, second), np.minimum(third, fourth)),
            np.maximum(np.maximum(first, second), np.maximum(third, fourth)),
        )

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Interval:
        quotient: Interval = self * Interval.of(other).power(-1)
        return quotient

    def power(self, exponent: int) -> Interval:
        """s^k for an integer k, of which k < 0 excludes zero."""
        if exponent < 0:
            base = self.power(-exponent)
            return _outward(1.0 / base.high, 1.0 / base.low).where(
                (base.low > 0.0) | (base.high < 0.0)
            )
        if exponent == 1:
            return self
        if exponent % 2:  # it increases: the ends are those of the ends
            low, high = Interval.of(self.low), Interval.of(self.high)
            return Interval(
                (low * low.power(exponent - 1)).low, (high * high.power(exponent - 1)).high
            )
        size = abs(self).power(exponent // 2)
        square = _outward(size.low * size.low, size.high * size.high)
        return Interval(np.maximum(square.low, 0.0), square.high)

    def __abs__(self) -> Interval:
        least = np.maximum(np.maximum(self.low, -self.high), 0.0)
        return Interval(least, self.magnitude)

    def raised(self, exponent: float) -> Interval:
        """s^c for any number c, of members that are not negative; not of zero if c < 0."""
        value = self.increasing(lambda s: np.power(s, exponent)) if exponent > 0 else -(
            self.increasing(lambda s: -np.power(s, exponent))
        )
        return Interval(np.maximum(value.low, 0.0), value.high).where(self.low >= 0.0)

    def increasing(
        self, function: Callable[[Array], Any], least: float = -np.inf, most: float = np.inf,
        ulps: int = _LIBRARY_ULPS,
    ) -> Interval:
        """An increasing function with values between two numbers; NaN where it is not finite."""
        low, high = np.asarray(function(self.low)), np.asarray(function(self.high))
        moved = _outward(low, high, ulps)
        return Interval(np.maximum(moved.low, least), np.minimum(moved.high, most)).where(
            np.isfinite(low) & np.isfinite(high)
        )

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
        first, second = np.asarray(function(self.low)), np.asarray(function(self.high))
        ends = _outward(np.minimum(first, second), np.maximum(first, second), _LIBRARY_ULPS)

        def reached(phase: float) -> NDArray[np.bool_]:
            return np.asarray(np.ceil(low - slack - phase) <= high + slack - phase)

        return Interval(
            np.where(reached(top + 0.5), -1.0, np.maximum(ends.low, -1.0)),
            np.where(reached(top), 1.0, np.minimum(ends.high, 1.0)),
        ).where(np.isfinite(first + second))

    def tan(self) -> Interval:
        """The tangent, between two of its poles."""
        cosine = self.cos()
        return self.increasing(np.tan).where((cosine.low > 0.0) | (cosine.high < 0.0))


def angle(y: Interval, x: Interval) -> Interval:
    """The angle of the points (x, y), off the cut along negative abscissas and the origin."""
    # Along each edge of the box it is monotone, and inside its gradient is never zero.
    corners = [np.arctan2(b, a) for a in (x.low, x.high) for b in (y.low, y.high)]
    found = _outward(np.minimum.reduce(corners), np.maximum.reduce(corners), _LIBRARY_ULPS)
    return found.where((x.low > 0.0) | (y.low > 0.0) | (y.high < 0.0))


def length(*legs: Interval) -> Interval:
    """The length of vectors."""
    squares = [leg.power(2) for leg in legs]
    total = sum(squares[1:], squares[0])
    return Interval(np.maximum(total.low, 0.0), total.high).increasing(np.sqrt, 0.0)


def share(x: Interval, y: Interval) -> Interval:
    """X / length(x, y); what it may be near by, where both may be zero."""
    found = x / length(x, y)
    return Interval(np.fmax(found.low, -1.0), np.fmin(found.high, 1.0)).where(x.known & y.known)


def _truth(sure: NDArray[np.bool_], possible: NDArray[np.bool_], *operands: Interval) -> Interval:
    """1 where something surely holds, 0 where it cannot, [0, 1] in between."""
    nothing = sum(0.0 * (one.low + one.high) for one in operands)
    return Interval(sure + nothing, possible + nothing)


def _decided(truth: Interval) -> NDArray[np.bool_]:
    return np.asarray(truth.low == truth.high)


def either(
    truth: Interval, first: Interval, second: Interval, between: Interval | None = None
) -> Interval:
    """One of two; where the truth is not known, what lies between: what holds both."""
    between = first.hull(second) if between is None else between
    return Interval(*(
        np.where(truth.low == 1.0, one, np.where(truth.high == 0.0, other, rest + 0.0 * truth.low))
        for one, other, rest in (
            (first.low, second.low, between.low), (first.high, second.high, between.high)
        )
    ))


def _extreme(function: Callable[[Array, Array], Any]) -> Callable[[Interval, Interval], Interval]:
    """The larger or the smaller of two."""
    return lambda s, t: Interval(function(s.low, t.low), function(s.high, t.high))


maximum, minimum = _extreme(np.maximum), _extreme(np.minimum)


def _step(function: Callable[[Array], Any]) -> Callable[[Interval], Interval]:
    """A function that is constant in steps, where there is one value only."""

    def steps(s: Interval) -> Interval:
        low, high = np.asarray(function(s.low)), np.asarray(function(s.high))
        return Interval(low, high).where(low == high)

    return steps


def _erf(s: Interval) -> Interval:
    from scipy.special import erf

    return s.increasing(erf, -1.0, 1.0, 4 * _LIBRARY_ULPS)


#: Choices between two nodes, behind a condition.
BRANCHES = ("either", "jump", "max", "min", "abs")
#: What is defined where, as `Graph` names it: elementwise functions of intervals.
OPERATIONS: dict[str, Callable[..., Interval]] = {
    "add": lambda s, t: s + t, "sub": lambda s, t: s - t, "mul": lambda s, t: s * t,
    "neg": lambda s: -s, "pow": lambda s, k: s.power(k),
    "raised": lambda s, c: s.raised(c),
    "sqrt": lambda s: s.increasing(np.sqrt, 0.0, ulps=1),
    "exp": lambda s: s.increasing(np.exp, 0.0), "expm1": lambda s: s.increasing(np.expm1, -1.0),
    "log": lambda s: s.increasing(np.log), "log1p": lambda s: s.increasing(np.log1p),
    "sin": Interval.sin, "cos": Interval.cos, "tan": Interval.tan,
    "asin": lambda s: s.increasing(np.arcsin),
    "acos": lambda s: -s.increasing(lambda one: -np.arccos(one)),
    "atan": lambda s: s.increasing(np.arctan), "sinh": lambda s: s.increasing(np.sinh),
    "cosh": lambda s: abs(s).increasing(np.cosh, 1.0),
    "tanh": lambda s: s.increasing(np.tanh, -1.0, 1.0),
    "asinh": lambda s: s.increasing(np.arcsinh), "acosh": lambda s: s.increasing(np.arccosh, 0.0),
    "atanh": lambda s: s.increasing(np.arctanh), "erf": _erf,
    "sigmoid": lambda s: (1.0 + (-s).increasing(np.exp, 0.0)).power(-1),
    "near": lambda s, distance: s + Interval(-distance, distance),
    "angle": angle, "length": length, "share": share,
    # What is decided is one of the two, also beyond where it is.
    "max": lambda c, s, t: either(c, s, t, maximum(s, t)),
    "min": lambda c, s, t: either(c, s, t, minimum(s, t)),
    "abs": lambda c, s, t: either(c, s, t, abs(s)),
    "less": lambda s, t: _truth(s.high < t.low, s.low < t.high, s, t),
    "equal": lambda s, t: _truth(
        (s.low == t.high) & (s.high == t.low), (s.low <= t.high) & (t.low <= s.high), s, t),
    "not": lambda s: Interval(1.0 - s.high, 1.0 - s.low),
    "and": minimum, "or": maximum,
    "either": either, "jump": lambda c, s, t: either(c.where(_decided(c)), s, t),
    "truth": lambda c: c.where(_decided(c)),
    "floor": _step(np.floor), "ceil": _step(np.ceil), "sign": _step(np.sign),
    "trunc": _step(np.trunc), "unknown": lambda: Interval(np.nan, np.nan),
}
