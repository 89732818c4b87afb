"""Steps with nonlinear and soft constraints: both engines and acados, in one run on one thread.

- The paper's batch reactor (n = 2, N = 10), whose reaction does not run past its equilibrium: the
  constraint k2 x2 <= k1 x1^2, hard or with a penalty, is active in most windows once the
  equilibrium is near.
- A chain of two masses in three dimensions (n = 12, N = 30), whose velocities have a box so tight
  that about a tenth of its rows is active, hard or softened.

All take each sample one after the other. acados, where ACADOS_SOURCE_DIR is set, has nonlinear
rows and slacks of its own, with the same penalties, and starts at its own shifted solution.
"""

from __future__ import annotations

import os
import statistics
import warnings
from dataclasses import dataclass
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from numpy.typing import NDArray
from peers import UnavailableError, WindowData
from peers.acados_window import Acados, Bounds
from problems import Problem, chain_problem, reactor_problem
from rich.console import Console
from rich.table import Table
from stopwatch import timed

import qpmhe

Array = NDArray[np.float64]
STEPS, WARM_UP = 150, 40
TIGHT = (0.1, 0.9)  # quantiles of the free estimates' velocities that are the box


@dataclass(frozen=True)
class Case:
    """Constraints of a problem: rows g(x) <= 0 or a box of the states, and their penalty."""

    name: str
    problem: Problem
    rows: Any = None
    box: qpmhe.Box | None = None
    linear: float = 0.0
    quadratic: float = 0.0

    @property
    def soft(self) -> bool:
        """Whether it has a penalty."""
        return self.linear + self.quadratic > 0.0

    def estimators(self, max_qps: int | None) -> list[qpmhe.MovingHorizonEstimator]:
        """Ours, compiled and in Python."""
        penalty = {"linear": self.linear, "quadratic": self.quadratic} if self.soft else {}
        options: dict[str, Any] = {}
        if self.rows is not None:
            options["constraints"] = [qpmhe.Constraint(self.rows, **penalty)]
        if self.box is not None:
            options["states"] = self.box.soften(**penalty) if self.soft else self.box
        one = self.problem
        system = qpmhe.from_casadi(
            one.rate, one.output, n=one.n, dt=one.scenario.dt, method=one.method, **options
        )
        return [
            qpmhe.MovingHorizonEstimator(
                system, one.observer, one.cost, horizon=one.horizon,
                initial_state=one.scenario.initial_estimate, max_qps=max_qps, engine=engine,
            )
            for engine in ("compiled", "python")
        ]

    def peer(self, max_qps: int | None) -> Acados:
        """The same problem in acados."""
        one, bounds = self.problem, None
        if self.box is not None:
            bounded = list(np.flatnonzero(np.isfinite([self.box.lower, self.box.upper]).any(0)))
            lower, upper = (
                np.tile(side[bounded], (one.horizon + 1, 1))
                for side in (self.box.lower, self.box.upper)
            )
            bounds = Bounds(bounded, lower, upper)
        peer = Acados(max_qps)
        peer.build(
            one.step, one.output, one.cost, (one.horizon, one.n, one.p, one.m), bounds, self.rows,
            (self.linear, self.quadratic) if self.soft else None,
        )
        return peer


def past_equilibrium(x: Any) -> Any:
    """The net rate of the reaction 2A <-> B, backwards."""
    return 0.64 * x[1] - 0.16 * x[0] ** 2


def cases() -> list[Case]:
    """All choices of constraints."""
    reactor, chain = reactor_problem(), chain_problem(2, 3)
    half = chain.n // 2
    free = qpmhe.MovingHorizonEstimator(
        chain.system, chain.observer, chain.cost, horizon=chain.horizon,
        initial_state=chain.scenario.initial_estimate,
    )
    record = chain.scenario.simulate(0, STEPS).measurements
    found = np.array([free.update(y).state for y in record])[chain.horizon // 2 :]
    lower, upper = (np.quantile(found, q, axis=0) for q in TIGHT)
    lower[:half], upper[:half] = -np.inf, np.inf
    box = qpmhe.Box(lower, upper)
    return [
        Case("reactor, no constraint", reactor),
        Case("reactor, hard", reactor, past_equilibrium),
        Case("reactor, soft, linear", reactor, past_equilibrium, linear=20.0),
        Case("reactor, soft, both", reactor, past_equilibrium, linear=5.0, quadratic=50.0),
        Case("chain, hard box", chain, box=box),
        Case("chain, soft box", chain, box=box, linear=20.0, quadratic=50.0),
    ]


def measured(case: Case, max_qps: int | None) -> tuple[list[float], list[float]]:
    """Median times (s) of both engines and acados, and how far their answers are apart.

    The latter are the largest relative difference of the engines' J, the largest difference of
    acados' trajectories from ours in deviations of the prior, and the share of windows that acados
    solves.
    """
    both, names = case.estimators(max_qps), ("compiled", "python")
    try:
        peer = case.peer(max_qps)
    except UnavailableError:
        peer = None
    times: dict[str, list[float]] = {one: [] for one in (*names, "acados")}
    problem, apart, differ = case.problem, 0.0, 0.0
    record = problem.scenario.simulate(0, STEPS).measurements
    count, nothing = problem.horizon, np.zeros((problem.horizon, 0))
    deviations = np.sqrt(np.diag(np.linalg.inv(problem.cost.prior)))
    for t, y in enumerate(record):
        found = []
        for name, one in zip(names, both, strict=True):
            estimate, seconds, _ = timed(one.update, y)
            found.append(estimate)
            times[name].append(seconds)
        apart = max(apart, abs(found[0].cost - found[1].cost) / found[1].cost)
        candidate = found[0].candidate
        if peer is None or len(candidate) <= count:
            continue
        window = WindowData(
            y, nothing[0], candidate[0], record[t + 1 - count : t + 1], nothing, candidate,
            np.zeros((count, problem.n)),
        )
        try:
            states, seconds, _ = timed(peer.update, window)
        except RuntimeError:  # it counts as not solved, and starts anew
            peer.restart()
            continue
        times["acados"].append(seconds)
        differ = max(differ, float(np.abs((states - found[0].trajectory) / deviations).max()))
    seconds = [statistics.median(times[one][WARM_UP:]) for one in names]
    share = len(times["acados"]) / max(STEPS - count + 1, 1)
    theirs = statistics.median(times["acados"][10:]) if share > 0.1 else np.nan
    return [*seconds, theirs], [apart, differ, share]


def main() -> None:
    warnings.simplefilter("ignore", qpmhe.errors.ObserverWarning)
    table = Table(title=f"Medians of {STEPS - WARM_UP} steps (us)", title_justify="left")
    columns = ("compiled", "Python", "acados", "Python/compiled", "acados/compiled")
    table.add_column("constraint", no_wrap=True)
    for column in ("QPs", *columns, "J", "acados' states", "solved"):
        table.add_column(column, justify="right")
    for case in cases():
        for max_qps in (1, None):
            (ours, python, theirs), (apart, differ, share) = measured(case, max_qps)
            table.add_row(
                case.name, "1" if max_qps else "converged", f"{1e6 * ours:.1f}",
                f"{1e6 * python:.0f}", f"{1e6 * theirs:.1f}", f"{python / ours:.0f}",
                f"{theirs / ours:.2f}", f"{apart:.0e}", f"{differ:.0e}", f"{100 * share:.0f} %",
            )
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
