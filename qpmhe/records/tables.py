"""Tables read row by row: CSV text or Parquet."""

from __future__ import annotations

import csv
import json
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime
from difflib import SequenceMatcher
from itertools import chain, islice
from time import perf_counter
from typing import Any, BinaryIO, NamedTuple

from .._checks import need
from ..errors import InvalidInputError

# Before the comma, which occurs within names and numbers, too.
_SEPARATORS = {"\t": "tab", ";": "semicolon", "|": "bar", ",": "comma"}
#: Separators by their names.
SEPARATORS = {name: mark for mark, name in _SEPARATORS.items()} | {"space": " "}
_BATCH = 4096

#: Usual names of the time, in small letters.
TIMES = ("time", "t", "timestamp", "datetime", "date_time", "zeit", "zeitstempel")


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


class Table:
    """What all tables share: a header, and rows below it.

    ``unit`` says what a row is called, ``hint`` what an error about the columns adds, ``notes``
    what the user should know of the file once it is read, ``arrived`` the time of `perf_counter`
    at which the newest row came in, 0 where rows do not come one by one.
    """

    unit = "line"
    header: list[str]
    header_line: int | None = None
    total: int | None = None
    types: Any = None
    hint = ""
    #: Whether the first column is the time, which channels with clocks of their own share.
    has_clocks = False
    close: Callable[[], None]
    arrived = 0.0

    def __init__(self, name: str) -> None:
        self.name, self.position = name, 0
        self.notes: list[str] = []

    def __iter__(self) -> Iterator[TableRow]:
        raise NotImplementedError

    def select(self, columns: Sequence[int], held: Sequence[int]) -> dict[int, int]:
        """The positions in a row of the columns that are needed; some hold their last value."""
        return {i: i for i in range(len(self.header))}

    @property
    def units(self) -> list[str] | None:
        """Units of the columns where they stand apart from the names, which are paths then."""
        return None

    @property
    def start(self) -> datetime | None:
        """The date of time 0, where the file states it."""
        return None

    def expect(self, name: str) -> int | None:
        """The position of a column that may come later, None where none can."""
        return None


class LineTable(Table):
    """Lines of text, each available as soon as it arrives."""

    def __init__(
        self, stream: BinaryIO, name: str, encoding: str, total: int | None, skip_lines: int
    ) -> None:
        super().__init__(name)
        self._stream, self._encoding, self.total = stream, encoding, total
        self.line = 0
        self.close = stream.close
        self._lines = filter(str.strip, islice(self._read_lines(), skip_lines, None))

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
            self.arrived = perf_counter()
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

class CsvTable(LineTable):
    """Fields between separators, below a header."""

    def __init__(
        self, stream: BinaryIO, name: str, separator: str | None, encoding: str, total: int | None,
        skip_lines: int = 0,
    ) -> None:
        super().__init__(stream, name, encoding, total, skip_lines)
        self._separator = SEPARATORS.get(separator or "", separator)
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


class JsonTable(LineTable):
    """A JSON object on each line; the first one names the columns, those that are named may follow.

    Fields of objects in objects are ``a.b``, items of lists ``a[0]``.
    """

    hint = (
        " The first line has these; a column that comes later needs its name in --outputs or "
        "--inputs. Of objects within objects, it is outer.inner, of lists name[0]."
    )

    def __init__(
        self, stream: BinaryIO, name: str, encoding: str, total: int | None, skip_lines: int = 0
    ) -> None:
        super().__init__(stream, name, encoding, total, skip_lines)
        first = next(self._lines, None)
        if first is None:
            raise RecordError("it is empty; expected a JSON object on each line.", name)
        self._first = first, self.line
        self.header = list(self._parsed(first))
        self.header_line = self.line
        self._expected: set[str] = set()

    @property
    def units(self) -> list[str]:
        """Blank for each column."""
        return [""] * len(self.header)

    def expect(self, name: str) -> int:
        """A column that the first line does not have."""
        if name not in self.header:
            self.header.append(name)
            self._expected.add(name)
        return self.header.index(name)

    def __iter__(self) -> Iterator[TableRow]:
        for text in chain((self._first[0],), self._lines):
            found = self._parsed(text)
            if self._expected:
                self._expected -= found.keys()
            yield TableRow(
                self.line, [found.get(name, "") for name in self.header],
                text.endswith(("\n", "\r")),
            )
        self.notes += [f"no line of {self.name} has {name!r}." for name in sorted(self._expected)]

    def _parsed(self, text: str) -> dict[str, str]:
        try:
            content = json.loads(text, parse_float=str, parse_int=str, parse_constant=str)
        except (ValueError, RecursionError) as error:
            is_ended = text.endswith(("\n", "\r"))
            cut = "" if is_ended else " The last line has no end, and may be cut off."
            raise RecordError(
                f"it is no JSON ({first_line(error)}); expected an object on each line.{cut}",
                self.name, self.line,
            ) from None
        if not isinstance(content, dict):
            raise RecordError(
                f"it is {text.strip()[:40]!r}; expected a JSON object, such as "
                '{"time": 0.1, "y": 2.5}.', self.name, self.line,
            )
        return dict(_flat("", content))


def _flat(name: str, value: Any) -> Iterator[tuple[str, str]]:
    """Names and values as a CSV file would have them."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flat(f"{name}.{key}" if name else key, item)
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _flat(f"{name}[{k}]", item)
    else:
        yield name, "" if value is None else str(int(value)) if isinstance(value, bool) else value


class ParquetTable(Table):
    """The columns of a Parquet file, read batch by batch."""

    unit = "row"

    def __init__(self, name: str) -> None:
        self._arrow = need("pyarrow", "a Parquet file")
        parquet = need("pyarrow.parquet", "a Parquet file")
        super().__init__(name)
        try:
            self._file = parquet.ParquetFile(name)
        except (self._arrow.ArrowException, OSError) as error:
            raise RecordError(f"it cannot be read as Parquet ({first_line(error)}).", name) from (
                error
            )
        self.close = self._file.close
        self.types = self._file.schema_arrow.types
        self.header = list(self._file.schema_arrow.names)
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
                    f"it cannot be read any further ({first_line(error)}).", self.name,
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


def first_line(error: BaseException) -> str:
    """What an exception says, on one line."""
    return str(error).partition("\n")[0].rstrip(".")


def nearest_first(names: Iterable[str], wanted: str) -> list[str]:
    """The names, those most like the wanted one first."""
    return sorted(names, key=lambda name: (
        -SequenceMatcher(None, name.lower(), wanted.lower()).ratio(), name))
