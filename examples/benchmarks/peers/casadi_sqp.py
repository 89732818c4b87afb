"""CasADi's sqpmethod with its QP solver qrqp, converged."""

from __future__ import annotations

from typing import Any

from problems import Problem

from .casadi_program import CasadiProgram

__all__ = ["CasadiSqp"]


class CasadiSqp(CasadiProgram):
    """Sequential quadratic programming with exact Hessians; it can be C as a whole."""

    plugin, label = "sqpmethod", "sqpmethod+qrqp"
    limitations = "sqpmethod: default options (tolerance 1e-6), exact Hessians."
    whole = True
    multipliers = True

    def options(self, problem: Problem) -> dict[str, Any]:
        """Quiet; all else as it comes."""
        quiet = dict.fromkeys(("print_header", "print_iteration", "print_status"), False)
        return {
            **quiet,
            "print_time": False,
            "qpsol": "qrqp",
            "qpsol_options": dict.fromkeys(("print_iter", "print_header", "print_info"), False),
        }
