"""Auxiliary observers: stable, perhaps inaccurate, and the source of every guarantee."""

from .base import Observer, Sample
from .design import design_luenberger
from .extended_kalman import ExtendedKalman
from .high_gain import HighGain
from .injection import OutputInjection
from .innovation import Gate, HuberInnovation, Innovation
from .luenberger import Luenberger
from .steady_kalman import SteadyStateKalman
from .unscented import UnscentedKalman

__all__ = [
    "ExtendedKalman", "Gate", "HighGain", "HuberInnovation", "Innovation", "Luenberger", "Observer",
    "OutputInjection", "Sample", "SteadyStateKalman", "UnscentedKalman", "design_luenberger",
]
