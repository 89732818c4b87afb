"""The evidence for a certified number, and the errors where nothing can be certified."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from decimal import ROUND_CEILING, Context
from enum import Enum
from typing import Any

import numpy as np

from ..errors import InvalidInputError, QpmheError
from ..model.sets import ConvexSet


class Evidence(Enum):
    """The evidence for a constant, best first."""

    #: Holds on the whole stated set: shown in exact or outward-rounded arithmetic.
    PROVED = "proved"
    #: Held at every point that was tried; points in between may break it.
    SAMPLED = "sampled"
    #: Taken from the user, not examined.
    ASSUMED = "assumed"

    def __str__(self) -> str:
        return self.value


def weakest(evidence: Iterable[Evidence]) -> Evidence:
    """The evidence for a number computed from others: the weakest of theirs."""
    return max(evidence, key=list(Evidence).index, default=Evidence.PROVED)


class CertificateError(InvalidInputError):
    """A question that no certificate can answer, such as one about an unbounded set."""


class MismatchError(CertificateError):
    """Something certified for one system, gain, region or estimator, and used for another."""


class NotCertifiedError(QpmheError):
    """A property that could not be certified, and perhaps does not hold.

    Parameters
    ----------
    message : str
        What was asked, and what was found.
    suggestions : sequence of str
        What may help; the text of the error lists them.
    smallest_rate : float, optional
        The smallest rate that was found feasible, if the requested one was not.

    Attributes
    ----------
    finding : str
        The message without the suggestions.
    """

    def __init__(
        self, message: str, suggestions: tuple[str, ...] = (), smallest_rate: float | None = None
    ) -> None:
        self.suggestions = tuple(suggestions)
        self.smallest_rate = smallest_rate
        self.finding = message.rstrip(".")
        if self.suggestions:
            end = "" if message.endswith((".", "!", "?")) else "."
            message = f"{message}{end} What may help: {'; '.join(self.suggestions)}."
        super().__init__(message)


class OutOfTimeError(NotCertifiedError):
    """A search that was stopped before it found anything: nothing is known about the property."""


def at_most(value: float, digits: int) -> str:
    """An upper bound with so many digits: a shown bound holds as well as the stored one.

    A number that has no more digits, such as 0.9, is shown as it is.
    """
    short = Context(digits, ROUND_CEILING).create_decimal(repr(float(value)))
    return f"{float(short):.{digits}g}"


def json_ready(value: Any) -> Any:
    """Types that JSON knows: of dataclasses their fields, None for numbers that are not finite."""
    if hasattr(value, "to_dict"):
        value = value.to_dict()
    elif is_dataclass(value):
        value = {each.name: getattr(value, each.name) for each in fields(value)}
    elif isinstance(value, ConvexSet):
        value = [value.lower, value.upper]
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Evidence):
        return value.value
    if isinstance(value, Mapping):
        return {str(key): json_ready(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(each) for each in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
