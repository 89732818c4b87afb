"""Every solver that qpsolvers offers, through one translation table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .layout import Layout, Structure, Style
from .native import Answer, NativeSolver
from .options import SolverOptions
from .qp import QP

__all__ = ["TRANSLATIONS", "DispatchSolver", "Translation", "qpsolvers_arguments"]

Point = NDArray[np.float64] | None


@dataclass(frozen=True)
class Translation:
    """How our vocabulary reads in one solver's own."""

    method: str
    package: str
    matrices: Literal["csc", "dense"]
    bounds: Literal["box", "rows"]
    cap: str | None
    absolute: tuple[str, ...]
    relative: tuple[str, ...] = ()
    time_limit: str | None = None
    start: bool = False
    needs_row: bool = False
    keep_empty: bool = False
    reports_infeasibility: bool = False
    default_cap: int | None = None
    beyond_cap: int = 0
    others: tuple[tuple[str, float], ...] = ()
    objective: float = 1.0


# Caps, tolerances and traps as measured (qpsolvers 4.13). cvxopt is harmed by its start; the
# IPMs and quadprog ignore it; clarabel and scs hand a QP without rows to a least-squares
# routine that calls it unbounded; ecos and cvxopt choke on infinite bounds, and ecos on a
# relative tolerance of 0. highs without rows claims to be optimal far from the optimum, and adds
# 1e-7 to the Hessian's diagonal, which is much where weights spread over decades; with 1e-12 it
# can cycle for ever, so it gets 1e-9 and a cap. proxqp takes
# a direction d with |H d| <= 1e-4 |d| for an unbounded one, as osqp and piqp do; qpsolvers lets
# nobody change that of proxqp.
TRANSLATIONS: Mapping[str, Translation] = {
    "clarabel": Translation(
        "interior point", "clarabel", "csc", "rows", "max_iter", ("tol_gap_abs", "tol_feas"),
        ("tol_gap_rel",), "time_limit", needs_row=True, reports_infeasibility=True,
    ),
    "cvxopt": Translation(
        "interior point", "cvxopt", "csc", "rows", "maxiters", ("abstol", "feastol"), ("reltol",),
    ),
    "daqp": Translation(
        "dual active set", "daqp", "dense", "box", "iter_limit", ("primal_tol", "dual_tol"),
        time_limit="time_limit", start=True, beyond_cap=1,
    ),
    "ecos": Translation(
        "interior point", "ecos", "dense", "rows", "max_iters", ("abstol", "feastol", "reltol"),
        needs_row=True,
    ),
    "highs": Translation(
        "active set", "highspy", "csc", "box", "qp_iteration_limit",
        ("primal_feasibility_tolerance", "dual_feasibility_tolerance"), time_limit="time_limit",
        needs_row=True, default_cap=10000, others=(("qp_regularization_value", 1e-9),),
    ),
    "osqp": Translation(
        "ADMM", "osqp", "csc", "box", "max_iter", ("eps_abs",), ("eps_rel",), "time_limit",
        start=True, reports_infeasibility=True, others=(("eps_dual_inf", 1e-12),),
    ),
    "piqp": Translation(
        "interior point", "piqp", "csc", "box", "max_iter", ("eps_abs",), ("eps_rel",),
        keep_empty=True, reports_infeasibility=True, others=(("eps_dual_inf", 1e-12),),
    ),
    "proxqp": Translation(
        "augmented Lagrangian", "proxsuite", "dense", "box", "max_iter", ("eps_abs",),
        ("eps_rel",), default_cap=200, reports_infeasibility=True, objective=2.0**10,
    ),
    "qpalm": Translation(
        "augmented Lagrangian", "qpalm", "csc", "box", "max_iter", ("eps_abs",), ("eps_rel",),
        "time_limit", reports_infeasibility=True,
    ),
    "quadprog": Translation(
        "dual active set", "quadprog", "dense", "rows", None, (),
    ),
    "scs": Translation(
        "ADMM", "scs", "csc", "rows", "max_iters", ("eps_abs",), ("eps_rel",), "time_limit_secs",
        start=True, needs_row=True,
    ),
}


class DispatchSolver(NativeSolver):
    """Hand the QP to one solver through ``qpsolvers.solve_problem``.

    Only the arrays are kept; a solver gets the limits that there are, and no others.
    """

    package = "qpsolvers"  # imports every solver that is installed
    _keeps, _warns = False, True

    def __init__(self, name: str, options: SolverOptions) -> None:
        super().__init__(options)
        self.name = name
        self._translation = how = TRANSLATIONS[name]
        self.style = Style(
            how.matrices, bounds=how.bounds, sides=1, needs_row=how.needs_row,
            objective=how.objective,
        )
        self._keywords = _keywords(how, options)
        self._solve_problem: Callable[..., Any] = self._package.solve_problem

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.name, self.options)

    def structure(self, qp: QP) -> Structure:
        """The limits of this QP."""
        return Structure.of(qp, exact=True)

    def _set_up(self, layout: Layout) -> Any:
        return self._package.Problem(*qpsolvers_arguments(layout, self._translation.keep_empty))

    def _limit(self, handle: Any, seconds: float) -> None:
        if self._translation.time_limit is not None:
            self._keywords[self._translation.time_limit] = seconds

    def _run(self, handle: Any, layout: Layout, start: Point, duals: Point) -> Answer:
        initial = start.copy() if start is not None and self._translation.start else None
        answer = self._solve_problem(
            handle, self.name, initvals=initial, verbose=False, **self._keywords
        )
        iterations, message = _report(answer.extras)
        return Answer(
            answer.x, _multipliers(layout, answer), bool(answer.found), True, iterations, message
        )


def qpsolvers_arguments(layout: Layout, keep_empty: bool = False) -> tuple[Any, ...]:
    r"""P, q, G, h, A, b, l, u of a one-sided layout; None for what there is not.

    .. math::
        \min_x \tfrac12 x^\top P x + q^\top x \quad \text{s.t.} \quad
        G x \le h, \quad A x = b, \quad l \le x \le u
    """
    rows = layout.matrix, layout.upper
    level = layout.equality_matrix, layout.level
    box = layout.box_lower, layout.box_upper
    return (
        layout.hessian, layout.gradient,
        *(rows if keep_empty or layout.upper.size else (None, None)),
        *(level if keep_empty or layout.level.size else (None, None)),
        *(box if layout.boxed else (None, None)),
    )


def _multipliers(layout: Layout, answer: Any) -> Point:
    """Multipliers of all constraints; None where some are missing."""
    parts = []
    for values, size in (
        (answer.z, layout.upper.size), (answer.y, layout.level.size),
        (answer.z_box, layout.box_upper.size),
    ):
        numbers = np.empty(0)
        if size and values is not None:
            numbers = np.asarray(values, np.float64).ravel()
        if numbers.size < size:
            return None
        parts.append(numbers[:size])
    return layout.duals(*parts)


def _keywords(how: Translation, options: SolverOptions) -> dict[str, Any]:
    words: dict[str, Any] = dict(how.others)
    words.update(dict.fromkeys(how.absolute, options.absolute_tolerance))
    words.update(dict.fromkeys(how.relative, options.relative_tolerance))
    cap = how.default_cap if options.max_iterations is None else options.max_iterations
    if cap is not None and how.cap is not None:
        words[how.cap] = int(cap) + how.beyond_cap
    return words


def _report(extras: Mapping[str, Any]) -> tuple[int | None, str]:
    """The solver's own count and words, wherever this solver keeps them."""
    info = extras.get("info")
    # proxqp's cap is on its outer iterations.
    count = getattr(info, "iter_ext", getattr(info, "iter", None))
    for key in ("iter", "iterations"):
        count = extras.get(key, count)
    if count is not None:
        count = int(np.ravel(count)[0])  # quadprog counts two: added, then dropped
    status = getattr(info, "status", extras.get("status", extras.get("exitFlag", "")))
    return count, str(status)
