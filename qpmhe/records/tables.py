"""Tables read row by row: CSV text, gzip of it, or Parquet."""

from __future__ import annotations

import contextlib
import csv
import gzip
import io
import os
import re
import stat
import sys
import zlib
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, BinaryIO, NamedTuple

from .._checks import need
from ..errors import InvalidInputError, OptionError

# Before the comma, which occurs within names and numbers, too.
_SEPARATORS = {"\t": "tab", ";": "semicolon", "|": "bar", ",": "comma"}
_SEPARATOR_NAMES = {name: mark for mark, name in _SEPARATORS.items()} | {"space": " "}
_BATCH = 4096

_GZIP, _PARQUET = b"\x1f\x8b", b"PAR1"
_ZCAT = "give '{} FILE | qpmhe estimate MODEL -', or compress it by gzip, which qpmhe reads."
_UNREADABLE = {
    _PARQUET: "it is a Parquet file, which cannot be read line by line; name the file instead.",
    b"PK\x03\x04": "it is a zip archive or a spreadsheet; save it as CSV.",
    b"BZh": f"it is compressed by bzip2; {_ZCAT.format('bzcat')}",
    b"\xfd7zXZ": f"it is compressed by xz; {_ZCAT.format('xzcat')}",
    b"\x28\xb5\x2f\xfd": f"it is compressed by zstd; {_ZCAT.format('zstdcat')}",
}


class RecordError(InvalidInputError):
    """A record that cannot be read or used; the text names file, line, column and remedy.

    ``what`` states the fault and the remedy; ``unit`` is ``line``, or ``row`` of a Parquet file.
    """

    def __init__(
        self, what: str, file: str, line: int | None = None, column: str | None = None,
        unit: str = "line",
    ) -> None:
        place = file if line is None else f"{file}, {unit} {line}"
        super().__init__(f"{place}{'' if column is None else f', column {column!r}'}: {what}")
        self.file, self.line, self.column = file, line, column


class TableRow(NamedTuple):
    """A line number, a field for each column, and whether the line has an end."""

    line: int
    fields: list[str]
    ended: bool


def open_table(
    record: str, separator: str | None, encoding: str, skip_lines: int = 0
) -> CsvTable | ParquetTable:
    """Open a record, a file or ``-`` for standard input; its first bytes show its kind."""
    piped = record == "-"
    name = "standard input" if piped else record
    if piped and sys.stdin is None:
        raise RecordError("it is closed; pipe a record into it, or name a file.", name)
    with contextlib.ExitStack() as opened:
        try:
            stream: Any = sys.stdin.buffer if piped else opened.enter_context(open(record, "rb"))
            if not hasattr(stream, "peek"):
                stream = io.BufferedReader(stream)
            head, total = stream.peek(6)[:6], None
            if not piped and stat.S_ISREG((status := os.fstat(stream.fileno())).st_mode):
                total = status.st_size
        except OSError as error:
            raise RecordError(f"it cannot be read ({error.strerror or error}).", name) from error
        if total is not None and (
            head.startswith(_PARQUET) or record.lower().endswith((".parquet", ".pq"))
        ):
            if skip_lines:
                raise OptionError(
                    f"--skip-lines is {skip_lines}, but {name} is a Parquet file, which has no "
                    "lines; leave it out."
                )
            return ParquetTable(name)
        for magic, remedy in _UNREADABLE.items():
            if head.startswith(magic):
                raise RecordError(remedy, name)
        if head.startswith(_GZIP):
            stream, total = gzip.GzipFile(fileobj=stream), None
        table = CsvTable(stream, name, separator, encoding, total, skip_lines)
        table.close = opened.pop_all().close
        return table


class CsvTable:
    """A header, and rows below it, each available as soon as its line arrives."""

    unit = "line"

    def __init__(
        self, stream: BinaryIO, name: str, separator: str | None, encoding: str, total: int | None,
        skip_lines: int = 0,
    ) -> None:
        self._stream, self.name, self._encoding, self.total = stream, name, encoding, total
        self._separator = _SEPARATOR_NAMES.get(separator or "", separator)
        if self._separator is not None and (
            len(self._separator) != 1 or self._separator in '"\r\n'
        ):
            raise OptionError(
                f"--separator is {separator!r}; expected one character, or one of "
                f"{', '.join(_SEPARATOR_NAMES)}."
            )
        try:
            is_usable = b"1,\n".decode(encoding) == "1,\n"  # lines are split before decoding
        except (LookupError, UnicodeError):
            is_usable = False
        if not is_usable:
            raise OptionError(
                f"--encoding is {encoding!r}; expected one that contains ASCII, such as utf-8, "
                "latin-1 or cp1252."
            )
        self.position = self.line = 0
        self.close: Callable[[], None] = stream.close
        self._lines = filter(str.strip, islice(self._read_lines(), skip_lines, None))
        text = next(self._lines, None)
        note = re.fullmatch(r"\s*sep=(.)\s*", text or "", re.IGNORECASE)
        if note:  # a spreadsheet writes its separator above the header
            self._separator = self._separator or note[1]
            text = next(self._lines, None)
        if text is None:
            below = f" below the {skip_lines} lines that --skip-lines skips" if skip_lines else ""
            raise RecordError(
                f"it is empty{below}; expected a header with the columns' names.", name
            )
        if self._separator is None:  # the first that separates anything
            self._separator = next((mark for mark in _SEPARATORS if mark in text), ",")
        self.header = self._split(text)
        self.header_line = self.line
        if all(map(_is_number, self.header)):
            raise RecordError(
                "it begins with numbers; expected a header with the columns' names above them.",
                name, self.line,
            )
        word = _SEPARATORS.get(self._separator, repr(self._separator))
        #: What an error of the columns adds.
        self.hint = (
            f" The separator is taken to be {word}; choose another one with --separator. Skip "
            "lines above the header with --skip-lines N, and delete comments."
        )

    def __iter__(self) -> Iterator[TableRow]:
        width = len(self.header)
        for text in self._lines:
            fields, ended = self._split(text), text.endswith(("\n", "\r"))
            if len(fields) != width:
                fields = self._fitted(fields, ended)
            yield TableRow(self.line, fields, ended)

    def _read_lines(self) -> Iterator[str]:
        while True:
            try:
                raw = self._stream.readline()
            except (OSError, EOFError, zlib.error) as error:
                raise RecordError(
                    f"it cannot be read any further ({getattr(error, 'strerror', None) or error}).",
                    self.name, self.line + 1,
                ) from error
            if not raw:
                return
            self.line += 1
            self.position += len(raw)
            if self.line == 1:
                if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
                    raise RecordError("it is in UTF-16; save it as UTF-8.", self.name)
                raw = raw.removeprefix(b"\xef\xbb\xbf")
            try:
                yield raw.decode(self._encoding)
            except UnicodeDecodeError as error:
                raise RecordError(
                    f"byte {error.start + 1} of the line is not {self._encoding}; save the "
                    "record as UTF-8, or give --encoding (cp1252 is usual in Western Europe).",
                    self.name, self.line,
                ) from None

    def _split(self, text: str) -> list[str]:
        assert self._separator is not None
        try:
            return next(csv.reader([text], delimiter=self._separator, strict=True), [""])
        except csv.Error as error:
            raise RecordError(
                f"it cannot be split into fields ({error}); close quotation marks on the line "
                "where they open, and end lines in LF or CR LF.", self.name, self.line,
            ) from error

    def _fitted(self, fields: list[str], ended: bool) -> list[str]:
        """The fields of a line that has more or fewer than the header."""
        width, found = len(self.header), len(fields)
        if found > width and not "".join(fields[width:]).strip():
            return fields[:width]
        if not ended and found < width:
            raise RecordError(
                f"the last line is cut off: it has {found} of {width} fields and no end of line. "
                "Complete or delete it.", self.name, self.line,
            )
        remedy = "correct the line, or delete it if it is a comment."
        if self._separator == "," and found > width:
            remedy = (
                "correct the line; numbers with decimal commas need quotation marks or another "
                "separator."
            )
        raise RecordError(
            f"it has {found} field{'s' if found > 1 else ''}, and the header {width}; {remedy}",
            self.name, self.line,
        )


class ParquetTable:
    """The columns of a Parquet file, read batch by batch."""

    unit = "row"
    header_line = None
    hint = ""

    def __init__(self, name: str) -> None:
        self._arrow = need("pyarrow", "a Parquet file")
        parquet = need("pyarrow.parquet", "a Parquet file")
        self.name, self.position = name, 0
        try:
            self._file = parquet.ParquetFile(name)
        except (self._arrow.ArrowException, OSError) as error:
            raise RecordError(f"it cannot be read as Parquet ({_first_line(error)}).", name) from (
                error
            )
        self.close: Callable[[], None] = self._file.close
        self.types = self._file.schema_arrow.types
        self.header: list[str] = list(self._file.schema_arrow.names)
        self.total = int(self._file.metadata.num_rows)

    def __iter__(self) -> Iterator[TableRow]:
        batches = self._file.iter_batches(batch_size=_BATCH)
        while True:
            try:
                columns = [self._texts(column) for column in next(batches).columns]
            except StopIteration:
                return
            except (self._arrow.ArrowException, OSError, ValueError) as error:
                raise RecordError(
                    f"it cannot be read any further ({_first_line(error)}).", self.name,
                    self.position + 1, unit=self.unit,
                ) from error
            for values in zip(*columns, strict=True):
                self.position += 1
                yield TableRow(self.position, list(values), True)

    def _texts(self, column: Any) -> list[str]:
        """Values as a CSV file would have them; all digits of floats, nanoseconds of dates."""
        if self._arrow.types.is_timestamp(column.type):
            column = column.cast(self._arrow.string())
        elif self._arrow.types.is_boolean(column.type):
            column = column.cast(self._arrow.int8())
        return ["" if value is None else str(value) for value in column.to_pylist()]


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return not field.strip()
    return True


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0].rstrip(".")
