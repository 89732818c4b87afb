"""The weight of a window's prior, from the observer's covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..model.system import System
from ..observers import Observer
from .limits import KNOWN, NO_VARIANCE

Array = NDArray[np.float64]


class PriorWeights:
    """The rule by which the observer's covariance gives the prior's weight.

    Attributes
    ----------
    typical : (n,) array or None
        Typical variances of the states, where an observer's may be zero; None where it cannot.
    """

    def __init__(self, system: System, observer: Observer, cost: Cost) -> None:
        self._cost, covariance = cost, observer.initial_covariance()
        self.typical: Array | None = None
        if covariance is not None and (cost.space is not None or not covariance.diagonal().all()):
            scales = system.scales
            self.typical = cost.prior_variances(covariance) if scales is None else scales * scales

    def __call__(self, covariance: Array | None) -> tuple[Array, Array]:
        """The prior's weight for an observer's covariance, and one to judge its distance by.

        A state that is known exactly has a large weight in the first, and the weight of its typical
        magnitude in the second.
        """
        typical, cost = self.typical, self._cost
        if typical is not None and covariance is not None and cost.observer_prior is not None:
            known = covariance.diagonal() <= NO_VARIANCE * typical
            if known.any():
                nearly, regular = (
                    covariance + np.diag(np.where(known, one, 0.0))
                    for one in (KNOWN * typical, typical)
                )
                return cost.initial_weight(nearly), cost.initial_weight(regular)
        weight = cost.initial_weight(covariance)
        return weight, weight
