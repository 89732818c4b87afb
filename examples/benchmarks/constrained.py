"""Steps with active inequalities: the compiled engine beside PIQP's multistage solver.

A chain of two masses in three dimensions (n = 12, N = 30) with boxes on disturbances and
noises, so tight that about a tenth of their rows is active. Every QP of the estimator is
solved by both: the whole update of ``engine="compiled"``, divided by the QPs in it, beside
PIQP's own update and solve of the same QP, whose structure it knows already.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import numpy as np
import piqp
from numpy.typing import NDArray
from report import environment
from rich.console import Console
from rich.table import Table

import qpmhe
from qpmhe.models.chain import casadi_output, casadi_rate
from qpmhe_solvers import QP, RawSolution, Solver, SolverOptions

MASSES, DIMENSION, HORIZON = 2, 3, 30


class Multistage(Solver):
    """PIQP with its multistage factorisation, kept from QP to QP, and timed."""

    def __init__(self, options: SolverOptions) -> None:
        super().__init__(options)
        self._kept: dict[int, Any] = {}
        self.seconds: list[float] = []
        self.active: list[float] = []

    def _solve(self, qp: QP, start: NDArray[np.float64] | None) -> RawSolution:
        hessian, rows = qp.csc(), qp.csc_rows()
        low, high = qp.row_lower.ravel(), qp.row_upper.ravel()
        there = np.isfinite(low) | np.isfinite(high)
        rows, low, high = rows[there], low[there], high[there]
        gradient = qp.gradient.ravel()
        solver = self._kept.get(qp.size)
        if solver is None:
            solver = self._kept[qp.size] = piqp.SparseSolver()
            solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
            solver.settings.eps_abs = solver.settings.eps_rel = 1e-9
            nothing = type(rows)((0, qp.size))
            solver.setup(hessian, gradient, nothing, np.zeros(0), rows, low, high, None, None)
        began = perf_counter()
        solver.update(P=hessian, c=gradient, G=rows, h_l=low, h_u=high)
        status = solver.solve()
        self.seconds.append(perf_counter() - began)
        x = np.array(solver.result.x)
        value, width = rows @ x, high - low
        self.active.append(float(np.mean(np.minimum(value - low, high - value) < 1e-6 * width)))
        solved = status == piqp.Status.PIQP_SOLVED
        duals = np.zeros(there.size)
        duals[there] = np.array(solver.result.z_u) - np.array(solver.result.z_l)
        return RawSolution(x, solved, int(solver.result.info.iter), np.zeros(qp.size), duals, "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100, help="samples of the record")
    parser.add_argument("--width", type=float, default=0.3, help="of W, in standard deviations")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    arguments = parser.parse_args()

    plain = qpmhe.models.chain_of_masses(MASSES, DIMENSION)
    scenario = plain.scenario
    spread = [np.sqrt(np.diag(c)) for c in
              (scenario.disturbance_covariance, scenario.noise_covariance)]
    system = qpmhe.from_casadi(
        casadi_rate(MASSES, DIMENSION), casadi_output(MASSES, DIMENSION), dt=scenario.dt,
        n=plain.system.n,
        disturbances=qpmhe.Box(-arguments.width * spread[0], arguments.width * spread[0]),
        noises=qpmhe.Box(-2.5 * spread[1], 2.5 * spread[1]),
    )
    solvers: list[Multistage] = []

    def make(options: SolverOptions) -> Multistage:
        solvers.append(Multistage(options))
        return solvers[-1]

    qpmhe.solvers.register(
        qpmhe.solvers.Backend("multistage", make, method="interior point", matrices="csc")
    )
    runs = {}
    for name, options in {
        "PIQP multistage": {"backend": "multistage"}, "compiled": {"engine": "compiled"}
    }.items():
        mhe = qpmhe.MovingHorizonEstimator(
            system, plain.observer, plain.cost, horizon=HORIZON,
            initial_state=scenario.initial_estimate, **options,  # type: ignore[arg-type]
        )
        runs[name] = [mhe.update(y) for y in
                      scenario.simulate(0, arguments.steps).measurements][HORIZON:]

    theirs, ours = runs["PIQP multistage"], runs["compiled"]
    gap = max(abs(a.cost - b.cost) / b.cost for a, b in zip(ours, theirs, strict=True))
    if gap > 1e-6:
        raise SystemExit(f"the costs differ by {gap:.1e}: nothing to compare")
    solved = [e.qps + e.corrections + e.nearest_points for e in ours]
    per_qp = statistics.median(e.step_time / count for e, count in zip(ours, solved, strict=True))
    settled = slice(len(solvers[0].seconds) // 3, None)
    reference = statistics.median(solvers[0].seconds[settled])

    iterations = [e.solver_iterations / c for e, c in zip(ours, solved, strict=True)]

    table = Table(title=f"One QP with inequalities, n = {plain.system.n}, N = {HORIZON}",
                  title_justify="left")
    for column in ("", "median us", "of PIQP's"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    table.add_row("PIQP multistage, update + solve", f"{reference * 1e6:.0f}", "1")
    table.add_row("compiled, whole update / QPs in it", f"{per_qp * 1e6:.0f}",
                  f"{per_qp / reference:.2f}")
    console = Console()
    console.print(table)
    console.print(
        f"Rows active (median): {100 * statistics.median(solvers[0].active[settled]):.0f} %. "
        f"Costs agree to {gap:.0e}. QPs in an update: {statistics.median(solved):.0f}, "
        f"iterations in each: {statistics.median(iterations):.0f}.",
        highlight=False,
    )
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "constrained.json").write_text(json.dumps({
        "environment": environment(("qpmhe", "numpy", "scipy", "casadi", "piqp")),
        "piqp_us": 1e6 * reference, "compiled_us": 1e6 * per_qp, "ratio": per_qp / reference,
        "active_rows": statistics.median(solvers[0].active[settled]), "cost_gap": gap,
    }, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
