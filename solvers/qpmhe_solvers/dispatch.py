"""Every solver that qpsolvers offers, through one translation table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .options import SolverOptions
from .qp import QP
from .solution import RawSolution
from .solver import Solver

__all__ = ["TRANSLATIONS", "DispatchSolver", "Translation"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Translation:
    """How our vocabulary reads in one solver's own.

    Parameters
    ----------
    matrices : {"csc", "dense"}
        The form in which the solver takes its matrices here.
    bounds : {"box", "rows"}
        Whether it takes infinite bounds natively, or finite bounds as inequality rows.
    cap, time_limit : str or None
        Keyword of the iteration cap and of the time limit in seconds.
    absolute, relative : tuple of str
        Keywords of the tolerances.
    start : bool
        Whether a primal start is used by the solver and does it good.
    default_cap : int or None
        Cap where none is asked for and the solver's own would let it run for minutes.
    needs_row : bool
        Whether a QP without any inequality row goes wrong, so that a void row is added.
    """

    matrices: Literal["csc", "dense"]
    bounds: Literal["box", "rows"]
    cap: str | None
    absolute: tuple[str, ...]
    relative: tuple[str, ...] = ()
    time_limit: str | None = None
    start: bool = False
    needs_row: bool = False
    default_cap: int | None = None


# Caps, tolerances and traps as measured (qpsolvers 4.13). cvxopt is harmed by its start; the
# IPMs and quadprog ignore it; clarabel and scs hand a QP without rows to a least-squares
# routine that calls it unbounded; ecos and cvxopt choke on infinite bounds, and ecos on a
# relative tolerance of 0. highs without rows claims to be optimal far from the optimum.
TRANSLATIONS: Mapping[str, Translation] = {
    "clarabel": Translation(
        "csc", "rows", "max_iter", ("tol_gap_abs", "tol_feas"), ("tol_gap_rel",), "time_limit",
        needs_row=True,
    ),
    "cvxopt": Translation("csc", "rows", "maxiters", ("abstol", "feastol"), ("reltol",)),
    "daqp": Translation(
        "dense", "box", "iter_limit", ("primal_tol", "dual_tol"), time_limit="time_limit",
        start=True,
    ),
    "ecos": Translation(
        "dense", "rows", "max_iters", ("abstol", "feastol", "reltol"), needs_row=True
    ),
    "highs": Translation(
        "csc", "box", "qp_iteration_limit",
        ("primal_feasibility_tolerance", "dual_feasibility_tolerance"), time_limit="time_limit",
        needs_row=True,
    ),
    "osqp": Translation(
        "csc", "box", "max_iter", ("eps_abs",), ("eps_rel",), "time_limit", start=True
    ),
    "piqp": Translation("csc", "box", "max_iter", ("eps_abs",), ("eps_rel",)),
    "proxqp": Translation(
        "dense", "box", "max_iter", ("eps_abs",), ("eps_rel",), default_cap=200
    ),
    "qpalm": Translation("csc", "box", "max_iter", ("eps_abs",), ("eps_rel",), "time_limit"),
    "quadprog": Translation("dense", "rows", None, ()),
    "scs": Translation(
        "csc", "rows", "max_iters", ("eps_abs",), ("eps_rel",), "time_limit_secs", start=True,
        needs_row=True,
    ),
}


class DispatchSolver(Solver):
    """Hand the QP to one solver through ``qpsolvers.solve_problem``, built anew each time.

    Parameters
    ----------
    name : str
        The solver's name in qpsolvers, one of `TRANSLATIONS`.
    options : SolverOptions
        Limits and accuracy, translated into the solver's own keywords.
    """

    def __init__(self, name: str, options: SolverOptions) -> None:
        import qpsolvers  # late: it imports every solver that is installed

        super().__init__(options)
        self.name = name
        self._translation = TRANSLATIONS[name]
        self._keywords = _keywords(self._translation, options)
        self._problem: Callable[..., Any] = qpsolvers.Problem
        self._solve_problem: Callable[..., Any] = qpsolvers.solve_problem

    def _solve(self, qp: QP, start: Array | None) -> RawSolution:
        how = self._translation
        constraints = _Constraints(qp, how)
        hessian = qp.csc() if how.matrices == "csc" else qp.dense()
        problem = self._problem(
            hessian, qp.gradient.ravel().copy(), *constraints.inequalities,
            *constraints.equalities, *constraints.box,
        )
        initial = None if start is None or not how.start else np.ravel(start).copy()
        answer = self._solve_problem(
            problem, self.name, initvals=initial, verbose=False, **self._keywords
        )
        bound_duals, row_duals = constraints.multipliers(answer)
        iterations, message = _told(answer.extras)
        return RawSolution(
            answer.x, bool(answer.found), iterations, bound_duals, row_duals, message
        )


class _Constraints:
    """A QP's bounds and two-sided rows as qpsolvers wants them, and the way back."""

    def __init__(self, qp: QP, how: Translation) -> None:
        self._qp = qp
        lower, upper = qp.lower.ravel(), qp.upper.ravel()
        row_lower, row_upper = qp.row_lower.ravel(), qp.row_upper.ravel()
        equal = row_lower == row_upper
        self._equal = np.flatnonzero(equal)
        self._row_up = np.flatnonzero(~equal & np.isfinite(row_upper))
        self._row_low = np.flatnonzero(~equal & np.isfinite(row_lower))
        self._up = np.flatnonzero(np.isfinite(upper))
        self._low = np.flatnonzero(np.isfinite(lower))
        self._as_rows = how.bounds == "rows"
        self.box: tuple[Array | None, Array | None] = (None, None)
        if not self._as_rows and (self._up.size or self._low.size):
            self.box = (lower.copy(), upper.copy())
        dense = how.matrices == "dense"
        blocks, sides = [], []
        rows: Any = None
        if qp.rows:
            rows = qp.dense_rows() if dense else qp.csc_rows().tocsr()
            blocks += [rows[self._row_up], -rows[self._row_low]]
            sides += [row_upper[self._row_up], -row_lower[self._row_low]]
        if self._as_rows:
            blocks += [
                _unit_rows(self._up, qp.size, dense), -_unit_rows(self._low, qp.size, dense)
            ]
            sides += [upper[self._up], -lower[self._low]]
        side = np.concatenate([*sides, np.empty(0)])
        if how.needs_row and side.size == 0:
            blocks, side = [_void_row(qp.size, dense)], np.ones(1)
        self.inequalities: tuple[Any, Array | None] = (None, None)
        if side.size:
            self.inequalities = (_stack(blocks, dense), side)
        self.equalities: tuple[Any, Array | None] = (None, None)
        if self._equal.size and rows is not None:
            self.equalities = (_stack([rows[self._equal]], dense), row_upper[self._equal])

    def multipliers(self, answer: Any) -> tuple[Array | None, Array | None]:
        """Multipliers of our bounds and rows from those of the qpsolvers form."""
        qp, ups, lows = self._qp, self._row_up.size, self._row_low.size
        bound_duals, row_duals = np.zeros(qp.size), np.zeros(qp.stages * qp.rows)
        wanted = ups + lows + (self._up.size + self._low.size if self._as_rows else 0)
        z = _numbers(answer.z, wanted)
        y = _numbers(answer.y, self._equal.size)
        if z is None or y is None:
            return None, None
        if qp.rows:
            row_duals[self._row_up] += z[:ups]
            row_duals[self._row_low] -= z[ups : ups + lows]
            row_duals[self._equal] += y
        if self._as_rows:
            split = ups + lows + self._up.size
            bound_duals[self._up] += z[ups + lows : split]
            bound_duals[self._low] -= z[split:]
        elif self.box[0] is not None:
            z_box = _numbers(answer.z_box, qp.size)
            if z_box is None:
                return None, None
            bound_duals += z_box
        return bound_duals, row_duals


def _numbers(values: Any, size: int) -> Array | None:
    """The first ``size`` multipliers; none expected may be given as nothing."""
    if size == 0:
        return np.empty(0)
    if values is None:
        return None
    numbers = np.asarray(values, dtype=np.float64).ravel()
    return numbers[:size] if numbers.size >= size else None


def _unit_rows(columns: NDArray[np.intp], width: int, dense: bool) -> Any:
    count = columns.size
    if dense:
        rows = np.zeros((count, width))
        rows[np.arange(count), columns] = 1.0
        return rows
    from scipy.sparse import csr_matrix

    return csr_matrix((np.ones(count), columns, np.arange(count + 1)), shape=(count, width))


def _void_row(width: int, dense: bool) -> Any:
    from scipy.sparse import csr_matrix

    return np.zeros((1, width)) if dense else csr_matrix((1, width))


def _stack(blocks: list[Any], dense: bool) -> Any:
    if dense:
        return np.vstack(blocks)
    from scipy.sparse import csc_matrix, vstack

    stacked = csc_matrix(vstack(blocks, format="csc"))
    stacked.sort_indices()
    return stacked


def _keywords(how: Translation, options: SolverOptions) -> dict[str, Any]:
    words: dict[str, Any] = dict.fromkeys(how.absolute, options.absolute_tolerance)
    words.update(dict.fromkeys(how.relative, options.relative_tolerance))
    cap = how.default_cap if options.max_iterations is None else options.max_iterations
    if cap is not None and how.cap is not None:
        words[how.cap] = int(cap)
    if options.time_limit is not None and how.time_limit is not None:
        words[how.time_limit] = options.time_limit
    return words


def _told(extras: Mapping[str, Any]) -> tuple[int | None, str]:
    """The solver's own count and words, wherever this solver keeps them."""
    info = extras.get("info")
    count = getattr(info, "iter", None)
    for key in ("iter", "iterations"):
        count = extras.get(key, count)
    if count is not None:
        count = int(np.ravel(count)[0])  # quadprog tells two numbers: added, then dropped
    status = getattr(info, "status", extras.get("status", extras.get("exitFlag", "")))
    return count, str(status)
