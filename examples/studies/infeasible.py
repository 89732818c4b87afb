"""Dropped rows against restored candidates, where sets exclude the observer's trajectory.

``python -m examples.studies.infeasible`` prints the table of docs/how-to/sets.md. Each row is a
model and its sets, on the same records with both policies and two QPs:

- the models of the zoo, W and V at one or two standard deviations, from which the records are
  drawn, so that they hold the truth;
- the chain of masses with a W and V that do not hold it;
- the gallery, V at three standard deviations by hand: real noises are outside at times;
- sets that exclude the measured rest of a plant, and a range of a disturbance: what other
  toolboxes test their sets with.

An error is a ratio, of the root mean square errors of each state with restored candidates over
those with dropped rows: the geometric mean over states and records, 1 where both are the same.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import qpmhe
from examples.gallery.problem import Problem
from examples.studies.priors import DATA, FOLDERS
from qpmhe import Box, Status
from qpmhe.model.residuals import difference
from qpmhe.models import Example, catalogue

Array = NDArray[np.float64]
POLICIES = ("drop_rows", "restore")
QPS = 2
#: A set without a width that a scenario can draw from.
NARROW = {"chain_of_masses": 0.22}
HEAD = ("problem | sets | outside, % | dropped, % | restored, % | error | error, settled | "
        "largest error | time")


class Found(NamedTuple):
    """Of one policy on one record."""

    errors: Array  # (T + 1, k)
    seconds: float
    run: qpmhe.Run


def compared(
    name: str, sets: str, records: Sequence[Callable[[str], Found]], settled: int | None = None
) -> str:
    """A line of the table, of functions that run a policy on a record.

    Its last three quarters are settled, or those from a sample on.
    """
    found = [[run(policy) for policy in POLICIES] for run in records]

    def share(flag: Status, policy: int) -> str:
        return f"{100.0 * np.mean([pair[policy].run.share(flag) for pair in found]):.0f}"

    def ratio(size: Callable[[Array], Array], is_settled: bool = False) -> str:
        logs = []
        for drop, restore in found:
            first = (len(drop.errors) // 4 if settled is None else settled) if is_settled else 0
            one, other = size(drop.errors[first:]), size(restore.errors[first:])
            logs.append(np.log(other / np.where(one > 0.0, one, 1.0)))
        return f"{np.exp(np.mean(logs)):.3f}"

    def rms(errors: Array) -> Array:
        value: Array = np.sqrt(np.nanmean(errors**2, axis=0))
        return value

    times = [restore.seconds / drop.seconds for drop, restore in found]
    return " | ".join((
        name, sets, share(Status.CANDIDATE_OUTSIDE, 0), share(Status.ROWS_DROPPED, 0),
        share(Status.RESTORED, 1), ratio(rms), ratio(rms, True),
        ratio(lambda errors: np.nanmax(np.abs(errors), axis=0)), f"{np.median(times):.2f}",
    ))


def timed(mhe: Any, y: Array, u: Array | None) -> tuple[qpmhe.Run, float]:
    """A run and its seconds."""
    began = time.perf_counter()
    return mhe.run(y, u), time.perf_counter() - began


def of_example(
    example: Example, seed: int, drawn: qpmhe.System, narrow: qpmhe.System
) -> Callable[[str], Found]:
    """A record of a model of the zoo with the sets of one system, estimated with another's."""
    system, observer, cost, scenario = example
    record = replace(scenario, system=drawn).simulate(seed)

    def run(policy: str) -> Found:
        mhe = qpmhe.MovingHorizonEstimator(
            narrow, observer, cost, horizon=scenario.horizon, max_qps=QPS,
            initial_state=scenario.initial_estimate, infeasible=policy,
        )
        found, seconds = timed(mhe, record.measurements, record.inputs)
        errors = difference(system.state_residual, found.states, record.states)
        return Found(errors, seconds, found)

    return run


def zoo(names: Sequence[str], seeds: int) -> Iterator[str]:
    """The models of the zoo with tightened sets."""
    for name in names:
        example = catalogue()[name]()
        system, _, _, scenario = example
        w, v = (
            np.sqrt(covariance.diagonal())
            for covariance in (scenario.disturbance_covariance, scenario.noise_covariance)
        )
        settled = round(scenario.settling_time / scenario.dt)
        rounding = 0.0 if scenario.resolution is None else 0.5 * scenario.resolution
        for factor in (2.0, 1.0):
            most = factor * v + rounding
            narrow = system.with_sets({
                "disturbances": Box(-factor * w, factor * w), "noises": Box(-most, most)
            })
            drawn = system.with_sets({
                "disturbances": Box(-factor * w, factor * w), "noises": Box(-factor * v, factor * v)
            })
            runs = [of_example(example, seed, drawn, narrow) for seed in range(seeds)]
            yield compared(name, f"W, V: {factor:g} sd", runs, settled)
        if name in NARROW:
            low = NARROW[name]
            narrow = system.with_sets({
                "disturbances": Box(-low * w, low * w), "noises": Box(-2.5 * v, 2.5 * v)
            })
            runs = [of_example(example, seed, system, narrow) for seed in range(seeds)]
            yield compared(name, f"W: {low:g} sd, V: 2.5 sd, truth outside", runs, settled)


def gallery(names: Sequence[str], data: Path, most: int) -> Iterator[str]:
    """The problems of the gallery with a V, as far as their data are there."""
    for folder in names:
        try:
            problems = FOLDERS[folder](data / DATA.get(folder, folder), True)
        except Exception as error:  # no data
            print(f"{folder}: {error}", file=sys.stderr)
            continue
        for problem in problems:
            v = np.sqrt(problem.weights.noise.diagonal())
            narrow = replace(problem, system=problem.system.with_sets({
                "noises": Box(-3.0 * v, 3.0 * v)
            }))
            runs = [of_record(narrow, record, most) for record in problem.records[:2]]
            yield compared(problem.name, "V: 3 sd", runs)


def of_record(problem: Problem, record: Any, most: int) -> Callable[[str], Found]:
    """The start of a record of the gallery, from its first initial state."""
    def run(policy: str) -> Found:
        mhe = problem.estimator(record.starts[0], problem.weights, max_qps=QPS, infeasible=policy)
        inputs = None if record.inputs is None else record.inputs[:most]
        found, seconds = timed(mhe, record.measurements[:most], inputs)
        truth = record.truth[: len(found.filtered)]
        errors = problem.error(found.filtered[: len(truth)], truth)[:, None]
        return Found(errors, seconds, found)

    return run


def tests_of_others() -> Iterator[str]:
    """A plant at rest in sets that exclude the rest, and a disturbance with a range."""
    a, c = np.diag([0.8, 0.61]), np.diag([1.0, 1.2])
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=10.0 * np.eye(2))

    def simulated(sets: dict[str, Box], seed: int) -> Callable[[str], Found]:
        rng, x = np.random.default_rng(seed), [np.zeros(2)]
        low, high = sets["disturbances"].lower, sets["disturbances"].upper
        y = []
        for _ in range(60):
            y.append(c @ x[-1] + 0.3 * rng.standard_normal(2))
            x.append(a @ x[-1] + rng.uniform(low, np.minimum(high, low + 1.0)))

        def run(policy: str) -> Found:
            system = qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=2, p=2, **sets)
            mhe = qpmhe.MovingHorizonEstimator(
                system, qpmhe.Luenberger(0.1 * np.eye(2)), cost, horizon=5, max_qps=QPS,
                initial_state=np.zeros(2), infeasible=policy,
            )
            found, seconds = timed(mhe, np.array(y), None)
            return Found(found.states - np.array(x), seconds, found)

        return run

    for low, text in ((1.0, "w >= 1, true"), (0.5, "w in [0.5, 1], true")):
        sets = {"disturbances": Box([low] * 2, [100.0 if low == 1.0 else 1.0] * 2)}
        yield compared("a plant at rest", text, [simulated(sets, seed) for seed in range(5)], 10)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--models", nargs="*", default=list(catalogue()), choices=list(catalogue()))
    parser.add_argument("--folders", nargs="*", default=list(FOLDERS), choices=list(FOLDERS))
    parser.add_argument("--data", type=Path, default=Path(), help="folder above the data sets")
    parser.add_argument("--seeds", type=int, default=5, help="records of each model of the zoo")
    parser.add_argument("--most", type=int, default=600, help="samples of a record of the gallery")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    print(f"| {HEAD} |\n|{'---|' * (HEAD.count('|') + 1)}")
    for lines in (
        tests_of_others(), zoo(given.models, given.seeds),
        gallery(given.folders, given.data, given.most),
    ):
        for line in lines:
            print(f"| {line} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
