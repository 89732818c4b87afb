"""Derivatives of an estimate with respect to its data."""

from .active_rows import ActiveRow
from .sensitivity import Gradient, Sensitivity

__all__ = ["ActiveRow", "Gradient", "Sensitivity"]
