"""The nonlinear problem P_t: cost and constraints of a state trajectory (eq:optiMHE)."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..model.functions import raised_along
from ..model.residuals import difference
from ..model.system import System
from ..observers import Observer
from ..terms.base import Trial
from ..terms.forms import WholeForm
from ..terms.prior import PriorCost
from ..terms.sum import CostSum
from .conditions import Conditions
from .constraints import Constraints
from .estimate import DroppedRow
from .limits import FEASIBLE
from .window import Window

Array = NDArray[np.float64]

# Rounding of a residual, as a share of the numbers that it is computed from.
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)


class Formulation:
    """The common data of all problems of an estimator."""

    def __init__(
        self, system: System, observer: Observer, cost: Cost, form: WholeForm | None = None
    ) -> None:
        self.system, self.cost = system, cost
        #: How matrices are held.
        self.form: WholeForm = form or WholeForm(system.n, system.p)
        #: The usual weight of (w, v).
        self.usual_weight: Array = self.form.usual_weight(cost)
        self.wraps = not (system.output_residual is None and system.state_residual is None)
        prior = PriorCost(system, observer, cost, self.form)
        self.functions = system.constraints
        self.constraints = Constraints(system, cost, prior)
        self.constrained = bool(self.constraints)
        #: J.
        self.sum = CostSum(
            system, cost, prior, lambda: self.constraints.basis, self.form
        )

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
    terms : tuple of Term
        J, as a sum.
    prior, hold : Term
        Two of them, see `CostSum`.
    stage_weights : array
        Weights of the stages' cost, before discount and majorisation; one, or one for each stage.
    inputs, measurements : array
        u (K, m) and y (K, p).
    observed : (K, p) bool array or None
        Which components of y are not missing; None if none is missing.
    model : System
        The model that takes these inputs, whose last column may be the length of the step.
    span : Span
        The candidate's linearised stages.
    surrogate : Cost or None
        The cost that the QPs minimise while the first window fills, if it is another.
    time : int
        Time of the first state.
    wraps : bool
        Whether the system has residual functions.
    """

    # Class attributes as defaults: few of them change in most steps.
    surrogate: Cost | None = None
    observed: NDArray[np.bool_] | None = None
    rolled_out: Trial | None = None
    _counting: NDArray[np.bool_] | None = None
    _clip: tuple[Array, Array] | None = None
    _has_noise_free: bool = False

    def __init__(self, formulation: Formulation, window: Window) -> None:
        self._formulation, view, cost = formulation, window.view, formulation.cost
        if cost.graduation > 1.0 and window.time < window.horizon:
            self.surrogate = cost.graduated(window.time / window.horizon)
        self.wraps = formulation.wraps
        self.measurements, self.span = view.measurements, view.span
        self.time = window.time - window.length
        self.inputs, self.model = view.inputs, formulation.system
        weights = formulation.usual_weight
        # `unusual` only saves time: it stays set for too long, and loading a snapshot sets it.
        if window.unusual:
            if window.has_special_weights:
                weights, self.observed = window.weights, window.observed
            if window.has_irregular_steps:
                self.inputs, self.model = window.inputs, window.model
        self.stage_weights = weights
        self.prior, self.hold, self.terms = formulation.sum.of_window(window, view, weights)
        self.candidate = candidate = Trial(view.candidate, view.residuals, weights, 0.0)
        if formulation.functions is not None:
            if self.observed is not None:
                self._counting = formulation.functions.counting(window.length, self.observed)
            self._set_values(candidate)
        for term in self.terms:
            candidate.cost += term.cost_of_candidate(candidate)
        self.constraints, self.constrained = formulation.constraints, formulation.constrained
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
            n = candidate.trajectory.shape[1]
            self._candidate_residuals = candidate.residuals.copy()
            self._candidate_residuals[:, :n] @= directions.candidate_projection.T
            if math.isfinite(candidate.cost) and not directions.has(candidate.residuals[:, :n]):
                self.rolled_out = self.evaluate(candidate.trajectory, of_candidate=True)
                candidate.cost = self.rolled_out.cost
        points = self._points(candidate, self._candidate_residuals)
        candidate.violation = self.constraints.violation(*points)

    def _constrain(self, constraints: Constraints) -> None:
        self.constraints = constraints
        self._has_noise_free = bool(constraints.noise_free.size) or (
            constraints.directions is not None
        )
        self._clip = None
        states = constraints.states
        if states is not None and states.bounds:
            shape = (*states.lower.shape[:-1], self.candidate.trajectory.shape[1])
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

    def _set_values(self, trial: Trial) -> None:
        """Evaluate the nonlinear constraints."""
        functions = self._formulation.functions
        assert functions is not None
        trial.values = functions.values(trial.trajectory, self.inputs, trial.residuals)
        if self._counting is not None:
            trial.values[~self._counting] = 0.0

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
        try:
            if self._has_noise_free and roll_out:
                trajectory = self._rolled_out(trajectory, of_candidate)
            residuals = self.model.evaluation.residuals(
                trajectory, self.measurements, self.inputs
            )
            if self.wraps:
                self.wrap(residuals, trajectory)
            trial, cost = Trial(trajectory, residuals, self.stage_weights, 0.0), 0.0
            if self._formulation.functions is not None:
                self._set_values(trial)
            for term in self.terms:
                cost += term.cost(trial)
            trial.cost = cost
        except Exception as error:  # a model function outside its domain, or a user's loss
            residuals = np.full_like(self.candidate.residuals, np.nan)
            return Trial(trajectory, residuals, self.stage_weights, math.inf, math.inf, error)
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
        other.terms = tuple(term.with_cost(cost) for term in self.terms)
        # The terms that the window holds are those of the true cost: this is another trajectory.
        other.candidate = replace(self.candidate, trajectory=self.candidate.trajectory.copy())
        return other

    def judged(self, trial: Trial) -> Trial:
        """A trial of the problem with another cost, by the cost of this one.

        One without a finite cost stays so, with the weights of this cost: a QP around it has them.
        """
        found = replace(trial, cost=0.0)
        try:
            for term in self.terms:
                found.cost += term.cost(found)
        except Exception as error:  # a user's loss
            return replace(trial, cost=math.inf, error=error)
        if not (math.isfinite(trial.cost) and 0.0 <= found.cost < math.inf):
            found.cost = math.inf
        return found

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

        Components j with W_j = {c} become f_j(x_i) + c; for directions see `NoiseFreeDirections`.
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

    def wrap(self, residuals: Array, trajectory: Array) -> None:
        """Turn the plain differences of a trajectory into residuals, in place."""
        self.model.wrap(residuals, trajectory[1:], self.measurements)

    def rounding_cost(self, trial: Trial) -> float:
        """The part of a trial's J that rounding of its residuals can explain."""
        sizes = np.abs(np.concatenate((trial.trajectory[1:], self.measurements), axis=1))
        sizes = sizes * _ROUNDING
        weighted = self._formulation.form.times(sizes, np.abs(trial.weights))
        return float(np.vdot(sizes, weighted))


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
