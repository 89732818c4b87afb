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
# tolerance, since solvers measure in scaled norms of their own, but not beyond the loosest.
_SLACK = 1e3
_LOOSEST = 1e-3


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

    def prepare(self, size: int) -> None:  # noqa: B027 - most have nothing to prepare
        """Do beforehand what the first QPs with inequalities would otherwise wait for.

        Parameters
        ----------
        size : int
            Unknowns K n of the largest QP to come.
        """

    def solve(self, qp: QP, start: Array | None = None) -> Solution:
        """Solve a QP; whatever the solver raises ends here, and it is never believed.

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
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                fault = _fault(qp)
                if fault:
                    return Solution(None, SolveStatus.FAILED, message=fault)
                return self._judged(qp, self._solve(qp, self._usable(start, qp)))
        except (KeyboardInterrupt, SystemExit, GeneratorExit):
            raise
        except BaseException as error:  # the wall; a panic of compiled code is no Exception
            message = f"{type(error).__name__}: {error}"
            return Solution(None, SolveStatus.FAILED, message=message)

    def _usable(self, start: Array | None, qp: QP) -> Array | None:
        if start is None or not self.options.warm_start:
            return None
        fits = np.shape(start) == (qp.stages, qp.n) and bool(np.isfinite(start).all())
        return start if fits else None

    def _judged(self, qp: QP, raw: object) -> Solution:
        if not isinstance(raw, RawSolution):
            message = f"the backend returned {type(raw).__name__}, not a RawSolution"
            return Solution(None, SolveStatus.FAILED, message=message)
        count = _as_count(raw.iterations)
        d, message = _as_iterate(raw, qp)
        if d is None:
            return Solution(None, SolveStatus.FAILED, count, message=message)
        bound_duals = _as_multipliers(raw.bound_duals, qp.size)
        row_duals = _as_multipliers(raw.row_duals, qp.stages * qp.rows)
        if not qp.bounded and not qp.rows:
            bound_duals, row_duals = np.zeros(qp.size), np.zeros(0)  # there is nothing to weigh
        residuals = Residuals.of(qp, d, bound_duals, row_duals)
        if not (isinstance(raw.claimed, (bool, np.bool_)) and raw.claimed):
            status = SolveStatus.STOPPED
        elif self._confirmed(qp, d, residuals):
            status = SolveStatus.SOLVED
        else:
            status = SolveStatus.INACCURATE
        return Solution(d, status, count, residuals, bound_duals, row_duals, message)

    def _confirmed(self, qp: QP, d: Array, residuals: Residuals) -> bool:
        """Whether the residuals bear a claim out; a claim without multipliers cannot be checked."""
        tolerance = self.options.absolute_tolerance + self.options.relative_tolerance
        limit = max(tolerance, min(_SLACK * tolerance, _LOOSEST))
        objective = abs(float(np.vdot(d, qp.gradient)))
        return (
            residuals.primal <= limit * (1.0 + float(np.abs(d).max()))
            and residuals.dual <= limit * (1.0 + float(np.abs(qp.gradient).max()))
            and residuals.gap <= limit * (1.0 + objective)
        )


def _fault(qp: QP) -> str:
    """What no solver must be given: NaN hangs proxqp and comes back as success from others."""
    if not qp.finite():
        return "the QP's data are not finite"
    if (qp.lower > qp.upper).any() or (qp.row_lower > qp.row_upper).any():
        return "the QP is infeasible: a lower bound is above its upper bound"
    return ""


def _as_iterate(raw: RawSolution, qp: QP) -> tuple[Array | None, str]:
    told: object = raw.message
    message = told if isinstance(told, str) else f"its message is a {type(told).__name__}"
    if raw.d is None:
        return None, message or "the solver returned no iterate"
    given = np.asarray(raw.d)
    if np.iscomplexobj(given):
        return None, "the solver returned complex numbers"
    d = np.array(given, dtype=np.float64)  # a copy: solvers reuse their buffers
    if d.size != qp.size:
        return None, f"the solver returned {d.size} numbers for {qp.size} unknowns"
    if not np.isfinite(d).all():
        return None, "the solver returned an iterate that is not finite"
    return d.reshape(qp.stages, qp.n), message


def _as_count(value: object) -> int | None:
    """A count of iterations; None where it is none."""
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 0:
        return int(value)
    return None


def _as_multipliers(values: object, size: int) -> Array | None:
    """Multipliers that can be used; None stands for all that cannot."""
    if values is None:
        return None
    try:
        given = np.asarray(values)
        if np.iscomplexobj(given):
            return None
        multipliers = np.array(given, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        return None
    if multipliers.size != size or not np.isfinite(multipliers).all():
        return None
    return multipliers
