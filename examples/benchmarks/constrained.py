"""Steps with active inequalities: the compiled engine beside HPIPM and PIQP's multistage solver.

A chain of two masses in three dimensions (n = 12, N = 30) with sets so tight that about a tenth
of their rows is active at the estimates: boxes on the disturbances, on disturbances and noises,
and on the velocities. In one run, on one thread, all take the same windows:

- the compiled step, converged and with one QP;
- the Python step, converged, by the default backend and by PIQP;
- CasADi's ``sqpmethod`` with HPIPM, converged, with the Gauss-Newton Hessian, from its previous
  solution, and the time of one of its QPs;
- PIQP's own update and solve of the Python step's QPs, whose structure it knows already.

CasADi's wheel has HPIPM for any x86-64 processor; built for the machine, it is faster.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, ClassVar

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import casadi as ca
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
Array = NDArray[np.float64]


class Multistage(Solver):
    """PIQP with its multistage factorisation, kept from QP to QP, and timed."""

    seconds: ClassVar[list[float]] = []

    def __init__(self, options: SolverOptions) -> None:
        super().__init__(options)
        self._kept: dict[tuple[int, int], Any] = {}

    def _solve(self, qp: QP, start: Array | None) -> RawSolution:
        hessian, rows = qp.csc(), qp.csc_rows()
        low, high = qp.row_lower.ravel(), qp.row_upper.ravel()
        there = np.isfinite(low) | np.isfinite(high)
        rows, low, high = rows[there], low[there], high[there]
        lower, upper = (side.ravel() if qp.bounded else None for side in (qp.lower, qp.upper))
        gradient, key = qp.gradient.ravel(), (qp.size, len(low))
        solver = self._kept.get(key)
        if solver is None:
            solver = self._kept[key] = piqp.SparseSolver()
            solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
            solver.settings.eps_abs = solver.settings.eps_rel = 1e-9
            nothing = type(rows)((0, qp.size))
            solver.setup(hessian, gradient, nothing, np.zeros(0), rows, low, high, lower, upper)
        began = perf_counter()
        solver.update(
            P=hessian, c=gradient, G=rows, h_l=low, h_u=high, x_l=lower, x_u=upper
        )
        status = solver.solve()
        self.seconds.append(perf_counter() - began)
        result = solver.result
        duals = np.zeros(there.size)
        duals[there] = np.array(result.z_u) - np.array(result.z_l)
        bounds = np.zeros(qp.size)
        if qp.bounded:
            bounds = np.array(result.z_bu) - np.array(result.z_bl)
        solved = status == piqp.Status.PIQP_SOLVED
        return RawSolution(np.array(result.x), solved, int(result.info.iter), bounds, duals, "")


class Hpipm:
    """The window as a program of CasADi, solved by ``sqpmethod`` with HPIPM.

    Its variables are x and w by stages, its rows the dynamics and v, as HPIPM wants them.
    """

    def __init__(self, example: Any, sets: dict[str, Any]) -> None:
        n, p, cost, dt = example.system.n, example.system.p, example.cost, example.system.dt
        rate, output = casadi_rate(MASSES, DIMENSION), casadi_output(MASSES, DIMENSION)
        x = ca.SX.sym("x", n)
        k1 = rate(x)
        k2 = rate(x + dt / 2 * k1)
        k3 = rate(x + dt / 2 * k2)
        moved = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + dt * k3))
        step = self._step = ca.Function("f", [x], [moved])
        free = {"states": n, "disturbances": n, "noises": p}
        X, W, V = (
            sets.get(name, qpmhe.Box(np.full(size, -np.inf), np.full(size, np.inf)))
            for name, size in free.items()
        )
        states = [ca.SX.sym(f"x{i}", n) for i in range(HORIZON + 1)]
        prior, measured = ca.SX.sym("prior", n), ca.SX.sym("y", p, HORIZON)
        objective = (states[0] - prior).T @ cost.prior @ (states[0] - prior)
        variables, rows, low, high, below, above = [], [], [], [], [], []
        with_v = p if "noises" in sets else 0
        for i in range(HORIZON):
            w, v = ca.SX.sym(f"w{i}", n), measured[:, i] - output(states[i])
            objective += w.T @ cost.disturbance @ w + v.T @ cost.noise @ v
            variables += [states[i], w]
            low += [X.lower, W.lower]
            high += [X.upper, W.upper]
            rows.append(step(states[i]) + w - states[i + 1])
            below.append(np.zeros(n))
            above.append(np.zeros(n))
            if with_v:
                rows.append(v)
                below.append(V.lower)
                above.append(V.upper)
        z, p_all = ca.vertcat(*variables, states[-1]), ca.veccat(prior, measured)
        g = ca.vertcat(*rows)
        # Of a linear output, the Hessian of the objective is the Gauss-Newton one.
        factor, multipliers = ca.SX.sym("factor"), ca.SX.sym("multipliers", g.numel())
        hessian = ca.Function(
            "hessian", [z, p_all, factor, multipliers],
            [ca.triu(factor * ca.hessian(objective, z)[0])],
        )
        quiet = dict.fromkeys(("print_header", "print_iteration", "print_status"), False)
        self._solver = ca.nlpsol("mhe", "sqpmethod", {"x": z, "p": p_all, "f": objective, "g": g}, {
            **quiet, "print_time": False, "error_on_fail": False, "hess_lag": hessian,
            "qpsol": "hpipm",
            "qpsol_options": {
                "N": HORIZON, "nx": [n] * (HORIZON + 1), "nu": [n] * HORIZON + [0],
                "ng": [with_v] * HORIZON + [0], "print_time": False, "error_on_fail": False,
            },
        })
        self._sides = {
            "lbx": np.concatenate([*low, X.lower]), "ubx": np.concatenate([*high, X.upper]),
            "lbg": np.concatenate(below), "ubg": np.concatenate(above),
        }
        self._n = n
        self._last: Array | None = None

    def update(self, estimate: qpmhe.Estimate, measurements: Array) -> tuple[float, float, float]:
        """Solve the window of an estimate: J, and the seconds of all and of one QP."""
        n, candidate = self._n, estimate.candidate
        if self._last is None:
            stages = np.hstack((candidate[:-1], np.zeros((HORIZON, n))))
            start = np.append(stages.ravel(), candidate[-1])
        else:
            start, end = self._last.copy(), self._last[-n:]
            start[: -3 * n] = self._last[2 * n : -n]
            start[-3 * n : -2 * n], start[-2 * n : -n] = end, 0.0
            start[-n:] = np.array(self._step(end)).ravel()
        # Of what takes many milliseconds, a busy machine would be most of the time on the wall.
        began = process_time()
        found = self._solver(
            x0=start, p=np.append(candidate[0], measurements.ravel()), **self._sides
        )
        seconds, stats = process_time() - began, self._solver.stats()
        self._last = np.array(found["x"]).ravel()
        qps = max(stats["iter_count"], 1)
        cost = float(found["f"]) if stats["success"] else np.nan
        return cost, seconds, stats["t_proc_QP"] / qps


@dataclass
class Case:
    """What was measured with one choice of sets."""

    name: str
    active: float = 0.0
    gap: float = 0.0
    solved: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)


def measured(name: str, sets: dict[str, Any], steps: int) -> Case:
    """Run all on one record."""
    example = qpmhe.models.chain_of_masses(MASSES, DIMENSION)
    scenario = example.scenario
    system = qpmhe.from_casadi(
        casadi_rate(MASSES, DIMENSION), casadi_output(MASSES, DIMENSION), dt=scenario.dt,
        n=example.system.n, **sets,
    )
    record = scenario.simulate(0, steps).measurements

    def run(**options: Any) -> list[qpmhe.Estimate]:
        mhe = qpmhe.MovingHorizonEstimator(
            system, example.observer, example.cost, horizon=HORIZON,
            initial_state=scenario.initial_estimate, **options,
        )
        return [mhe.update(y) for y in record][HORIZON:]

    converged, single = run(engine="compiled", max_qps=None), run(engine="compiled")
    plain, by_piqp = (
        run(engine="python", max_qps=None, backend=backend) for backend in ("auto", "piqp")
    )
    Multistage.seconds = []
    run(engine="python", backend="multistage", max_qps=None)
    peer, theirs = Hpipm(example, sets), []
    for t, estimate in enumerate(converged, HORIZON):
        theirs.append(peer.update(estimate, record[t + 1 - HORIZON : t + 1]))
    solved = [k for k, (cost, _, _) in enumerate(theirs) if np.isfinite(cost)]
    points = {"disturbances": "disturbances", "noises": "noises", "states": "trajectory"}
    active = []
    for estimate in converged:
        places = []
        for which, box in sets.items():
            s, width = getattr(estimate, points[which]), box.upper - box.lower
            near = np.minimum(s - box.lower, box.upper - s) < 1e-6 * width
            places.append(near[:, np.isfinite(width)].ravel())
        active.append(float(np.mean(np.concatenate(places))))
    middle = statistics.median
    return Case(
        name, middle(active),
        max(abs(theirs[k][0] - converged[k].cost) / converged[k].cost for k in solved),
        len(solved) / len(theirs),
        {
            "compiled, converged": middle(e.step_time for e in converged),
            "Python, converged": middle(e.step_time for e in plain),
            "Python by PIQP, converged": middle(e.step_time for e in by_piqp),
            "HPIPM, converged": middle(theirs[k][1] for k in solved),
            "compiled, one QP": middle(e.step_time for e in single),
            "HPIPM, one QP": middle(theirs[k][2] for k in solved),
            "PIQP, one QP": middle(Multistage.seconds[len(Multistage.seconds) // 3 :]),
        },
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100, help="samples of the record")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    arguments = parser.parse_args()
    if not ca.has_conic("hpipm"):
        raise SystemExit("this CasADi comes without HPIPM")
    warnings.simplefilter("ignore", qpmhe.errors.ObserverWarning)
    qpmhe.solvers.register(
        qpmhe.solvers.Backend("multistage", Multistage, method="interior point", matrices="csc")
    )
    example = qpmhe.models.chain_of_masses(MASSES, DIMENSION)
    scenario, half = example.scenario, example.system.n // 2
    w, v = (np.sqrt(np.diag(one)) for one in
            (scenario.disturbance_covariance, scenario.noise_covariance))
    free = qpmhe.MovingHorizonEstimator(
        example.system, example.observer, example.cost, horizon=HORIZON,
        initial_state=scenario.initial_estimate,
    )
    found = np.array([free.update(y).state for y in scenario.simulate(0, 100).measurements])
    lower, upper = (np.quantile(found[HORIZON // 2 :], q, axis=0) for q in (0.1, 0.9))
    lower[:half], upper[:half] = -np.inf, np.inf
    cases = [
        measured("W", {"disturbances": qpmhe.Box(-0.22 * w, 0.22 * w)}, arguments.steps),
        measured("W and V", {
            "disturbances": qpmhe.Box(-0.18 * w, 0.18 * w), "noises": qpmhe.Box(-2.5 * v, 2.5 * v),
        }, arguments.steps),
        measured("X", {"states": qpmhe.Box(lower, upper)}, arguments.steps),
    ]

    console = Console()
    table = Table(title=f"Boxes, n = {2 * half}, N = {HORIZON}; median us", title_justify="left")
    for column in ("", *(one.name for one in cases)):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in cases[0].seconds:
        table.add_row(row, *(f"{1e6 * one.seconds[row]:.0f}" for one in cases))
    for row in ("converged", "one QP"):
        table.add_row(f"compiled / HPIPM, {row}", *(
            f"{one.seconds[f'compiled, {row}'] / one.seconds[f'HPIPM, {row}']:.2f}"
            for one in cases
        ))
    for other in ("Python by PIQP", "HPIPM"):
        table.add_row(f"Python / {other}, converged", *(
            f"{one.seconds['Python, converged'] / one.seconds[f'{other}, converged']:.2f}"
            for one in cases
        ))
    console.print(table)
    for one in cases:
        console.print(
            f"{one.name}: {100 * one.active:.0f} % of the rows active, costs agree to "
            f"{one.gap:.0e}, {100 * one.solved:.0f} % of the windows solved by sqpmethod.",
            highlight=False,
        )
    if max(one.gap for one in cases) > 1e-4:
        raise SystemExit("the costs differ: nothing to compare")
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "constrained.json").write_text(json.dumps({
        "environment": environment(("qpmhe", "numpy", "scipy", "casadi", "piqp")),
        "cases": [
            {
                "sets": one.name, "active_rows": one.active, "cost_gap": one.gap,
                "us": {row: 1e6 * seconds for row, seconds in one.seconds.items()},
            }
            for one in cases
        ],
    }, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
