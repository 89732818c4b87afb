"""The latency of single updates of the compiled step: medians, tails, and the machine's own spikes.

A zoo model written in plain NumPy, beside the same model given as CasADi functions. Where other
programs take the processor within an update, its time is the processor's. Between the
updates a loop waits for as long as an update usually takes, and does nothing: its tail is the
machine's. The column `first` is the median over the first 100 samples of a new estimator, in the
best of 15. The column `to CasADi` divides it by that of the CasADi model. The column `own tail`
subtracts the machine's share from the 99.99th percentile and divides the rest by the median; this
share is how far the idle loop's percentile lies above its own median.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
from pathlib import Path
from time import perf_counter, thread_time

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import casadi as ca
import numpy as np
from report import environment
from rich.console import Console
from rich.table import Table

import qpmhe
from qpmhe.codegen.compiler import find_compiler

MODELS = ("batch_reactor", "chain_of_masses", "quadrotor")
RECORD, RECORDS = 100, 15
PERCENTILES = (50.0, 99.0, 99.9, 99.99)


def as_casadi(system: qpmhe.System) -> qpmhe.System:
    """The same model, given as CasADi functions."""
    symbolic = system.model().symbolic
    x, u = ca.SX.sym("x", system.n), ca.SX.sym("u", system.m)
    arguments = [x, u] if system.m else [x]
    step = ca.Function("f", arguments, [symbolic.step()(x, u, symbolic.dt or 0.0)])
    output = ca.Function("h", arguments, [symbolic.h(x, u)])
    return qpmhe.from_casadi(step, output)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000, help="updates of each estimator")
    parser.add_argument("--models", nargs="+", default=MODELS, help="models of the zoo")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    arguments = parser.parse_args()
    if find_compiler() is None:
        raise SystemExit("there is no C compiler")
    rows = [row for name in arguments.models for row in measured(name, arguments.steps)]
    table = Table(title="Microseconds an update", title_justify="left")
    table.add_column("estimator", no_wrap=True)
    columns = "first", *(f"{one:g} %" for one in PERCENTILES), "idle", "to CasADi", "own tail"
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        numbers = *row["microseconds"], row["first_to_casadi"], row["own_tail_to_median"]
        table.add_row(row["estimator"], *(f"{one:,.2f}" for one in numbers))
    Console(width=120).print(table)
    arguments.out.mkdir(parents=True, exist_ok=True)
    versions = environment(("qpmhe", "numpy", "casadi"))
    (arguments.out / "latency.json").write_text(
        json.dumps({"environment": versions, "rows": rows}, indent=1), encoding="utf-8"
    )


def measured(name: str, steps: int) -> list[dict[str, object]]:
    """A row for the NumPy model, and one for the CasADi model."""
    system, observer, cost, scenario = getattr(qpmhe.models, name)()
    record = scenario.simulate(seed=0, steps=1000)
    samples = [
        (y, *(() if not system.m else (u,)))
        for y, u in zip(record.measurements, record.inputs if system.m else record.measurements,
                        strict=False)
    ]
    options = {
        "horizon": scenario.horizon, "initial_state": scenario.initial_state, "time_budget": 1.0
    }
    systems = {"NumPy": system, "CasADi": as_casadi(system)}

    def made(kind: str) -> qpmhe.MovingHorizonEstimator:
        return qpmhe.MovingHorizonEstimator(
            systems[kind], observer, cost, engine="compiled", **options
        )

    first = dict.fromkeys(systems, np.inf)
    for _ in range(RECORDS):
        for kind in systems:
            took, _ = timed(made(kind), samples, RECORD, 0.0)
            first[kind] = min(first[kind], float(np.median(took)))
    rows = []
    for kind in systems:
        mhe = made(kind)
        gc.collect()
        gc.disable()
        took, idle = timed(mhe, samples, steps, first[kind])
        gc.enable()
        found = [first[kind], *np.percentile(took, PERCENTILES), np.percentile(idle, 99.99)]
        machine = found[-1] - np.median(idle)
        rows.append({
            "estimator": f"{name}, {kind}", "microseconds": [1e6 * one for one in found],
            "first_to_casadi": first[kind] / first["CasADi"],
            "own_tail_to_median": float((found[-2] - machine) / found[1]),
        })
    return rows


def timed(mhe: qpmhe.MovingHorizonEstimator, samples: list, steps: int, wait: float) -> tuple:
    """Seconds of each update, and of waiting for so many seconds in between."""
    took, idle, clock, count = np.empty(steps), np.empty(steps), perf_counter, len(samples)
    busy = thread_time
    for t in range(steps):
        sample = samples[t % count]
        before = busy()
        began = clock()
        mhe.update(*sample)
        ended = clock()
        # The processor's clock takes longer to read, and around the other one reads more.
        took[t] = min(ended - began, busy() - before)
        before = busy()
        began = ended = clock()
        while ended - began < wait:
            ended = clock()
        idle[t] = min(ended - began, busy() - before)
    return took, idle


if __name__ == "__main__":
    main()
