"""The paper's simulation example (section 4), with every installed QP backend."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from qpmhe_solvers import available, backend, create

from .._checks import Array, count, make_folder
from ..estimation.estimate import Status
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..model.discretize import Discretization, discretize
from ..models import Example
from ..models.batch_reactor import batch_reactor, casadi_output, casadi_rate
from ..models.scenario import Record
from ..plots import save, trajectories
from ..plots.style import inches_of
from .cell import ENGINE
from .environment import environment, environment_words
from .ipopt import IpoptEstimator
from .metrics import accuracy, timing
from .summary import student

# The paper's i = 0, 2, 5 and converged, and i = 1 beside them; the paper's own of Ipopt.
_ITERATIONS: tuple[int | None, ...] = (0, 1, 2, 5, None)
_IPOPT_ITERATIONS: tuple[int | None, ...] = (0, 2, 5, None)
# QPs per sample, and caps on the iterations inside each, where backends are compared.
_COMPARED, _CAPS = 2, (1, 5, None)
_DRAWN = ("i = 0", "i = 2", "i = 5", "converged")
#: From here on the initial error has decayed, in the scenario's unit of time.
SETTLED = 2.0


@dataclass(frozen=True)
class PaperStudy:
    """One record of the example, by ``seed``, ``steps`` and ``method``: ``euler`` or ``rk4``."""

    seed: int = 0
    steps: int = 150
    method: str = "euler"

    @property
    def model(self) -> Example:
        """System, observer, cost and scenario."""
        return batch_reactor(self.method)

    def record(self) -> Record:
        """The simulated states and measurements."""
        return self.model.scenario.simulate(self.seed, self.steps)

    def estimator(
        self, iterations: int | None, backend_name: str = "auto", cap: int | None = None
    ) -> MovingHorizonEstimator:
        """The estimator with at most this many QPs per sample."""
        system, observer, cost, scenario = self.model
        return MovingHorizonEstimator(
            system, observer, cost,
            horizon=scenario.horizon, initial_state=scenario.initial_estimate,
            backend=backend_name, max_qps=iterations, max_solver_iterations=cap,
            engine=ENGINE,
        )

    def ipopt(self, iterations: int | None) -> IpoptEstimator:
        """The paper's tool: CasADi with Ipopt, terminated after this many iterations."""
        system, observer, cost, scenario = self.model
        step, _ = discretize(casadi_rate, None, Discretization(self.method))
        return IpoptEstimator(
            system, observer, cost, f=partial(step, scenario.dt), h=casadi_output,
            horizon=scenario.horizon, initial_state=scenario.initial_estimate,
            max_iterations=iterations,
        )


@dataclass(frozen=True)
class PaperRow:
    """Accuracy, time and outcome of one run.

    The RMSEs are over all t and from `SETTLED` on, the times the median and the 95th percentile
    of the seconds per update, ``mean_cost`` the mean of J, and ``stopped`` what ended the steps.
    Over several seeds all are means over the seeds, and ``rmse_half`` and ``rmse_settled_half``
    the half-widths of the 95 % confidence intervals (Student's) of the RMSEs; ``states`` and
    ``stopped`` are those of the first seed.
    """

    label: str
    cap: int | None
    states: Array
    rmse: float
    rmse_settled: float
    median_time: float
    high_time: float
    improved: float
    mean_cost: float
    stopped: str
    rmse_half: float = math.nan
    rmse_settled_half: float = math.nan


@dataclass(frozen=True)
class Reproduction:
    """Results of `reproduce`.

    Attributes
    ----------
    study, backend : PaperStudy, str
        The record, and the backend of ``rows``.
    rows : list of PaperRow
        i = 0, 1, 2, 5 and converged; then Ipopt's, if requested.
    backends : list of PaperRow
        Every installed backend at each cap, with i = 2.
    files : list of Path
        What was written.
    seeds : int
        Number of records that ``rows`` are means over; ``study`` is the first.
    converged_cost : float
        Mean J of the converged estimates on the first record.
    """

    study: PaperStudy
    backend: str
    rows: list[PaperRow]
    backends: list[PaperRow]
    files: list[Path]
    seeds: int
    converged_cost: float

    def excess(self, row: PaperRow) -> float:
        """Relative excess of the mean cost of a row of ``backends`` over the converged cost."""
        return row.mean_cost / self.converged_cost - 1.0


def reproduce(
    out: str | Path | None = None,
    *,
    seed: int = 0,
    seeds: int = 1,
    steps: int = 150,
    method: str = "euler",
    backend_name: str = "auto",
    ipopt: bool = False,
    progress: Callable[[int, int], None] | None = None,
    width: str | float | None = None,
) -> Reproduction:
    """Reproduce the paper's figure, and compare every installed backend on the same record.

    Parameters
    ----------
    out : path, optional
        Folder for the figure (PNG, SVG) and tables (CSV); without it nothing is written.
    seed, steps, method
        As of `PaperStudy`.
    seeds : int
        Records of the paper's rows: those of ``seed``, ``seed`` + 1, ... Figure and backends use
        the first one.
    backend_name : str
        QP backend of the paper's rows.
    ipopt : bool
        Whether to run CasADi with Ipopt, the paper's tool, too.
    progress : callable, optional
        Called with the numbers of finished and of all steps.
    width : {"single", "double"} or float, optional
        For a paper: also write the figure as PDF of this width; see `qpmhe.plots.save`.

    Returns
    -------
    Reproduction
        The rows, and the files.

    Raises
    ------
    BackendError, InvalidInputError
        If the backend or CasADi is missing, or the folder cannot be made.
    """
    count("seeds", seeds, 1)
    inches_of(width)
    create(backend_name)  # before any work: a wrong name must not cost a minute
    folder = None if out is None else make_folder(out)
    study = PaperStudy(seed, steps, method)
    paper: list[tuple[str, int | None, Callable[[], Any]]] = [
        ("converged" if i is None else f"i = {i}", None, partial(study.estimator, i, backend_name))
        for i in _ITERATIONS
    ]
    if ipopt:
        paper += [
            ("Ipopt converged" if i is None else f"Ipopt i = {i}", None, partial(study.ipopt, i))
            for i in _IPOPT_ITERATIONS
        ]
    compared: list[tuple[str, int | None, Callable[[], Any]]] = [
        (name, cap, partial(study.estimator, _COMPARED, name, cap))
        for name in available() if name != "auto" and ":" not in name
        for cap in (_CAPS if backend(name).iteration_cap else (None,))
    ]
    records = [replace(study, seed=seed + k).record() for k in range(seeds)]
    done, total = 0, (len(paper) * seeds + len(compared)) * steps

    def row_of(label: str, cap: int | None, make: Callable[[], Any], record: Record) -> PaperRow:
        nonlocal done
        mhe, estimates = make(), []
        for y in record.measurements:
            estimates.append(mhe.update(y))
            done += 1
            if progress is not None:
                progress(done, total)
        scenario = study.model.scenario
        run = Run.of(scenario.initial_estimate, estimates)
        return _row(label, cap, run, record, scenario.dt)

    each = [[row_of(*one, record) for record in records] for one in paper]
    converged = next(rows[0] for rows in each if rows[0].label == "converged")
    backends = [row_of(*one, records[0]) for one in compared]
    found = Reproduction(
        study, backend_name, [_mean(rows) for rows in each], backends, [], seeds,
        converged.mean_cost,
    )
    if folder is not None:
        found.files.extend(_write(found, records[0], folder, width))
    return found


def _mean(rows: list[PaperRow]) -> PaperRow:
    """The means of a row over seeds, with confidence limits of the RMSEs."""
    names = ("rmse", "rmse_settled", "median_time", "high_time", "improved", "mean_cost")
    table = np.array([[getattr(row, name) for name in names] for row in rows])
    means = dict(zip(names, table.mean(axis=0).tolist(), strict=True))
    halves: dict[str, float] = {}
    if len(rows) > 1:
        factor = float(student(np.array([len(rows)]))[0]) / math.sqrt(len(rows))
        widths = (factor * table[:, :2].std(axis=0, ddof=1)).tolist()
        halves = {"rmse_half": widths[0], "rmse_settled_half": widths[1]}
    combined: dict[str, Any] = means | halves
    return replace(rows[0], **combined)


def _row(label: str, cap: int | None, run: Run, record: Record, dt: float) -> PaperRow:
    errors, times = accuracy(run.states, record.states, round(SETTLED / dt)), timing(run.times)
    return PaperRow(
        label, cap, run.states,
        # Both states are partial pressures: they add up as they are, as in the paper.
        rmse=float(np.linalg.norm(errors["rmse_states"])),
        rmse_settled=float(np.linalg.norm(errors["rmse_settled_states"])),
        median_time=times["time_median"], high_time=times["time_p95"],
        improved=run.share(Status.IMPROVED), mean_cost=float(run.costs.mean()),
        stopped=_stopped(run),
    )


def _stopped(run: Run) -> str:
    """What ended the steps, the first of these reasons that applies to each."""
    words = {
        Status.SOLVER_FAILED: "no iterate",
        Status.NO_DECREASE: "no decrease",
        Status.SOLVER_STOPPED: "solver's cap",
        Status.CONVERGED: "converged",
        Status.NO_QPS: "no QP asked",
    }
    counts = dict.fromkeys([*words.values(), "QP cap"], 0)
    for status in run.statuses:
        counts[next((word for flag, word in words.items() if flag in status), "QP cap")] += 1
    total = max(1, len(run))
    order = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{word} {count / total:.0%}" for word, count in order if count)


def _write(
    found: Reproduction, record: Record, folder: Path, width: str | float | None
) -> list[Path]:
    scenario = found.study.model.scenario
    times = scenario.dt * np.arange(found.study.steps + 1, dtype=np.float64)
    axes = trajectories(
        times, record.states, {row.label: row.states for row in found.rows if row.label in _DRAWN},
        scenario.labels, f"time t ({scenario.time_unit})",
    )
    paths = save(axes[0].figure, folder / "reproduce", width=width)
    columns = {"t": times, **_by_state("real", record.states)}
    columns["y"] = np.append(record.measurements[:, 0], np.nan)
    for row in found.rows:
        columns |= _by_state(row.label.replace(" ", "_").replace("=", "is"), row.states)
    tables: dict[str, list[list[Any]]] = {
        "reproduce": [[*columns], *np.column_stack(list(columns.values())).tolist()],
        "reproduce_summary": [
            ["run", "rmse", "rmse_half", "rmse_settled", "rmse_settled_half", "median_s", "p95_s",
             "improved", "mean_J", "seeds", "stopped"],
            *([row.label, row.rmse, row.rmse_half, row.rmse_settled, row.rmse_settled_half,
               row.median_time, row.high_time, row.improved, row.mean_cost, found.seeds,
               row.stopped] for row in found.rows),
        ],
        "reproduce_backends": [
            ["backend", "cap", "rmse", "J_excess", "improved", "median_s", "stopped"],
            *([row.label, row.cap, row.rmse, found.excess(row), row.improved, row.median_time,
               row.stopped] for row in found.backends),
        ],
    }
    machine = environment_words(environment(), available())
    for lines in list(tables.values())[1:]:
        for line in lines:
            line.append("environment" if line is lines[0] else machine)
    for name, lines in tables.items():
        paths.append(folder / f"{name}.csv")
        with paths[-1].open("w", newline="") as file:
            csv.writer(file).writerows(lines)
    return paths


def _by_state(name: str, states: Array) -> dict[str, Array]:
    return {f"{name}_x{j}": values for j, values in enumerate(states.T, start=1)}
