"""What can go wrong with a study that is not the input of one function."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from ..errors import InvalidInputError, OptionError, QpmheError

__all__ = ["SchedulerError", "StoreError", "StudyError", "need"]


class StudyError(OptionError):
    """A study that cannot be run as it is written."""


class StoreError(QpmheError):
    """A store that cannot be read or written; what it holds stays as it is."""


class SchedulerError(QpmheError):
    """A cluster that cannot be reached, or no longer; what is stored stays stored."""


def need(module: str, purpose: str, extra: str = "studies") -> ModuleType:
    """Import an optional package, at the time it is needed.

    Parameters
    ----------
    module : str
        What is imported.
    purpose : str
        Who asks, as the beginning of the error text.
    extra : str
        Name of the extra that brings it.

    Raises
    ------
    InvalidInputError
        If it is not installed; the text has the command that installs it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise InvalidInputError(
            f"{purpose} needs {package}, which is not installed; pip install 'qpmhe[{extra}]'."
        ) from error
