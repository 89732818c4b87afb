"""The measurements of a record: its columns, its fields, and checks one sample after another."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from time import perf_counter
from typing import Any, NamedTuple, Protocol

import numpy as np

from .._checks import Array
from ..errors import InvalidInputError, OptionError
from .quaternions import SignChanges
from .readers import ReadingOptions, open_table
from .tables import TIMES, RecordError, Table, TableRow, nearest_first

# Units with which a column called "t" is the time, and no temperature.
_TIME_UNITS = frozenset((
    "ns", "us", "\u00b5s", "\u03bcs", "ms", "s", "sec", "second", "seconds", "min", "minute",
    "minutes", "h", "hr", "hour", "hours", "d", "day", "days", "sample", "samples", "step", "steps",
))
# By option: the letter of its signals, and what one of them is.
_KINDS = {
    "outputs": ("y", "output"), "inputs": ("u", "input"), "truth": ("x", "true state"),
}
# "Voltage (V)", "Voltage [V]", "Voltage / V", but "Voltage[0]"
_UNIT = re.compile(r"\s*(\([^()]*\)|\[(?!\d+\])[^\[\]]*\]|/\s*\S+)$")
_TIME, _NAME_TIME = "the time", "name it with --time COLUMN."
# An error shows so many names, and so much of each.
_NAMES_SHOWN, _LETTERS_SHOWN = 40, 60
_MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "<na>", "null", "none"})
_WHOLE = re.compile(r"[+-]?[0-9]{1,19}")
_NANOSECONDS = re.compile(r":\d\d[.,]\d{6}(\d{1,3})(?!\d)")
# 04.05.2026, the fourth of May; a date with slashes may begin with the month.
_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(?=\s|T|$)")
# What pandas writes of a duration, and what Python does: 1 days 00:00:00.25, 1 day, 0:00:00
_DURATION = re.compile(
    r"(?=.)(?:([+-]?\d+) days?,?)?(?:(?:^| )\+?(\d+):([0-5]\d):([0-5]\d)(?:[.,](\d{1,9}))?)?"
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(eq=False)
class Measurement:
    """One sample: y is NaN where it is missing, u holds its last value there.

    `complete` says that no later line of the record can change it or its step; `line` is 0 if it
    comes from a checkpoint; `arrived` is the time of `perf_counter` at which its line came in.
    """

    line: int
    time: Time
    y: Array
    u: Array
    complete: bool = True
    arrived: float = 0.0


class RecordReader:
    """A file of any kind, or standard input; counts what it holds and skips.

    `columns` are positions in a row. `cut` is the last line, if it has no end; `blank` counts rows
    that hold nothing.
    """

    def __init__(
        self, path: str, names: ColumnFinder, reading: ReadingOptions
    ) -> None:
        self.is_stream = path == "-"
        self.held = self.repeated = self.blank = 0
        self.cut: int | None = None
        self._skip_repeated = reading.skip_repeated
        self._reader = FieldReader(reading.decimal, reading.missing, reading.time_format)
        self._table = table = open_table(path, names.time, reading)
        self.name, self.total = table.name, table.total
        try:
            columns = names.find(table)
        except InvalidInputError as error:
            if isinstance(error, RecordError):
                error.args = (f"{error}{table.hint}",)
            table.close()
            raise
        places = table.select([i for i in columns.chosen if i >= 0], columns.inputs) | {-1: -1}
        self.columns = Columns(places[columns.time], *(
            tuple(places[i] for i in each) for each in (columns.outputs, columns.inputs)
        ))
        self._signs = SignChanges(len(columns.outputs))

    @property
    def notes(self) -> list[str]:
        """What the user should know of the file."""
        names = [self._table.header[i] if i >= 0 else "" for i in self.columns.outputs]
        return [*self._table.notes, *self._signs.notes(self.name, names)]

    @property
    def time_type(self) -> Any:
        """Type of the times in a Parquet file, None for CSV."""
        types = self._table.types
        return types[self.columns.time] if types is not None else None

    @property
    def position(self) -> int:
        """Bytes or rows read so far."""
        return self._table.position

    def close(self) -> None:
        """Close the file."""
        self._table.close()

    def error(self, what: str, line: int | None, column: str | None = None) -> RecordError:
        """The error for a place in this record; `what` includes the remedy."""
        return RecordError(what, self.name, line, column, self._table.unit)

    def place(self, sample: Measurement) -> str:
        """How messages name a sample of this record."""
        line = f", {self._table.unit} {sample.line}" if sample.line else ""
        return f"{self.name}{line} (time {sample.time.text})"

    def samples(self, held: Array | None = None) -> Iterator[Measurement]:
        """The samples in order of time; `held` are the inputs before the first one."""
        for row, time in self.rows():
            found = self._sample(row, time, held)
            held = found.u
            yield found

    def rows(self) -> Iterator[tuple[TableRow, Time]]:
        """The rows in order of time."""
        before: tuple[TableRow, Time] | None = None
        for row in self._table:
            if not "".join(row.fields).strip():
                self.blank += 1
                continue
            self.cut = None if row.ended else row.line
            time = self.value(row, self.columns.time, self._reader.time)
            if before is not None:
                if self._skip_repeated and time[:2] == before[1][:2]:
                    self.repeated += 1
                    continue
                self._check_order(row, time, *before)
            before = row, time
            yield before

    def _sample(self, row: TableRow, time: Time, held: Array | None) -> Measurement:
        columns, number = self.columns, self._reader.number
        y = np.array([self.value(row, i, number) if i >= 0 else np.nan for i in columns.outputs])
        u = np.array([self.value(row, i, number) for i in columns.inputs])
        missing = ~np.isfinite(u)
        if missing.any():
            if held is None:
                position = columns.inputs[int(np.argmax(missing))]
                raise self.error(
                    "the input is missing, and there is no earlier value to hold; fill it in.",
                    row.line, self._table.header[position],
                )
            u[missing] = held[missing]
            self.held += int(missing.sum())
        self._signs.look(y, time.text)
        return Measurement(
            row.line, time, y, u, row.ended, self._table.arrived or perf_counter()
        )

    def value(self, row: TableRow, position: int, read: Any) -> Any:
        """A field of a row, read; a `RecordError` where it cannot be."""
        try:
            return read(row.fields[position])
        except ValueError as error:
            field = row.fields[position].strip()
            shown = field if len(field) <= 40 else f"{field[:40]}..."
            if position != self.columns.time:
                remedy = "correct it, or leave it blank if it is missing"
                if str(error) == "is not a number":
                    remedy += ", or declare it missing with --missing"
            else:
                remedy = (
                    "correct the line or --time-format; %f is a fraction of a second"
                    if self._reader.has_format
                    else "expected a number, or a date such as 2026-05-04T12:00:00 or 04.05.2026 "
                    "12:00:00; choose another form with --time-format, such as "
                    "'%d/%m/%Y %H:%M:%S', followed by '.%f' for fractions of a second"
                )
                if not any(mark.isdigit() for mark in field):
                    remedy += "; delete the line if it holds units or a comment"
            what = f"{shown!r} {error}; {remedy}." if shown else f"the time {error}."
            if not row.ended:
                what += " It is the last line, which has no end and may be cut off."
            raise self.error(what, row.line, self._table.header[position]) from None

    def _check_order(self, row: TableRow, time: Time, last: TableRow, before: Time) -> None:
        column, unit = self._table.header[self.columns.time], self._table.unit
        if time.kind != before.kind:
            raise self.error(
                f"its time is a {time.kind}, and in {unit} {last.line} a {before.kind}; "
                "write all times as numbers, or all as dates with or all without a zone.",
                row.line, column,
            )
        if time.value > before.value:
            return
        if time.value == before.value:
            raise self.error(
                f"time {time.text} is in {unit} {last.line} already; keep one of the two, or "
                "give --skip-repeated, which keeps the first.", row.line, column,
            )
        raise self.error(
            f"time {time.text} is before {before.text} in {unit} {last.line}; sort the "
            "record by time.", row.line, column,
        )


class Columns(NamedTuple):
    """Positions in a row; -1 for an output that the record does not have."""

    time: int
    outputs: tuple[int, ...]
    inputs: tuple[int, ...]

    @property
    def chosen(self) -> tuple[int, ...]:
        """Those besides the time."""
        return (*self.outputs, *self.inputs)


class ColumnFinder(Protocol):
    """Knows which columns are needed."""

    @property
    def time(self) -> str | None:
        """What the user calls the time."""
        ...

    def find(self, table: Table) -> Columns:
        """Their positions."""
        ...


@dataclass(frozen=True)
class ColumnNames:
    """The model's names of y and u, and the options --time, --outputs and --inputs.

    With ``option="truth"`` the true states take the place of the outputs; those without a column
    have no truth.
    """

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    time: str | None = None
    output_columns: str | None = None
    input_columns: str | None = None
    option: str = "outputs"

    def find(self, table: Table) -> Columns:
        """The columns in a header; RecordError where one is missing or ambiguous."""
        header = Header(table)
        outputs = _find(header, self.option, self.outputs, self.output_columns)
        inputs = _find(header, "inputs", self.inputs, self.input_columns)
        if all(position < 0 for position in outputs):
            kind = _KINDS[self.option][1]
            raise OptionError(f"--{self.option} leaves out all {kind}s; expected a column for at "
                              "least one.")
        return Columns(header.time(self.time, (*outputs, *inputs), self.option), outputs, inputs)


def _find(
    header: Header, option: str, names: tuple[str, ...], given: str | None
) -> tuple[int, ...]:
    letter, kind = _KINDS[option]
    chosen = _chosen(option, given, letter, names)
    found = []
    for i, name in enumerate(names):
        guesses = [name, f"{letter}{i + 1}", f"{letter}_{i + 1}", *[letter] * (len(names) == 1)]
        remedy = f"name it with --{option} {letter}{i + 1}=COLUMN"
        if option == "outputs":
            remedy += f", or leave it out with --outputs {letter}{i + 1}= (no column)"
        elif option == "truth":
            remedy += ", or leave it out: then the state has no truth"
            guesses = [""]
        elif chosen.get(i) == "":
            raise OptionError(f"--inputs gives no column for {name!r}; inputs are needed.")
        wanted = [chosen[i]] if i in chosen else guesses
        found.append(
            -1 if wanted == [""] else header.find(wanted, f"{kind} {name!r}", f"{remedy}.")
        )
    return tuple(found)


class Header:
    """The names of a table's columns, and which of them is meant."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self._file, self._line = table.name, table.header_line
        self._look()

    def _look(self) -> None:
        self.names = [name.strip() for name in self._table.header]
        self._lower = [name.lower() for name in self.names]
        self._is_plain = self._table.units is not None
        self._bare = self._lower if self._is_plain else [
            _UNIT.sub("", name) for name in self._lower]

    def time(self, given: str | None, taken: Sequence[int], option: str = "outputs") -> int:
        """The column of the time: the given one, or one with a usual name."""
        if self._table.has_clocks:
            return 0
        if given is None:
            return self._usual_time(taken)
        time = self.find((given,), _TIME, _NAME_TIME)
        if time in taken:
            raise OptionError(
                f"column {self.names[time]!r} is both the time and something else; choose a "
                f"different column for each with --time, --{option} and --inputs."
            )
        return time

    def _usual_time(self, taken: Iterable[int]) -> int:
        """The column with one of the usual names; not an output, input or temperature."""
        others = dict.fromkeys(taken, "is used already")
        for i, name in enumerate(self.names):
            bare = _UNIT.sub("", name)
            if bare.lower() == "t" and i not in others:
                unit = name[len(bare):].strip("()[]/ ").lower()
                if unit and unit not in _TIME_UNITS:
                    others[i] = "has no unit of time"
                elif bare == "T" and not unit:
                    others[i] = "may be a temperature"
        reasons = "; ".join(
            f"{self.names[i]!r} {reason}" for i, reason in others.items()
            if _UNIT.sub("", self.names[i]).lower() in TIMES
        )
        remedy = f"{_NAME_TIME} Not taken: {reasons}." if reasons else _NAME_TIME
        return self.find(TIMES, _TIME, remedy, others)

    def find(
        self, wanted: Sequence[str], what: str, remedy: str, others: Container[int] = ()
    ) -> int:
        """The column of the first of these names; case does not matter, nor a unit behind it.

        Of names that are paths, the last part will do. Columns in `others` are something else.
        """
        if self._table.has_clocks:
            others = (0,)
        for name in wanted:
            small = name.lower()
            bare = _UNIT.sub("", small) or small
            found = self._matching(name, small, bare, others)
            if len(found) == 1:
                return found[0]
            if found:
                same = ", ".join(repr(self.names[i]) for i in found[:_NAMES_SHOWN])
                raise RecordError(
                    f"{len(found)} columns could all be {what}: {same}; rename all but one, "
                    f"or {remedy}", self._file, self._line,
                )
        # Of several usual names nobody knows which one will come.
        later = self._table.expect(wanted[0]) if len(wanted) == 1 and what != _TIME else None
        if later is not None:
            self._look()
            return later
        tried = ", ".join(map(repr, dict.fromkeys(wanted)))
        names = self.names[self._table.has_clocks:]
        more = len(names) - _NAMES_SHOWN
        nearest = ""
        if more > 0:
            names = nearest_first(names, wanted[0])
            nearest = ", the nearest first,"
        shown = ", ".join(
            repr(name if len(name) <= _LETTERS_SHOWN else f"{name[:_LETTERS_SHOWN]}...")
            for name in names[:_NAMES_SHOWN]
        )
        raise RecordError(
            f"there is no column for {what} (looked for {tried}); the columns are{nearest} {shown}"
            f"{f' and {more} more' if more > 0 else ''}. If it is one of them, {remedy}",
            self._file, self._line,
        )

    def _matching(self, name: str, small: str, bare: str, others: Container[int]) -> list[int]:
        """The columns of a name, by the strictest rule that finds any."""
        rules: list[tuple[Sequence[str], str]] = [
            (self.names, name), (self._lower, small), (self._bare, small), (self._bare, bare),
        ]
        for names, one in rules:
            found = [i for i, each in enumerate(names) if each == one and i not in others]
            if found:
                return found
        if not self._is_plain:
            return []
        ends = (f".{small}", f"/{small}")
        return [i for i, each in enumerate(self._lower) if each.endswith(ends) and i not in others]


def unit_of(name: str) -> str:
    """The unit behind a column's name, such as V of ``Voltage [V]``; blank without one."""
    found = _UNIT.search(name)
    return "" if found is None else found[0].strip().strip("()[]/").strip()


def _chosen(
    option: str, text: str | None, letter: str, names: tuple[str, ...]
) -> dict[int, str]:
    """Read ``y1=column,y2=column`` or ``column,column``: the column of each index."""
    if text is None:
        return {}
    indices = {f"{letter}{i + 1}": i for i in range(len(names))}
    if len(names) == 1:
        indices[letter] = 0
    indices |= {_UNIT.sub("", name): i for i, name in enumerate(names)}
    indices |= {name: i for i, name in enumerate(names)}
    known = ", ".join(indices) or f"none: the model has no {option}"
    items = [item.strip() for item in next(csv.reader([text], skipinitialspace=True), [])]
    if len(items) == len(names) and not any(
        item.partition("=")[0].strip() in indices for item in items
    ):
        return dict(enumerate(items))
    found: dict[int, str] = {}
    for item in items:
        name, equals, column = (part.strip() for part in item.partition("="))
        if not equals or name not in indices:
            raise OptionError(
                f"--{option} has {item!r}; expected comma-separated NAME=COLUMN with a name of "
                f"{known}, or {len(names)} columns in order."
            )
        if indices[name] in found:
            raise OptionError(f"--{option} gives {name!r} twice; give it once.")
        found[indices[name]] = column
    return found


class Time(NamedTuple):
    """A number; or a date in nanoseconds since 1970, or a duration in nanoseconds.

    Whole numbers stay integers: nanoseconds since 1970 do not fit into a float.
    """

    kind: str
    value: int | float
    text: str


def spacing(before: Time, after: Time) -> tuple[float, float]:
    """Difference of two times of one kind, and their last digit: numbers in their unit, else s."""
    difference = after.value - before.value
    if after.kind != "number":
        return difference / 1e9, 1e-9
    return float(difference), 4e-16 * abs(after.value) if isinstance(after.value, float) else 0.0


class FieldReader:
    """Reads fields, with one decimal mark in all measurements: the first one, if ``auto``.

    Times may have another one: clocks often write a point where the measurements have commas.
    """

    def __init__(
        self, decimal: str = "auto", missing: Sequence[str | float] = (),
        time_format: str | None = None,
    ) -> None:
        self._mark = "" if decimal == "auto" else decimal
        self._format = time_format
        words = [str(word).strip().lower() for word in missing]
        self._missing = _MISSING.union(words)
        # -999 is also written -999.0.
        self._numbers = set()
        for word in words:
            try:
                self._numbers.add(float(word))
            except ValueError:
                continue

    @property
    def has_format(self) -> bool:
        """Whether the user gave the form of the times."""
        return self._format is not None

    def number(self, field: str) -> float:
        """The value of a field, NaN where it is missing; ValueError where it is no number."""
        text = field.strip()
        if text.lower() in self._missing:
            return math.nan
        value, mark = _parse(text)
        self._mark = self._mark or mark
        if mark and mark != self._mark:
            raise ValueError(
                f"has the decimal mark {mark!r}, where {self._mark!r} is expected; use the same "
                "one in all numbers, or choose it with --decimal"
            )
        return math.nan if value in self._numbers else value

    def time(self, field: str) -> Time:
        """The time in a field: a number, a date or a duration; else ValueError."""
        text = field.strip()
        if text.lower() in _MISSING:
            raise ValueError("is blank; every line needs its time")
        if self._format is not None:
            try:
                return _date(datetime.strptime(text, self._format), text)
            except ValueError:
                raise ValueError(f"does not have the form {self._format!r}") from None
        if _WHOLE.fullmatch(text):
            return Time("number", int(text), text)
        try:
            value, _ = _parse(text)
        except ValueError:
            day = _DAY_FIRST.match(text)
            iso = f"{day[3]}-{day[2]:0>2}-{day[1]:0>2}{text[day.end():]}" if day else text
            with suppress(ValueError):
                return _date(datetime.fromisoformat(iso), text)
            duration = _DURATION.fullmatch(text)
            if duration is None:
                raise
            return Time("duration", _nanoseconds(duration), text)
        if not math.isfinite(value):
            raise ValueError("is not finite")
        return Time("number", value, text.replace(",", "."))


def _parse(text: str) -> tuple[float, str]:
    """A number, and its decimal mark if it has one."""
    comma, point = "," in text, "." in text
    try:
        value = float(text.replace(",", "" if point else ".") if comma else text)
    except ValueError:
        raise ValueError("is not a number") from None
    if "_" in text:  # 1_000 is a number in Python only
        raise ValueError("is not a number")
    if comma and point:
        raise ValueError("has two kinds of decimal marks; leave out the thousands separator")
    return value, "," if comma else "." if point else ""


def _nanoseconds(duration: re.Match[str]) -> int:
    days, hours, minutes, seconds, rest = duration.groups("0")
    whole = ((24 * int(days) + int(hours)) * 60 + int(minutes)) * 60 + int(seconds)
    return 10**9 * whole + int(rest.ljust(9, "0"))


def _date(moment: datetime, text: str) -> Time:
    kind = "date" if moment.tzinfo is None else "date with a zone"
    since = moment.replace(tzinfo=moment.tzinfo or UTC) - _EPOCH
    rest = _NANOSECONDS.search(text)  # a datetime has microseconds only
    nanoseconds = 1000 * (since // timedelta(microseconds=1))
    return Time(kind, nanoseconds + (int(rest[1].ljust(3, "0")) if rest else 0), text)
