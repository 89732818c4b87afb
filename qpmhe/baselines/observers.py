"""Observers for a problem, by the names that studies know."""

from __future__ import annotations

from typing import Any

from ..observers import ExtendedKalman, UnscentedKalman
from .base import Problem


def extended_kalman(problem: Problem, **options: Any) -> ExtendedKalman:
    """An extended Kalman filter with the problem's covariances."""
    return ExtendedKalman(**problem.covariances, **options)


def unscented_kalman(problem: Problem, **options: Any) -> UnscentedKalman:
    """An unscented Kalman filter with the problem's covariances."""
    return UnscentedKalman(**problem.covariances, **options)
