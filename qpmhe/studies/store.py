"""The results of a study in one SQLite file."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from qpmhe_solvers.values import shown

from .._checks import checked_path, need
from ..errors import InvalidInputError, QpmheError
from .row import StudyRow

if TYPE_CHECKING:
    from pandas import DataFrame

#: Version of the tables, and of what their columns mean.
SCHEMA = 5
# Distinguishes our files from other SQLite files: "qpmh".
_APPLICATION = 0x71706D68
# Seconds to wait for another program's lock.
_PATIENCE = 10.0

_SQL = {"int": "INTEGER", "int | None": "INTEGER", "bool": "INTEGER", "float": "REAL",
        "Array | None": "BLOB"}
_PANDAS = {"int": "int64", "int | None": "Int64", "bool": "bool", "float": "float64"}
_STORED = {
    one.name: str(one.type) for one in fields(StudyRow) if one.metadata.get("stored", True)
} | {"environment": "int"}  # its number
#: Type in SQLite of each column, in the order of the data frame; lists and dicts are JSON texts.
COLUMNS = {
    "key": "TEXT PRIMARY KEY", **{name: _SQL.get(kind, "TEXT") for name, kind in _STORED.items()}
}
_JSON = tuple(name for name, kind in _STORED.items() if kind.startswith(("list", "dict")))
_ARRAYS = ("times", "states", "estimates")
_TYPES = {name: _PANDAS[kind] for name, kind in _STORED.items() if kind in _PANDAS}
_TABLES = (
    f"CREATE TABLE cells ({', '.join(f'{name} {kind}' for name, kind in COLUMNS.items())})",
    "CREATE TABLE environments (id INTEGER PRIMARY KEY, settings TEXT UNIQUE)",
    "CREATE TABLE studies (id INTEGER PRIMARY KEY, settings TEXT, started TEXT)",
    "CREATE TABLE models (name TEXT PRIMARY KEY, fingerprint TEXT)",
    "CREATE TABLE trajectories (key TEXT PRIMARY KEY, content TEXT)",
)
# What failed takes nothing away from what is there.
_PUT = (
    f"INSERT INTO cells ({', '.join(COLUMNS)}) VALUES ({', '.join('?' * len(COLUMNS))}) "
    f"ON CONFLICT (key) DO UPDATE SET {', '.join(f'{name} = excluded.{name}' for name in COLUMNS)} "
    "WHERE excluded.outcome = 'done' OR cells.outcome = 'failed'"
)
_LOCKED = "another program has locked it; close that, then give the same command again"
_DAMAGED = (
    "it is damaged or truncated and was left as it is; take an earlier copy, or name another file"
)
_REMEDIES = {
    "SQLITE_BUSY": _LOCKED,
    "SQLITE_LOCKED": _LOCKED,
    "SQLITE_READONLY": "it cannot be written; make file and folder writable, or name another file",
    "SQLITE_FULL": (
        "the disk is full; all cells that were stored are safe. Make room, then give the same "
        "command again"
    ),
    "SQLITE_IOERR": "the disk does not read or write; give the same command again when it works",
    "SQLITE_CANTOPEN": "it cannot be opened; check that the folder exists and can be written",
    "SQLITE_NOTADB": "it is no SQLite file and was left as it is; name another",
}


class StoreError(QpmheError):
    """A store that cannot be read or written; its content stays as it is."""


class Store:
    """A file of results, which `run` writes and others may read meanwhile.

    ``path`` is the file, which need not exist until something is read. Reading raises `StoreError`
    if the store is missing or unreadable.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = checked_path("the store", path)

    def __repr__(self) -> str:
        return f"Store({str(self.path)!r})"

    def frame(self) -> DataFrame:
        """All cells as a pandas.DataFrame, one row each, in the order of their keys' first storing.

        Its columns are ``key`` and the stored attributes of `qpmhe.studies.row.StudyRow`;
        ``environment`` is the index into ``meta()["environments"]``, and ``late`` follows from the
        times and the last study's deadline. NA in ``qps`` is a sequence to convergence, in
        ``solver_iterations`` no cap.
        """
        pandas = need("pandas", "a data frame of results")
        with _reading(self.path) as connection:
            found = connection.execute(f"SELECT {', '.join(COLUMNS)} FROM cells ORDER BY rowid")
            last = connection.execute(
                "SELECT settings FROM studies ORDER BY id DESC LIMIT 1"
            ).fetchone()
            deadline = json.loads(last[0])["deadline"] if last else None
            frame = pandas.DataFrame(found.fetchall(), columns=[*COLUMNS], dtype=object)
            frame["shared"] = frame["shared"].eq(1)
            frame = frame.astype(_TYPES).drop(columns="parts")
            for name in _JSON:
                frame[name] = [None if text is None else json.loads(text) for text in frame[name]]
            times = [None if one is None else np.frombuffer(one, "f4") for one in frame["times"]]
            late = [
                float("nan") if one is None or deadline is None else float((one > deadline).mean())
                for one in times
            ]
            frame["times"] = pandas.Series(times, dtype=object)
            place = frame.columns.get_loc("improved")
            frame.insert(place, "late", pandas.Series(late, dtype=float))
        whole: DataFrame = frame
        return whole

    def meta(self) -> dict[str, Any]:
        """Where and with which settings the results were computed.

        ``study`` has the settings of the last study, ``studies`` the settings of all with the time
        each ``started``, ``environments`` what `qpmhe.studies.environment` found, ``schema`` the
        version of the tables.
        """
        with _reading(self.path) as connection:
            begun = connection.execute("SELECT settings, started FROM studies ORDER BY id")
            studies = [(json.loads(settings), started) for settings, started in begun]
            places = connection.execute("SELECT settings FROM environments ORDER BY id")
            environments = [json.loads(settings) for (settings,) in places]
        return {
            "study": studies[-1][0] if studies else {},
            "studies": [{**settings, "started": started} for settings, started in studies],
            "environments": environments, "schema": SCHEMA,
        }

    def trajectory(self, key: str) -> dict[str, Any] | None:
        """The run of the cell ``key``, which is kept for the first seed of each configuration.

        A dict of ``times`` (T + 1,), ``states`` and ``estimates`` (T + 1, n), ``labels``, ``title``
        and ``time_unit``; None where none was kept.
        """
        with _reading(self.path) as connection:
            found = connection.execute(
                "SELECT content FROM trajectories WHERE key = ?", (key,)
            ).fetchone()
            if found is None:
                return None
            content: dict[str, Any] = json.loads(found[0])
            return content | {name: np.array(content[name], float) for name in _ARRAYS}

    @contextmanager
    def writing(self) -> Iterator[Writer]:
        """Open for writing; the file is made if it does not exist.

        Raises `StoreError` if it is no store of this version, damaged or read-only.
        """
        _check_file(self.path)
        with _explained(self.path):
            opened = _connect(self.path, "rwc")
        with closing(opened) as connection:
            with _explained(self.path):
                _check(connection, self.path, empty=True)
                (answer,) = connection.execute("PRAGMA quick_check(1)").fetchone()
                if answer != "ok":
                    raise ValueError(answer)
                _create(connection)
            yield Writer(self.path, connection)


def opened(store: Any) -> Store:
    """A store, or the one in a file of this name."""
    if isinstance(store, Store):
        return store
    if not isinstance(store, (str, Path)):
        raise InvalidInputError(
            f"the store is {shown(store)}; expected a qpmhe.studies.Store, or the name of its file."
        )
    return Store(store)


class Writer:
    """Stores results, one transaction each; `Store.writing` makes it."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self._path, self._connection = path, connection

    def begin(self, settings: dict[str, Any], fingerprints: dict[str, str]) -> None:
        """Note that a study begins, with its settings and the fingerprints of what it names."""
        connection = self._connection
        with _explained(self._path), _transaction(connection):
            known = dict(connection.execute("SELECT name, fingerprint FROM models").fetchall())
            for name, fingerprint in fingerprints.items():
                if known.get(name, fingerprint) != fingerprint:
                    raise StoreError(
                        f"{name} has changed since its cells were stored in "
                        f"{self._path}: its function or arguments, its file, a file that it "
                        "imports, or a model's record or the options for reading that. Name "
                        "another store, or undo the change."
                    )
                connection.execute(
                    "INSERT OR IGNORE INTO models VALUES (?, ?)", (name, fingerprint)
                )
            connection.execute(
                "INSERT INTO studies (settings, started) VALUES (?, ?)",
                (json.dumps(settings), _now()),
            )

    def present(self, retry_failed: bool) -> dict[str, frozenset[str]]:
        """The parts that each cell has; failed cells are left out if they are to be retried."""
        where = "WHERE outcome = 'done'" if retry_failed else ""
        with _explained(self._path):
            rows = self._connection.execute(f"SELECT key, parts FROM cells {where}").fetchall()
            return {key: frozenset(parts.split(",")) for key, parts in rows}

    def put(self, result: StudyRow) -> None:
        """Store what `qpmhe.studies.cell.compute` gives, in place of an earlier result."""
        connection = self._connection
        row: dict[str, Any] = {name: getattr(result, name) for name in COLUMNS}
        row |= {name: json.dumps(row[name]) for name in _JSON if row[name] is not None}
        row["parts"], row["finished"] = ",".join(sorted(result.parts)), _now()
        if row["times"] is not None:
            row["times"] = np.asarray(row["times"], "f4").tobytes()
        with _explained(self._path), _transaction(connection):
            row["environment"] = _environment(connection, result.environment)
            connection.execute(_PUT, [*row.values()])
            if result.trajectory is not None:
                content = result.trajectory
                content = content | {name: content[name].tolist() for name in _ARRAYS}
                connection.execute(
                    "INSERT OR REPLACE INTO trajectories VALUES (?, ?)",
                    (row["key"], json.dumps(content)),
                )


def _environment(connection: sqlite3.Connection, settings: dict[str, Any]) -> int:
    """Number of an environment, from 0 in the order in which they came."""
    text = json.dumps(settings, sort_keys=True)
    connection.execute(
        "INSERT OR IGNORE INTO environments SELECT count(*), ? FROM environments", (text,)
    )
    found = connection.execute("SELECT id FROM environments WHERE settings = ?", (text,))
    return int(found.fetchone()[0])


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(
        f"file:{quote(str(path))}?mode={mode}", uri=True, timeout=_PATIENCE, isolation_level=None
    )


@contextmanager
def _transaction(connection: sqlite3.Connection) -> Iterator[None]:
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


def _create(connection: sqlite3.Connection) -> None:
    """Make the tables of an empty file, all or none."""
    with _transaction(connection):
        if not _tables(connection):
            for statement in _TABLES:
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {_APPLICATION}")
            connection.execute(f"PRAGMA user_version = {SCHEMA}")


def _tables(connection: sqlite3.Connection) -> set[str]:
    return {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}


def _check(connection: sqlite3.Connection, path: Path, empty: bool) -> None:
    """Raise unless a file is a store of this version, or empty where that will do."""
    tables = _tables(connection)
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if not tables and application == 0 and version == 0:
        if empty:
            return
        raise StoreError(f"the store {path} is empty: no study has written to it yet.")
    if application != _APPLICATION:
        raise StoreError(
            f"{path} is an SQLite file of another program, not a store of qpmhe; name another."
        )
    if version != SCHEMA:
        raise StoreError(
            f"the store {path} has schema version {version}; this qpmhe reads version {SCHEMA}. "
            "Use the qpmhe that wrote it, or name another file for a new store."
        )
    (page,) = connection.execute("PRAGMA page_size").fetchone()
    if path.stat().st_size % page:  # SQLite would read zeros there
        raise ValueError("its last page is cut off")


def _check_file(path: Path) -> None:
    if path.exists() and not path.is_file():
        raise StoreError(f"the store {path} is no regular file; name one, such as study.sqlite.")


@contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that sees one moment, also while another process writes."""
    if not path.exists():
        raise StoreError(f"there is no store {path}; run a study first, or check the name.")
    _check_file(path)
    with _explained(path), closing(_connect(path, "rw")) as connection:
        connection.execute("BEGIN")
        _check(connection, path, empty=False)
        yield connection


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Give errors of SQLite, and of content that cannot be decoded, with name and remedy."""
    try:
        yield
    except QpmheError:
        raise
    except (sqlite3.Error, ValueError, TypeError, LookupError, AttributeError) as error:
        # The primary code: SQLITE_READONLY for SQLITE_READONLY_DIRECTORY.
        code = "_".join(getattr(error, "sqlite_errorname", "").split("_")[:2])
        raise StoreError(
            f"the store {path}: {_REMEDIES.get(code, _DAMAGED)} ({error})."
        ) from error
