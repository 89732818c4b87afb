"""CasADi with fatrop, an interior-point method that uses the structure of stages."""

from __future__ import annotations

from typing import Any

from problems import Problem

from .casadi_program import CasadiProgram

__all__ = ["CasadiFatrop"]


class CasadiFatrop(CasadiProgram):
    """Fatrop with the stages found by itself, which needs w as controls."""

    plugin, label = "fatrop", "fatrop"
    limitations = "fatrop: default options; it needs w as variables."

    def __init__(self, compiled: bool = False, start: str = "shifted") -> None:
        super().__init__("shooting", compiled, start)

    def options(self, problem: Problem) -> dict[str, Any]:
        """Quiet, with all rows told to be equations of the dynamics."""
        return {
            "print_time": False,
            "fatrop.print_level": 0,
            "structure_detection": "auto",
            "equality": [True] * (problem.n * problem.horizon),
        }
