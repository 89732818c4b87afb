"""Numbers and times as they stand in a record's fields."""

from __future__ import annotations

import math
from datetime import datetime

__all__ = ["MISSING", "Reader", "Time", "spacing"]

#: Words for a value that is missing, in lower case.
MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none"})

Time = float | datetime


def spacing(before: Time, after: Time) -> float:
    """Time from one stamp to a later one: a difference, or seconds between two dates.

    Parameters
    ----------
    before, after : float or datetime
        Of one kind.
    """
    if isinstance(before, datetime) and isinstance(after, datetime):
        return (after - before).total_seconds()
    assert not isinstance(before, datetime)
    assert not isinstance(after, datetime)
    return after - before


class Reader:
    """Fields to numbers, with one decimal mark in the whole record.

    Parameters
    ----------
    mark : {"auto", ".", ","}
        Decimal mark; ``auto`` is the first one that occurs.
    """

    def __init__(self, mark: str = "auto") -> None:
        self._mark = "" if mark == "auto" else mark

    def plain(self, field: str) -> str:
        """A field without blanks around it, its decimal mark a point.

        Raises
        ------
        ValueError
            If it has another mark than the fields before.
        """
        text = field.strip()
        comma, point = "," in text, "." in text
        if not (comma or point):
            return text
        if comma and point:
            raise ValueError("has two kinds of decimal marks; leave the thousands' mark out")
        found = "," if comma else "."
        if not self._mark:
            self._mark = found
        if found != self._mark:
            raise ValueError(
                f"has the decimal mark {found!r}, where {self._mark!r} is expected; "
                "write all numbers with the same one, or name it by --decimal"
            )
        return text.replace(",", ".")

    def number(self, field: str) -> float:
        """The value of a field; NaN where it is missing.

        Raises
        ------
        ValueError
            If it is no number.
        """
        text = field.strip()
        if text.lower() in MISSING:
            return math.nan
        if "_" in text:  # Python's own way of writing, and nobody else's
            raise ValueError("is not a number")
        text = self.plain(text)
        try:
            return float(text)
        except ValueError:
            raise ValueError("is not a number") from None

    def time(self, field: str) -> tuple[Time, str]:
        """The time of a field, a number or an ISO date, and how it is written in results.

        Raises
        ------
        ValueError
            If it is neither.
        """
        text = field.strip()
        if text.lower() in MISSING:
            raise ValueError("is blank; every line needs its time")
        try:
            value = self.number(text)
        except ValueError:
            try:
                return datetime.fromisoformat(text), text
            except ValueError:
                pass
            raise
        if not math.isfinite(value):
            raise ValueError("is not finite")
        return value, self.plain(text)
