"""Where results go: a CSV file or standard output line by line, or a Parquet file at the end."""

from __future__ import annotations

import contextlib
import csv
import os
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, cast

from ..errors import InvalidInputError, OptionError
from ..studies.errors import need
from .errors import CheckpointError
from .numbers import Reader
from .results import COUNTS, TEXTS

__all__ = ["Sink"]

_ROWS = 20_000
_SPECIAL = re.compile('[,"\r\n]')


class Sink:
    """Rows to a file or standard output, each written whole and at once.

    A Parquet file cannot be continued: its rows are gathered in a CSV file beside it, of the
    same name with ``.part.csv`` behind, which `finish` turns into it.

    Parameters
    ----------
    out : str or Path
        A name in .csv or .parquet, or ``-`` for standard output.

    Attributes
    ----------
    path : Path or None
        The file that rows are written to; None for standard output.
    checkpoint : Path or None
        Where the checkpoint belongs.
    offset : int
        Bytes written so far, with those that stood there before.

    Raises
    ------
    OptionError
        If the name ends differently.
    """

    def __init__(self, out: str | Path) -> None:
        self.path: Path | None = None
        self.checkpoint: Path | None = None
        self.offset = 0
        self._target: Path | None = None
        self._stream: BinaryIO | None = None
        if str(out) == "-":
            self._stream = sys.stdout.buffer
            return
        path = Path(out)
        if path.suffix not in (".csv", ".parquet"):
            raise OptionError(
                f"--out is {str(out)!r}; expected a name in .csv or .parquet, or - for standard "
                "output."
            )
        self.path = self._target = path
        if path.suffix == ".parquet":
            need("pyarrow", "a Parquet file")
            self.path = path.with_name(f"{path.name}.part.csv")
        self.checkpoint = path.with_name(f"{path.name}.checkpoint")

    @property
    def name(self) -> str:
        """What texts call the place where rows are."""
        return "standard output" if self.path is None else str(self.path)

    def begin(self, header: Sequence[str], offset: int | None = None) -> None:
        """Open; write the header, or go on behind what was written before.

        Parameters
        ----------
        header : sequence of str
            The columns' names.
        offset : int, optional
            Bytes to keep of the file that is there; what stands behind is cut off.

        Raises
        ------
        CheckpointError
            If the file is shorter than that, or has another header.
        InvalidInputError
            If the file cannot be written.
        """
        if self.path is None:
            self.write(header)
            return
        try:
            if offset is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._stream = self.path.open("wb", buffering=0)
                self.write(header)
                return
            self._stream = stream = cast(BinaryIO, self.path.open("r+b", buffering=0))
            first = _line(header)
            if stream.seek(0, os.SEEK_END) < offset or offset < len(first):
                raise CheckpointError(
                    f"{self.path} is shorter than its checkpoint says; start again by "
                    "--overwrite."
                )
            stream.seek(0)
            if stream.read(len(first)) != first:
                raise CheckpointError(
                    f"{self.path} has other columns than its checkpoint says; start again by "
                    "--overwrite."
                )
            stream.seek(offset)
            stream.truncate()
            self.offset = offset
        except FileNotFoundError as error:
            raise CheckpointError(
                f"{self.path} is gone, and its checkpoint {self.checkpoint} is not; start again "
                "by --overwrite."
            ) from error
        except OSError as error:
            raise InvalidInputError(
                f"cannot write {self.path}: {error.strerror or error}."
            ) from error

    def time_behind(self, offset: int) -> str | None:
        """Time of the first row that stands behind a place in the file, if there is one.

        Parameters
        ----------
        offset : int
            The place.
        """
        assert self.path is not None
        try:
            with self.path.open("rb") as file:
                file.seek(offset)
                line = file.readline().decode()
        except OSError:  # `begin` tells
            return None
        return next(csv.reader([line]))[0] if line.endswith("\n") else None

    def write(self, fields: Sequence[str]) -> None:
        """Write a row, at once.

        Raises
        ------
        InvalidInputError
            If it cannot be written; the file still ends with a whole row.
        """
        stream, line = self._stream, _line(fields)
        assert stream is not None
        if self.path is None:
            stream.write(line)
            stream.flush()
            return
        try:
            done = 0
            while done < len(line):
                done += stream.write(line[done:])
        except OSError as error:
            with contextlib.suppress(OSError):
                stream.truncate(self.offset)
            raise InvalidInputError(
                f"cannot write {self.path}: {error.strerror or error}. Make room, and go on by "
                "--resume."
            ) from error
        self.offset += len(line)

    def sync(self) -> None:
        """Make sure that all rows are on the disk."""
        if self.path is not None and self._stream is not None:
            os.fsync(self._stream.fileno())

    def close(self) -> None:
        """Let go of the file."""
        if self.path is not None and self._stream is not None:
            self._stream.close()
        self._stream = None

    def finish(self) -> None:
        """Make the Parquet file, if one is wanted; its CSV file and checkpoint go.

        Raises
        ------
        InvalidInputError
            If it cannot be written; the rows stay in the CSV file.
        """
        self.close()
        if self.path is None or self._target is None or self.path == self._target:
            return
        temporary = self._target.with_name(f"{self._target.name}.tmp")
        try:
            _to_parquet(self.path, temporary)
            os.replace(temporary, self._target)
        except OSError as error:
            raise InvalidInputError(
                f"cannot write {self._target}: {error.strerror or error}. All rows are in "
                f"{self.path}."
            ) from error
        self.path.unlink()
        assert self.checkpoint is not None
        self.checkpoint.unlink(missing_ok=True)


def _line(fields: Sequence[str]) -> bytes:
    return (",".join(map(_quoted, fields)) + "\n").encode()


def _quoted(field: str) -> str:
    if _SPECIAL.search(field):
        return '"' + field.replace('"', '""') + '"'
    return field


def _to_parquet(source: Path, target: Path) -> None:
    pyarrow, parquet = need("pyarrow", "a Parquet file"), need("pyarrow.parquet", "a Parquet file")
    with source.open(encoding="utf-8", newline="") as file:
        rows = csv.reader(file)
        header = next(rows)
        schema, writer = None, None
        try:
            for piece in _pieces(rows):
                columns = list(zip(*piece, strict=True)) or [()] * len(header)
                arrays = [
                    _array(pyarrow, name, list(column))
                    for name, column in zip(header, columns, strict=True)
                ]
                schema = schema or pyarrow.schema(
                    [(name, array.type) for name, array in zip(header, arrays, strict=True)]
                )
                writer = writer or parquet.ParquetWriter(target, schema)
                writer.write_table(pyarrow.Table.from_arrays(arrays, schema=schema))
        finally:
            if writer is not None:
                writer.close()


def _pieces(rows: Iterator[list[str]]) -> Iterator[list[list[str]]]:
    piece: list[list[str]] = []
    for row in rows:
        piece.append(row)
        if len(piece) == _ROWS:
            yield piece
            piece = []
    yield piece


def _array(pyarrow: Any, name: str, fields: list[str]) -> Any:
    if name in TEXTS:
        return pyarrow.array(fields, pyarrow.string())
    if name in COUNTS:
        return pyarrow.array([int(field) for field in fields], pyarrow.int32())
    reader = Reader(".")
    if name != "time":
        return pyarrow.array([reader.number(field) for field in fields], pyarrow.float64())
    times = [reader.time(field)[0] for field in fields]
    if not times or isinstance(times[0], float):
        return pyarrow.array(times, pyarrow.float64())
    zone = None if times[0].tzinfo is None else "UTC"
    return pyarrow.array(times, pyarrow.timestamp("us", tz=zone))
