"""Times of Parquet files as texts and back, without losing their type or a digit."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from decimal import Decimal
from typing import Any
from zoneinfo import ZoneInfo

from ..studies.errors import need
from .numbers import Reader
from .times import Stamp, Time

__all__ = ["common_type", "is_kept", "time_array", "timestamp_texts"]

_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
_EPOCH = datetime(1970, 1, 1)


def timestamp_texts(column: Any) -> list[str]:
    """Timestamps as ISO dates, with nanoseconds where there are any; blank where null.

    Parameters
    ----------
    column : pyarrow.Array
        Of a timestamp type.

    Raises
    ------
    ValueError
        If one is not within the years 1 to 9999.
    """
    pyarrow = need("pyarrow", "a Parquet file")
    per = _PER_SECOND[column.type.unit]
    zone = None if column.type.tz is None else _zone(column.type.tz)
    texts = []
    for value in column.cast(pyarrow.int64()).to_pylist():
        if value is None:
            texts.append("")
            continue
        seconds, part = divmod(value, per)
        micro, rest = divmod(part * (10**9 // per), 1000)
        try:
            moment = _EPOCH + timedelta(seconds=seconds, microseconds=micro)
            if zone is not None:
                moment = moment.replace(tzinfo=UTC).astimezone(zone)
        except OverflowError:
            raise ValueError("a date is not within the years 1 to 9999") from None
        if rest:
            full = moment.isoformat(timespec="microseconds")
            texts.append(f"{full[:26]}{rest:03d}{full[26:]}")
        else:
            texts.append(moment.isoformat())
    return texts


def is_kept(kind: Any) -> bool:
    """Whether times of a Parquet type can be written in it again.

    Parameters
    ----------
    kind : pyarrow.DataType
        The type.
    """
    types = need("pyarrow", "a Parquet file").types
    return any(
        test(kind) for test in (
            types.is_integer, types.is_float32, types.is_float64, types.is_decimal,
            types.is_timestamp, types.is_date, types.is_string, types.is_large_string,
        )
    )


def common_type(times: Iterable[str]) -> Any:
    """The Parquet type for times that come from no Parquet file.

    Whole numbers, numbers, or dates; these with their zone if it is one and the same.

    Parameters
    ----------
    times : iterable of str
        All of them, as results have them.
    """
    pyarrow, reader = need("pyarrow", "a Parquet file"), Reader(".")
    whole, dated, fine = True, False, False
    offsets: set[timedelta | None] = set()
    for text in times:
        time, _ = reader.time(text)
        if isinstance(time, Stamp):
            dated, fine = True, fine or time.rest > 0
            offsets.add(time.moment.utcoffset())
        elif not isinstance(time, int) or abs(time) >= 2**63:
            whole = False
    if dated:
        zone = None if None in offsets else _name(offsets.pop()) if len(offsets) == 1 else "UTC"
        return pyarrow.timestamp("ns" if fine else "us", tz=zone)
    return pyarrow.int64() if whole else pyarrow.float64()


def time_array(kind: Any, fields: list[str]) -> Any:
    """Times as a column of a Parquet type.

    Parameters
    ----------
    kind : pyarrow.DataType
        One that `is_kept`, or comes from `common_type`.
    fields : list of str
        The times, as results have them.
    """
    pyarrow, reader = need("pyarrow", "a Parquet file"), Reader(".")
    types = pyarrow.types
    if types.is_string(kind) or types.is_large_string(kind):
        return pyarrow.array(fields, kind)
    if types.is_decimal(kind):
        return pyarrow.array([Decimal(field) for field in fields], kind)
    times = [reader.time(field)[0] for field in fields]
    if types.is_timestamp(kind):
        values = [_since_1970(time, _PER_SECOND[kind.unit]) for time in times]
        return pyarrow.array(values, pyarrow.int64()).cast(kind)
    if types.is_date(kind):
        days = [time.moment.date() for time in times if isinstance(time, Stamp)]
        return pyarrow.array(days, kind)
    if types.is_integer(kind):
        return pyarrow.array(times, kind)
    return pyarrow.array([_number(time) for time in times], pyarrow.float64()).cast(kind)


def _since_1970(time: Time, per: int) -> int:
    assert isinstance(time, Stamp)
    moment = time.moment
    if moment.tzinfo is not None:
        moment = moment.astimezone(UTC).replace(tzinfo=None)
    microseconds = (moment - _EPOCH) // timedelta(microseconds=1)
    return (microseconds * 1000 + time.rest) * per // 10**9


def _number(time: Time) -> float:
    assert not isinstance(time, Stamp)
    return float(time)


def _zone(name: str) -> tzinfo:
    if name[:1] in "+-":
        hours, _, minutes = name[1:].partition(":")
        offset = timedelta(hours=int(hours), minutes=int(minutes or 0))
        return timezone(-offset if name[0] == "-" else offset)
    try:
        return ZoneInfo(name)
    except Exception:  # no such zone, or no table of zones here: the instant is the same
        return UTC


def _name(offset: timedelta | None) -> str:
    assert offset is not None
    minutes = offset // timedelta(minutes=1)
    if not minutes:
        return "UTC"
    return f"{'-' if minutes < 0 else '+'}{abs(minutes) // 60:02d}:{abs(minutes) % 60:02d}"
