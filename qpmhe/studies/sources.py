"""The models of a study; `qpmhe.models.loading` does the work."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import ModelError
from ..models import Example, loading
from ..models.loading import ModelSource as Source
from .errors import StudyError

__all__ = ["Source", "find", "load"]


def find(text: Any, folder: Path | None = None) -> Source:
    """As `qpmhe.models.loading.find`, with a `StudyError`."""
    try:
        return loading.find(text, folder)
    except ModelError as error:
        raise StudyError(str(error)) from error


def load(source: Source) -> Example:
    """As `qpmhe.models.loading.load`, with a `StudyError`."""
    try:
        return loading.load(source)
    except ModelError as error:
        raise StudyError(str(error)) from error
