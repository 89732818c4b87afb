"""The columns of a store: their names, their types in SQLite and in a data frame."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import need

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["COLUMNS", "PARTS", "decoded", "encoded", "framed"]

#: Type in SQLite of each column, in the order of the data frame.
COLUMNS = {
    "key": "TEXT PRIMARY KEY", "model": "TEXT", "backend": "TEXT", "qps": "INTEGER",
    "solver_iterations": "INTEGER", "horizon": "INTEGER", "start": "TEXT", "seed": "INTEGER",
    "steps": "INTEGER", "outcome": "TEXT", "reason": "TEXT", "rmse": "REAL",
    "rmse_settled": "REAL", "rmse_states": "TEXT", "rmse_settled_states": "TEXT",
    "nees": "REAL", "cost_ratio": "REAL", "improved": "REAL", "kept": "REAL", "fallback": "REAL",
    "reasons": "TEXT", "cap_hits": "REAL", "qps_mean": "REAL", "solver_iterations_mean": "REAL",
    "time_median": "REAL", "time_p95": "REAL", "time_p99": "REAL", "time_max": "REAL",
    "times": "BLOB", "shared": "INTEGER", "environment": "INTEGER", "finished": "TEXT",
    "parts": "TEXT",
}
#: Columns that only one part of a measurement fills; the others come with each.
PARTS = {
    "accuracy": ("cost_ratio",),
    "time": ("time_median", "time_p95", "time_p99", "time_max", "times", "shared"),
    "covariance": ("nees",),
}
_JSON = ("rmse_states", "rmse_settled_states", "reasons")
_REAL = tuple(name for name, kind in COLUMNS.items() if kind == "REAL")
_TEXT = ("key", "model", "backend", "start", "outcome", "reason", "finished")
_NULLABLE = ("qps", "solver_iterations")


def encoded(name: str, value: Any) -> Any:
    """A value as SQLite keeps it.

    Parameters
    ----------
    name : str
        The column.
    value
        What is to be kept.
    """
    if value is None:
        return None
    if name in _JSON:
        return json.dumps(value)
    if name == "times":
        return np.asarray(value, np.float32).tobytes()
    if name == "parts":
        return ",".join(sorted(value))
    return value


def decoded(name: str, value: Any) -> Any:
    """A value as users see it.

    Parameters
    ----------
    name : str
        The column.
    value
        What SQLite has.
    """
    if value is None:
        return float("nan") if name in _REAL else None
    if name in _JSON:
        return json.loads(value)
    if name == "times":
        return np.frombuffer(value, np.float32)
    return value


def framed(rows: list[dict[str, Any]], deadline: float | None) -> DataFrame:
    """Rows as a data frame.

    Parameters
    ----------
    rows : list of dict
        Decoded.
    deadline : float or None
        Seconds; ``late`` is the share of steps that took longer.

    Returns
    -------
    pandas.DataFrame
        The columns of `COLUMNS`, without ``parts``, with ``late`` before ``times``.

    Raises
    ------
    InvalidInputError
        If pandas is not installed.
    """
    pandas = need("pandas", "a data frame of results")
    names = [name for name in COLUMNS if name != "parts"]
    names.insert(names.index("times"), "late")
    for row in rows:
        times = row["times"]
        row["late"] = (
            float("nan") if times is None or deadline is None else float((times > deadline).mean())
        )
    frame = pandas.DataFrame({name: [row[name] for row in rows] for name in names}, columns=names)
    types = dict.fromkeys((*_REAL, "late"), "float64") | dict.fromkeys(_NULLABLE, "Int64")
    types |= dict.fromkeys(("horizon", "seed", "steps", "environment"), "int64")
    types |= dict.fromkeys(_TEXT, "object")
    found: DataFrame = frame.astype(types).assign(shared=frame["shared"].astype("bool"))
    return found
