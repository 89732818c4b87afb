"""What is known of integers and pointers at a place in C: ranges, and their arithmetic."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

#: A bound of an integer, both ends included.
Range = tuple[float, float]
ANY: Range = (-math.inf, math.inf)
TRUTH: Range = (0, 1)


@dataclass(frozen=True)
class Place:
    """A pointer: into a constant array of integers, or into what another variable points to."""

    base: tuple[int, ...] | str
    offset: int


def exact(value: Any) -> bool:
    """Whether it is one number."""
    return isinstance(value, tuple) and value[0] == value[1]


def span(value: Any) -> Range:
    """The range; any where it is a pointer."""
    return value if isinstance(value, tuple) else ANY


def truth_of(value: Any) -> bool | None:
    """Whether it is not 0, if that is known."""
    low, high = span(value)
    if low == high == 0:
        return False
    return True if low > 0 or high < 0 else None


def joined(one: Any, other: Any) -> Any:
    """What covers both; None stands for nothing yet."""
    if one is None or other is None:
        return other if one is None else one
    if one == other:
        return one
    (a, b), (c, d) = span(one), span(other)
    return min(a, c), max(b, d)


def joined_ranges(ends: list[dict[str, Any]]) -> dict[str, Any]:
    """What is known at the end of all of some ways."""
    first, *others = ends
    return {
        name: joined_all([value, *(one[name] for one in others)])
        for name, value in first.items() if all(name in one for one in others)
    }


def joined_all(values: list[Any]) -> Any:
    """What covers all."""
    found = values[0]
    for one in values[1:]:
        found = joined(found, one)
    return found


def compared(op: str, left: Any, right: Any) -> Range:
    """The range of a comparison."""
    (a, b), (c, d) = span(left), span(right)
    if op in (">", ">="):
        return compared({">": "<", ">=": "<="}[op], right, left)
    if op in ("<", "<="):
        equal = op == "<="
        if b < c or (equal and b <= c):
            return 1, 1
        return (0, 0) if a > d or (not equal and a >= d) else TRUTH
    same = op == "=="
    if b < c or a > d:
        return int(not same), int(not same)
    return (int(same),) * 2 if a == b == c == d else TRUTH


def arithmetic(op: str, left: Range, right: Range) -> Range:
    """The range of a sum, a product or another operation of integers."""
    (a, b), (c, d) = left, right
    if op == "+":
        return a + c, b + d
    if op == "-":
        return a - d, b - c
    if op == "*":
        ends = [0 if 0 in (x, y) else x * y for x in (a, b) for y in (c, d)]
        return min(ends), max(ends)
    if op == "/" and c == d > 0:
        ends = [x if math.isinf(x) else int(x / c) for x in (a, b)]
        return min(ends), max(ends)
    if op == "%" and c == d > 0:
        if a == b:
            return (math.fmod(a, c),) * 2 if math.isfinite(a) else ANY
        return (0 if a >= 0 else 1 - c), min(c - 1, b) if a >= 0 else c - 1
    if op == "&" and a == b and c == d:
        return (int(a) & int(c),) * 2
    if op == "&" and (a >= 0 or c >= 0):
        return 0, min(one for one, least in ((b, a), (d, c)) if least >= 0)
    if op in ("|", "&", "^") and a >= 0 and b <= 1 and c >= 0 and d <= 1:
        return 0, 1
    return ANY
