"""Time per step and memory of the Python step for models of many states with sparse Jacobians.

Diffusion with a reaction on a line and on a square grid: every tenth state is measured, the gain
is constant, prior and weights are diagonal, N = 10, one QP a step. The step holds matrices by their
entries; ``--whole`` has it hold them whole, as for dense models. Sizes take turns. Memory is what
tracemalloc sees: of an estimator with a full window, beside model and weights, and the most that a
step takes beside it.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import tracemalloc
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from report import environment
from rich import box
from rich.console import Console
from rich.table import Table
from stopwatch import timed

import qpmhe
from qpmhe.terms import entries

HORIZON, SEEN = 10, 10
LINES, SIDES = (100, 200, 400, 1000, 2000), (10, 20, 32)


class Reaction:
    """x + 0.1 (sum of the neighbours - x) + 0.01 x (1 - x) on a grid, without flow at its ends."""

    def __init__(self, rows: int, columns: int) -> None:
        self.shape, n = (rows, columns), rows * columns
        self.n, self.p = n, len(range(0, n, SEEN))
        self.system = qpmhe.System(f=self.step, h=lambda x: x[::SEEN], n=n, p=self.p)
        self.gain = 0.3 * np.eye(n)[:, ::SEEN]
        self.cost = qpmhe.QuadraticCost(
            prior=np.eye(n), disturbance=5.0 * np.eye(n), noise=9.0 * np.eye(self.p)
        )

    def step(self, x: Any) -> Any:
        """The next state."""
        flow = 0.0
        one = x.reshape(self.shape)
        if self.shape[0] > 1:
            flow = np.concatenate((one[:1], one[:-1])) + np.concatenate((one[1:], one[-1:]))
            flow = flow - 2.0 * one
        left = np.concatenate((one[:, :1], one[:, :-1]), axis=1)
        right = np.concatenate((one[:, 1:], one[:, -1:]), axis=1)
        return x + 0.1 * (flow + left + right - 2.0 * one).reshape(-1) + 0.01 * x * (1.0 - x)

    def estimator(self) -> qpmhe.MovingHorizonEstimator:
        """One QP a step."""
        return qpmhe.MovingHorizonEstimator(
            self.system, qpmhe.Luenberger(self.gain), self.cost, horizon=HORIZON,
            initial_state=np.full(self.n, 0.4), max_qps=1, engine="python",
        )

    def record(self, steps: int) -> np.ndarray:
        """Measurements (steps, p)."""
        return 0.5 + 0.1 * np.random.default_rng(0).standard_normal((steps, self.p))


def memory(model: Reaction) -> tuple[float, float]:
    """MB that an estimator with a full window holds, and the most that a step takes beside it."""
    record = model.record(HORIZON + 3)
    gc.collect()
    tracemalloc.start()
    try:
        mhe = model.estimator()
        for y in record[:-1]:
            mhe.update(y)
        gc.collect()
        held = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        mhe.update(record[-1])
        return held / 1e6, (tracemalloc.get_traced_memory()[1] - held) / 1e6
    finally:
        tracemalloc.stop()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=40, help="timed steps of each size")
    parser.add_argument("--quick", action="store_true", help="fewer sizes")
    parser.add_argument("--whole", action="store_true", help="hold matrices whole")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    chosen = parser.parse_args()
    if chosen.whole:
        entries._LEAST_STATES = 10**9
    lines, sides = (LINES[:3], SIDES[:2]) if chosen.quick else (LINES, SIDES)
    models = [Reaction(1, n) for n in lines if not chosen.whole or n <= 1000]
    models += [Reaction(side, side) for side in sides]
    surroundings, console, times = environment(["qpmhe", "casadi"]), Console(), []
    rows: list[dict[str, Any]] = []
    made = [(one.estimator(), one.record(HORIZON + 1 + chosen.steps)) for one in models]
    for mhe, record in made:
        for y in record[: HORIZON + 1]:
            mhe.update(y)
        times.append([])
    for k in range(HORIZON + 1, HORIZON + 1 + chosen.steps):
        for (mhe, record), own in zip(made, times, strict=True):
            own.append(1e3 * timed(mhe.update, record[k])[1])
    made.clear()
    table = Table(title="diffusion with a reaction, one QP", title_justify="left",
                  box=box.SIMPLE_HEAD)
    for name in ("grid", "n", "least ms", "median ms", "MB held", "MB within a step"):
        table.add_column(name, justify="right")
    for one, own in zip(models, times, strict=True):
        held, beside = memory(one)
        row = {"grid": list(one.shape), "n": one.n, "least_ms": min(own),
               "median_ms": float(np.median(own)), "held_mb": held, "step_mb": beside}
        rows.append(row)
        table.add_row("x".join(map(str, one.shape)), str(one.n), *(
            f"{row[name]:,.2f}" for name in ("least_ms", "median_ms", "held_mb", "step_mb")
        ))
    console.print(table)
    chosen.out.mkdir(parents=True, exist_ok=True)
    name = "large-whole" if chosen.whole else "large"
    content = {"environment": surroundings, "rows": rows}
    (chosen.out / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
