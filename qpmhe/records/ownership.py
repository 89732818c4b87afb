"""What may be written over: nothing that stands there, unless the user says so."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from ..errors import InvalidInputError, OptionError
from .checkpoint import Checkpoint, load
from .errors import CheckpointError
from .sink import Sink

__all__ = ["insist_on_two_files", "may_write"]


def may_write(sink: Sink, resume: bool, overwrite: bool) -> Checkpoint | None:
    """Insist that no results are lost; where to go on, if that is wanted and possible.

    Parameters
    ----------
    sink : Sink
        Before it is opened.
    resume, overwrite : bool
        What the user says.

    Raises
    ------
    CheckpointError
        If results of ours stand there, or the checkpoint is damaged.
    InvalidInputError
        If another file stands there.
    OptionError
        If there is nothing that could be resumed from.
    """
    if sink.checkpoint is None:
        if resume:
            raise OptionError("--resume needs a file: give --out a name in .csv or .parquet.")
        return None
    if overwrite:
        return None
    found = load(sink.checkpoint)
    if found is not None:
        if not _holds_rows(sink, found):
            return None
        if resume:
            return found
        if found.finished:
            raise CheckpointError(
                f"{sink.name} holds a finished estimation; replace it by --overwrite, go on by "
                "--resume if the record has grown, or give another --out."
            )
        raise CheckpointError(
            f"{sink.name} holds an estimation that was cut off (its checkpoint was taken after "
            f"{found.samples} samples); go on by --resume, or start again by --overwrite."
        )
    for path in sink.files:
        if _size(path):
            raise InvalidInputError(
                f"{path} is there already, and no checkpoint beside it that --resume could go "
                "on from; give another --out, or replace it by --overwrite."
            )
    return None


def _holds_rows(sink: Sink, found: Checkpoint) -> bool:
    """Whether there is more than the header, which the first checkpoint is taken behind."""
    assert sink.path is not None
    return found.samples > 0 or _size(sink.path) > found.offset


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:  # not there, or not to be seen: opening it tells
        return 0


def insist_on_two_files(record: str | Path, sink: Sink) -> None:
    """Refuse to write over the record that is being read.

    Parameters
    ----------
    record : str or Path
        The record; ``-`` is standard input.
    sink : Sink
        Where results go.

    Raises
    ------
    OptionError
        If they are one file, by whatever names.
    """
    for path in sink.files:
        try:
            there = path.stat()
            read = (
                os.fstat(sys.stdin.fileno()) if str(record) == "-" else Path(record).stat()
            )
        except (OSError, ValueError, AttributeError):  # one of them is no file yet, or no file
            continue
        if os.path.samestat(there, read):
            raise OptionError(
                f"--out would overwrite the record itself, {record}; name another file."
            )
