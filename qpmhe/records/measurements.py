"""The measurements of a record, checked one after another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidInputError
from .columns import ColumnNames
from .tables import RecordError, Row, open_table
from .values import FieldReader, Time

__all__ = ["Measurement", "RecordReader"]

Array = NDArray[np.float64]


@dataclass(eq=False)
class Measurement:
    """One sample: y is NaN where it is missing, u holds its last value there.

    `complete` says that nothing that comes later in the record can change it or its step;
    `line` is 0 if it comes from a checkpoint.
    """

    line: int
    time: Time
    y: Array
    u: Array
    complete: bool = True


class RecordReader:
    """A CSV or Parquet file, or standard input; counts what it holds and skips.

    `cut` is the last line, if it has no end; `blank` counts rows at the end that hold nothing.
    """

    def __init__(
        self, path: str, names: ColumnNames, *, separator: str | None = None,
        encoding: str = "utf-8", decimal: str = "auto", missing: Sequence[str] = (),
        skip_repeated: bool = False,
    ) -> None:
        self.is_stream = path == "-"
        self.held = self.repeated = self.blank = 0
        self.cut: int | None = None
        self._skip_repeated = skip_repeated
        self._reader = FieldReader(decimal, missing)
        self._table = table = open_table(path, separator, encoding)
        self.name, self.total = table.name, table.total
        try:
            self._columns = names.find(table.header, table.name, table.header_line)
        except InvalidInputError as error:
            if isinstance(error, RecordError):
                error.args = (f"{error}{table.explain(names.find)}",)
            table.close()
            raise

    @property
    def time_type(self) -> Any:
        """Type of the times in a Parquet file, None for CSV."""
        types = getattr(self._table, "types", None)
        return types[self._columns.time] if types is not None else None

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
        """What texts call a sample of this record."""
        line = f", {self._table.unit} {sample.line}" if sample.line else ""
        return f"{self.name}{line} (time {sample.time.text})"

    def samples(self, held: Array | None = None) -> Iterator[Measurement]:
        """The samples in order of time; `held` are the inputs before the first one."""
        before: Measurement | None = None
        blank: Row | None = None
        for row in self._table:
            if not "".join(row.fields).strip():
                blank, self.blank = blank or row, self.blank + 1
                continue
            if blank is not None:
                raise self.error(
                    "the line is blank, and others follow it; delete it.", blank.line
                )
            self.cut = None if row.ended else row.line
            time = self._value(row, self._columns.time, self._reader.time)
            if before is not None:
                if self._skip_repeated and time[:2] == before.time[:2]:
                    self.repeated += 1
                    continue
                self._check_order(row, time, before)
            before = self._sample(row, time, held)
            held = before.u
            yield before

    def _sample(self, row: Row, time: Time, held: Array | None) -> Measurement:
        columns, number = self._columns, self._reader.number
        y = np.array([self._value(row, i, number) if i >= 0 else np.nan for i in columns.outputs])
        u = np.array([self._value(row, i, number) for i in columns.inputs])
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
        return Measurement(row.line, time, y, u, row.ended)

    def _value(self, row: Row, position: int, read: Any) -> Any:
        try:
            return read(row.fields[position])
        except ValueError as error:
            field = row.fields[position].strip()
            shown = field if len(field) <= 40 else f"{field[:40]}..."
            is_time = position == self._columns.time
            remedy = (
                "expected a number or a date such as 2026-05-04T12:00:00" if is_time
                else "correct it, or leave it blank if it is missing"
            )
            what = f"{shown!r} {error}; {remedy}." if shown else f"the time {error}."
            if not row.ended:
                what += " It is the last line, which has no end and may be cut off."
            raise self.error(what, row.line, self._table.header[position]) from None

    def _check_order(self, row: Row, time: Time, before: Measurement) -> None:
        column, unit = self._table.header[self._columns.time], self._table.unit
        if time.kind != before.time.kind:
            raise self.error(
                f"its time is a {time.kind}, and in {unit} {before.line} a {before.time.kind}; "
                "write all times as numbers, or all as dates with or all without a zone.",
                row.line, column,
            )
        if time.value > before.time.value:
            return
        if time.value == before.time.value:
            raise self.error(
                f"time {time.text} is in {unit} {before.line} already; keep one of the two, or "
                "give --skip-repeated, which keeps the first.", row.line, column,
            )
        raise self.error(
            f"time {time.text} is before {before.time.text} in {unit} {before.line}; sort the "
            "record by time.", row.line, column,
        )
