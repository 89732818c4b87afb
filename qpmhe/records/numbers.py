"""Numbers and times as they stand in a record's fields."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..errors import OptionError
from .times import Time, date, whole_number

__all__ = ["MISSING", "Reader"]

#: Words for a value that is missing, in lower case.
MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "<na>", "null", "none"})


class Reader:
    """Fields to numbers, with one decimal mark in the whole record.

    Parameters
    ----------
    mark : {"auto", ".", ","}
        Decimal mark; ``auto`` is the first one that occurs.
    missing : sequence of str
        More words for a value that is missing, or numbers that stand for it.

    Raises
    ------
    OptionError
        If such a word is blank.
    """

    def __init__(self, mark: str = "auto", missing: Sequence[str] = ()) -> None:
        self._mark = "" if mark == "auto" else mark
        own = [str(word).strip().lower() for word in missing]
        if not all(own):
            raise OptionError("--missing is blank; expected a word. Blank fields are missing.")
        self._missing = MISSING | frozenset(own)
        # -999 is also written -999.0.
        self._markers = frozenset(value for value in map(_value, own) if value is not None)

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
        if text.lower() in self._missing:
            return math.nan
        value = self._parsed(text)
        return math.nan if value in self._markers else value

    def _parsed(self, text: str) -> float:
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
        whole = whole_number(text)
        if whole is not None:
            return whole, text
        try:
            value = self._parsed(text)
        except ValueError:
            try:
                return date(text), text
            except ValueError:
                pass
            raise
        if not math.isfinite(value):
            raise ValueError("is not finite")
        return value, self.plain(text)


def _value(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
