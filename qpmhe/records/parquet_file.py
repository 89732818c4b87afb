"""Rows of a Parquet file, one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..studies.errors import need
from .csv_file import Row
from .errors import RecordError
from .parquet_times import is_kept, timestamp_texts

__all__ = ["ParquetFile"]

_ROWS = 4096


class ParquetFile:
    """The columns of a Parquet file, read piece by piece.

    Parameters
    ----------
    path : Path
        The file.
    name : str
        What error texts call it.

    Attributes
    ----------
    header : list of str
        Names of the columns.
    header_line : None
        They stand in no line.
    position, total : int
        Rows read so far, and in all.
    types : list of pyarrow.DataType or None
        Types of the columns, None where results cannot have times of them.

    Raises
    ------
    RecordError
        If it cannot be read.
    InvalidInputError
        If pyarrow is not installed.
    """

    unit = "row"
    header_line = None
    hint = ""

    def __init__(self, path: Path, name: str) -> None:
        pyarrow = need("pyarrow", "a Parquet file")
        parquet = need("pyarrow.parquet", "a Parquet file")
        self._name, self._broken = name, (pyarrow.ArrowException, OSError)
        try:
            self._file = parquet.ParquetFile(path)
        except self._broken as error:
            raise RecordError(f"it cannot be read as Parquet ({_first_line(error)}).", name) from (
                error
            )
        schema = self._file.schema_arrow
        self.header: list[str] = list(schema.names)
        self.types: list[Any] = [kind if is_kept(kind) else None for kind in schema.types]
        self.position, self.total = 0, int(self._file.metadata.num_rows)

    def __iter__(self) -> Iterator[Row]:
        batches = self._file.iter_batches(batch_size=_ROWS)
        while True:
            try:
                batch = next(batches)
                columns = [_texts(column) for column in batch.columns]
            except StopIteration:
                return
            except (*self._broken, ValueError) as error:
                raise RecordError(
                    f"it cannot be read on ({_first_line(error)}).", self._name,
                    self.position + 1, unit=self.unit,
                ) from error
            for values in zip(*columns, strict=True):
                self.position += 1
                yield Row(self.position, list(values), True)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


def _texts(column: Any) -> list[str]:
    if hasattr(column.type, "unit") and hasattr(column.type, "tz"):
        return timestamp_texts(column)
    return [_text(value) for value in column.to_pylist()]


def _text(value: Any) -> str:
    """A value as a CSV file would have it; floats keep all their digits."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if hasattr(value, "isoformat"):
        return str(value.isoformat())
    return repr(value) if isinstance(value, float) else str(value)


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0].rstrip(".")
