"""The workers of a Dask cluster, through joblib's dask backend."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from typing import Any
from uuid import uuid4

from .address import insist_on_scheduler
from .cell import Task
from .compute import Result, compute_once, failure
from .errors import SchedulerError, need
from .pool import Pool, quiet_leaving
from .watch import folder_of

__all__ = ["ClusterPool"]

# Seconds to reach a scheduler; seconds without any worker before giving up.
_CONNECT, _PATIENCE = 15.0, 60.0
_LOGGERS = ("distributed", "tornado")


class ClusterPool(Pool):
    """Workers of an existing cluster; best with one thread each.

    A cell at which workers die is given to other workers by the scheduler, and marked as
    failed by the worker that sees that two died at it. Where the scheduler gives it up, it
    is sent once more alone.

    Parameters
    ----------
    address : str
        Of the scheduler, such as ``tcp://10.0.0.1:8786``.

    Raises
    ------
    SchedulerError
        If the address is none, no scheduler answers there, or it has no workers.
    InvalidInputError
        If joblib, dask or distributed is not installed.
    """

    def __init__(self, address: str) -> None:
        self._joblib = need("joblib", "a study")
        distributed = need("distributed", "a study on a cluster", "dask")
        self._address, self._notes = address, f"qpmhe-study-{uuid4().hex}"
        insist_on_scheduler(address, _CONNECT)
        self._quiet = ExitStack()
        self._quiet.enter_context(_without_log())
        try:
            self._client = distributed.Client(address, timeout=_CONNECT, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            self._quiet.close()
            raise SchedulerError(
                f"the Dask scheduler at {address!r} did not take us ({error}); check that it "
                "works, and has the same version of distributed."
            ) from error
        try:
            from .dask_backend import DaskBackend

            self._backend = DaskBackend(self._client)
            self._backend.effective_n_jobs(-1)  # waits for a worker
            self.jobs = sum(self._client.ncores().values())
        except (OSError, TimeoutError) as error:
            self.close()
            raise SchedulerError(
                f"the Dask scheduler at {address!r} has no workers; start some with 'dask worker "
                f"{address} --nthreads 1'."
            ) from error

    def results(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """The row of each task; see `Pool.results`."""
        from .dask_backend import Lost

        lost = []
        waiting = (replace(task, notes=self._notes) for task in tasks)
        for answer in self._stream(waiting, 2 * self.jobs):
            if isinstance(answer, Lost):
                lost.append(answer.task)
            else:
                yield answer
        for task in lost:
            for answer in self._stream([task], 1):
                if isinstance(answer, Lost):
                    yield failure(task, f"its workers died: {answer.error}")
                else:
                    yield answer

    def _stream(self, tasks: Iterable[Task], ahead: int) -> Iterator[Any]:
        joblib = self._joblib
        with joblib.parallel_config(self._backend):
            parallel = joblib.Parallel(
                n_jobs=-1, pre_dispatch=ahead, batch_size=1, return_as="generator_unordered"
            )
            calls = (joblib.delayed(compute_once)(task) for task in tasks)
            try:
                with (
                    quiet_leaving(), self._backend.guarded(_PATIENCE),
                    closing(parallel(calls)) as answers,
                ):
                    yield from answers
            except (SchedulerError, OSError) as error:
                raise SchedulerError(
                    f"the cluster of the scheduler at {self._address!r} is gone: {error}. All "
                    "cells that were finished are stored; give the same command again when the "
                    "cluster is back."
                ) from error

    def close(self) -> None:
        """Leave the cluster as it was found."""
        with suppress(Exception):  # a cluster that is gone has nothing to tidy up
            if self._client.status == "running":
                self._client.run(_tidy, self._notes)
        with suppress(Exception):
            self._client.close(timeout=5)
        self._quiet.close()


@contextmanager
def _without_log() -> Iterator[None]:
    """Keep Dask's own words back: where a cluster is lost, ours tell it."""
    for name in _LOGGERS:
        logging.getLogger(name)
    levels = {
        logger: logger.level for name, logger in logging.root.manager.loggerDict.items()
        if isinstance(logger, logging.Logger) and name.partition(".")[0] in _LOGGERS
    }
    try:
        for logger in levels:
            logger.setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _tidy(notes: str) -> None:
    shutil.rmtree(folder_of(notes), ignore_errors=True)
