"""Suboptimal moving horizon estimation by sequences of convex QPs, with a stability promise."""

from . import batch, codegen, errors, models, solvers
from .batch import BatchEstimator
from .costs import (
    Cost,
    CostConstants,
    Huber,
    Loss,
    ObserverPrior,
    Power,
    Quadratic,
    QuadraticCost,
    RobustCost,
)
from .errors import QpmheError
from .estimate import Estimate, Status
from .estimator import MovingHorizonEstimator
from .observers import (
    ExtendedKalman,
    HighGain,
    Luenberger,
    Observer,
    OutputInjection,
    Sample,
    SteadyStateKalman,
    UnscentedKalman,
    design_luenberger,
)
from .parameters import augment_parameters
from .run import Run
from .sets import Box, ConvexSet, Polytope
from .system import System

__version__ = "0.1.0"

__all__ = [
    "BatchEstimator",
    "Box",
    "ConvexSet",
    "Cost",
    "CostConstants",
    "Estimate",
    "ExtendedKalman",
    "HighGain",
    "Huber",
    "Loss",
    "Luenberger",
    "MovingHorizonEstimator",
    "Observer",
    "ObserverPrior",
    "OutputInjection",
    "Polytope",
    "Power",
    "QpmheError",
    "Quadratic",
    "QuadraticCost",
    "RobustCost",
    "Run",
    "Sample",
    "Status",
    "SteadyStateKalman",
    "System",
    "UnscentedKalman",
    "__version__",
    "augment_parameters",
    "batch",
    "codegen",
    "design_luenberger",
    "errors",
    "models",
    "solvers",
]
