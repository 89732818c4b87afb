"""PIQP with a workspace: a proximal interior point method, staged or dense."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .layout import Layout, Style
from .workspace import Answer, NativeSolver

__all__ = ["PiqpDenseSolver", "PiqpSolver"]

Array = NDArray[np.float64]


class PiqpSolver(NativeSolver):
    """Solve by PIQP's sparse solver, which factorises stage by stage.

    Its multistage factorisation wants the unknowns in the order of the stages, as they are.
    PIQP knows no start: it begins anew each time.
    """

    package = "piqp"
    style = Style("csc", triangle="upper", infinite=False)

    def _made(self) -> Any:
        handle = self._package.SparseSolver()
        handle.settings.kkt_solver = self._package.KKTSolver.sparse_multistage
        return handle

    def _set_up(self, layout: Layout) -> Any:
        handle, options = self._made(), self.options
        settings = handle.settings
        settings.eps_abs = settings.eps_duality_gap_abs = options.absolute_tolerance
        settings.eps_rel = settings.eps_duality_gap_rel = options.relative_tolerance
        if hasattr(settings, "eps_dual_inf"):  # PIQP 0.6.1 has no such limit
            settings.eps_dual_inf = 1e-12  # H is positive definite: there is always a minimiser
        if options.max_iterations is not None:
            settings.max_iter = int(options.max_iterations)
        handle.setup(layout.hessian, layout.gradient, *self._others(layout))
        return handle

    def _update(self, handle: Any, layout: Layout) -> None:
        handle.update(layout.hessian, layout.gradient, *self._others(layout))

    def _others(self, layout: Layout) -> tuple[Any, ...]:
        """A, b, G, lower and upper limits, lower and upper bounds."""
        box = (layout.box_lower, layout.box_upper) if layout.boxed else (None, None)
        return (
            layout.equality_matrix, layout.level, layout.matrix, layout.lower, layout.upper, *box
        )

    def _run(
        self, handle: Any, layout: Layout, start: Array | None, duals: Array | None
    ) -> Answer:
        status = handle.solve()
        result, kinds = handle.result, self._package.Status
        box = result.z_bu - result.z_bl if layout.boxed else None
        return Answer(
            result.x, layout.duals(result.z_u - result.z_l, result.y, box),
            status == kinds.PIQP_SOLVED,
            status in (kinds.PIQP_SOLVED, kinds.PIQP_MAX_ITER_REACHED),
            int(result.info.iter), status.name,
        )


class PiqpDenseSolver(PiqpSolver):
    """Solve by PIQP with dense matrices."""

    style = Style("dense", infinite=False)

    def _made(self) -> Any:
        return self._package.DenseSolver()
