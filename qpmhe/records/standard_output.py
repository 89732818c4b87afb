"""Standard output for rows alone, whatever else the process prints."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator
from typing import BinaryIO

__all__ = ["standard_output_for_rows"]

_STANDARD_OUTPUT = 1


@contextlib.contextmanager
def standard_output_for_rows() -> Iterator[BinaryIO]:
    """Give a stream to standard output; all other prints go to standard error meanwhile.

    The C code of solvers prints on file descriptor 1, past ``sys.stdout``. So the rows go to a
    duplicate of the descriptor, and 1 itself is pointed at standard error, in the whole process.
    Where ``sys.stdout`` is no file descriptor 1, as in a notebook, only it is replaced.
    """
    text = sys.stdout
    assert text is not None
    with contextlib.ExitStack() as stack:
        rows = text.buffer
        if _is_descriptor(text):
            rows = stack.enter_context(_duplicate(text))
        stack.enter_context(contextlib.redirect_stdout(sys.stderr))
        yield rows


def _is_descriptor(text: object) -> bool:
    try:
        return bool(text.fileno() == _STANDARD_OUTPUT)  # type: ignore[attr-defined]
    except (AttributeError, OSError, ValueError):  # of a notebook, a test, or closed
        return False


@contextlib.contextmanager
def _duplicate(text: object) -> Iterator[BinaryIO]:
    """Standard output under another number, while 1 is standard error, or nothing."""
    _flush(text)
    kept = os.dup(_STANDARD_OUTPUT)
    rows = os.fdopen(kept, "wb")
    try:
        if sys.__stderr__ is None:  # closed: another file may have its number by now
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, _STANDARD_OUTPUT)
            os.close(nowhere)
        else:
            os.dup2(sys.__stderr__.fileno(), _STANDARD_OUTPUT)
        yield rows
    finally:
        _flush(text)  # what C or Python still holds belongs to standard error, too
        os.dup2(kept, _STANDARD_OUTPUT)
        with contextlib.suppress(OSError):  # whoever read the rows has gone, which was raised
            rows.close()


def _flush(text: object) -> None:
    with contextlib.suppress(OSError, ValueError):
        text.flush()  # type: ignore[attr-defined]
    # The C library has a buffer of its own; where it is not found, that goes out at the end.
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).fflush(None)
