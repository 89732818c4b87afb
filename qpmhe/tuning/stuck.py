"""Sensors that repeat a number: dead ones, and those that have reached an end of their range."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Repetitions in a row of a sensor whose numbers are not rounded, before it counts as dead.
_LEAST = 10
# Samples at an end of the range, and how many times those at the number next to it.
_AT_END, _MORE = 7, 3.0

# Of a step, how far its multiples may be off; of the noise, what a step that matters has at least.
_ROUNDING, _STEP = 1e-3, 0.5


def longest_repetition(y: Array) -> tuple[int, int]:
    """First and last sample of the longest row of equal numbers; NaN interrupts none."""
    there = np.flatnonzero(np.isfinite(y))
    if not there.size:
        return 0, -1
    changes = np.flatnonzero(np.diff(y[there]) != 0.0) + 1
    edges = np.concatenate(([0], changes, [there.size]))
    k = int(np.argmax(np.diff(edges)))
    return int(there[edges[k]]), int(there[edges[k + 1] - 1])


def is_dead(y: Array, first: int, last: int) -> bool:
    """Whether a row of equal numbers is longer than rounding explains."""
    inside = np.isfinite(y[first : last + 1]).sum()
    others = np.concatenate((y[:first], y[last + 1 :]))
    others = others[np.isfinite(others)]
    repeated = np.mean(np.diff(others) == 0.0) if others.size > 1 else 0.0
    # With this share of repetitions by rounding, a row of so many is as rare as one in a million.
    rare = np.log(1e-6 / max(y.size, 1)) / np.log(np.clip(repeated, 1e-3, 0.99))
    return bool(inside >= max(_LEAST, rare))


def is_rounded(y: Array, repeated: Mask, deviation: float) -> bool:
    """Whether a sensor's steps are not small beside the noise, so that it may repeat a number."""
    others = y[np.isfinite(y) & ~repeated]
    if others.size and np.unique(others).size < 0.5 * others.size:
        return True
    values = np.unique(y[np.isfinite(y)])
    if values.size < 2:
        return False
    multiples = (values - values[0]) / np.diff(values).min()
    return bool(
        (np.abs(multiples - np.rint(multiples)) < _ROUNDING).all()
        and np.diff(values).min() > _STEP * deviation
    )


def at_end_of_range(y: Array) -> tuple[Mask, bool]:
    """The samples at the largest or smallest number, and whether so many are stuck there."""
    for sign in (1.0, -1.0):
        values, counts = np.unique(sign * y[np.isfinite(y)], return_counts=True)
        if values.size < 3:
            continue
        if counts[-1] >= _AT_END and counts[-1] > _MORE * counts[-2]:
            return sign * y == values[-1], True
    return np.zeros(y.size, np.bool_), False


def comes_back(y: Array, first: int, last: int) -> bool:
    """Whether a row of equal numbers at an end of the range has others before and behind it."""
    there = np.isfinite(y)
    return bool(there[:first].any() and there[last + 1 :].any())
