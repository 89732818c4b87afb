"""Weights from data, and diagnostics that need no truth."""

from ..estimation.observability import Observability, observability
from .answer import HorizonScore, Tuning
from .data import TuningRecord
from .diagnosis import Diagnosis, diagnose
from .findings import Finding
from .search import TuningCheckpointError
from .tune import tune
from .weights import Weights, WeightsError, load

__all__ = [
    "Diagnosis", "Finding", "HorizonScore", "Observability", "Tuning", "TuningCheckpointError",
    "TuningRecord", "Weights", "WeightsError", "diagnose", "load", "observability", "tune",
]
