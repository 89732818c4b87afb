"""The root of every exception that this project raises on purpose."""

from __future__ import annotations

__all__ = ["BackendError", "InvalidInputError", "OptionError", "QpmheError", "ShapeError"]


class QpmheError(Exception):
    """Root of the tree: catch this to catch everything that is ours."""


class InvalidInputError(QpmheError, ValueError):
    """An argument that can never work; the text names value, expectation and remedy."""


class ShapeError(InvalidInputError):
    """An array of the wrong shape."""


class OptionError(InvalidInputError):
    """An option outside its range, or one that does not exist."""


class BackendError(InvalidInputError):
    """A QP backend that is not known here, or whose package is not installed."""
