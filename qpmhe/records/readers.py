"""Which function reads which file: one table by the end of its name, CSV if it is none of these."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .._checks import choice, positive
from ..errors import OptionError
from .channels import Channels, ChannelTable
from .formats import read_bag, read_hdf5, read_mat, read_mdf
from .tables import CsvTable, JsonTable, LineTable, ParquetTable, RecordError, Table

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


def open_table(
    record: str, separator: str | None = None, encoding: str = "utf-8", skip_lines: int = 0, *,
    time: str | None = None, same_time: float | None = None, log_time: bool = False,
    kind: str = "auto",
) -> Table:
    """Open a record, a file or ``-`` for standard input; its name or first bytes show its kind.

    On standard input, `kind` says whether JSON lines are expected.
    """
    choice("--format", kind, FORMATS)
    if same_time is not None:
        positive("--same-time", same_time)
    piped = record == "-"
    name = "standard input" if piped else record
    if piped and sys.stdin is None:
        raise RecordError("it is closed; pipe a record into it, or name a file.", name)
    ending = "folder" if is_bag(record) else Path(record).suffix.lower()
    reader, option = READERS.get(ending, (None, None))
    options = {option: time if option == "time" else log_time} if option else {}
    with contextlib.ExitStack() as opened:
        try:
            if reader is not None and ending == "folder":
                return ChannelTable(name, reader(record, **options), same_time)
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
            return ChannelTable(name, reader(record, **options), same_time)
        for magic, remedy in _UNREADABLE.items():
            if head.startswith(magic):
                raise RecordError(remedy, name)
        if head.startswith(_GZIP):
            stream, total = gzip.GzipFile(fileobj=stream), None
        table: LineTable
        if is_json(record, kind):
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
