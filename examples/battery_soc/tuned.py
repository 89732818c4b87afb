"""Covariances of the battery's estimator, tuned on one drive cycle and judged on the others.

Run ``python examples/battery_soc/tuned.py --data DIR``; DIR as for `study.py`. `qpmhe.tune` starts
at the covariances that `model.py` gives, chosen by hand, and sees the cycle UDDS alone: its voltage
and current, and the state of charge by the tester's counter. To be quick it tunes the filter, which
the estimator equals but for outliers. The table tells the estimator's error of the state of charge
on each cycle, by hand and tuned.
"""

import argparse
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
from measurements import DataError, drive_cycles
from model import HORIZON, PRIOR, START, Cell, cost_of, disturbance, noise, robust_kalman, system_of
from rich.console import Console
from rich.table import Table
from study import DT, SETTLING, Cycle, read

import qpmhe

TRAINING = "UDDS"
# Only ratios matter to the estimates, so the noise stays. One factor of all disturbances: slow
# errors of one state in one cycle determine no more. Three lower the error on the cycle that they
# are tuned on, and double it on the other one.
STRUCTURE = {"disturbance": "scalar"}


def record(cycle: Cycle) -> qpmhe.tuning.TuningRecord:
    """The cycle with the truth of the state of charge; the other states have none."""
    truth = np.full((len(cycle.soc), 4), np.nan)
    truth[:, 0] = cycle.soc
    return qpmhe.tuning.TuningRecord(cycle.voltage, cycle.current, truth, initial_state=START)


def error(cell: Cell, weights: qpmhe.tuning.Weights, cycle: Cycle) -> float:
    """Root mean square error of the state of charge after settling, in %."""
    mhe = qpmhe.MovingHorizonEstimator(
        system_of(cell, DT), weights.observer(robust_kalman), weights.cost(),
        horizon=weights.horizon, initial_state=START,
    )
    found = mhe.run(cycle.voltage, cycle.current).states[:, 0] - cycle.soc
    return 100.0 * float(np.sqrt(np.mean(found[round(SETTLING / DT) :] ** 2)))


def main() -> int:
    parser = argparse.ArgumentParser(description="Tune the battery's estimator on one cycle.")
    parser.add_argument("--data", type=Path, required=True, help="folder of the .mat files")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the weights")
    arguments, console, cell = parser.parse_args(), Console(), Cell.read()
    try:
        files = drive_cycles(arguments.data)
        cycles = {name: read(cell, path, None) for name, path in files.items()}
        arguments.out.mkdir(parents=True, exist_ok=True)
    except (DataError, OSError) as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 2
    if TRAINING not in cycles:
        print(f"error: {arguments.data} has no cycle {TRAINING}.", file=sys.stderr)
        return 2
    by_hand = {"prior": PRIOR, "disturbance": disturbance(cell, DT), "noise": noise(DT)}
    threshold = cost_of(cell, DT, PRIOR).noise_loss.threshold
    began = perf_counter()
    tuning = qpmhe.tune(
        system_of(cell, DT), [record(cycles[TRAINING])], **by_hand, horizon=round(HORIZON / DT),
        structure=STRUCTURE, threshold=threshold, observer=robust_kalman, max_qps=0,
        names={"states": ("SOC", "v1", "v2", "rho"), "outputs": ("voltage",)},
        checkpoint=arguments.out / "battery_weights.search",
    )
    console.print(str(tuning), highlight=False)
    console.print(f"{perf_counter() - began:.0f} s; {tuning.save(arguments.out / 'battery.toml')}")
    first = qpmhe.tuning.Weights(
        **by_hand, horizon=tuning.weights.horizon, threshold=threshold
    )
    table = Table(title="Error of the SOC after 300 s, RMSE in %", title_justify="left", box=None)
    for title in ("cycle", "by hand", "tuned"):
        table.add_column(title)
    for name, cycle in cycles.items():
        errors = [error(cell, weights, cycle) for weights in (first, tuning.weights)]
        seen = " (tuned on)" if name == TRAINING else ""
        table.add_row(f"{name}{seen}", *(f"{one:.3f}" for one in errors))
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
