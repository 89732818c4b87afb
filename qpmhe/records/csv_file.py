"""Rows of a CSV file or stream, one at a time, as soon as they are there."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from ..errors import OptionError
from .errors import RecordError
from .numbers import Reader

__all__ = ["CsvFile", "Row"]

# Before the comma, which stands within names and numbers, too.
_SEPARATORS = {"\t": "tab", ";": "semicolon", "|": "bar", ",": "comma"}
_NAMES = {name: mark for mark, name in _SEPARATORS.items()} | {"space": " "}
_TOLD = re.compile(r"\s*sep=(.)\s*", re.IGNORECASE)
_WIDE = (b"\xff\xfe", b"\xfe\xff")


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
        if self._separator is None:
            counts = {mark: len(self._split(text, mark)) for mark in _SEPARATORS}
            self._separator = next((mark for mark, count in counts.items() if count > 1), ",")
        self.header = self._split(text, self._separator)
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
        while (line := self._next_line()) is not None:
            text, whole = line
            assert self._separator is not None
            fields = self._split(text, self._separator)
            if len(fields) != len(self.header):
                fields = self._fitted(text, fields, whole)
            yield Row(self._line, fields, whole)

    def _next_line(self) -> tuple[str, bool] | None:
        """The next line that is not blank, and whether it was ended."""
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
            if text.strip():
                return text.rstrip("\r\n"), text.endswith(("\n", "\r"))
        return None

    def _read(self) -> bytes:
        try:
            return self._stream.readline()
        except OSError as error:
            raise RecordError(
                f"cannot be read on ({error.strerror or error}).", self._name, self._line + 1
            ) from error

    def _split(self, text: str, separator: str) -> list[str]:
        if '"' not in text:
            return text.split(separator)
        try:
            # Line by line: one mark that is never closed must not swallow the record.
            return next(csv.reader([text], delimiter=separator, strict=True))
        except csv.Error as error:
            raise RecordError(
                f"its quotation marks do not fit ({error}); close each within its line.",
                self._name, self._line,
            ) from None

    def _fitted(self, text: str, fields: list[str], whole: bool) -> list[str]:
        """The fields of a line that has more or fewer than the header."""
        width, found = len(self.header), len(fields)
        if found > width and not any(field.strip() for field in fields[width:]):
            return fields[:width]
        if not whole and found < width:
            raise RecordError(
                f"the last line is cut off: it has {found} of {width} fields and no end. "
                "Complete or delete it.", self._name, self._line,
            )
        what = f"it has {found} field{'s' if found > 1 else ''}, and the header {width}; "
        assert self._separator is not None
        for mark, word in _SEPARATORS.items():
            if mark != self._separator and len(self._split(text, mark)) == width:
                usual = _SEPARATORS.get(self._separator, repr(self._separator))
                raise RecordError(
                    f"{what}this line is separated by {word}, the header by {usual}. Separate "
                    "all lines alike.", self._name, self._line,
                )
        remedy = "mend the line."
        if self._separator == "," and found > width:
            remedy = (
                "mend the line; numbers with decimal commas need quotation marks or another "
                "separator."
            )
        raise RecordError(what + remedy, self._name, self._line)


def _is_number(field: str) -> bool:
    try:
        Reader().number(field)
    except ValueError:
        return False
    return True
