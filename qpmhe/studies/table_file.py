"""A store's rows as a CSV or Parquet file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidInputError, OptionError
from .errors import need
from .store import Store

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["export"]

_LISTS = ("rmse_states", "rmse_settled_states", "times")


def export(store: Store | str | Path, path: str | Path) -> Path:
    """Write all cells of a store into a table.

    In CSV, lists and ``reasons`` are JSON texts; in Parquet, lists are lists and ``reasons``
    is a JSON text.

    Parameters
    ----------
    store : Store, str or Path
        What is exported.
    path : str or Path
        The file, ``.csv`` or ``.parquet``; it is replaced if it exists.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OptionError
        If the file's name ends differently.
    StoreError
        If the store cannot be read.
    InvalidInputError
        If the file cannot be written, or a package is missing.
    """
    target = Path(path)
    if target.suffix not in (".csv", ".parquet"):
        raise OptionError(f"the file is {str(path)!r}; expected a name in .csv or .parquet.")
    frame = (store if isinstance(store, Store) else Store(store)).frame()
    frame["reasons"] = frame["reasons"].map(_text)
    try:
        if target.suffix == ".csv":
            _write_csv(frame, target)
        else:
            need("pyarrow", "a Parquet file")
            frame.to_parquet(target, engine="pyarrow", index=False)
    except OSError as error:
        raise InvalidInputError(f"cannot write {target}: {error.strerror or error}.") from error
    return target


def _write_csv(frame: DataFrame, target: Path) -> None:
    for name in _LISTS:
        frame[name] = frame[name].map(_text)
    frame.to_csv(target, index=False)


def _text(value: Any) -> str | None:
    if value is None or isinstance(value, float):  # pandas may put NaN for None
        return None
    return json.dumps(value if isinstance(value, (list, dict)) else value.tolist())
