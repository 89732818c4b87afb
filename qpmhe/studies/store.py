"""The results of a study in one SQLite file."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InvalidInputError
from .database import SCHEMA, reading
from .rows import COLUMNS, decoded, framed
from .writer import Writer, writing

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["Store"]


class Store:
    """A file of results, which `run` writes and everybody may read meanwhile.

    Parameters
    ----------
    path : str or Path
        The file. It need not exist until something is read.
    """

    def __init__(self, path: str | Path) -> None:
        if not isinstance(path, (str, Path)):
            raise InvalidInputError(f"the store is {path!r}; expected the name of a file.")
        self.path = Path(path)

    def __repr__(self) -> str:
        return f"Store({str(self.path)!r})"

    def frame(self) -> DataFrame:
        """All cells, one row each, in the order of their keys' first storing.

        Returns
        -------
        pandas.DataFrame
            With the columns

            - key, model, backend, qps (NA: to convergence), solver_iterations (NA: no cap),
              horizon, start, seed, steps: the cell;
            - outcome ("done", "failed") and reason;
            - rmse, rmse_settled, rmse_states, rmse_settled_states, nees, cost_ratio,
              improved, kept, fallback, reasons, cap_hits, qps_mean, solver_iterations_mean:
              see `qpmhe.studies.metrics`;
            - time_median, time_p95, time_p99, time_max [s], late (share of steps over the
              last study's deadline), times (seconds of each step, None where not measured),
              shared (whether other cells ran meanwhile);
            - environment (index into ``meta()["environments"]``) and finished (UTC).

        Raises
        ------
        StoreError
            If there is no such store, or it cannot be read.
        InvalidInputError
            If pandas is not installed.
        """
        names = list(COLUMNS)
        with reading(self.path) as connection:
            rows = connection.execute(f"SELECT {', '.join(names)} FROM cells ORDER BY rowid")
            found = [
                {name: decoded(name, value) for name, value in zip(names, row, strict=True)}
                for row in rows
            ]
            last = connection.execute(
                "SELECT settings FROM studies ORDER BY id DESC LIMIT 1"
            ).fetchone()
        return framed(found, json.loads(last[0])["deadline"] if last else None)

    def meta(self) -> dict[str, Any]:
        """Where and with which settings the results came about.

        Returns
        -------
        dict
            ``study``: settings of the last study; ``studies``: of all, each with the time it
            ``started``; ``environments``: list of dicts, see
            `qpmhe.studies.environment.environment`; ``schema``: version of the tables.

        Raises
        ------
        StoreError
            If there is no such store, or it cannot be read.
        """
        with reading(self.path) as connection:
            studies = [
                {**json.loads(settings), "started": started}
                for settings, started in connection.execute(
                    "SELECT settings, started FROM studies ORDER BY id"
                )
            ]
            environments = [
                json.loads(settings)
                for (settings,) in connection.execute(
                    "SELECT settings FROM environments ORDER BY id"
                )
            ]
        last = {name: value for name, value in studies[-1].items() if name != "started"} if (
            studies
        ) else {}
        return {
            "study": last, "studies": studies, "environments": environments, "schema": SCHEMA,
        }

    def trajectory(self, key: str) -> dict[str, Any] | None:
        """The run of a cell, which is kept for the first seed of each configuration.

        Parameters
        ----------
        key : str
            The cell's.

        Returns
        -------
        dict or None
            ``times`` (T + 1,), ``states`` and ``estimates`` (T + 1, n), ``labels``,
            ``title``, ``time_unit``; None where none was kept.

        Raises
        ------
        StoreError
            If there is no such store, or it cannot be read.
        """
        with reading(self.path) as connection:
            found = connection.execute(
                "SELECT header, numbers FROM trajectories WHERE key = ?", (key,)
            ).fetchone()
        if found is None:
            return None
        header = json.loads(found[0])
        rows, n = header.pop("shape")
        numbers = np.frombuffer(found[1])
        return {
            "times": numbers[:rows],
            "states": numbers[rows : rows * (n + 1)].reshape(rows, n),
            "estimates": numbers[rows * (n + 1) :].reshape(rows, n),
            **header,
        }

    def writing(self) -> AbstractContextManager[Writer]:
        """The right to write, for one process at a time.

        Raises
        ------
        StoreError
            If it is no store of this version, damaged, read-only, or another study writes.
        """
        return writing(self.path)
