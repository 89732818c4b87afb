"""Run one cell: what a worker process does."""

from __future__ import annotations

from functools import lru_cache
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import BackendError, backend, register

from ..estimate import Estimate
from ..estimator import MovingHorizonEstimator
from ..models import Example, Record
from ..run import Run
from . import metrics
from .cell import OBSERVER, Cell, Task
from .environment import environment
from .sources import Source, load
from .watch import deaths, died, second_attempt, watched

__all__ = ["Result", "compute", "compute_once", "failure"]

Array = NDArray[np.float64]
Result = dict[str, Any]


class OutOfTimeError(Exception):
    """The cell's time is up."""


def compute(task: Task) -> Result:
    """Run a cell; whatever happens in it becomes a row.

    Parameters
    ----------
    task : Task
        What to run.

    Returns
    -------
    dict
        The row: the cell's own fields, ``outcome``, ``reason``, the metrics, and
        ``environment``, ``trajectory`` where it is wanted.
    """
    began = perf_counter()
    with watched(task):
        try:
            return _measured(task, began + task.timeout)
        except KeyboardInterrupt:
            raise
        except OutOfTimeError as error:
            return failure(task, f"out of time: {error}")
        except BaseException as error:  # a solver may even try to leave the process
            return failure(task, f"{type(error).__name__}: {error}")


def compute_once(task: Task) -> Result:
    """Run a cell, unless workers of this machine have died at it twice or hung.

    Parameters
    ----------
    task : Task
        What to run.
    """
    words = deaths(task)
    reason = died(words)
    return compute(second_attempt(task, words)) if reason is None else failure(task, reason)


def failure(task: Task, reason: str) -> Result:
    """The row of a cell that failed.

    Parameters
    ----------
    task : Task
        Which.
    reason : str
        Why.
    """
    return {
        **_fields(task), "outcome": "failed", "reason": " ".join(reason.split())[:500],
        "environment": environment(),
    }


def _fields(task: Task) -> Result:
    return {"key": task.cell.key, **vars(task.cell), "parts": task.parts, "shared": task.shared}


def _measured(task: Task, limit: float) -> Result:
    cell, example = task.cell, load(task.source)
    _bring(task)
    record = _record(task.source, cell.seed, cell.steps)
    if "time" in task.parts:
        _warm(task, limit)
    run = _run(_estimator(example, task), record, limit, "covariance" in task.parts)
    scenario = example.scenario
    settled = int(np.ceil(scenario.settling_time / scenario.dt - 1e-9))
    row: Result = {
        **_fields(task), "outcome": "done", "environment": environment(),
        "reason": f"the backend ran in {task.isolated}" if task.isolated else "",
        **metrics.accuracy(run.states, record.states, settled), **metrics.outcomes(run),
    }
    if "time" in task.parts:
        row |= metrics.timing(run.times)
    if run.covariances is not None:
        row["nees"] = metrics.consistency(run.states, record.states, run.covariances)
    if "accuracy" in task.parts:
        try:
            reference = _reference(task.source, cell, record, limit)
        except OutOfTimeError as error:
            late = f"no cost ratio: the converged reference ran out of time, {error}"
            row["reason"] = "; ".join(filter(None, (row["reason"], late)))
            reference = None
        row["cost_ratio"] = metrics.cost_ratio(run.costs, reference)
    if task.keep:
        row["trajectory"] = {
            "times": scenario.dt * np.arange(cell.steps + 1, dtype=np.float64),
            "states": record.states, "estimates": run.states,
            "labels": list(scenario.labels), "title": scenario.title,
            "time_unit": scenario.time_unit,
        }
    return row


def _bring(task: Task) -> None:
    """Register a backend that the user registered in the process that started the study."""
    if task.entry is None or task.cell.backend == OBSERVER:
        return
    try:
        backend(task.entry.name)
    except BackendError:
        register(task.entry)


def _estimator(example: Example, task: Task) -> MovingHorizonEstimator:
    (system, observer, cost, scenario), cell = example, task.cell
    return MovingHorizonEstimator(
        system, observer, cost,
        horizon=cell.horizon, initial_state=scenario.initial_estimate,
        backend="banded" if cell.backend == OBSERVER else cell.backend,
        max_qps=cell.qps, max_solver_iterations=cell.solver_iterations, start=cell.start,
        isolated=bool(task.isolated),
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
def _record(source: Source, seed: int, steps: int) -> Record:
    return load(source).scenario.simulate(seed, steps)


_WARM: set[tuple[object, ...]] = set()


def _warm(task: Task, limit: float) -> None:
    """Imports and first calls, which belong to no step, happen before the first measured run."""
    cell, source = task.cell, task.source
    key = (source, *cell.configuration)
    if key not in _WARM:
        steps = min(cell.steps, cell.horizon + 2)
        _run(_estimator(load(source), task), _record(source, cell.seed, steps), limit)
        _WARM.add(key)


_REFERENCES: dict[tuple[object, ...], Array | None] = {}


def _reference(source: Source, cell: Cell, record: Record, limit: float) -> Array | None:
    """J of the converged solutions, which all cells on the same record share."""
    key = (source, cell.horizon, cell.start, cell.seed, cell.steps)
    if key not in _REFERENCES:
        if len(_REFERENCES) >= 8:
            del _REFERENCES[next(iter(_REFERENCES))]
        converged = Cell(
            cell.model, "auto", None, None, cell.horizon, cell.start, cell.seed, cell.steps
        )
        _REFERENCES[key] = None  # where it runs out of time, it does so once
        task = Task(converged, source, frozenset(), 0.0)
        _REFERENCES[key] = _run(_estimator(load(source), task), record, limit).costs
    return _REFERENCES[key]
