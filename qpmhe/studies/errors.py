"""Errors of studies."""

from __future__ import annotations

from ..errors import OptionError, QpmheError

__all__ = ["StoreError", "StudyError"]


class StudyError(OptionError):
    """A study that cannot run as it is written, or not on the cluster that it names."""


class StoreError(QpmheError):
    """A store that cannot be read or written; what it holds stays as it is."""
