"""P_t: the true cost and the true constraints of a state trajectory (eq:optiMHE)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_of

from .costs import ObserverPrior, QuadraticCost
from .sets import Box
from .system import System
from .window import Window

__all__ = ["Problem", "Trial"]

Array = NDArray[np.float64]

# The paper's sets are closed and a trial lies on their boundary up to rounding.
_FEASIBLE = 1e-9


@dataclass(slots=True)
class Trial:
    """A trajectory with its verdict.

    Parameters
    ----------
    trajectory : (K + 1, n) array
        The states.
    residuals : (K, n + p) array
        w and v along them.
    weighted : (K, n + p) array
        The residuals times their weights.
    cost : float
        J; infinite where the model cannot be evaluated or a constraint is violated.
    """

    trajectory: Array
    residuals: Array
    weighted: Array
    cost: float


class Problem:
    r"""The estimation problem of one window, in its state trajectory.

    The disturbance enters additively in full dimension, so every trajectory
    :math:`x_0, \dots, x_K` satisfies the dynamics with :math:`w_i = x_{i+1} - f(x_i, u_i)`,
    and the paper's (eq:optiMHE), (eq:constraints) become

    .. math::
        \min_x\; |x_0 - \bar x|_P^2 + \sum_{i<K} |(w_i, v_i)|_{W_i}^2
        \quad \text{s.t.} \quad x_i \in \mathbb X,\ w_i \in \mathbb W,\ v_i \in \mathbb V.

    Parameters
    ----------
    system : System
        f, h and the sets.
    cost : QuadraticCost
        The weights.
    """

    def __init__(self, system: System, cost: QuadraticCost) -> None:
        self._system, self._cost = system, cost
        self._n = system.n
        self._prior_rule = cost.prior if isinstance(cost.prior, ObserverPrior) else None
        self.prior_weight: Array = (
            np.eye(system.n) if isinstance(cost.prior, ObserverPrior) else cost.prior
        )
        self.prior_band: Array = band_of(self.prior_weight)
        self.prior: Array = np.zeros(system.n)
        self.inputs: Array = np.zeros((0, system.m))
        self.measurements: Array = np.zeros((0, system.p))
        self.stage_weights: Array = cost.stage_weight
        self._sets = [s for s in (system.states, system.disturbances, system.noises) if s]
        self.states: Box | None = None
        self.disturbances: Box | None = None
        self.noises: Box | None = None

    def bind(self, window: Window) -> bool:
        """Take over the window's data; prior z(t-N) as in (eq:prior).

        Returns
        -------
        dropped : bool
            Whether the candidate is outside of sets, which are left out in this problem:
            the paper's remedy after Assumption ass:observer.
        """
        self.prior = window.candidate[0]
        self.inputs, self.measurements = window.inputs, window.measurements
        self.stage_weights = window.stage_weights
        covariance = window.prior_covariance
        if self._prior_rule is not None and covariance is not None:
            self.prior_weight = self._prior_rule.weight(covariance)
            self.prior_band = band_of(self.prior_weight)
        return bool(self._sets) and self._drop_violated(window)

    def _drop_violated(self, window: Window) -> bool:
        n, system, residuals = self._n, self._system, window.residuals
        self.states = _kept(system.states, window.candidate)
        self.disturbances = _kept(system.disturbances, residuals[:, :n])
        self.noises = _kept(system.noises, residuals[:, n:])
        kept = (self.states, self.disturbances, self.noises)
        return kept != (system.states, system.disturbances, system.noises)

    def evaluate(self, trajectory: Array) -> Trial:
        """Judge a trajectory (K + 1, n) by the true model.

        Never raises on account of the model: where f or h raise or are not finite, or a
        constraint is violated, the cost is infinite.
        """
        n, states = self._n, trajectory[:-1]
        residuals = np.empty((states.shape[0], n + self._system.p))
        try:
            np.subtract(trajectory[1:], self._system.f.batch(states, self.inputs),
                        out=residuals[:, :n])
            np.subtract(self.measurements, self._system.h.batch(states, self.inputs),
                        out=residuals[:, n:])
        except Exception:  # a model function outside its domain: such a trial is worthless
            return Trial(trajectory, residuals, residuals, math.inf)
        weighted = self._weigh(residuals)
        offset = trajectory[0] - self.prior
        cost = float(np.vdot(weighted, residuals) + offset @ self.prior_weight @ offset)
        if not math.isfinite(cost) or (self._sets and not self.feasible(trajectory, residuals)):
            cost = math.inf
        return Trial(trajectory, residuals, weighted, cost)

    def _weigh(self, residuals: Array) -> Array:
        weight = self.stage_weights
        if weight.ndim == 2:
            return residuals @ weight
        value: Array = np.matmul(residuals[:, None, :], weight)[:, 0]
        return value

    def candidate(self, window: Window) -> Trial:
        """The candidate of the bound window as a trial: its cost is known already."""
        residuals = window.residuals
        return Trial(window.candidate, residuals, residuals, window.candidate_cost)

    def feasible(self, trajectory: Array, residuals: Array) -> bool:
        """Whether states, disturbances and noises lie in their sets (those not dropped)."""
        return self.violation(trajectory, residuals) <= _FEASIBLE

    def violation(self, trajectory: Array, residuals: Array) -> float:
        """The largest distance by which a component leaves its set."""
        n, worst = self._n, 0.0
        if self.states is not None:
            worst = self.states.violation(trajectory)
        if self.disturbances is not None:
            worst = max(worst, self.disturbances.violation(residuals[:, :n]))
        if self.noises is not None:
            worst = max(worst, self.noises.violation(residuals[:, n:]))
        return worst


def _kept(box: Box | None, points: Array) -> Box | None:
    return box if box is not None and box.violation(points) <= _FEASIBLE else None
