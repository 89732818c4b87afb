"""Costs: what the prior, the disturbances and the noises weigh."""

from .prior import ObserverPrior
from .quadratic import CostConstants, QuadraticCost

__all__ = ["CostConstants", "ObserverPrior", "QuadraticCost"]
