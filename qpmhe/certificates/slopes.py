r"""Derivatives of a graph's nodes, as nodes of the same graph.

A choice by a condition has the derivatives of either side. This is rigorous for differences, which
is what certificates need. Along the segment between two states, every node is a Lipschitz function
of the way, and so has a derivative at almost every point of it. There a choice v between a and b
that is continuous equals a or b at points arbitrarily near by, so that v' is a' or b', the chain
rule holds with what is enclosed, and differences are the integral. (Where a equals b on more than
single points, a' is b' at almost all of these, so that v' is the derivative of the
branch that the condition takes.) Second derivatives are only for cells on which no condition
changes.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from .graph import CONDITIONS, Graph
from .intervals import BRANCHES

_STEPS = (*CONDITIONS, "floor", "ceil", "sign", "trunc", "truth")


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
            case "expm1":
                return [of("exp", a)]
            case "log":
                return [power(a, -1)]
            case "log1p":
                return [power(add(one, a), -1)]
            case "sqrt":
                return [mul(number(0.5), power(node, -1))]
            case "sin":
                return [of("cos", a)]
            case "cos":
                return [neg(of("sin", a))]
            case "tan":
                return [add(one, power(node, 2))]
            case "sinh":
                return [of("cosh", a)]
            case "cosh":
                return [of("sinh", a)]
            case "tanh":
                return [sub(one, power(node, 2))]
            case "sigmoid":  # v (1 - v), with v once
                return [sub(number(0.25), power(sub(node, number(0.5)), 2))]
            case "atan":
                return [power(add(one, power(a, 2)), -1)]
            case "atanh":
                return [power(sub(one, power(a, 2)), -1)]
            case "erf":
                root = of("sqrt", graph.node("near", number(np.pi), parameter=4e-16))
                return [mul(mul(number(2.0), power(root, -1)), of("exp", neg(power(a, 2))))]
        square = power(a, 2)
        inside = {
            "asin": sub(one, square), "acos": sub(one, square),
            "asinh": add(one, square), "acosh": sub(square, one),
        }[operation]
        inverse = power(of("sqrt", inside), -1)
        return [neg(inverse) if operation == "acos" else inverse]
