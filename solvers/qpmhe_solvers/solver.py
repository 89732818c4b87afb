"""The contract of a QP solver, and the wall that nothing it does can get through."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from .options import SolverOptions
from .qp import QP
from .solution import RawSolution, Residuals, Solution, SolveStatus

__all__ = ["Solver"]

Array = NDArray[np.float64]

# A claim of success is believed while the recomputed residuals stay below this many times the
# tolerance: solvers measure in scaled norms of their own.
_SLACK = 1e3


class Solver(ABC):
    """One QP solver with its options; subclasses implement `_solve` and nothing more.

    Parameters
    ----------
    options : SolverOptions
        Limits and accuracy of every solve.
    """

    def __init__(self, options: SolverOptions) -> None:
        self.options = options

    @abstractmethod
    def _solve(self, qp: QP, start: Array | None) -> RawSolution:
        """Solve qp. May raise, hang on to nothing, and lie: `solve` contains all of it."""

    def prepare(self, size: int) -> None:
        """Do beforehand what the first QPs with inequalities would otherwise wait for.

        Parameters
        ----------
        size : int
            Unknowns K n of the largest QP to come.
        """

    def solve(self, qp: QP, start: Array | None = None) -> Solution:
        """Solve a QP; never raises an `Exception`, and never believes the solver.

        Parameters
        ----------
        qp : QP
            The problem. It is read, never written.
        start : (K, n) array, optional
            A point near the solution; zero is the trajectory that the QP is built around.

        Returns
        -------
        Solution
            The iterate, if it is finite and of the right shape, with its recomputed
            residuals; otherwise FAILED with the reason in its message.
        """
        if not qp.finite():
            # NaN hangs proxqp and comes back as success from others: it must not reach them.
            return Solution(None, SolveStatus.FAILED, message="the QP's data are not finite")
        if not self.options.warm_start:
            start = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                raw = self._solve(qp, start)
                d, message = _as_iterate(raw, qp)
        except Exception as error:  # the wall: whatever a third party's solver raises
            message = f"{type(error).__name__}: {error}"
            return Solution(None, SolveStatus.FAILED, message=message)
        if d is None:
            return Solution(None, SolveStatus.FAILED, raw.iterations, message=message)
        bound_duals = _as_multipliers(raw.bound_duals, qp.size)
        row_duals = _as_multipliers(raw.row_duals, qp.stages * qp.rows)
        residuals = Residuals.of(qp, d, bound_duals, row_duals)
        if not raw.claimed:
            status = SolveStatus.STOPPED
        elif self._confirmed(qp, d, residuals):
            status = SolveStatus.SOLVED
        else:
            status = SolveStatus.INACCURATE
        return Solution(d, status, raw.iterations, residuals, bound_duals, row_duals, message)

    def _confirmed(self, qp: QP, d: Array, residuals: Residuals) -> bool:
        tolerance = self.options.absolute_tolerance + self.options.relative_tolerance
        primal = _SLACK * tolerance * (1.0 + float(np.abs(d).max()))
        dual = _SLACK * tolerance * (1.0 + float(np.abs(qp.gradient).max()))
        return residuals.primal <= primal and not residuals.dual > dual


def _as_iterate(raw: object, qp: QP) -> tuple[Array | None, str]:
    if not isinstance(raw, RawSolution):
        return None, f"the backend returned {type(raw).__name__}, not a RawSolution"
    if raw.d is None:
        return None, raw.message or "the solver returned no iterate"
    d = np.array(raw.d, dtype=np.float64)  # a copy: solvers reuse their buffers
    if d.size != qp.size:
        return None, f"the solver returned {d.size} numbers for {qp.size} unknowns"
    if not np.isfinite(d).all():
        return None, "the solver returned an iterate that is not finite"
    return d.reshape(qp.stages, qp.n), raw.message


def _as_multipliers(values: Array | None, size: int) -> Array | None:
    if values is None:
        return None
    multipliers = np.array(values, dtype=np.float64).ravel()
    if multipliers.size != size or not np.isfinite(multipliers).all():
        return None
    return multipliers
