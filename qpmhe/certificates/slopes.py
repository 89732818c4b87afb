r"""First and second derivatives of a graph's nodes, as nodes of the same graph.

Functions with kinks (absolute values, maxima, minima, choices by a condition) have no second
derivative where they have one, and their first derivative is enclosed by all that it may be on
either side. This is rigorous for differences, which is what certificates need. Along the segment
between two states, every node is a Lipschitz function of the way, and so has a derivative at almost
every point of it. There a choice v between a and b that is continuous has one of theirs: v
equals a or b at points arbitrarily near by, so v' is a limit of differences of a or of b. Hence
v' is a' or b', the chain rule holds with what is enclosed, and differences are the integral. (Where
a equals b on more than single points, a' is b' at almost all of these, so that v' is always that of
the side on which the condition is.) For the same reason, a partial derivative all of whose second
derivatives are enclosed is Lipschitz, and its differences are averages of what encloses them.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np

from .graph import CONDITIONS, Graph
from .polynomials import BRANCHES

Pairs = dict[tuple[int, int], int]

_LINEAR = {"add": (1.0, 1.0), "sub": (1.0, -1.0), "neg": (-1.0,), "near": (1.0,)}
_STEPS = (*CONDITIONS, "floor", "ceil", "sign", "trunc", "truth")


class Slopes:
    """The derivatives of a graph's nodes; second ones by its first ``states`` variables and all."""

    def __init__(self, graph: Graph, states: int) -> None:
        self._graph, self._states = graph, states
        self._first: dict[int, dict[int, int]] = {}
        self._second: dict[int, Pairs] = {}
        self._one, self._zero = graph.constant(1.0), graph.constant(0.0)

    def first(self, node: int) -> dict[int, int]:
        """The partial derivatives that are not zero, by variable."""
        if node not in self._first:
            for one in self._graph.ancestors([node]):
                if one not in self._first:
                    self._first[one] = self._first_of(one)
        return self._first[node]

    def second(self, node: int) -> Pairs:
        """The second derivatives that are not zero, by pairs (i, j), i a state and i <= j."""
        if node not in self._second:
            for one in self._graph.ancestors([node]):
                if one not in self._second:
                    self._second[one] = self._second_of(one)
        return self._second[node]

    def _first_of(self, node: int) -> dict[int, int]:
        operation, arguments, parameter = self._graph.nodes[node]
        if operation == "variable":
            return {parameter: self._one}
        if operation in BRANCHES:
            c, a, b = arguments
            return {
                i: self._either(c, self._entry(a, i), self._entry(b, i))
                for i in sorted({*self.first(a), *self.first(b)})
            }
        found: dict[int, int] = {}
        slopes = self._partial(node)[0] if arguments else []
        for slope, argument in zip(slopes, arguments, strict=True):
            for i, entry in self.first(argument).items():
                self._gather(found, i, self._graph.mul(slope, entry))
        return {i: one for i, one in found.items() if one != self._zero}

    def _second_of(self, node: int) -> Pairs:
        graph, (operation, arguments, _) = self._graph, self._graph.nodes[node]
        found: Pairs = {}
        if operation in BRANCHES:
            c, *sides = arguments
            first, second = (self.second(side) for side in sides)
            for pair in {**first, **second}:
                found[pair] = self._either(
                    c, first.get(pair, self._zero), second.get(pair, self._zero)
                )
            for i in {**self.first(sides[0]), **self.first(sides[1])}:
                # Where the condition may change, the partial derivative by i may jump.
                if i < self._states and self._entry(sides[0], i) != self._entry(sides[1], i):
                    found[i, i] = graph.of("smooth", c, found.get((i, i), self._zero))
            return found
        if not arguments:
            return found
        slopes, bends = self._partial(node)
        for slope, argument in zip(slopes, arguments, strict=True):
            for pair, entry in self.second(argument).items():
                self._gather(found, pair, graph.mul(slope, entry))
        for (k, other), bend in bends.items():
            left, right = self.first(arguments[k]), self.first(arguments[other])
            for i, one in left.items():
                for j, another in right.items():
                    if min(i, j) >= self._states or (k == other and i > j):
                        continue
                    # Of two arguments, both orders; on the diagonal, they are equal.
                    term = graph.mul(bend, graph.mul(one, another))
                    for _ in range(2 if k != other and i == j else 1):
                        self._gather(found, (min(i, j), max(i, j)), term)
        return {pair: one for pair, one in found.items() if one != self._zero}

    def _gather(self, found: dict[Any, int], key: Any, term: int) -> None:
        found[key] = self._graph.add(found[key], term) if key in found else term

    def _entry(self, node: int, i: int) -> int:
        return self.first(node).get(i, self._zero)

    def _either(self, c: int, a: int, b: int) -> int:
        return a if a == b else self._graph.of("either", c, a, b)

    def _partial(self, node: int) -> tuple[list[int], Pairs]:
        """Partial derivatives of an operation by its arguments, and the second ones by pairs."""
        graph = self._graph
        operation, arguments, parameter = graph.nodes[node]
        if operation in _LINEAR:
            return [graph.constant(sign) for sign in _LINEAR[operation]], {}
        if operation in _STEPS:
            return [self._zero] * len(arguments), {}
        if operation == "mul":
            return [arguments[1], arguments[0]], {(0, 1): self._one}
        if operation == "angle":
            return self._of_angle(node, *arguments)
        if operation == "length":
            return self._of_length(node, arguments)
        if operation == "pow":
            k, a = parameter, arguments[0]
            slope = graph.mul(graph.constant(k), graph.power(a, k - 1))
            bend = graph.mul(graph.constant(k * (k - 1)), graph.power(a, k - 2))
        elif operation == "raised":
            slope, bend = self._of_power(node, arguments[0], parameter)
        else:
            slope, bend = self._of_one(operation, arguments[0], node)
        return [slope], {(0, 0): bend}

    def _of_power(self, node: int, a: int, c: float) -> tuple[int, int]:
        graph = self._graph
        # Exponents that are rounded would be others.
        exact = all(Fraction(c) - j == Fraction(c - j) for j in (1, 2))
        lower, lowest = (
            graph.raised(a, c - j) if exact else graph.mul(node, graph.power(a, -j))
            for j in (1, 2)
        )
        factor = graph.constant(c)
        twice = graph.mul(factor, graph.sub(factor, self._one))
        return graph.mul(factor, lower), graph.mul(twice, lowest)

    def _of_angle(self, node: int, y: int, x: int) -> tuple[list[int], Pairs]:
        graph = self._graph
        inverse = graph.power(graph.of("length", x, y), -1)
        twice, square = graph.mul(graph.constant(2.0), node), graph.power(inverse, 2)
        bent = graph.mul(graph.of("sin", twice), square)
        return [
            graph.mul(graph.of("cos", node), inverse),
            graph.neg(graph.mul(graph.of("sin", node), inverse)),
        ], {
            (0, 0): graph.neg(bent), (1, 1): bent,
            (0, 1): graph.neg(graph.mul(graph.of("cos", twice), square)),
        }

    def _of_length(self, node: int, legs: tuple[int, ...]) -> tuple[list[int], Pairs]:
        graph = self._graph
        inverse, others = graph.power(node, -1), []
        for k in range(len(legs)):
            rest = legs[:k] + legs[k + 1 :]
            others.append(graph.of("length", *rest) if len(rest) > 1 else rest[0])
        shares = [graph.of("share", *pair) for pair in zip(legs, others, strict=True)]
        bends = {
            (k, j): graph.neg(graph.mul(graph.mul(shares[k], shares[j]), inverse))
            for j in range(len(legs)) for k in range(j)
        }
        for k, pair in enumerate(zip(others, legs, strict=True)):
            bends[k, k] = graph.mul(graph.power(graph.of("share", *pair), 2), inverse)
        return shares, bends

    def _of_one(self, operation: str, a: int, v: int) -> tuple[int, int]:
        """First and second derivative of a function v of one argument a."""
        graph = self._graph
        number, mul, add, sub, power, neg = (
            graph.constant, graph.mul, graph.add, graph.sub, graph.power, graph.neg
        )
        one, two = self._one, number(2.0)
        match operation:
            case "exp" | "expm1":
                return graph.of("exp", a), graph.of("exp", a)
            case "log" | "log1p":
                base = add(one, a) if operation == "log1p" else a
                return power(base, -1), neg(power(base, -2))
            case "sqrt":
                return mul(number(0.5), power(v, -1)), mul(number(-0.25), power(mul(a, v), -1))
            case "sin":
                return graph.of("cos", a), neg(v)
            case "cos":
                return neg(graph.of("sin", a)), neg(v)
            case "tan":
                return add(one, power(v, 2)), mul(two, add(v, power(v, 3)))
            case "sinh":
                return graph.of("cosh", a), v
            case "cosh":
                return graph.of("sinh", a), v
            case "tanh":
                return sub(one, power(v, 2)), mul(number(-2.0), graph.of("t-t^3", v))
            case "sigmoid":
                return graph.of("t-t^2", v), graph.of("t-3t^2+2t^3", v)
            case "atan":
                return power(add(one, power(a, 2)), -1), graph.of("atan''", a)
            case "atanh":
                inverse = power(sub(one, power(a, 2)), -1)
                return inverse, mul(mul(two, a), power(inverse, 2))
            case "erf":
                pi = graph.node("near", number(np.pi), parameter=4e-16)
                factor = mul(two, power(graph.of("sqrt", pi), -1))
                slope = mul(factor, graph.of("exp", neg(power(a, 2))))
                return slope, mul(number(-2.0), mul(a, slope))
        square = power(a, 2)
        inside = {
            "asin": sub(one, square), "acos": sub(one, square),
            "asinh": add(one, square), "acosh": sub(square, one),
        }[operation]
        inverse = power(graph.of("sqrt", inside), -1)
        bend = mul(a, power(inverse, 3))
        return (
            neg(inverse) if operation == "acos" else inverse,
            bend if operation == "asin" else neg(bend),
        )
