"""Measured records: estimates from a table of samples, file to file or line by line."""

from .checkpoints import CheckpointError, WriteError
from .session import Summary, estimate_record
from .tables import RecordError

__all__ = ["CheckpointError", "RecordError", "Summary", "WriteError", "estimate_record"]
