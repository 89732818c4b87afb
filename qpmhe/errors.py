"""Exceptions: those of the QP layer, and what else can be wrong with an estimation problem."""

from __future__ import annotations

from qpmhe_solvers.errors import (
    BackendError,
    InvalidInputError,
    OptionError,
    QpmheError,
    ShapeError,
    UnknownOptionError,
)

__all__ = [
    "BackendError",
    "CompilationError",
    "EngineWarning",
    "InvalidInputError",
    "ModelError",
    "ObserverWarning",
    "OptionError",
    "QpmheError",
    "SetError",
    "ShapeError",
    "UnknownOptionError",
    "WeightError",
]


class ModelError(InvalidInputError):
    """A model that cannot be loaded, or a function of it with a wrong value or an error."""


class WeightError(InvalidInputError):
    """A weight or covariance that is not symmetric positive definite."""


class SetError(InvalidInputError):
    """A set that is empty, inverted or of the wrong dimension."""


class CompilationError(QpmheError):
    """C code that could not be compiled or loaded here."""


class ObserverWarning(UserWarning):
    """An observer that the estimates cannot rely on, or that had to be moved into its set."""


class EngineWarning(UserWarning):
    """A slower means than the one asked for is in use; the results are the same."""
