"""Lengths of initial errors, and how norms of two matrices compare."""

from __future__ import annotations

import math

import numpy as np

from .._checks import Array
from ..errors import ShapeError
from .inequalities import Matrices, definite
from .sizes import OUTWARD, UNIT, Size, lengths_of

#: How much larger than computed a verified bound may be, tried in turn.
SLACKS = (1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2)


def initial_length(error: Size, weight: Array) -> float:
    """|e|_W from an initial error: a vector (n,), a bound on its length, or a set that holds it."""
    found = lengths_of("initial_error", error, weight)
    if found.ndim:
        raise ShapeError("initial_error has several samples; expected the error at the first one.")
    return float(found)


def largest_ratio(metric: Array, other: Array) -> float:
    """A number c with |e|_P <= c |e|_M for all e, P the first and M the other metric."""
    from scipy.linalg import eigh

    units = 1.0 / np.sqrt(other.diagonal())
    metric, other = np.outer(units, units) * metric, np.outer(units, units) * other
    top = float(eigh(metric, other, eigvals_only=True)[-1])
    for slack in SLACKS:
        found = top * (1.0 + slack)
        scaled = metric[None] / found
        rest = Matrices(other[None], 4.0 * UNIT * np.abs(other[None])) - Matrices(
            scaled, 6.0 * UNIT * np.abs(scaled)
        )
        if found > 0.0 and definite(rest)[0].all():
            return math.sqrt(found) * OUTWARD
    return math.inf
