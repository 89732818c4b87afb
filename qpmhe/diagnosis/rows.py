"""Rows of a record that are missing, or there twice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from .bank import Array, Hypothesis
from .faults import Evidence, Fault

# Log likelihood that a jump of the state must gain to be looked at, and how near to a whole number
# of steps it must be. The most rows that are looked at, and the samples between two of them.
_GAIN, _WHOLE, _MOST, _APART = 8.0, 0.45, 64, 3
# Rows that are missing in one place: these numbers are tried.
_COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)


def dropped(evidence: Evidence) -> Iterator[Fault]:
    """Rows that are missing at single places: there the state moves by several steps.

    References
    ----------
    De Jong and Penzer, Diagnosing shocks in time series, Journal of the American Statistical
    Association 93 (1998), whose backward sweep yields the size of a jump at each sample.
    """
    null, base = evidence.null, evidence.base
    if not np.isfinite(null.logs).all():
        return
    moves = evidence.bank.following(null.states, evidence.inputs) - null.states
    sizes, gains = _jumps(evidence, moves)
    fits = (gains > _GAIN) & (sizes > 1.0 - _WHOLE)
    places = _peaks(np.where(fits, gains, 0.0))
    if not places:
        return
    for count in _COUNTS:
        yield _with_gaps(base, [places[0]], [count])
    near = [k for k in places if abs(sizes[k] - np.rint(sizes[k])) < _WHOLE]
    counts = [max(1, round(float(sizes[k]))) for k in near]
    some = 2
    while some // 2 < len(near):
        yield _with_gaps(base, near[:some], counts[:some])
        some *= 2


def doubled(evidence: Evidence) -> Iterator[Fault]:
    """Rows that are there twice: they repeat all numbers of the row before."""
    y, u = evidence.base.measurements, evidence.base.inputs
    there = np.isfinite(y)
    same = ((y[1:] == y[:-1]) | ~(there[1:] | there[:-1])).all(axis=1) & there[1:].any(axis=1)
    same &= (u[1:] == u[:-1]).all(axis=1)
    rows = np.flatnonzero(same) + 1
    if not rows.size or rows.size > len(y) // 2:
        return
    repeats, measured = _repeats(evidence.base), y.copy()
    repeats[rows - 1], measured[rows] = 0, np.nan
    changed = replace(evidence.base, measurements=measured, repeats=repeats)
    yield Fault("doubled", float(rows.size), changed, rows=tuple(rows.tolist()))


def _repeats(base: Hypothesis) -> Array:
    if base.repeats is None:
        return np.ones(len(base.measurements), np.intp)
    return np.array(base.repeats)


def _with_gaps(base: Hypothesis, places: list[int], counts: list[int]) -> Fault:
    """The record with so many rows missing before each of these."""
    repeats = _repeats(base)
    repeats[np.array(places) - 1] += counts
    rows = tuple(sorted(places))
    return Fault("dropped", float(sum(counts)), replace(base, repeats=repeats), rows=rows)


def _jumps(evidence: Evidence, moves: Array) -> tuple[Array, Array]:
    """Sizes of jumps of the state before each sample, in these moves, and their gains."""
    null, (total, n) = evidence.null, moves.shape
    errors = np.where(np.isfinite(null.innovations), null.innovations, 0.0)
    against, own = np.zeros(total), np.zeros(total)
    slope, spread = np.zeros(n), np.zeros((n, n))
    weighed = null.outputs.swapaxes(1, 2) @ null.weights
    slopes, spreads = (weighed @ errors[:, :, None])[:, :, 0], weighed @ null.outputs
    closed = null.transitions @ (np.eye(n) - null.gains @ null.outputs)
    for t in range(total - 1, -1, -1):
        turned = closed[t].T
        slope = slopes[t] + turned @ slope
        spread = spreads[t] + turned @ spread @ closed[t]
        if t:  # what the step before should have moved
            against[t], own[t] = moves[t] @ slope, moves[t] @ spread @ moves[t]
    sizes = np.divide(against, own, out=np.zeros(total), where=own > 0.0)
    return sizes, 0.5 * sizes * against


def _peaks(gains: Array) -> list[int]:
    """Samples that gain more than those beside them, the most first."""
    found: list[int] = []
    for k in np.argsort(-gains, kind="stable").tolist():
        if gains[k] <= 0.0 or len(found) == _MOST:
            break
        if all(abs(k - other) > _APART for other in found):
            found.append(k)
    return found
