"""Costs of the prior, the disturbances and the noises."""

from .base import Cost, CostConstants, LossForm, ObserverPrior
from .lifted import LiftedCost, lifted
from .losses import Barron, Cauchy, GemanMcClure, Huber, Loss, Power, Quadratic
from .quadratic import QuadraticCost
from .robust import RobustCost
from .subspace import Subspace

__all__ = [
    "Barron", "Cauchy", "Cost", "CostConstants", "GemanMcClure", "Huber", "LiftedCost", "Loss",
    "LossForm", "ObserverPrior", "Power", "Quadratic", "QuadraticCost", "RobustCost", "Subspace",
    "lifted",
]
