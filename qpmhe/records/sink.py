"""Where results go: a CSV file or standard output line by line, or a Parquet file at the end."""

from __future__ import annotations

import contextlib
import csv
import errno
import hashlib
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO, cast

from ..errors import OptionError
from ..studies.errors import need
from .errors import CheckpointError, WriteError
from .parquet_out import to_parquet

__all__ = ["Sink"]

_SPECIAL = re.compile('[,"\r\n]')
# What says that a place has nothing to be synchronised.
_NOT_SYNCHRONISED = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)
_PIECE = 1 << 20


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
        Where the checkpoint belongs; None where nothing can be gone on with.
    files : tuple of Path
        What is written in the end, and on the way.
    offset : int
        Bytes written so far, with those that stood there before.

    Raises
    ------
    OptionError
        If the name ends differently, or standard output is closed.
    """

    def __init__(self, out: str | Path) -> None:
        self.path: Path | None = None
        self.checkpoint: Path | None = None
        self.offset = 0
        self._target: Path | None = None
        self._stream: BinaryIO | None = None
        self._hash = hashlib.sha256()
        self.files: tuple[Path, ...] = ()
        if str(out) == "-":
            if sys.stdout is None:
                raise OptionError("standard output is closed; name a file by --out.")
            return
        path = Path(out)
        if path.suffix not in (".csv", ".parquet"):
            raise OptionError(
                f"--out is {str(out)!r}; expected a name in .csv or .parquet, or - for standard "
                "output."
            )
        self.path = self._target = path
        is_new, is_file = not os.path.exists(path), os.path.isfile(path)
        if path.suffix == ".parquet":
            need("pyarrow", "a Parquet file")
            if not (is_new or is_file):
                raise OptionError(f"--out is {str(out)!r}, which is no file; give another name.")
            self.path = path.with_name(f"{path.name}.part.csv")
        self.files = tuple(dict.fromkeys((self.path, path)))
        if is_new or is_file:  # a pipe that has a name is none to go on with
            self.checkpoint = path.with_name(f"{path.name}.checkpoint")

    @property
    def name(self) -> str:
        """What texts call the place where rows are."""
        return "standard output" if self.path is None else str(self.path)

    @property
    def digest(self) -> str:
        """Of all bytes so far."""
        return self._hash.hexdigest()

    def use(self, stream: BinaryIO) -> None:
        """Write to standard output by this stream.

        Parameters
        ----------
        stream : binary stream
            As of `standard_output_for_rows`.
        """
        self._stream = stream

    def begin(self, header: Sequence[str], first: Callable[[bytes], None] | None = None) -> None:
        """Open anew, and write the header.

        Parameters
        ----------
        header : sequence of str
            The columns' names.
        first : callable, optional
            Called with the header's line before it is written: no row may stand in the
            file without a checkpoint beside it.

        Raises
        ------
        WriteError
            If the file cannot be written; it is not there then.
        """
        if self.path is None:
            self.write(header)
            return
        try:
            if self.checkpoint is not None:
                self.checkpoint.unlink(missing_ok=True)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self.path.open("wb", buffering=0)
        except OSError as error:
            raise self._failed(error, "Name another place by --out.") from error
        try:
            if first is not None:
                first(_line(header))
            self.write(header)
        except WriteError as error:
            self.close()
            if self.checkpoint is not None:
                for path in (self.path, self.checkpoint):
                    with contextlib.suppress(OSError):
                        path.unlink()
            raise WriteError(f"{error} Make room, or name another place by --out.") from error

    def go_on(self, header: Sequence[str], offset: int, digest: str) -> None:
        """Open behind what was written before.

        Parameters
        ----------
        header : sequence of str
            The columns' names.
        offset : int
            Bytes to keep of the file that is there; what stands behind is cut off.
        digest : str
            Of these.

        Raises
        ------
        CheckpointError
            If these are not there any more, or have another header.
        WriteError
            If the file cannot be written.
        """
        assert self.path is not None
        again = "start again by --overwrite."
        try:
            self._stream = stream = cast(BinaryIO, self.path.open("r+b", buffering=0))
            first = _line(header)
            if stream.seek(0, os.SEEK_END) < offset:
                raise CheckpointError(f"{self.path} is shorter than its checkpoint says; {again}")
            stream.seek(0)
            if stream.read(len(first)) != first:
                raise CheckpointError(
                    f"{self.path} has other columns than its checkpoint says; {again}"
                )
            stream.seek(0)
            while (left := offset - stream.tell()) > 0:
                self._hash.update(stream.read(min(left, _PIECE)))
            if self.digest != digest:
                raise CheckpointError(
                    f"{self.path} was changed after its checkpoint was written; undo that, or "
                    f"{again}"
                )
            stream.truncate()
            self.offset = offset
        except FileNotFoundError as error:
            raise CheckpointError(
                f"{self.path} is gone, and its checkpoint {self.checkpoint} is not; {again}"
            ) from error
        except OSError as error:
            raise self._failed(error) from error

    def times_behind(self, offset: int) -> list[str]:
        """Times of the first two rows that stand behind a place in the file.

        Parameters
        ----------
        offset : int
            The place.
        """
        assert self.path is not None
        try:
            with self.path.open("rb") as file:
                file.seek(offset)
                lines = [file.readline().decode(), file.readline().decode()]
        except OSError:  # `go_on` tells
            return []
        return [next(csv.reader([line]))[0] for line in lines if line.endswith("\n")]

    def write(self, fields: Sequence[str]) -> None:
        """Write a row, at once.

        Raises
        ------
        WriteError
            If it cannot be written; the file still ends with a whole row.
        BrokenPipeError
            If whoever reads the rows has gone.
        """
        stream, line = self._stream, _line(fields)
        assert stream is not None
        try:
            done = 0
            while done < len(line):
                done += stream.write(line[done:])
            if self.path is None:
                stream.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            if self.checkpoint is not None:
                with contextlib.suppress(OSError):
                    stream.truncate(self.offset)
            raise self._failed(error) from error
        self.offset += len(line)
        self._hash.update(line)

    def sync(self) -> None:
        """Make sure that all rows are on the disk.

        Raises
        ------
        WriteError
            If they are not.
        """
        if self.path is None or self._stream is None:
            return
        try:
            os.fsync(self._stream.fileno())
        except OSError as error:
            if error.errno not in _NOT_SYNCHRONISED:
                raise self._failed(error) from error

    def _failed(self, error: OSError, remedy: str = "") -> WriteError:
        return WriteError(f"cannot write {self.name}: {error.strerror or error}. {remedy}".rstrip())

    def close(self) -> None:
        """Let go of the file."""
        if self.path is not None and self._stream is not None:
            self._stream.close()
        self._stream = None

    def finish(self, time_type: Any = None) -> None:
        """Make the Parquet file, if one is wanted; its CSV file and checkpoint go.

        Parameters
        ----------
        time_type : pyarrow.DataType, optional
            Type of the times in it.

        Raises
        ------
        WriteError
            If it cannot be written; the rows stay in the CSV file.
        """
        self.close()
        if self.path is None or self._target is None or self.path == self._target:
            return
        temporary = self._target.with_name(f"{self._target.name}.tmp")
        try:
            to_parquet(self.path, temporary, time_type)
            os.replace(temporary, self._target)
        except OSError as error:
            raise WriteError(
                f"cannot write {self._target}: {error.strerror or error}. All rows are in "
                f"{self.path}; make room, and --resume makes the Parquet file of them."
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
