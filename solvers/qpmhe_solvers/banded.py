"""The unconstrained minimiser by one banded Cholesky factorisation (LAPACK ``pbsv``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .options import SolverOptions
from .qp import QP
from .solution import RawSolution, Residuals, Solution, SolveStatus
from .solver import Solver

__all__ = ["BandedSolver"]

Array = NDArray[np.float64]


class BandedSolver(Solver):
    """Solve ``H d = -g``, exact wherever the result meets every inequality.

    Where it does not, the minimiser without inequalities comes back with the status
    UNCONSTRAINED: a legal trial, not the QP's solution. The factorisation takes
    O(K n^3) time, no iterations, and needs no options.

    Parameters
    ----------
    options : SolverOptions
        Kept for the common contract; a direct solve has nothing to cap.
    """

    def __init__(self, options: SolverOptions) -> None:
        from scipy.linalg.lapack import dpbsv  # late: twice the cost of importing NumPy

        super().__init__(options)
        self._dpbsv = dpbsv
        self._work: dict[tuple[int, int], tuple[Array, Array, Array]] = {}

    def _solve(self, qp: QP, start: Array | None) -> RawSolution:
        solution = self.solve(qp, start)
        return RawSolution(solution.d, solution.status is SolveStatus.SOLVED)

    def solve(self, qp: QP, start: Array | None = None) -> Solution:
        """Solve the QP without its inequalities, then look whether they hold.

        Parameters
        ----------
        qp : QP
            The problem; its band and gradient are copied, not overwritten.
        start : (K, n) array, optional
            Not used by a direct solve.

        Returns
        -------
        Solution
            SOLVED, UNCONSTRAINED, or FAILED where H is not positive definite or not finite.
            The iterate lives in this solver's workspace until its next solve.
        """
        key = (qp.stages, qp.n)
        work = self._work.get(key)
        if work is None:
            band, step = np.empty((qp.stages, qp.n, 2 * qp.n)), np.empty((qp.stages, qp.n))
            # Views for LAPACK, made once: Fortran order, so that f2py works in place.
            work = band, band.reshape(qp.size, 2 * qp.n).T, step
            self._work[key] = work
        band, lapack_band, step = work
        band[...] = qp.band
        np.negative(qp.gradient, out=step)
        _, _, info = self._dpbsv(
            lapack_band, step.reshape(qp.size), lower=1, overwrite_ab=1, overwrite_b=1
        )
        # A NaN anywhere reaches the last unknowns or the pivots; infinities become NaN.
        if info != 0 or not np.isfinite(step).all():
            message = f"Cholesky factorisation failed (info {info}): H is not positive definite"
            return Solution(None, SolveStatus.FAILED, 0, message=message)
        if not qp.bounded and not qp.rows:
            return Solution(step, SolveStatus.SOLVED, 0)
        no_bound, no_row = np.zeros(qp.size), np.zeros(qp.stages * qp.rows)
        if qp.violation(step) <= 0.0:
            return Solution(step, SolveStatus.SOLVED, 0, None, no_bound, no_row)
        residuals = Residuals.of(qp, step, no_bound, no_row)
        return Solution(step, SolveStatus.UNCONSTRAINED, 0, residuals, no_bound, no_row)
