"""Suboptimal moving horizon estimation by sequences of convex QPs, with a stability promise."""

from . import errors, models, solvers
from .costs import CostConstants, ObserverPrior, QuadraticCost
from .errors import QpmheError
from .estimate import Estimate, Status
from .estimator import MovingHorizonEstimator
from .observers import ExtendedKalman, Luenberger, Observer, OutputInjection
from .run import Run
from .sets import Box
from .system import System

__version__ = "0.1.0"

__all__ = [
    "Box",
    "CostConstants",
    "Estimate",
    "ExtendedKalman",
    "Luenberger",
    "MovingHorizonEstimator",
    "Observer",
    "ObserverPrior",
    "OutputInjection",
    "QpmheError",
    "QuadraticCost",
    "Run",
    "Status",
    "System",
    "__version__",
    "errors",
    "models",
    "solvers",
]
