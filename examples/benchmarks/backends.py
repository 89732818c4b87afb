"""Backends that keep a workspace beside the same solvers through qpsolvers, QP by QP.

The QPs are those of an estimator with boxes on the disturbances that bind: of each sample,
the projection of the candidate into the sets, and up to two QPs around it. Both forms solve
each QP in turn, at the same tolerance, and both have their answers judged alike; the times are
those of the whole ``solve``. "own" is the share of the native form's time that is spent inside
of the solver: where it is near 1, what could be saved around it is saved.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import numpy as np
from numpy.typing import NDArray
from report import environment
from rich.console import Console
from rich.table import Table
from stopwatch import timed

import qpmhe
from qpmhe.models import batch_reactor, chain_of_masses, quadrotor
from qpmhe_solvers import QP, Backend, RawSolution, Solution, Solver, SolverOptions, SolveStatus
from qpmhe_solvers.native import NativeSolver

# The generic form that stands beside each native one; qpsolvers has one form of each solver.
PAIRS = {
    "daqp": "qpsolvers:daqp", "osqp": "qpsolvers:osqp", "piqp": "qpsolvers:piqp",
    "piqp_dense": "qpsolvers:piqp", "proxqp": "qpsolvers:proxqp",
    "proxqp_sparse": "qpsolvers:proxqp", "clarabel": "qpsolvers:clarabel",
}
OTHER_FORM = ("piqp_dense", "proxqp_sparse")
ARRAYS = ("band", "gradient", "lower", "upper", "row_own", "row_next", "row_lower", "row_upper")
TOLERANCE = 1e-6


@dataclass
class Case:
    """QPs in the order in which an estimator met them.

    Parameters
    ----------
    name, title : str
        What it is called.
    qps : list of (bool, QP)
        Whether a QP is the first one of its sample, and the QP.
    active : list of float
        Share of the rows with limits that are active, or equalities, at each solution.
    """

    name: str
    title: str
    qps: list[tuple[bool, QP]] = field(default_factory=list)
    active: list[float] = field(default_factory=list)


class Keeper(Solver):
    """Solves by PIQP, and keeps copies of the QPs."""

    def __init__(self, options: SolverOptions, case: Case) -> None:
        super().__init__(options)
        self._case, self.first = case, True
        self._inner = qpmhe.solvers.create("piqp", SolverOptions(absolute_tolerance=1e-9))

    def _solve(self, qp: QP, start: NDArray[np.float64] | None) -> RawSolution:
        kept = QP(qp.stages, qp.n, qp.rows)
        for name in ARRAYS:
            getattr(kept, name)[...] = getattr(qp, name)
        kept.bounded = qp.bounded
        self._case.qps.append((self.first, kept))
        self.first = False
        found = self._inner.solve(qp)
        limits = np.isfinite(qp.row_lower).sum()
        if found.row_duals is not None and limits:
            self._case.active.append(float(np.sum(np.abs(found.row_duals) > 1e-6) / limits))
        return RawSolution(
            found.d, found.status is SolveStatus.SOLVED, found.iterations,
            found.bound_duals, found.row_duals,
        )


def recorded(name: str, example: Any, horizon: int, width: float, samples: int) -> Case:
    """The QPs of a full window, with disturbances inside of ``width`` standard deviations."""
    plain, scenario = example.system, example.scenario
    case = Case(name, f"{name}: n = {plain.n}, N = {horizon}")
    keepers: list[Keeper] = []

    def make(options: SolverOptions) -> Keeper:
        keepers.append(Keeper(options, case))
        return keepers[-1]

    deviation = np.sqrt(np.diag(scenario.disturbance_covariance))
    nothing = np.zeros(0)

    def of(function: Any) -> Any:
        if plain.m:
            return lambda x, u: function(x, u)
        return lambda x: function(x, nothing)

    system = qpmhe.System(
        of(plain.f), of(plain.h), n=plain.n, p=plain.p, m=plain.m,
        f_jacobian=of(plain.f_jacobian), h_jacobian=of(plain.h_jacobian),
        disturbances=qpmhe.Box(-width * deviation, width * deviation),
    )
    qpmhe.solvers.register(Backend(name, make, "recorder"))
    mhe = qpmhe.MovingHorizonEstimator(
        system, example.observer, example.cost, horizon=horizon, max_qps=2,
        initial_state=scenario.initial_estimate, backend=name, engine="python",
    )
    record = scenario.simulate(0, horizon + samples)
    for t, y in enumerate(record.measurements):
        if t == horizon:
            case.qps.clear()
            case.active.clear()
        for keeper in keepers:
            keeper.first = True
        mhe.update(y, record.inputs[t]) if plain.m else mhe.update(y)
    qpmhe.solvers.unregister(name)
    return case


def inside(solver: NativeSolver) -> list[float]:
    """A list of one number: the seconds that the solver itself takes, from now on."""
    spent = [0.0]

    def around(method: Any) -> Any:
        def measured(*arguments: Any) -> Any:
            began = perf_counter()
            try:
                return method(*arguments)
            finally:
                spent[0] += perf_counter() - began

        return measured

    for name in ("_set_up", "_update", "_run"):
        setattr(solver, name, around(getattr(solver, name)))
    return spent


def compare(case: Case, native: str, generic: str) -> dict[str, Any]:
    """Times of both forms on the QPs of a case."""
    options = SolverOptions(absolute_tolerance=TOLERANCE)
    kept, anew = (qpmhe.solvers.create(name, options) for name in (native, generic))
    assert isinstance(kept, NativeSolver)
    spent = inside(kept)
    times: dict[str, list[float]] = {"native": [], "generic": []}
    own, total, apart, failed = 0.0, 0.0, 0.0, [0, 0]
    for number, (first, qp) in enumerate(case.qps):
        if first:
            kept.shift()
        before = spent[0]
        answers: list[Solution] = []
        for column, solver in (("native", kept), ("generic", anew)):
            began = perf_counter()
            answer, seconds, _ = timed(solver.solve, qp)
            if column == "native" and number:
                total += perf_counter() - began
                own += spent[0] - before
            if number:  # the first one is set-up, and imports
                times[column].append(seconds)
            answers.append(answer)
        for k, answer in enumerate(answers):
            failed[k] += answer.status is not SolveStatus.SOLVED
        if answers[0].d is not None and answers[1].d is not None:
            scale = 1.0 + np.abs(answers[1].d).max()
            apart = max(apart, float(np.abs(answers[0].d - answers[1].d).max() / scale))
    medians = {column: 1e6 * statistics.median(values) for column, values in times.items()}
    return {
        "native": native, "generic": generic, "same_form": native not in OTHER_FORM,
        "native_us": medians["native"], "generic_us": medians["generic"],
        "ratio": medians["generic"] / medians["native"], "own_share": own / total,
        "unsolved": failed, "largest_difference": apart, "qps": len(case.qps),
    }


def shown(console: Console, case: Case, rows: list[dict[str, Any]]) -> None:
    """One table."""
    active = 100 * statistics.median(case.active)
    table = Table(
        title=f"{case.title}; {len(case.qps)} QPs, {active:.0f} % of their rows active (median)",
        title_justify="left",
    )
    for column in ("", "native us", "generic us", "generic/native", "own", "unsolved", "apart"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in rows:
        table.add_row(
            row["native"] + ("" if row["same_form"] else " (other form)"),
            f"{row['native_us']:.0f}", f"{row['generic_us']:.0f}", f"{row['ratio']:.2f}",
            f"{row['own_share']:.2f}", "{} / {}".format(*row["unsolved"]),
            f"{row['largest_difference']:.0e}",
        )
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few samples")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    arguments = parser.parse_args()
    few = arguments.quick
    cases = [
        recorded("reactor", batch_reactor(), 10, 0.5, 10 if few else 100),
        recorded("quadrotor", quadrotor(), 20, 0.5, 3 if few else 20),
        recorded("chain", chain_of_masses(2, 3), 30, 0.3, 3 if few else 20),
    ]
    console = Console()
    if console.width < 110:
        console = Console(width=110)
    available = qpmhe.solvers.available()
    results = {}
    for case in cases:
        rows = [
            compare(case, native, generic) for native, generic in PAIRS.items()
            if native in available and generic in available
        ]
        shown(console, case, rows)
        results[case.name] = {"active": statistics.median(case.active), "pairs": rows}
    arguments.out.mkdir(parents=True, exist_ok=True)
    packages = ("qpmhe", "qpsolvers", "osqp", "proxsuite", "piqp", "clarabel", "daqp")
    (arguments.out / "backends.json").write_text(
        json.dumps({"environment": environment(packages), "cases": results}, indent=1),
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
