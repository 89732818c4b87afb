"""qpmhe itself: plain NumPy model, CasADi model, compiled engine."""

from __future__ import annotations

from typing import Any

from problems import Problem

import qpmhe

from .base import Array, Peer, WindowData

__all__ = ["Qpmhe"]

_WORDS = {"numpy": "NumPy", "casadi": "CasADi", "compiled": "compiled"}


class Qpmhe(Peer):
    """Our estimator.

    Parameters
    ----------
    variant : {"numpy", "casadi", "compiled"}
        How the model is written, and the engine.
    max_qps : int or None
        QPs per sample; None converges.
    start : {"candidate", "best"}
        ``best`` starts at the shifted previous estimate where its J is lower.
    """

    package = "qpmhe"
    kind = "qpmhe"
    recursive = True

    def __init__(self, variant: str, max_qps: int | None, start: str = "candidate") -> None:
        self.variant, self.max_qps, self.start = variant, max_qps, start
        self.converges = max_qps is None
        amount = {None: "converged", 0: "observer alone", 1: "1 QP"}.get(
            max_qps, f"{max_qps} QPs"
        )
        self.name = f"qpmhe {_WORDS[variant]}, {amount}"
        if start == "best":
            self.name += ", start best"

    def setup(self, problem: Problem) -> None:
        """Build the estimator."""
        system = problem.system
        options: dict[str, Any] = {"engine": "python"}
        if self.variant != "numpy":
            system = problem.casadi_system()
        if self.variant == "compiled":
            options["engine"] = "compiled"
        self._mhe = qpmhe.MovingHorizonEstimator(
            system, problem.observer, problem.cost, horizon=problem.horizon,
            initial_state=problem.scenario.initial_estimate, max_qps=self.max_qps,
            warm_start=self.start == "best", **options,
        )

    def restart(self) -> None:
        """Begin a record."""
        self._mhe.reset()

    def update(self, window: WindowData) -> Array:
        """One update, by the newest measurement alone."""
        return self._mhe.update(window.newest).trajectory
