"""Are the true covariances within the 95 % intervals of `qpmhe.tune`? On simulated records.

Run ``python examples/studies/tuning_recovery.py``: for each model of the zoo, 100 records that were
simulated with known covariances, each tuned by its likelihood from a start that is wrong by a
factor of up to three in the standard deviations. The table tells for each of them how often the
interval contains the truth, how wide it is, and how often it was named as not identified.

The pendulum is simulated with normal noise in place of its encoder: rounding has no covariance.
"""

import argparse
import sys
from dataclasses import replace
from time import perf_counter

import joblib
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import qpmhe

# Samples of a record.
STEPS = {
    "batch_reactor": 100, "van_der_pol": 3000, "cstr": 2000, "pendulum": 2000, "vehicle": 1000,
    "quadrotor": 200, "chain_of_masses": 1500, "battery_cell": 1000,
}
# The reactor's states drift out of where its model holds: several short runs make up a record.
RUNS = {"batch_reactor": 40}
# Groups of components with one standard deviation each, where there are many.
GROUPS = {
    "vehicle": {
        "disturbance": {"position": [0, 1], "heading": [2]},
        "noise": {"range": [0, 1], "bearing": [2, 3]},
    },
    "quadrotor": {
        "disturbance": {
            "position": [0, 1, 2], "velocity": [3, 4, 5], "angle": [6, 7, 8], "rate": [9, 10, 11],
        },
        "noise": {"position": [0, 1, 2], "angle": [3, 4, 5]},
    },
    "chain_of_masses": {
        "disturbance": {"position": range(3), "velocity": range(3, 6)},
        "noise": {"position": range(3)},
    },
}
# The zoo's starts are far off, which biases any filter's likelihood; ours are ten times nearer.
TEN = 10.0
# A parameter that is named in more than half of the records counts as not identified.
NAMED = 0.5


def recover(name: str, seed: int, steps: int) -> list[tuple[str, bool, float, bool]]:
    """Name, whether the truth is inside, width as a factor, and whether it is named, of each."""
    arguments = {"masses": 1} if name == "chain_of_masses" else {}
    system, _, cost, scenario = qpmhe.models.catalogue()[name](**arguments)
    scenario = replace(scenario, resolution=None)
    runs = [scenario.simulate(100 * seed + k, steps) for k in range(RUNS.get(name, 1))]
    prior = np.linalg.inv(cost.prior) / TEN**2
    starts = [near(system, run.states[0], prior, [seed, k]) for k, run in enumerate(runs)]
    structure = GROUPS.get(name, "diagonal")
    away = np.random.default_rng([20210829, seed])
    scales = {
        "disturbance": np.exp(away.uniform(-1.0, 1.0)), "noise": np.exp(away.uniform(-1.0, 1.0)),
    }
    tuning = qpmhe.tune(
        system,
        [
            qpmhe.tuning.TuningRecord(run.measurements, run.inputs, initial_state=start)
            for run, start in zip(runs, starts, strict=True)
        ],
        prior=prior,
        disturbance=scales["disturbance"] ** 2 * scenario.disturbance_covariance,
        noise=scales["noise"] ** 2 * scenario.noise_covariance,
        structure=structure, objective="likelihood",
        held_out=0.0, progress=False,
    )
    found = []
    for each, (low, high) in tuning.intervals.items():
        true = tuning.start[each] / scales[each.split()[0]]
        named = any(each in text for text in tuning.unidentified)
        width = np.sqrt(high / low) if low > 0.0 else np.inf
        found.append((each, bool(low <= true <= high), float(width), named))
    return found


def near(
    system: qpmhe.System, state: np.ndarray, covariance: np.ndarray, seed: list[int]
) -> np.ndarray:
    """A state drawn about the true one, within X."""
    drawn = np.random.default_rng(seed).multivariate_normal(state, covariance)
    if system.states is None:
        return drawn
    return np.clip(drawn, system.states.lower, system.states.upper)


def table(name: str, steps: int, found: list[list[tuple[str, bool, float, bool]]]) -> Table:
    """What was found in all records of a model."""
    runs = f"{RUNS[name]} x " if name in RUNS else ""
    title = f"{name}, {len(found)} records of {runs}{steps} samples"
    made = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for title in ("", "identified", "inside", "interval, median", "named as not identified"):
        made.add_column(title, justify="left" if not title else "right")
    for rows in zip(*found, strict=True):
        each, named = rows[0][0], np.mean([row[3] for row in rows])
        inside, width = np.mean([row[1] for row in rows]), np.median([row[2] for row in rows])
        made.add_row(
            each, "no" if named > NAMED else "yes", f"{100 * inside:.0f} %",
            f"x / {width:.2f}" if np.isfinite(width) else "no lower end", f"{100 * named:.0f} %",
        )
    return made


def main() -> int:
    parser = argparse.ArgumentParser(description="Recover known covariances from records.")
    parser.add_argument("--models", nargs="+", default=list(STEPS), choices=list(STEPS))
    parser.add_argument("--records", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    arguments, console = parser.parse_args(), Console()
    began = perf_counter()
    for name in arguments.models:
        workers = joblib.Parallel(n_jobs=arguments.jobs, return_as="generator")
        tasks = (
            joblib.delayed(recover)(name, seed, STEPS[name]) for seed in range(arguments.records)
        )
        with Progress(console=console, transient=True) as progress:
            found = list(
                progress.track(workers(tasks), total=arguments.records, description=name)
            )
        console.print(table(name, STEPS[name], found))
    console.print(f"{perf_counter() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
