"""Run a study: the missing cells, in processes of this machine or on a Dask cluster."""

from __future__ import annotations

import asyncio
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent import futures
from concurrent.futures import BrokenExecutor, CancelledError, Future, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any

from qpmhe_solvers import backend
from qpmhe_solvers.values import shown

from .._checks import dimension, flag, make_folder, need
from ..errors import OptionError
from ..models.loading import file_of
from .cell import ENGINE, Task, compute, failure
from .environment import environment, revision
from .grid import Study, StudyError
from .row import OBSERVER, StudyRow
from .store import Store

if TYPE_CHECKING:
    from rich.console import Console

# Seconds to reach a scheduler, and without any worker before giving up.
_CONNECT, _PATIENCE = 15.0, 60.0
# Seconds for which a worker process waits for work; those of a killed study end then.
_IDLE = 20.0
# Seconds beyond its hard limit after which a cell of a cluster is given up.
_GRACE = 10.0
_THREADS = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
     "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
_HUNG = "out of time: the process that ran it did not answer and was ended"
_SIGNALS = re.compile(r"exit codes of the workers are \{(.*?)\}")


def run(
    study: Study, store: Store | str | Path, *, jobs: int | None = None,
    scheduler: str | None = None, progress: bool | Console = True, retry_failed: bool = False,
    keep_failing: str | Path | None = None,
) -> Store:
    """Run the cells of a study that the store does not have, and store each as it ends.

    A study that is stopped or killed loses no finished cell; the same call resumes it. A cell
    that fails is a row with its reason. If a cell kills its worker process, it runs once more
    alone, then with the solver in another process; no other cell is lost.

    Parameters
    ----------
    study : Study
        What to run.
    store : Store, str or Path
        Where results go. It may hold cells of other studies.
    jobs : int, optional
        Cells that run at a time on this machine; by default the number of cores, or one if only
        times are measured.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``tcp://10.0.0.1:8786``, whose workers run the cells
        instead; best with one thread each.
    progress : bool or rich.console.Console
        Whether (and where) to show a progress bar; on the standard error stream by default.
    retry_failed : bool
        Whether cells that failed before run again.
    keep_failing : str or Path, optional
        Folder for QPs on which a backend failed, as `qpmhe.solvers.Recording` keeps them, at most
        20 in a folder for each cell that runs. Such a cell runs twice: writing takes time.

    Returns
    -------
    Store
        The store.

    Raises
    ------
    StoreError, StudyError
        If the store or the cluster cannot be used, or fails during the run.
    InvalidInputError
        If an argument does not fit, or a package is missing.
    """
    if not isinstance(study, Study):
        raise StudyError(f"the study is {shown(study)}; expected a qpmhe.studies.Study.")
    if jobs is not None:
        dimension("jobs", jobs, 1)
        if scheduler is not None:
            raise OptionError("jobs is for this machine; with a scheduler, leave it out.")
    flag("retry_failed", retry_failed)
    if not isinstance(progress, bool) and not hasattr(progress, "print"):
        raise OptionError(
            f"progress is {shown(progress)}; expected True, False or a rich.console.Console."
        )
    failing = None if keep_failing is None else make_folder(keep_failing).resolve()
    target = store if isinstance(store, Store) else Store(store)
    alone = study.measure == "time"  # other cells would share the cores
    made = (
        _Processes(jobs or (1 if alone else environment()["cores"])) if scheduler is None
        else _Cluster(scheduler)
    )
    with closing(made) as workers, target.writing() as writer:
        writer.begin(
            {
                **study.settings(), "engine": ENGINE, "jobs": workers.jobs, "scheduler": scheduler,
            },
            {f"model {source.name!r}": source.fingerprint for source in study.sources}
            | {
                f"{one.kind} {name!r}": f"{one.name} {one.fingerprint}"
                for group in study.makers.values() for name, one in group.items()
            },
        )
        tasks, found = _tasks(study, writer.present(retry_failed), workers.jobs > 1, failing)
        git = revision()
        with _shown(progress, len(tasks), found) as advance:
            for result in _results(workers, tasks):
                writer.put(replace(result, environment={**result.environment, "git": git}))
                advance(result.outcome == "failed")
    return target


class _Processes:
    """Processes of this machine, each with one thread."""

    def __init__(self, jobs: int) -> None:
        need("joblib", "a study")
        from joblib.externals.loky import ProcessPoolExecutor

        self._make = partial(ProcessPoolExecutor, jobs, timeout=_IDLE, env=_THREADS)
        self.jobs = jobs
        self._executor: Any = None

    def submit(self, task: Task) -> Future[StudyRow]:
        if self._executor is None:
            self._executor = self._make()
        future: Future[StudyRow] = self._executor.submit(compute, task)
        return future

    def ready(self) -> bool:
        return True

    def restart(self) -> None:
        """Replace workers that may have died."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, kill_workers=True)
            self._executor = None

    def close(self) -> None:
        """End the workers."""
        if self._executor is not None:
            sleep(0.1)  # loky raises in its thread where it is ended right after a submission
        self.restart()


class _Cluster:
    """Workers of a Dask cluster, which replaces those that die."""

    def __init__(self, address: str) -> None:
        distributed = need("distributed", "a study on a cluster", "dask")
        self._address = address
        try:
            if "workers" not in _identity(distributed, address, _CONNECT):
                raise ValueError("no scheduler answers there")
            self._client = distributed.Client(address, timeout=_CONNECT, set_as_default=False)
        except Exception as error:  # anything may answer at an address
            raise self._refused(error) from error
        try:
            self._client.wait_for_workers(1, timeout=_CONNECT)
        except Exception as error:
            self.close()
            raise self._refused(error) from error
        self.jobs = sum(self._client.ncores().values())
        self._executor = self._client.get_executor(pure=False)
        self._seen = monotonic()

    def _refused(self, error: Exception) -> StudyError:
        return StudyError(
            f"the scheduler is {shown(self._address)}, which gives no Dask workers "
            f"({str(error) or type(error).__name__}); start one with 'dask scheduler' and workers "
            "with 'dask worker ADDRESS --nthreads 1', and give the address that it shows, such as "
            "tcp://10.0.0.1:8786."
        )

    def submit(self, task: Task) -> Future[StudyRow]:
        future: Future[StudyRow] = self._executor.submit(compute, task)
        return future

    def ready(self) -> bool:
        if self._client.status == "running" and self._client.scheduler_info()["workers"]:
            self._seen = monotonic()
            return True
        if monotonic() - self._seen > _PATIENCE:
            raise self.lost(f"there was no worker for {_PATIENCE:g} s")
        return False

    def lost(self, reason: str) -> StudyError:
        return StudyError(
            f"the cluster of the scheduler at {self._address!r} is gone: {reason}. All cells that "
            "were finished are stored; give the same command again when the cluster is back."
        )

    def restart(self) -> None:
        pass

    def close(self) -> None:
        with suppress(Exception):  # a cluster that is gone has nothing to tidy up
            self._client.close(timeout=5)


def _identity(distributed: Any, address: str, seconds: float) -> dict[str, Any]:
    """What answers at an address; a client that fails to connect can block later ones."""
    async def ask() -> Any:
        arguments = distributed.Security().get_connection_args("client")
        async with distributed.rpc(
            address, timeout=0.8 * seconds, connection_args=arguments
        ) as server:
            return await server.identity()

    async def limited() -> Any:
        return await asyncio.wait_for(ask(), seconds)

    with ThreadPoolExecutor(1) as thread:  # there may be an event loop in this one
        answer = thread.submit(lambda: asyncio.run(limited())).result()
    return answer if isinstance(answer, dict) else {}


def _results(workers: _Processes | _Cluster, tasks: Iterable[Task]) -> Iterator[StudyRow]:
    """The row of each task, in the order in which they end."""
    waiting, suspects = deque(tasks), deque[Task]()
    sent: dict[Future[StudyRow], Task] = {}
    began: dict[Future[StudyRow], float] = {}
    broken = False
    while waiting or sent or suspects:
        # No worker waits for us; but after a death nothing new starts until its cause is found.
        while waiting and not suspects and len(sent) < 2 * workers.jobs:
            try:
                sent[workers.submit(waiting[0])] = waiting[0]
                waiting.popleft()
            except BrokenExecutor:
                broken = True
                break
        for future in islice(sent, workers.jobs):  # tasks start in the order of their sending
            began.setdefault(future, monotonic())
        ended, _ = futures.wait(sent, timeout=1.0, return_when=futures.FIRST_COMPLETED)
        for future in ended:
            task, start = sent.pop(future), began.pop(future, None)
            answer = _answer(workers, task, future, start)
            if isinstance(answer, StudyRow):
                yield answer
            elif start is None:
                waiting.appendleft(task)
            else:
                suspects.append(task)
        if not workers.ready():  # what ran before starts anew with the next worker
            began = dict.fromkeys(began, monotonic())
        for future, start in list(began.items()):
            if monotonic() - start > sent[future].hard_limit + _GRACE:
                del began[future]
                future.cancel()
                suspects.append(sent.pop(future))  # a cluster may have kept it waiting
        if not sent and (suspects or broken):
            while suspects:
                yield _again(workers, suspects.popleft())
            workers.restart()
            broken = False


def _answer(
    workers: _Processes | _Cluster, task: Task, future: Future[StudyRow], start: float | None
) -> StudyRow | Exception:
    """The row of a task that ended, or the error where the process died that may have run it."""
    try:
        return future.result()
    except CancelledError as error:
        if isinstance(workers, _Cluster):
            raise workers.lost("the connection to the scheduler was lost") from error
        raise
    except Exception as error:
        if not isinstance(error, BrokenExecutor) and type(error).__name__ != "KilledWorker":
            return failure(task, f"{type(error).__name__}: {error}")
        if isinstance(error, BrokenExecutor) and start is not None:
            return failure(task, _HUNG) if monotonic() - start >= task.hard_limit else error
        return error


def _again(workers: _Processes | _Cluster, task: Task) -> StudyRow:
    """Run a cell alone at which a process may have died, at last with its solver isolated."""
    words = ""
    for isolated in (False, True) if task.cell.qps != 0 else (False,):
        workers.restart()
        start = monotonic()
        future = workers.submit(replace(task, isolated=isolated))
        # A worker of a cluster may still hang in a cell that was given up.
        if not futures.wait([future], 2 * task.hard_limit + _GRACE).done:
            future.cancel()
            return failure(task, _HUNG)
        answer = _answer(workers, task, future, start)
        if isinstance(answer, StudyRow):
            if isolated and answer.outcome == "done":
                return replace(answer, reason=(
                    "the backend ran in a separate process, since the cell's process died "
                    f"twice{words}"
                ))
            return answer
        signals = _SIGNALS.search(str(answer))
        words = f" ({signals[1]})" if signals else ""
    return failure(task, f"the process that ran it died, twice{words}")


def _tasks(
    study: Study, present: dict[str, frozenset[str]], shared: bool, failing: Path | None
) -> tuple[list[Task], int]:
    """What is missing, and how many cells are there already."""
    parts = {"both": {"accuracy", "time"}, "accuracy": {"accuracy"}, "time": {"time"}}
    wanted = frozenset(parts[study.measure] | ({"covariance"} if study.covariances else set()))
    sources = {source.name: source for source in study.sources}
    tasks, found, seen = [], 0, set()
    for cell in study.cells():
        first = cell.configuration not in seen
        seen.add(cell.configuration)
        known = present.get(cell.key, frozenset())
        if wanted <= known:
            found += 1
            continue
        estimator = study.makers["estimators"].get(cell.backend)
        alone = estimator is not None or cell.backend == OBSERVER
        entry = None if alone else backend(cell.backend)
        # What a model's file defines, other processes know once they have imported the file.
        file = None if entry is None else file_of(entry.factory)
        tasks.append(
            Task(
                cell, sources[cell.model], wanted | known, study.cell_timeout,
                keep=first, shared=shared,
                registered=file or entry, failing=failing,
                observer=study.makers["observers"].get(cell.observer), estimator=estimator,
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
    from rich import progress as bars
    from rich.console import Console

    console = Console(stderr=True) if progress is True else progress
    total, failures = missing + found, 0
    if found:
        console.print(f"{found} of {total} cells were there already")
    with bars.Progress(
        bars.TextColumn("{task.description}"), bars.BarColumn(), bars.MofNCompleteColumn(),
        bars.TextColumn("elapsed"), bars.TimeElapsedColumn(), bars.TextColumn("left"),
        bars.TimeRemainingColumn(), console=console, speed_estimate_period=600.0,
    ) as bar:
        task = bar.add_task("cells", total=total, completed=found)

        def advance(failed: bool) -> None:
            nonlocal failures
            failures += failed
            bar.update(
                task, advance=1, description=f"cells, {failures} failed" if failures else "cells"
            )

        yield advance
