"""A record's samples, checked one after another."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .columns import Columns, Wanted
from .csv_file import CsvFile, Row
from .errors import RecordError
from .numbers import Reader
from .opening import open_file, open_standard_input
from .parquet_file import ParquetFile
from .times import Time, alike

__all__ = ["Record", "Sample"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample.

    Parameters
    ----------
    line : int
        Its line; 0 if it is not of this record.
    time : int, float or Stamp
        Its time.
    text : str
        Its time as results have it.
    y : (p,) array
        Measurements, NaN where they are missing.
    u : (m,) array
        Inputs, the last ones held where they are missing.
    whole : bool
        Whether its line was ended.
    """

    line: int
    time: Time
    text: str
    y: Array
    u: Array
    whole: bool = True


class Record:
    """A CSV or Parquet file, or standard input, opened.

    Parameters
    ----------
    path : str or Path
        The file; ``-`` is standard input, in CSV.
    wanted : Wanted
        The columns to look for.
    separator, decimal, encoding, missing
        Of `CsvFile` and `Reader`.
    skip_repeated : bool
        Pass over samples whose time is that of the one before.

    Attributes
    ----------
    name : str
        What error texts call it.
    total : int or None
        Bytes or rows in all, if it is known.
    held : int
        Blank inputs so far that were replaced by the last value.
    repeated : int
        Samples so far that were passed over.
    blank : int
        Rows at the end that have nothing in them.
    cut : int or None
        The last line, if it has no end.
    time_type : pyarrow.DataType or None
        Type of the times in a Parquet file.

    Raises
    ------
    RecordError
        If it cannot be opened, or columns are missing.
    OptionError
        If an option does not fit.
    """

    def __init__(
        self,
        path: str | Path,
        wanted: Wanted,
        *,
        separator: str | None = None,
        decimal: str = "auto",
        encoding: str = "utf-8",
        missing: Sequence[str] = (),
        skip_repeated: bool = False,
    ) -> None:
        self.is_stream = str(path) == "-"
        self.name = "standard input" if self.is_stream else str(path)
        self.total: int | None = None
        self.held = self.repeated = self.blank = 0
        self.cut: int | None = None
        self._skip_repeated = skip_repeated
        self._reader = Reader(decimal, missing)
        self._closing = contextlib.ExitStack()
        try:
            self._table = self._open(Path(path), separator, encoding)
            self._columns = self._find(wanted)
        except BaseException:
            self.close()
            raise

    def _open(self, path: Path, separator: str | None, encoding: str) -> CsvFile | ParquetFile:
        if self.is_stream:
            opened = open_standard_input(self.name)
            return CsvFile(opened.stream, self.name, separator, encoding)
        opened = open_file(path, self.name)
        self._closing.callback(opened.close)
        self.total = opened.total
        if opened.is_parquet:
            table = ParquetFile(path, self.name)
            self._closing.callback(table.close)
            self.total = table.total
            return table
        return CsvFile(opened.stream, self.name, separator, encoding)

    def _find(self, wanted: Wanted) -> Columns:
        table = self._table
        try:
            return wanted.find(table.header, self.name, table.header_line)
        except RecordError as error:
            if isinstance(table, ParquetFile):
                raise
            error.args = (f"{error}{table.hint}{self._above(table, wanted)}",)
            raise

    def _above(self, table: CsvFile, wanted: Wanted) -> str:
        """What to add where lines stand above the header."""
        if not self.is_stream:  # a pipe would keep waiting
            for line, fields in table.later_headers():
                with contextlib.suppress(RecordError):
                    wanted.find(fields, self.name, line)
                    return f" Line {line} looks like the header; delete the lines above it."
        if table.header[0].lstrip().startswith(("#", "//", "%")):
            return " Comments and other lines above the header are not understood; delete them."
        return ""

    @property
    def time_type(self) -> Any:
        """Type of the times in a Parquet file."""
        table = self._table
        return table.types[self._columns.time] if isinstance(table, ParquetFile) else None

    @property
    def position(self) -> int:
        """Bytes or rows read so far."""
        return self._table.position

    def close(self) -> None:
        """Let go of the file."""
        self._closing.close()

    def fail(self, what: str, line: int | None, column: str | None = None) -> RecordError:
        """The error that tells of a place in this record.

        Parameters
        ----------
        what : str
            What is wrong, with the remedy.
        line : int, optional
            Where.
        column : str, optional
            Its name.
        """
        return RecordError(what, self.name, line, column, self._table.unit)

    def place(self, sample: Sample) -> str:
        """What texts call a sample of this record.

        Parameters
        ----------
        sample : Sample
            The sample.
        """
        line = f"{self.name}, {self._table.unit} {sample.line}" if sample.line else self.name
        return f"{line} (time {sample.text})"

    def samples(self, held: Array | None = None) -> Iterator[Sample]:
        """The samples, in the order of their times.

        Parameters
        ----------
        held : (m,) array, optional
            Inputs before the first sample.

        Raises
        ------
        RecordError
            At the first sample that cannot be used.
        """
        before: Sample | None = None
        blank: Row | None = None
        for row in self._table:
            if not any(field.strip() for field in row.fields):
                blank, self.blank = blank or row, self.blank + 1
                continue
            if blank is not None:
                raise self.fail(
                    "the line is blank, and others are behind it; delete it.", blank.line
                )
            self.cut = None if row.whole else row.line
            sample = self._sample(row, before, held)
            if sample is None:
                self.repeated += 1
                continue
            before, held = sample, sample.u
            yield sample

    def _sample(self, row: Row, before: Sample | None, held: Array | None) -> Sample | None:
        """The sample of a row; None if it is to be passed over."""
        columns, fields = self._columns, row.fields
        try:
            time, text = self._reader.time(fields[columns.time])
        except ValueError as error:
            raise self._broken(row, columns.time, error) from None
        if before is not None:
            if self._skip_repeated and time == before.time:
                return None
            self._insist_on_order(row, time, before)
        y = np.array([self._number(row, i) if i >= 0 else np.nan for i in columns.outputs])
        u = np.array([self._number(row, i) for i in columns.inputs])
        there = np.isfinite(u)
        if not there.all():
            if held is None or not np.isfinite(held[~there]).all():
                position = columns.inputs[int(np.argmin(there))]
                raise self.fail(
                    "the input is missing, and none stands before it that could be held; fill "
                    "it in.", row.line, self._table.header[position],
                )
            u[~there] = held[~there]
            self.held += int((~there).sum())
        return Sample(row.line, time, text, y, u, row.whole)

    def _number(self, row: Row, position: int) -> float:
        try:
            return self._reader.number(row.fields[position])
        except ValueError as error:
            raise self._broken(row, position, error) from None

    def _broken(self, row: Row, position: int, error: ValueError) -> RecordError:
        field = row.fields[position].strip()
        shown = field if len(field) <= 40 else f"{field[:40]}..."
        remedy = "correct it, or leave it blank if it is missing." if position != (
            self._columns.time
        ) else "correct it; expected a number or a date as 2026-05-04T12:00:00."
        what = f"{shown!r} {error}; {remedy}" if shown else f"the time {error}."
        if not row.whole:
            what += " It is the last line, which has no end and may be cut off."
        return self.fail(what, row.line, self._table.header[position])

    def _insist_on_order(self, row: Row, time: Time, before: Sample) -> None:
        column = self._table.header[self._columns.time]
        unit = self._table.unit
        if not alike(time, before.time):
            raise self.fail(
                f"its time cannot be compared with that of {unit} {before.line}; write all as "
                "numbers, or all as dates with or all without a zone.", row.line, column,
            )
        if time > before.time:  # type: ignore[operator]
            return
        equal = time == before.time
        shown = row.fields[self._columns.time].strip()
        if equal:
            raise self.fail(
                f"time {shown} stands in {unit} {before.line} already; keep one of the two, or "
                "give --skip-repeated, which keeps the first.",
                row.line, column,
            )
        raise self.fail(
            f"time {shown} is before {before.text} of {unit} {before.line}; sort the record by "
            "time.", row.line, column,
        )
