"""Nodes of a graph as polynomials with rational coefficients, to show that they are equal."""

from __future__ import annotations

from collections import defaultdict
from fractions import Fraction
from typing import Any

import numpy as np

from .intervals import OPERATIONS, Interval

Polynomial = dict[Any, Fraction]

#: Choices between two nodes, behind a condition.
BRANCHES = ("either", "jump", "max", "min", "abs")
_MOST_TERMS, _MOST_LEVELS = 40, 25
# Constants that differ by less, beside what they are computed from, are equal but for rounding.
_ROUNDING = 1e-14
_NUMBER = "number"
_AT_ZERO = {
    **dict.fromkeys(("exp", "cos", "cosh"), 1.0),
    **dict.fromkeys(("sqrt", "sin", "tan", "asin", "atan", "sinh", "tanh", "asinh", "atanh", "erf",
                     "expm1", "log1p", "floor", "ceil", "trunc", "sign"), 0.0),
    "sigmoid": 0.5,
}


class UnclearError(Exception):
    """A polynomial of too many terms, or none."""


class Polynomials:
    """Nodes as polynomials with rational coefficients, where some nodes or atoms are others.

    Atoms are variables and what is no polynomial: they count as independent of each other.
    """

    def __init__(self, graph: Any, known: dict[Any, Polynomial]) -> None:
        self._graph, self._known = graph, known
        self._found: dict[int, Polynomial] = {}
        self.size = 0.0  # of the largest constant

    def of(self, node: int, level: int = 0) -> Polynomial:
        """The polynomial of a node."""
        if node in self._known:
            return self._known[node]
        if node not in self._found:
            found = self._of(node, level + 1)
            if len(found) > _MOST_TERMS:
                found = self._atom((node,))
            self.size = max(self.size, float(abs(found.get((), 0))))
            self._found[node] = found
        return self._found[node]

    def _atom(self, key: Any) -> Polynomial:
        found = self._known.get(key)
        return {((key, 1),): Fraction(1)} if found is None else found

    def _of(self, node: int, level: int) -> Polynomial:
        operation, arguments, parameter = self._graph.nodes[node]
        if operation == "constant":
            if not np.isfinite(parameter):
                raise UnclearError
            return _number(Fraction(parameter))
        if operation == "variable" or level > _MOST_LEVELS:
            return self._atom((node,))
        if operation in BRANCHES:
            holds = self._decided(arguments[0], level)
            return self._atom((node,)) if holds is None else self.of(
                arguments[1 if holds else 2], level
            )
        parts = [self.of(one, level) for one in arguments]
        if operation in ("add", "sub"):
            return total(parts[0], parts[1], 1 if operation == "add" else -1)
        if operation == "neg":
            return total({}, parts[0], -1)
        if operation == "near":
            return parts[0]
        if operation == "mul":
            return _product(parts[0], parts[1])
        if operation == "pow" and 0 < parameter < 5:
            found = parts[0]
            for _ in range(parameter - 1):
                found = _product(found, parts[0])
            return found
        if not all(set(part) <= {()} for part in parts):
            return self._atom((operation, parameter, *(frozenset(part.items()) for part in parts)))
        values = [part.get((), Fraction(0)) for part in parts]
        if operation == "pow" and values[0]:
            return _number(values[0] ** parameter)
        if not any(values) and operation in _AT_ZERO:
            return _number(Fraction(_AT_ZERO[operation]))
        return self._atom((_NUMBER, operation, parameter, *values))

    def gap(self, rest: Polynomial) -> float | None:
        """How large a polynomial may be, if it is zero but for rounding errors."""
        size, found = self.size, Interval.of(0.0)
        for monomial, weight in rest.items():
            term = Interval.of(float(weight))
            for (kind, *key), k in monomial:
                if kind != _NUMBER:
                    return None
                operation, parameter, *values = key
                value = OPERATIONS[operation](
                    *(Interval.of(float(one)) for one in values),
                    *(() if parameter is None else (parameter,)),
                )
                term = term * value.power(k)
            size, found = max(size, float(term.magnitude)), found + term
        gap = float(found.magnitude) + 1e-15 * size * len(rest)  # weights, too, are rounded
        return gap if gap <= _ROUNDING * size else None

    def _decided(self, c: int, level: int) -> bool | None:
        """Whether a condition holds, if that is known."""
        operation, sides, _ = self._graph.nodes[c]
        if operation not in ("less", "atmost", "equal"):
            return None
        gap = total(self.of(sides[1], level), self.of(sides[0], level), -1)
        if not set(gap) <= {()}:
            return None
        value = gap.get((), Fraction(0))
        if operation == "equal":
            return not value
        return value > 0 or (operation == "atmost" and not value)


def _number(value: Fraction) -> Polynomial:
    return {(): value} if value else {}


def total(a: Polynomial, b: Polynomial, sign: int) -> Polynomial:
    """The sum a + b, or the difference."""
    found = dict(a)
    for monomial, weight in b.items():
        found[monomial] = found.get(monomial, Fraction(0)) + sign * weight
    return {one: weight for one, weight in found.items() if weight}


def _product(a: Polynomial, b: Polynomial) -> Polynomial:
    if len(a) * len(b) > _MOST_TERMS**2:
        raise UnclearError
    found: Polynomial = {}
    for one, weight in a.items():
        for other, another in b.items():
            powers: dict[Any, int] = defaultdict(int)
            for atom, k in (*one, *other):
                powers[atom] += k
            monomial = tuple(sorted(powers.items(), key=repr))
            found[monomial] = found.get(monomial, Fraction(0)) + weight * another
    return {one: weight for one, weight in found.items() if weight}


def holds(monomial: Any, atom: Any) -> bool:
    """Whether an atom occurs in a monomial, or in what its atoms are made of."""
    return atom == monomial or (
        isinstance(monomial, (tuple, frozenset)) and any(holds(one, atom) for one in monomial)
    )
