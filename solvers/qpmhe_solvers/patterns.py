"""Where the entries of a QP's matrices stand, found once for each size."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["Pattern", "chosen_rows", "hessian_pattern", "rows_pattern"]


@dataclass(frozen=True)
class Pattern:
    """Where the entries of a sparse matrix come from; they run by column, then by row."""

    source: NDArray[np.intp]
    rows: NDArray[np.int32]
    columns: NDArray[np.intp]
    indptr: NDArray[np.int32]


@lru_cache(maxsize=256)
def hessian_pattern(stages: int, n: int) -> Pattern:
    """H in full, (K n, K n), from the flat band panels."""
    k, c, b, r = np.ix_(np.arange(stages), np.arange(n), np.arange(-1, 2), np.arange(n))
    row, column = (k + b) * n + r, k * n + c + 0 * (b + r)
    valid = (k + b >= 0) & (k + b < stages) & (c + r >= 0)
    low, high = np.minimum(row, column), np.maximum(row, column)
    return _sorted_pattern(low * 2 * n + (high - low), row + 0 * c, column, valid, stages * n)


@lru_cache(maxsize=256)
def rows_pattern(stages: int, n: int, m: int) -> Pattern:
    """The general rows [F, G], (K m, K n), from the flat own rows, followed by the next rows."""
    k, c, b, r = np.ix_(np.arange(stages), np.arange(n), np.arange(-1, 1), np.arange(m))
    row, column = (k + b) * m + r + 0 * c, k * n + c + 0 * (b + r)
    valid = (k + b >= 0) & (c + r >= 0)
    source = row * n + c + np.where(b < 0, stages * m * n, 0)
    return _sorted_pattern(source, row, column, valid, stages * n)


def chosen_rows(stages: int, n: int, m: int, rows: NDArray[np.intp]) -> Pattern:
    """Some rows of all constraints [I; F, G; 0], (K n + K m + 1, K n)."""
    source, columns, starts, counts = _constraints(stages, n, m)
    taken = counts[rows]
    first = np.cumsum(taken) - taken
    entry = np.repeat(starts[rows] - first, taken) + np.arange(taken.sum())
    order = np.argsort(columns[entry], kind="stable")
    row, entry = np.repeat(np.arange(rows.size), taken)[order], entry[order]
    return _sorted_pattern(
        source[entry], row, columns[entry], np.ones(entry.size, dtype=bool), stages * n
    )


@lru_cache(maxsize=256)
def _constraints(stages: int, n: int, m: int) -> tuple[NDArray[np.intp], ...]:
    """Source and column of all entries, row by row; start and count of each row."""
    unit, general = np.arange(stages * n), rows_pattern(stages, n, m)
    row = np.concatenate((unit, unit.size + general.rows))
    order = np.argsort(row, kind="stable")
    source = np.concatenate((np.full(unit.size, 2 * stages * m * n), general.source))[order]
    columns = np.concatenate((unit, general.columns))[order]
    counts = np.bincount(row, minlength=unit.size + stages * m + 1)
    return source, columns, np.cumsum(counts) - counts, counts


def _sorted_pattern(
    source: NDArray[np.intp],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    valid: NDArray[np.bool_],
    width: int,
) -> Pattern:
    """Drop the invalid entries of arrays that already run by column, then by row."""
    counts = np.bincount(columns[valid], minlength=width)
    return Pattern(
        source=source[valid],
        rows=rows[valid].astype(np.int32),
        columns=columns[valid],
        indptr=np.concatenate(([0], np.cumsum(counts))).astype(np.int32),
    )
