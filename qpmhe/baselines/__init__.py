"""Filters of the field to compare with: extended and unscented Kalman, ensemble, particles."""

from .base import Baseline, Problem, follow
from .ensembles import BootstrapParticleFilter, EnsembleKalmanFilter
from .filters import ExtendedKalmanFilter, UnscentedKalmanFilter

__all__ = [
    "Baseline", "BootstrapParticleFilter", "EnsembleKalmanFilter", "ExtendedKalmanFilter",
    "Problem", "UnscentedKalmanFilter", "follow",
]
