"""PIQP's dense solver with a workspace, for few unknowns."""

from __future__ import annotations

from typing import Any

from .layout import Style
from .piqp import PiqpSolver

__all__ = ["PiqpDenseSolver"]


class PiqpDenseSolver(PiqpSolver):
    """Solve by PIQP with dense matrices.

    Parameters
    ----------
    options : SolverOptions
        Cap and tolerances; there is no time limit.
    """

    style = Style("dense", infinite=False)

    def _made(self) -> Any:
        return self._package.DenseSolver()
