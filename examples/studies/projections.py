"""The observer's own metric against a diagonal one, in which it is projected onto X.

``python -m examples.studies.projections --data DIR`` prints the tables of
docs/explanation/projected-observer.md: errors of drawn points before and after a projection; then
errors of the observer alone and of estimators with two QPs on it, on all problems of the gallery
and all models of the zoo that have an X, and on compartments of which many are empty. Without
``--data``, the measured records are left out.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import qpmhe
from examples.gallery.battery.cell import problems as battery
from examples.gallery.command import grouped
from examples.gallery.indoor_uwb.robot import problems as indoor_uwb
from examples.gallery.problem import Problem, judge
from examples.gallery.reactors.reactors import problems as reactors
from qpmhe.observers.projection import NearestPoint

Array = NDArray[np.float64]
METRICS = "observer", "diagonal"
QPS = 0, 2
MEASURED = {"battery": (battery, "samsung_30t"), "indoor_uwb": (indoor_uwb, "indoor_uwb")}
OBSERVERS: dict[str, Callable[..., qpmhe.Observer]] = {
    "EKF": qpmhe.ExtendedKalman, "UKF": qpmhe.UnscentedKalman,
}
#: A model's initial error, in multiples of that of its scenario.
FACTORS = 1, 3
SIZES = 5, 11, 21  # compartments
#: For the same inputs, a row: label, then errors of runs for each number of QPs and each metric.
Row = tuple[str, dict[tuple[int, str], Array]]


def of_gallery(problem: Problem) -> Iterator[Row]:
    """Rows of a problem: of each record and filter."""
    for name, records in grouped(problem.records).items():
        for kind, observer in OBSERVERS.items():
            found = {}
            for count in QPS:
                for metric in METRICS:
                    way = partial(
                        problem.estimator, weights=problem.weights, observer=observer,
                        max_qps=count, projection_metric=metric,
                    )
                    found[count, metric] = judge(problem, "", name, way, records, False).errors
            yield f"{problem.title}: {name}, {kind} ({problem.unit})", found


def errors(
    example: Any, observer: qpmhe.Observer, cost: qpmhe.Cost, start: Array, seeds: int,
    scale: Array, **options: Any,
) -> Array:
    """Root mean square errors of runs, each component in units of its scale."""
    system, _, _, scenario = example
    found = []
    for seed in range(seeds):
        states, *given = scenario.simulate(seed)
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=scenario.horizon, initial_state=start,
            engine="python", **options,
        )
        run = mhe.run(*given)
        found.append(np.sqrt(np.mean(((run.states - states) / scale) ** 2)))
    return np.array(found)


def of_model(name: str, seeds: int) -> Iterator[Row]:
    """Rows of a model of the zoo: with its own observer, and with an extended Kalman filter."""
    example = qpmhe.models.catalogue()[name]()
    system, own, cost, scenario = example
    assert system.states is not None
    prior, noise = np.linalg.inv(cost.prior), scenario.noise_covariance
    scale = np.sqrt(prior.diagonal())
    covariances = {"prior": prior, "disturbance": scenario.disturbance_covariance, "noise": noise}
    extended = qpmhe.QuadraticCost.from_covariances(
        disturbance=covariances["disturbance"], noise=noise
    )
    for kind, observer, weights in (
        ("own observer", own, cost),
        ("EKF", qpmhe.ExtendedKalman(**covariances), extended),
    ):
        for factor in FACTORS:
            away = factor * (scenario.initial_estimate - scenario.initial_state)
            start = np.clip(
                scenario.initial_state + away, system.states.lower, system.states.upper
            )
            yield f"{name}, {kind}, {factor} times the initial error", {
                (count, metric): errors(
                    example, observer, weights, start, seeds, scale, max_qps=count,
                    projection_metric=metric,
                )
                for count in QPS for metric in METRICS
            }


def of_compartments(size: int, seeds: int) -> Row:
    """Compartments on a circle, x >= 0, many of them empty; sums of three are measured."""
    eye = np.eye(size)
    A = 0.7 * eye + 0.1 * np.roll(eye, 1, axis=0) + 0.1 * np.roll(eye, -1, axis=0)
    C = (eye + np.roll(eye, 1, axis=0) + np.roll(eye, -1, axis=0))[::2]
    system = qpmhe.System(
        lambda x: x @ A.T, lambda x: x @ C.T, n=size, p=len(C),
        states=qpmhe.Box(np.zeros(size), np.full(size, np.inf)),
    )
    # A filling is rare: the filter's covariance is that of all steps.
    covariances = {"prior": eye, "disturbance": 0.1 * eye, "noise": 0.25 * np.eye(len(C))}
    cost = qpmhe.QuadraticCost.from_covariances(disturbance=0.1 * eye, noise=0.25 * np.eye(len(C)))
    found: dict[tuple[int, str], list[float]] = {(q, m): [] for q in QPS for m in METRICS}
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        x, states, ys = np.zeros(size), [], []
        for _ in range(200):
            states.append(x)
            ys.append(C @ x + 0.5 * rng.standard_normal(len(C)))
            x = A @ x + (rng.random(size) < 0.03) * rng.exponential(2.0, size)
        for count, metric in found:
            mhe = qpmhe.MovingHorizonEstimator(
                system, qpmhe.ExtendedKalman(**covariances), cost, horizon=5,
                initial_state=np.zeros(size), max_qps=count, projection_metric=metric,
                engine="python",
            )
            away = mhe.run(np.array(ys)).states[:-1] - states
            found[count, metric].append(float(np.sqrt(np.mean(away * away))))
    return f"{size} compartments, EKF", {key: np.array(one) for key, one in found.items()}


def of_draws(size: int, is_true: bool, count: int = 200) -> str:
    """A line: errors before and after a projection onto x >= 0, of drawn points.

    Of the true states' components, 70 % are 0. The errors have the metric's covariance, which is
    drawn at random, or they are independent of it, with a standard deviation of 1.
    """
    rng, convex_set = np.random.default_rng(size), qpmhe.Box(np.zeros(size), np.full(size, np.inf))
    ways = [NearestPoint(convex_set), NearestPoint(convex_set, True)]
    squares = np.empty((count, 3, 2))
    for one in squares:
        root = rng.standard_normal((size, size)) / np.sqrt(size)
        truth = np.where(rng.random(size) < 0.7, 0.0, rng.exponential(1.0, size))
        away = rng.standard_normal(size)
        point = truth + (root @ away if is_true else away)
        covariance = root @ root.T
        weight = np.linalg.inv(covariance)
        for k, found in enumerate((point, *(way(point, covariance).point for way in ways))):
            error = found - truth
            one[k] = error @ error, error @ weight @ error
    sizes = np.sqrt(squares.mean(axis=0))
    cells = (f"{euclidean:.3g} ({own:.3g})" for euclidean, own in sizes)
    return f"| {size}, {'true' if is_true else 'wrong'} covariance | {' | '.join(cells)} |"


DRAWS = "| components | not projected | own metric | diagonal |\n|---|---|---|---|"
HEAD = "| problem | own metric, observer | diagonal, observer | own metric, 2 QPs | " \
    "diagonal, 2 QPs |\n|---|---|---|---|---|"


def show(row: Row) -> None:
    """A line of the table: median and largest error of the runs."""
    label, found = row
    cells = [
        f"{np.median(found[count, metric]):.3g} ({found[count, metric].max():.3g})"
        for count in QPS for metric in METRICS
    ]
    print(f"| {label} | {' | '.join(cells)} |", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder above the data sets")
    parser.add_argument("--seeds", type=int, default=10, help="runs of each simulated problem")
    given = parser.parse_args(arguments)
    print("Euclidean error (in the own metric) of drawn points:\n", DRAWS, sep="\n")
    for is_true in (True, False):
        for size in SIZES:
            print(of_draws(size, is_true), flush=True)
    print("", HEAD, sep="\n")
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # of filters that are lost, which are compared, too
        for size in SIZES:
            show(of_compartments(size, given.seeds))
        for name, make in qpmhe.models.catalogue().items():
            if make().system.states is not None:
                for row in of_model(name, given.seeds):
                    show(row)
        made = list(reactors(Path(), given.seeds < 10))
        for make, folder in MEASURED.values() if given.data is not None else ():
            made += make(given.data / folder, True)
        for problem in made:
            for row in of_gallery(problem):
                show(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
