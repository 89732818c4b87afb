"""ProxQP's sparse solver with a workspace."""

from __future__ import annotations

from typing import Any

from .layout import Layout, Style
from .proxqp import ProxqpSolver

__all__ = ["ProxqpSparseSolver"]


class ProxqpSparseSolver(ProxqpSolver):
    """Solve by ProxQP with sparse matrices.

    It begins at the minimiser under the equality rows each time, like the dense one.

    Parameters
    ----------
    options : SolverOptions
        Tolerances, and a cap on the outer iterations; there is no time limit.
    """

    style = Style("csc", bounds="rows")

    def _made(self, layout: Layout) -> Any:
        return self._package.proxqp.sparse.QP(
            layout.size, layout.equalities.size, layout.constraints.size
        )
