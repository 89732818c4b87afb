"""Every solver of qpsolvers, through one translation table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .backend import Backend
from .layout import QPLayout, QPStructure
from .native import NATIVE, NativeAnswer, NativeSolver
from .options import SolverOptions
from .qp import QP
from .translations import TRANSLATIONS

Point = NDArray[np.float64] | None


class DispatchSolver(NativeSolver):
    """Pass the QP to one solver through ``qpsolvers.solve_problem``.

    Only the arrays are kept; the solver gets only finite limits.
    """

    package = "qpsolvers"  # imports every solver that is installed
    kept = 8  # with and without sets, at a few phases of sampling
    _keeps, _warns = False, True

    def __init__(self, name: str, options: SolverOptions) -> None:
        super().__init__(options)
        self.name = name
        if name == "highs":
            _silence_highs()
        self._translation = how = TRANSLATIONS[name]
        self.style = how.style
        self._keywords = how.keywords(options)
        self._solve_problem: Callable[..., Any] = self._package.solve_problem

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.name, self.options)

    def prepare(self, size: int) -> None:
        """Import what this solver's first solve imports; see `Solver.prepare`."""
        self._rehearse(self.name)

    def structure(self, qp: QP) -> QPStructure:
        """The limits of this QP."""
        return QPStructure.of(qp, exact=True, bounds=self.style.bounds == "rows")

    def _set_up(self, layout: QPLayout) -> Any:
        return self._package.Problem(*qpsolvers_arguments(layout, self._translation.keep_empty))

    def _limit(self, handle: Any, seconds: float) -> None:
        if self._translation.time_limit is not None:
            self._keywords[self._translation.time_limit] = seconds

    def _run(self, handle: Any, layout: QPLayout, start: Point, duals: Point) -> NativeAnswer:
        initial = start.copy() if start is not None and self._translation.start else None
        answer = self._solve_problem(
            handle, self.name, initvals=initial, verbose=False, **self._keywords
        )
        iterations, message = _report(answer.extras)
        # osqp then leaves 2143289344 everywhere, the bits of a NaN read as an integer.
        nothing = self.name == "osqp" and "infeasible" in message
        return NativeAnswer(
            None if nothing else answer.x, _multipliers(layout, answer), bool(answer.found), True,
            iterations, message,
        )


@cache
def _silence_highs() -> None:
    """Let HiGHS write the banner that it writes once a process to nowhere.

    It does so where its first solver is made, before qpsolvers can turn it off.
    """
    # A release that has no such class shows its banner, but works.
    with suppress(ImportError, AttributeError):
        from highspy._core import _Highs

        first = _Highs()
        first.setOptionValue("log_to_console", False)
        first.run()


def qpsolvers_arguments(layout: QPLayout, keep_empty: bool = False) -> tuple[Any, ...]:
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


def _multipliers(layout: QPLayout, answer: Any) -> Point:
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


#: The backends of this module, with "qpsolvers:" in front where there is a native one.
DISPATCHED = tuple(
    Backend(
        f"qpsolvers:{name}" if name in NATIVE else name, partial(DispatchSolver, name),
        how.method, how.package, how.package, how.style.matrices,
        iteration_cap=how.cap is not None,
        iterate_at_cap=how.cap is not None and name != "daqp",
        warm_start=how.start,
        time_limit=how.time_limit is not None,
        reports_infeasibility=how.reports_infeasibility,
    )
    for name, how in TRANSLATIONS.items()
)
