"""Measured records: estimates from a table of samples, file to file or line by line."""

from .errors import CheckpointError, RecordError, WriteError
from .run import Summary, estimate_record

__all__ = ["CheckpointError", "RecordError", "Summary", "WriteError", "estimate_record"]
