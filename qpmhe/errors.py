"""Exceptions of the QP layer and of estimation problems."""

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
    "ModelWarning",
    "ObserverWarning",
    "OptionError",
    "PriorWarning",
    "QpmheError",
    "SetError",
    "ShapeError",
    "UnknownOptionError",
    "WeightError",
]


class ModelError(InvalidInputError):
    """A model that cannot be loaded, or whose functions fail or return wrong values."""


class WeightError(InvalidInputError):
    """A weight or covariance that is not symmetric positive definite."""


class SetError(InvalidInputError):
    """A set that is empty, inverted or of the wrong dimension."""


class CompilationError(QpmheError):
    """C code that cannot be compiled or loaded on this machine."""


class ObserverWarning(UserWarning):
    """An unreliable observer, or an initial state that was projected onto the state set."""


class PriorWarning(ObserverWarning):
    """A constant weight of the prior beside an observer that has a covariance."""


class ModelWarning(UserWarning):
    """A model that its step discretises too coarsely for the size of its disturbances."""


class EngineWarning(UserWarning):
    """A slower engine than the requested one is in use; the results are the same."""
