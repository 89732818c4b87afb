"""Numbers and times in the fields of a record."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

from ..errors import OptionError

__all__ = ["FieldReader", "Time", "seconds_between"]

_MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "<na>", "null", "none"})
_WHOLE = re.compile(r"[+-]?[0-9]{1,19}")
_NANOSECONDS = re.compile(r":\d\d[.,]\d{6}(\d{1,3})(?!\d)")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Time(NamedTuple):
    """A number, or a date in nanoseconds since 1970.

    Whole numbers stay integers: nanoseconds since 1970 do not fit into a float.
    """

    kind: str
    value: int | float
    text: str


def seconds_between(before: Time, after: Time) -> float:
    """Difference of two times of one kind: of numbers in their unit, of dates in seconds."""
    difference = after.value - before.value
    return float(difference) if after.kind == "number" else difference / 1e9


class FieldReader:
    """Reads fields, with one decimal mark in the whole record: the first one, if ``auto``."""

    def __init__(self, decimal: str = "auto", missing: Sequence[str] = ()) -> None:
        self._mark = "" if decimal == "auto" else decimal
        words = [str(word).strip().lower() for word in missing]
        if not all(words):
            raise OptionError("--missing is blank; expected a word. Blank fields are missing.")
        self._missing = _MISSING.union(words)
        # -999 is also written -999.0.
        self._numbers = set()
        for word in words:
            try:
                self._numbers.add(float(word))
            except ValueError:
                continue

    def number(self, field: str) -> float:
        """The value of a field, NaN where it is missing; ValueError where it is no number."""
        text = field.strip()
        if text.lower() in self._missing:
            return math.nan
        value = self._parse(text)
        return math.nan if value in self._numbers else value

    def time(self, field: str) -> Time:
        """The time in a field, a number or an ISO date; ValueError where it is neither."""
        text = field.strip()
        if text.lower() in _MISSING:
            raise ValueError("is blank; every line needs its time")
        if _WHOLE.fullmatch(text):
            return Time("number", int(text), text)
        try:
            value = self._parse(text)
        except ValueError:
            try:
                moment = datetime.fromisoformat(text)
            except ValueError:
                pass
            else:
                return _date(moment, text)
            raise
        if not math.isfinite(value):
            raise ValueError("is not finite")
        return Time("number", value, text.replace(",", "."))

    def _parse(self, text: str) -> float:
        comma, point = "," in text, "." in text
        try:
            value = float(text.replace(",", "" if point else ".") if comma else text)
        except ValueError:
            raise ValueError("is not a number") from None
        if "_" in text:  # 1_000 is a number in Python only
            raise ValueError("is not a number")
        if comma and point:
            raise ValueError("has two kinds of decimal marks; leave out the thousands separator")
        if comma or point:
            mark = "," if comma else "."
            self._mark = self._mark or mark
            if mark != self._mark:
                raise ValueError(
                    f"has the decimal mark {mark!r}, where {self._mark!r} is expected; use the "
                    "same one in all numbers, or choose it by --decimal"
                )
        return value


def _date(moment: datetime, text: str) -> Time:
    kind = "date" if moment.tzinfo is None else "date with a zone"
    since = moment.replace(tzinfo=moment.tzinfo or UTC) - _EPOCH
    rest = _NANOSECONDS.search(text)  # a datetime has microseconds only
    nanoseconds = 1000 * (since // timedelta(microseconds=1))
    return Time(kind, nanoseconds + (int(rest[1].ljust(3, "0")) if rest else 0), text)
