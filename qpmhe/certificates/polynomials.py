"""Choices by a condition: whether both sides agree where it changes, as polynomials."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterable
from fractions import Fraction
from typing import Any

import numpy as np

from .intervals import BRANCHES, OPERATIONS, Interval

Polynomial = dict[Any, Fraction]

_MOST_TERMS, _MOST_LEVELS, _MOST_POWER = 40, 25, 4
# Constants that differ by less, beside what they are computed from, are equal but for rounding.
_ROUNDING = 1e-14
_NUMBER = "number"


class _UnclearError(Exception):
    """A polynomial of too many terms, or none."""


def gap_of(nodes: Any, c: int, a: int, b: int) -> float | None:
    """How far a and b are apart where the condition c changes; None if that is not known."""
    operation, sides, _ = nodes[c]
    if operation in ("and", "or", "not"):
        gaps = [gap_of(nodes, side, a, b) for side in sides]
        known = [gap for gap in gaps if gap is not None]
        return max(known) if len(known) == len(gaps) else None
    with contextlib.suppress(_UnclearError, OverflowError):
        for changed in _boundaries(nodes, *sides):
            side = _Polynomials(nodes, changed)
            with contextlib.suppress(_UnclearError, OverflowError):
                gap = side.gap(_total(side.of(a), side.of(b), -1))
                if gap is not None:
                    return gap
    return None


def _boundaries(nodes: Any, p: int, q: int) -> Iterable[dict[Any, Polynomial]]:
    """What p = q says of a node, or of one of the atoms."""
    plain = _Polynomials(nodes, {})
    first, second = plain.of(p), plain.of(q)
    for one, other in ((p, second), (q, first)):
        if nodes[one][0] != "constant":
            yield {one: other}
    equation = _total(first, second, -1)
    for monomial, weight in equation.items():
        if len(monomial) == 1 and monomial[0][1] == 1:
            atom = monomial[0][0]
            rest = {one: -each / weight for one, each in equation.items() if one != monomial}
            if not any(_holds(one, atom) for one in rest):
                yield {atom: rest}


class _Polynomials:
    """Nodes as polynomials with rational coefficients, where some nodes or atoms are others.

    Atoms are variables and what is no polynomial: they count as independent of each other.
    """

    def __init__(self, nodes: Any, known: dict[Any, Polynomial]) -> None:
        self._nodes, self._known = nodes, known
        self._found: dict[int, Polynomial] = {}
        self._size = 0.0  # of the largest constant

    def of(self, node: int, level: int = 0) -> Polynomial:
        """The polynomial of a node."""
        if node in self._known:
            return self._known[node]
        if node not in self._found:
            found = self._of(node, level + 1)
            if len(found) > _MOST_TERMS:
                found = self._atom((node,))
            self._size = max(self._size, float(abs(found.get((), 0))))
            self._found[node] = found
        return self._found[node]

    def _atom(self, key: Any) -> Polynomial:
        found = self._known.get(key)
        return {((key, 1),): Fraction(1)} if found is None else found

    def _of(self, node: int, level: int) -> Polynomial:
        operation, arguments, parameter = self._nodes[node]
        if operation == "constant":
            if not np.isfinite(parameter):
                raise _UnclearError
            return _number(Fraction(parameter))
        if operation == "variable" or level > _MOST_LEVELS:
            return self._atom((node,))
        if operation in BRANCHES:
            holds = self._decided(arguments[0], level)
            return self._atom((node,)) if holds is None else self.of(
                arguments[1 if holds else 2], level
            )
        parts = [self.of(one, level) for one in arguments]
        match operation:
            case "add" | "sub":
                return _total(parts[0], parts[1], 1 if operation == "add" else -1)
            case "neg":
                return _total({}, parts[0], -1)
            case "near":
                return parts[0]
            case "mul":
                return _product(parts[0], parts[1])
            case "pow" if 0 < parameter <= _MOST_POWER:
                found = parts[0]
                for _ in range(parameter - 1):
                    found = _product(found, parts[0])
                return found
        if not all(set(part) <= {()} for part in parts):
            return self._atom((operation, parameter, *(frozenset(part.items()) for part in parts)))
        values = [part.get((), Fraction(0)) for part in parts]
        if operation == "pow" and values[0]:
            return _number(values[0] ** parameter)
        key = (_NUMBER, operation, parameter, *values)
        if parts and not any(values):
            # Functions whose value at zero is close to a half or a whole number have that value.
            value = _value(key)
            half = np.round(2.0 * value.middle) / 2.0
            if abs(half - value.middle) <= value.radius:
                return _number(Fraction(float(half)))
        return self._atom(key)

    def gap(self, rest: Polynomial) -> float | None:
        """How large a polynomial may be, if it is zero but for rounding errors."""
        size, found = self._size, Interval.of(0.0)
        for monomial, weight in rest.items():
            term = Interval.of(float(weight))
            for key, k in monomial:
                if key[0] != _NUMBER:
                    return None
                term = term * _value(key).power(k)
            size, found = max(size, float(term.magnitude)), found + term
        gap = float(found.magnitude) + 1e-15 * size * len(rest)  # weights, too, are rounded
        return gap if gap <= _ROUNDING * size else 0.0 if not rest else None

    def _decided(self, c: int, level: int) -> bool | None:
        """Whether a condition holds, if that is known."""
        operation, sides, _ = self._nodes[c]
        if operation not in ("less", "equal"):
            return None
        gap = _total(self.of(sides[1], level), self.of(sides[0], level), -1)
        if not set(gap) <= {()}:
            return None
        value = gap.get((), Fraction(0))
        return not value if operation == "equal" else value > 0


def _value(key: Any) -> Interval:
    """The value of a function of rational numbers."""
    _, operation, parameter, *values = key
    with np.errstate(all="ignore"):
        return OPERATIONS[operation](
            *(Interval.of(float(one)) for one in values),
            *(() if parameter is None else (parameter,)),
        )


def _number(value: Fraction) -> Polynomial:
    return {(): value} if value else {}


def _total(a: Polynomial, b: Polynomial, sign: int) -> Polynomial:
    """The sum a + b, or the difference."""
    found = dict(a)
    for monomial, weight in b.items():
        found[monomial] = found.get(monomial, Fraction(0)) + sign * weight
    return {one: weight for one, weight in found.items() if weight}


def _product(a: Polynomial, b: Polynomial) -> Polynomial:
    if len(a) * len(b) > _MOST_TERMS**2:
        raise _UnclearError
    found: Polynomial = {}
    for one, weight in a.items():
        for other, another in b.items():
            powers: dict[Any, int] = defaultdict(int)
            for atom, k in (*one, *other):
                powers[atom] += k
            monomial = tuple(sorted(powers.items(), key=repr))
            found[monomial] = found.get(monomial, Fraction(0)) + weight * another
    return {one: weight for one, weight in found.items() if weight}


def _holds(monomial: Any, atom: Any) -> bool:
    """Whether an atom occurs in a monomial, or in what its atoms are made of."""
    return atom == monomial or (
        isinstance(monomial, (tuple, frozenset)) and any(_holds(one, atom) for one in monomial)
    )
