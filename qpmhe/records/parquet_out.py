"""Gathered rows of results to a Parquet file."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..studies.errors import need
from .numbers import Reader
from .parquet_times import common_type, time_array
from .results import COUNTS, TEXTS

__all__ = ["to_parquet"]

_ROWS = 20_000


def to_parquet(source: Path, target: Path, time_type: Any = None) -> None:
    """Turn a CSV file of results into a Parquet file.

    Parameters
    ----------
    source, target : Path
        The files.
    time_type : pyarrow.DataType, optional
        Type of the times; found from them if left out.

    Raises
    ------
    OSError
        If it cannot be written; nothing of it stays then.
    """
    parquet = need("pyarrow.parquet", "a Parquet file")
    if time_type is None:
        with source.open(encoding="utf-8", newline="") as file:
            rows = csv.reader(file)
            next(rows)
            time_type = common_type(row[0] for row in rows)
    try:
        with source.open(encoding="utf-8", newline="") as file, contextlib.ExitStack() as stack:
            rows = csv.reader(file)
            header = next(rows)
            writer = None
            for piece in _pieces(rows):
                table = _table(header, piece, time_type)
                if writer is None:
                    writer = stack.enter_context(parquet.ParquetWriter(target, table.schema))
                writer.write_table(table)
    except BaseException:
        target.unlink(missing_ok=True)
        raise


def _table(header: list[str], rows: list[list[str]], time_type: Any) -> Any:
    pyarrow = need("pyarrow", "a Parquet file")
    columns = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in header]
    arrays = [
        time_array(time_type, column) if name == "time" else _array(pyarrow, name, column)
        for name, column in zip(header, columns, strict=True)
    ]
    return pyarrow.Table.from_arrays(arrays, names=header)


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
    return pyarrow.array([reader.number(field) for field in fields], pyarrow.float64())
