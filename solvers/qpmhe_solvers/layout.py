"""A QP in the form of native solvers: laid out once per structure, then filled in place."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .qp import QP, Array, Places, as_csc, hessian_pattern, rows_pattern

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix, csr_matrix

Flags = NDArray[np.bool_]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class QPStyle:
    """How one solver wants its QP."""

    matrices: Literal["csc", "dense"]
    triangle: Literal["upper", "full"] = "full"
    bounds: Literal["box", "rows"] = "box"
    equalities: Literal["apart", "among"] = "apart"
    sides: Literal[1, 2] = 2
    infinite: bool = True
    needs_row: bool = False
    objective: float = 1.0


class QPStructure(NamedTuple):
    """Which limits a layout has room for, constraint by constraint; bounds come first.

    A limit that is finite at any stage but the last has room at all of these, so that limits
    which come and go with missing measurements leave the structure as it is.
    """

    lower: Flags
    upper: Flags
    equal: Flags

    @staticmethod
    def of(qp: QP, *, exact: bool = False, bounds: bool = False) -> QPStructure:
        """The structure that a QP needs; with room for its own limits only, if exact.

        Equal bounds of an unknown are an equality if ``bounds``, where they become rows: active-set
        methods call two rows that face each other infeasible.
        """
        stages, n, rows = qp.sizes
        size = stages * n
        equal = (qp.all_lower == qp.all_upper) & np.isfinite(qp.all_lower)
        equal[:size] &= bounds
        sides = []
        for limits in (qp.all_lower, qp.all_upper):
            finite = np.isfinite(limits) & ~equal
            for part in (finite[:size].reshape(stages, n), finite[size:].reshape(stages, rows)):
                if stages > 1 and not exact:
                    part[:-1] = part[:-1].any(axis=0)
            sides.append(finite & ~equal)
        return QPStructure(sides[0], sides[1], equal)

    @property
    def key(self) -> Hashable:
        """Something to look it up by."""
        return tuple(part.tobytes() for part in self)


class Voids(NamedTuple):
    """Rows of a layout without a limit in a certain QP: their entries, and their sides."""

    entries: Index
    lower: Index
    upper: Index


class QPLayout:
    r"""The arrays of a QP for one structure.

    .. math::
        \min_x \tfrac12 x^\top P x + q^\top x \quad \text{s.t.} \quad
        l \le C x \le u, \quad A x = b, \quad l_x \le x \le u_x

    in two-sided styles; with one side, C x <= u alone, its rows being the equality rows, those
    with an upper limit, and those with a lower limit, negated (their ``signs`` are -1). P, q, l,
    u, b, l_x and u_x are ``hessian``, ``gradient``, ``lower``, ``upper``, ``level``, ``box_lower``
    and ``box_upper``; ``all_lower`` and ``all_upper`` the box's limits, followed by those of C;
    ``constraints`` and ``equalities`` the constraint that each row of C and of A stands for.
    """

    def __init__(
        self, style: QPStyle, structure: QPStructure, stages: int, n: int, rows: int
    ) -> None:
        places = Places.of(stages, n, rows)
        self.style, self.structure = style, structure
        self.size, self.count = size, count = stages * n, stages * (n + rows)
        self.equalities, self.constraints, self.signs = _rows(style, structure, size)
        self.boxed = style.bounds == "box" and bool(
            structure.lower[:size].any() or structure.upper[:size].any()
        )
        patterns = _patterns(style, stages, n, rows, self.constraints, self.equalities)
        # Behind the limits of the constraints stands the upper limit of a void row: 0 x <= 1.
        lower = np.append(places.lower + np.arange(count), places.one)
        upper = np.append(places.upper + np.arange(count), places.one)
        box = slice(size if self.boxed else 0)
        above = np.where(self.signs > 0, upper[self.constraints], lower[self.constraints])
        below = lower[self.constraints] if style.sides == 2 else lower[:0]
        sources = [
            patterns[0].data, *(places.own + pattern.data for pattern in patterns[1:]),
            places.gradient + np.arange(size), upper[self.equalities],
            lower[box], below, upper[box], above,
        ]
        self._source = np.concatenate(sources)
        self._values = np.empty(self._source.size)
        ends = np.cumsum([source.size for source in sources])
        views = np.split(self._values, ends[:-1])
        self.gradient, self.level, self.box_lower, self.lower, self.box_upper, self.upper = (
            views[3:]
        )
        self.all_lower = self._values[ends[4] : ends[6]]
        self.all_upper = self._values[ends[6] :]
        self._entry_rows = patterns[1].indices
        self._c_entries = views[1]
        self._negated = None
        if style.sides == 1:
            self._negated = self.signs[self._entry_rows]
        self._objective = (views[0], self.gradient) if style.objective != 1.0 else ()
        self._dense: list[tuple[Array, Index, Array]] = []
        self.hessian, self.matrix, self.equality_matrix = map(self._matrix, patterns, views[:3])

    def _matrix(self, pattern: csc_matrix, values: Array) -> Any:
        if self.style.matrices == "csc":
            return as_csc(pattern, values)
        full, entries = np.zeros(pattern.shape), pattern.tocoo()
        places = np.ravel_multi_index((entries.row, entries.col), full.shape)
        self._dense.append((full.reshape(-1), places, values))
        return full

    def voids(self, qp: QP) -> Voids | None:
        """The rows of C without a limit in this QP, as far as the solver cannot have such."""
        if self.style.infinite:
            return None
        lower = np.isfinite(qp.all_lower)[self.constraints]
        upper = np.isfinite(qp.all_upper)[self.constraints]
        void = ~np.where(self.signs > 0, upper, lower) if self._negated is not None else (
            ~(lower | upper)
        )
        if not void.any():
            return None
        rows = np.flatnonzero(void)
        below = rows if self.style.sides == 2 else rows[:0]
        return Voids(np.flatnonzero(void[self._entry_rows]), below, rows)

    def fill(self, qp: QP, voids: Voids | None) -> None:
        """Write the numbers of a QP into the arrays."""
        # Any mode but the default one writes into ``out`` without a buffer between.
        qp.numbers.take(self._source, out=self._values, mode="clip")
        for part in self._objective:
            part *= self.style.objective
        if self._negated is not None:
            self._c_entries *= self._negated
            self.upper *= self.signs
        if voids is not None:  # 0 x between -1 and 1
            self._c_entries[voids.entries] = 0.0
            self.lower[voids.lower] = -1.0
            self.upper[voids.upper] = 1.0
        for target, places, values in self._dense:
            target[places] = values

    def duals(self, rows: Array, equalities: Array | None, box: Array | None) -> Array:
        """Multipliers of all constraints, from those of C, A and the box."""
        duals = np.zeros(self.count + 1)  # the last one is that of a void row
        if self._negated is None:
            duals[self.constraints] = rows
        else:  # a constraint may have two rows
            upper = self.signs > 0
            duals[self.constraints[upper]] = rows[upper]
            duals[self.constraints[~upper]] -= rows[~upper]
        if equalities is not None and self.equalities.size:
            duals[self.equalities] = equalities
        if box is not None and self.boxed:
            duals[: self.size] += box
        if self._objective:
            duals /= self.style.objective
        return duals[: self.count]


def _rows(style: QPStyle, structure: QPStructure, size: int) -> tuple[Index, Index, Array]:
    """Constraints of the rows of A and of C, and the signs of the latter."""
    lower, upper = structure.lower.copy(), structure.upper.copy()
    if style.bounds == "box":
        lower[:size] = upper[:size] = False
    equal = np.flatnonzero(structure.equal)
    if style.sides == 2:
        parts = [np.flatnonzero(lower | upper)]
    else:
        parts = [np.flatnonzero(upper), np.flatnonzero(lower)]
    if style.needs_row and not any(part.size for part in parts):
        parts[0] = np.array([lower.size])
    signs = np.repeat([1.0, -1.0][: len(parts)], [part.size for part in parts])
    if style.equalities == "apart":
        return equal, np.concatenate(parts), signs
    constraints = np.concatenate([equal, *parts])
    return equal[:0], constraints, np.concatenate((np.ones(equal.size), signs))


def _patterns(
    style: QPStyle, stages: int, n: int, rows: int, constraints: Index, equalities: Index
) -> list[csc_matrix]:
    """P, C and A; the entries of the latter are places in own rows, next rows, and a 1."""
    upper = style.triangle == "upper" and style.matrices == "csc"
    every = _every_row(stages, n, rows)
    return [
        _upper_hessian(stages, n) if upper else hessian_pattern(stages, n),
        *(every[chosen].tocsc() for chosen in (constraints, equalities)),
    ]


@lru_cache(maxsize=64)
def _upper_hessian(stages: int, n: int) -> csc_matrix:
    from scipy.sparse import triu

    upper: csc_matrix = triu(hessian_pattern(stages, n), format="csc")
    return upper


@lru_cache(maxsize=64)
def _every_row(stages: int, n: int, rows: int) -> csr_matrix:
    """The rows of all constraints, bounds first, and a void one."""
    from scipy.sparse import csc_matrix, vstack

    unit = np.arange(stages * n)
    ones = csc_matrix((np.full(unit.size, 2 * stages * rows * n), (unit, unit)))
    void = csc_matrix((1, unit.size), dtype=np.intp)
    every: csr_matrix = vstack((ones, rows_pattern(stages, n, rows), void), format="csr")
    return every
