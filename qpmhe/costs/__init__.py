"""Costs: what the prior, the disturbances and the noises weigh."""

from .base import Cost, CostConstants, LossForm, ObserverPrior
from .lifted import LiftedCost, lifted
from .losses import Huber, Loss, Power, Quadratic
from .quadratic import QuadraticCost
from .robust import RobustCost
from .subspace import Subspace

__all__ = [
    "Cost", "CostConstants", "Huber", "LiftedCost", "Loss", "LossForm", "ObserverPrior", "Power",
    "Quadratic", "QuadraticCost", "RobustCost", "Subspace", "lifted",
]
