"""Clarabel with a workspace: an interior point method for cones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .layout import Layout, Style
from .workspace import Answer, NativeSolver

__all__ = ["ClarabelSolver"]

Array = NDArray[np.float64]


class ClarabelSolver(NativeSolver):
    """Solve by Clarabel.

    It knows no start: it begins anew each time.
    """

    package = "clarabel"
    style = Style(
        "csc", triangle="upper", bounds="rows", equalities="among", sides=1, infinite=False
    )

    def _set_up(self, layout: Layout) -> Any:
        options, settings = self.options, self._package.DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False  # its data could not be updated
        settings.max_threads = 1
        settings.tol_gap_abs = settings.tol_feas = options.absolute_tolerance
        settings.tol_gap_rel = options.relative_tolerance
        if options.max_iterations is not None:
            settings.max_iter = int(options.max_iterations)
        equal = int(layout.structure.equal.sum())
        cones = [
            kind(count)
            for kind, count in (
                (self._package.ZeroConeT, equal),
                (self._package.NonnegativeConeT, layout.constraints.size - equal),
            )
            if count
        ]
        return self._package.DefaultSolver(
            layout.hessian, layout.gradient, layout.matrix, layout.upper, cones, settings
        )

    def _update(self, handle: Any, layout: Layout) -> None:
        handle.update(
            P=layout.hessian.data, q=layout.gradient, A=layout.matrix.data, b=layout.upper
        )

    def _limit(self, handle: Any, seconds: float) -> None:
        settings = handle.get_settings()
        settings.time_limit = seconds
        handle.update(settings=settings)

    def _run(
        self, handle: Any, layout: Layout, start: Array | None, duals: Array | None
    ) -> Answer:
        solution = handle.solve()
        status = str(solution.status)
        solved = status == "Solved"
        return Answer(
            np.array(solution.x), layout.duals(np.array(solution.z), None, None), solved,
            solved or status in ("MaxIterations", "MaxTime"), int(solution.iterations), status,
        )
