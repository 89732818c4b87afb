"""Which columns of a record hold time, outputs and inputs."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..errors import OptionError
from .tables import RecordError

__all__ = ["ColumnNames", "Columns"]

_TIMES = ("time", "t", "timestamp", "datetime", "date_time")
# "Voltage (V)", "Voltage [V]", "Voltage / V"
_UNIT = re.compile(r"\s*(\([^()]*\)|\[[^\[\]]*\]|/\s*\S+)$")
# An error shows so many names, and so much of each.
_NAMES_SHOWN, _LETTERS_SHOWN = 40, 60


class Columns(NamedTuple):
    """Positions in a row; -1 for an output that the record does not have."""

    time: int
    outputs: tuple[int, ...]
    inputs: tuple[int, ...]


@dataclass(frozen=True)
class ColumnNames:
    """The model's names of y and u, and the options --time, --outputs and --inputs."""

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    time: str | None = None
    output_columns: str | None = None
    input_columns: str | None = None

    def find(self, header: Sequence[str], file: str, line: int | None = None) -> Columns:
        """The columns in a header; RecordError where one is missing or ambiguous."""
        table = _Header([name.strip() for name in header], file, line)
        if self.time is not None:
            time = table.exactly(self.time, "the time", "name it by --time.")
        else:
            time = table.guess(_TIMES, "the time", "name it by --time COLUMN.")
        outputs = _find(table, "outputs", self.outputs, self.output_columns)
        inputs = _find(table, "inputs", self.inputs, self.input_columns)
        if all(position < 0 for position in outputs):
            raise OptionError("--outputs leaves all outputs out; expected a column for one.")
        if time in (*outputs, *inputs):
            raise OptionError(
                f"column {header[time]!r} is both the time and an output or input; choose a "
                "different column for each by --time, --outputs and --inputs."
            )
        return Columns(time, outputs, inputs)


def _find(
    table: _Header, option: str, names: tuple[str, ...], given: str | None
) -> tuple[int, ...]:
    letter = "y" if option == "outputs" else "u"
    chosen = _chosen(option, given, letter, names)
    found = []
    for i, name in enumerate(names):
        what = f"{option[:-1]} {name!r}"
        remedy = f"name it by --{option} {letter}{i + 1}=COLUMN."
        if i in chosen:
            if not chosen[i] and option == "inputs":
                raise OptionError(f"--inputs gives no column for {name!r}; inputs are needed.")
            found.append(table.exactly(chosen[i], what, remedy) if chosen[i] else -1)
            continue
        guesses = [name, f"{letter}{i + 1}", f"{letter}_{i + 1}"]
        if len(names) == 1:
            guesses.append(letter)
        if option == "outputs":
            remedy = f"{remedy[:-1]}, or leave it out by --outputs {letter}{i + 1}= (no column)."
        found.append(table.guess(guesses, what, remedy))
    return tuple(found)


@dataclass
class _Header:
    names: list[str]
    file: str
    line: int | None

    def exactly(self, name: str, what: str, remedy: str) -> int:
        """The column of this very name, or of this name but for case."""
        lower = [one.lower() for one in self.names]
        for names, wanted in ((self.names, name), (lower, name.lower())):
            if names.count(wanted) > 1:
                raise RecordError(
                    f"there are {names.count(wanted)} columns {name!r}; rename all but one.",
                    self.file, self.line,
                )
            if wanted in names:
                return names.index(wanted)
        raise self._missing(f"column {name!r} for {what}", remedy)

    def guess(self, names: Sequence[str], what: str, remedy: str) -> int:
        """The column of the first of these names; units behind a column's name do not count."""
        lower = [one.lower() for one in self.names]
        bare = [_UNIT.sub("", one) for one in lower]
        for name in names:
            if name.lower() in lower:
                return self.exactly(name, what, remedy)
            found = [i for i, one in enumerate(bare) if one == name.lower()]
            if len(found) == 1:
                return found[0]
            if found:
                same = ", ".join(repr(self.names[i]) for i in found)
                raise RecordError(f"{same} could all be {what}; {remedy}", self.file, self.line)
        tried = ", ".join(map(repr, dict.fromkeys(names)))
        raise self._missing(f"column for {what} (looked for {tried})", remedy)

    def _missing(self, what: str, remedy: str) -> RecordError:
        shown = ", ".join(
            repr(name if len(name) <= _LETTERS_SHOWN else f"{name[:_LETTERS_SHOWN]}...")
            for name in self.names[:_NAMES_SHOWN]
        )
        if len(self.names) > _NAMES_SHOWN:
            shown += f" and {len(self.names) - _NAMES_SHOWN} more"
        return RecordError(
            f"there is no {what}; the columns are {shown}. If it is one of them, {remedy}",
            self.file, self.line,
        )


def _chosen(
    option: str, text: str | None, letter: str, names: tuple[str, ...]
) -> dict[int, str]:
    """Read ``y1=column,y2=column`` or ``column,column``: the column of each index."""
    if text is None:
        return {}
    indices = {f"{letter}{i + 1}": i for i in range(len(names))}
    if len(names) == 1:
        indices[letter] = 0
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
                f"--{option} has {item!r}; expected NAME=COLUMN between commas with a name of "
                f"{known}, or {len(names)} columns in order."
            )
        if indices[name] in found:
            raise OptionError(f"--{option} gives {name!r} twice; give it once.")
        found[indices[name]] = column
    return found
