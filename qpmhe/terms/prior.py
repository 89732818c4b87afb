"""The prior's term of J, and its weight from the observer's covariance."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_of

from .._linalg import inverse
from ..costs import Cost
from ..model.functions import contained
from ..model.residuals import difference
from ..model.system import System
from ..observers import Observer
from .base import FirstStateDerivative, FirstStateTerm, Trial, WindowData, WindowView

Array = NDArray[np.float64]

#: A variance of the observer's below the first share of the typical one is none; in the prior's
#: weight it counts as the second share.
NO_VARIANCE, KNOWN = 1e-30, 1e-16


class PriorWeights:
    """The rule by which the observer's covariance gives the prior's weight.

    Attributes
    ----------
    typical : (n,) array or None
        Typical variances of the states, where an observer's may be zero; None where it cannot.
    added, least : (n, n) array
        What `ObserverPrior` adds to each covariance, and to its inverse; zero for a constant
        weight.
    """

    def __init__(self, system: System, observer: Observer, cost: Cost) -> None:
        self._cost, covariance = cost, observer.initial_covariance()
        self.typical: Array | None = None
        if covariance is not None and (cost.space is not None or not covariance.diagonal().all()):
            scales = system.scales
            self.typical = cost.prior_variances(covariance) if scales is None else scales * scales
        rule = cost.observer_prior
        self.added: Array = np.zeros((system.n, system.n))
        self.least = self.added
        self._varies = rule is not None and covariance is not None
        if rule is not None and covariance is not None and covariance.shape == self.added.shape:
            _, first = self._regular(covariance)
            self.added = 2.0 / rule.kappa * first
            self.least = cost.initial_weight(first) / rule.kappa

    def __call__(self, covariance: Array | None) -> tuple[Array, Array]:
        """The prior's weight for an observer's covariance, and one to judge its distance by.

        A state that is known exactly has a large weight in the first, and the weight of its typical
        magnitude in the second.
        """
        cost = self._cost
        if covariance is None or not self._varies:
            weight = cost.initial_weight(covariance)
            return weight, weight
        nearly, regular = self._regular(covariance + self.added)
        weight = cost.initial_weight(nearly) + self.least
        if regular is nearly:
            return weight, weight
        return weight, cost.initial_weight(regular) + self.least

    def _regular(self, covariance: Array) -> tuple[Array, Array]:
        """The covariance with a small and with a typical variance of states known exactly."""
        typical = self.typical
        if typical is not None:
            known = covariance.diagonal() <= NO_VARIANCE * typical
            if known.any():
                one, other = (
                    covariance + np.diag(np.where(known, each, 0.0))
                    for each in (KNOWN * typical, typical)
                )
                return one, other
        return covariance, covariance


class PriorCost:
    """The prior of all windows: its rule, and the cost of an offset.

    Parameters
    ----------
    system, observer, cost
        Those of the estimator.
    """

    def __init__(self, system: System, observer: Observer, cost: Cost) -> None:
        self.cost, self.residual = cost, system.state_residual
        self.quadratic, self.discounted = cost.quadratic, cost.discount < 1.0
        #: Whether the weight of a window is that of its quadratic form along all trajectories.
        self.is_constant = self.quadratic and not self.discounted
        #: Whether the observer's covariance gives the weight.
        self.follows = cost.observer_prior is not None
        self.evaluate = contained(cost.prior_cost)
        #: The weights of the initial error, for the observer's covariance.
        self.weights = PriorWeights(system, observer, cost)
        covariance = observer.initial_covariance()
        #: Weight of the initial error of the first window, and one to judge its distance by.
        self.first: Array
        self.first, regular = self.weights(covariance)
        self.first_band = band_of(self.first)
        #: Covariance of the initial error, regular.
        self.covariance = inverse(regular)

    def of_window(self, window: WindowData, view: WindowView) -> Prior:
        """The prior of a window."""
        prior = Prior(self, view)
        if self.follows and (covariance := window.prior_covariance) is not None:
            prior.set_weights(*self.weights(covariance))
        if self.discounted:
            prior.factor = float(window.discounts[0])
        if window.smoothed_prior is not None:
            prior.move(window.smoothed_prior)
        return prior


class Prior(FirstStateTerm):
    r"""The prior's cost :math:`\gamma^K \Gamma(x_0 - \bar x)` of one window.

    Attributes
    ----------
    mean : (n,) array
        z(t-N) or, with ``arrival="smoothed"``, another one.
    factor : float
        gamma^K.
    weight : (n, n) array
        Weight of the initial error, before discount and majorisation.
    distance_weight : (n, n) array
        Weight of a distance from the observer, regular where a state was known exactly.
    """

    # Class attributes as defaults: few of them change in most steps.
    factor: float = 1.0
    _moved_cost: float = 0.0  # of the candidate, where the mean is another

    def __init__(self, rule: PriorCost, view: WindowView) -> None:
        self._rule, self.mean = rule, view.prior
        # The trajectory that is known to start at the mean, if there is one.
        self._zero: Array | None = view.candidate
        self.weight = self.distance_weight = rule.first
        if rule.is_constant:
            self.band = rule.first_band

    def set_weights(self, weight: Array, distance_weight: Array) -> None:
        """Set other weights."""
        self.weight, self.distance_weight = weight, distance_weight
        if self._rule.is_constant:
            self.band = band_of(weight)

    def move(self, mean: Array) -> None:
        """Take another mean, unless the candidate has no finite cost there."""
        rule = self._rule
        try:
            offset = difference(rule.residual, self.mean, mean)  # the candidate's
            cost = rule.evaluate(offset, self.weight)
            self._majorised(offset)
        except Exception:  # a user's loss or residual
            return
        if math.isfinite(cost):
            self.mean, self._zero, self._moved_cost = mean, None, self.factor * cost

    def offset(self, trial: Trial) -> Array:
        """The initial error x_0 [-] mean of a trajectory."""
        residual, first = self._rule.residual, trial.trajectory[0]
        if residual is not None:
            return difference(residual, first, self.mean)
        offset: Array = first - self.mean
        return offset

    def _majorised(self, offset: Array) -> Array:
        """The weight, discounted and majorised at an offset."""
        weight, cost = self.weight, self._rule.cost
        if not cost.quadratic:
            weight = cost.majorise_prior(offset, weight)
        return weight if self.factor == 1.0 else self.factor * weight

    def cost(self, trial: Trial) -> float:
        """Gamma of the initial error; see `Term.cost`."""
        rule = self._rule
        offset = trial.trajectory[0] - self.mean if rule.residual is None else self.offset(trial)
        if rule.quadratic:
            return self.factor * float(offset.dot(self.weight).dot(offset))
        return float(self.factor * rule.evaluate(offset, self.weight))

    def cost_of_candidate(self, candidate: Trial) -> float:
        """0 exactly, where the mean is the candidate's first state."""
        return self._moved_cost

    def weight_of_first(self, trial: Trial) -> Array:
        """See `FirstStateTerm.weight_of_first`."""
        return self._majorised(self.offset(trial))

    def force(self, trial: Trial) -> Array | None:
        """See `FirstStateTerm.force`; None for a candidate that starts at the mean."""
        if trial.trajectory is self._zero:
            return None
        offset = self.offset(trial)
        force: Array = self._majorised(offset).dot(offset)
        return force

    def magnitude(self, trial: Trial) -> float:
        """See `Term.magnitude`."""
        offset = abs(self.offset(trial))
        return float(offset @ abs(self.weight) @ offset)

    def derivative(self, trial: Trial) -> PriorDerivative:
        """See `Term.derivative`."""
        cost = self._rule.cost
        return PriorDerivative(
            cost, self.offset(trial), self.weight, self.factor,
            self.weight_of_first(trial), len(trial.residuals) / cost.discount,
        )


class PriorDerivative(FirstStateDerivative):
    """The derivatives of a prior, also by its mean and its weight."""

    data = ("prior", "prior_weight")

    def __init__(
        self, cost: Cost, offset: Array, weight: Array, factor: float, majorised: Array, age: float
    ) -> None:
        majorised = 2.0 * majorised
        bent = factor * cost.prior_hessian(offset, weight)
        super().__init__(majorised @ offset, bent, majorised, age)
        self._cost, self._offset, self._weight, self._factor = cost, offset, weight, factor

    def _by_weight(self, directions: Array) -> Array:
        return self._cost.prior_weight_gradient(self._offset, directions, self._weight)

    def by(self, name: str, states: Array, residuals: Array) -> Array:
        """See `TermDerivative.by`."""
        if name == "prior":
            return np.asarray(-(states[..., 0, :] @ self.bent))
        return self._factor * self._by_weight(states[..., 0, :])

    def change(self, data: Mapping[str, Array], states: Array, residuals: Array) -> None:
        """See `TermDerivative.change`."""
        states[..., 0, :] -= data["prior"] @ self.bent
        by_weight = self._by_weight(np.eye(self._offset.size))
        states[..., 0, :] += self._factor * np.einsum(
            "iab,...ab->...i", by_weight, data["prior_weight"]
        )
