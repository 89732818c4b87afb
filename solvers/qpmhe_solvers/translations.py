"""Each solver's names for our caps and tolerances, and its matrix format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .layout import QPStyle
from .options import SolverOptions


@dataclass(frozen=True)
class Translation:
    """Our options under one solver's names; the style is the matrix format for qpsolvers."""

    method: str
    package: str
    style: QPStyle
    cap: str | None
    absolute: tuple[str, ...]
    relative: tuple[str, ...] = ()
    time_limit: str | None = None
    start: bool = False
    keep_empty: bool = False
    reports_infeasibility: bool = False
    default_cap: int | None = None
    beyond_cap: int = 0
    others: tuple[tuple[str, float], ...] = ()

    def keywords(self, options: SolverOptions) -> dict[str, Any]:
        """The options under the solver's names, without the time limit."""
        words: dict[str, Any] = dict(self.others)
        words.update(dict.fromkeys(self.absolute, options.absolute_tolerance))
        words.update(dict.fromkeys(self.relative, options.relative_tolerance))
        cap = self.default_cap if options.max_iterations is None else options.max_iterations
        if cap is not None and self.cap is not None:
            words[self.cap] = int(cap) + self.beyond_cap
        return words


# Caps, tolerances and traps as measured (qpsolvers 4.13). cvxopt is harmed by its start; the
# IPMs and quadprog ignore it; clarabel and scs hand a QP without rows to a least-squares
# routine that calls it unbounded; ecos and cvxopt choke on infinite bounds, and ecos on a
# relative tolerance of 0. highs without rows claims to be optimal far from the optimum, and adds
# 1e-7 to the Hessian's diagonal, which is much where weights spread over decades; with 1e-12 it
# can cycle for ever, so it gets 1e-9 and a cap. osqp, piqp and proxqp take a direction d with
# |H d| <= 1e-4 |d| for an unbounded one, though H is positive definite; qpsolvers lets nobody
# change that of proxqp, which without a cap goes on for minutes.
TRANSLATIONS: Mapping[str, Translation] = {
    "clarabel": Translation(
        "interior point", "clarabel", QPStyle("csc", bounds="rows", sides=1, needs_row=True),
        "max_iter", ("tol_gap_abs", "tol_feas"), ("tol_gap_rel",), "time_limit",
        reports_infeasibility=True,
    ),
    "cvxopt": Translation(
        "interior point", "cvxopt", QPStyle("csc", bounds="rows", sides=1),
        "maxiters", ("abstol", "feastol"), ("reltol",),
    ),
    "daqp": Translation(
        "dual active set", "daqp", QPStyle("dense", sides=1),
        "iter_limit", ("primal_tol", "dual_tol"), time_limit="time_limit", start=True,
        beyond_cap=1,
    ),
    "ecos": Translation(
        "interior point", "ecos", QPStyle("dense", bounds="rows", sides=1, needs_row=True),
        "max_iters", ("abstol", "feastol", "reltol"),
    ),
    "highs": Translation(
        "active set", "highspy", QPStyle("csc", sides=1, needs_row=True),
        "qp_iteration_limit", ("primal_feasibility_tolerance", "dual_feasibility_tolerance"),
        time_limit="time_limit", default_cap=10000, others=(("qp_regularization_value", 1e-9),),
    ),
    "osqp": Translation(
        "ADMM", "osqp", QPStyle("csc", sides=1),
        "max_iter", ("eps_abs",), ("eps_rel",), "time_limit", start=True,
        reports_infeasibility=True, others=(("eps_dual_inf", 1e-12),),
    ),
    "piqp": Translation(
        "interior point", "piqp", QPStyle("csc", sides=1),
        "max_iter", ("eps_abs",), ("eps_rel",), keep_empty=True, reports_infeasibility=True,
        others=(("eps_dual_inf", 1e-12),),
    ),
    "proxqp": Translation(
        "augmented Lagrangian", "proxsuite", QPStyle("dense", sides=1, objective=2.0**9),
        "max_iter", ("eps_abs",), ("eps_rel",), default_cap=200, reports_infeasibility=True,
    ),
    "qpalm": Translation(
        "augmented Lagrangian", "qpalm", QPStyle("csc", sides=1),
        "max_iter", ("eps_abs",), ("eps_rel",), "time_limit", reports_infeasibility=True,
    ),
    "quadprog": Translation(
        "dual active set", "quadprog", QPStyle("dense", bounds="rows", sides=1), None, (),
    ),
    "scs": Translation(
        "ADMM", "scs", QPStyle("csc", bounds="rows", sides=1, needs_row=True),
        "max_iters", ("eps_abs",), ("eps_rel",), "time_limit_secs", start=True,
    ),
}
