"""Rows of a CSV file or stream, one at a time, as soon as they are there."""

from __future__ import annotations

import contextlib
import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from ..errors import OptionError
from .errors import RecordError
from .numbers import Reader
from .opening import BROKEN

__all__ = ["CsvFile", "Row"]

# Before the comma, which stands within names and numbers, too.
_SEPARATORS = {"\t": "tab", ";": "semicolon", "|": "bar", ",": "comma"}
_NAMES = {name: mark for mark, name in _SEPARATORS.items()} | {"space": " "}
_TOLD = re.compile(r"\s*sep=(.)\s*", re.IGNORECASE)
_WIDE = (b"\xff\xfe", b"\xfe\xff")
# A field in quotation marks may go on over so many lines, and no further: a mark that is never
# closed must not swallow the record, nor keep a pipe waiting.
_LINES = 20
# Above the header there may stand so many lines for it to be found, and named, below.
_PREAMBLE = 50


@dataclass(frozen=True)
class Row:
    """One row.

    Parameters
    ----------
    line : int
        Where it stands, counted from 1.
    fields : list of str
        One for each column of the header.
    whole : bool
        Whether the line was ended; the last one of a record that is still being written, or
        was cut off, is not.
    """

    line: int
    fields: list[str]
    whole: bool


class CsvFile:
    """A header, and rows below it.

    Parameters
    ----------
    stream : binary stream
        Read line by line.
    name : str
        What error texts call it.
    separator : str, optional
        A character, or ``tab``, ``semicolon``, ``bar``, ``comma``, ``space``; if left out,
        what separates the names of the header.
    encoding : str
        Of the text; a byte-order mark is passed over.

    Attributes
    ----------
    header : list of str
        Names of the columns.
    header_line : int
        Where they stand.
    position : int
        Bytes read so far.

    Raises
    ------
    RecordError
        If there is no header.
    OptionError
        If separator or encoding do not exist.
    """

    unit = "line"

    def __init__(
        self, stream: BinaryIO, name: str, separator: str | None = None,
        encoding: str = "utf-8",
    ) -> None:
        self._stream, self._name, self._encoding = stream, name, encoding
        self._separator = _NAMES.get(separator or "", separator)
        if self._separator is not None and (
            len(self._separator) != 1 or self._separator in '"\r\n'
        ):
            raise OptionError(
                f"--separator is {separator!r}; expected one character, or one of "
                f"{', '.join(_NAMES)}."
            )
        try:
            # Lines are told apart before they are decoded.
            usable = b"1,\n".decode(encoding) == "1,\n"
        except (LookupError, UnicodeError):
            usable = False
        if not usable:
            raise OptionError(
                f"--encoding is {encoding!r}; expected one that has ASCII in it, as utf-8, "
                "latin-1 and cp1252 do."
            )
        self._line = self.position = 0
        line = self._next_line()
        if line is None:
            raise RecordError("it is empty; expected a header with the columns' names.", name)
        text, _ = line
        told = _TOLD.fullmatch(text)
        if told:  # a spreadsheet's note for itself, above the header
            self._separator = self._separator or told[1]
            line = self._next_line()
            if line is None:
                raise RecordError("it has no header with the columns' names.", name)
            text, _ = line
        self.header_line = self._line
        if "\r" in text:
            raise RecordError(
                "its lines end in CR alone; turn these into LF, as by tr '\\r' '\\n'.", name,
            )
        self._separator, self.header = self._told_apart(text)
        if all(_is_number(field) for field in self.header):
            raise RecordError(
                "it begins with numbers; expected a header with the columns' names above them.",
                name, self._line,
            )

    @property
    def hint(self) -> str:
        """What to add where columns are not found."""
        mark = self._separator
        word = _SEPARATORS.get(mark or "", repr(mark))
        return f" Columns are taken to be separated by {word}; --separator says otherwise."

    def __iter__(self) -> Iterator[Row]:
        assert self._separator is not None
        while (line := self._next_line()) is not None:
            text, whole = line
            number = self._line
            try:
                fields = self._split(text, self._separator)
            except RecordError as error:
                joined = self._joined(text) if _is_open(error) else None
                if joined is None:
                    raise
                text, whole, fields = joined
            if len(fields) != len(self.header):
                fields = self._fitted(text, fields, whole, number)
            yield Row(number, fields, whole)

    def later_headers(self) -> Iterator[tuple[int, list[str]]]:
        """Fields of the next lines, where the first one turned out not to be the header."""
        for _ in range(_PREAMBLE):
            try:
                line = self._next_line()
                if line is None:
                    return
                fields = self._told_apart(line[0])[1]
            except RecordError:
                continue
            yield self._line, fields

    def _joined(self, text: str) -> tuple[str, bool, list[str]] | None:
        """A line with the next ones, up to where its quotation marks are closed."""
        assert self._separator is not None
        for _ in range(_LINES):
            line = self._next_line(blank=True)
            if line is None:
                return None
            text = f"{text}\n{line[0]}"
            with contextlib.suppress(csv.Error):
                return text, line[1], self._parsed(text, self._separator)
        return None

    def _told_apart(self, text: str) -> tuple[str, list[str]]:
        """The separator of a line of names, and these."""
        for mark in _SEPARATORS if self._separator is None else (self._separator,):
            names = self._split(text, mark)
            if len(names) > 1:
                return mark, names
        return self._separator or ",", self._split(text, self._separator or ",")

    def _next_line(self, blank: bool = False) -> tuple[str, bool] | None:
        """The next line (that is not blank, or any), and whether it was ended."""
        while raw := self._read():
            self._line += 1
            self.position += len(raw)
            if self._line == 1:
                if raw.startswith(_WIDE):
                    raise RecordError("it is in UTF-16; save it as UTF-8.", self._name)
                raw = raw.removeprefix(b"\xef\xbb\xbf")
            try:
                text = raw.decode(self._encoding)
            except UnicodeDecodeError as error:
                raise RecordError(
                    f"byte {error.start + 1} of the line is not {self._encoding}; save the "
                    "record as UTF-8, or give --encoding (cp1252 is usual in Western Europe).",
                    self._name, self._line,
                ) from None
            if blank or text.strip():
                return text.rstrip("\r\n"), text.endswith(("\n", "\r"))
        return None

    def _read(self) -> bytes:
        try:
            return self._stream.readline()
        except BROKEN as error:
            raise RecordError(
                f"cannot be read on ({getattr(error, 'strerror', None) or error}).",
                self._name, self._line + 1,
            ) from error

    def _split(self, text: str, separator: str) -> list[str]:
        if '"' not in text:
            return text.split(separator)
        try:
            return self._parsed(text, separator)
        except csv.Error as error:
            raise RecordError(
                f"its quotation marks do not fit ({error}); close each that is open.",
                self._name, self._line,
            ) from error

    @staticmethod
    def _parsed(text: str, separator: str) -> list[str]:
        return next(csv.reader([text], delimiter=separator, strict=True))

    def _fitted(self, text: str, fields: list[str], whole: bool, line: int) -> list[str]:
        """The fields of a line that has more or fewer than the header."""
        width, found = len(self.header), len(fields)
        if found > width and not any(field.strip() for field in fields[width:]):
            return fields[:width]
        if not whole and found < width:
            raise RecordError(
                f"the last line is cut off: it has {found} of {width} fields and no end. "
                "Complete or delete it.", self._name, line,
            )
        what = f"it has {found} field{'s' if found > 1 else ''}, and the header {width}; "
        assert self._separator is not None
        for mark, word in _SEPARATORS.items():
            if mark != self._separator and len(self._split(text, mark)) == width:
                usual = _SEPARATORS.get(self._separator, repr(self._separator))
                raise RecordError(
                    f"{what}this line is separated by {word}, the header by {usual}. Separate "
                    "all lines alike.", self._name, line,
                )
        remedy = "mend the line."
        if text.lstrip().startswith(("#", "//", "%")):
            remedy = "comments are not understood; delete such lines."
        if self._separator == "," and found > width:
            remedy = (
                "mend the line; numbers with decimal commas need quotation marks or another "
                "separator."
            )
        raise RecordError(what + remedy, self._name, line)


def _is_open(error: RecordError) -> bool:
    """Whether a field in quotation marks has not come to its end."""
    return "unexpected end" in str(error.__cause__)


def _is_number(field: str) -> bool:
    try:
        Reader().number(field)
    except ValueError:
        return False
    return True
