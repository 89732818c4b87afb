"""The nonlinear problem P_t: cost and constraints of a state trajectory (eq:optiMHE)."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_of

from .._linalg import inverse
from ..costs import Cost
from ..model.functions import contained, raised_along
from ..model.residuals import difference
from ..model.system import System
from ..observers import Observer
from ..terms.hold import Hold, WindowHold
from ..terms.prior import PriorWeights
from ..terms.soft import Penalties, WindowPenalties
from .conditions import Conditions
from .constraints import Constraints
from .estimate import DroppedRow
from .limits import FEASIBLE
from .stages import read_only
from .window import Window

Array = NDArray[np.float64]

# Rounding of a residual, as a share of the numbers that it is computed from.
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)


@dataclass(slots=True)
class Trial:
    """A state trajectory, evaluated.

    Attributes
    ----------
    trajectory, residuals : array
        States (K + 1, n), and joint residuals (w, v) of the stages (K, n + p).
    weights : (n + p, n + p) or (K, n + p, n + p) array
        Weights of the quadratic form that majorises the stages' cost here, discount included.
    cost : float
        J, or infinity if a constraint is violated or the model fails. The candidate's is its
        true J in any case.
    violation : float
        The largest violation of a row in its scale (see `Rows`), infinity if the model fails.
    error : Exception or None
        What the model or the cost raised.
    values : (K + 1, T) array or None
        Values of the nonlinear constraints, if there are any; see `ConstraintFunctions.values`.
    penalty : float
        The part of the cost that soft sets and soft constraints add.
    """

    trajectory: Array
    residuals: Array
    weights: Array
    cost: float
    violation: float = 0.0
    error: Exception | None = None
    values: Array | None = None
    penalty: float = 0.0


class Formulation:
    """The common data of all problems of an estimator."""

    def __init__(self, system: System, observer: Observer, cost: Cost) -> None:
        self.system, self.cost, self.quadratic = system, cost, cost.quadratic
        self.evaluate_costs, self.majorise = contained(cost.stage_costs), contained(cost.majorise)
        self.prior_cost = contained(cost.prior_cost)
        self.observer_prior = cost.observer_prior
        self.discounted = cost.discount < 1.0
        self.wraps = not (system.output_residual is None and system.state_residual is None)
        covariance = observer.initial_covariance()
        #: The weights of the initial error, for the observer's covariance.
        self.prior_weights = PriorWeights(system, observer, cost)
        #: Weight of the initial error of the first window.
        self.prior_weight: Array
        self.prior_weight, regular = self.prior_weights(covariance)
        self.prior_band = band_of(self.prior_weight)
        covariance = inverse(regular)
        self.functions = system.constraints
        self.constraints = Constraints(system, cost, covariance)
        #: What holds parameters that a window does not see; None where none is held.
        self.hold: Hold | None = None
        if system.held:
            self.hold = Hold(system.held, covariance, self.constraints.basis, cost.disturbance)
        self.constrained = bool(self.constraints)
        penalties = Penalties(system, cost, covariance)
        #: The soft sets and soft constraints; None without any.
        self.penalties: Penalties | None = penalties if penalties else None
        #: Whether trials have values of nonlinear constraints, or penalties.
        self.extended = self.functions is not None or self.penalties is not None

    def with_cost(self, cost: Cost) -> Formulation:
        """The formulation with another cost of the stages."""
        other = copy(self)
        other.evaluate_costs = contained(cost.stage_costs)
        other.majorise = contained(cost.majorise)
        return other

    def problem(self, window: Window) -> Problem:
        """The problem of the present window."""
        return Problem(self, window)


class Problem:
    r"""The estimation problem of one window, in its state trajectory; immutable.

    The disturbance enters additively in full dimension, so every trajectory
    :math:`x_0, \dots, x_K` satisfies the dynamics with :math:`w_i = x_{i+1} - f(x_i, u_i)`,
    and the paper's (eq:optiMHE), (eq:constraints) become

    .. math::
        \min_x\; \gamma^K \Gamma(x_0 - \bar x) + \sum_{i<K} \gamma^{K-1-i} l(w_i, v_i)
        \quad \text{s.t.} \quad x_i \in \mathbb X,\ w_i \in \mathbb W,\ v_i \in \mathbb V.

    Parameters
    ----------
    formulation : Formulation
        The common data of the problems of all windows.
    window : Window
        The data, with the prior z(t-N) of (eq:prior).

    Attributes
    ----------
    candidate : Trial
        The observer's trajectory (eq:warmstart), with its true J even if it is infeasible.
    rolled_out : Trial or None
        The trajectory that defines its J, if a correction is outside the range of the disturbances.
    constraints : Constraints
        The rows that a trial must satisfy.
    prior, inputs, measurements : array
        z(t-N) or, with ``arrival="smoothed"``, another prior mean (n,), u (K, m) and y (K, p).
    prior_moved : bool
        Whether the prior is other than the candidate's first state.
    observed : (K, p) bool array or None
        Which components of y are not missing; None if none is missing.
    prior_weight : (n, n) array
        Weight of the initial error, before discount and majorisation.
    distance_weight : (n, n) array
        Weight of a distance from the observer, regular where a state was known exactly.
    discounts : (K + 1,) array or None
        Factors of the prior's cost and of the stages'; None without a discount.
    stage_weights : array
        Weights of the stages' cost, before discount and majorisation; one, or one for each stage.
    usual_disturbances : bool
        Whether all stages are known to weigh their disturbances as usual.
    model : System
        The model that takes these inputs, whose last column may be the length of the step.
    span : Span
        The candidate's linearised stages.
    penalties : WindowPenalties or None
        The rows of soft sets and soft constraints, with their penalties.
    surrogate : Cost or None
        The cost that the QPs minimise while the first window fills, if it is another.
    time : int
        Time of the first state.
    wraps : bool
        Whether the system has residual functions.
    hold : WindowHold or None
        The part of J that holds parameters which the window does not see.
    """

    __slots__ = (
        "_candidate_residuals", "_clip", "_counting", "_formulation", "_has_noise_free",
        "_prior_band", "candidate", "constrained", "constraints", "discounts", "distance_weight",
        "hold", "inputs", "measurements", "model", "observed", "penalties", "prior", "prior_moved",
        "prior_weight", "rolled_out", "span", "stage_weights", "surrogate", "time",
        "usual_disturbances", "wraps",
    )

    _clip: tuple[Array, Array] | None

    def __init__(self, formulation: Formulation, window: Window) -> None:
        self._formulation, view, cost = formulation, window.view, formulation.cost
        self.surrogate: Cost | None = None
        if cost.graduation > 1.0 and window.time < window.horizon:
            self.surrogate = cost.graduated(window.time / window.horizon)
        self.wraps = formulation.wraps
        self.prior, self.measurements, self.span = view.prior, view.measurements, view.span
        self.time = window.time - window.length
        self.observed: NDArray[np.bool_] | None = None
        self.inputs, self.model = view.inputs, formulation.system
        self.stage_weights = cost.stage_weight
        # `unusual` only saves time: it stays set for too long, and loading a snapshot sets it.
        if window.unusual:
            if window.has_special_weights:
                self.stage_weights, self.observed = window.weights, window.observed
            if window.has_irregular_steps:
                self.inputs, self.model = window.inputs, window.model
        self.discounts = window.discounts if formulation.discounted else None
        self.usual_disturbances = not (window.has_disturbance_weights or formulation.discounted)
        self.prior_weight, self._prior_band = formulation.prior_weight, formulation.prior_band
        self.distance_weight = self.prior_weight
        if formulation.observer_prior is not None and window.prior_covariance is not None:
            self.prior_weight, self.distance_weight = formulation.prior_weights(
                window.prior_covariance
            )
            self._prior_band = band_of(self.prior_weight)
        weights = self.stage_weights if formulation.quadratic else window.majorising_weights
        if self.discounts is not None:
            weights = weights * self.discounts[1:, None, None]
        self.candidate = Trial(
            view.candidate, view.residuals, weights, window.candidate_cost_of(view)
        )
        self.hold: WindowHold | None = None
        if formulation.hold is not None and window.trusted is not None and window.has_terms:
            n = formulation.system.n
            noise = self.stage_weights[..., n:, n:]
            self.hold = formulation.hold.of_window(
                view.span.minus_jacobian, noise, window.trusted[0]
            )
            self.candidate.cost += self._hold_cost(view.candidate)
            self._prior_band = band_of(self.prior_weight + self.hold.whole)
        self.prior_moved = False
        if window.smoothed_prior is not None:
            self._move_prior(window.smoothed_prior)
        self.constraints, self.constrained = formulation.constraints, formulation.constrained
        self._has_noise_free, self._clip = False, None
        self.rolled_out: Trial | None = None
        self._counting: NDArray[np.bool_] | None = None
        if formulation.functions is not None and self.observed is not None:
            self._counting = formulation.functions.counting(window.length, self.observed)
        self.penalties: WindowPenalties | None = None
        if formulation.penalties is not None:
            self.penalties = formulation.penalties.of_window(
                window.length, self.observed, self.discounts,
                window.conditions if window.has_own_bounds else None,
            )
        if formulation.extended:
            self._add_penalty(self.candidate)
        if self.constrained:
            constraints = formulation.constraints
            if window.has_own_bounds:
                constraints = constraints.at(window.conditions)
            if self.observed is not None:
                constraints = constraints.observed(self.observed, self._counting)
            self._constrain(constraints)
            self._judge_candidate()

    def _judge_candidate(self) -> None:
        """Set the candidate's violation and, where its noise-free part has no cost, its J.

        Corrections outside of the range of the disturbances have no weight: J(candidate) is then J
        of its roll-out, which takes the part of each correction that is in the range.
        """
        candidate, directions = self.candidate, self.constraints.directions
        self._candidate_residuals = candidate.residuals
        if directions is not None:
            n = self.prior.size
            self._candidate_residuals = candidate.residuals.copy()
            self._candidate_residuals[:, :n] @= directions.candidate_projection.T
            if math.isfinite(candidate.cost) and not directions.has(candidate.residuals[:, :n]):
                self.rolled_out = self.evaluate(candidate.trajectory, of_candidate=True)
                candidate.cost = self.rolled_out.cost
        points = self._points(candidate, self._candidate_residuals)
        candidate.violation = self.constraints.violation(*points)

    def _move_prior(self, prior: Array) -> None:
        """Take another prior mean, unless the candidate has no finite prior cost there."""
        try:
            offset = difference(self.model.state_residual, self.candidate.trajectory[0], prior)
            cost = self._formulation.prior_cost(offset, self.prior_weight)
            self.prior_weight_at(offset)
        except Exception:  # a user's loss or residual
            return
        if math.isfinite(cost):
            self.prior, self.prior_moved = prior, True
            factor = 1.0 if self.discounts is None else float(self.discounts[0])
            self.candidate.cost += factor * cost

    def _constrain(self, constraints: Constraints) -> None:
        self.constraints = constraints
        self._has_noise_free = bool(constraints.noise_free.size) or (
            constraints.directions is not None
        )
        self._clip = None
        states = constraints.states
        if states is not None and states.bounds:
            shape = (*states.lower.shape[:-1], self.prior.size)
            lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
            lower[..., states.components] = states.lower[..., : states.bounds]
            upper[..., states.components] = states.upper[..., : states.bounds]
            self._clip = lower, upper

    def without_violated(self) -> Problem:
        """The problem without the rows that the candidate violates; noise-free ones stay."""
        other, points = copy(self), self._points(self.candidate, self._candidate_residuals)
        other._constrain(self.constraints.without_violated(*points))
        violation = other.constraints.violation(*points)
        other.candidate = replace(self.candidate, violation=violation)
        return other

    def _add_penalty(self, trial: Trial) -> None:
        """Evaluate the nonlinear constraints, and add the penalty of what is soft to the cost."""
        functions, penalties = self._formulation.functions, self._formulation.penalties
        if functions is not None:
            trial.values = functions.values(trial.trajectory, self.inputs, trial.residuals)
            if self._counting is not None:
                trial.values[~self._counting] = 0.0
        if penalties is not None and self.penalties is not None:
            values = penalties.values(trial.trajectory, trial.residuals, trial.values)
            trial.penalty = self.penalties.cost(self.penalties.misses(values))
            trial.cost += trial.penalty

    def missed_rows(self, trial: Trial) -> tuple[DroppedRow, ...]:
        """The rows of this problem that a trial violates."""
        return self.constraints.missed_rows(*self._points(trial), self.time)

    def _points(
        self, trial: Trial, residuals: Array | None = None
    ) -> tuple[Array, Array, Array, Array | None]:
        """What `Constraints` are functions of, with a trial's residuals or these."""
        if residuals is None:
            residuals = trial.residuals
        return trial.trajectory, residuals, self.measurements, trial.values

    def clipped(self, trajectory: Array) -> Array:
        """Clip each state to its bounds, in place; return the trajectory."""
        if self.model.turns is not None:
            trajectory = self.model.turns(trajectory)
        if self._clip is not None:
            np.clip(trajectory, *self._clip, out=trajectory)
        return trajectory

    def evaluate(
        self, trajectory: Array, of_candidate: bool = False, roll_out: bool = True
    ) -> Trial:
        """Evaluate a trajectory (K + 1, n); never raises, whatever the model does.

        The candidate's is rolled out along the directions of the cost alone, and no set judges it.
        Without ``roll_out`` the trajectory is evaluated as it is.
        """
        formulation, prior_weight = self._formulation, self.prior_weight
        try:
            if self._has_noise_free and roll_out:
                trajectory = self._rolled_out(trajectory, of_candidate)
            residuals = self._residuals(trajectory)
            offset = trajectory[0] - self.prior
            if self.wraps:
                self.wrap(residuals, trajectory)
                offset = self.offset(trajectory)
            weights, cost = self._weights_and_cost(residuals)
            if formulation.quadratic:
                prior_cost = float(offset.dot(prior_weight).dot(offset))
            else:
                prior_cost = formulation.prior_cost(offset, prior_weight)
            cost += prior_cost if self.discounts is None else float(self.discounts[0]) * prior_cost
            if self.hold is not None:
                cost += self._hold_cost(trajectory)
        except Exception as error:  # a model function outside its domain, or a user's loss
            residuals = np.full_like(self.candidate.residuals, np.nan)
            return Trial(trajectory, residuals, self.stage_weights, math.inf, math.inf, error)
        trial = Trial(trajectory, residuals, weights, cost)
        if self._formulation.extended:
            self._add_penalty(trial)
            cost = trial.cost
        if not 0.0 <= cost < math.inf:  # below 0 with a weight that is indefinite
            trial.cost = trial.violation = math.inf
        elif self.constrained and not of_candidate:
            trial.violation = self.constraints.violation(*self._points(trial))
            if trial.violation > FEASIBLE:
                trial.cost = math.inf
        return trial

    def with_cost(self, cost: Cost) -> Problem:
        """The problem with a surrogate of the cost; the candidate keeps its true one."""
        other = copy(self)
        other._formulation = self._formulation.with_cost(cost)
        # The terms that the window holds are those of the true cost: this is another trajectory.
        other.candidate = replace(self.candidate, trajectory=self.candidate.trajectory.copy())
        return other

    def judged(self, trial: Trial) -> Trial:
        """A trial of the problem with another cost, by the cost of this one.

        One without a finite cost stays so, with the weights of this cost: a QP around it has them.
        """
        try:
            weights, cost = self._weights_and_cost(trial.residuals)
            prior = self._formulation.prior_cost(self.offset(trial.trajectory), self.prior_weight)
        except Exception as error:  # a user's loss
            return replace(trial, cost=math.inf, error=error)
        cost += prior if self.discounts is None else float(self.discounts[0]) * prior
        if self.hold is not None:
            cost += self._hold_cost(trial.trajectory)
        cost += trial.penalty
        if not (math.isfinite(trial.cost) and 0.0 <= cost < math.inf):
            cost = math.inf
        return replace(trial, weights=weights, cost=cost)

    def failure(self, trial: Trial) -> str:
        """What the model or the cost raised at a trial, as a message; blank if nothing."""
        if trial.error is None:
            return "" if trial.values is None else self.constraint_failure(trial)
        functions = {"f": self.model.f, "h": self.model.h}
        return raised_along(trial.error, functions, trial.trajectory[:-1], self.inputs)

    def constraint_failure(self, trial: Trial) -> str:
        """What a nonlinear constraint raised at a trial, as a message; blank if nothing."""
        functions = self._formulation.functions
        if functions is None or trial.values is None or np.isfinite(trial.values).all():
            return ""
        return functions.failure(trial.trajectory, self.inputs, trial.residuals)

    def _rolled_out(self, trajectory: Array, of_candidate: bool) -> Array:
        """Follow the model where there is no disturbance, stage by stage.

        Components j with W_j = {c} become f_j(x_i) + c; for directions see `Directions`.
        """
        constraints, rolled_out = self.constraints, trajectory.copy()
        free, shift, directions = constraints.noise_free, constraints.constant, None
        if constraints.directions is not None:
            directions, shift = constraints.directions.roll_out(of_candidate)
        for i in range(trajectory.shape[0] - 1):
            predicted = np.asarray(self.model.f(rolled_out[i], self.inputs[i]))
            if directions is None:
                rolled_out[i + 1, free] = predicted[free] + shift
            else:
                ahead = difference(self.model.state_residual, rolled_out[i + 1], predicted)
                rolled_out[i + 1] = predicted + directions.dot(ahead) + shift
        return rolled_out if self.model.turns is None else self.model.turns(rolled_out)

    def offset(self, trajectory: Array) -> Array:
        """The initial error x_0 [-] prior of a trajectory."""
        return difference(self.model.state_residual, trajectory[0], self.prior)

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
        if residuals.shape != self.candidate.residuals.shape or residuals.dtype != np.float64:
            raise TypeError("f or h returned other than real numbers of the right shape")
        return residuals

    def wrap(self, residuals: Array, trajectory: Array) -> None:
        """Turn the plain differences of a trajectory into residuals, in place."""
        self.model.wrap(residuals, trajectory[1:], self.measurements)

    def _weights_and_cost(self, residuals: Array) -> tuple[Array, float]:
        """The weights of `Trial`, and the stages' cost."""
        weights, formulation = self.stage_weights, self._formulation
        if formulation.quadratic:
            if self.discounts is not None:
                weights = weights * self.discounts[1:, None, None]
            if weights.ndim == 2:
                weighted = residuals.dot(weights)
            else:
                weighted = np.matmul(residuals[:, None, :], weights)[:, 0]
            return weights, float(weighted.ravel().dot(residuals.ravel()))
        residuals, weights = read_only(residuals), read_only(weights)
        costs = formulation.evaluate_costs(residuals, weights)
        weights = formulation.majorise(residuals, weights)
        if self.discounts is not None:
            weights = weights * self.discounts[1:, None, None]
            costs = costs * self.discounts[1:]
        return weights, float(costs.sum())

    def rounding_cost(self, trial: Trial) -> float:
        """The part of a trial's J that rounding of its residuals can explain."""
        sizes = np.abs(np.concatenate((trial.trajectory[1:], self.measurements), axis=1))
        sizes = sizes * _ROUNDING
        weights = np.broadcast_to(np.abs(trial.weights), (len(sizes), *trial.weights.shape[-2:]))
        return float(np.einsum("ki,kij,kj->", sizes, weights, sizes))

    def _hold_cost(self, trajectory: Array) -> float:
        """What the hold adds to J."""
        assert self.hold is not None
        cost = self.hold.cost(trajectory[0])
        return cost if self.discounts is None else float(self.discounts[0]) * cost

    def hold_force(self, trajectory: Array) -> Array:
        """Half the derivative (n,) of it by the first state; zeros where nothing is held."""
        if self.hold is None:
            return np.zeros_like(self.prior)
        force = self.hold.force(trajectory[0])
        return force if self.discounts is None else self.discounts[0] * force

    def first_weight_at(self, offset: Array) -> Array:
        """Weight (n, n) of the first state: the prior's of `prior_weight_at`, and the hold's."""
        weight = self.prior_weight_at(offset)
        if self.hold is None:
            return weight
        held = self.hold.whole
        return weight + (held if self.discounts is None else self.discounts[0] * held)

    def prior_weight_at(self, offset: Array) -> Array:
        """Weight (n, n) of the form that majorises the prior's cost where x_0 - prior = offset."""
        weight, formulation = self.prior_weight, self._formulation
        if not formulation.quadratic:
            weight = formulation.cost.majorise_prior(offset, weight)
        return weight if self.discounts is None else self.discounts[0] * weight

    def first_band_at(self, offset: Array) -> Array:
        """`first_weight_at` as a band panel."""
        if self._formulation.quadratic and self.discounts is None:
            return self._prior_band
        return band_of(self.first_weight_at(offset))


class Solved(NamedTuple):
    """The last step's problem and its conditions.

    Attributes
    ----------
    problem : Problem
        The problem of the window, with all of its rows.
    formulation : Formulation
        The formulation of the problem.
    trajectory : (K + 1, n) array
        The estimate.
    conditions : list of Conditions
        The conditions of each sample.
    """

    problem: Problem
    formulation: Formulation
    trajectory: Array
    conditions: list[Conditions]
