"""CasADi with Ipopt, converged: the paper's own tool."""

from __future__ import annotations

from typing import Any

from problems import Problem

from .casadi_program import CasadiProgram

__all__ = ["CasadiIpopt"]


class CasadiIpopt(CasadiProgram):
    """Ipopt with exact Hessians and MUMPS, to its default tolerance 1e-8."""

    plugin, label = "ipopt", "Ipopt"
    limitations = "Ipopt: default options (MUMPS, tol 1e-8), exact Hessians."

    def options(self, problem: Problem) -> dict[str, Any]:
        """Quiet; all else as it comes."""
        return {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
