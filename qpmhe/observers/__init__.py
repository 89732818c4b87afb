"""Auxiliary observers: stable, perhaps poor, and the source of every guarantee."""

from .base import Observer, Sample
from .extended_kalman import ExtendedKalman
from .injection import OutputInjection
from .luenberger import Luenberger

__all__ = ["ExtendedKalman", "Luenberger", "Observer", "OutputInjection", "Sample"]
