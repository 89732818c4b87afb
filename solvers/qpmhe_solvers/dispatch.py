"""Every solver that qpsolvers offers, through one translation table."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .gathered import GatheredQP
from .matrices import QpsolversMatrices, pattern_of_limits
from .options import SolverOptions
from .qp import QP
from .solution import RawSolution
from .solver import Solver

__all__ = ["TRANSLATIONS", "DispatchSolver", "Translation"]

Array = NDArray[np.float64]

# Patterns of limits kept by one solver: with and without sets, at a few phases of sampling.
_KEPT = 8


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


class DispatchSolver(Solver):
    """Hand the QP to one solver through ``qpsolvers.solve_problem``."""

    _keeps = False

    def __init__(self, name: str, options: SolverOptions) -> None:
        import qpsolvers  # late: it imports every solver that is installed

        super().__init__(options)
        self.name = name
        self._translation = TRANSLATIONS[name]
        self._keywords = _keywords(self._translation, options)
        self._problem: Callable[..., Any] = qpsolvers.Problem
        self._solve_problem: Callable[..., Any] = qpsolvers.solve_problem
        self._forms: dict[Hashable, tuple[QpsolversMatrices, Any]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_forms": {}}  # copies of arrays no longer share their numbers

    def prepare(self, size: int) -> None:
        """Import what qpsolvers and the solver import at their first solve."""
        self._rehearse()
        self._forms.clear()

    def _solve(self, qp: QP, start: Array | None) -> RawSolution:
        qp = GatheredQP.of(qp)
        form, problem = self._form(qp)
        form.fill(qp)
        initial = None
        if start is not None and self._translation.start:
            initial = np.ravel(start).copy()
        words = self._keywords
        if self.time_limit is not None and self._translation.time_limit is not None:
            words[self._translation.time_limit] = self.time_limit
        answer = self._solve_problem(
            problem, self.name, initvals=initial, verbose=False, **words
        )
        bound_duals, row_duals = form.multipliers(answer)
        iterations, message = _report(answer.extras)
        return RawSolution(
            answer.x, bool(answer.found), iterations, bound_duals, row_duals, message
        )

    def _form(self, qp: QP) -> tuple[QpsolversMatrices, Any]:
        """The layout for this QP's pattern of limits, and the problem made of its arrays."""
        key = pattern_of_limits(qp)
        made = self._forms.pop(key, None)
        if made is None:
            how = self._translation
            form = QpsolversMatrices(
                qp, dense=how.matrices == "dense", box=how.bounds == "box",
                needs_row=how.needs_row, keep_empty=how.keep_empty,
                objective=how.objective,
            )
            made = form, self._problem(*form.arguments)
            if len(self._forms) == _KEPT:
                del self._forms[next(iter(self._forms))]  # the longest unused
        self._forms[key] = made
        return made


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
