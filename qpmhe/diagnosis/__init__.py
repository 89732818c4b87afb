"""Which sensor, weight or part of the model a run contradicts; it needs no truth."""

from ..estimation.observability import Observability, observability
from .diagnose import Diagnosis, diagnose
from .findings import Finding

__all__ = ["Diagnosis", "Finding", "Observability", "diagnose", "observability"]
