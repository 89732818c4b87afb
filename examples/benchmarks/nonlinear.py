"""Steps with a nonlinear constraint: the compiled engine beside the Python step, in one run.

The paper's batch reactor (n = 2, N = 10), whose reaction does not run past its equilibrium: the
constraint k2 x2 <= k1 x1^2, hard or with a penalty, is active in most windows once the equilibrium
is near. Both engines take each sample one after the other, on one thread.
"""

from __future__ import annotations

import os
import statistics
import warnings
from time import perf_counter
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import qpmhe
from qpmhe.models.batch_reactor import casadi_output, casadi_rate

Array = NDArray[np.float64]
STEPS, WARM_UP = 150, 20
CASES = {
    "none": None, "hard": {}, "soft, linear": {"linear": 20.0},
    "soft, both": {"linear": 5.0, "quadratic": 50.0},
}


def past_equilibrium(x: Array) -> Any:
    """The net rate of the reaction 2A <-> B, backwards."""
    return 0.64 * x[1] - 0.16 * x[0] ** 2


def measured(penalty: dict[str, float] | None, max_qps: int | None) -> tuple[list[float], float]:
    """Median times of both engines (s), and the largest relative difference of J."""
    _, observer, cost, scenario = qpmhe.models.batch_reactor("rk4")
    constraints = [] if penalty is None else [qpmhe.Constraint(past_equilibrium, **penalty)]
    system = qpmhe.from_casadi(
        casadi_rate, casadi_output, n=2, dt=0.1, method="rk4", constraints=constraints
    )
    both = [
        qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=10, initial_state=scenario.initial_estimate,
            max_qps=max_qps, engine=engine,
        )
        for engine in ("compiled", "python")
    ]
    times: list[list[float]] = [[], []]
    apart = 0.0
    for y in scenario.simulate(0, STEPS).measurements:
        costs = []
        for one, found in zip(both, times, strict=True):
            began = perf_counter()
            costs.append(one.update(y).cost)
            found.append(perf_counter() - began)
        apart = max(apart, abs(costs[0] - costs[1]) / costs[1])
    return [statistics.median(found[WARM_UP:]) for found in times], apart


def main() -> None:
    warnings.simplefilter("ignore", qpmhe.errors.ObserverWarning)
    table = Table(title=f"Reactor, N = 10; medians of {STEPS - WARM_UP} steps (us)")
    for column in ("constraint", "QPs", "compiled", "Python", "ratio", "J differs by"):
        table.add_column(column, justify="left" if column == "constraint" else "right")
    for name, penalty in CASES.items():
        for max_qps in (1, None):
            (ours, python), apart = measured(penalty, max_qps)
            table.add_row(
                name, "1" if max_qps else "converged", f"{1e6 * ours:.1f}", f"{1e6 * python:.0f}",
                f"{python / ours:.0f}", f"{apart:.0e}",
            )
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
