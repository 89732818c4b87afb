"""A clock that ends a worker whose cell does not come back, and notes on what it was at."""

from __future__ import annotations

import faulthandler
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from time import monotonic, sleep
from typing import IO

from .cell import OBSERVER, Task

__all__ = ["deaths", "died", "folder_of", "noted", "second_attempt", "watched"]

_LOCK = threading.Lock()
_LIMITS: dict[object, tuple[float, IO[str] | None]] = {}
_NOTES: dict[Path, IO[str]] = {}
# How the words begin that Python's clock leaves behind.
_HUNG = "Timeout ("


@contextmanager
def watched(task: Task) -> Iterator[None]:
    """End this process if the block takes longer than the task's hard limit.

    The clock runs in C, so that it ends a solver that hangs without giving Python a turn.
    A file in the folder of notes names the cell while it runs; after a crash or the hard
    limit it tells where that was.

    Parameters
    ----------
    task : Task
        What runs.
    """
    notes, mine = _begin(task), object()
    if task.parent is not None:
        _end_with(task.parent, task.notes)
    with _LOCK:
        _LIMITS[mine] = monotonic() + task.hard_limit, notes
        _arm()
    try:
        yield
    finally:
        with _LOCK:
            del _LIMITS[mine]
            _arm()
        if notes is not None:
            notes.seek(0)
            notes.truncate()


@lru_cache(maxsize=1)
def _end_with(parent: int, notes: str | None) -> None:
    """End this process soon after its parent, which may be killed without a word."""

    def wait() -> None:
        while os.getppid() == parent:
            sleep(1.0)
        if notes is not None:
            shutil.rmtree(folder_of(notes), ignore_errors=True)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _arm() -> None:
    """Set the clock, of which a process has one, to the limit that ends first."""
    if not _LIMITS:
        faulthandler.cancel_dump_traceback_later()
        return
    limit, notes = min(_LIMITS.values(), key=lambda item: item[0])
    file = notes or sys.__stderr__
    if file is not None:
        faulthandler.dump_traceback_later(max(limit - monotonic(), 0.001), exit=True, file=file)


def folder_of(notes: str) -> Path:
    """The folder of a run's notes on this machine.

    Parameters
    ----------
    notes : str
        Its name.
    """
    return Path(tempfile.gettempdir()) / notes


def _begin(task: Task) -> IO[str] | None:
    if task.notes is None:
        return None
    path = folder_of(task.notes) / f"{os.getpid()}-{threading.get_ident()}.txt"
    try:
        if path not in _NOTES:
            path.parent.mkdir(exist_ok=True)
            _NOTES[path] = path.open("w", encoding="utf-8")
        notes = _NOTES[path]
        faulthandler.enable(file=notes)
        notes.seek(0)
        notes.truncate()
        notes.write(task.cell.key + "\n")
        notes.flush()
    except OSError:  # no room for notes: the cell runs without
        return None
    return notes


def noted(notes: str) -> dict[str, list[str]]:
    """Last words of the workers of this machine that ended within a cell, by its key.

    Parameters
    ----------
    notes : str
        Name of the run's folder.
    """
    found: dict[str, list[str]] = {}
    for path in folder_of(notes).glob("*.txt"):
        with suppress(OSError):
            key, _, words = path.read_text(encoding="utf-8", errors="replace").partition("\n")
            if key:
                found.setdefault(key, []).append(words)
    return found


def deaths(task: Task) -> list[str]:
    """Last words of the workers of this machine that ended within this cell.

    Parameters
    ----------
    task : Task
        The cell.
    """
    return [] if task.notes is None else noted(task.notes).get(task.cell.key, [])


def died(words: list[str]) -> str | None:
    """Why a cell at which workers died is not to be run again, if so.

    Parameters
    ----------
    words : list of str
        Their last words.
    """
    for text in words:
        if text.startswith(_HUNG):
            return f"out of time: the process that ran it was ended{_place(text)}"
    if len(words) > 1:
        return f"the process that ran it died, twice{_place(max(words, key=len))}"
    return None


def second_attempt(task: Task, words: list[str]) -> Task:
    """The cell as it is to be run again after a worker died at it.

    Where a crash of compiled code ended the worker, the backend gets a process of its own: if
    it is to blame, only its QPs fail. A worker that was killed from outside says nothing, and
    its cell runs as before.

    Parameters
    ----------
    task : Task
        The cell.
    words : list of str
        Last words of the workers that ended within it.
    """
    crashes = [fatal for text in words if (fatal := _signal(text))]
    if not crashes or task.cell.backend == OBSERVER:
        return task
    return replace(task, isolated=f"a process of its own, since the first one died ({crashes[0]})")


def _signal(words: str) -> str:
    """What the signal that ended a process was called; empty where there was none."""
    return words.partition("Fatal Python error: ")[2].partition("\n")[0]


def _place(words: str) -> str:
    """Where Python was, and what the signal was called."""
    fatal = _signal(words)
    told = f" ({fatal})" if fatal else ""
    for thread in words.split("\n\n"):
        lines = [line.strip() for line in thread.splitlines() if line.startswith("  File ")]
        if any("compute.py" in line for line in lines):
            return f"{told}, in {lines[0].removeprefix('File ')}"
    return told
