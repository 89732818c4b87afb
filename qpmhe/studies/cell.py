"""One cell of a study: an estimator on one record, run in a worker process."""

from __future__ import annotations

import faulthandler
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from qpmhe_solvers import Backend, BackendError, Recording, backend, register

from .._checks import Array
from ..baselines import follow
from ..baselines.observers import made
from ..errors import InvalidInputError, PriorWarning, QpmheError
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..models import Record
from ..models.loading import ModelSource, code_place, import_file
from . import metrics
from .environment import environment
from .experiment import Source, experiment
from .row import OBSERVER, Cell, StudyRow

#: Engine of all cells: only the Python step calls the backends that a study compares.
ENGINE = "python"
# Failing QPs that are kept of one cell, at most.
_KEPT = 20


@dataclass(frozen=True)
class Task:
    """A cell as it is sent to a worker, and what to measure: "accuracy", "time", "covariance".

    It gives up between two steps after ``timeout`` seconds. ``keep`` returns the trajectory,
    ``shared`` says that other cells run on the machine at the same time, ``registered`` is the
    backend for workers that do not know it, or the user's file that registers it, and
    ``isolated`` runs the solver in another process. QPs on which the backend failed go to a folder
    in ``failing``. ``observer`` makes an observer in place of the model's, ``estimator`` an
    estimator in place of moving horizon estimation.
    """

    cell: Cell
    source: Source
    parts: frozenset[str]
    timeout: float
    keep: bool = False
    shared: bool = False
    registered: Backend | Path | None = None
    isolated: bool = False
    failing: Path | None = None
    observer: ModelSource | None = None
    estimator: ModelSource | None = None

    @property
    def hard_limit(self) -> float:
        """Seconds after which a process that hangs in the cell is terminated."""
        return 1.5 * self.timeout + 1.0


class CellTimeoutError(Exception):
    """The cell's time is up."""


def compute(task: Task) -> StudyRow:
    """Run a cell; an exception in it becomes a row."""
    began = perf_counter()
    with _ended_after(task.hard_limit):
        try:
            return _measured(task, began + task.timeout)
        except KeyboardInterrupt:
            raise
        except CellTimeoutError as error:
            return failure(task, f"out of time: {error}")
        except BaseException as error:  # a solver may even try to leave the process
            maker = task.estimator or task.observer
            place = "" if maker is None or isinstance(error, QpmheError) else code_place(
                error, maker.file)
            return failure(task, f"{place}{type(error).__name__}: {error}")


def failure(task: Task, reason: str) -> StudyRow:
    """The row of a cell that failed."""
    return StudyRow(**_fields(task), outcome="failed", reason=" ".join(reason.split())[:500])


@contextmanager
def _ended_after(seconds: float) -> Iterator[None]:
    """End this process if the block hangs; this clock needs no turn of the interpreter."""
    if sys.__stderr__ is not None:
        faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def _fields(task: Task) -> dict[str, Any]:
    return {
        **vars(task.cell), "parts": task.parts, "shared": task.shared,
        "environment": environment(),
    }


def _measured(task: Task, limit: float) -> StudyRow:
    cell, found = task.cell, experiment(task.source)
    if isinstance(task.registered, Path):
        import_file(task.registered)
    elif task.registered is not None:
        _register(task.registered)
    record = found.record(cell.seed, cell.steps, cell.noise_level)
    if "time" in task.parts:
        _warm_up(task, limit)
    run = _run(task, record, limit, covariances="covariance" in task.parts)
    with np.errstate(over="ignore", invalid="ignore"):
        has_square = np.isfinite(run.states**2).all(axis=1)
    if not has_square.all():  # a mean over the other seeds would hide it
        return failure(
            task, f"the estimates diverge: after {has_square.argmin()} steps, one is "
            f"{run.states[has_square.argmin()].tolist()}"
        )
    residual = found.system.state_residual
    measured: dict[str, Any] = {
        **metrics.accuracy(run.states, record.states, found.settled, residual),
    }
    if run.flags.any():  # steps of other estimators have no status
        measured |= metrics.outcomes(run)
    if "time" in task.parts:
        measured |= metrics.timing(run.times)
    if run.covariances is not None:
        measured["nees"] = metrics.consistency(run.states, record.states, run.covariances, residual)
    if "accuracy" in task.parts and task.estimator is None:
        try:
            reference = _reference(task, record, limit)
        except CellTimeoutError as error:
            measured["reason"] = f"no cost ratio: the converged reference ran out of time, {error}"
            reference = None
        measured["cost_ratio"] = metrics.cost_ratio(run.costs, reference)
    if task.keep:
        measured["trajectory"] = {
            "times": found.times(cell.steps),
            "states": record.states,
            "estimates": run.states if residual is None
            else residual.aligned(run.states, record.states),
            "labels": list(found.labels), "title": found.title, "time_unit": found.time_unit,
        }
    stopped = {"SOLVER_FAILED", "SOLVER_STOPPED"} & measured.get("reasons", {}).keys()
    if task.failing is not None and stopped:
        try:
            _keep_failing(task, task.failing, record, limit)
        except (InvalidInputError, CellTimeoutError) as error:
            measured["reason"] = f"not all failing QPs were kept: {error}"
    return StudyRow(**_fields(task), **measured, outcome="done")


def _keep_failing(task: Task, folder: Path, record: Record, limit: float) -> None:
    """Run once more, as writing files takes time, and keep the QPs on which the backend failed."""
    place = folder / re.sub(r"[^\w.=-]+", "-", task.cell.key)
    with Recording(
        place, task.cell.backend, limit=_KEPT, isolated=task.isolated
    ) as recording:
        _run(replace(task, isolated=False), record, limit, backend_name=recording.backend)
    with suppress(OSError):
        place.rmdir()  # where there was none


def _register(entry: Backend) -> None:
    try:
        backend(entry.name)
    except BackendError:
        register(entry)


def _estimator(task: Task, backend_name: str = "") -> Any:
    cell, found = task.cell, experiment(task.source)
    if task.estimator is not None:
        return made(task.estimator, replace(found.problem, seed=cell.seed))
    system, observer, cost = found.parts
    if task.observer is not None:
        observer = made(task.observer, found.problem)
    with warnings.catch_warnings():
        if task.observer is not None:  # the prior's weight is what observers are compared with
            warnings.simplefilter("ignore", PriorWarning)
        return MovingHorizonEstimator(system, observer, cost, **found.options | {
            "horizon": cell.horizon, "max_qps": cell.qps, "warm_start": cell.start == "best",
            "backend": backend_name or ("banded" if cell.backend == OBSERVER else cell.backend),
            "max_solver_iterations": cell.solver_iterations, "isolated": task.isolated,
            "engine": ENGINE,
        })


def _run(
    task: Task, record: Record, limit: float, *, covariances: bool = False, backend_name: str = ""
) -> Run:
    found, total = experiment(task.source), len(record.measurements)

    def watch(done: int) -> None:
        if perf_counter() > limit:
            raise CellTimeoutError(f"{done} of {total} steps were done.")

    estimator = _estimator(task, backend_name)
    start = found.options["initial_state"] if task.estimator is not None else estimator.state
    return follow(
        estimator, np.array(start, float), record.measurements, record.inputs,
        None if found.lengths is None else found.lengths[:total], covariances=covariances,
        each=watch,
    )


_WARM: set[tuple[object, ...]] = set()


def _warm_up(task: Task, limit: float) -> None:
    """Imports and first calls happen before the first measured run, as they belong to no step."""
    cell = task.cell
    key = (task.source, task.isolated, task.observer, task.estimator, *cell.configuration)
    if key not in _WARM:
        steps = min(cell.steps, cell.horizon + 2)
        _run(task, experiment(task.source).record(cell.seed, steps, cell.noise_level), limit)
        _WARM.add(key)


_REFERENCES: dict[tuple[object, ...], Array | None] = {}


def _reference(task: Task, record: Record, limit: float) -> Array | None:
    """J of the converged solutions, which all cells on the same record share."""
    cell, source = task.cell, task.source
    key = (
        source, cell.horizon, cell.start, cell.seed, cell.steps, cell.noise_level, task.observer
    )
    if key not in _REFERENCES:
        if len(_REFERENCES) >= 8:
            del _REFERENCES[next(iter(_REFERENCES))]
        converged = replace(
            task, cell=replace(cell, backend="auto", qps=None, solver_iterations=None),
            isolated=False,
        )
        _REFERENCES[key] = None  # where it runs out of time, it does so once
        _REFERENCES[key] = _run(converged, record, limit).costs
    return _REFERENCES[key]
