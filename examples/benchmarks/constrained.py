"""Steps with active inequalities: the compiled engine beside HPIPM and PIQP's multistage solver.

A chain of two masses in three dimensions (n = 12, N = 30) with sets so tight that about a tenth
of their rows is active at the estimates: boxes on the disturbances, on disturbances and noises,
and on the velocities. In one run, on one thread, all take the same windows:

- the compiled step, converged and with one QP;
- the Python step, converged, by the default backend and by PIQP;
- acados with HPIPM, converged and one iteration, where ACADOS_SOURCE_DIR is set;
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
from peers import UnavailableError, WindowData
from peers.acados_window import Acados, Bounds
from report import environment, tell_once
from rich.console import Console
from rich.table import Table
from stopwatch import timed

import qpmhe
from qpmhe.models.chain import casadi_output, casadi_rate
from qpmhe_solvers import QP, RawSolution, Solver, SolverOptions

MASSES, DIMENSION, HORIZON = 2, 3, 30
# Samples that an estimator takes before it is the next one's turn.
TURN = 10
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


def moved(dt: float, x: Any) -> Any:
    """One Runge-Kutta step for a CasADi column."""
    rate = casadi_rate(MASSES, DIMENSION)
    k1 = rate(x)
    k2 = rate(x + dt / 2 * k1)
    k3 = rate(x + dt / 2 * k2)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + dt * k3))


class Hpipm:
    """The window as a program of CasADi, solved by ``sqpmethod`` with HPIPM.

    Its variables are x and w by stages, its rows the dynamics and v, as HPIPM wants them.
    """

    def __init__(self, example: Any, sets: dict[str, Any]) -> None:
        n, p, cost, dt = example.system.n, example.system.p, example.cost, example.system.dt
        output = casadi_output(MASSES, DIMENSION)
        x = ca.SX.sym("x", n)
        step = self._step = ca.Function("f", [x], [moved(dt, x)])
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


class Windows:
    """acados' solver of the windows, with the boxes as bounds of its states and controls."""

    def __init__(self, example: Any, sets: dict[str, Any], max_qps: int | None) -> None:
        system = example.system
        n, p = system.n, system.p
        self._noises, X, W = (sets.get(one) for one in ("noises", "states", "disturbances"))
        # The outputs are the positions, which the bounds of v bound.
        bounded = [] if X is None else list(np.flatnonzero(np.isfinite([X.lower, X.upper]).any(0)))
        bounded = list(range(p)) if self._noises is not None else bounded
        self._lower, self._upper = np.zeros((2, HORIZON + 1, len(bounded)))
        if X is not None:
            self._lower[:], self._upper[:] = X.lower[bounded], X.upper[bounded]
        self._peer = Acados(max_qps)
        self._peer.build(
            lambda x, _: moved(system.dt, x), casadi_output(MASSES, DIMENSION), example.cost,
            (HORIZON, n, p, 0), Bounds(
                bounded, self._lower, self._upper, X is not None,
                None if W is None else np.array([W.lower, W.upper]),
            ),
        )

    def update(self, estimate: qpmhe.Estimate, measurements: Array) -> tuple[Array, float]:
        """Solve the window of an estimate: the trajectory, and the seconds."""
        if self._noises is not None:
            self._lower[:-1] = measurements - self._noises.upper
            self._upper[:-1] = measurements - self._noises.lower
        candidate, nothing = estimate.candidate, np.zeros((HORIZON, 0))
        window = WindowData(
            measurements[-1], nothing[0], candidate[0], measurements, nothing, candidate,
            np.zeros((HORIZON, candidate.shape[1])),
        )
        try:
            found, seconds, _ = timed(self._peer.update, window)
        except RuntimeError:  # a window without a solution, perhaps
            self._peer.restart()
            return np.full(candidate.shape, np.nan), np.nan
        return found, seconds


def cost(example: Any, trajectory: Array, prior: Array, measurements: Array) -> float:
    """J of a trajectory."""
    f, h, weights = example.system.f, example.system.h, example.cost
    u = np.zeros(0)
    value = (trajectory[0] - prior) @ weights.prior @ (trajectory[0] - prior)
    for x, following, y in zip(trajectory[:-1], trajectory[1:], measurements, strict=True):
        w, v = following - f(x, u), y - h(x, u)
        value += w @ weights.disturbance @ w + v @ weights.noise @ v
    return float(value)


@dataclass
class Case:
    """What was measured with one choice of sets."""

    name: str
    active: float = 0.0
    gap: float = 0.0
    solved: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    acados: dict[str, float] | None = None


def measured(name: str, sets: dict[str, Any], steps: int) -> Case:
    """Run all on one record."""
    example = qpmhe.models.chain_of_masses(MASSES, DIMENSION)
    scenario = example.scenario
    system = qpmhe.from_casadi(
        casadi_rate(MASSES, DIMENSION), casadi_output(MASSES, DIMENSION), dt=scenario.dt,
        n=example.system.n, **sets,
    )
    record = scenario.simulate(0, steps).measurements
    options: dict[str, dict[str, Any]] = {
        "compiled, converged": {"engine": "compiled", "max_qps": None},
        "compiled, one QP": {"engine": "compiled"},
        "Python, converged": {"engine": "python", "max_qps": None},
        "Python by PIQP, converged": {"engine": "python", "max_qps": None, "backend": "piqp"},
        "multistage": {"engine": "python", "max_qps": None, "backend": "multistage"},
    }
    ours = {
        name: qpmhe.MovingHorizonEstimator(
            system, example.observer, example.cost, horizon=HORIZON,
            initial_state=scenario.initial_estimate, **own,
        ) for name, own in options.items()
    }
    estimates: dict[str, list[qpmhe.Estimate]] = {one: [] for one in ours}
    times: dict[str, list[float]] = {one: [] for one in ours}
    peer, theirs = Hpipm(example, sets), []
    others: dict[str, Windows] = {}
    try:
        others = {
            "acados, converged": Windows(example, sets, None),
            "acados, one QP": Windows(example, sets, 1),
        }
    except UnavailableError as error:
        tell_once(f"left out: acados: {error}")
    answers: dict[str, list[tuple[Array, float]]] = {one: [] for one in others}
    Multistage.seconds = []
    for begin in range(0, steps, TURN):
        share = range(begin, min(begin + TURN, steps))
        for one, mhe in ours.items():
            for t in share:
                estimate, seconds, _ = timed(mhe.update, record[t])
                estimates[one].append(estimate)
                times[one].append(seconds)
        windows = [
            (estimates["compiled, converged"][t], record[t + 1 - HORIZON : t + 1])
            for t in share if t >= HORIZON
        ]
        for one, other in others.items():
            answers[one] += [other.update(*window) for window in windows]
        theirs += [peer.update(*window) for window in windows]
    converged = estimates["compiled, converged"][HORIZON:]
    solved = [k for k, (cost, _, _) in enumerate(theirs) if np.isfinite(cost)]
    deviations = np.sqrt(np.diag(np.linalg.inv(example.cost.prior)))
    pairs = [
        (k, found) for k, (found, _) in enumerate(answers.get("acados, converged", []))
        if np.isfinite(found).all()
    ]
    differences = [
        float(np.abs((found - converged[k].trajectory) / deviations).max()) for k, found in pairs
    ]
    gaps = [
        abs(cost(
            example, found, converged[k].candidate[0], record[k + 1 : k + 1 + HORIZON]
        ) / converged[k].cost - 1.0) for k, found in pairs
    ]
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
            **{
                one: middle(times[one][HORIZON:])
                for one in ours if one != "multistage"
            },
            **{
                one: middle(seconds for _, seconds in answers[one] if np.isfinite(seconds))
                for one in others
            },
            "HPIPM, converged": middle(theirs[k][1] for k in solved),
            "HPIPM, one QP": middle(theirs[k][2] for k in solved),
            "PIQP, one QP": middle(Multistage.seconds[len(Multistage.seconds) // 3 :]),
        },
        {
            "difference": max(differences), "cost_gap": max(gaps),
            "solved": len(pairs) / len(converged),
        } if pairs else None,
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
        for other in ("HPIPM", "acados"):
            if f"{other}, {row}" in cases[0].seconds:
                table.add_row(f"compiled / {other}, {row}", *(
                    f"{one.seconds[f'compiled, {row}'] / one.seconds[f'{other}, {row}']:.2f}"
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
        if one.acados is not None:
            console.print(
                f"{one.name}: acados solved {100 * one.acados['solved']:.0f} % of the windows. "
                f"Converged, costs agree to {one.acados['cost_gap']:.0e} and trajectories to "
                f"{one.acados['difference']:.0e} standard deviations of the prior.",
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
                "acados": one.acados,
                "us": {row: 1e6 * seconds for row, seconds in one.seconds.items()},
            }
            for one in cases
        ],
    }, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
