r"""A model's functions as one graph of operations, with first and second derivatives.

Every model has the same form here, a graph of CasADi's scalar operations: those of NumPy, SymPy and
JAX are traced to it. Nodes that compute the same are one node, and what is zero is left out.

Functions with kinks (absolute values, maxima, minima, choices by a condition) have no second
derivative where they have one, and their first derivative is enclosed by all that it may be on
either side. This is rigorous for differences, which is what certificates need. Along the segment
between two states, every node is a Lipschitz function of the way, and so has a derivative at almost
every point of it. There a choice v between a and b that is continuous has one of theirs: v
equals a or b at points arbitrarily near by, so v' is a limit of differences of a or of b. Hence
v' is a' or b', the chain rule holds with what is enclosed, and differences are the integral. For the
same reason, a partial derivative all of whose second derivatives are enclosed is Lipschitz, and
its differences are averages of what encloses them.

A choice is continuous if a and b agree where the condition changes, as polynomials of what they are
made of. If they differ by a constant in the size of rounding errors, as pieces of a table do, the
graph is that of the function whose pieces are moved to meet, and encloses how far.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from .._checks import Array
from ..model.expressions import import_casadi
from .intervals import OPERATIONS, Interval

Pairs = dict[tuple[int, int], int]
Polynomial = dict[Any, Fraction]

# Numbers that are held at once, of both ends of intervals.
_HELD = 1_000_000
_MOST_TERMS, _MOST_LEVELS = 40, 25
# Constants that differ by less, beside those that they are computed from, are equal but for rounding.
_ROUNDING = 1e-13
_CONDITIONS = ("less", "atmost", "equal", "and", "or", "not")
_STEPS = ("floor", "ceil", "sign", "trunc", "truth", "unknown")
# Why a node may be undefined on a cell.
_UNDEFINED = {
    "pow": "a division by a value that may be zero", "sqrt": "a square root of a value that may "
    "be negative", "log": "a logarithm of a value that may not be positive",
    "log1p": "a logarithm of a value that may not be positive",
    "raised": "a power of a value that may not be positive",
    "jump": "a choice (numpy.where, if_else) that may jump where its condition changes",
    "truth": "a comparison as a number, which jumps",
    "angle": "an angle (arctan2) that may jump, or be of a point at the origin",
    **{name: f"a jump of {name}" for name in ("floor", "ceil", "sign", "trunc")},
}


class Graph:
    """Nodes, each known by a number: an operation, its arguments (nodes), and its parameter."""

    def __init__(self, variables: int, states: int) -> None:
        self.states = states
        self.nodes: list[tuple[str, tuple[int, ...], Any]] = []
        self._numbers: dict[Any, int] = {}
        self._first: dict[int, dict[int, int]] = {}
        self._second: dict[int, Pairs] = {}
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
        """a + b."""
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
        """a - b."""
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
        """a b, where powers of one node are one power."""
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
        return self.of("sqrt", a) if exponent == 0.5 else self.node("raised", a, parameter=exponent)

    def root(self, a: int) -> int:
        """The square root; of a sum of squares, the length of a vector."""
        legs = self._legs(a)
        if not legs or self.value(a) is not None:
            return self.of("sqrt", a)
        return self.of("length", *legs) if len(legs) > 1 else self.of("abs", *legs)

    def _legs(self, a: int) -> list[int]:
        """Nodes whose squares sum up to a node; none if it is no such sum."""
        operation, arguments, parameter = self.nodes[a]
        if operation == "constant" and parameter > 0.0:
            return [self.of("sqrt", a)]
        if operation == "pow" and parameter > 0 and parameter % 2 == 0:
            return [self.power(arguments[0], parameter // 2)]
        parts = [self._legs(one) for one in arguments] if operation == "add" else [[]]
        return sum(parts, []) if all(parts) else []

    # Conditions, and choices by them.

    def condition(self, a: int) -> int:
        """What is not zero, as a condition."""
        return a if self.nodes[a][0] in _CONDITIONS else self.negated(
            self.of("equal", a, self.constant(0.0))
        )

    def number(self, a: int) -> int:
        """A condition as 0 or 1; other nodes themselves."""
        return self.of("truth", a) if self.nodes[a][0] in _CONDITIONS else a

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
            return self.of("min" if sides == (a, b) else "max", min(a, b), max(a, b))
        gap = self._gap(c, a, b)
        if gap is None:
            return self.of("jump", c, a, b)
        found = self.of("either", c, a, b)
        return self.node("near", found, parameter=gap) if gap else found

    def _assumed(self, node: int, c: int) -> int:
        """The node where a condition holds."""
        operation, arguments, parameter = self.nodes[node]
        if operation == "near":
            inner = self._assumed(arguments[0], c)
            return node if inner == arguments[0] else self.node("near", inner, parameter=parameter)
        if operation not in ("either", "jump"):
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
            return None if None in gaps else max(gap for gap in gaps if gap is not None)
        p, q = sides
        for changed in self._boundaries(p, q):
            try:
                side = _Polynomials(self, changed)
                first, second = side.of(a), side.of(b)
            except _UnclearError:
                continue
            rest = _sum(first, second, -1)
            gap = side.gap(rest) if rest else 0.0
            if gap is not None:
                return gap
        return None

    def _boundaries(self, p: int, q: int) -> Iterable[dict[Any, Polynomial]]:
        """What p = q says of a node, or of one of the variables."""
        plain = _Polynomials(self, {})
        for one, other in ((p, q), (q, p)):
            if self.value(one) is None:
                yield {one: plain.of(other)}
        try:
            equation = _sum(plain.of(p), plain.of(q), -1)
        except _UnclearError:
            return
        for monomial, weight in equation.items():
            if len(monomial) == 1 and monomial[0][1] == 1:
                atom = monomial[0][0]
                rest = {one: -each / weight for one, each in equation.items() if one != monomial}
                if not any(_holds(one, atom) for one in rest):
                    yield {atom: rest}

    # Derivatives.

    def first(self, node: int) -> dict[int, int]:
        """The partial derivatives that are not zero, by variable."""
        if node not in self._first:
            for one in self.ancestors([node]):
                if one not in self._first:
                    self._first[one] = self._first_of(one)
        return self._first[node]

    def second(self, node: int) -> Pairs:
        """The second derivatives that are not zero, by pairs (i, j), i a state and i <= j."""
        if node not in self._second:
            for one in self.ancestors([node]):
                if one not in self._second:
                    self._second[one] = self._second_of(one)
        return self._second[node]

    def _first_of(self, node: int) -> dict[int, int]:
        operation, arguments, parameter = self.nodes[node]
        if operation == "variable":
            return {parameter: self.constant(1.0)}
        if not arguments:
            return {}
        branches = self._branches(node)
        if branches is not None:
            c, a, b = branches
            return {
                i: self._either(c, self._entry(a, i), self._entry(b, i))
                for i in sorted({*self.first(a), *self.first(b)})
            }
        found: dict[int, int] = {}
        for slope, argument in zip(self._partial(node)[0], arguments, strict=True):
            for i, entry in self.first(argument).items():
                term = self.mul(slope, entry)
                found[i] = self.add(found[i], term) if i in found else term
        return self._without_zeros(found)

    def _second_of(self, node: int) -> Pairs:
        operation, arguments, _ = self.nodes[node]
        found: Pairs = {}

        def gather(pair: tuple[int, int], term: int) -> None:
            found[pair] = self.add(found[pair], term) if pair in found else term

        branches = self._branches(node)
        if branches is not None:
            c, a, b = branches
            zero = self.constant(0.0)
            for pair in {**self.second(a), **self.second(b)}:
                entries = (self.second(one).get(pair, zero) for one in (a, b))
                found[pair] = self._either(c, *entries)
            for i in {**self.first(a), **self.first(b)}:
                # Where the condition may change, the partial derivative by i may jump.
                if i < self.states and self._entry(a, i) != self._entry(b, i):
                    found[i, i] = self.of("smooth", c, found.get((i, i), zero))
            return found
        if not arguments:
            return found
        slopes, curvatures = self._partial(node)
        for slope, argument in zip(slopes, arguments, strict=True):
            for pair, entry in self.second(argument).items():
                gather(pair, self.mul(slope, entry))
        for (k, other), curvature in curvatures.items():
            a, b = self.first(arguments[k]), self.first(arguments[other])
            for i, one in a.items():
                for j, another in b.items():
                    if min(i, j) >= self.states or (k == other and i > j):
                        continue
                    term = self.mul(curvature, self.mul(one, another))
                    # Of two arguments, both orders; on the diagonal, they are equal.
                    gather((min(i, j), max(i, j)), term)
                    if k != other and i == j:
                        gather((i, j), term)
        return self._without_zeros(found)

    def _without_zeros(self, entries: Any) -> Any:
        return {key: one for key, one in entries.items() if self.value(one) != 0.0}

    def _entry(self, node: int, i: int) -> int:
        return self.first(node).get(i, self.constant(0.0))

    def _either(self, c: int, a: int, b: int) -> int:
        return a if a == b else self.of("either", c, a, b)

    def _branches(self, node: int) -> tuple[int, int, int] | None:
        """Condition and choices of a function with kinks or jumps."""
        operation, arguments, _ = self.nodes[node]
        if operation in ("either", "jump"):
            c, a, b = arguments
            return c, a, b
        if operation in ("max", "min"):
            a, b = arguments
            return self.of("atmost", *((b, a) if operation == "max" else (a, b))), a, b
        if operation == "abs":
            a = arguments[0]
            return self.of("less", self.constant(0.0), a), a, self.neg(a)
        return None

    def _partial(self, node: int) -> tuple[list[int], Pairs]:
        """Partial derivatives of an operation by its arguments, and the second ones by pairs."""
        operation, arguments, parameter = self.nodes[node]
        one = self.constant(1.0)
        if operation in ("add", "sub", "near", "neg"):
            first = self.neg(one) if operation == "neg" else one
            return [first, self.neg(one) if operation == "sub" else one][: len(arguments)], {}
        if operation == "mul":
            return [arguments[1], arguments[0]], {(0, 1): one}
        if operation == "angle":
            return self._of_angle(node, *arguments)
        if operation == "length":
            return self._of_length(node, arguments)
        if operation in _STEPS or operation in _CONDITIONS:
            zero = self.constant(0.0)
            return [zero] * len(arguments), {}
        slope, curvature = self._of_one(operation, arguments[0], node, parameter)
        return [slope], {(0, 0): curvature}

    def _of_angle(self, node: int, b: int, a: int) -> tuple[list[int], Pairs]:
        inverse = self.power(self.of("length", a, b), -1)
        twice, square = self.mul(self.constant(2.0), node), self.power(inverse, 2)
        bent = self.mul(self.of("sin", twice), square)
        return [
            self.mul(self.of("cos", node), inverse), self.neg(self.mul(self.of("sin", node), inverse)),
        ], {
            (0, 0): self.neg(bent), (1, 1): bent,
            (0, 1): self.neg(self.mul(self.of("cos", twice), square)),
        }

    def _of_length(self, node: int, legs: tuple[int, ...]) -> tuple[list[int], Pairs]:
        inverse, others = self.power(node, -1), []
        for k in range(len(legs)):
            rest = legs[:k] + legs[k + 1 :]
            others.append(self.of("length", *rest) if len(rest) > 1 else rest[0])
        shares = [self.of("share", *pair) for pair in zip(legs, others, strict=True)]
        bends = {
            (k, j): self.neg(self.mul(self.mul(shares[k], shares[j]), inverse))
            for j in range(len(legs)) for k in range(j)
        }
        for k, pair in enumerate(zip(others, legs, strict=True)):
            bends[k, k] = self.mul(self.power(self.of("share", *pair), 2), inverse)
        return shares, bends

    def _of_one(self, operation: str, a: int, v: int, k: Any) -> tuple[int, int]:
        """First and second derivative of a function v of one argument a."""
        number, mul, add, sub, power, neg = (
            self.constant, self.mul, self.add, self.sub, self.power, self.neg
        )
        one, two = number(1.0), number(2.0)
        if operation == "pow":
            return (
                mul(number(k), power(a, k - 1)), mul(number(k * (k - 1)), power(a, k - 2))
            )
        if operation == "raised":
            c, lower = number(k), sub(number(k), one)
            # Exponents that are rounded would be others.
            exact = all(Fraction(k) - j == Fraction(k - j) for j in (1, 2))
            parts = [
                self.raised(a, k - j) if exact else mul(v, power(a, -j)) for j in (1, 2)
            ]
            return mul(c, parts[0]), mul(mul(c, lower), parts[1])
        if operation in ("exp", "expm1"):
            return (self.of("exp", a),) * 2
        if operation in ("log", "log1p"):
            base = add(one, a) if operation == "log1p" else a
            return power(base, -1), neg(power(base, -2))
        if operation == "sqrt":
            return mul(number(0.5), power(v, -1)), mul(number(-0.25), power(mul(a, v), -1))
        if operation in ("sin", "cos"):
            other = self.of("cos" if operation == "sin" else "sin", a)
            return other if operation == "sin" else neg(other), neg(v)
        if operation == "tan":
            return add(one, power(v, 2)), mul(two, add(v, power(v, 3)))
        if operation in ("sinh", "cosh"):
            return self.of("cosh" if operation == "sinh" else "sinh", a), v
        if operation == "tanh":
            return sub(one, power(v, 2)), mul(number(-2.0), self.of("t-t^3", v))
        if operation == "sigmoid":
            return self.of("t-t^2", v), self.of("t-3t^2+2t^3", v)
        if operation == "atan":
            return power(add(one, power(a, 2)), -1), self.of("atan''", a)
        if operation == "erf":
            pi = self.node("near", number(np.pi), parameter=4e-16)
            slope = mul(mul(two, power(self.of("sqrt", pi), -1)), self.of("exp", neg(power(a, 2))))
            return slope, mul(number(-2.0), mul(a, slope))
        if operation == "atanh":
            inverse = power(sub(one, power(a, 2)), -1)
            return inverse, mul(mul(two, a), power(inverse, 2))
        inside = {
            "asin": sub(one, power(a, 2)), "acos": sub(one, power(a, 2)),
            "asinh": add(one, power(a, 2)), "acosh": sub(power(a, 2), one),
        }[operation]
        inverse = power(self.of("sqrt", inside), -1)
        bent = mul(a, power(inverse, 3))
        return (neg(inverse) if operation == "acos" else inverse,
                bent if operation == "asin" else neg(bent))

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


_NUMBER = "number"
_EXACT: dict[str, Callable[..., Fraction]] = {"abs": abs, "max": max, "min": min}
_AT_ZERO = {
    **dict.fromkeys(("exp", "cos", "cosh"), 1.0),
    **dict.fromkeys(("sqrt", "sin", "tan", "asin", "atan", "sinh", "tanh", "asinh", "atanh", "erf",
                     "expm1", "log1p", "floor", "ceil", "trunc", "sign"), 0.0),
    "sigmoid": 0.5,
}


class _UnclearError(Exception):
    """A polynomial of too many terms, or none."""


class _Polynomials:
    """Nodes as polynomials with rational coefficients, where some nodes or atoms are others.

    Atoms are variables and what is no polynomial: they count as independent of each other.
    """

    def __init__(self, graph: Graph, known: dict[Any, Polynomial]) -> None:
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
                raise _UnclearError
            return _number(Fraction(parameter))
        if operation == "variable" or level > _MOST_LEVELS:
            return self._atom((node,))
        if operation in ("either", "jump"):
            holds = self._decided(arguments[0], level)
            return self._atom((node,)) if holds is None else self.of(
                arguments[1 if holds else 2], level
            )
        parts = [self.of(one, level) for one in arguments]
        if operation in ("add", "sub"):
            return _sum(*parts, 1 if operation == "add" else -1)
        if operation == "neg":
            return _sum({}, parts[0], -1)
        if operation == "near":
            return parts[0]
        if operation == "mul":
            return _product(*parts)
        if operation == "pow" and 0 < parameter < 5:
            found = parts[0]
            for _ in range(parameter - 1):
                found = _product(found, parts[0])
            return found
        if not all(set(part) <= {()} for part in parts):
            return self._atom((operation, parameter, *(frozenset(part.items()) for part in parts)))
        values = [part.get((), Fraction(0)) for part in parts]
        if operation in _EXACT:
            return _number(_EXACT[operation](*values))
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
        gap = _sum(self.of(sides[1], level), self.of(sides[0], level), -1)
        if not set(gap) <= {()}:
            return None
        value = gap.get((), Fraction(0))
        return value > 0 if operation == "less" else value >= 0 if operation == "atmost" else not value


def _number(value: Fraction) -> Polynomial:
    return {(): value} if value else {}


def _sum(a: Polynomial, b: Polynomial, sign: int) -> Polynomial:
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


class Program:
    """Some nodes of a graph, evaluated on many cells at once: equal operations together."""

    def __init__(self, graph: Graph, roots: Sequence[int]) -> None:
        self._graph = graph
        nodes = graph.ancestors(roots)
        self._order: list[int] = []
        waiting, users = {}, defaultdict(list)
        ready: dict[tuple[str, Any, int], list[int]] = defaultdict(list)
        leaves = []
        for node in nodes:
            operation, arguments, parameter = graph.nodes[node]
            waiting[node] = len(set(arguments))
            for one in set(arguments):
                users[one].append(node)
            if operation in ("variable", "constant", "unknown"):
                leaves.append(node)
        groups: list[tuple[tuple[str, Any, int], list[int]]] = []
        done = leaves
        while True:
            self._order += done
            for one in done:
                for user in users[one]:
                    waiting[user] -= 1
                    if not waiting[user]:
                        operation, arguments, parameter = graph.nodes[user]
                        ready[operation, parameter, len(arguments)].append(user)
            if not ready:
                break
            key = max(ready, key=lambda one: len(ready[one]))
            done = ready.pop(key)
            groups.append((key, done))
        self._place = place = {node: k for k, node in enumerate(self._order)}
        self._roots = np.array([place[root] for root in roots], np.intp)
        self._leaves = len(leaves)
        self._columns = [
            (k, graph.nodes[node][2]) for k, node in enumerate(leaves)
            if graph.nodes[node][0] == "variable"
        ]
        self._constants = np.array([
            graph.nodes[node][2] if graph.nodes[node][0] == "constant" else np.nan
            for node in leaves
        ])
        self._groups = []
        for (operation, parameter, count), members in groups:
            arguments = [
                np.array([place[graph.nodes[node][1][j]] for node in members], np.intp)
                for j in range(count)
            ]
            self._groups.append((
                OPERATIONS[operation], arguments, () if parameter is None else (parameter,),
                place[members[0]], place[members[0]] + len(members),
            ))

    def __call__(
        self, lower: Array, upper: Array, forced: dict[int, Array] | None = None
    ) -> Interval:
        """The nodes (roots, B) over cells (B, N), with the values (B,) of some unless NaN."""
        size = max(1, _HELD // max(1, len(self._order)))
        rows = [
            (self._place[node], values) for node, values in (forced or {}).items()
            if node in self._place
        ]
        parts = [
            self._held(
                lower[k : k + size], upper[k : k + size],
                [(row, values[k : k + size]) for row, values in rows],
            )[self._roots]
            for k in range(0, len(lower), size)
        ]
        return Interval(
            np.concatenate([one.low for one in parts], axis=1),
            np.concatenate([one.high for one in parts], axis=1),
        )

    def _held(
        self, lower: Array, upper: Array, forced: Sequence[tuple[int, Array]] = ()
    ) -> Interval:
        """All nodes, in order."""
        low, high = np.empty((2, len(self._order), len(lower)))
        low[: self._leaves] = high[: self._leaves] = self._constants[:, None]
        for row, column in self._columns:
            low[row], high[row] = lower[:, column], upper[:, column]
        with np.errstate(all="ignore"):
            for function, arguments, parameters, start, end in self._groups:
                found = function(*(Interval(low[a], high[a]) for a in arguments), *parameters)
                low[start:end], high[start:end] = found.low, found.high
                for row, values in forced:
                    if start <= row < end:
                        given = np.isfinite(values)
                        low[row, given] = high[row, given] = values[given]
        return Interval(low, high)

    def obstacle(self, lower: Array, upper: Array) -> str:
        """What is not defined on all of a cell (N,), in words; blank if all is."""
        values = self._held(lower[None], upper[None])
        place = self._place
        for k in self._roots:
            node = self._order[k]
            while not values.known[place[node], 0]:
                operation, arguments, parameter = self._graph.nodes[node]
                if operation in ("either", "jump"):
                    truth = values.low[place[arguments[0]], 0], values.high[place[arguments[0]], 0]
                    if truth in ((0.0, 0.0), (1.0, 1.0)):
                        arguments = (arguments[1 if truth[0] else 2],)
                unknown = [one for one in arguments if not values.known[place[one], 0]]
                if not unknown:
                    if operation == "unknown":
                        return f"{parameter}, of which no enclosure is known"
                    if operation == "constant":
                        return f"the value {parameter}"
                    return _UNDEFINED.get(operation, f"{operation} of a value out of its range")
                node = unknown[0]
        return ""


def read(graph: Graph, function: Any) -> list[int]:
    """The nodes of the entries that a casadi.Function returns, of one column of the variables."""
    ca = import_casadi()
    names = {getattr(ca, name): name[3:] for name in dir(ca) if name.startswith("OP_")}
    work: dict[int, int] = {}
    results = [graph.constant(0.0)] * function.numel_out(0)
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        inputs, outputs = function.instruction_input(k), function.instruction_output(k)
        if code == ca.OP_INPUT:
            work[outputs[0]] = graph.variables[inputs[1]]
        elif code == ca.OP_CONST:
            work[outputs[0]] = graph.constant(function.instruction_constant(k))
        elif code == ca.OP_OUTPUT:
            results[outputs[1]] = _settled(graph, work[inputs[0]])
        else:
            operation = _READ.get(names[code])
            work[outputs[0]] = (
                graph.node("unknown", parameter=names[code].lower()) if operation is None
                else operation(graph, *(work[one] for one in inputs))
            )
    return results


def _settled(graph: Graph, node: int) -> int:
    """A number in place of a condition, or of half of a choice."""
    operation, arguments, _ = graph.nodes[node]
    if operation == "pick":
        return graph.choice(*arguments, graph.constant(0.0))
    return graph.number(node)


def _pick(graph: Graph, c: int, a: int) -> int:
    c, a = graph.condition(_unless_condition(graph, c)), _settled(graph, a)
    return a if graph.value(a) == 0.0 else graph.of("pick", c, a)


def _unless_condition(graph: Graph, c: int) -> int:
    return c if graph.nodes[c][0] in _CONDITIONS else _settled(graph, c)


def _add(graph: Graph, a: int, b: int) -> int:
    if graph.nodes[a][0] == graph.nodes[b][0] == "pick":
        (c, first), (other, second) = graph.nodes[a][1], graph.nodes[b][1]
        if c == graph.negated(other):
            return graph.choice(c, first, second)
    return graph.add(_settled(graph, a), _settled(graph, b))


def _divided(graph: Graph, a: int, b: int) -> int:
    if graph.value(a) == 1.0 and graph.nodes[b][0] == "add":
        # 1 / (1 + exp(s)), whose derivatives are enclosed as those of one function.
        for one, other in (graph.nodes[b][1], graph.nodes[b][1][::-1]):
            if graph.value(one) == 1.0 and graph.nodes[other][0] == "exp":
                return graph.of("sigmoid", graph.neg(graph.nodes[other][1][0]))
    return graph.mul(a, graph.power(b, -1))


def _raised(graph: Graph, a: int, b: int) -> int:
    exponent = graph.value(b)
    if exponent is not None:
        return graph.raised(a, exponent)
    return graph.of("exp", graph.mul(b, graph.of("log", a)))


def _of_numbers(function: Callable[..., int]) -> Callable[..., int]:
    return lambda graph, *nodes: function(graph, *(_settled(graph, one) for one in nodes))


def _of_conditions(operation: str) -> Callable[..., int]:
    return lambda graph, *nodes: graph.of(
        operation, *(graph.condition(_unless_condition(graph, one)) for one in nodes)
    )


def _ordered(operation: str) -> Callable[..., int]:
    return _of_numbers(lambda graph, a, b: graph.of(operation, *sorted((a, b))))


_READ: dict[str, Callable[..., int]] = {
    "ADD": _add, "IF_ELSE_ZERO": _pick, "AND": _of_conditions("and"), "OR": _of_conditions("or"),
    "NOT": lambda graph, c: graph.negated(graph.condition(_unless_condition(graph, c))),
    "EQ": _ordered("equal"), "FMAX": _ordered("max"), "FMIN": _ordered("min"),
    "NE": _of_numbers(lambda graph, a, b: graph.negated(graph.of("equal", *sorted((a, b))))),
    **{name: _of_numbers(function) for name, function in {
        "SUB": Graph.sub, "MUL": Graph.mul, "NEG": Graph.neg, "DIV": _divided, "SQRT": Graph.root,
        "POW": _raised, "CONSTPOW": _raised, "SQ": lambda graph, a: graph.power(a, 2),
        "TWICE": lambda graph, a: graph.mul(graph.constant(2.0), a),
        "INV": lambda graph, a: _divided(graph, graph.constant(1.0), a),
        "ASSIGN": lambda graph, a: a, "LIFT": lambda graph, a, _: a,
        "LT": lambda graph, a, b: graph.of("less", a, b),
        "LE": lambda graph, a, b: graph.of("atmost", a, b),
        "FABS": lambda graph, a: graph.of("abs", a),
        "ATAN2": lambda graph, a, b: graph.of("angle", a, b),
        "HYPOT": lambda graph, a, b: graph.of("length", a, b),
        "FMOD": lambda graph, a, b: graph.sub(
            a, graph.mul(b, graph.of("trunc", _divided(graph, a, b)))),
        "COPYSIGN": lambda graph, a, b: graph.choice(
            graph.of("atmost", graph.constant(0.0), b), graph.of("abs", a),
            graph.neg(graph.of("abs", a))),
        **{name: (lambda graph, a, operation=name.lower(): graph.of(operation, a)) for name in (
            "EXP", "LOG", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "SINH", "COSH", "TANH",
            "ASINH", "ACOSH", "ATANH", "EXPM1", "LOG1P", "ERF", "FLOOR", "CEIL", "SIGN",
        )},
    }.items()},
}
