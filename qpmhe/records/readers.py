"""Which function reads which file: one table by the end of its name, CSV if it is none of these."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import stat
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from numbers import Real
from pathlib import Path
from typing import Any, Self

from qpmhe_solvers.errors import report_unknown_options
from qpmhe_solvers.values import shown

from .._checks import choice, count, flag, positive
from ..errors import OptionError
from .channels import Channels, ChannelTable
from .formats import read_bag, read_hdf5, read_mat, read_mdf
from .tables import (
    SEPARATORS,
    CsvTable,
    JsonTable,
    LineTable,
    ParquetTable,
    RecordError,
    Table,
)

#: By the end of a file's name: a function of the file, and which options it takes besides: the
#: name of the time, and whether the log's times are wanted. A folder is a ROS 2 bag.
READERS: dict[str, tuple[Callable[..., Channels], str | None]] = {
    **dict.fromkeys((".mf4", ".mdf"), (read_mdf, None)),
    ".mat": (read_mat, "time"),
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), (read_hdf5, "time")),
    **dict.fromkeys((".mcap", ".db3", ".bag", "folder"), (read_bag, "log_time")),
}

#: What a stream may be; ``auto`` is CSV.
FORMATS = ("auto", "csv", "jsonl")

_GZIP, _PARQUET = b"\x1f\x8b", b"PAR1"
_ZCAT = "give '{} FILE | qpmhe estimate MODEL -', or compress it by gzip, which qpmhe reads."
_RENAME = "it is {} file, which cannot be read line by line; name the file, in {}."
_UNREADABLE = {
    _PARQUET: "it is a Parquet file, which cannot be read line by line; name the file instead.",
    b"PK\x03\x04": "it is a zip archive or a spreadsheet; save it as CSV.",
    b"BZh": f"it is compressed by bzip2; {_ZCAT.format('bzcat')}",
    b"\xfd7zXZ": f"it is compressed by xz; {_ZCAT.format('xzcat')}",
    b"\x28\xb5\x2f\xfd": f"it is compressed by zstd; {_ZCAT.format('zstdcat')}",
    b"MDF ": _RENAME.format("an MDF", ".mf4"),
    b"MATLAB": _RENAME.format("a MAT", ".mat"),
    b"\x89HDF": _RENAME.format("an HDF5", ".h5, or in .mat if MATLAB wrote it"),
    b"\x89MCAP": _RENAME.format("an MCAP", ".mcap"),
    b"SQLite": _RENAME.format("an SQLite", ".db3 if it is a ROS 2 bag"),
}


@report_unknown_options
@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """How a record is read, where it does not show this itself.

    Parameters
    ----------
    separator : str, optional
        Of a CSV file: one character, or its name. If left out, the header shows it.
    decimal : {"auto", ".", ","}
        Decimal mark of a CSV file; "auto" is the first one in it.
    encoding : str
        Of a CSV file.
    missing : str or sequence of str
        Words (or numbers) that stand for a missing value, besides the usual ones.
    skip_lines : int
        Lines of a CSV file above its header.
    skip_repeated : bool
        Whether to skip lines whose time repeats the line before.
    time_format : str, optional
        Form of the dates, as for `datetime.datetime.strptime`; if left out, ISO dates, and those
        with dots and the day first.
    same_time : float, optional
        Times of several channels that differ by at most this belong to one sample, which has
        the earliest of them; in s, or the file's unit. By default 1e-6 of the shortest mean step:
        only times that differ by rounding are equal.
    log_time : bool
        Of ROS bags, take the times of the log instead of ``header.stamp``. Messages without a
        stamp, or a zero one, have the log's in any case.
    format : {"auto", "csv", "jsonl"}
        Lines on standard input: CSV, or a JSON object each. In JSON, a column that is named may be
        missing in any line, the first one included; it is missing there.

    Raises
    ------
    OptionError
        If an option has another form. It names the option as the command line does.
    """

    separator: str | None = None
    decimal: str = "auto"
    encoding: str = "utf-8"
    missing: Sequence[str | float] = ()
    skip_lines: int = 0
    skip_repeated: bool = False
    time_format: str | None = None
    same_time: float | None = None
    log_time: bool = False
    format: str = "auto"

    def __post_init__(self) -> None:
        mark: Any = SEPARATORS.get(str(self.separator), self.separator)
        if mark is not None and (
            not isinstance(mark, str) or len(mark) != 1 or mark in '"\r\n'
        ):
            raise OptionError(
                f"--separator is {shown(mark)}; expected one character, or one of "
                f"{', '.join(SEPARATORS)}."
            )
        if not (self.time_format is None or isinstance(self.time_format, str)):
            raise OptionError(
                f"--time-format is {shown(self.time_format)}; expected a string, such as "
                "'%d/%m/%Y'."
            )
        try:
            is_usable = b"1,\n".decode(self.encoding) == "1,\n"  # lines are split before decoding
        except (LookupError, TypeError, ValueError):
            is_usable = False
        if not is_usable:
            raise OptionError(
                f"--encoding is {shown(self.encoding)}; expected one that contains ASCII, such as "
                "utf-8, latin-1 or cp1252."
            )
        choice("--decimal", self.decimal, ("auto", ".", ","))
        choice("--format", self.format, FORMATS)
        count("--skip-lines", self.skip_lines, 0)
        flag("--skip-repeated", self.skip_repeated)
        flag("--log-time", self.log_time)
        if self.same_time is not None:
            positive("--same-time", self.same_time)
        words: Any = self.missing
        words = words if isinstance(words, (list, tuple)) else (words,)
        if not all(isinstance(one, str | Real) and str(one).strip() for one in words):
            raise OptionError(
                f"--missing is {shown(self.missing)}; expected words, or numbers. Blank fields are "
                "missing in any case."
            )
        object.__setattr__(self, "missing", tuple(map(str, words)))

    @classmethod
    def taken_from(cls, options: dict[str, Any]) -> Self:
        """Take these options out of others."""
        names = [one.name for one in fields(cls) if one.name in options]
        return cls(**{name: options.pop(name) for name in names})


def open_table(record: str, time: str | None, reading: ReadingOptions) -> Table:
    """Open a record, a file or ``-`` for standard input; its name or first bytes show its kind."""
    separator, encoding, skip_lines = reading.separator, reading.encoding, reading.skip_lines
    piped = record == "-"
    name = "standard input" if piped else record
    if piped and sys.stdin is None:
        raise RecordError("it is closed; pipe a record into it, or name a file.", name)
    if os.path.isdir(record) and not is_bag(record):
        raise RecordError(
            "it is a folder and has no metadata.yaml; name a file. Of a ROS 2 bag, name the .mcap "
            f"or .db3 file in it, or run 'ros2 bag reindex {record}'.", name,
        )
    ending = "folder" if is_bag(record) else Path(record).suffix.lower()
    reader, option = READERS.get(ending, (None, None))
    options = {option: time if option == "time" else reading.log_time} if option else {}
    with contextlib.ExitStack() as opened:
        try:
            if reader is not None and ending == "folder":
                return ChannelTable(name, reader(record, **options), reading.same_time)
            stream: Any = sys.stdin.buffer if piped else opened.enter_context(open(record, "rb"))
            if not hasattr(stream, "peek"):
                stream = io.BufferedReader(stream)
            head, total = stream.peek(6)[:6], None
            if not piped and stat.S_ISREG((status := os.fstat(stream.fileno())).st_mode):
                total = status.st_size
        except OSError as error:
            raise RecordError(f"it cannot be read ({error.strerror or error}).", name) from error
        is_parquet = head.startswith(_PARQUET) or record.lower().endswith((".parquet", ".pq"))
        if total is not None and (reader is not None or is_parquet):
            if skip_lines:
                what = "a Parquet file" if reader is None else f"a file in {ending}"
                raise OptionError(
                    f"--skip-lines is {skip_lines}, but {name} is {what}, which has no lines; "
                    "leave it out."
                )
            if reader is None:
                return ParquetTable(name)
            return ChannelTable(name, reader(record, **options), reading.same_time)
        for magic, remedy in _UNREADABLE.items():
            if head.startswith(magic):
                raise RecordError(remedy, name)
        if head.startswith(_GZIP):
            stream, total = gzip.GzipFile(fileobj=stream), None
        table: LineTable
        if is_json(record, reading.format):
            table = JsonTable(stream, name, encoding, total, skip_lines)
        else:
            table = CsvTable(stream, name, separator, encoding, total, skip_lines)
        table.close = opened.pop_all().close
        return table


def is_json(name: str, kind: str) -> bool:
    """Whether a file, or a stream of this kind, has JSON lines."""
    plain = name.lower().removesuffix(".gz")
    return kind == "jsonl" if name == "-" else plain.endswith((".jsonl", ".ndjson"))


def is_bag(record: str) -> bool:
    """Whether it is the folder of a ROS 2 bag."""
    return os.path.isfile(os.path.join(record, "metadata.yaml"))
