"""Upper bounds of the floating-point operations of C functions, by walking their syntax trees."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from pycparser import c_ast

from .c_expressions import (
    INTEGER,
    REAL,
    Expressions,
    Frame,
    Known,
    UnboundedError,
    largest,
    name_of,
)
from .ranges import ANY, Place, exact, joined, joined_ranges, span, truth_of

__all__ = ["Known", "UnboundedError", "WorstCase"]

# A loop whose body costs another number in each iteration is summed up to so many iterations; a
# longer one costs as many times what its dearest iteration may.
_MOST_SUMMED = 600
# So many loops are looked at more closely; of later ones, the dearest iteration counts for all.
_MOST_WALKED = 4_000
# Neither operations nor functions of libm: signs, tests and copies.
_FREE = frozenset((
    "fabs", "isfinite", "isnan", "isinf", "signbit", "copysign", "memcmp", "memcpy", "memset",
    "memmove",
))


@dataclass
class _Flow:
    """Costs of a statement: where it is passed, and where it ends the function or an iteration."""

    passed: Counter[Any] | None
    left: Counter[Any] | None = None


class WorstCase(Expressions):
    """Bounds of what functions of a C source compute, with all branches taken that may be.

    Loops run as often as their conditions and constants allow. The bound is the sum over the
    iterations where each costs another number, exactly for triangular loops; of alternatives, the
    larger number of each kind of operation.
    """

    def operations(self, function: str) -> Counter[str]:
        """The most operations of a call, by kind, and calls of libm by name."""
        cost, _, _ = self._call(f"{self._prefix}{function}", [], {})
        for name, most in self._known.most_calls.items():
            calls = cost.pop(("calls", f"{self._prefix}{name}"), 0)
            if calls:
                own, _, _ = self._call(f"{self._prefix}{name}", None, {})
                cost.update(_times(min(calls, most), own))
        return cost

    # Functions

    def _call(
        self, name: str, given: list[Any] | None, before: dict[str, Any]
    ) -> tuple[Counter[Any], Any, dict[str, Any]]:
        """The cost of a call, what it returns, and what it leaves where its pointers point to."""
        node = self._functions[name]
        parameters = node.decl.type.args.params if node.decl.type.args else []
        names = [one.name for one in parameters if getattr(one, "name", None)]
        values = given if given is not None else []
        ranges = {**dict(zip(names, values, strict=False)), **before}
        ranges = {one: value for one, value in ranges.items() if value != ANY}
        key = name, tuple(sorted(ranges.items(), key=lambda one: one[0]))
        if key in self._done:
            return self._done[key]
        outer, spent = self._frame, self._spent
        kinds = {one.name: self._declared(one) for one in parameters if getattr(one, "name", None)}
        frame = self._frame = Frame(name, ranges, dict(kinds))
        try:
            flow = self._statement(node.body)
        finally:
            self._frame, self._spent = outer, spent
        if flow.passed is not None:
            _keep_results(frame)
        found = _larger(flow.passed, flow.left) or Counter(), (
            ANY if frame.returned is None else frame.returned
        ), frame.results or {}
        self._done[key] = found
        return found

    def _called(self, node: Any) -> tuple[Any, Any]:
        """A call in an expression."""
        arguments = node.args.exprs if node.args else []
        target = node.name
        while isinstance(target, (c_ast.UnaryOp, c_ast.Cast)):  # (*f)(x)
            target = target.expr
        name = target.name if isinstance(target, c_ast.ID) else ""
        name = self._frame.ranges[name] if isinstance(self._frame.ranges.get(name), str) else name
        if not isinstance(name, str) or not name:
            self._value(node.name)
        given, before, behind = [], {}, {}
        node_of = self._functions.get(name)
        parameters = node_of.decl.type.args.params if node_of and node_of.decl.type.args else []
        for k, one in enumerate(arguments):
            variable = self._pointed(one)
            is_address = isinstance(one, c_ast.UnaryOp) and variable is not None
            value = ANY if is_address else self._value(one)[1]
            is_own = isinstance(value, Place) and isinstance(value.base, str)
            given.append(ANY if is_own else value)
            own = parameters[k].name if k < len(parameters) else None
            if variable is None or own is None:
                continue
            before[f"*{own}"] = self._frame.ranges.get(variable, ANY)
            behind[f"*{own}"] = variable
        if node_of is None:
            if name in self._frame.types:
                raise UnboundedError(f"{self._frame.name} calls any function")
            for one in arguments:
                variable = self._pointed(one)
                if variable is not None:
                    self._assign(variable, ANY)
            self._count_library(name)
            kind = self._globals.get(name)
            return (kind[1] if kind else REAL), ANY
        kind = self._globals[name][1]
        if name.removeprefix(self._prefix) in self._known.most_calls:
            self._spent[("calls", name)] += 1
            for variable in behind.values():
                self._assign(variable, ANY)
            return kind, ANY
        cost, value, results = self._call(name, given, before)
        self._spent.update(cost)
        for own, variable in behind.items():
            self._assign(variable, results.get(own, ANY))
        return kind, value if kind == INTEGER else ANY

    def _pointed(self, node: Any) -> str | None:
        """The integer that an argument points to, if it is a variable's."""
        if isinstance(node, c_ast.UnaryOp) and node.op == "&":
            name = str(node.expr.name) if isinstance(node.expr, c_ast.ID) else ""
            return name if self._frame.types.get(name) == INTEGER else None
        if isinstance(node, c_ast.ID):
            kind = self._frame.types.get(node.name)
            return f"*{node.name}" if kind == ("to", INTEGER, None) else None
        return None

    def _count_library(self, name: str) -> None:
        name = name.removesuffix("f") if name not in ("erf", "isinf") else name
        if name == "sqrt":
            self._spent["square_roots"] += 1
        elif name and name not in _FREE:
            self._spent[name] += 1

    # Statements

    def _statement(self, node: Any) -> _Flow:
        if node is None or isinstance(node, (c_ast.EmptyStatement, c_ast.Pragma)):
            return _Flow(Counter())
        if isinstance(node, c_ast.Compound):
            return self._block(node.block_items or ())
        if isinstance(node, c_ast.DeclList):
            return self._block(node.decls)
        if isinstance(node, c_ast.If):
            return self._branch(node)
        if isinstance(node, (c_ast.For, c_ast.While, c_ast.DoWhile)):
            return self._loop(node)
        if isinstance(node, (c_ast.Return, c_ast.Break, c_ast.Continue)):
            cost = Counter[Any]()
            if isinstance(node, c_ast.Return):
                if node.expr is not None:
                    cost, value = self._measured(node.expr)
                    self._frame.returned = joined(self._frame.returned, value)
                _keep_results(self._frame)
            return _Flow(None, cost)
        if isinstance(node, c_ast.Decl):
            return _Flow(self._declare(node))
        if isinstance(node, c_ast.Switch):
            return self._switch(node)
        if isinstance(node, (c_ast.Case, c_ast.Default)):
            # Another case may lead behind what ends this one.
            inside = self._block(node.stmts)
            return _Flow(_larger(inside.passed, inside.left))
        if isinstance(node, (c_ast.Goto, c_ast.Label)):
            raise UnboundedError(f"{self._frame.name} has a {type(node).__name__.lower()}")
        return _Flow(self._measured(node)[0])

    def _block(self, items: Iterable[Any]) -> _Flow:
        whole = _Flow(Counter())
        for one in items:
            flow = self._statement(one)
            assert whole.passed is not None
            if flow.left is not None:
                whole.left = _larger(whole.left, whole.passed + flow.left)
            if flow.passed is None:
                whole.passed = None
                break
            whole.passed = whole.passed + flow.passed
        return whole

    def _declare(self, node: Any) -> Counter[Any]:
        kind = self._declared(node)
        self._frame.types[node.name] = kind
        self._frame.ranges.pop(node.name, None)
        self._frame.ranges.pop(f"*{node.name}", None)
        if node.init is None:
            return Counter()
        cost, value = self._measured(node.init)
        if kind == INTEGER or isinstance(value, Place):
            self._frame.ranges[node.name] = value
        return cost

    def _branch(self, node: Any) -> _Flow:
        cost, value = self._measured(node.cond)
        truth = truth_of(value)
        before, ends = self._frame.ranges, []
        flows = []
        for is_true, part in ((True, node.iftrue), (False, node.iffalse)):
            if truth not in (None, is_true):
                continue
            self._frame.ranges = dict(before)
            self._refine(node.cond, is_true)
            flow = self._statement(part)
            flows.append(flow)
            if flow.passed is not None:
                ends.append(self._frame.ranges)
        self._frame.ranges = joined_ranges(ends) if ends else before
        passed = [flow.passed for flow in flows if flow.passed is not None]
        left = [flow.left for flow in flows if flow.left is not None]
        return _Flow(
            cost + largest(passed) if passed else None, cost + largest(left) if left else None
        )

    def _switch(self, node: Any) -> _Flow:
        """All cases one after another; any of them may be the first, the last, or none."""
        cost = Counter(self._measured(node.cond)[0])
        changed: dict[str, Any] = {}
        self._collect(node.stmt, changed, False)
        for one in (*(node.stmt.block_items or ()), None):
            for name in changed:
                self._assign(name, ANY)
            flow = self._statement(one)
            cost.update(_larger(flow.passed, flow.left) or Counter())
        return _Flow(cost)

    def _loop(self, node: Any) -> _Flow:
        frame = self._frame
        total = Counter[Any]()
        if isinstance(node, c_ast.For) and node.init is not None:
            flow = self._statement(node.init)
            assert flow.passed is not None
            total.update(flow.passed)
        following = node.next if isinstance(node, c_ast.For) else None
        start, changes = dict(frame.ranges), self._changes(node)
        never = node.cond is not None and truth_of(self._measured(node.cond)[1]) is False
        if isinstance(node, c_ast.DoWhile):
            if not never or _reads(node.cond):  # what it reads may be another number by then
                raise UnboundedError(f"{frame.name} has a loop without a bound")
            flow = self._statement(node.stmt)
            return _Flow(_larger(flow.passed, flow.left))
        frame.ranges = dict(start)
        if never:
            return _Flow(total + self._measured(node.cond)[0])
        for name in changes:
            frame.ranges.pop(name, None)
            self._forget_places(name)
        trips, counter, step = self._trips(node, start, changes)
        if not trips:
            frame.ranges = dict(start)
            return _Flow(total + self._measured(node.cond)[0])
        if counter and changes.get(counter) != ((0, step) if step > 0 else (-step, 0)):
            counter = None  # changed elsewhere, too
        inside = dict(frame.ranges)
        for name, change in changes.items():
            low, high = span(start.get(name, ANY))
            if isinstance(change, tuple):
                down, up = change
                inside[name] = low - down * trips, high + up * trips
        if counter is not None:
            low, high = start.get(counter, ANY)
            inside[counter] = (low, high + step * max(trips - 1, 0)) if step > 0 else (
                low + step * max(trips - 1, 0), high
            )

        def once(**ranges: Any) -> Counter[Any]:
            frame.ranges = {**inside, **ranges}
            cost = Counter[Any]() if node.cond is None else self._measured(node.cond)[0]
            if node.cond is not None:
                self._refine(node.cond, True)
            flow = self._statement(node.stmt)
            cost.update(_larger(flow.passed, flow.left) or Counter())
            if following is not None:
                cost.update(self._measured(following)[0])
            return cost

        before, frame.assigned = frame.assigned, {}
        try:
            cost = self._all(once, counter, start, int(trips), step)
        except UnboundedError:
            self._find_invariant(once, inside, start, changes)
            cost = self._all(once, counter, start, int(trips), step)
        total.update(cost)
        assigned, frame.assigned = frame.assigned, before
        for name, value in assigned.items():
            before[name] = joined(before.get(name), value)
        frame.ranges = dict(inside)
        for name in changes:
            low, high = span(start.get(name, ANY))
            if name == counter:
                far = low + step * trips if step > 0 else high + step * trips
                frame.ranges[name] = (low, max(far, high)) if step > 0 else (min(far, low), high)
            elif isinstance(changes[name], tuple):
                down, up = changes[name]
                frame.ranges[name] = low - down * trips, high + up * trips
            elif changes[name] is None and name in assigned and name in start:
                frame.ranges[name] = joined(start[name], assigned[name])
            else:
                frame.ranges.pop(name, None)
        if node.cond is not None:  # the last time, in which it does not hold
            total.update(self._measured(node.cond)[0])
        return _Flow(total)

    def _find_invariant(
        self, once: Any, inside: dict[str, Any], start: dict[str, Any], changes: dict[str, Any]
    ) -> None:
        """Enter ranges of what a loop assigns, if one iteration does not leave them."""
        names = [one for one in changes if changes[one] is None and one in start]
        inside.update((one, start[one]) for one in names)
        for attempt in range(2):
            self._frame.assigned = {}
            once()
            for one in names:
                found = joined(inside[one], self._frame.assigned.get(one))
                if attempt and found != inside[one]:
                    raise UnboundedError(f"{self._frame.name} changes {one} in a loop")
                inside[one] = found

    def _all(
        self, once: Any, counter: Any, start: dict[str, Any], trips: int, step: int
    ) -> Counter[Any]:
        """The cost of all iterations, and what they leave behind."""
        low, high = ANY if counter is None else start[counter]
        is_summed = low == high and 1 < trips <= _MOST_SUMMED
        values = [low + k * step for k in range(trips)] if is_summed else []
        try:
            whole: Counter[Any] = once()
        except UnboundedError:  # perhaps only of all values together
            if not is_summed:
                raise
            whole = Counter()
            for one in values:
                whole.update(once(**{counter: (one, one)}))
            return whole
        self._walked += 1
        if not is_summed or not whole or self._walked > _MOST_WALKED:
            return _times(trips, whole)
        last, first = (once(**{counter: (one, one)}) for one in (values[-1], values[0]))
        if last == first == whole:
            return _times(trips, whole)
        total: Counter[Any] = first + last
        for one in values[1:-1]:
            total.update(once(**{counter: (one, one)}))
        return total

    def _trips(
        self, node: Any, start: dict[str, Any], changes: dict[str, Any]
    ) -> tuple[float, str | None, int]:
        """The most iterations of a loop, the variable that counts them, and its step."""
        best: tuple[float, str | None, int] = (math.inf, None, 0)
        conditions = [node.cond] if node.cond is not None else []
        while conditions:
            one = conditions.pop()
            if not isinstance(one, c_ast.BinaryOp):
                continue
            if one.op == "&&":
                conditions += [one.left, one.right]
                continue
            for op, left, right in (
                (one.op, one.left, one.right),
                (one.op.translate(str.maketrans("<>", "><")), one.right, one.left),
            ):
                found = self._trips_by(op, left, right, node, start, changes)
                if found is not None and found[0] < best[0]:
                    best = found
        if best[0] == math.inf:
            raise UnboundedError(f"{self._frame.name} has a loop without a bound")
        return best

    def _trips_by(
        self, op: str, left: Any, right: Any, node: Any, start: dict[str, Any],
        changes: dict[str, Any],
    ) -> tuple[float, str | None, int] | None:
        """The same by one condition, on a variable or a variable and a number."""
        shift = 0
        steps = self._steps(node)
        if isinstance(left, c_ast.BinaryOp) and left.op == "+" and isinstance(left.left, c_ast.ID):
            left, more = left.left, self._value(left.right)[1]
            if not exact(more):
                return None
            shift = int(more[0])
        elif isinstance(left, c_ast.UnaryOp) and left.op in ("p--", "p++"):  # while (limit-- > 0)
            left = left.expr
            if isinstance(left, c_ast.ID) and changes.get(left.name) in ((1, 0), (0, 1)):
                steps = {left.name: changes[left.name][1] - changes[left.name][0]}
        if isinstance(left, c_ast.UnaryOp) and left.op == "*" and isinstance(left.expr, c_ast.ID):
            name = f"*{left.expr.name}"
        elif isinstance(left, c_ast.ID):
            name = left.name
        else:
            return None
        step = steps.get(name, 0)
        if step and op == "!=":
            first, last = start.get(name), self._value(right)[1]
            if isinstance(first, Place) and isinstance(last, Place) and first.base == last.base:
                times, rest = divmod(last.offset - first.offset, step)
                return (times, None, 0) if times >= 0 and not rest else None
            (low, high), (least, most) = span(first if first else ANY), span(last)
            room = most - low if step > 0 else high - least
            is_met = high <= least if step > 0 else low >= most
            return (room, name, step) if is_met and abs(step) == 1 and room < math.inf else None
        if not step or op not in (("<", "<=") if step > 0 else (">", ">=")):
            return None
        low, high = span(start.get(name, ANY))
        least, most = span(self._value(right)[1])
        room = most - (low + shift) if step > 0 else high + shift - least
        trips = max(0, (room + 1 if len(op) == 2 else room) / abs(step))
        return (math.ceil(trips) if trips < math.inf else math.inf), name, step

    def _steps(self, node: Any) -> dict[str, int]:
        """The variables that each iteration changes by a number, and this number."""
        loop = node.next if isinstance(node, c_ast.For) else node.stmt
        if loop is node.stmt and _continues(loop):
            return {}
        parts = []
        if isinstance(loop, c_ast.ExprList):
            parts = loop.exprs
        elif isinstance(loop, c_ast.Compound):
            parts = loop.block_items or []
        elif loop is not None:
            parts = [loop]
        found: dict[str, int] = {}
        for one in parts:
            if isinstance(one, c_ast.UnaryOp) and one.op in ("p++", "++", "p--", "--"):
                name, by = name_of(one.expr), 1 if "+" in one.op else -1
            elif isinstance(one, c_ast.Assignment) and one.op in ("+=", "-="):
                value = self._value(one.rvalue)[1]
                if not exact(value):
                    continue
                name = name_of(one.lvalue)
                by = int(value[0]) * (1 if one.op == "+=" else -1)
            else:
                continue
            change = self._changes(node).get(name)
            # A change elsewhere may go further, but not back.
            one_way = isinstance(change, tuple) and not change[0 if by > 0 else 1]
            if name and one_way:
                found[name] = by
        return found

    def _changes(self, node: Any) -> dict[str, Any]:
        """What a loop changes: by how much at most, down and up, or None if that is not known."""
        if id(node) not in self._changed:
            found: dict[str, Any] = {}
            self._collect(node.stmt, found, False)
            self._collect(node.cond, found, False)
            if isinstance(node, c_ast.For):
                self._collect(node.next, found, False)
            self._changed[id(node)] = found
        return self._changed[id(node)]

    def _collect(self, node: Any, found: dict[str, Any], in_loop: bool) -> None:
        if node is None:
            return
        name = ""
        change: Any = None
        if isinstance(node, c_ast.UnaryOp) and node.op in ("p++", "++", "p--", "--"):
            name, change = name_of(node.expr), (0, 1) if "+" in node.op else (1, 0)
        elif isinstance(node, c_ast.Assignment):
            name = name_of(node.lvalue)
            if node.op in ("+=", "-=") and name:
                by = self._step_of(node.rvalue)
                change = by if node.op == "+=" else by and by[::-1]
        elif isinstance(node, c_ast.Decl):
            name = node.name or ""
        elif isinstance(node, c_ast.FuncCall) and node.args:
            for one in node.args.exprs:
                if isinstance(one, c_ast.UnaryOp) and one.op == "&":
                    found[name_of(one.expr)] = None
                elif isinstance(one, c_ast.ID):
                    found[f"*{one.name}"] = None
        if name:
            before = found.get(name, (0, 0))
            known = change is not None and before is not None
            if known and in_loop:  # so often as that one runs
                change = tuple(math.inf if one else 0 for one in change)
            found[name] = (before[0] + change[0], before[1] + change[1]) if known else None
        inner = in_loop or isinstance(node, (c_ast.For, c_ast.While, c_ast.DoWhile))
        for _, child in node.children():
            self._collect(child, found, inner)

    def _step_of(self, node: Any) -> tuple[float, float] | None:
        """By how much adding an expression changes a variable, down and up, whatever it reads."""
        if isinstance(node, c_ast.BinaryOp) and node.op in ("<", ">", "<=", ">=", "==", "!="):
            return 0, 1
        if _reads(node):
            return None
        low, high = span(self._measured(node)[1])
        return max(-low, 0), max(high, 0)


def _keep_results(frame: Frame) -> None:
    own = {name: value for name, value in frame.ranges.items() if name[0] == "*"}
    if frame.results is None:
        frame.results = own
        return
    frame.results = joined_ranges([frame.results, own])


def _reads(node: Any) -> bool:
    """Whether an expression is none of constants alone."""
    if isinstance(node, (c_ast.ID, c_ast.FuncCall)):
        return True
    return any(_reads(child) for _, child in node.children())


def _continues(node: Any) -> bool:
    """Whether a loop's body may go on with the next iteration before its end."""
    if isinstance(node, c_ast.Continue):
        return True
    return not isinstance(node, (c_ast.For, c_ast.While, c_ast.DoWhile)) and any(
        _continues(child) for _, child in node.children()
    )


def _larger(one: Counter[Any] | None, other: Counter[Any] | None) -> Counter[Any] | None:
    if one is None or other is None:
        return other if one is None else one
    return one | other


def _times(count: float, cost: Counter[Any]) -> Counter[Any]:
    return Counter({one: int(count) * number for one, number in cost.items()})
