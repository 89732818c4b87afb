"""Weights from data, and diagnostics that need no truth."""

from .diagnosis import Diagnosis, diagnose
from .findings import Finding
from .observability import Observability, observability

__all__ = ["Diagnosis", "Finding", "Observability", "diagnose", "observability"]
