r"""A model's functions as one graph of operations.

Every model has the same form here, a graph of CasADi's scalar operations: those of NumPy, SymPy and
JAX are traced to it. Nodes that compute the same are one node, and what is zero is left out.

A choice by a condition is continuous if both sides agree where the condition changes, as
polynomials of what they are made of. If they differ by a constant in the size of rounding errors,
as pieces of a table do, the graph describes the function whose pieces are moved to meet, and
encloses how far.

Derivatives of nodes are nodes of the same graph. A choice has the derivatives of either side. This
is rigorous for differences, which is what certificates need: along the segment between two states,
every node is a Lipschitz function of the position, and so has a derivative at almost every point.
There a choice v between a and b that is continuous equals a or b at points arbitrarily near by,
so that v' is a' or b', the chain rule holds with what is enclosed, and differences are the
integral. (Where a equals b on more than single points, a' is b' at almost all of these, so that v'
is the derivative of the branch that the condition takes.) Second derivatives are only for cells on
which no condition changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from fractions import Fraction
from typing import Any

import numpy as np

from .continuity import gap_of
from .intervals import BRANCHES

CONDITIONS = ("less", "equal", "and", "or", "not")
_STEPS = (*CONDITIONS, "floor", "ceil", "sign", "trunc", "truth")


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
        return arguments[0] if operation == "not" else self.of("not", c)

    def atmost(self, a: int, b: int) -> int:
        """The condition that a <= b."""
        return self.negated(self.of("less", b, a))

    def choice(self, c: int, a: int, b: int) -> int:
        """A where the condition c holds, b elsewhere."""
        operation, sides, _ = self.nodes[c]
        if operation == "not":
            return self.choice(sides[0], b, a)
        a, b = self._assumed(a, c, 1), self._assumed(b, c, 2)
        if a == b:
            return a
        if operation == "less" and set(sides) == {a, b}:
            return self.least(a, b) if sides == (a, b) else self.largest(a, b)
        gap = gap_of(self.nodes, c, a, b)
        if gap is None:
            return self.of("jump", c, a, b)
        found = self.of("either", c, a, b)
        return self.node("near", found, parameter=gap) if gap else found

    def _assumed(self, node: int, c: int, side: int) -> int:
        """A node where a condition holds (side 1) or does not (side 2)."""
        operation, arguments, parameter = self.nodes[node]
        if operation in BRANCHES and arguments[0] == c:
            return self._assumed(arguments[side], c, side)
        if operation not in (*BRANCHES, "near"):
            return node
        moved = [self._assumed(one, c, side) for one in arguments[-2:]]
        if moved == list(arguments[-2:]):
            return node
        return (
            self.node("near", *moved, parameter=parameter) if operation == "near"
            else self.choice(arguments[0], *moved)
        )

    def absolute(self, a: int) -> int:
        """|a|."""
        return self.of("abs", self.of("less", self.constant(0.0), a), a, self.neg(a))

    def largest(self, a: int, b: int) -> int:
        """The larger one of two."""
        a, b = sorted((a, b))
        return a if a == b else self.of("max", self.of("less", b, a), a, b)

    def least(self, a: int, b: int) -> int:
        """The smaller one of two."""
        a, b = sorted((a, b))
        return a if a == b else self.of("min", self.of("less", a, b), a, b)

    def comparisons(self, roots: Iterable[int]) -> list[int]:
        """The comparisons that these depend on."""
        return [one for one in self.ancestors(roots) if self.nodes[one][0] in ("less", "equal")]

    def ancestors(self, roots: Iterable[int]) -> list[int]:
        """All nodes that these are computed from, and themselves, in order."""
        found, waiting = set(), list(roots)
        while waiting:
            one = waiting.pop()
            if one not in found:
                found.add(one)
                waiting.extend(self.nodes[one][1])
        return sorted(found)


class Slopes:
    """The gradients of a graph's nodes, those of gradients among them."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._found: dict[int, dict[int, int]] = {}
        self._one, self._zero = graph.constant(1.0), graph.constant(0.0)

    def of(self, node: int) -> dict[int, int]:
        """The partial derivatives that are not zero, by variable."""
        if node not in self._found:
            for one in self._graph.ancestors([node]):
                if one not in self._found:
                    self._found[one] = self._of(one)
        return self._found[node]

    def _of(self, node: int) -> dict[int, int]:
        graph, (operation, arguments, parameter) = self._graph, self._graph.nodes[node]
        if operation == "variable":
            return {parameter: self._one}
        if operation in BRANCHES:
            c, *sides = arguments
            first, second = (self.of(side) for side in sides)
            entries = {
                i: (first.get(i, self._zero), second.get(i, self._zero))
                for i in sorted({*first, *second})
            }
            return {
                i: a if a == b else graph.of("either", c, a, b) for i, (a, b) in entries.items()
            }
        found: dict[int, int] = {}
        if operation in _STEPS or not any(self.of(one) for one in arguments):
            return found
        for slope, argument in zip(self._partial(node), arguments, strict=True):
            for i, entry in self.of(argument).items():
                term = graph.mul(slope, entry)
                found[i] = graph.add(found[i], term) if i in found else term
        return {i: one for i, one in found.items() if one != self._zero}

    def _partial(self, node: int) -> list[int]:
        """The partial derivatives of an operation by its arguments."""
        graph, one = self._graph, self._one
        operation, arguments, parameter = graph.nodes[node]
        number, of, mul, add, sub, power, neg = (
            graph.constant, graph.of, graph.mul, graph.add, graph.sub, graph.power, graph.neg
        )
        a = arguments[0]
        match operation:
            case "add":
                return [one, one]
            case "sub":
                return [one, number(-1.0)]
            case "mul":
                return [arguments[1], a]
            case "neg":
                return [number(-1.0)]
            case "near":
                return [one]
            case "pow":
                return [mul(number(parameter), power(a, parameter - 1))]
            case "raised":
                # An exponent that is rounded would be another.
                exact = Fraction(parameter) - 1 == Fraction(parameter - 1.0)
                lower = graph.raised(a, parameter - 1.0) if exact else mul(node, power(a, -1))
                return [mul(number(parameter), lower)]
            case "angle":
                inverse = power(of("length", arguments[1], a), -1)
                return [mul(of("cos", node), inverse), neg(mul(of("sin", node), inverse))]
            case "length":
                rests = [arguments[:k] + arguments[k + 1 :] for k in range(len(arguments))]
                return [
                    of("share", leg, of("length", *rest) if len(rest) > 1 else rest[0])
                    for leg, rest in zip(arguments, rests, strict=True)
                ]
            case "share":
                other, inverse = of("share", *arguments[::-1]), power(of("length", *arguments), -1)
                return [mul(power(other, 2), inverse), neg(mul(mul(node, other), inverse))]
            case "exp":
                return [node]
            case "erf":
                root = of("sqrt", graph.node("near", number(np.pi), parameter=4e-16))
                return [mul(mul(number(2.0), power(root, -1)), of("exp", neg(power(a, 2))))]
        plus, minus = add(one, power(a, 2)), sub(one, power(a, 2))
        made: dict[str, Callable[[], int]] = {
            "expm1": lambda: of("exp", a), "log": lambda: power(a, -1),
            "log1p": lambda: power(add(one, a), -1),
            "sqrt": lambda: mul(number(0.5), power(node, -1)),
            "sin": lambda: of("cos", a), "cos": lambda: neg(of("sin", a)),
            "tan": lambda: add(one, power(node, 2)), "sinh": lambda: of("cosh", a),
            "cosh": lambda: of("sinh", a), "tanh": lambda: sub(one, power(node, 2)),
            # v (1 - v), with v once.
            "sigmoid": lambda: sub(number(0.25), power(sub(node, number(0.5)), 2)),
            "atan": lambda: power(plus, -1), "atanh": lambda: power(minus, -1),
            "asin": lambda: power(of("sqrt", minus), -1),
            "acos": lambda: neg(power(of("sqrt", minus), -1)),
            "asinh": lambda: power(of("sqrt", plus), -1),
            "acosh": lambda: power(of("sqrt", sub(power(a, 2), one)), -1),
        }
        return [made[operation]()]
