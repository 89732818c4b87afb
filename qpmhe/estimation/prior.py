"""The weight of a window's prior, from the observer's covariance."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import InvalidInputError, PriorWarning
from ..model.system import System
from ..observers import Observer
from .limits import KNOWN, NO_VARIANCE

Array = NDArray[np.float64]


def check_prior(observer: Observer, cost: Cost, *, warns: bool) -> None:
    """Check that an observer can weigh the prior; warn of a constant weight where it could.

    Without QPs there is nothing to warn of: the estimates do not depend on the weight.
    """
    name, has = type(observer).__name__, observer.initial_covariance() is not None
    if cost.observer_prior is not None and not has:
        raise InvalidInputError(
            f"the prior's weight comes from the observer's covariance, but {name} has none; give "
            "the cost prior=, the covariance (n, n) of this observer's error for from_covariances "
            "and else its inverse, or take a Kalman-type observer, such as qpmhe.ExtendedKalman."
        )
    if cost.observer_prior is None and has and warns:
        warnings.warn(
            f"the cost's prior is a constant weight beside {name}, which has a covariance: every "
            "window counts the data before it only as much as that weight says. Leave prior out, "
            "and the weight follows the covariance. If the constant weight is meant, ignore "
            "qpmhe.PriorWarning.",
            PriorWarning,
            stacklevel=4,
        )


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
