"""The weight of a window's prior, from the observer's covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..model.system import System
from ..observers import Observer

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
