"""How far the two sides of a choice are apart where its condition changes.

Both are evaluated in rational numbers, where the condition changes, with random numbers for
variables and for what functions return; equal arguments have equal values. A polynomial of degree
d that is not zero is zero there with probability (d / 2**64)**3 at most, whatever the model is.
"""

from __future__ import annotations

import contextlib
import operator
import random
from collections.abc import Callable, Iterable
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from .intervals import BRANCHES, OPERATIONS, Interval

_POINTS, _BITS = 3, 64
_MOST_LEVELS, _MOST_POWER, _MOST_BITS = 25, 4, 10_000
# Sides that differ by less, beside what they are computed from, are equal but for rounding.
_ROUNDING = 1e-14
_RANDOM = random.SystemRandom()
_EXACT: dict[str, Callable[..., Any]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "neg": operator.neg,
    "pow": operator.pow,
}


class _UnclearError(Exception):
    """A number that is not finite."""


class _Value(NamedTuple):
    points: tuple[Fraction, ...]  # at the random points
    constant: Interval  # where all that is random is zero
    exact: bool = True  # whether no function of numbers, of which an enclosure is known, is in it

    @property
    def varies(self) -> bool:
        return len(set(self.points)) > 1


def _number(value: float) -> _Value:
    return _Value((Fraction(value),) * _POINTS, Interval.of(float(value)))


def _of(operation: str, *parts: _Value, extra: tuple[Any, ...] = ()) -> _Value:
    """A polynomial of values."""
    points = zip(*(part.points for part in parts), strict=True)
    return _Value(
        tuple(_EXACT[operation](*each, *extra) for each in points),
        OPERATIONS[operation](*(part.constant for part in parts), *extra),
        all(part.exact for part in parts),
    )


def gap_of(nodes: Any, c: int, a: int, b: int) -> float | None:
    """How far a and b are apart where the condition c changes; None if that is not known."""
    operation, sides, _ = nodes[c]
    if operation in ("and", "or", "not"):
        gaps = [gap_of(nodes, side, a, b) for side in sides]
        known = [gap for gap in gaps if gap is not None]
        return max(known) if len(known) == len(gaps) else None
    with contextlib.suppress(_UnclearError), np.errstate(all="ignore"):
        for values in _boundaries(nodes, *sides):
            with contextlib.suppress(_UnclearError):
                rest = _of("sub", values.of(a), values.of(b))
                gap = float(rest.constant.magnitude)
                if rest.exact:
                    gap = float(abs(rest.points[0])) * (1.0 + 1e-15)
                if not rest.varies and gap <= _ROUNDING * values.size:
                    return gap
    return None


def _boundaries(nodes: Any, p: int, q: int) -> Iterable[_Values]:
    """Values where p = q, solved for either of them, or for an atom."""
    plain = _Values(nodes, {}, {})
    for one, value in ((p, plain.of(q)), (q, plain.of(p))):
        if nodes[one][0] != "constant":
            yield _Values(nodes, plain.atoms, {one: value})
    for atom in list(plain.atoms):
        first, second, third = (
            _of("sub", values.of(p), values.of(q))
            for values in (_Values(nodes, plain.atoms | {atom: _number(k)}, {}) for k in range(3))
        )
        slope = _of("sub", first, second)
        if all(slope.points) and slope.points == _of("sub", second, third).points:
            inverse = _of("pow", slope, extra=(-1,))
            yield _Values(nodes, plain.atoms | {atom: _of("mul", first, inverse)}, {})


class _Values:
    """The values of nodes, where those of some atoms or nodes are known.

    Atoms are variables and what is no polynomial: they count as independent of each other.
    """

    def __init__(self, nodes: Any, atoms: dict[Any, _Value], known: dict[int, _Value]) -> None:
        self._nodes, self.atoms, self._found = nodes, dict(atoms), known
        self.size = 0.0  # of the largest constant

    def of(self, node: int, level: int = 0) -> _Value:
        """The value of a node."""
        if node not in self._found:
            found = self._evaluated(node, level + 1)
            if any(each.numerator.bit_length() > _MOST_BITS for each in found.points):
                found = self._atom(node)
            self.size = max(self.size, float(found.constant.magnitude))
            self._found[node] = found
        return self._found[node]

    def _atom(self, *key: Any) -> _Value:
        points = tuple(Fraction(_RANDOM.getrandbits(_BITS)) for _ in range(_POINTS))
        value: _Value = self.atoms.setdefault(key, _Value(points, Interval.of(0.0)))
        return value

    def _evaluated(self, node: int, level: int) -> _Value:
        operation, arguments, parameter = self._nodes[node]
        if operation == "constant":
            if not np.isfinite(parameter):
                raise _UnclearError
            return _number(parameter)
        if operation == "variable" or level > _MOST_LEVELS:
            return self._atom(node)
        if operation in BRANCHES:
            holds = self._decided(arguments[0], level)
            return self._atom(node) if holds is None else self.of(
                arguments[1 if holds else 2], level
            )
        parts = [self.of(one, level) for one in arguments]
        if operation == "near":
            return parts[0]
        extra = () if parameter is None else (parameter,)
        if operation in _EXACT and (operation != "pow" or 0 < parameter <= _MOST_POWER):
            return _of(operation, *parts, extra=extra)
        if any(part.varies for part in parts):
            return self._atom(operation, parameter, *(part.points for part in parts))
        found = OPERATIONS[operation](*(part.constant for part in parts), *extra)
        if not found.known:
            raise _UnclearError
        return _Value(_number(float(found.middle)).points, found, exact=False)

    def _decided(self, c: int, level: int) -> bool | None:
        """Whether a condition holds, if that is known."""
        operation, sides, _ = self._nodes[c]
        if operation not in ("less", "equal"):
            return None
        gap = _of("sub", *(self.of(side, level) for side in sides))
        if gap.varies or not gap.exact:
            return None
        return not gap.points[0] if operation == "equal" else gap.points[0] < 0
