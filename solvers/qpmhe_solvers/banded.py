"""Direct solution without inequalities, by one factorisation of a banded matrix."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .options import SolverOptions
from .qp import QP, Array, Places, hessian_entries, rows_entries
from .solution import Residuals, Solution, SolveStatus
from .solver import Solver
from .sparse_order import LEAST, SparseOrder
from .sparse_qp import SparseQP

Index = NDArray[np.intp]

# How far equality rows may be missed after a solve, in scaled numbers.
_ROUNDING = 1e-10

# By the exponent of the first number, even or odd: that of 1, 4, 16 is odd for `math.frexp`.
_COST_UNITS = 0.5, 1.0


class BandedSolver(Solver):
    """Solve ``H d = -g``, exact if the result satisfies every inequality.

    Otherwise it returns the minimiser without inequalities with the status UNCONSTRAINED: a valid
    trial, not the QP's solution. LAPACK's banded Cholesky factorisation (``pbsv``) takes O(K n^3)
    time and no iterations; where blocks of H are sparse, `SparseOrder` makes the band narrower.
    Equality rows are kept: the optimality conditions, ordered by stages, are banded too, and solved
    by ``gbsv``.
    """

    _judges, _keeps, _takes_sparse = True, False, True

    def __init__(self, options: SolverOptions) -> None:
        from scipy.linalg.lapack import dgbsv, dpbsv  # late: twice the cost of importing NumPy

        super().__init__(options)
        self._dpbsv, self._dgbsv = dpbsv, dgbsv
        # Workspace for QPs of one size: windows keep theirs, once they are full.
        self._size = (0, 0)
        self._work: tuple[Array, Array, Array] | None = None
        self._sparse = SparseOrder()

    def _solve(self, qp: QP, start: Array | None) -> Solution:
        if qp.rows and (qp.row_lower == qp.row_upper).any():
            return self._solve_scaled(qp)
        step = self._cholesky(qp)
        if step is None:
            message = "the factorisation failed: H is not positive definite, or not finite"
            return Solution(None, SolveStatus.FAILED, 0, message=message)
        if not qp.bounded and not qp.rows:
            return Solution(step, SolveStatus.SOLVED, 0)
        return _judged(qp, step, np.zeros(qp.stages * qp.rows), qp.violation(step) <= 0.0)

    def _solve_scaled(self, qp: QP) -> Solution:
        """Solve with equality rows; pivots, unlike a Cholesky factor, depend on units."""
        scale, scaled = self._scale(qp)
        step, multipliers = self._with_equalities(scaled)
        if step is None:
            message = "the factorisation failed: H is not positive definite, or not finite"
            return Solution(None, SolveStatus.FAILED, 0, message=message)
        # Equality rows hold up to the rounding of the solve.
        rounding = _ROUNDING * (1.0 + float(np.abs(step).max()))
        feasible = scaled.violation(step) <= rounding
        return _judged(
            qp, step * scale.step, multipliers * scale.duals[qp.size :], feasible
        )

    def _cholesky(self, qp: QP) -> Array | None:
        # A root is exact for powers of four alone: an odd unit of the cost goes before.
        unit = _COST_UNITS[math.frexp(qp.band.item(0))[1] % 2]
        is_sparse = type(qp) is SparseQP
        if is_sparse or qp.n >= LEAST:
            found = self._sparse.band(qp, unit)
            if found is not None:
                band, flat = found
                if self._solves(band, flat, band[0]):  # else rounding may have decided: once more
                    return self._sparse.step(flat).reshape(qp.stages, qp.n)
        if is_sparse:
            return None
        work = self._work
        if work is None or self._size != (qp.stages, qp.n):
            band, step = np.empty((qp.stages, qp.n, 2 * qp.n)), np.empty((qp.stages, qp.n))
            # Views for LAPACK, made once: Fortran order, so that f2py works in place.
            work = band, band.reshape(qp.size, 2 * qp.n).T, step
            self._work, self._size = work, (qp.stages, qp.n)
        band, lapack_band, step = work
        np.multiply(qp.band, unit, out=band)
        np.multiply(qp.gradient, -unit, out=step)
        return step if self._solves(lapack_band, step.reshape(qp.size), band[:, :, 0]) else None

    def _solves(self, band: Array, side: Array, diagonal: Array) -> bool:
        """Solve in place, ``band`` in LAPACK's layout; whether the solution is to be believed."""
        _, _, info = self._dpbsv(band, side, lower=1, overwrite_ab=1, overwrite_b=1)
        finite = math.isfinite(side.dot(side))
        if finite and np.count_nonzero(side) < side.size:
            # An infinite pivot turns its unknown into 0 and would pass: look at the factor.
            finite = math.isfinite(np.add.reduce(diagonal, axis=None))
        return info == 0 and finite

    def _with_equalities(self, qp: QP) -> tuple[Array | None, Array]:
        """Minimiser (K, n) and multipliers (K rows,) subject to the equality rows alone."""
        width, level, order, source, target = _optimality_conditions(
            qp.sizes, (qp.row_lower == qp.row_upper).tobytes()
        )
        band = np.zeros((3 * width + 1, order.size))
        band.reshape(-1)[target] = qp.numbers[source]
        side = np.append(-qp.gradient, qp.row_upper.ravel()[level])[order]
        _, _, solution, info = self._dgbsv(width, width, band, side)
        found, multipliers = np.empty(order.size), np.zeros(qp.stages * qp.rows)
        found[order] = solution
        multipliers[level] = found[qp.size :]
        if info != 0 or not np.isfinite(found).all():
            return None, multipliers
        return found[: qp.size].reshape(qp.stages, qp.n), multipliers


def _judged(qp: QP, step: Array, row_duals: Array, feasible: bool) -> Solution:
    """The solution, if no inequality is missed, or a trial."""
    no_bound = np.zeros(qp.size)
    if feasible:
        return Solution(step, SolveStatus.SOLVED, 0, None, no_bound, row_duals)
    residuals = Residuals.of(qp, step, no_bound, row_duals)
    return Solution(step, SolveStatus.UNCONSTRAINED, 0, residuals, no_bound, row_duals)


@lru_cache(maxsize=64)
def _optimality_conditions(
    sizes: tuple[int, int, int], equal: bytes
) -> tuple[int, Index, Index, Index, Index]:
    """How [H, A'; A, 0] is written as a band, A being the rows that are equalities.

    Returns the bandwidth, those rows, the order of unknowns and multipliers by stages, and for
    each entry its place in `QP.numbers` and in the flat band of LAPACK's ``gbsv``.
    """
    stages, n, rows = sizes
    size, level = stages * n, np.flatnonzero(np.frombuffer(equal, np.bool_))
    order = np.argsort(np.append(np.arange(size) // n, level // rows), kind="stable")
    at = np.argsort(order)
    own, rows_of, columns_of = rows_entries(*sizes)
    kept = np.isin(rows_of, level)
    own, columns_of = Places.of(*sizes).own + own[kept], columns_of[kept]
    rows_of = size + np.searchsorted(level, rows_of[kept])
    source, row, column = hessian_entries(stages, n)
    row = at[np.concatenate((row, rows_of, columns_of))]
    column = at[np.concatenate((column, columns_of, rows_of))]
    width = int(np.abs(row - column).max())
    target = (2 * width + row - column) * order.size + column
    return width, level, order, np.concatenate((source, own, own)), target
