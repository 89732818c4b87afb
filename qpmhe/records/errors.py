"""What can be wrong with a record, and with what is kept beside its results."""

from __future__ import annotations

from ..errors import InvalidInputError, QpmheError

__all__ = ["CheckpointError", "RecordError", "WriteError"]


class RecordError(InvalidInputError):
    """A record that cannot be read on; the text names file, line, column and remedy.

    Parameters
    ----------
    what : str
        What is wrong, and what to do about it.
    file : str
        The record, as the user calls it.
    line : int, optional
        Its line, counted from 1; of a Parquet file, the row.
    column : str, optional
        The column's name.
    unit : str
        What is counted: ``line`` or ``row``.
    """

    def __init__(
        self, what: str, file: str, line: int | None = None, column: str | None = None,
        unit: str = "line",
    ) -> None:
        place = file if line is None else f"{file}, {unit} {line}"
        super().__init__(f"{place}{'' if column is None else f', column {column!r}'}: {what}")
        self.file, self.line, self.column = file, line, column


class CheckpointError(QpmheError):
    """A checkpoint that is damaged, or does not belong to what is to go on from it."""


class WriteError(InvalidInputError):
    """Results or a checkpoint that cannot be written; what was written before stays."""
