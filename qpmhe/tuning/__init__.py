"""Weights from data."""

from .answer import HorizonScore, Tuning
from .data import TuningRecord
from .search import TuningCheckpointError
from .tune import tune
from .weights import Weights, WeightsError, load

__all__ = [
    "HorizonScore", "Tuning", "TuningCheckpointError", "TuningRecord", "Weights", "WeightsError",
    "load", "tune",
]
