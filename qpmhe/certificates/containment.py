"""Whether one region lies within another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..sets import ConvexSet
from .regions import Region, dual_bound, inequalities

__all__ = ["beyond"]

Array = NDArray[np.float64]


def beyond(inner: Region, outer: Region) -> str:
    """Where a region reaches beyond another, in words; empty if it lies within it.

    Sides are compared as they are, general inequalities by the largest value that their row
    is shown to take on the inner region: by intervals, or by duality, rounded outward.

    Parameters
    ----------
    inner, outer : Region
        The regions; an outer one whose inputs are not bounded allows all of them.
    """
    n = inner.n
    if outer.n != n:
        return f"it has {n} states instead of {outer.n}"
    told = _sides("x", inner.lower[:n], inner.upper[:n], outer.states.lower, outer.states.upper)
    if outer.lower.size > n:
        told = told or _sides("u", inner.lower[n:], inner.upper[n:], outer.lower[n:],
                              outer.upper[n:])
    return told or _rows(inner, outer.states)


def _sides(letter: str, low: Array, high: Array, outer_low: Array, outer_high: Array) -> str:
    for j in range(low.size):
        if low[j] < outer_low[j] or high[j] > outer_high[j]:
            return (
                f"{letter}[{j}] in [{low[j]:.6g}, {high[j]:.6g}] is not within "
                f"[{outer_low[j]:.6g}, {outer_high[j]:.6g}]"
            )
    return ""


def _rows(inner: Region, outer: ConvexSet) -> str:
    own, sides = inequalities(inner.states)
    rows = np.vstack((outer.matrix, -outer.matrix))
    limits = np.append(outer.row_upper, -outer.row_lower)
    for row, limit in zip(rows, limits, strict=True):
        if not np.isfinite(limit):
            continue
        same = (own == row).all(axis=1)
        if same.any() and sides[same].min() <= limit:
            continue
        most = _largest(inner, own, sides, row)
        if not most <= limit:
            return (
                f"the inequality {np.round(row, 6).tolist()} x <= {limit:.6g} is not shown to hold "
                f"on it: the left-hand side may be {most:.6g}"
            )
    return ""


def _largest(region: Region, G: Array, g: Array, row: Array) -> float:
    """An upper bound on row^T x over the region."""
    n, eps = region.n, float(np.finfo(np.float64).eps)
    low, high = region.lower[:n], region.upper[:n]
    size = np.maximum(np.abs(low), np.abs(high))
    rounding = 4.0 * (n + 2) * eps * float(np.abs(row) @ size)
    by_box = float(np.maximum(row * low, row * high).sum()) + rounding
    if region.is_box:
        return by_box
    side, residual = dual_bound(G, g, row)
    by_duality = side + (residual + 4.0 * eps) * float(size.max())
    return min(by_box, by_duality) if np.isfinite(by_duality) else by_box
