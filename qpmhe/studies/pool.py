"""Where cells run: worker processes of this machine, or of a Dask cluster."""

from __future__ import annotations

import os
import shutil
import warnings
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any
from uuid import uuid4

from .cell import Task
from .compute import Result, compute, failure
from .environment import environment
from .errors import need
from .grid import Study
from .watch import died, folder_of, noted, second_attempt

__all__ = ["LocalPool", "Pool", "local", "quiet_leaving"]

class Pool(ABC):
    """Runs cells; a worker that dies takes no other cell with it.

    Attributes
    ----------
    jobs : int
        Cells at a time.
    """

    jobs: int

    @abstractmethod
    def results(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """The row of each task, in the order in which they end.

        Parameters
        ----------
        tasks : iterable of Task
            What to run.
        """

    @abstractmethod
    def close(self) -> None:
        """End the workers."""


class LocalPool(Pool):
    """Worker processes of this machine, each with one thread.

    Where a worker dies, those that it may have been at are run again, one at a time in a
    fresh process, with the backend in another one if it was a crash; one that dies again failed.

    Parameters
    ----------
    jobs : int
        Cells at a time.
    """

    def __init__(self, jobs: int) -> None:
        self._joblib = need("joblib", "a study")
        self.jobs = jobs
        self._notes = f"qpmhe-study-{uuid4().hex}"

    def results(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """The row of each task; see `Pool.results`."""
        from joblib.externals.loky.process_executor import BrokenProcessPool

        waiting = deque(
            replace(task, notes=self._notes, parent=os.getpid()) for task in tasks
        )
        while waiting:
            flying: dict[str, Task] = {}
            try:
                yield from self._stream(waiting, flying, self.jobs)
            except BrokenProcessPool:
                suspects = self._suspects(flying)
                waiting.extendleft(task for key, task in flying.items() if key not in suspects)
                for key, words in suspects.items():
                    yield self._again(flying[key], words)

    def _stream(
        self, waiting: deque[Task], flying: dict[str, Task], jobs: int
    ) -> Iterator[Result]:
        from joblib.externals.loky.process_executor import BrokenProcessPool

        joblib = self._joblib

        def feed() -> Iterator[Any]:
            while waiting:
                task = waiting.popleft()
                flying[task.cell.key] = task
                yield joblib.delayed(compute)(task)

        # joblib runs a single job in this process, where a crash would end everything: with
        # two workers and one task at a time there is one job in a process of its own.
        with joblib.parallel_config("loky", inner_max_num_threads=1):
            parallel = joblib.Parallel(
                n_jobs=max(jobs, 2), pre_dispatch=1 if jobs == 1 else 2 * jobs,
                batch_size=1, return_as="generator_unordered", max_nbytes=None,
            )
            with quiet_leaving(), closing(parallel(feed())) as answers:
                for result in answers:
                    del flying[result["key"]]
                    yield result
        if flying:  # joblib may end before the error of a worker has reached it
            raise BrokenProcessPool("a worker ended")

    def _suspects(self, flying: dict[str, Task]) -> dict[str, list[str]]:
        """Cells that were running when a worker died, with its last words.

        All workers end with the first: those that had something to say come before the others.
        """
        words = noted(self._notes)
        self._forget()
        found = {key: words[key] for key in words if key in flying}
        spoken = {key: texts for key, texts in found.items() if any(texts)}
        return spoken or found or {key: [""] for key in flying}

    def _again(self, task: Task, words: list[str]) -> Result:
        from joblib.externals.loky.process_executor import BrokenProcessPool

        reason = died(words)
        if reason is not None:
            return failure(task, reason)
        task = second_attempt(task, words)
        self._end_workers()
        try:
            (result,) = self._stream(deque([task]), {}, 1)
            return result
        except BrokenProcessPool as error:
            more = noted(self._notes).get(task.cell.key, [""])
            self._forget()
            return failure(task, died([*more, *words]) or str(error))

    def _end_workers(self) -> None:
        from joblib.externals.loky import get_reusable_executor

        get_reusable_executor().shutdown(wait=True, kill_workers=True)

    def _forget(self) -> None:
        shutil.rmtree(folder_of(self._notes), ignore_errors=True)

    def close(self) -> None:
        """End the worker processes."""
        self._end_workers()
        self._forget()


@contextmanager
def quiet_leaving() -> Iterator[None]:
    """No warning where results are not waited for: whoever makes us leave tells why."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*tasks which were still being")
        yield


def local(study: Study, jobs: int | None) -> LocalPool:
    """The pool of this machine.

    Parameters
    ----------
    study : Study
        What will run.
    jobs : int or None
        Cells at a time; None is one where only times are measured, else one a core.
    """
    if jobs is None:
        jobs = 1 if study.measure == "time" else environment()["cores"]
    return LocalPool(jobs)
