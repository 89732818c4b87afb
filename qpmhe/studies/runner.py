"""Run a study: the missing cells, on the cores of this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from qpmhe_solvers import backend

from .._checks import count
from ..errors import OptionError
from .cell import OBSERVER, Task
from .environment import revision
from .errors import StudyError
from .grid import Study
from .pool import Pool, local
from .store import Store

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["run"]


def run(
    study: Study,
    store: Store | str | Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: bool | Console = True,
    retry_failed: bool = False,
) -> Store:
    """Run the cells of a study that the store does not have, and store each as it ends.

    Ended at any moment, in whatever way, it loses no finished cell; the same call goes on. A
    cell that fails is a row with its reason.

    Parameters
    ----------
    study : Study
        What to run.
    store : Store, str or Path
        Where results go. Cells of other studies may be in it.
    jobs : int, optional
        Cells at a time on this machine; as many as there are cores if left out, one if only
        times are measured.
    scheduler : str, optional
        Address of a Dask scheduler, whose workers run the cells in place of this machine.
    progress : bool or rich.console.Console
        Whether (and where) a progress bar is shown; on the standard error stream by default.
    retry_failed : bool
        Whether cells that failed before run again.

    Returns
    -------
    Store
        The store.

    Raises
    ------
    StoreError
        If the store cannot be used, or no longer.
    SchedulerError
        If the cluster cannot be reached, or no longer.
    InvalidInputError
        If an argument does not fit, or a package is missing.
    """
    if not isinstance(study, Study):
        raise StudyError(f"the study is {study!r}; expected a qpmhe.studies.Study.")
    if jobs is not None:
        count("jobs", jobs, 1)
        if scheduler is not None:
            raise OptionError("jobs is for this machine; with a scheduler, leave it out.")
    target = store if isinstance(store, Store) else Store(store)
    pool = local(study, jobs) if scheduler is None else _cluster(scheduler)
    try:
        with target.writing() as writer:
            writer.begin(
                {**study.settings(), "jobs": pool.jobs, "scheduler": scheduler},
                {source.name: source.fingerprint for source in study.sources},
            )
            tasks, found = _tasks(study, writer.present(retry_failed), pool.jobs > 1)
            git = revision()
            with _shown(progress, len(tasks), found) as advance:
                for result in pool.results(tasks):
                    result["environment"] = {**result["environment"], "git": git}
                    writer.put(result)
                    advance(result["outcome"] == "failed")
    finally:
        pool.close()
    return target


def _cluster(address: str) -> Pool:
    from .cluster import ClusterPool

    return ClusterPool(address)


def _tasks(
    study: Study, present: dict[str, frozenset[str]], shared: bool
) -> tuple[list[Task], int]:
    """What is missing, and how many cells are there already."""
    parts = {"both": {"accuracy", "time"}, "accuracy": {"accuracy"}, "time": {"time"}}
    wanted = frozenset(parts[study.measure] | ({"covariance"} if study.covariances else set()))
    sources = {source.name: source for source in study.sources}
    tasks, found, seen = [], 0, set()
    for cell in study.cells():
        first = cell.configuration not in seen
        seen.add(cell.configuration)
        missing = wanted - present.get(cell.key, frozenset())
        if not missing:
            found += 1
            continue
        entry = None if cell.backend == OBSERVER else backend(cell.backend)
        tasks.append(
            Task(
                cell, sources[cell.model], missing, study.cell_timeout,
                keep=first, shared=shared, entry=entry,
            )
        )
    return tasks, found


@contextmanager
def _shown(
    progress: bool | Console, missing: int, found: int
) -> Iterator[Callable[[bool], None]]:
    """A progress bar, and what moves it on by one cell."""
    if progress is False:
        yield lambda _failed: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True) if progress is True else progress
    total, failures = missing + found, 0
    if found:
        console.print(f"{found} of {total} cells were there already")
    with Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TextColumn("elapsed"), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
        console=console, speed_estimate_period=600.0,
    ) as bar:
        task = bar.add_task("cells", total=total, completed=found)

        def advance(failed: bool) -> None:
            nonlocal failures
            failures += failed
            bar.update(
                task, advance=1, description=f"cells, {failures} failed" if failures else "cells"
            )

        yield advance
