"""SQLite under the store: opening files, and its errors in our words."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import quote

from .errors import StoreError
from .rows import COLUMNS

__all__ = ["SCHEMA", "check", "connect", "create", "insist_on_file", "reading", "told"]

#: Version of the tables.
SCHEMA = 1
# Tells our files from other SQLite files: "qpmh".
_APPLICATION = 0x71706D68
# Seconds to wait for another program's lock.
_PATIENCE = 10.0

_TABLES = (
    f"CREATE TABLE cells ({', '.join(f'{name} {kind}' for name, kind in COLUMNS.items())})",
    "CREATE TABLE environments (id INTEGER PRIMARY KEY, settings TEXT UNIQUE)",
    "CREATE TABLE studies (id INTEGER PRIMARY KEY, settings TEXT, started TEXT)",
    "CREATE TABLE models (name TEXT PRIMARY KEY, fingerprint TEXT)",
    "CREATE TABLE trajectories (key TEXT PRIMARY KEY, header TEXT, numbers BLOB)",
)


def connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open a file.

    Parameters
    ----------
    path : Path
        Which.
    mode : str
        ``rwc`` creates it, ``rw`` does not, ``ro&immutable=1`` needs no lock.
    """
    return sqlite3.connect(
        f"file:{quote(str(path))}?mode={mode}", uri=True, timeout=_PATIENCE, isolation_level=None
    )


def create(connection: sqlite3.Connection) -> None:
    """Make the tables of an empty file, all or none.

    Parameters
    ----------
    connection : sqlite3.Connection
        To a file that is ours or empty.
    """
    connection.execute("PRAGMA journal_mode = WAL")
    # A process that ends loses nothing; a power failure loses the last rows, never the file.
    connection.execute("PRAGMA synchronous = NORMAL")
    connection.execute("BEGIN IMMEDIATE")
    try:
        if not _tables(connection):
            for statement in _TABLES:
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {_APPLICATION}")
            connection.execute(f"PRAGMA user_version = {SCHEMA}")
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


def _tables(connection: sqlite3.Connection) -> set[str]:
    return {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}


def check(connection: sqlite3.Connection, path: Path, empty: bool) -> None:
    """Insist that a file is a store of this version.

    Parameters
    ----------
    connection : sqlite3.Connection
        To the file.
    path : Path
        Its name, for the error text.
    empty : bool
        Whether an empty file will do.

    Raises
    ------
    StoreError
        If it is not.
    """
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
        raise StoreError(f"the store {path}: {_REMEDIES['SQLITE_CORRUPT']}.")


@contextmanager
def reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that changes nothing, also while another process writes.

    All that is read through it is of one moment.

    Parameters
    ----------
    path : Path
        The store.

    Raises
    ------
    StoreError
        If there is no such file, or it cannot be read.
    """
    if not path.exists():
        raise StoreError(f"there is no store {path}; run a study first, or check the name.")
    insist_on_file(path)
    with told(path), closing(_reader(path)) as connection:
        connection.execute("BEGIN")
        check(connection, path, empty=False)
        yield connection


def insist_on_file(path: Path) -> None:
    """Insist that a store is a file, or nothing yet.

    Parameters
    ----------
    path : Path
        The store.

    Raises
    ------
    StoreError
        If it is a folder, a device or the like.
    """
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or the like"
        raise StoreError(f"the store {path} is {what}; name a file, such as study.sqlite.")


def _reader(path: Path) -> sqlite3.Connection:
    connection = connect(path, "rw")
    try:
        connection.execute("PRAGMA query_only = ON")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError as error:
        connection.close()
        if _name(error) not in ("SQLITE_CANTOPEN", "SQLITE_READONLY") or _unwritten(path):
            raise
        # A folder where nothing can be written: nobody else writes to the file, either.
        return connect(path, "ro&immutable=1")
    return connection


def _unwritten(path: Path) -> bool:
    """Whether there is something in the log that is not in the file yet."""
    log = path.with_name(path.name + "-wal")
    return log.exists() and log.stat().st_size > 0


def _name(error: sqlite3.Error) -> str:
    """The primary code: SQLITE_READONLY for SQLITE_READONLY_DIRECTORY."""
    return "_".join(getattr(error, "sqlite_errorname", "").split("_")[:2])


_REMEDIES = {
    "SQLITE_BUSY": "another program has locked it; close that, then give the same command again",
    "SQLITE_LOCKED": "another program has locked it; close that, then give the same command again",
    "SQLITE_READONLY": "it cannot be written; make file and folder writable, or name another file",
    "SQLITE_FULL": (
        "the disk is full; all cells that were stored are safe. Make room, then give the same "
        "command again"
    ),
    "SQLITE_IOERR": (
        "the disk does not read or write; all cells that were stored before are as the disk has "
        "them. Give the same command again when it works"
    ),
    "SQLITE_CANTOPEN": "it cannot be opened; check that the folder exists and can be written",
    "SQLITE_CORRUPT": (
        "it is damaged or truncated and was left as it is; take a copy of before, or name "
        "another file"
    ),
    "SQLITE_NOTADB": "it is no SQLite file and was left as it is; name another",
}


@contextmanager
def told(path: Path) -> Iterator[None]:
    """Tell SQLite's errors within the block in our words.

    Parameters
    ----------
    path : Path
        The store.

    Raises
    ------
    StoreError
        In place of any error of SQLite's.
    """
    try:
        yield
    except sqlite3.Error as error:
        remedy = _REMEDIES.get(_name(error), "SQLite cannot go on")
        raise StoreError(f"the store {path}: {remedy} ({error}).") from error
