"""joblib's dask backend, told of what joblib does not hear: lost workers and schedulers.

Import only where joblib and distributed are installed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from time import monotonic
from typing import Any

from distributed.scheduler import KilledWorker
from joblib._dask import DaskDistributedBackend

from .cell import Task
from .errors import SchedulerError

__all__ = ["DaskBackend", "Lost"]

# Seconds between two looks at the client.
_PERIOD = 0.5


@dataclass(frozen=True)
class Lost:
    """A task that the scheduler has given up.

    Parameters
    ----------
    task : Task
        Which.
    error : BaseException
        Why.
    """

    task: Task
    error: BaseException


class DaskBackend(DaskDistributedBackend):  # type: ignore[misc]  # untyped
    """The backend, in which no task is waited for in vain.

    joblib's own calls nobody back where a task fails outside of its function, as with
    workers that died; the generator of results would wait for ever.

    Parameters
    ----------
    client : distributed.Client
        Connected to the scheduler.
    """

    def __init__(self, client: Any) -> None:
        super().__init__(client=client)
        self._pending: dict[Future[Any], Callable[[Any], None]] = {}
        self._failure: SchedulerError | None = None

    def effective_n_jobs(self, n_jobs: int) -> int:
        """Workers' threads, at least two: with one, joblib would run everything in here."""
        return max(2, int(super().effective_n_jobs(n_jobs)))

    def submit(self, func: Any, callback: Callable[[Any], None] | None = None) -> Any:
        """Send a batch of one task; joblib calls this."""
        future: Future[Any] = super().submit(func, callback)
        if callback is None:
            return future
        self._pending[future] = callback
        (task,) = func.items[0][1]

        def ended(done: Future[Any]) -> None:
            self._pending.pop(done, None)
            error = done.exception()
            if isinstance(error, KilledWorker):
                callback([Lost(task, error)])
            elif error is not None:
                self._fail(f"{type(error).__name__}: {error}")
                callback(None)

        future.add_done_callback(ended)
        return future

    def retrieve_result_callback(self, out: Any) -> Any:
        """The results of a batch; joblib calls this."""
        if self._failure is not None:
            raise self._failure
        if not isinstance(out, list):  # the client lost its scheduler and cancelled everything
            raise self._fail("the connection to the scheduler was lost")
        return super().retrieve_result_callback(out)

    @contextmanager
    def guarded(self, patience: float) -> Iterator[None]:
        """Look after the cluster within the block.

        Parameters
        ----------
        patience : float
            Seconds for which it may be without workers.

        Raises
        ------
        SchedulerError
            From within the block, out of joblib's generator, where the scheduler is gone or
            has no workers any more.
        """
        self._failure = None
        ended = threading.Event()
        watcher = threading.Thread(target=self._watch, args=(ended, patience), daemon=True)
        watcher.start()
        try:
            yield
            if self._failure is not None:  # joblib may end before the error has reached it
                raise self._failure
        finally:
            ended.set()
            watcher.join()
            self._pending.clear()

    def _watch(self, ended: threading.Event, patience: float) -> None:
        manned = monotonic()
        while not ended.wait(_PERIOD):
            if self.client.status != "running":
                self._give_up("the connection to the scheduler was lost")
                return
            workers = None
            with suppress(Exception):  # the next look will tell
                workers = self.client.scheduler_info().get("workers")
            if workers or workers is None:
                manned = monotonic()
            elif monotonic() - manned > patience:
                self._give_up(f"there was no worker for {patience:g} s")
                return

    def _fail(self, reason: str) -> SchedulerError:
        """Note what has happened, and tell what happened first."""
        if self._failure is None:
            self._failure = SchedulerError(reason)
        return self._failure

    def _give_up(self, reason: str) -> None:
        self._fail(reason)
        for callback in list(self._pending.values()):
            callback(None)
