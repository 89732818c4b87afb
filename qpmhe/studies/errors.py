"""What can go wrong with a study that is not the input of one function."""

from __future__ import annotations

from .._checks import need
from ..errors import OptionError, QpmheError

__all__ = ["SchedulerError", "StoreError", "StudyError", "need"]


class StudyError(OptionError):
    """A study that cannot be run as it is written."""


class StoreError(QpmheError):
    """A store that cannot be read or written; what it holds stays as it is."""


class SchedulerError(QpmheError):
    """A cluster that cannot be reached, or no longer; what is stored stays stored."""
