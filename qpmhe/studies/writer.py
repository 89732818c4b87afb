"""The one process that writes to a store."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from . import database
from .errors import StoreError
from .rows import COLUMNS, PARTS, encoded

__all__ = ["Writer", "writing"]


class Writer:
    """Takes results in, one transaction each.

    Parameters
    ----------
    path : Path
        The store.
    connection : sqlite3.Connection
        To it, with the right to write.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self._path, self._connection = path, connection

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        connection = self._connection
        with database.told(self._path):
            connection.execute("BEGIN IMMEDIATE")
            try:
                yield connection
                connection.execute("COMMIT")
            except BaseException:
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
                raise

    def begin(self, settings: dict[str, Any], fingerprints: dict[str, str]) -> None:
        """Note that a study begins.

        Parameters
        ----------
        settings : dict
            Of the study.
        fingerprints : dict
            Of the files of its models, by name.

        Raises
        ------
        StoreError
            If a model's file is not that of the cells that are there.
        """
        with self._transaction() as connection:
            known = dict(connection.execute("SELECT name, fingerprint FROM models").fetchall())
            for name, fingerprint in fingerprints.items():
                if known.get(name, fingerprint) != fingerprint:
                    raise StoreError(
                        f"the file of model {name!r}, or one that it imports, has changed since "
                        f"cells of it were put into {self._path}; name another store for the new "
                        "model, or change the file back."
                    )
                connection.execute(
                    "INSERT OR IGNORE INTO models VALUES (?, ?)", (name, fingerprint)
                )
            connection.execute(
                "INSERT INTO studies (settings, started) VALUES (?, ?)",
                (json.dumps(settings), _now()),
            )

    def present(self, retry_failed: bool) -> dict[str, frozenset[str]]:
        """The parts that each cell has.

        Parameters
        ----------
        retry_failed : bool
            Whether cells that failed count as absent.
        """
        where = "WHERE outcome = 'done'" if retry_failed else ""
        with database.told(self._path):
            rows = self._connection.execute(f"SELECT key, parts FROM cells {where}").fetchall()
        return {key: frozenset(parts.split(",")) for key, parts in rows}

    def put(self, result: dict[str, Any]) -> None:
        """Store a result, in one transaction.

        Parameters
        ----------
        result : dict
            What `qpmhe.studies.compute.compute` gives.
        """
        with self._transaction() as connection:
            row = {name: result.get(name) for name in COLUMNS}
            row["environment"] = _environment(connection, result["environment"])
            row["finished"] = _now()
            _merge(connection, row)
            if "trajectory" in result:
                connection.execute(
                    "INSERT OR REPLACE INTO trajectories VALUES (?, ?, ?)",
                    (row["key"], *_packed(result["trajectory"])),
                )


def _merge(connection: sqlite3.Connection, row: dict[str, Any]) -> None:
    """Insert a row, or add to the one that is there what was measured now."""
    found = connection.execute(
        "SELECT outcome, parts FROM cells WHERE key = ?", (row["key"],)
    ).fetchone()
    written = set(COLUMNS)
    if found is not None and found[0] == "done":
        for part, columns in PARTS.items():
            if row["outcome"] == "failed" or part not in row["parts"]:
                written -= set(columns)
        if row["outcome"] == "failed":
            what = "; ".join(sorted(set(row["parts"]) - set(found[1].split(","))))
            row["reason"] = f"{what}: {row['reason']}"
            written = {"key", "parts", "reason"}
        row["parts"] = set(row["parts"]) | set(found[1].split(","))
    names = [name for name in COLUMNS if name in written]
    connection.execute(
        f"INSERT INTO cells ({', '.join(names)}) VALUES ({', '.join('?' * len(names))}) "
        f"ON CONFLICT (key) DO UPDATE SET "
        + ", ".join(f"{name} = excluded.{name}" for name in names if name != "key"),
        [encoded(name, row[name]) for name in names],
    )


def _environment(connection: sqlite3.Connection, settings: dict[str, Any]) -> int:
    text = json.dumps(settings, sort_keys=True)
    found = connection.execute(
        "SELECT id FROM environments WHERE settings = ?", (text,)
    ).fetchone()
    if found is None:
        (count,) = connection.execute("SELECT count(*) FROM environments").fetchone()
        connection.execute("INSERT INTO environments VALUES (?, ?)", (count, text))
        return int(count)
    return int(found[0])


def _packed(trajectory: dict[str, Any]) -> tuple[str, bytes]:
    names = ("times", "states", "estimates")
    header = {name: value for name, value in trajectory.items() if name not in names}
    header["shape"] = list(trajectory["states"].shape)
    numbers = np.concatenate([np.ravel(trajectory[name]) for name in names])
    return json.dumps(header), numbers.astype(np.float64).tobytes()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


@contextmanager
def writing(path: Path) -> Iterator[Writer]:
    """Open a store to write; it is made if it does not exist.

    Parameters
    ----------
    path : Path
        The store.

    Raises
    ------
    StoreError
        If it is no store of this version, damaged, read-only, or another study writes to it.
    """
    database.insist_on_file(path)
    with _alone(path), database.told(path):
        connection = database.connect(path, "rwc")
        try:
            database.check(connection, path, empty=True)
            _insist_on_whole(connection, path)
            database.create(connection)
            yield Writer(path, connection)
        finally:
            connection.close()


def _insist_on_whole(connection: sqlite3.Connection, path: Path) -> None:
    (answer,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if answer != "ok":
        raise StoreError(
            f"the store {path}: it is damaged or truncated and was left as it is ({answer}); "
            "take a copy of before, or name another file."
        )


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Hold a lock that ends with the process, however that ends."""
    beside = path.with_name(path.name + "-lock")
    with database.told(path):
        lock = database.connect(beside, "rwc")
    try:
        try:
            lock.execute("PRAGMA busy_timeout = 0")
            lock.execute("PRAGMA journal_mode = MEMORY")
            lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorname == "SQLITE_BUSY":
                raise StoreError(
                    f"another study is writing to the store {path}; wait for its end, or name "
                    "another file."
                ) from error
            with database.told(path):
                raise
        try:
            yield
        finally:
            with suppress(OSError):
                os.remove(beside)
    finally:
        lock.close()
