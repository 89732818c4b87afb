"""The results of a study in one SQLite file."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from .._checks import checked_path, need
from ..errors import InvalidInputError, OptionError, QpmheError
from .cell import Cell

if TYPE_CHECKING:
    from pandas import DataFrame

#: Version of the tables, and of what their columns mean.
SCHEMA = 2
# Distinguishes our files from other SQLite files: "qpmh".
_APPLICATION = 0x71706D68
# Seconds to wait for another program's lock.
_PATIENCE = 10.0

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
# Columns that only one part of a measurement fills; the others come with each.
_PARTS = {
    "accuracy": ("cost_ratio",),
    "time": ("time_median", "time_p95", "time_p99", "time_max", "times", "shared"),
    "covariance": ("nees",),
}
_JSON = ("rmse_states", "rmse_settled_states", "reasons")
_REAL = tuple(name for name, kind in COLUMNS.items() if kind == "REAL")
_SHARES = ("improved", "kept", "fallback", "cap_hits")
_TYPES = {
    **dict.fromkeys((*_REAL, "late"), "float64"),
    **dict.fromkeys(("qps", "solver_iterations"), "Int64"),
    **dict.fromkeys(("horizon", "seed", "steps", "environment"), "int64"),
    **dict.fromkeys(
        ("key", "model", "backend", "start", "outcome", "reason", "finished"), "object"
    ),
}
_TABLES = (
    f"CREATE TABLE cells ({', '.join(f'{name} {kind}' for name, kind in COLUMNS.items())})",
    "CREATE TABLE environments (id INTEGER PRIMARY KEY, settings TEXT UNIQUE)",
    "CREATE TABLE studies (id INTEGER PRIMARY KEY, settings TEXT, started TEXT)",
    "CREATE TABLE models (name TEXT PRIMARY KEY, fingerprint TEXT)",
    "CREATE TABLE trajectories (key TEXT PRIMARY KEY, header TEXT, numbers BLOB)",
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
    "SQLITE_CORRUPT": _DAMAGED,
    "SQLITE_ERROR": _DAMAGED,  # a table or column that we made is not there
    "": _DAMAGED,  # text that cannot be decoded
    "SQLITE_NOTADB": "it is no SQLite file and was left as it is; name another",
}


class StoreError(QpmheError):
    """A store that cannot be read or written; what it holds stays as it is."""


class Store:
    """A file of results, which `run` writes and everybody may read meanwhile.

    ``path`` is the file, which need not exist until something is read. Reading raises `StoreError`
    where there is no store, or none that can be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = checked_path("the store", path)

    def __repr__(self) -> str:
        return f"Store({str(self.path)!r})"

    def frame(self) -> DataFrame:
        """All cells as a pandas.DataFrame, one row each, in the order of their keys' first storing.

        Its columns are

        - key, model, backend, qps (NA: to convergence), solver_iterations (NA: no cap), horizon,
          start, seed, steps: the cell;
        - outcome ("done", "failed") and reason;
        - rmse, rmse_settled, rmse_states, rmse_settled_states, nees, cost_ratio, improved, kept,
          fallback, reasons, cap_hits, qps_mean, solver_iterations_mean: see
          `qpmhe.studies.metrics`;
        - time_median, time_p95, time_p99, time_max [s], late (share of steps over the last study's
          deadline), times (seconds of each step, None where not measured), shared (whether other
          cells ran meanwhile);
        - environment (index into ``meta()["environments"]``) and finished (UTC).
        """
        pandas = need("pandas", "a data frame of results")
        names = [name for name in COLUMNS if name != "parts"]
        with _reading(self.path) as connection:
            found = connection.execute(f"SELECT {', '.join(names)} FROM cells ORDER BY rowid")
            rows = [_checked(dict(zip(names, row, strict=True))) for row in found]
            last = connection.execute(
                "SELECT settings FROM studies ORDER BY id DESC LIMIT 1"
            ).fetchone()
            deadline = json.loads(last[0])["deadline"] if last else None
            for row in rows:
                measured = row["times"] is not None and deadline is not None
                row["late"] = float((row["times"] > deadline).mean()) if measured else float("nan")
            names.insert(names.index("times"), "late")
            columns = {name: [row[name] for row in rows] for name in names}
            frame = pandas.DataFrame(columns, columns=names).astype(_TYPES)
            whole: DataFrame = frame.assign(shared=frame["shared"].astype("bool"))
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
                "SELECT header, numbers FROM trajectories WHERE key = ?", (key,)
            ).fetchone()
            return None if found is None else _unpacked(*found)

    @contextmanager
    def writing(self) -> Iterator[Writer]:
        """Open for writing, one process at a time; the file is made if it does not exist.

        Raises `StoreError` if it is no store of this version, damaged, read-only, or another study
        writes.
        """
        _check_file(self.path)
        with (
            _alone(self.path), _explained(self.path),
            closing(_connect(self.path, "rwc")) as connection,
        ):
            _check(connection, self.path, empty=True)
            (answer,) = connection.execute("PRAGMA quick_check(1)").fetchone()
            if answer != "ok":
                raise StoreError(f"the store {self.path}: {_DAMAGED} ({answer}).")
            _create(connection)
            yield Writer(self.path, connection)


class Writer:
    """Stores results, one transaction each; `Store.writing` makes it."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self._path, self._connection = path, connection

    def begin(self, settings: dict[str, Any], fingerprints: dict[str, str]) -> None:
        """Note that a study begins, with its settings and the fingerprints of its models' files."""
        connection = self._connection
        with _explained(self._path), _transaction(connection):
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
        """The parts that each cell has; if failed cells are to be retried, without those."""
        where = "WHERE outcome = 'done'" if retry_failed else ""
        with _explained(self._path), _undamaged(self._path):
            rows = self._connection.execute(f"SELECT key, parts FROM cells {where}").fetchall()
            return {key: frozenset(parts.split(",")) for key, parts in rows}

    def put(self, result: dict[str, Any]) -> None:
        """Store what `qpmhe.studies.cell.compute` gives."""
        connection = self._connection
        with _explained(self._path), _transaction(connection):
            row = {name: result.get(name) for name in COLUMNS}
            row["environment"] = _environment(connection, result["environment"])
            row["finished"] = _now()
            _merge(connection, row)
            if "trajectory" in result:
                connection.execute(
                    "INSERT OR REPLACE INTO trajectories VALUES (?, ?, ?)",
                    (row["key"], *_packed(result["trajectory"])),
                )


def export(store: Store | str | Path, path: str | Path) -> Path:
    """Write all cells of a store into the file ``path``, ``.csv`` or ``.parquet``, and return it.

    In CSV, lists and ``reasons`` are JSON texts; in Parquet, only ``reasons`` is. An existing file
    is replaced. Raises `OptionError` if the name ends differently, `StoreError` if the store
    cannot be read, `InvalidInputError` if the file cannot be written or a package is missing.
    """
    target = checked_path("the file", path)
    if target.suffix not in (".csv", ".parquet"):
        raise OptionError(f"the file is {str(path)!r}; expected a name in .csv or .parquet.")
    frame = (store if isinstance(store, Store) else Store(store)).frame()
    lists = ("rmse_states", "rmse_settled_states", "times") if target.suffix == ".csv" else ()
    for name in ("reasons", *lists):
        frame[name] = frame[name].map(_text)
    try:
        if target.suffix == ".csv":
            frame.to_csv(target, index=False)
        else:
            need("pyarrow", "a Parquet file")
            frame.to_parquet(target, engine="pyarrow", index=False)
    except OSError as error:
        raise InvalidInputError(f"cannot write {target}: {error.strerror or error}.") from error
    return target


def _text(value: Any) -> str | None:
    if value is None or isinstance(value, float):  # pandas may put NaN for None
        return None
    return json.dumps(value if isinstance(value, (list, dict)) else value.tolist())


def _encoded(name: str, value: Any) -> Any:
    if value is None:
        return None
    if name in _JSON:
        return json.dumps(value)
    if name == "times":
        return np.asarray(value, np.float32).tobytes()
    return ",".join(sorted(value)) if name == "parts" else value


def _checked(row: dict[str, Any]) -> dict[str, Any]:
    """A row of cells, decoded; raises any exception where it cannot be what was stored."""
    found = {name: _decoded(name, value) for name, value in row.items()}
    cell = Cell(**{one.name: found[one.name] for one in fields(Cell)})
    done = found["outcome"] == "done"
    lists, reasons = [found["rmse_states"], found["rmse_settled_states"]], found["reasons"]
    if (
        cell.key != found["key"]
        or found["outcome"] not in ("done", "failed")
        or (done and not all(isinstance(one, list) and np.ndim(one) == 1 for one in lists))
        or (done and not all(number >= 0 for number in reasons.values()))
        or not all(found[name] >= 0 for name in ("horizon", "seed", "steps", "environment"))
        or any(found[name] < 0.0 for name in _REAL)
        or any(found[name] > 1.0 for name in _SHARES)
    ):
        raise ValueError(f"a value of the cell {found['key']}")
    return found


def _decoded(name: str, value: Any) -> Any:
    if name in _REAL:
        return float("nan") if value is None else float(value)
    if value is None:
        return None
    if name in _JSON:
        return json.loads(value)
    return np.frombuffer(value, np.float32) if name == "times" else value


def _merge(connection: sqlite3.Connection, row: dict[str, Any]) -> None:
    """Insert a row, or add to the one that is there what was measured now."""
    found = connection.execute(
        "SELECT outcome, parts FROM cells WHERE key = ?", (row["key"],)
    ).fetchone()
    written = set(COLUMNS)
    if found is not None and found[0] == "done":
        for part, columns in _PARTS.items():
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
        [_encoded(name, row[name]) for name in names],
    )


def _environment(connection: sqlite3.Connection, settings: dict[str, Any]) -> int:
    """Number of an environment, from 0 in the order in which they came."""
    text = json.dumps(settings, sort_keys=True)
    connection.execute(
        "INSERT OR IGNORE INTO environments SELECT count(*), ? FROM environments", (text,)
    )
    found = connection.execute("SELECT id FROM environments WHERE settings = ?", (text,))
    return int(found.fetchone()[0])


def _packed(trajectory: dict[str, Any]) -> tuple[str, bytes]:
    names = ("times", "states", "estimates")
    header = {name: value for name, value in trajectory.items() if name not in names}
    header["shape"] = list(trajectory["states"].shape)
    numbers = np.concatenate([np.ravel(trajectory[name]) for name in names])
    return json.dumps(header), numbers.astype(np.float64).tobytes()


def _unpacked(packed: str, numbers: bytes) -> dict[str, Any]:
    header = json.loads(packed)
    rows, n = header.pop("shape")
    values = np.frombuffer(numbers)
    found = {
        "times": values[:rows],
        "states": values[rows : rows * (n + 1)].reshape(rows, n),
        "estimates": values[rows * (n + 1) :].reshape(rows, n),
        **header,
    }
    if len(found["labels"]) != n or not isinstance(found["time_unit"], str):
        raise ValueError("the labels of a run")
    return found


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
    connection.execute("PRAGMA journal_mode = WAL")
    # A process that ends loses nothing; a power failure loses the last rows, never the file.
    connection.execute("PRAGMA synchronous = NORMAL")
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
    if not _unwritten(path) and path.stat().st_size % page:  # SQLite would read zeros there
        raise StoreError(f"the store {path}: {_DAMAGED}.")


def _check_file(path: Path) -> None:
    if path.exists() and not path.is_file():
        raise StoreError(f"the store {path} is no regular file; name one, such as study.sqlite.")


@contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that changes nothing and sees one moment, also while another process writes."""
    if not path.exists():
        raise StoreError(f"there is no store {path}; run a study first, or check the name.")
    _check_file(path)
    with _undamaged(path), _explained(path), closing(_reader(path)) as connection:
        connection.execute("BEGIN")
        _check(connection, path, empty=False)
        yield connection


def _reader(path: Path) -> sqlite3.Connection:
    connection = _connect(path, "rw")
    try:
        connection.execute("PRAGMA query_only = ON")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError as error:
        connection.close()
        if _code(error) not in ("SQLITE_CANTOPEN", "SQLITE_READONLY") or _unwritten(path):
            raise
        # A folder where nothing can be written: nobody else writes to the file, either.
        return _connect(path, "ro&immutable=1")
    return connection


def _unwritten(path: Path) -> bool:
    """Whether the log holds something that the file does not yet."""
    log = path.with_name(path.name + "-wal")
    return log.exists() and log.stat().st_size > 0


def _code(error: sqlite3.Error) -> str:
    """The primary code: SQLITE_READONLY for SQLITE_READONLY_DIRECTORY."""
    return "_".join(getattr(error, "sqlite_errorname", "").split("_")[:2])


@contextmanager
def _undamaged(path: Path) -> Iterator[None]:
    """Report content that cannot be decoded as damage."""
    try:
        yield
    except QpmheError:
        raise
    except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError) as error:
        raise StoreError(f"the store {path}: {_DAMAGED} ({error}).") from error


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Give SQLite's errors with the store's name and a remedy."""
    try:
        yield
    except sqlite3.Error as error:
        remedy = _REMEDIES.get(_code(error), "SQLite cannot go on")
        raise StoreError(f"the store {path}: {remedy} ({error}).") from error


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Hold a lock, which ends with the process, however that ends."""
    beside = path.with_name(path.name + "-lock")
    with _explained(path):
        lock = _connect(beside, "rwc")
    with closing(lock):
        try:
            lock.execute("PRAGMA busy_timeout = 0")
            lock.execute("PRAGMA journal_mode = MEMORY")
            lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            if _code(error) == "SQLITE_BUSY":
                raise StoreError(
                    f"another study is writing to the store {path}; wait for its end, or name "
                    "another file."
                ) from error
            with _explained(path):
                raise
        try:
            yield
        finally:
            with suppress(OSError):
                os.remove(beside)
