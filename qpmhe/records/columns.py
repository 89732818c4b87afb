"""Which columns of a record hold time, outputs and inputs."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass

from ..errors import OptionError
from .errors import RecordError

__all__ = ["Columns", "Wanted", "pairs"]

_TIMES = ("time", "t", "timestamp", "datetime", "date_time")
# "Voltage (V)", "Voltage [V]", "Voltage / V"
_UNIT = re.compile(r"\s*(\([^()]*\)|\[[^\[\]]*\]|/\s*\S+)$")

# So many names are shown, and so much of each.
_MOST, _LONG = 40, 60


@dataclass(frozen=True)
class Columns:
    """Positions in a row.

    Parameters
    ----------
    time : int
        Of the time.
    outputs, inputs : tuple of int
        Of y and u; -1 for an output that the record does not have.
    """

    time: int
    outputs: tuple[int, ...]
    inputs: tuple[int, ...]


@dataclass(frozen=True)
class Wanted:
    """What is looked for, by which names.

    Parameters
    ----------
    outputs, inputs : tuple of str
        The model's names of y and u.
    time : str, optional
        Name of the time's column.
    output_columns, input_columns : str, optional
        ``name=column`` or columns in order, between commas.
    """

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    time: str | None = None
    output_columns: str | None = None
    input_columns: str | None = None

    def find(self, header: Sequence[str], file: str, line: int | None = None) -> Columns:
        """Find the columns.

        Parameters
        ----------
        header : sequence of str
            Names of the record's columns.
        file : str
            The record, for error texts.
        line : int, optional
            Line of the header.

        Raises
        ------
        RecordError
            If a column is not there, or is there twice.
        OptionError
            If an option names an output or input that the model does not have, or the time
        would be one, too.
        """
        table = _Header(header, file, line)
        if self.time is not None:
            time = table.exactly(self.time, "the time", "name it by --time.")
        else:
            time = table.guess(_TIMES, "the time", "name it by --time COLUMN.")
        outputs = self._find(table, "outputs", "y", self.outputs, self.output_columns)
        inputs = self._find(table, "inputs", "u", self.inputs, self.input_columns)
        if all(position < 0 for position in outputs):
            raise OptionError("--outputs leaves all outputs out; expected a column for one.")
        if time in (*outputs, *inputs):
            raise OptionError(
                f"column {header[time]!r} is taken for the time, and for an output or input as "
                "well; give each a column of its own by --time, --outputs and --inputs."
            )
        return Columns(time, outputs, inputs)

    @staticmethod
    def _find(
        table: _Header, option: str, letter: str, names: tuple[str, ...], given: str | None
    ) -> tuple[int, ...]:
        chosen = pairs(option, given, letter, names)
        found = []
        for i, name in enumerate(names):
            what = f"{option[:-1]} {name!r}"
            remedy = f"name it by --{option} {letter}{i + 1}=COLUMN."
            if i in chosen:
                column = chosen[i]
                if not column and option == "inputs":
                    raise OptionError(f"--inputs gives no column for {name!r}; inputs are needed.")
                found.append(table.exactly(column, what, remedy) if column else -1)
                continue
            guesses = [name, f"{letter}{i + 1}", f"{letter}_{i + 1}"]
            if option == "outputs":
                remedy = f"{remedy[:-1]}, or leave it out by --outputs {letter}{i + 1}= for good."
            found.append(
                table.guess([*guesses, letter] if len(names) == 1 else guesses, what, remedy)
            )
        return tuple(found)


class _Header:
    def __init__(self, header: Sequence[str], file: str, line: int | None) -> None:
        self._names, self._file, self._line = [name.strip() for name in header], file, line

    def _fail(self, what: str) -> RecordError:
        return RecordError(what, self._file, self._line)

    def exactly(self, name: str, what: str, remedy: str) -> int:
        """The column of this very name, or of this name but for case."""
        for found in (
            [i for i, one in enumerate(self._names) if one == name],
            [i for i, one in enumerate(self._names) if one.lower() == name.lower()],
        ):
            if len(found) == 1:
                return found[0]
            if found:
                raise self._fail(f"there are {len(found)} columns {name!r}; rename all but one.")
        raise self._missing(f"column {name!r} for {what}", remedy)

    def guess(self, names: Sequence[str], what: str, remedy: str) -> int:
        """The column of the first of these names; units behind a name are passed over."""
        bare = [_UNIT.sub("", one).lower() for one in self._names]
        for name in names:
            if name in self._names or name.lower() in [one.lower() for one in self._names]:
                return self.exactly(name, what, remedy)
            found = [i for i, one in enumerate(bare) if one == name.lower()]
            if len(found) == 1:
                return found[0]
            if found:
                same = ", ".join(repr(self._names[i]) for i in found)
                raise self._fail(f"{same} could all be {what}; {remedy}")
        tried = ", ".join(repr(name) for name in dict.fromkeys(names))
        raise self._missing(f"column for {what} (looked for {tried})", remedy)

    def _missing(self, what: str, remedy: str) -> RecordError:
        there = ", ".join(repr(_short(name)) for name in self._names[:_MOST])
        if len(self._names) > _MOST:
            there += f" and {len(self._names) - _MOST} more"
        return self._fail(f"there is no {what}; the columns are {there}. If it is one of them, "
                          f"{remedy}")


def _short(name: str) -> str:
    return name if len(name) <= _LONG else f"{name[:_LONG]}..."


def pairs(option: str, text: str | None, letter: str, names: tuple[str, ...]) -> dict[int, str]:
    """Read ``y1=column,y2=column`` or ``column,column``: the column of each index.

    Parameters
    ----------
    option : str
        ``outputs`` or ``inputs``, for error texts.
    text : str or None
        What was given; columns that have commas stand in quotation marks.
    letter : str
        ``y`` or ``u``.
    names : tuple of str
        The model's names.

    Raises
    ------
    OptionError
        If a name is not the model's, or stands twice, or the number does not fit.
    """
    if text is None:
        return {}
    indices = {f"{letter}{i + 1}": i for i in range(len(names))}
    if len(names) == 1:
        indices[letter] = 0
    indices |= {name: i for i, name in enumerate(names)}
    known = ", ".join(indices) or "none: the model has no " + option
    items = [item.strip() for item in next(csv.reader([text], skipinitialspace=True), [])]
    plain = [item for item in items if item.partition("=")[0].strip() not in indices]
    if plain and len(plain) == len(items) == len(names):
        return dict(enumerate(items))
    found: dict[int, str] = {}
    for item in items:
        name, equals, column = (part.strip() for part in item.partition("="))
        if not equals or name not in indices:
            raise OptionError(
                f"--{option} has {item!r}; expected NAME=COLUMN between commas with a name of "
                f"{known}, or {len(names)} columns in order."
            )
        if indices[name] in found:
            raise OptionError(f"--{option} gives {name!r} twice; give it once.")
        found[indices[name]] = column
    return found
