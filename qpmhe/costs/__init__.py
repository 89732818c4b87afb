"""Costs: what the prior, the disturbances and the noises weigh."""

from .base import Cost, CostConstants, ObserverPrior
from .losses import Huber, Loss, Power, Quadratic
from .quadratic import QuadraticCost
from .robust import RobustCost

__all__ = [
    "Cost", "CostConstants", "Huber", "Loss", "ObserverPrior", "Power", "Quadratic",
    "QuadraticCost", "RobustCost",
]
