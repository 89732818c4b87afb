"""Sensors that repeat a number: dead ones, and those that have reached an end of their range."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from .bank import Array, Mask
from .findings import Finding, Names, number

# Repetitions in a row of a sensor whose numbers are not rounded, before it counts as dead.
_LEAST = 10
# Samples at an end of the range, and how many times those at the number next to it.
_AT_END, _MORE = 7, 3.0
# Of a step, how far its multiples may be off; of the noise, what a step that matters has at least.
_ROUNDING, _STEP = 1e-3, 0.5


def stuck(
    y: Array, deviations: Array, names: Names, contradicts: Callable[[Mask, int], bool]
) -> Iterator[tuple[int, Mask, Finding]]:
    """Sensor, samples (T,) and finding of each sensor of y (T, p) that is stuck, or missing.

    `contradicts` says whether a filter expects other numbers at samples of a sensor.
    """
    for j, name in enumerate(names.outputs):
        column = y[:, j]
        seen = np.isfinite(column)
        if not seen.any():
            yield j, ~seen, Finding(
                "missing", f"Sensor {name} has no measurement.",
                "Check its column, or leave it out of the model.", "warning",
            )
            continue
        first, last = _longest_repetition(column)
        row = np.zeros(column.size, np.bool_)
        row[first : last + 1] = True
        at_end = _at_end_of_range(column)
        is_dead, is_saturated = _is_dead(column, row), bool(at_end.any())
        if (is_dead or is_saturated) and _is_rounded(column, row | at_end, deviations[j]):
            # A sensor with coarse steps repeats its numbers where little moves.
            is_dead, is_saturated = (
                found and contradicts(at, j)
                for found, at in ((is_dead, row), (is_saturated, at_end))
            )
        comes_back = seen[:first].any() and seen[last + 1 :].any()
        if is_saturated and ((at_end & ~row).any() or (at_end[first] and comes_back)):
            value = column[at_end][0]
            which = "largest" if value == np.nanmax(column) else "smallest"
            yield j, at_end, Finding(
                "saturated",
                f"Sensor {name} is saturated: {at_end[seen].mean():.0%} of its samples are stuck "
                f"at {number(value)}, the {which} one.",
                "Pass NaN where it is at the end of its range, or use one with a wider range.",
                where=names.span(*np.flatnonzero(at_end)[[0, -1]]),
            )
            if at_end[first]:
                continue
        if is_dead:
            stretch = names.between(first, last) or " throughout"
            yield j, row & seen, Finding(
                "dead", f"Sensor {name} is dead: it repeats {number(column[first])}{stretch}.",
                "Pass NaN for these samples, and check its cable and its power.",
                where=names.span(first, last),
            )


def _longest_repetition(y: Array) -> tuple[int, int]:
    """First and last sample of the longest row of equal numbers; NaN interrupts none."""
    there = np.flatnonzero(np.isfinite(y))
    changes = np.flatnonzero(np.diff(y[there]) != 0.0) + 1
    edges = np.concatenate(([0], changes, [there.size]))
    k = int(np.argmax(np.diff(edges)))
    return int(there[edges[k]]), int(there[edges[k + 1] - 1])


def _is_dead(y: Array, row: Mask) -> bool:
    """Whether a row of equal numbers is longer than rounding explains."""
    others = y[~row & np.isfinite(y)]
    repeated = np.mean(np.diff(others) == 0.0) if others.size > 1 else 0.0
    # With this share of repetitions by rounding, a row of so many is as rare as one in a million.
    rare = np.log(1e-6 / y.size) / np.log(np.clip(repeated, 1e-3, 0.99))
    return bool(np.isfinite(y[row]).sum() >= max(_LEAST, rare))


def _is_rounded(y: Array, repeated: Mask, deviation: float) -> bool:
    """Whether a sensor's steps are not small beside the noise, so that it may repeat a number."""
    others, values = y[np.isfinite(y) & ~repeated], np.unique(y[np.isfinite(y)])
    if others.size and np.unique(others).size < 0.5 * others.size:
        return True
    if values.size < 2:
        return False
    step = np.diff(values).min()
    multiples = (values - values[0]) / step
    whole = (np.abs(multiples - np.rint(multiples)) < _ROUNDING).all()
    return bool(whole and step > _STEP * deviation)


def _at_end_of_range(y: Array) -> Mask:
    """The samples at the largest or smallest number, if so many are stuck there."""
    for sign in (1.0, -1.0):
        values, counts = np.unique(sign * y[np.isfinite(y)], return_counts=True)
        if values.size >= 3 and counts[-1] >= _AT_END and counts[-1] > _MORE * counts[-2]:
            return np.asarray(sign * y == values[-1])
    return np.zeros(y.size, np.bool_)
