"""The solution of a QP, verified with the QP's data, independently of the solver's status."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .qp import QP, Array

if TYPE_CHECKING:
    from .scaling import Scale

_NOTHING = np.zeros(0)
_largest = np.maximum.reduce  # the method of an array comes to this, by detours


class SolveStatus(enum.Enum):
    """The outcome of a QP solve; the value gives the remedy."""

    SOLVED = "solved: the recomputed residuals confirm it"
    STOPPED = (
        "stopped at a cap or gave up: the iterate is usable as a trial; raise the cap for accuracy"
    )
    INACCURATE = (
        "success claimed, but the recomputed residuals do not confirm it: usable as a trial; "
        "tighten the tolerances, rescale the weights or use another backend"
    )
    UNCONSTRAINED = (
        "the exact minimiser without inequalities, which violates some: usable as a trial; "
        "use a backend that handles inequalities for accuracy"
    )
    FAILED = "no usable iterate: read the message, and use another backend"

    @property
    def usable(self) -> bool:
        """Whether a finite iterate of the right shape exists."""
        return self is not SolveStatus.FAILED


@dataclass(frozen=True)
class RawSolution:
    """A backend's result before verification.

    Parameters
    ----------
    d : array_like or None
        The iterate, K n numbers in stage order; None if there is none.
    claimed : bool
        Whether the solver reports success.
    iterations : int or None
        The solver's iteration count, None if it reports none.
    bound_duals, row_duals : array or None
        Multipliers of the bounds (K n) and rows (K rows), positive on the upper side; None if the
        solver reports none.
    message : str
        The solver's message.
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
        ``|H d + g + z + [F, G]^T y|_inf``; NaN if the solver reported no multipliers.
    gap : float
        Distance between primal and dual objective,
        ``|d^T H d + g^T d + sum of multipliers times their bounds|``; NaN likewise.
    """

    primal: float
    dual: float
    gap: float

    @staticmethod
    def of(qp: QP, d: Array, bound_duals: Array | None, row_duals: Array | None) -> Residuals:
        """Of ``d`` (K, n) in ``qp``; for ``bound_duals`` and ``row_duals`` see `RawSolution`."""
        duals = None
        if bound_duals is not None and row_duals is not None:
            duals = np.concatenate((bound_duals, row_duals), axis=None)
        return Residuals(*Errors(qp, d, duals).largest())


class Errors:
    """The optimality errors of an iterate, entry by entry; bounds and rows in one array each.

    ``missed``, (K n + K rows,), is the amount by which each constraint is missed, negative where
    it is met, and empty where there is none; ``force``, (K n,), the size of the gradient of the
    Lagrangian; ``gap`` the distance between primal and dual objective. Without multipliers
    ``force`` is None and ``gap`` NaN.
    """

    __slots__ = ("force", "gap", "missed")

    def __init__(self, qp: QP, d: Array, duals: Array | None) -> None:
        size, point, limited = qp.size, d.reshape(-1), qp.bounded or qp.rows > 0
        self.missed, self.force, self.gap = _NOTHING, None, math.nan
        if limited:
            value = np.concatenate((d, qp.rows_times(d)), axis=None) if qp.rows else point
            self.missed = np.maximum(qp.all_lower - value, value - qp.all_upper)
        if duals is None:
            return
        force = qp.hessian_times(d).reshape(-1)
        force += qp.gradient.reshape(-1)
        gap = float(point.dot(force))
        if limited:
            side = np.where(duals > 0.0, qp.all_upper, qp.all_lower)
            # Multipliers of absent limits are dropped, and then show as a dual residual.
            there = np.isfinite(side)
            duals = duals * there
            gap += float(duals.dot(np.where(there, side, 0.0)))
            force += duals[:size]
            if qp.rows:
                rows = duals[size:].reshape(qp.stages, qp.rows)
                force += qp.rows_transposed_times(rows).reshape(-1)
        self.force, self.gap = np.abs(force, out=force), abs(gap)

    def largest(self) -> tuple[float, float, float]:
        """The residuals, primal, dual and gap."""
        return _worst(self.missed), _peak(self.force), self.gap

    def unscaled(self, scale: Scale) -> Residuals:
        """The residuals in the user's units, of an iterate of a scaled QP."""
        missed, force = self.missed, self.force
        with np.errstate(all="ignore"):
            if missed.size:
                missed = missed * scale.units
            if force is not None:
                force = force * scale.duals[: force.size]
            return Residuals(_worst(missed), _peak(force), self.gap * scale.cost)


def _worst(missed: Array) -> float:
    if not missed.size:
        return 0.0
    worst = float(_largest(missed))
    # Comparisons with NaN are false: a NaN among the numbers must not pass as feasible.
    return math.inf if math.isnan(worst) else max(worst, 0.0)


def _peak(force: Array | None) -> float:
    return math.nan if force is None else float(_largest(force))


class Solution:
    """A verified solution.

    Attributes
    ----------
    d : (K, n) array or None
        The iterate; None if and only if the status is FAILED.
    status : SolveStatus
        The verified status.
    iterations : int or None
        The solver's iteration count.
    residuals : Residuals or None
        Recomputed from the data; None without an iterate, and for the unconstrained minimiser of a
        Cholesky factorisation, whose residuals are only rounding.
    bound_duals, row_duals : array or None
        Multipliers as in `RawSolution`.
    message : str
        The solver's message, or why its answer was rejected.
    """

    __slots__ = (
        "_residuals", "bound_duals", "d", "iterations", "message", "row_duals", "status",
    )

    def __init__(
        self,
        d: Array | None,
        status: SolveStatus,
        iterations: int | None = None,
        residuals: Residuals | Callable[[], Residuals] | None = None,
        bound_duals: Array | None = None,
        row_duals: Array | None = None,
        message: str = "",
    ) -> None:
        self.d, self.status, self.iterations = d, status, iterations
        self._residuals, self.message = residuals, message
        self.bound_duals, self.row_duals = bound_duals, row_duals

    @property
    def residuals(self) -> Residuals | None:
        """Recomputed from the data at the first access."""
        found = self._residuals
        if callable(found):
            found = self._residuals = found()
        return found

    def __reduce__(self) -> tuple[type[Solution], tuple[Any, ...]]:
        return Solution, (
            self.d, self.status, self.iterations, self.residuals, self.bound_duals,
            self.row_duals, self.message,
        )

    def __repr__(self) -> str:
        return f"Solution({self.status.name}, iterations={self.iterations}, {self.residuals})"
