"""OSQP with a workspace: an operator splitting method, warm-started with multipliers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..options import SolverOptions
from .layout import Layout, Style
from .workspace import Answer, NativeSolver

__all__ = ["OsqpSolver"]

Array = NDArray[np.float64]

# OSQP looks whether it is done at every so many iterations; at a low cap it should each time.
_CHECKED = 25
_RHO = 0.1


class OsqpSolver(NativeSolver):
    """Solve by OSQP."""

    package = "osqp"
    style = Style("csc", triangle="upper", bounds="rows", equalities="among")

    def __init__(self, options: SolverOptions) -> None:
        super().__init__(options)
        cap = options.max_iterations
        self._settings: dict[str, Any] = {
            "eps_abs": options.absolute_tolerance, "eps_rel": options.relative_tolerance,
            "verbose": False, "rho": _RHO,
            "eps_dual_inf": 1e-12,  # H is positive definite: there is always a minimiser
        }
        if cap is not None:
            self._settings["max_iter"] = int(cap)
            if cap < _CHECKED:
                self._settings["check_termination"] = 1

    def _set_up(self, layout: Layout) -> Any:
        handle = self._package.OSQP()
        handle.setup(
            layout.hessian, layout.gradient, layout.matrix, layout.lower, layout.upper,
            **self._settings,
        )
        return handle

    def _update(self, handle: Any, layout: Layout) -> None:
        if not self.options.warm_start:
            handle.update_settings(rho=_RHO)  # adapted by the solves before
        handle.update(
            q=layout.gradient, l=layout.lower, u=layout.upper,
            Px=layout.hessian.data, Ax=layout.matrix.data,
        )

    def _limit(self, handle: Any, seconds: float) -> None:
        handle.update_settings(time_limit=seconds)

    def _run(
        self, handle: Any, layout: Layout, start: Array | None, duals: Array | None
    ) -> Answer:
        handle.warm_start(
            x=np.zeros(layout.size) if start is None else start,
            y=np.zeros(layout.constraints.size) if duals is None else duals[layout.constraints],
        )
        result = handle.solve(raise_error=False)
        status = result.info.status
        # Anything else comes without an iterate, or with a certificate in its place.
        stopped = status.startswith(("solved", "maximum", "run time"))
        return Answer(
            result.x, layout.duals(result.y, None, None), status == "solved", stopped,
            int(result.info.iter), status,
        )
