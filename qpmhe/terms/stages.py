"""The stages' term of J."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..model.functions import contained
from .base import (
    Derivatives,
    QuadraticModel,
    Term,
    TermDerivative,
    Trial,
    WindowData,
    WindowView,
    read_only,
)
from .forms import WholeForm

Array = NDArray[np.float64]


class _EarlierBands(dict[int, Array]):
    """A band at all states of a window but the first and the last one, by its length."""

    def __init__(self, band: Array) -> None:
        self._band = band

    def __missing__(self, count: int) -> Array:
        found = self[count] = np.zeros((count, *self._band.shape))
        found[1:] = self._band
        return found


class StageCosts:
    """The stages of all windows: their cost, and the weight of a usual disturbance.

    Parameters
    ----------
    cost : Cost
        That of the estimator.
    form : WholeForm
        How matrices are held.
    """

    def __init__(self, cost: Cost, form: WholeForm) -> None:
        self.cost, self.quadratic, self.form = cost, cost.quadratic, form
        self.discounted = cost.discount < 1.0
        self.evaluate, self.majorise = contained(cost.stage_costs), contained(cost.majorise)
        #: The weight of a usual disturbance, as a band.
        self.band = form.band(cost.disturbance)
        #: What usual disturbances add to the bands of all states but the last one, by the length of
        #: the window.
        self.earlier_bands = _EarlierBands(self.band)

    def with_cost(self, cost: Cost) -> StageCosts:
        """The same with another cost."""
        other = copy(self)
        other.evaluate, other.majorise = contained(cost.stage_costs), contained(cost.majorise)
        return other


class Stages(Term):
    r"""The cost :math:`\sum_{i<K} \gamma^{K-1-i} l(w_i, v_i)` of the stages of one window.

    Attributes
    ----------
    weights : array
        Weights of the stages, before discount and majorisation; one, or one for each stage.
    """

    # Class attributes as defaults: most costs have no discount.
    _factors: Array | None = None

    def __init__(
        self, rule: StageCosts, window: WindowData, view: WindowView, weights: Array
    ) -> None:
        self._rule, self.weights = rule, weights
        self._candidate_cost = window.candidate_cost_of(view)
        # Whether all stages are known to weigh their disturbances as usual.
        self._usual = not window.has_disturbance_weights
        # Of the form that majorises the cost along the candidate, discount included.
        self._candidate_weights = weights if rule.quadratic else window.majorising_weights
        if rule.discounted:
            self._factors, self._usual = window.discounts[1:], False
            self._candidate_weights = self._with_factors(self._candidate_weights)

    def _with_factors(self, weights: Array) -> Array:
        factors = self._factors
        return weights if factors is None else weights * self._rule.form.per_stage(factors)

    def with_cost(self, cost: Cost) -> Stages:
        """See `Term.with_cost`."""
        other = copy(self)
        other._rule = self._rule.with_cost(cost)
        return other

    def cost(self, trial: Trial) -> float:
        """See `Term.cost`; sets the weights of the trial."""
        rule, residuals = self._rule, trial.residuals
        if rule.quadratic:
            trial.weights = weights = self._candidate_weights  # the same along all trajectories
            weighted = rule.form.times(residuals, weights)
            return float(weighted.ravel().dot(residuals.ravel()))
        residuals, weights = read_only(residuals), read_only(self.weights)
        costs = rule.evaluate(residuals, weights)
        trial.weights = self._with_factors(rule.majorise(residuals, weights))
        if self._factors is not None:
            costs = costs * self._factors
        return float(costs.sum())

    def cost_of_candidate(self, candidate: Trial) -> float:
        """See `Term.cost_of_candidate`: the stages were evaluated when they were taken."""
        candidate.weights = self._candidate_weights
        return self._candidate_cost

    def add_model(self, model: QuadraticModel, trial: Trial) -> None:
        """Set all of the model; see `Term.add_model`. The stages come first.

        Each stage adds its panel to that of its state, and the weight of its disturbance to the
        next.
        """
        span, weights, factors, form = model.span, trial.weights, None, self._rule.form
        if model.is_candidate:
            factors = self._factors
        if factors is not None:
            np.multiply(span.panel, form.per_stage(factors), model.earlier_band)
            np.multiply(span.gradient_first, factors[0], model.first_gradient)
            np.multiply(span.gradient_rest, factors[1:, None], model.inner_gradient)
            model.inner_gradient += span.next_gradient_rest * factors[:-1, None]
            np.multiply(span.next_gradient_last, factors[-1], model.last_gradient)
        else:
            model.first_gradient[...] = span.gradient_first
            np.add(span.gradient_rest, span.next_gradient_rest, model.inner_gradient)
            model.last_gradient[...] = span.next_gradient_last
        if self._usual or form.is_single(weights):
            last = self._rule.band
            np.add(span.panel, self._rule.earlier_bands[len(span.panel)], model.earlier_band)
        else:
            bands = form.disturbance_band(weights)
            if factors is None:
                model.earlier_band[...] = span.panel
            model.earlier_band[1:] += bands[:-1]
            last = bands[-1]
        model.last_band[...] = last

    def add_weights(self, diagonal: Array) -> None:
        """See `Term.add_weights`."""
        weights, n = self._rule.form.diagonal(self.weights), diagonal.shape[1]
        if self._factors is not None:
            weights = weights * self._factors[:, None]
        diagonal[1:] += weights[..., :n]

    def magnitude(self, trial: Trial) -> float:
        """See `Term.magnitude`."""
        residuals, weights = abs(trial.residuals), abs(self.weights)
        return float(np.vdot(residuals, self._rule.form.times(residuals, weights)))

    def derivative(self, trial: Trial) -> StagesDerivative:
        """See `Term.derivative`."""
        form = self._rule.form
        whole = form.whole(trial.weights), form.whole(self.weights).copy()
        return StagesDerivative(self._rule.cost, trial.residuals, *whole, self._factors)


class StagesDerivative(TermDerivative):
    """The derivatives of the stages, also by the weights (K, q, q) of each."""

    data = ("stage_weights",)

    def __init__(
        self, cost: Cost, residuals: Array, majorising: Array, weights: Array,
        factors: Array | None,
    ) -> None:
        self._cost, self._residuals, self._weights = cost, residuals, weights
        count = len(residuals)
        self._factors = np.ones(count) if factors is None else factors
        self.majorised = np.broadcast_to(2.0 * majorising, (count, *weights.shape[-2:]))
        self.force = np.einsum("kij,kj->ki", self.majorised, residuals)
        hessian = cost.stage_hessian(residuals, weights)
        self.bent = self._factors[:, None, None] * hessian
        # The newest stage has the age 0.
        self.ages = np.arange(count - 1, -1, -1.0) / cost.discount

    def add_to(self, sums: Derivatives) -> None:
        """See `TermDerivative.add_to`."""
        sums.on_residuals += self.force
        sums.bent_residuals += self.bent
        sums.majorised_residuals += self.majorised
        sums.aged_residuals += self.ages[:, None] * self.force

    def _by_weights(self, directions: Array) -> Array:
        found = self._cost.stage_weight_gradient(self._residuals, directions, self._weights)
        return self._factors[:, None, None] * found

    def by(self, name: str, states: Array, residuals: Array) -> Array:
        """See `TermDerivative.by`."""
        return self._by_weights(residuals)

    def change(self, data: Mapping[str, Array], states: Array, residuals: Array) -> None:
        """See `TermDerivative.change`."""
        count, q = self._residuals.shape
        each = np.broadcast_to(np.eye(q)[:, None], (q, count, q))
        residuals += np.einsum(
            "ikab,...kab->...ki", self._by_weights(each), data["stage_weights"]
        )
