"""Measured records: read from files, and estimated file to file or line by line."""

from .checkpoints import CheckpointError, WriteError
from .frame import read
from .latency import Latency
from .readers import ReadingOptions
from .session import Summary, estimate_record
from .tables import RecordError

__all__ = [
    "CheckpointError", "Latency", "ReadingOptions", "RecordError", "Summary", "WriteError",
    "estimate_record", "read",
]
