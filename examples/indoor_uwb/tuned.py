"""Weights of an indoor position estimator: the first half of a record tunes, the second one judges.

Run ``python examples/indoor_uwb/tuned.py --data DIR``. DIR holds ``input.txt`` and
``ground_truth.txt`` of *The Labyrinth Dataset*, Tim Pfeifer, TU Chemnitz (libRSF, folder
datasets/Indoor_UWB), licence CC BY-SA 4.0; it is not part of this project. A small robot measures
its distance to one of four ultra-wideband modules at a time, every 0.13 s, and its wheels' speeds.

The estimator knows neither where the robot starts nor where it heads: it starts in the middle, with
24 headings in turn. By hand are the covariances of a first trial.
"""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import qpmhe

Array = np.ndarray
# m between what the wheels' speeds make of a turn; by a fit to the ground truth.
TRACK = -0.157
DT = 0.128
CENTRE = np.array([1.2, 1.2])
BY_HAND = {
    "prior": np.diag([1.0, 1.0, 2.0]) ** 2, "disturbance": np.diag([0.004, 0.004, 0.01]) ** 2,
    "noise": np.array([[0.12**2]]),
}
STRUCTURE = {"disturbance": {"position": [0, 1], "heading": [2]}, "noise": {"range": [0]}}
HORIZON, THRESHOLD = 40, 1.345


def rate(x: Array, u: Array) -> Array:
    """Of position (m) and heading (rad), by speed, turn rate, and the module's position."""
    speed, turn = u[..., 0], u[..., 1]
    return np.stack((speed * np.cos(x[..., 2]), speed * np.sin(x[..., 2]), turn), axis=-1)


def distance(x: Array, u: Array) -> Array:
    """To the module whose turn it is."""
    offsets = x[..., :2] - u[..., 2:]
    return np.sqrt((offsets * offsets).sum(axis=-1, keepdims=True) + 1e-6)


def read(folder: Path) -> tuple[Array, Array, Array]:
    """Distances (T, 1), inputs (T, 4) and positions (T, 2)."""
    lines = [line.split() for line in (folder / "input.txt").read_text().splitlines() if line]
    ranges = np.array([line[1:6] for line in lines if line[0] == "range2"], float)
    wheels = np.array([line[1:4] for line in lines if line[0] == "odom2diff"], float)
    truth = np.array([
        line.split()[2:4] for line in (folder / "ground_truth.txt").read_text().splitlines() if line
    ], float)
    if not len(ranges) == len(wheels) == len(truth) or not np.allclose(ranges[:, 0], wheels[:, 0]):
        raise ValueError("its lines are not the pairs that the data set has")
    right, left = wheels[:, 1:].T
    inputs = np.column_stack((0.5 * (right + left), (right - left) / TRACK, ranges[:, 3:5]))
    return ranges[:, 1:2], inputs, truth


def starts(count: int) -> list[Array]:
    """The middle with headings all around."""
    return [np.array([*CENTRE, angle]) for angle in np.arange(count) / count * 2 * np.pi - np.pi]


def errors(
    system: qpmhe.System, weights: qpmhe.tuning.Weights, y: Array, u: Array, truth: Array,
    max_qps: int | None, begin: list[Array],
) -> Array:
    """Root mean square error (m) of the position in the second half, from each start."""
    found = []
    for start in begin:
        mhe = qpmhe.MovingHorizonEstimator(
            system, weights.observer(), weights.cost(), horizon=weights.horizon,
            initial_state=start, max_qps=max_qps, warm_start=True,
        )
        offsets = (mhe.run(y, u).filtered[:, :2] - truth)[len(y) // 2 :]
        found.append(np.sqrt(np.mean((offsets**2).sum(axis=1))))
    return np.array(found)


def main() -> int:
    parser = argparse.ArgumentParser(description="Tune an indoor position estimator.")
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    arguments, console = parser.parse_args(), Console()
    try:
        y, u, truth = read(arguments.data)
    except (OSError, ValueError, IndexError) as problem:
        print(f"error: {arguments.data} is not the data set ({problem}).", file=sys.stderr)
        return 2
    system = qpmhe.System.from_ode(
        rate, distance, dt=DT, n=3, p=1, m=4, state_residual=qpmhe.angles([2]),
    )
    half = len(y) // 2
    known = np.column_stack((truth, np.full(len(truth), np.nan)))
    # A wrong heading would pass for disturbance: the first half begins where it is likeliest.
    options = {**BY_HAND, "horizon": HORIZON, "structure": STRUCTURE, "threshold": THRESHOLD,
               "held_out": 0.0}
    likely = min(
        starts(24), key=lambda start: qpmhe.tune(
            system, [(y[:half], u[:half])], initial_state=start, objective="likelihood",
            progress=False, **options,
        ).cost_per_sample,
    )
    console.print(f"likeliest heading at the start: {likely[2]:.2f} rad")
    record = qpmhe.tuning.TuningRecord(
        y[:half], u[:half], known[: half + 1], initial_state=likely
    )
    table = Table(title="Position error in the second half, RMSE in m: from the likeliest start; "
                  "median / worst of 24",
                  title_justify="left", box=None)
    for title in ("weights", "EKF", "MHE, 2 QPs", "MHE, 5 QPs"):
        table.add_column(title)
    found = {"by hand": qpmhe.tuning.Weights(**BY_HAND, horizon=HORIZON, threshold=THRESHOLD)}
    for objective, words in (("prediction", "tuned by predictions"), ("truth", "tuned by truth")):
        tuning = qpmhe.tune(
            system, [record], objective=objective, **options,
            names={"states": ("x", "y", "heading"), "outputs": ("range",)},
        )
        console.print(f"[bold]{words}[/]\n{tuning}\n", highlight=False)
        found[words] = tuning.weights
    warnings.simplefilter("ignore", qpmhe.ObserverWarning)  # of the wrong headings
    for words, weights in found.items():
        cells = []
        for qps in (0, 2, 5):
            (known_start,) = errors(system, weights, y, u, truth, qps, [likely])
            row = errors(system, weights, y, u, truth, qps, starts(24))
            cells.append(f"{known_start:.3f}; {np.median(row):.3f} / {row.max():.3f}")
        table.add_row(words, *cells)
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
