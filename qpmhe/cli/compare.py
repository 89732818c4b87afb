"""``qpmhe compare``, ``qpmhe study`` and ``qpmhe export``: studies from the command line."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console

from ..errors import InvalidInputError, OptionError
from ..studies.errors import StudyError
from ..studies.grid import Study
from ..studies.runner import run
from ..studies.store import Store
from ..studies.study_file import WORDS
from ..studies.table_file import export as write_table

__all__ = ["compare", "export", "study"]


def compare(
    console: Console,
    *,
    store: Path,
    out: Path,
    models: Sequence[str] = ("batch_reactor",),
    backends: Sequence[str] | None = None,
    qps: str = "0,1,2,5,converged",
    solver_iterations: str = "1,2,5,10,none",
    horizons: str = "default",
    starts: Sequence[str] = ("candidate",),
    seeds: int = 20,
    steps: int | None = None,
    measure: str = "both",
    deadline: float | None = None,
    covariances: bool = False,
    cell_timeout: float = 60.0,
    jobs: int | None = None,
    scheduler: str | None = None,
    retry_failed: bool = False,
) -> None:
    """Run a study given by options, show its summary, and write its report.

    Parameters
    ----------
    console : rich.console.Console
        Where to print.
    store : Path
        Where the results go; a run that was ended goes on from there.
    out : Path
        Folder of the report.
    models, backends, starts, seeds, steps, measure, deadline, covariances, cell_timeout
        As of `qpmhe.studies.Study`; no backends stand for all installed ones.
    qps, solver_iterations, horizons : str
        Numbers between commas; ``converged``, ``none`` and ``default`` stand for None.
    jobs, scheduler, retry_failed
        As of `qpmhe.studies.run`.

    Raises
    ------
    QpmheError
        If an option does not fit, the store or cluster cannot be used, or all cells failed.
    """
    _run(
        console,
        Study(
            models=models, backends=backends or None,
            qps=_numbers("qps", qps),
            solver_iterations=_numbers("solver_iterations", solver_iterations),
            horizons=_numbers("horizons", horizons),
            starts=starts, seeds=seeds, steps=steps, measure=measure, deadline=deadline,
            covariances=covariances, cell_timeout=cell_timeout,
        ),
        store, out, jobs=jobs, scheduler=scheduler, retry_failed=retry_failed,
    )


def study(
    console: Console,
    file: Path,
    *,
    store: Path | None = None,
    out: Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    retry_failed: bool = False,
) -> None:
    """Run a study given by a TOML file, show its summary, and write its report.

    Parameters
    ----------
    console : rich.console.Console
        Where to print.
    file : Path
        The study; see `qpmhe.studies.study_file`.
    store : Path, optional
        Where the results go; if left out, beside the file, with its name in .sqlite.
    out : Path, optional
        Folder of the report; if left out, beside the store, named after it.
    jobs, scheduler, retry_failed
        As of `qpmhe.studies.run`.

    Raises
    ------
    QpmheError
        If the file does not fit, the store or cluster cannot be used, or all cells failed.
    """
    target = file.with_suffix(".sqlite") if store is None else store
    _run(
        console, Study.from_toml(file), target,
        target.with_name(f"{target.stem}-report") if out is None else out,
        jobs=jobs, scheduler=scheduler, retry_failed=retry_failed,
    )


def export(console: Console, store: Path, file: Path) -> None:
    """Write a store's rows into a CSV or Parquet file.

    Parameters
    ----------
    console : rich.console.Console
        Where to print.
    store : Path
        The store.
    file : Path
        The file, in .csv or .parquet.

    Raises
    ------
    QpmheError
        If the store cannot be read, or the file not written.
    """
    console.print(f"wrote {write_table(store, file)}", highlight=False)


def _run(console: Console, what: Study, store: Path, out: Path, **options: Any) -> None:
    from .report import report

    try:
        store.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"cannot make the folder {store.parent}: {error.strerror}."
        ) from error
    target = Store(store)
    try:
        with _terminated_as_interrupted():
            run(what, target, progress=console, **options)
    except (KeyboardInterrupt, SystemExit):
        console.print(f"stopped; what was finished is in {store}: the same command goes on.")
        raise
    frame = target.frame()
    cells = frame[frame["key"].isin({cell.key for cell in what.cells()})]
    failed = cells[cells["outcome"] == "failed"]
    if 0 < len(failed) < len(cells):
        console.print(
            f"[yellow]{len(failed)} of {len(cells)} cells failed; their rows tell why.[/]",
            highlight=False,
        )
    report(console, store, out)
    if 0 < len(failed) == len(cells):
        raise StudyError(
            f"no cell of the study was finished, {len(failed)} failed; the first for this reason: "
            f"{failed['reason'].iloc[0].rstrip('.')}. When that is put right, give the same "
            "command with --retry-failed."
        )


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Within the block SIGTERM ends worker processes and progress bar before this process."""
    def leave(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    if threading.current_thread() is not threading.main_thread():  # signals are not for it
        yield
        return
    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _numbers(name: str, text: str) -> list[int | None]:
    """The numbers of an option, in which a word stands for None."""
    found: list[int | None] = []
    for item in text.split(","):
        word = item.strip()
        try:
            found.append(None if word == WORDS[name] else int(word))
        except ValueError as error:
            option = name.replace("_", "-")
            raise OptionError(
                f"--{option} has {word!r}; expected integers between commas, or {WORDS[name]!r}."
            ) from error
    return found
