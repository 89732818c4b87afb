"""Many independent estimators of one system at once."""

from .estimator import BatchEstimator
from .results import BatchEstimate, BatchRun

__all__ = ["BatchEstimate", "BatchEstimator", "BatchRun"]
