"""qpmhe itself: plain NumPy model or CasADi model, Python step or compiled step."""

from __future__ import annotations

from typing import Any

import numpy as np
from problems import Problem

import qpmhe

from .base import Array, Peer, WindowData

__all__ = ["Qpmhe"]

_WORDS = {
    "numpy": "NumPy model", "casadi": "CasADi model", "compiled": "compiled",
    "numpy compiled": "NumPy model compiled", "extended": "compiled, EKF and its prior",
}


def _extended(cost: qpmhe.QuadraticCost) -> tuple[qpmhe.ExtendedKalman, qpmhe.QuadraticCost]:
    """An extended Kalman filter of the cost's covariances, and the cost with its covariance."""
    covariances = {
        name: np.linalg.inv(getattr(cost, name)) for name in ("prior", "disturbance", "noise")
    }
    weights = {"disturbance": cost.disturbance, "noise": cost.noise}
    return (
        qpmhe.ExtendedKalman(**covariances),
        qpmhe.QuadraticCost(**weights),
    )


class Qpmhe(Peer):
    """Our estimator.

    Parameters
    ----------
    variant : {"numpy", "casadi", "numpy compiled", "compiled", "extended"}
        How the model is written, and the engine. "extended" has an extended Kalman filter as
        observer, whose covariance weighs the prior: another problem.
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
        if variant == "extended":
            self.kind = "other"
        if start == "best":
            self.name += ", start best"

    def setup(self, problem: Problem) -> None:
        """Build the estimator."""
        system, self._inputs = problem.system, problem.m > 0
        options: dict[str, Any] = {"engine": "python"}
        if not self.variant.startswith("numpy"):
            system = problem.casadi_system()
        if self.variant not in ("numpy", "casadi"):
            options["engine"] = "compiled"
        observer, cost = problem.observer, problem.cost
        if self.variant == "extended":
            observer, cost = _extended(cost)
        self._mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=problem.horizon,
            initial_state=problem.scenario.initial_estimate, max_qps=self.max_qps,
            warm_start=self.start == "best", **options,
        )

    def restart(self) -> None:
        """Begin a record."""
        self._mhe.reset()

    def update(self, window: WindowData) -> Array:
        """One update, by the newest measurement and input alone."""
        u = window.newest_input if self._inputs else None
        return self._mhe.update(window.newest, u).trajectory
