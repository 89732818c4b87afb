"""A QP in the form of qpsolvers: laid out once for a pattern of limits, then only filled."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .patterns import Pattern, chosen_rows, hessian_pattern
from .qp import QP

__all__ = ["QpsolversMatrices", "pattern_of_limits"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_ONE = np.ones(1)


def pattern_of_limits(qp: QP) -> Hashable:
    """What `QpsolversMatrices` depends on: the sizes, and which limits are finite or equal."""
    return (
        qp.stages, qp.n, qp.rows,
        np.isfinite(qp.lower).tobytes(), np.isfinite(qp.upper).tobytes(),
        np.isfinite(qp.row_lower).tobytes(), np.isfinite(qp.row_upper).tobytes(),
        (qp.row_lower == qp.row_upper).tobytes(),
    )


class QpsolversMatrices:
    r"""The arrays of a QP in the form of qpsolvers, for one pattern of limits.

    .. math::
        \min_x \tfrac12 x^\top P x + q^\top x \quad \text{s.t.} \quad
        G x \le h, \quad A x = b, \quad l \le x \le u

    G takes the general rows with a finite upper side, then those with a finite lower side,
    negated, then likewise the bounds, unless these go to l and u. A takes the general rows
    whose sides are equal.

    Parameters
    ----------
    qp : QP
        Any problem with the sizes and the pattern.
    dense : bool
        Whether P, G and A are dense arrays; otherwise CSC matrices with sorted indices.
    box : bool
        Whether bounds go to l and u.
    needs_row : bool
        Whether a G without rows gets a void one.
    keep_empty : bool
        Whether a G or A without rows is given as such, not as None.
    objective : float
        Factor of P and q.

    Attributes
    ----------
    arguments : tuple
        P, q, G, h, A, b, l, u, made once; None for what there is not.
    """

    def __init__(
        self, qp: QP, *, dense: bool, box: bool, needs_row: bool, keep_empty: bool,
        objective: float = 1.0,
    ) -> None:
        size, count = qp.size, qp.size + qp.stages * qp.rows
        rows = _Rows.of(qp, box)
        self._multipliers = _Multipliers(rows, size, count)
        self._objective = objective
        # Where the numbers stand in `_numbers`, in the order in which `fill` puts them there.
        gradient = qp.band.size + np.arange(size)
        lower = qp.band.size + size + np.arange(count)
        upper = lower + count
        own = qp.band.size + size + 2 * count
        one = own + 2 * qp.row_own.size
        self._numbers = np.empty(one + 1)

        inequality, sign = rows.inequality, rows.sign
        side = np.where(sign > 0, upper[inequality], lower[inequality])
        if needs_row and not inequality.size:
            inequality, sign, side = np.array([count]), np.ones(1), np.array([one])  # 0 x <= 1
        p = hessian_pattern(qp.stages, qp.n)
        g, a = (
            chosen_rows(qp.stages, qp.n, qp.rows, chosen)
            for chosen in (inequality, rows.equality)
        )
        empty = 0 if keep_empty else None
        above, level = side.size or empty, rows.equality.size or empty
        box_height, boxed = (size, slice(size)) if rows.boxed else (None, slice(0))
        parts = (
            _Part(size, p.source, objective, p), _Part(size, gradient, objective),
            _Part(above, own + g.source, sign[g.rows], g), _Part(above, side, sign),
            _Part(level, own + a.source, 1.0, a), _Part(level, upper[rows.equality]),
            _Part(box_height, lower[boxed]), _Part(box_height, upper[boxed]),
        )
        self._source = np.concatenate([part.source for part in parts])
        self._sign = np.concatenate([np.full(part.source.size, part.sign) for part in parts])
        self._values = np.empty(self._source.size)
        ends = np.cumsum([part.source.size for part in parts])
        self._matrices: list[tuple[Array, Any, Array]] = []
        self.arguments = tuple(
            self._array(part, values, size, dense)
            for part, values in zip(parts, np.split(self._values, ends[:-1]), strict=True)
        )

    def _array(self, part: _Part, values: Array, width: int, dense: bool) -> Any:
        """A vector, which is its values, or a matrix, into which they are to be copied."""
        pattern, height = part.pattern, part.height
        if height is None:
            return None
        if pattern is None:
            return values
        if dense:
            full = np.zeros((height, width))
            places = pattern.rows.astype(np.intp) * width + pattern.columns
            self._matrices.append((full.reshape(-1), places, values))
            return full
        from scipy.sparse import csc_matrix

        # Numbers of its own: of a view into a larger array scipy may make a copy unasked.
        # Indices of its own, too: those of the patterns are shared.
        matrix = csc_matrix(
            (np.zeros(values.size), pattern.rows.copy(), pattern.indptr.copy()),
            shape=(height, width),
        )
        self._matrices.append((matrix.data, slice(None), values))
        return matrix

    def fill(self, qp: QP) -> None:
        """Write the numbers of a QP into the arguments."""
        np.concatenate(
            (
                qp.band, qp.gradient, qp.lower, qp.row_lower, qp.upper, qp.row_upper,
                qp.row_own, qp.row_next, _ONE,
            ),
            axis=None, out=self._numbers,
        )
        # Any mode but the default one writes into ``out`` without a buffer between.
        self._numbers.take(self._source, out=self._values, mode="clip")
        np.multiply(self._values, self._sign, out=self._values)
        for target, places, values in self._matrices:
            target[places] = values

    def multipliers(self, answer: Any) -> tuple[Array | None, Array | None]:
        """Multipliers of the QP's bounds and rows; None twice where some are missing."""
        return self._multipliers.of(answer, 1.0 / self._objective)


class _Part(NamedTuple):
    """An argument: its rows, None if it is not given; its numbers; their places in a matrix."""

    height: int | None
    source: Index
    sign: Array | float = 1.0
    pattern: Pattern | None = None


class _Rows(NamedTuple):
    """Which constraints (bounds, then general rows) become rows."""

    inequality: Index
    sign: Array
    equality: Index
    boxed: bool

    @staticmethod
    def of(qp: QP, box: bool) -> _Rows:
        """The order of rows that `QpsolversMatrices` promises."""
        size = qp.size
        lower = np.concatenate((qp.lower, qp.row_lower), axis=None)
        upper = np.concatenate((qp.upper, qp.row_upper), axis=None)
        equal = lower == upper
        equal[:size] = False
        above, below = (np.flatnonzero(np.isfinite(side) & ~equal) for side in (upper, lower))
        sides = [above[above >= size], below[below >= size]]
        bounds = [above[above < size], below[below < size]]
        if not box:
            sides += bounds
        sign = np.repeat(np.resize([1.0, -1.0], len(sides)), [side.size for side in sides])
        boxed = box and any(bound.size for bound in bounds)
        return _Rows(np.concatenate(sides), sign, np.flatnonzero(equal), boxed)


class _Multipliers:
    """Multipliers of the constraints, added up from those of the rows and the box."""

    def __init__(self, rows: _Rows, size: int, count: int) -> None:
        ends = np.cumsum([rows.sign.size, rows.equality.size, size if rows.boxed else 0])
        self._size, self._given = size, np.zeros(ends[-1] + 1)  # the last one stays 0
        self._parts = np.split(self._given, ends)[:-1]
        # Each constraint's multiplier is one of these less one of those.
        self._upper, self._lower = np.full((2, count), ends[-1])
        self._upper[rows.inequality[rows.sign > 0]] = np.flatnonzero(rows.sign > 0)
        self._lower[rows.inequality[rows.sign < 0]] = np.flatnonzero(rows.sign < 0)
        self._upper[rows.equality] = np.arange(ends[0], ends[1])
        if rows.boxed:
            self._upper[:size] = np.arange(ends[1], ends[2])

    def of(self, answer: Any, unit: float) -> tuple[Array | None, Array | None]:
        for values, part in zip((answer.z, answer.y, answer.z_box), self._parts, strict=True):
            if part.size == 0:
                continue
            numbers = np.empty(0) if values is None else np.asarray(values, np.float64).ravel()
            if numbers.size < part.size:
                return None, None
            part[...] = numbers[: part.size]
        duals = unit * (self._given[self._upper] - self._given[self._lower])
        return duals[: self._size], duals[self._size :]
