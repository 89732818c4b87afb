"""Exact solution with inequalities, by active sets on one banded factorisation."""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .options import SolverOptions
from .qp import QP, Array
from .solution import RawSolution
from .solver import Solver

Index = NDArray[np.intp]
Flags = NDArray[np.bool_]
Sides = NDArray[np.int8]
Sizes = tuple[int, int, int]

_NOTHING = np.zeros(0, np.intp)

# How far a limit may be missed before its constraint enters the active set, in scaled numbers.
_ROUNDING = 1e-12
# The part of a constraint's column, squared, that must be independent of the active ones.
_DEPENDENT = 1e-10
_DEPENDENT_ROOT = math.sqrt(_DEPENDENT)
# Sizes of QPs whose last active set is kept: with and without slack variables.
_KEPT = 2
# Exchanges in blocks that do not lower the number of wrong constraints, before single steps.
_PATIENCE = 2
# Exchanges without a cap. Most QPs take less than ten.
_MOST_EXCHANGES = 1000
_STOPPED = "the cap on exchanges, or on time, is reached"
_DEPENDS = "active constraints depend on each other"
_INFEASIBLE = "the QP is infeasible: a limit depends on active ones"


class _Lapack(NamedTuple):
    """The factorisations and solves of LAPACK."""

    pbtrf: Any
    tbtrs: Any
    potrf: Any
    potrs: Any


class ActiveSetSolver(Solver):
    r"""Solve by the active set, beginning with the last one.

    With the multipliers y of active constraints C d = b,

    .. math::
        (C H^{-1} C^\top)\, y = C d_0 - b, \quad d = d_0 - H^{-1} C^\top y, \quad
        d_0 = -H^{-1} g .

    The banded Cholesky factor L of H is made once, and each constraint's column :math:`L^{-1} c`
    when it is first met. Constraints on the wrong side, active ones whose multiplier has the wrong
    sign and inactive ones that d violates, change sides all at once, as long as their number goes
    down [1]_. Where it does not, the dual method [2]_ goes on from the part of the set whose
    multipliers have the right signs; it is finite, and recognises a QP without a feasible point.

    References
    ----------
    .. [1] J. J. Judice, F. M. Pires, "A block principal pivoting algorithm for large-scale
       strictly monotone linear complementarity problems", Computers & Operations Research 21
       (1994).
    .. [2] D. Goldfarb, A. Idnani, "A numerically stable dual method for solving strictly convex
       quadratic programs", Mathematical Programming 27 (1983).
    """

    _warns = False

    def __init__(
        self, options: SolverOptions, *, most_exchanges: int = _MOST_EXCHANGES
    ) -> None:
        from scipy.linalg.lapack import dpbtrf, dpotrf, dpotrs, dtbtrs  # late: see `BandedSolver`

        super().__init__(options)
        self._lapack = _Lapack(dpbtrf, dtbtrs, dpotrf, dpotrs)
        self._most = options.max_iterations or most_exchanges
        self._last: dict[Sizes, Sides] = {}  # QPs with slack variables have sizes of their own
        self._columns: _Columns | None = None

    def __reduce__(self) -> tuple[type[ActiveSetSolver], tuple[SolverOptions]]:
        return type(self), (self.options,)

    def shift(self) -> None:
        """Move the last active set by one stage; see `Solver.shift`."""
        for (stages, n, rows), last in self._last.items():
            for part, width in ((last[: stages * n], n), (last[stages * n :], rows)):
                part[: part.size - width] = part[width:].copy()
                part[part.size - width :] = 0

    def forget(self) -> None:
        """Forget the last active set; see `Solver.forget`."""
        super().forget()
        self._last, self._columns = {}, None

    def _solve(self, qp: QP, start: Array | None) -> RawSolution:
        until = None if self.time_limit is None else perf_counter() + self.time_limit
        columns = self._columns
        if columns is None or not columns.are_of(qp):  # else only the limits or g have changed
            columns = self._columns = _Columns(self._lapack, qp)
        if not columns.regular:
            return RawSolution(None, False, 0, message="H is not positive definite")
        last = self._last.get(qp.sizes) if self.options.warm_start else None
        if last is None:
            last = np.zeros(qp.all_lower.size, np.int8)
        search = _Search(qp, columns, self._most, until)
        message, duals = search.go(last), search.duals
        if not message:
            self._last.pop(qp.sizes, None)
            if len(self._last) >= _KEPT:
                del self._last[next(iter(self._last))]
            self._last[qp.sizes] = search.sides
        return RawSolution(
            search.step, not message, search.exchanges, duals[: qp.size], duals[qp.size :], message
        )


class _Columns:
    """The factor L of one H, columns L^-1 c of the constraints met so far, and their products.

    ``regular`` says whether H is positive definite.
    """

    def __init__(self, lapack: _Lapack, qp: QP) -> None:
        self._lapack, self._qp = lapack, qp.copy()
        self._factor, info = lapack.pbtrf(qp.lapack_band, lower=1)
        self.regular = info == 0
        self._place = np.full(qp.all_lower.size, -1, np.intp)  # where a constraint's column stands
        self._columns, self._gram = np.empty((0, qp.size)), np.empty((0, 0))

    def are_of(self, qp: QP) -> bool:
        """Whether H and the rows of a QP are the same."""
        own = self._qp
        return own.sizes == qp.sizes and all(
            np.array_equal(getattr(own, name), getattr(qp, name))
            for name in ("band", "row_own", "row_next")
        )

    def root(self, active: Index) -> tuple[Array, Array, int]:
        """The root of C H^-1 C' with a diagonal of 1, its units, and how many are independent."""
        places = self._place[active]
        gram = self._gram[places[:, None], places]
        unit = 1.0 / np.sqrt(gram.diagonal())
        gram *= unit
        gram *= unit[:, None]
        root, info = self._lapack.potrf(gram.T, lower=1, overwrite_a=1)
        independent = info - 1 if info > 0 else active.size
        small = (root.diagonal()[:independent] < _DEPENDENT_ROOT).nonzero()[0]
        return root, unit, int(small[0]) if small.size else independent

    def met(self, constraints: Index) -> Array:
        """The columns L^-1 c of constraints, as rows."""
        places = self._place[constraints]
        new = constraints[places < 0]
        if new.size:
            qp, normals = self._qp, np.zeros((new.size, self._qp.size))
            bounds = (new < qp.size).nonzero()[0]
            normals[bounds, new[bounds]] = 1.0
            if bounds.size < new.size:
                others = (new >= qp.size).nonzero()[0]
                stage, row = np.divmod(new[others] - qp.size, qp.rows)
                at = stage[:, None] * qp.n + np.arange(qp.n)
                normals[others[:, None], at] = qp.row_own[stage, row]
                inner = stage + 1 < qp.stages
                normals[others[inner, None], at[inner] + qp.n] = (
                    qp.row_next[stage[inner], row[inner]]
                )
            old, columns = len(self._columns), self.down(normals.T).T
            self._place[new] = old + np.arange(new.size)
            # The rows in C order are columns in Fortran order: LAPACK copies nothing.
            self._columns = np.concatenate((self._columns, columns))
            gram = np.empty((old + new.size, old + new.size))
            gram[:old, :old] = self._gram
            gram[old:] = columns @ self._columns.T
            gram[:old, old:] = gram[old:, :old].T
            self._gram, places = gram, self._place[constraints]
        return self._columns[places]

    def down(self, side: Array) -> Array:
        """The solution x of L x = side."""
        found: Array = self._lapack.tbtrs(self._factor, side, uplo="L")[0]
        return found

    def up(self, side: Array) -> Array:
        """The solution x of L' x = side."""
        found: Array = self._lapack.tbtrs(self._factor, side, uplo="L", trans="T")[0]
        return found

    def solve(self, root: Array, side: Array) -> Array:
        """The solution x of R R' x = side."""
        found: Array = self._lapack.potrs(root, side, lower=1)[0]
        return found


class _Search:
    """The search for one QP's active set.

    ``sides`` holds 1 for each constraint active at its upper limit, and for equalities that are
    active, -1 at its lower one; ``step``, (K n,), is the minimiser on these, ``duals`` all
    multipliers, positive on the upper side.
    """

    def __init__(self, qp: QP, columns: _Columns, most: int, until: float | None) -> None:
        self._qp, self._columns, self._most, self._until = qp, columns, most, until
        self._free = -columns.up(columns.down(qp.gradient.reshape(-1)))
        self._equal: Flags = (qp.all_lower == qp.all_upper) & np.isfinite(qp.all_lower)
        count = qp.all_lower.size
        self.sides, self.step, self.duals = np.zeros(count, np.int8), self._free, np.zeros(count)
        self.exchanges = 0

    def go(self, last: Sides) -> str:
        """Search from the last active set; the reason if it stops before the solution."""
        qp = self._qp
        # Limits may have gone since, or become equalities.
        there = np.where(last > 0, np.isfinite(qp.all_upper), np.isfinite(qp.all_lower))
        first = np.flatnonzero(self._equal | (there & (last != 0)))
        self._minimise(first, np.where(self._equal, 1, last).astype(np.int8))
        fewest, patience = self.sides.size + 1, _PATIENCE
        while True:
            wrong = ~self._right_signs()
            missed, side = self._missed()
            outside = ((self.sides == 0) & (missed > 0.0)).nonzero()[0]
            count = outside.size + int(np.count_nonzero(wrong))
            if not count:
                return ""
            patience = _PATIENCE if count < fewest else patience - 1
            fewest = min(count, fewest)
            if not patience:
                return self._go_singly()
            if self._stopped():
                return _STOPPED
            self.sides[wrong] = 0
            # Where they depend on each other, those that are missed most come first.
            self._minimise(outside[np.argsort(-missed[outside], kind="stable")], side)

    def _stopped(self) -> bool:
        """Count an exchange, unless there may be none."""
        if self.exchanges >= self._most or (
            self._until is not None and perf_counter() >= self._until
        ):
            return True
        self.exchanges += 1
        return False

    def _right_signs(self) -> Flags:
        return (self.duals * self.sides >= 0.0) | self._equal

    def _missed(self) -> tuple[Array, Sides]:
        """By how much d misses each constraint beyond rounding, and on which side."""
        qp, values = self._qp, self._values(self.step)
        above, below = values - qp.all_upper, qp.all_lower - values
        missed = np.maximum(above, below)
        missed -= _ROUNDING * (1.0 + float(np.abs(values).max()))
        return missed, np.where(above > below, 1, -1).astype(np.int8)

    def _go_singly(self) -> str:
        """The dual method, from the part of the active set that has the right signs."""
        while (wrong := ~self._right_signs()).any():
            if self._stopped():
                return _STOPPED
            self.sides[wrong] = 0
            self._minimise(_NOTHING, self.sides)
        while True:
            missed, side = self._missed()
            missed[self.sides != 0] = 0.0
            new = int(missed.argmax())
            if not missed[new] > 0.0:
                return ""
            message = self._enter(new, side)
            if message:
                return message

    def _enter(self, new: int, side: Sides) -> str:
        """Make one constraint active; others leave before their multipliers change signs."""
        qp, sign = self._qp, float(side[new])
        limit = float((qp.all_upper if sign > 0.0 else qp.all_lower)[new])
        column = sign * self._columns.met(np.array([new]))[0]
        while not self._stopped():
            active = self.sides.nonzero()[0]
            columns = self._columns.met(active)
            change = self._multipliers(active, columns @ column)
            if change is None:
                return _DEPENDS
            along = column - change @ columns
            slope, full, partial, leaves = float(along.dot(along)), math.inf, math.inf, -1
            if slope > _DEPENDENT * float(column.dot(column)):
                full = max(sign * (float(self._values(self.step)[new]) - limit), 0.0) / slope
            # The multipliers' sizes go down at these rates.
            rates = change * self.sides[active]
            falling = ((rates > 0.0) & ~self._equal[active]).nonzero()[0]
            if falling.size:
                sizes = np.abs(self.duals[active[falling]])
                lengths = sizes / rates[falling]
                at = int(lengths.argmin())
                partial, leaves = float(lengths[at]), int(active[falling[at]])
            if full <= partial < math.inf or leaves < 0:
                if full == math.inf:
                    return _INFEASIBLE
                self._minimise(np.array([new]), side)
                return "" if self.sides[new] else _DEPENDS
            if full < math.inf:
                self.step = self.step - partial * self._columns.up(along)
            self.duals[active] -= partial * change
            self.sides[leaves], self.duals[leaves] = 0, 0.0
        return _STOPPED

    def _minimise(self, entering: Index, side: Sides) -> None:
        """The minimiser on the active constraints and those that enter, and the multipliers.

        Those that enter become active as long as they are independent.
        """
        qp, old = self._qp, self.sides.nonzero()[0]
        active = np.concatenate((old, entering))[: qp.size]
        self.step, self.duals = self._free, np.zeros(self.sides.size)
        if not active.size:
            return
        columns = self._columns.met(active)
        root, unit, independent = self._columns.root(active)
        if independent < active.size:
            active, columns, unit = active[:independent], columns[:independent], unit[:independent]
            root = root[:independent, :independent]
            self.sides[old[independent:]] = 0
        entered = active[old.size :]
        self.sides[entered] = side[entered]
        level = np.where(self.sides[active] > 0, qp.all_upper[active], qp.all_lower[active])
        for _ in range(2):  # the second time for the rounding of the first
            missed = self._values(self.step)[active] - level
            force = unit * self._columns.solve(root, unit * missed)
            self.duals[active] += force
            self.step = self.step - self._columns.up(force @ columns)

    def _multipliers(self, active: Index, missed: Array) -> Array | None:
        """The solution y of C H^-1 C' y = missed on constraints; None where they are dependent."""
        if not active.size:
            return missed
        root, unit, independent = self._columns.root(active)
        if independent < active.size:
            return None
        found: Array = unit * self._columns.solve(root, unit * missed)
        return found

    def _values(self, step: Array) -> Array:
        qp = self._qp
        if not qp.rows:
            return step
        rows = qp.rows_times(step.reshape(qp.stages, qp.n))
        return np.concatenate((step, rows), axis=None)
