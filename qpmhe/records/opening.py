"""What a record is, by its first bytes: text, compressed text, or a table of another kind."""

from __future__ import annotations

import gzip
import sys
import zlib
from pathlib import Path
from typing import BinaryIO, cast

from .errors import RecordError

__all__ = ["BROKEN", "Opened", "open_file", "open_standard_input"]

_GZIP, _PARQUET, _ZIP = b"\x1f\x8b", b"PAR1", b"PK\x03\x04"
_COMPRESSED = {
    b"BZh": ("bzip2", "bzcat"), b"\xfd7zXZ": ("xz", "xzcat"),
    b"\x28\xb5\x2f\xfd": ("zstd", "zstdcat"),
}
_LONGEST = max(map(len, (_GZIP, _PARQUET, _ZIP, *_COMPRESSED)))
#: What reading on can raise; the last two where compressed text is damaged or cut off.
BROKEN = (OSError, EOFError, zlib.error)


class Opened:
    """A record that can be read from its beginning.

    Parameters
    ----------
    stream : binary stream
        Its bytes; text is not compressed any more.
    is_parquet : bool
        Whether it is a Parquet file.
    total : int or None
        Bytes in all, if that can be known.
    file : binary stream, optional
        What it is read from, if that is to be closed.
    """

    def __init__(
        self, stream: BinaryIO, is_parquet: bool, total: int | None,
        file: BinaryIO | None = None,
    ) -> None:
        self.stream, self.is_parquet, self.total = stream, is_parquet, total
        self._file = file

    def close(self) -> None:
        """Let go of the file."""
        if self._file is not None:
            self.stream.close()
            self._file.close()


def open_file(path: Path, name: str) -> Opened:
    """Open a file; gzip is read as what is in it.

    Parameters
    ----------
    path : Path
        The file.
    name : str
        What error texts call it.

    Raises
    ------
    RecordError
        If it cannot be read, or is of another kind.
    """
    try:
        stream = path.open("rb")
    except OSError as error:
        raise RecordError(f"cannot be read ({error.strerror or error}).", name) from error
    try:
        is_file = path.is_file()
        head = _head(stream, name)
        named = path.suffix.lower() in (".parquet", ".pq")
        if is_file and (named or head.startswith(_PARQUET)):
            return Opened(stream, True, None, stream)
        text = _text(stream, head, name)
        total = path.stat().st_size if is_file and text is stream else None
        return Opened(text, False, total, stream)
    except BaseException:
        stream.close()
        raise


def open_standard_input(name: str) -> Opened:
    """Standard input, in CSV or gzip of it.

    Parameters
    ----------
    name : str
        What error texts call it.

    Raises
    ------
    RecordError
        If it is closed, or of another kind.
    """
    if sys.stdin is None:
        raise RecordError("it is closed; pipe a record into it, or name a file.", name)
    stream = sys.stdin.buffer
    return Opened(_text(stream, _head(stream, name), name), False, None)


def _head(stream: BinaryIO, name: str) -> bytes:
    """The first bytes, which stay to be read; none where a stream cannot look ahead."""
    peek = getattr(stream, "peek", None)
    try:
        return b"" if peek is None else bytes(peek(_LONGEST)[:_LONGEST])
    except OSError as error:
        raise RecordError(f"cannot be read ({error.strerror or error}).", name) from error


def _text(stream: BinaryIO, head: bytes, name: str) -> BinaryIO:
    if head.startswith(_GZIP):
        return cast(BinaryIO, gzip.GzipFile(fileobj=stream))
    if head.startswith(_PARQUET):
        raise RecordError(
            "it is a Parquet file, which is not read line by line; name the file instead.", name
        )
    if head.startswith(_ZIP):
        raise RecordError(
            "it is a zip archive or a spreadsheet, and no text; save it as CSV.", name
        )
    for magic, (kind, program) in _COMPRESSED.items():
        if head.startswith(magic):
            raise RecordError(
                f"it is compressed by {kind}; give '{program} FILE | qpmhe estimate MODEL -', or "
                "compress it by gzip, which is read as it is.", name,
            )
    return stream
