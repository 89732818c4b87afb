"""The nonlinear problem P_t: cost and constraints of a state trajectory (eq:optiMHE)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_of

from ..costs import Cost, ObserverPrior
from ..model.functions import contained, raised_along
from ..model.sets import ConvexSet
from ..model.system import System
from .limits import FEASIBLE
from .stages import read_only
from .window import Window

if TYPE_CHECKING:
    from .stages import WindowView

__all__ = ["Problem", "Trial"]

Array = NDArray[np.float64]

# The disturbance is a difference of states, whose rounding comes on top of FEASIBLE.
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)


@dataclass(slots=True)
class Trial:
    """A state trajectory, evaluated.

    Attributes
    ----------
    trajectory, residuals : array
        States (K + 1, n), and joint residuals (w, v) of the stages (K, n + p).
    weights : (n + p, n + p) or (K, n + p, n + p) array
        Of the quadratic form that majorises the stages' cost here, discount included.
    cost : float
        J, or infinity if a constraint is violated or the model fails.
    violation : float
        The largest violation of a constraint, 0 for the candidate, infinity if the model fails.
    error : Exception or None
        What the model or the cost raised.
    """

    trajectory: Array
    residuals: Array
    weights: Array
    cost: float
    violation: float = 0.0
    error: Exception | None = None


class Problem:
    r"""The estimation problem of one window, in its state trajectory.

    The disturbance enters additively in full dimension, so every trajectory
    :math:`x_0, \dots, x_K` satisfies the dynamics with :math:`w_i = x_{i+1} - f(x_i, u_i)`,
    and the paper's (eq:optiMHE), (eq:constraints) become

    .. math::
        \min_x\; \gamma^K \Gamma(x_0 - \bar x) + \sum_{i<K} \gamma^{K-1-i} l(w_i, v_i)
        \quad \text{s.t.} \quad x_i \in \mathbb X,\ w_i \in \mathbb W,\ v_i \in \mathbb V.
    """

    def __init__(self, system: System, cost: Cost) -> None:
        self._system, self._cost, self._quadratic = system, cost, cost.quadratic
        self._n, self._q = system.n, system.n + system.p
        self._evaluate_costs, self._majorise = contained(cost.stage_costs), contained(cost.majorise)
        self._prior_cost = contained(cost.prior_cost)
        self._observer_prior = cost.observer_prior
        #: Weight of the initial error, before discount and majorisation.
        self.prior_weight: Array = (
            np.eye(system.n) if isinstance(cost.prior, ObserverPrior) else cost.prior
        )
        self._prior_band = band_of(self.prior_weight)
        self._discounted = cost.discount < 1.0
        self._candidate: Trial | None = None
        self.view: WindowView  # of the bound window
        self.model = system
        self.prior: Array = np.zeros(system.n)
        self.inputs: Array = np.zeros((0, system.m))
        self.measurements: Array = np.zeros((0, system.p))
        self.stage_weights: Array = cost.stage_weight
        #: Which components of y are not missing (K, p); None if none is missing.
        self.observed: NDArray[np.bool_] | None = None
        self.discounts: Array | None = None
        self.constrained = any((system.states, system.disturbances, system.noises))
        fixed = system.disturbances.fixed_components if system.disturbances else np.empty(0, int)
        #: Components whose disturbance is a constant, so that their states follow the model.
        self.noise_free: NDArray[np.intp] = fixed
        self.use_sets(system.states, system.disturbances, system.noises)

    def bind(self, window: Window) -> None:
        """Take the window's data, with the prior z(t-N) of (eq:prior), and use all sets."""
        self._candidate = None
        self.view = view = window.view
        self.prior, self.measurements = view.prior, view.measurements
        # `unusual` stays set for longer, and a snapshot sets it: no result may depend on it.
        unusual = window.unusual and (window.has_special_weights or window.has_irregular_steps)
        if unusual:
            self.inputs, self.model = window.inputs, window.model
            self.stage_weights = window.stage_weights
            self.observed = window.observed if window.has_special_weights else None
        else:
            self.inputs, self.model = view.inputs, self._system
            self.stage_weights, self.observed = self._cost.stage_weight, None
        if self._discounted:
            self.discounts = window.discounts
        if self._observer_prior is not None and window.prior_covariance is not None:
            self.prior_weight = self._observer_prior.weight(window.prior_covariance)
            self._prior_band = band_of(self.prior_weight)
        if self.constrained:
            system = self._system
            self.use_sets(system.states, system.disturbances, system.noises)

    def candidate(self, window: Window) -> Trial:
        """The candidate of the bound window as a trial, whose cost the window knows."""
        if self._candidate is None:
            weights = self.stage_weights if self._quadratic else window.majorising_weights
            if self.discounts is not None:
                weights = weights * self.discounts[1:, None, None]
            view = self.view
            self._candidate = Trial(
                view.candidate, view.residuals, weights, window.candidate_cost_of(view)
            )
        return self._candidate

    def evaluate(self, trajectory: Array) -> Trial:
        """Evaluate a trajectory (K + 1, n); never raises, whatever the model does."""
        try:
            if self._has_noise_free:
                trajectory = self._rolled_out(trajectory)
            residuals = self._residuals(trajectory)
            weights, cost = self._weights_and_cost(residuals)
            offset = trajectory[0] - self.prior
            if self._quadratic:
                prior_cost = float(offset.dot(self.prior_weight).dot(offset))
            else:
                prior_cost = self._prior_cost(offset, self.prior_weight)
            cost += prior_cost if self.discounts is None else float(self.discounts[0]) * prior_cost
        except Exception as error:  # a model function outside its domain, or a user's loss
            residuals = np.full((trajectory.shape[0] - 1, self._q), np.nan)
            return Trial(trajectory, residuals, self.stage_weights, math.inf, math.inf, error)
        if not math.isfinite(cost):
            return Trial(trajectory, residuals, weights, math.inf, math.inf)
        if not self.constrained:
            return Trial(trajectory, residuals, weights, cost)
        violation = self.violation(trajectory, residuals)
        if violation > FEASIBLE:
            cost = math.inf
        return Trial(trajectory, residuals, weights, cost, violation)

    def failure(self, trial: Trial) -> str:
        """What the model or the cost raised at a trial, as a message; blank if nothing."""
        if trial.error is None:
            return ""
        functions = {"f": self.model.f, "h": self.model.h}
        return raised_along(trial.error, functions, trial.trajectory[:-1], self.inputs)

    def _rolled_out(self, trajectory: Array) -> Array:
        """Set each noise-free component j, with W_j = {c}, to f_j(x_i) + c, stage by stage."""
        free, system = self.noise_free, self.model
        assert self.disturbances is not None
        shift = self.disturbances.lower[free]
        rolled_out = trajectory.copy()
        for i in range(trajectory.shape[0] - 1):
            predicted = np.asarray(system.f(rolled_out[i], self.inputs[i]))
            rolled_out[i + 1, free] = predicted[free] + shift
        return rolled_out

    def _residuals(self, trajectory: Array) -> Array:
        """Residuals w and v of each stage; raises what the model raises."""
        model = self.model
        if model.kernel is not None:
            return model.kernel.residuals(trajectory, self.measurements, self.inputs)
        states = trajectory[:-1]
        # Concatenating contiguous differences is faster than writing into columns.
        disturbances = trajectory[1:] - model.f.batch(states, self.inputs)
        noises = self.measurements - model.h.batch(states, self.inputs)
        residuals: Array = np.concatenate((disturbances, noises), axis=1)
        if residuals.shape[1] != self._q or residuals.dtype != np.float64:
            raise TypeError("f or h returned other than real numbers of the right shape")
        return residuals

    def _weights_and_cost(self, residuals: Array) -> tuple[Array, float]:
        """The weights of `Trial`, and the stages' cost."""
        weights = self.stage_weights
        if self._quadratic:
            if self.discounts is not None:
                weights = weights * self.discounts[1:, None, None]
            if weights.ndim == 2:
                weighted = residuals.dot(weights)
            else:
                weighted = np.matmul(residuals[:, None, :], weights)[:, 0]
            return weights, float(weighted.ravel().dot(residuals.ravel()))
        residuals, weights = read_only(residuals), read_only(weights)
        costs = self._evaluate_costs(residuals, weights)
        weights = self._majorise(residuals, weights)
        if self.discounts is not None:
            weights = weights * self.discounts[1:, None, None]
            costs = costs * self.discounts[1:]
        return weights, float(costs.sum())

    def violation(self, trajectory: Array, residuals: Array) -> float:
        """The largest violation of the sets in use."""
        n, worst = self._n, 0.0
        if self.states is not None:
            worst = self.states.violation(trajectory)
        if self.disturbances is not None:
            rounding = _ROUNDING * np.abs(trajectory[1:]).max(axis=1, keepdims=True)
            worst = max(worst, self.disturbances.violation(residuals[:, :n], rounding=rounding))
        if self.noises is not None:
            worst = max(worst, self.noises.violation(residuals[:, n:], self.observed))
        return worst

    def violated_sets(self, trial: Trial) -> tuple[str, ...]:
        """Names of the sets that a trial leaves."""
        n = self._n
        violations = {
            "states": self.states and self.states.violation(trial.trajectory),
            "disturbances": self.disturbances
            and self.disturbances.violation(trial.residuals[:, :n]),
            "noises": self.noises
            and self.noises.violation(trial.residuals[:, n:], self.observed),
        }
        return tuple(name for name, size in violations.items() if size and size > FEASIBLE)

    def leave_out(self, names: tuple[str, ...]) -> None:
        """Leave out the sets of these names."""
        self.use_sets(
            None if "states" in names else self.states,
            None if "disturbances" in names else self.disturbances,
            None if "noises" in names else self.noises,
        )

    def use_sets(
        self,
        states: ConvexSet | None,
        disturbances: ConvexSet | None,
        noises: ConvexSet | None,
    ) -> None:
        """Use these sets as constraints; None leaves one out."""
        self.states, self.disturbances, self.noises = states, disturbances, noises
        self._has_noise_free = bool(self.noise_free.size) and disturbances is not None

    def prior_weight_at(self, offset: Array) -> Array:
        """Weight (n, n) of the form that majorises the prior's cost at x_0 - prior = offset."""
        weight = self.prior_weight
        if not self._cost.quadratic:
            weight = self._cost.majorise_prior(offset, weight)
        return weight if self.discounts is None else self.discounts[0] * weight

    def prior_band_at(self, offset: Array) -> Array:
        """The same weight as a band panel."""
        if self._quadratic and self.discounts is None:
            return self._prior_band
        return band_of(self.prior_weight_at(offset))
