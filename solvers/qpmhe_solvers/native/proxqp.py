"""ProxQP with a workspace: a primal-dual augmented Lagrangian method, dense."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .layout import Layout, Style
from .workspace import Answer, NativeSolver

__all__ = ["ProxqpSolver", "ProxqpSparseSolver"]

Array = NDArray[np.float64]

# Outer iterations where no cap is asked for: of its own accord it takes 10000, for minutes.
_CAP = 200


class ProxqpSolver(NativeSolver):
    """Solve by ProxQP's dense solver.

    It begins at the minimiser under the equality rows each time: starts with the multipliers
    of the last solve took as many iterations or more, and longer.
    """

    package = "proxsuite"
    style = Style("dense")

    def _made(self, layout: Layout) -> Any:
        return self._package.proxqp.dense.QP(
            layout.size, layout.equalities.size, layout.constraints.size, layout.boxed
        )

    def _set_up(self, layout: Layout) -> Any:
        handle, options = self._made(layout), self.options
        settings = handle.settings
        settings.eps_abs = settings.eps_duality_gap_abs = options.absolute_tolerance
        settings.eps_rel = settings.eps_duality_gap_rel = options.relative_tolerance
        settings.check_duality_gap = True
        settings.eps_dual_inf = 0.0  # H is positive definite: there is always a minimiser
        settings.max_iter = _CAP if options.max_iterations is None else int(options.max_iterations)
        handle.init(**self._parts(layout))
        return handle

    def _update(self, handle: Any, layout: Layout) -> None:
        handle.update(**self._parts(layout), update_preconditioner=True)

    def _parts(self, layout: Layout) -> dict[str, Any]:
        parts = {
            "H": layout.hessian, "g": layout.gradient, "A": layout.equality_matrix,
            "b": layout.level, "C": layout.matrix, "l": layout.lower, "u": layout.upper,
        }
        if layout.boxed:
            parts |= {"l_box": layout.box_lower, "u_box": layout.box_upper}
        return parts

    def _run(
        self, handle: Any, layout: Layout, start: Array | None, duals: Array | None
    ) -> Answer:
        handle.solve()
        results, count = handle.results, layout.constraints.size
        status, z = results.info.status.name, results.z
        solved = status == "PROXQP_SOLVED"
        return Answer(
            results.x,
            layout.duals(z[:count], results.y, z[count:] if layout.boxed else None),
            solved, solved or status == "PROXQP_MAX_ITER_REACHED",
            int(results.info.iter_ext), status,
        )


class ProxqpSparseSolver(ProxqpSolver):
    """Solve by ProxQP with sparse matrices.

    It begins at the minimiser under the equality rows each time, like the dense one.
    """

    style = Style("csc", bounds="rows")

    def _made(self, layout: Layout) -> Any:
        return self._package.proxqp.sparse.QP(
            layout.size, layout.equalities.size, layout.constraints.size
        )
