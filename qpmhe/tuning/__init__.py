"""Weights from data."""

from .answer import HorizonScore, Tuning
from .data import TuningRecord
from .innovations import Innovations
from .judge import ObserverScore
from .search import TuningCheckpointError
from .tune import tune
from .weights import Weights, WeightsError, load

__all__ = [
    "HorizonScore", "Innovations", "ObserverScore", "Tuning", "TuningCheckpointError",
    "TuningRecord", "Weights", "WeightsError", "load", "tune",
]
