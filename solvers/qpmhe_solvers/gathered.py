"""All numbers of a QP in one array: looked at, and handed on, with few calls."""

from __future__ import annotations

import math

import numpy as np

from .qp import QP, Array

__all__ = ["GatheredQP"]

_ONE = np.ones(1)
_peaks, _all = np.maximum.reduceat, np.logical_and.reduce
# Spread of the Hessian's diagonal over the stages at which the least known stage, rather than the
# best, is what the accuracy is for; and below which share double precision has none.
_SPREAD, _LEAST = 2.0**10, 2.0**-34


class GatheredQP(QP):
    """A QP whose arrays are views of one array, which is filled anew for each QP of its sizes.

    Constraints are numbered: the K n bounds first, then the K rows general rows.

    Attributes
    ----------
    sizes : tuple of int
        stages, n, rows.
    numbers : array
        The band panels, the gradient, the own rows, the next rows, a 1, and the limits: first
        all lower, then all upper.
    gradient_at, own_at, one_at, lower_at, upper_at : int
        Where these start in ``numbers``; the band at 0, the next rows right behind the own.
    all_lower, all_upper : (K n + K rows,) array
        Views of the limits of all constraints.
    limits : array
        View of both, one behind the other.
    key : int
        Name of the scale that the numbers are in.
    """

    __slots__ = (
        "_data", "_diagonal", "_entries", "_magnitudes", "_negated", "_ordered", "_positive",
        "_seen", "_starts", "_steps", "all_lower", "all_upper", "gradient_at", "key", "limits",
        "lower_at", "numbers", "one_at", "own_at", "sizes", "upper_at",
    )

    def __init__(self, stages: int, n: int, rows: int) -> None:
        self.stages, self.n, self.rows, self.size = stages, n, rows, stages * n
        self.sizes, self.bounded, self.key = (stages, n, rows), True, 0
        size, general = stages * n, stages * rows
        self.gradient_at = 2 * size * n
        self.own_at = self.gradient_at + size
        self.one_at = self.own_at + 2 * general * n
        self.lower_at = self.one_at + 1
        self.upper_at = self.lower_at + size + general
        self.numbers: Array = np.empty(self.upper_at + size + general)
        self._data = self.numbers[: self.one_at]
        self.limits = self.numbers[self.lower_at :]
        self.all_lower = self.numbers[self.lower_at : self.upper_at]
        self.all_upper = self.numbers[self.upper_at :]
        self.band = self._data[: self.gradient_at].reshape(stages, n, 2 * n)
        self.gradient = self._data[self.gradient_at : self.own_at].reshape(stages, n)
        self.row_own, self.row_next = self._data[self.own_at :].reshape(2, stages, rows, n)
        self.lower, self.upper = (
            limits[:size].reshape(stages, n) for limits in (self.all_lower, self.all_upper)
        )
        self.row_lower, self.row_upper = (
            limits[size:].reshape(stages, rows) for limits in (self.all_lower, self.all_upper)
        )
        self._ordered = np.empty(self.all_lower.size, np.bool_)
        self._prepare_peaks()

    @classmethod
    def of(cls, qp: QP) -> GatheredQP:
        """The QP itself, or its numbers in one array."""
        if isinstance(qp, GatheredQP):
            return qp
        gathered = cls(qp.stages, qp.n, qp.rows)
        gathered.gather(qp)
        return gathered

    def __reduce__(self) -> tuple[object, tuple[QP]]:
        return GatheredQP.of, (self.copy(),)  # views of a copied array would be arrays of their own

    def _prepare_peaks(self) -> None:
        """Find the entries that `peaks` looks at, in groups."""
        stages, n, rows = self.sizes
        diagonal = np.arange(self.gradient_at).reshape(stages, n, 2 * n)[:, :, 0].T
        own, following = np.arange(self.own_at, self.one_at).reshape(2, stages, rows, n)
        groups = list(diagonal)
        groups += [  # the last stage's G is never read
            np.concatenate((own[:, row], following[:-1, row]), axis=None) for row in range(rows)
        ]
        gradient = np.arange(self.gradient_at, self.own_at).reshape(stages, n).T
        # Gradients, then steps, then violations at zero, which are lower - 0 and 0 - upper, then
        # the diagonal with the other sign, whose largest entries are its smallest.
        groups += [gradient.ravel(), gradient.ravel(), np.arange(self.lower_at, self.numbers.size)]
        groups += list(diagonal)
        self._entries = np.concatenate(groups, axis=None)
        seen = self._seen = np.empty(self._entries.size)
        size, limits = self.size, self.limits.size
        magnitudes = seen.size - limits - size
        self._magnitudes, self._diagonal = seen[:magnitudes], seen[:size]
        self._steps = seen[magnitudes - size : magnitudes]
        self._negated = seen[magnitudes + limits // 2 :]
        self._positive = np.empty(size, np.bool_)
        self._starts = np.cumsum([0] + [group.size for group in groups[:-1]])

    def gather(self, qp: QP) -> None:
        """Copy the numbers of a QP."""
        np.concatenate(
            (
                qp.band, qp.gradient, qp.row_own, qp.row_next, _ONE,
                qp.lower, qp.row_lower, qp.upper, qp.row_upper,
            ),
            axis=None, out=self.numbers,
        )
        self.bounded = qp.bounded

    def peaks(self) -> list[float]:
        """What says how well the numbers are scaled, the signs left out."""
        # Any mode but the default one writes into ``out`` without a buffer between.
        self.numbers.take(self._entries, out=self._seen, mode="clip")
        diagonal, steps, positive = self._diagonal, self._steps, self._positive
        np.absolute(self._magnitudes, out=self._magnitudes)
        np.greater(diagonal, 0.0, out=positive)
        np.divide(steps, diagonal, out=steps, where=positive)
        np.negative(self._negated, out=self._negated)
        found: list[float] = _peaks(self._seen, self._starts).tolist()
        n = self.n
        negated = found[-n:]
        slope, step, missed = found[-n - 3 : -n]
        del found[-n - 2 :]
        found[-1] = max(min(slope, step), missed)
        for at, low in enumerate(negated):
            most = found[at]
            if -low * _SPREAD < most:
                found[at] = min(most, _SPREAD * max(-low, _LEAST * most))
        return found

    def fault(self) -> str:
        """What no solver must be given: NaN hangs some and comes back as success from others."""
        # Squares may overflow where the numbers do not: then each one is looked at.
        finite = math.isfinite(self._data.dot(self._data)) or np.isfinite(self._data).all()
        ordered = _all(np.less_equal(self.all_lower, self.all_upper, out=self._ordered))
        if finite and ordered:
            return ""
        if not finite or np.isnan(self.all_lower).any() or np.isnan(self.all_upper).any():
            return "the QP's data are not finite"
        return "the QP is infeasible: a lower bound is above its upper bound"
