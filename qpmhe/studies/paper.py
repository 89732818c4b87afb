"""The paper's simulation example (section 4), and what the QP backends make of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import available, backend

from ..discretize import discretize
from ..estimate import Status
from ..estimator import MovingHorizonEstimator
from ..models import Example
from ..models.batch_reactor import batch_reactor, casadi_output, casadi_rate
from ..models.scenario import Record
from ..run import Run
from .ipopt import IpoptEstimator

__all__ = ["IpoptComparison", "PaperStudy", "Row", "backend_rows", "ipopt_rows", "paper_rows"]

Array = NDArray[np.float64]
Tick = Callable[[], None]

#: The paper's i = 0, 2, 5 and fully converged, with i = 1 beside them.
ITERATIONS: tuple[int | None, ...] = (0, 1, 2, 5, None)
#: Caps on the iterations inside each QP.
CAPS: tuple[int | None, ...] = (1, 5, None)
#: From here on the initial error has decayed, in the scenario's unit of time.
SETTLED = 2.0


@dataclass(frozen=True)
class PaperStudy:
    """One record of the example, which all rows share.

    Parameters
    ----------
    seed : int
        Seed of the noise.
    steps : int
        Number of measurements.
    method : str
        Discretisation, ``euler`` or ``rk4``.
    """

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

    def run(
        self,
        iterations: int | None,
        backend_name: str,
        cap: int | None = None,
        tick: Tick | None = None,
    ) -> Run:
        """Estimate the record with at most this many QPs per sample."""
        system, observer, cost, scenario = self.model
        mhe = MovingHorizonEstimator(
            system, observer, cost,
            horizon=scenario.horizon, initial_state=scenario.initial_estimate,
            backend=backend_name, max_qps=iterations, max_solver_iterations=cap,
        )
        estimates = []
        for y in self.record().measurements:
            estimates.append(mhe.update(y))
            if tick:
                tick()
        return Run.of(scenario.initial_estimate, estimates)


@dataclass(frozen=True)
class Row:
    """Accuracy, time and outcome of one run.

    Parameters
    ----------
    label : str
        What was run.
    states : (T + 1, n) array
        The estimates.
    rmse, rmse_settled : float
        Root mean square of |x(t) - estimate(t)| over all t, and from `SETTLED` on.
    median_time, high_time : float
        Median and 95th percentile of the seconds per update.
    improved : float
        Share of steps whose estimate is better than the candidate.
    mean_cost : float
        Mean of J over all steps.
    stopped : str
        What ended the steps, with shares.
    """

    label: str
    states: Array
    rmse: float
    rmse_settled: float
    median_time: float
    high_time: float
    improved: float
    mean_cost: float
    stopped: str

    @staticmethod
    def of(label: str, run: Run, record: Record, dt: float) -> Row:
        """Summarise a run against the true states."""
        squares = np.sum((run.states - record.states) ** 2, axis=1)
        settled = round(SETTLED / dt)
        return Row(
            label=label,
            states=run.states,
            rmse=float(np.sqrt(squares.mean())),
            rmse_settled=float(np.sqrt(squares[settled:].mean())) if squares[settled:].size
            else float("nan"),
            median_time=float(np.median(run.times)),
            high_time=float(np.percentile(run.times, 95)),
            improved=run.share(Status.IMPROVED),
            mean_cost=float(run.costs.mean()),
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
    ranked = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{word} {count / total:.0%}" for word, count in ranked if count)


def paper_rows(study: PaperStudy, backend_name: str, tick: Tick | None = None) -> list[Row]:
    """The paper's figure as rows: i = 0, 1, 2, 5 and converged, on one record."""
    record, dt = study.record(), study.model.scenario.dt
    return [
        Row.of(
            "converged" if i is None else f"i = {i}",
            study.run(i, backend_name, None, tick), record, dt,
        )
        for i in ITERATIONS
    ]


def compared_backends() -> tuple[str, ...]:
    """The installed backends, without ``auto`` and generic forms of those with their own."""
    return tuple(name for name in available() if name != "auto" and ":" not in name)


def backend_rows(
    study: PaperStudy, iterations: int = 2, tick: Tick | None = None
) -> Iterator[tuple[str, int | None, Row]]:
    """Every installed backend at each cap on its own iterations, at the same i and record."""
    record, dt = study.record(), study.model.scenario.dt
    for name in compared_backends():
        for cap in CAPS if backend(name).iteration_cap else (None,):
            yield name, cap, Row.of(name, study.run(iterations, name, cap, tick), record, dt)


@dataclass(frozen=True)
class IpoptComparison:
    """CasADi with Ipopt on the same record.

    Parameters
    ----------
    study : PaperStudy
        The record and the model.
    """

    study: PaperStudy

    def estimator(self, iterations: int | None) -> IpoptEstimator:
        """Ipopt, terminated after this many iterations."""
        system, observer, cost, scenario = self.study.model
        step, _ = discretize(casadi_rate, None, self.study.method)
        return IpoptEstimator(
            system, observer, cost, f=partial(step, scenario.dt), h=casadi_output,
            horizon=scenario.horizon, initial_state=scenario.initial_estimate,
            max_iterations=iterations,
        )

    def run(self, iterations: int | None, tick: Tick | None = None) -> Run:
        """Estimate the record."""
        mhe = self.estimator(iterations)
        estimates: list[Any] = []
        for y in self.study.record().measurements:
            estimates.append(mhe.update(y))
            if tick:
                tick()
        return Run.of(self.study.model.scenario.initial_estimate, estimates)


def ipopt_rows(study: PaperStudy, tick: Tick | None = None) -> list[Row]:
    """The paper's own runs: Ipopt after 0, 2, 5 iterations and converged."""
    record, dt = study.record(), study.model.scenario.dt
    comparison = IpoptComparison(study)
    rows = []
    for i in (0, 2, 5, None):
        label = "Ipopt converged" if i is None else f"Ipopt i = {i}"
        rows.append(Row.of(label, comparison.run(i, tick), record, dt))
    return rows
