"""One cell of a study: an estimator on one record, run in a worker process."""

from __future__ import annotations

import faulthandler
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from functools import lru_cache
from time import perf_counter
from typing import Any

import numpy as np

from qpmhe_solvers import Backend, BackendError, backend, register

from .._checks import Array
from ..estimation.estimate import Estimate
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..models import Example, Record
from ..models.loading import ModelSource, load
from . import metrics
from .environment import environment

Result = dict[str, Any]

#: Engine of all cells: only the Python step calls the backends that a study compares.
ENGINE = "python"
#: Backend of a cell that solves no QP.
OBSERVER = "observer"


@dataclass(frozen=True)
class Cell:
    """What distinguishes one run from all others of a study.

    ``backend`` is `OBSERVER` where no QP is solved; ``qps`` is None to converge, and
    ``solver_iterations``, the cap inside each QP, None for the solver's default.
    """

    model: str
    backend: str
    qps: int | None
    solver_iterations: int | None
    horizon: int
    start: str
    seed: int
    steps: int

    @property
    def key(self) -> str:
        """A text that identifies the cell."""
        qps = "converged" if self.qps is None else self.qps
        cap = "none" if self.solver_iterations is None else self.solver_iterations
        return (
            f"{self.model}/{self.backend}/i={qps}/cap={cap}/N={self.horizon}/{self.start}"
            f"/T={self.steps}/seed={self.seed}"
        )

    @property
    def configuration(self) -> tuple[object, ...]:
        """Everything but the seed."""
        return astuple(replace(self, seed=0))


@dataclass(frozen=True)
class Task:
    """A cell as it is sent to a worker, and what to measure: "accuracy", "time", "covariance".

    It gives up between two steps after ``timeout`` seconds. ``keep`` returns the trajectory,
    ``shared`` says that other cells run on the machine at the same time, ``registered`` is the
    backend for workers that do not know it, and ``isolated`` runs the solver in another process.
    """

    cell: Cell
    source: ModelSource
    parts: frozenset[str]
    timeout: float
    keep: bool = False
    shared: bool = False
    registered: Backend | None = None
    isolated: bool = False

    @property
    def hard_limit(self) -> float:
        """Seconds after which a process that hangs in the cell is ended."""
        return 1.5 * self.timeout + 1.0


class OutOfTimeError(Exception):
    """The cell's time is up."""


def compute(task: Task) -> Result:
    """Run a cell; whatever is raised in it becomes a row."""
    began = perf_counter()
    with _ended_after(task.hard_limit):
        try:
            return _measured(task, began + task.timeout)
        except KeyboardInterrupt:
            raise
        except OutOfTimeError as error:
            return failure(task, f"out of time: {error}")
        except BaseException as error:  # a solver may even try to leave the process
            return failure(task, f"{type(error).__name__}: {error}")


def failure(task: Task, reason: str) -> Result:
    """The row of a cell that failed."""
    return {
        **_fields(task), "outcome": "failed", "reason": " ".join(reason.split())[:500],
        "environment": environment(),
    }


@contextmanager
def _ended_after(seconds: float) -> Iterator[None]:
    """End this process if the block hangs; this clock needs no turn of the interpreter."""
    if sys.__stderr__ is not None:
        faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def _fields(task: Task) -> Result:
    return {"key": task.cell.key, **vars(task.cell), "parts": task.parts, "shared": task.shared}


def _measured(task: Task, limit: float) -> Result:
    cell, example = task.cell, load(task.source)
    if task.registered is not None:
        _register(task.registered)
    record = _record(task.source, cell.seed, cell.steps)
    if "time" in task.parts:
        _warm_up(task, limit)
    run = _run(_estimator(example, task), record, limit, "covariance" in task.parts)
    scenario, residual = example.scenario, example.system.state_residual
    settled = int(np.ceil(scenario.settling_time / scenario.dt - 1e-9))
    row: Result = {
        **_fields(task), "outcome": "done", "reason": "", "environment": environment(),
        **metrics.accuracy(run.states, record.states, settled, residual),
        **metrics.outcomes(run),
    }
    if "time" in task.parts:
        row |= metrics.timing(run.times)
    if run.covariances is not None:
        row["nees"] = metrics.consistency(run.states, record.states, run.covariances, residual)
    if "accuracy" in task.parts:
        try:
            reference = _reference(task, record, limit)
        except OutOfTimeError as error:
            row["reason"] = f"no cost ratio: the converged reference ran out of time, {error}"
            reference = None
        row["cost_ratio"] = metrics.cost_ratio(run.costs, reference)
    if task.keep:
        row["trajectory"] = {
            "times": scenario.dt * np.arange(cell.steps + 1, dtype=np.float64),
            "states": record.states,
            "estimates": run.states if residual is None
            else residual.aligned(run.states, record.states),
            "labels": list(scenario.labels), "title": scenario.title,
            "time_unit": scenario.time_unit,
        }
    return row


def _register(entry: Backend) -> None:
    try:
        backend(entry.name)
    except BackendError:
        register(entry)


def _estimator(example: Example, task: Task) -> MovingHorizonEstimator:
    system, observer, cost, scenario = example
    cell = task.cell
    return MovingHorizonEstimator(
        system, observer, cost,
        horizon=cell.horizon, initial_state=scenario.initial_estimate,
        backend="banded" if cell.backend == OBSERVER else cell.backend,
        max_qps=cell.qps, max_solver_iterations=cell.solver_iterations,
        warm_start=cell.start == "best",
        isolated=task.isolated, engine=ENGINE,
    )


def _run(
    mhe: MovingHorizonEstimator, record: Record, limit: float, covariances: bool = False
) -> Run:
    start, estimates, collected = mhe.state.copy(), [], []
    inputs = [None] * len(record.measurements) if record.inputs is None else record.inputs
    for y, u in zip(record.measurements, inputs, strict=True):
        estimate: Estimate = mhe.update(y, u)
        estimates.append(estimate)
        if covariances:
            collected.append(_newest_covariance(mhe))
        if perf_counter() > limit:
            raise OutOfTimeError(f"{len(estimates)} of {len(record.measurements)} steps were done.")
    return Run.of(start, estimates, np.array(collected) if covariances else None)


def _newest_covariance(mhe: MovingHorizonEstimator) -> Array:
    try:
        value: Array = mhe.covariances()[-1]
    except (ValueError, np.linalg.LinAlgError):
        value = np.full((mhe.system.n, mhe.system.n), np.nan)
    return value


@lru_cache(maxsize=8)
def _record(source: ModelSource, seed: int, steps: int) -> Record:
    return load(source).scenario.simulate(seed, steps)


_WARM: set[tuple[object, ...]] = set()


def _warm_up(task: Task, limit: float) -> None:
    """Imports and first calls happen before the first measured run, as they belong to no step."""
    cell, source = task.cell, task.source
    key = (source, task.isolated, *cell.configuration)
    if key not in _WARM:
        steps = min(cell.steps, cell.horizon + 2)
        _run(_estimator(load(source), task), _record(source, cell.seed, steps), limit)
        _WARM.add(key)


_REFERENCES: dict[tuple[object, ...], Array | None] = {}


def _reference(task: Task, record: Record, limit: float) -> Array | None:
    """J of the converged solutions, which all cells on the same record share."""
    cell, source = task.cell, task.source
    key = (source, cell.horizon, cell.start, cell.seed, cell.steps)
    if key not in _REFERENCES:
        if len(_REFERENCES) >= 8:
            del _REFERENCES[next(iter(_REFERENCES))]
        converged = replace(
            task, cell=replace(cell, backend="auto", qps=None, solver_iterations=None),
            isolated=False,
        )
        _REFERENCES[key] = None  # where it runs out of time, it does so once
        _REFERENCES[key] = _run(_estimator(load(source), converged), record, limit).costs
    return _REFERENCES[key]
