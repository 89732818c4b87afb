"""What a QP solver brought back, judged from the data and never from its word."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .qp import QP

__all__ = ["RawSolution", "Residuals", "Solution", "SolveStatus"]

Array = NDArray[np.float64]


class SolveStatus(enum.Enum):
    """How a QP solve ended. The value tells what to do about it."""

    SOLVED = "solved: the recomputed residuals confirm it"
    STOPPED = (
        "stopped at a cap or gave up: the iterate is usable as a trial; raise the cap for accuracy"
    )
    INACCURATE = (
        "success claimed, but the recomputed residuals do not confirm it: usable as a trial; "
        "tighten the tolerances, rescale the weights or take another backend"
    )
    UNCONSTRAINED = (
        "the exact minimiser without inequalities, and it violates some: usable as a trial; "
        "take a backend that handles inequalities for accuracy"
    )
    FAILED = "no usable iterate: read the message, and take another backend"

    @property
    def usable(self) -> bool:
        """Whether there is a finite iterate of the right shape."""
        return self is not SolveStatus.FAILED


@dataclass(frozen=True)
class RawSolution:
    """What a backend hands over before it is judged.

    Parameters
    ----------
    d : array_like or None
        The iterate, K n numbers in stage order; None if there is none.
    claimed : bool
        Whether the solver says that it solved the QP.
    iterations : int or None
        The solver's own count, None where it does not tell.
    bound_duals, row_duals : array or None
        Multipliers of the bounds (K n) and rows (K rows), positive on the upper side; None
        where the solver gives none.
    message : str
        The solver's own words.
    """

    d: object
    claimed: bool
    iterations: int | None = None
    bound_duals: Array | None = None
    row_duals: Array | None = None
    message: str = ""


@dataclass(frozen=True)
class Residuals:
    """Optimality of an iterate, recomputed from the QP's data.

    Parameters
    ----------
    primal : float
        Largest violation of a bound or row.
    dual : float
        ``|H d + g + z + [F, G]^T y|_inf``; NaN where the solver gave no multipliers.
    gap : float
        Distance between primal and dual objective,
        ``|d^T H d + g^T d + sum of multipliers times their bounds|``; NaN likewise.
    """

    primal: float
    dual: float
    gap: float

    @staticmethod
    def of(qp: QP, d: Array, bound_duals: Array | None, row_duals: Array | None) -> Residuals:
        """Recompute the residuals of an iterate.

        Parameters
        ----------
        qp : QP
            The problem.
        d : (K, n) array
            The iterate.
        bound_duals, row_duals : array or None
            Its multipliers, as in `RawSolution`.
        """
        primal = qp.violation(d)
        if bound_duals is None or row_duals is None:
            return Residuals(primal, float("nan"), float("nan"))
        curvature = qp.hessian_times(d)
        stationarity = curvature + qp.gradient
        gap = float(np.vdot(d, stationarity))
        z = _present(bound_duals.reshape(qp.stages, qp.n), qp.lower, qp.upper)
        stationarity = stationarity + z
        gap += _support(z, qp.lower, qp.upper)
        if qp.rows:
            y = row_duals.reshape(qp.stages, qp.rows)
            y = _present(y, qp.row_lower, qp.row_upper)
            stationarity = stationarity + qp.rows_transposed_times(y)
            gap += _support(y, qp.row_lower, qp.row_upper)
        return Residuals(primal, float(np.abs(stationarity).max()), abs(gap))


def _present(multipliers: Array, lower: Array, upper: Array) -> Array:
    """Multipliers without those of absent bounds, which then show as a dual residual."""
    absent = np.where(multipliers > 0, upper, -lower) == np.inf
    return np.where(absent, 0.0, multipliers)


def _support(multipliers: Array, lower: Array, upper: Array) -> float:
    """Sum of multiplier times the bound that it belongs to."""
    active = multipliers != 0.0
    side = np.where(multipliers > 0, upper, lower)
    return float(np.vdot(multipliers[active], side[active]))


class Solution:
    """A judged solution.

    Attributes
    ----------
    d : (K, n) array or None
        The iterate; None exactly when the status is FAILED.
    status : SolveStatus
        The verdict.
    iterations : int or None
        The solver's own count.
    residuals : Residuals or None
        Recomputed from the data; None where there is no iterate, and for the unconstrained
        minimiser of a Cholesky factorisation, whose residuals are rounding.
    bound_duals, row_duals : array or None
        Multipliers as in `RawSolution`.
    message : str
        The solver's own words, or what was wrong with its answer.
    """

    __slots__ = (
        "bound_duals",
        "d",
        "iterations",
        "message",
        "residuals",
        "row_duals",
        "status",
    )

    def __init__(
        self,
        d: Array | None,
        status: SolveStatus,
        iterations: int | None = None,
        residuals: Residuals | None = None,
        bound_duals: Array | None = None,
        row_duals: Array | None = None,
        message: str = "",
    ) -> None:
        self.d, self.status, self.iterations = d, status, iterations
        self.residuals, self.message = residuals, message
        self.bound_duals, self.row_duals = bound_duals, row_duals

    def __repr__(self) -> str:
        return f"Solution({self.status.name}, iterations={self.iterations}, {self.residuals})"
