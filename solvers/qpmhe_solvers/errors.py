"""The root of every exception that this project raises deliberately."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Any, TypeVar

T = TypeVar("T")



class QpmheError(Exception):
    """Base class of all exceptions of this project."""


class InvalidInputError(QpmheError, ValueError):
    """An invalid argument; the message gives its value, what was expected, and the remedy."""


class ShapeError(InvalidInputError):
    """An array of the wrong shape."""


class OptionError(InvalidInputError):
    """An option outside its range, or one that does not exist."""


class UnknownOptionError(OptionError, TypeError):
    """An unknown keyword; also a TypeError, as Python would raise."""


class BackendError(InvalidInputError):
    """A QP backend that is unknown, not installed or misdescribed, or fails to make a solver."""


def report_unknown_options(cls: type[T]) -> type[T]:
    """Make a class report its known keywords if one is unknown."""
    plain = cls.__init__
    known = [name for name in inspect.signature(plain).parameters if name != "self"]

    @functools.wraps(plain)
    def init(self: T, *args: Any, **options: Any) -> None:
        check_options(cls.__name__, options, known)
        plain(self, *args, **options)

    type.__setattr__(cls, "__init__", init)
    return cls


def check_options(owner: str, options: Iterable[str], known: Sequence[str]) -> None:
    """Refuse options that the owner does not have."""
    for name in options:
        if name not in known:
            near = get_close_matches(name, known, 1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise UnknownOptionError(
                f"{owner} has no option {name!r}; expected one of {', '.join(known)}.{hint}"
            )
