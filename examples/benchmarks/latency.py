"""The latency of single updates of the compiled step: medians, tails, and the machine's own spikes.

A zoo model written in plain NumPy, beside the same model given as CasADi functions. Where other
programs take the processor within an update, its time is the processor's. Between the updates an
empty loop runs so many passes that it usually takes as long as an update: its tail is the
machine's. The column `first` is the median over the first 100 samples of a new estimator, in the
best of 15. The column `to CasADi` divides it by that of the CasADi model. The column `own tail`
subtracts the machine's share from the 99.99th percentile and divides the rest by the median; this
share is how far the empty loop's percentile lies above its own median. The column `left alone` is
the same of those updates in which the system's scheduler did not take the processor away, and
`taken` says in how many of a million it did: after that, caches are cold. Interrupts of the machine
count neither, and the empty loop meets as many of them. The column `each run` divides the 99.99th
percentile of the least time of each update in several runs over the same samples by the median of
these: an update that always does more work is slow in every run, an interrupt comes where it will.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import resource
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
RUNS = 3
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
    columns += "left alone", "each run", "taken"
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        numbers = *row["microseconds"], row["first_to_casadi"], row["own_tail_to_median"]
        numbers += row["left_alone_to_median"], row["each_run_to_median"]
        numbers += (row["taken_in_a_million"],)
        table.add_row(row["estimator"], *(f"{one:,.2f}" for one in numbers))
    Console(width=150).print(table)
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
            took, *_ = timed(made(kind), samples, RECORD, 0)
            first[kind] = min(first[kind], float(np.median(took)))
    rows = []
    for kind in systems:
        mhe = made(kind)
        gc.collect()
        gc.disable()
        passes = int(first[kind] / seconds_a_pass())
        took, idle, taken = timed(mhe, samples, steps, passes)
        least = took
        for _ in range(RUNS - 1):
            least = np.minimum(least, timed(made(kind), samples, steps, passes)[0])
        gc.enable()
        found = [first[kind], *np.percentile(took, PERCENTILES), np.percentile(idle, 99.99)]
        machine = found[-1] - np.median(idle)
        alone = np.percentile(took[~taken[0]], 99.99)
        machine_alone = np.percentile(idle[~taken[1]], 99.99) - np.median(idle)
        rows.append({
            "estimator": f"{name}, {kind}", "microseconds": [1e6 * one for one in found],
            "first_to_casadi": first[kind] / first["CasADi"],
            "own_tail_to_median": float((found[-2] - machine) / found[1]),
            "left_alone_to_median": float((alone - machine_alone) / found[1]),
            "each_run_to_median": float(np.percentile(least, 99.99) / np.median(least)),
            "taken_in_a_million": 1e6 * float(taken[0].mean()),
        })
    return rows


def seconds_a_pass(passes: int = 10_000) -> float:
    """The least time of a pass of an empty loop."""
    least = np.inf
    for _ in range(RECORDS):
        began = perf_counter()
        for _ in range(passes):
            pass
        least = min(least, (perf_counter() - began) / passes)
    return float(least)


def timed(mhe: qpmhe.MovingHorizonEstimator, samples: list, steps: int, passes: int) -> tuple:
    """Seconds of each update, of so many passes of an empty loop, and who was interrupted.

    The last is an array (2, steps): whether another thread had the processor within the update,
    and within the loop.
    """
    took, idle, clock, count = np.empty(steps), np.empty(steps), perf_counter, len(samples)
    switches, usage = np.empty((2, steps + 1), np.int64), resource.getrusage
    switches[1, 0] = usage(resource.RUSAGE_THREAD).ru_nivcsw
    busy = thread_time
    for t in range(steps):
        sample = samples[t % count]
        before = busy()
        began = clock()
        mhe.update(*sample)
        ended = clock()
        # The processor's clock takes longer to read, and around the other one reads more.
        took[t] = min(ended - began, busy() - before)
        switches[0, t + 1] = usage(resource.RUSAGE_THREAD).ru_nivcsw
        before = busy()
        began = clock()
        for _ in range(passes):
            pass
        ended = clock()
        idle[t] = min(ended - began, busy() - before)
        switches[1, t + 1] = usage(resource.RUSAGE_THREAD).ru_nivcsw
    taken = switches[0, 1:] > switches[1, :-1], switches[1, 1:] > switches[0, 1:]
    return took, idle, np.array(taken)


if __name__ == "__main__":
    main()
