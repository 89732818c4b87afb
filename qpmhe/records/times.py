"""Times of samples: numbers, and dates to the nanosecond."""

from __future__ import annotations

import re
from datetime import datetime
from typing import NamedTuple

__all__ = ["Stamp", "Time", "alike", "date", "spacing", "whole_number"]

_WHOLE = re.compile(r"[+-]?[0-9]{1,19}")
# Behind the seconds, what a datetime has no room for.
_NANOSECONDS = re.compile(r":\d\d[.,]\d{6}(\d{1,3})(?!\d)")


class Stamp(NamedTuple):
    """A date.

    Parameters
    ----------
    moment : datetime
        To the microsecond.
    rest : int
        Nanoseconds behind it, 0 to 999.
    """

    moment: datetime
    rest: int


#: Whole numbers are kept as such: nanoseconds since 1970 do not fit into a float.
Time = int | float | Stamp


def alike(one: Time, other: Time) -> bool:
    """Whether two times can be compared: both numbers, or both dates with or without a zone."""
    if isinstance(one, Stamp) and isinstance(other, Stamp):
        return (one.moment.tzinfo is None) == (other.moment.tzinfo is None)
    return not (isinstance(one, Stamp) or isinstance(other, Stamp))


def spacing(before: Time, after: Time) -> float:
    """Time from one stamp to a later one: a difference, or seconds between two dates.

    Parameters
    ----------
    before, after : int, float or Stamp
        Of one kind.
    """
    if isinstance(before, Stamp) and isinstance(after, Stamp):
        seconds = (after.moment - before.moment).total_seconds()
        return seconds + 1e-9 * (after.rest - before.rest)
    assert not isinstance(before, Stamp)
    assert not isinstance(after, Stamp)
    return float(after - before)


def whole_number(text: str) -> int | None:
    """The value of a text that has digits only; None if it has others."""
    return int(text) if _WHOLE.fullmatch(text) else None


def date(text: str) -> Stamp:
    """Read an ISO date.

    Raises
    ------
    ValueError
        If it is none.
    """
    moment = datetime.fromisoformat(text)
    behind = _NANOSECONDS.search(text)
    return Stamp(moment, int(behind[1].ljust(3, "0")) if behind else 0)
