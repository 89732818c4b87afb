"""Tables read row by row: CSV text, gzip of it, or Parquet."""

from __future__ import annotations

import contextlib
import csv
import gzip
import io
import itertools
import math
import os
import re
import stat
import sys
import zlib
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

from .._checks import need
from ..errors import InvalidInputError, OptionError

# Before the comma, which occurs within names and numbers, too.
_SEPARATORS = {"\t": "tab", ";": "semicolon", "|": "bar", ",": "comma"}
_SEPARATOR_NAMES = {name: mark for mark, name in _SEPARATORS.items()} | {"space": " "}
# A quotation mark that is never closed must not swallow the record, nor keep a pipe waiting.
_LINES_PER_ROW = 20
# A header is looked for below so many lines.
_PREAMBLE = 50
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

    ``what`` is wrong, and what to do about it; ``unit`` is ``line``, or ``row`` of a Parquet file.
    """

    def __init__(
        self, what: str, file: str, line: int | None = None, column: str | None = None,
        unit: str = "line",
    ) -> None:
        place = file if line is None else f"{file}, {unit} {line}"
        super().__init__(f"{place}{'' if column is None else f', column {column!r}'}: {what}")
        self.file, self.line, self.column = file, line, column


class Row(NamedTuple):
    """A line number, a field for each column, and whether the line has an end."""

    line: int
    fields: list[str]
    ended: bool


def open_table(record: str, separator: str | None, encoding: str) -> CsvTable | ParquetTable:
    """Open a record, a file or ``-`` for standard input, as the kind that its first bytes say."""
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
            return ParquetTable(name)
        for magic, remedy in _UNREADABLE.items():
            if head.startswith(magic):
                raise RecordError(remedy, name)
        if head.startswith(_GZIP):
            stream, total = gzip.GzipFile(fileobj=stream), None
        table = CsvTable(stream, name, separator, encoding, total)
        table.close = opened.pop_all().close
        return table


class CsvTable:
    """A header, and rows below it, each available as soon as its line is there."""

    unit = "line"

    def __init__(
        self, stream: BinaryIO, name: str, separator: str | None, encoding: str, total: int | None
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
        self._row_begins: float = math.inf
        self._ended = True
        self._lines = self._read_lines()
        text = next(filter(str.strip, self._lines), None)
        note = re.fullmatch(r"\s*sep=(.)\s*", text or "", re.IGNORECASE)
        if note:  # a spreadsheet writes its separator above the header
            self._separator = self._separator or note[1]
            text = next(filter(str.strip, self._lines), None)
        if text is None:
            raise RecordError("it is empty; expected a header with the columns' names.", name)
        if "\r" in text.rstrip("\r\n"):
            raise RecordError(
                "its lines end in CR alone; convert them to LF, as by tr '\\r' '\\n'.", name
            )
        self._separator, self.header = self._split_header(text)
        self.header_line = self.line
        if all(map(_is_number, self.header)):
            raise RecordError(
                "it begins with numbers; expected a header with the columns' names above them.",
                name, self.line,
            )

    def __iter__(self) -> Iterator[Row]:
        assert self._separator is not None
        reader = csv.reader(self._lines, delimiter=self._separator, strict=True)
        width = len(self.header)
        while True:
            self._row_begins = line = self.line + 1
            try:
                fields = next(reader)
            except StopIteration:
                return
            except csv.Error as error:
                raise self._unbalanced(error, line) from error
            if len(fields) != width:
                if len(fields) < 2 and not "".join(fields).strip():
                    continue
                fields = self._fitted(fields, line)
            yield Row(line, fields, self._ended)

    def explain(self, find: Callable[..., Any]) -> str:
        """What to add to an error of `find(header, file, line)`, which finds the columns."""
        word = _SEPARATORS.get(self._separator or "", repr(self._separator))
        hint = f" The separator is taken to be {word}; choose another one by --separator."
        if self.name != "standard input":  # a pipe would keep waiting
            for text in itertools.islice(self._lines, _PREAMBLE):
                try:
                    find(self._split_header(text)[1], self.name, self.line)
                except RecordError:
                    continue
                return f"{hint} Line {self.line} looks like the header; delete the lines above it."
        if _is_comment(self.header):
            return f"{hint} Comments above the header are not supported; delete them."
        return hint

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
            if self.line - self._row_begins > _LINES_PER_ROW:
                raise self._unbalanced(
                    f"a field has more than {_LINES_PER_ROW} lines", int(self._row_begins)
                )
            try:
                text = raw.decode(self._encoding)
            except UnicodeDecodeError as error:
                raise RecordError(
                    f"byte {error.start + 1} of the line is not {self._encoding}; save the "
                    "record as UTF-8, or give --encoding (cp1252 is usual in Western Europe).",
                    self.name, self.line,
                ) from None
            self._ended = text.endswith(("\n", "\r"))
            yield text

    def _split_header(self, text: str) -> tuple[str, list[str]]:
        """The separator and the names; the separator is the first that separates anything."""
        marks = list(_SEPARATORS) if self._separator is None else [self._separator]
        mark = next((mark for mark in marks if mark in text), self._separator or ",")
        return mark, self._split(text.rstrip("\r\n"), mark)

    def _split(self, text: str, separator: str) -> list[str]:
        try:
            return next(csv.reader([text], delimiter=separator, strict=True), [""])
        except csv.Error as error:
            raise self._unbalanced(error, self.line) from error

    def _unbalanced(self, reason: Any, line: int) -> RecordError:
        return RecordError(
            f"its quotation marks are not balanced ({reason}); close each one that is open.",
            self.name, line,
        )

    def _fitted(self, fields: list[str], line: int) -> list[str]:
        """The fields of a line that has more or fewer than the header."""
        width, found = len(self.header), len(fields)
        if found > width and not "".join(fields[width:]).strip():
            return fields[:width]
        if not self._ended and found < width:
            raise RecordError(
                f"the last line is cut off: it has {found} of {width} fields and no end of line. "
                "Complete or delete it.", self.name, line,
            )
        what = f"it has {found} field{'s' if found > 1 else ''}, and the header {width}; "
        remedy = "correct the line."
        if _is_comment(fields):
            remedy = "comments are not supported; delete such lines."
        elif self._separator == "," and found > width:
            remedy = (
                "correct the line; numbers with decimal commas need quotation marks or another "
                "separator."
            )
        raise RecordError(what + remedy, self.name, line)


class ParquetTable:
    """The columns of a Parquet file, read batch by batch."""

    unit = "row"
    header_line = None

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

    def __iter__(self) -> Iterator[Row]:
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
                yield Row(self.position, list(values), True)

    def explain(self, find: Callable[..., Any]) -> str:
        """Nothing to add: a Parquet file has its columns in one place."""
        return ""

    def _texts(self, column: Any) -> list[str]:
        """Values as a CSV file would have them; all digits of floats, nanoseconds of dates."""
        if self._arrow.types.is_timestamp(column.type):
            column = column.cast(self._arrow.string())
        elif self._arrow.types.is_boolean(column.type):
            column = column.cast(self._arrow.int8())
        return ["" if value is None else str(value) for value in column.to_pylist()]


def _is_comment(fields: list[str]) -> bool:
    return fields[0].lstrip().startswith(("#", "//", "%"))


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return not field.strip()
    return True


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0].rstrip(".")
