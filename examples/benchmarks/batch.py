"""Throughput of a batch: many reactors at once, beside a loop of single estimators.

The paper's reactor, N = 10, one QP a sample. All estimate the same records and reach the same
states. A step is one update of one member.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from time import perf_counter

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import numpy as np
from report import environment
from rich.console import Console
from rich.table import Table

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.models.batch_reactor import casadi_output, casadi_rate

HORIZON, START = 10, (3.0, 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=1000, help="estimators in the batch")
    parser.add_argument("--steps", type=int, default=100, help="samples of each record")
    parser.add_argument("--repeats", type=int, default=5, help="the median of so many counts")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    arguments = parser.parse_args()

    plain, observer, cost, scenario = qpmhe.models.batch_reactor()
    model = qpmhe.from_casadi(casadi_rate, casadi_output, dt=0.1, method="euler", n=2)
    records = np.array([
        scenario.simulate(seed, arguments.steps).measurements for seed in range(arguments.members)
    ])
    shared = {"members": arguments.members, "horizon": HORIZON, "initial_states": START}
    single = qpmhe.MovingHorizonEstimator(
        plain, observer, cost, horizon=HORIZON, initial_state=START, engine="python"
    )
    batches = {}
    if find_compiler() is not None:
        threads = sorted({1, len(os.sched_getaffinity(0))})
        for count in threads:
            batches[f"compiled, {count} thread{'s' * (count > 1)}"] = qpmhe.BatchEstimator(
                model, observer, cost, engine="compiled", threads=count, **shared
            )
    loop, rates = [], {name: [] for name in batches}
    for repeat in range(arguments.repeats):
        single.reset()
        began = perf_counter()
        reference = single.run(records[repeat]).states
        loop.append(arguments.steps / (perf_counter() - began))
        for name, batch in batches.items():
            batch.reset()
            began = perf_counter()
            run = batch.run(records)
            rates[name].append(records[:, :, 0].size / (perf_counter() - began))
            difference = float(np.abs(run.states[repeat] - reference).max())
            if difference > 1e-9:
                raise SystemExit(f"{name} differs by {difference:.1e}: nothing to compare")

    base = float(np.median(loop))
    rows = [{"estimator": "loop over single ones, NumPy", "steps_per_second": base, "ratio": 1.0}]
    rows += [
        {"estimator": name, "steps_per_second": float(np.median(found)),
         "ratio": float(np.median(found)) / base}
        for name, found in rates.items()
    ]
    table = Table(title=f"{arguments.members} reactors, {arguments.steps} samples each",
                  title_justify="left")
    table.add_column("estimator", no_wrap=True)
    table.add_column("steps/s", justify="right")
    table.add_column("of the loop's", justify="right")
    for row in rows:
        table.add_row(row["estimator"], f"{row['steps_per_second']:,.0f}", f"{row['ratio']:,.1f}")
    Console().print(table)
    arguments.out.mkdir(parents=True, exist_ok=True)
    versions = environment(("qpmhe", "numpy", "scipy", "casadi"))
    (arguments.out / "batch.json").write_text(
        json.dumps({"environment": versions, "rows": rows}, indent=1), encoding="utf-8"
    )


if __name__ == "__main__":
    main()
