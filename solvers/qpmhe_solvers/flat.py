"""All numbers of a QP in one array: looked at, and handed on, with few calls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .qp import QP

__all__ = ["FlatQP"]

Array = NDArray[np.float64]

_ONE = np.ones(1)


class FlatQP:
    """A kept copy of a QP's numbers, for QPs of one size.

    Constraints are numbered: the K n bounds first, then the K rows general rows.

    Parameters
    ----------
    stages, n, rows : int
        Sizes of the QP.

    Attributes
    ----------
    sizes : tuple of int
        stages, n, rows.
    numbers : array
        The band panels, the gradient, the own rows, the next rows, a 1, and the limits: first
        all lower, then all upper.
    gradient_at, own_at, one_at, lower_at, upper_at : int
        Where these start in ``numbers``; the band at 0, the next rows right behind the own.
    lower, upper : (K n + K rows,) array
        Views of the limits of all constraints.
    limits : array
        View of both, one behind the other.
    """

    __slots__ = (
        "_data", "gradient_at", "limits", "lower", "lower_at", "numbers", "one_at", "own_at",
        "sizes", "upper", "upper_at",
    )

    def __init__(self, stages: int, n: int, rows: int) -> None:
        size, general = stages * n, stages * rows
        self.sizes = (stages, n, rows)
        self.gradient_at = 2 * size * n
        self.own_at = self.gradient_at + size
        self.one_at = self.own_at + 2 * general * n
        self.lower_at = self.one_at + 1
        self.upper_at = self.lower_at + size + general
        self.numbers: Array = np.empty(self.upper_at + size + general)
        self._data = self.numbers[: self.one_at]
        self.limits = self.numbers[self.lower_at :]
        self.lower = self.numbers[self.lower_at : self.upper_at]
        self.upper = self.numbers[self.upper_at :]

    def __reduce__(self) -> tuple[type[FlatQP], tuple[int, int, int]]:
        return FlatQP, self.sizes  # views of a copied array would be arrays of their own

    def gather(self, qp: QP) -> None:
        """Copy the numbers of a QP."""
        np.concatenate(
            (
                qp.band, qp.gradient, qp.row_own, qp.row_next, _ONE,
                qp.lower, qp.row_lower, qp.upper, qp.row_upper,
            ),
            axis=None, out=self.numbers,
        )

    def fault(self) -> str:
        """What no solver must be given: NaN hangs some and comes back as success from others."""
        # Squares may overflow where the numbers do not: then each one is looked at.
        finite = math.isfinite(self._data.dot(self._data)) or np.isfinite(self._data).all()
        ordered = (self.lower <= self.upper).all()
        if finite and ordered:
            return ""
        if not finite or np.isnan(self.lower).any() or np.isnan(self.upper).any():
            return "the QP's data are not finite"
        return "the QP is infeasible: a lower bound is above its upper bound"
