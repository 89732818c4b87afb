r"""A model's functions as one graph of operations.

Every model has the same form here, a graph of CasADi's scalar operations: those of NumPy, SymPy and
JAX are traced to it. Nodes that compute the same are one node, and what is zero is left out.

A choice by a condition is continuous if both sides agree where the condition changes, as
polynomials of what they are made of. If they differ by a constant in the size of rounding errors,
as pieces of a table do, the graph describes the function whose pieces are moved to meet, and
encloses how far.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from fractions import Fraction
from typing import Any

import numpy as np

from .polynomials import BRANCHES, Polynomial, Polynomials, UnclearError, holds, total

CONDITIONS = ("less", "atmost", "equal", "and", "or", "not")


class Graph:
    """Nodes, each known by a number: an operation, its arguments (nodes), and its parameter."""

    def __init__(self, variables: int) -> None:
        self.nodes: list[tuple[str, tuple[int, ...], Any]] = []
        self._numbers: dict[Any, int] = {}
        self.variables = [self.node("variable", parameter=k) for k in range(variables)]

    def node(self, operation: str, *arguments: int, parameter: Any = None) -> int:
        """The number of a node, which is made if there is none yet."""
        key = operation, arguments, parameter
        number = self._numbers.get(key)
        if number is None:
            number = self._numbers[key] = len(self.nodes)
            self.nodes.append(key)
        return number

    def constant(self, value: float) -> int:
        """A number."""
        return self.node("constant", parameter=float(value) + 0.0)

    def value(self, node: int) -> float | None:
        """The number that a node is, if it is one."""
        operation, _, parameter = self.nodes[node]
        return parameter if operation == "constant" else None

    def _exactly(self, a: int, b: int, of: Callable[[Any, Any], Any]) -> int | None:
        """A sum or product of two numbers, if it is a number itself, without rounding."""
        first, second = self.value(a), self.value(b)
        if first is None or second is None or not np.isfinite(first + second):
            return None
        value = of(first, second)
        if not np.isfinite(value) or Fraction(value) != of(Fraction(first), Fraction(second)):
            return None
        return self.constant(value)

    def neg(self, a: int) -> int:
        """-a."""
        operation, arguments, number = self.nodes[a]
        if operation == "constant":
            return self.constant(-number)
        if operation == "sub":
            return self.sub(arguments[1], arguments[0])
        return arguments[0] if operation == "neg" else self.node("neg", a)

    def add(self, a: int, b: int) -> int:
        """A + b."""
        if self.value(a) == 0.0 or self.value(b) == 0.0:
            return b if self.value(a) == 0.0 else a
        if self.nodes[b][0] == "neg":
            return self.sub(a, self.nodes[b][1][0])
        if self.nodes[a][0] == "neg":
            return self.sub(b, self.nodes[a][1][0])
        if a == b:
            return self.mul(self.constant(2.0), a)
        found = self._exactly(a, b, lambda s, t: s + t)
        return self.node("add", min(a, b), max(a, b)) if found is None else found

    def sub(self, a: int, b: int) -> int:
        """A - b."""
        if a == b:
            return self.constant(0.0)
        if self.value(a) == 0.0:
            return self.neg(b)
        if self.value(b) == 0.0:
            return a
        if self.nodes[b][0] == "neg":
            return self.add(a, self.nodes[b][1][0])
        if self.nodes[a][0] == "neg":
            return self.neg(self.add(self.nodes[a][1][0], b))
        found = self._exactly(a, b, lambda s, t: s - t)
        return self.node("sub", a, b) if found is None else found

    def mul(self, a: int, b: int) -> int:
        """A b, where powers of one node are one power."""
        for one, other in ((a, b), (b, a)):
            number = self.value(one)
            if number is not None and number in (0.0, 1.0, -1.0):
                return one if number == 0.0 else other if number == 1.0 else self.neg(other)
            if self.nodes[one][0] == "neg":
                return self.neg(self.mul(self.nodes[one][1][0], other))
        (base, k), (other_base, other_k) = self._power_of(a), self._power_of(b)
        if base == other_base and (k > 0) == (other_k > 0):
            return self.power(base, k + other_k)
        found = self._exactly(a, b, lambda s, t: s * t)
        return self.node("mul", min(a, b), max(a, b)) if found is None else found

    def _power_of(self, a: int) -> tuple[int, int]:
        operation, arguments, k = self.nodes[a]
        return (arguments[0], k) if operation == "pow" else (a, 1)

    def power(self, a: int, k: int) -> int:
        """a^k for an integer k."""
        base, inner = self._power_of(a)
        if inner != 1 and (k > 0 or inner > 0):
            return self.power(base, inner * k)
        number = self.value(a)
        if k == 0 or number == 1.0:
            return self.constant(1.0)
        if k == 1:
            return a
        if number is not None and 0 < k < 4 and Fraction(number**k) == Fraction(number) ** k:
            return self.constant(number**k)
        if self.nodes[a][0] == "neg":
            value = self.power(self.nodes[a][1][0], k)
            return self.neg(value) if k % 2 else value
        return self.node("pow", a, parameter=k)

    def of(self, operation: str, *arguments: int) -> int:
        """Any other function without parameter."""
        return self.node(operation, *arguments)

    def raised(self, a: int, exponent: float) -> int:
        """a^c for any number c."""
        if float(exponent).is_integer() and abs(exponent) < 64:
            return self.power(a, int(exponent))
        return self.root(a) if exponent == 0.5 else self.node("raised", a, parameter=exponent)

    def root(self, a: int) -> int:
        """The square root; of a sum of squares, the length of a vector."""
        legs = self._legs(a)
        if not legs or self.value(a) is not None:
            return self.of("sqrt", a)
        return self.of("length", *legs) if len(legs) > 1 else self.absolute(legs[0])

    def _legs(self, a: int) -> list[int]:
        """Nodes whose squares sum up to a node; none if it is no such sum."""
        operation, arguments, parameter = self.nodes[a]
        if operation == "constant" and parameter > 0.0:
            return [self.of("sqrt", a)]
        if operation == "pow" and parameter > 0 and parameter % 2 == 0:
            return [self.power(arguments[0], parameter // 2)]
        parts = [self._legs(one) for one in arguments] if operation == "add" else [[]]
        return [one for part in parts for one in part] if all(parts) else []

    # Conditions, and choices by them.

    def negated(self, c: int) -> int:
        """The opposite of a condition."""
        operation, arguments, _ = self.nodes[c]
        if operation in ("less", "atmost"):
            return self.of("atmost" if operation == "less" else "less", *arguments[::-1])
        if operation in ("and", "or"):
            return self.of("or" if operation == "and" else "and", *map(self.negated, arguments))
        return arguments[0] if operation == "not" else self.of("not", c)

    def choice(self, c: int, a: int, b: int) -> int:
        """A where the condition c holds, b elsewhere."""
        a, b = self._assumed(a, c), self._assumed(b, self.negated(c))
        if a == b:
            return a
        operation, sides, _ = self.nodes[c]
        if operation in ("less", "atmost") and set(sides) == {a, b}:
            return self.least(a, b) if sides == (a, b) else self.largest(a, b)
        gap = self._gap(c, a, b)
        if gap is None:
            return self.of("jump", c, a, b)
        found = self.of("either", c, a, b)
        return self.node("near", found, parameter=gap) if gap else found

    def absolute(self, a: int) -> int:
        """|a|."""
        return self.of("abs", self.of("less", self.constant(0.0), a), a, self.neg(a))

    def largest(self, a: int, b: int) -> int:
        """The larger one of two."""
        a, b = sorted((a, b))
        return a if a == b else self.of("max", self.of("atmost", b, a), a, b)

    def least(self, a: int, b: int) -> int:
        """The smaller one of two."""
        a, b = sorted((a, b))
        return a if a == b else self.of("min", self.of("atmost", a, b), a, b)

    def _assumed(self, node: int, c: int) -> int:
        """The node where a condition holds."""
        operation, arguments, parameter = self.nodes[node]
        if operation == "near":
            moved = self._assumed(arguments[0], c)
            return node if moved == arguments[0] else self.node("near", moved, parameter=parameter)
        if operation not in BRANCHES:
            return node
        other, first, second = arguments
        if other in (c, self.negated(c)):
            return self._assumed(first if other == c else second, c)
        inner = self._assumed(first, c), self._assumed(second, c)
        return node if inner == (first, second) else self.choice(other, *inner)

    def _gap(self, c: int, a: int, b: int) -> float | None:
        """How far a and b are apart where the condition changes; None if that is not known."""
        operation, sides, _ = self.nodes[c]
        if operation in ("and", "or", "not"):
            gaps = [self._gap(side, a, b) for side in sides]
            return max((gap for gap in gaps if gap is not None), default=None) if (
                None not in gaps
            ) else None
        for changed in self._boundaries(*sides):
            side = Polynomials(self, changed)
            try:
                rest = total(side.of(a), side.of(b), -1)
                gap = side.gap(rest) if rest else 0.0
            except (UnclearError, OverflowError):
                continue
            if gap is not None:
                return gap
        return None

    def _boundaries(self, p: int, q: int) -> Iterable[dict[Any, Polynomial]]:
        """What p = q says of a node, or of one of the variables."""
        plain = Polynomials(self, {})
        try:
            first, second = plain.of(p), plain.of(q)
            equation = total(first, second, -1)
        except (UnclearError, OverflowError):
            return
        for one, other in ((p, second), (q, first)):
            if self.value(one) is None:
                yield {one: other}
        for monomial, weight in equation.items():
            if len(monomial) == 1 and monomial[0][1] == 1:
                atom = monomial[0][0]
                rest = {one: -each / weight for one, each in equation.items() if one != monomial}
                if not any(holds(one, atom) for one in rest):
                    yield {atom: rest}

    def open_conditions(self, roots: Iterable[int]) -> list[tuple[int, ...]]:
        """The comparisons that these depend on, each with its negation if there is that, too."""
        found = {}
        for one in self.ancestors(roots):
            if self.nodes[one][0] in ("less", "atmost", "equal"):
                negation = self._numbers.get(self._negation_of(one))
                found[min(one, one if negation is None else negation)] = (
                    (one,) if negation is None else (one, negation)
                )
        return list(found.values())

    def _negation_of(self, c: int) -> Any:
        operation, arguments, _ = self.nodes[c]
        other = {"less": "atmost", "atmost": "less"}.get(operation)
        return other, arguments[::-1], None

    def ancestors(self, roots: Iterable[int]) -> list[int]:
        """All nodes that these are computed from, and themselves, in order."""
        found, waiting = set(), list(roots)
        while waiting:
            one = waiting.pop()
            if one not in found:
                found.add(one)
                waiting.extend(self.nodes[one][1])
        return sorted(found)
