"""The filter's covariance against a constant one as the prior's weight, over the gallery.

``python -m examples.studies.priors --data DIR`` prints the tables of docs/how-to/prior.md. Each row
is a record of the gallery with its starts, and an observer: the extended Kalman filter, plain or
gated. Both estimators take the same windows, five QPs each, and the weights by hand; only what
weighs the prior differs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import qpmhe
from examples.gallery.battery.cell import problems as battery
from examples.gallery.command import grouped
from examples.gallery.indoor_uwb.robot import problems as indoor_uwb
from examples.gallery.outdoor_uwb.tag import problems as outdoor_uwb
from examples.gallery.problem import Problem, Result, judge
from examples.gallery.reactors.reactors import problems as reactors
from examples.gallery.smartloc.car import problems as smartloc
from examples.gallery.weak_excitation.motor import problems as weak_excitation

FOLDERS: dict[str, Callable[[Path, bool], Sequence[Problem]]] = {
    "battery": battery, "indoor_uwb": indoor_uwb, "outdoor_uwb": outdoor_uwb,
    "reactors": reactors, "smartloc": smartloc, "weak_excitation": weak_excitation,
}
#: The folders of the data sets, where they have another name.
DATA = {"battery": "samsung_30t", "outdoor_uwb": "uwb_outdoor", "smartloc": "smartloc_berlin"}
OBSERVERS = {
    "EKF": qpmhe.ExtendedKalman,
    "gated": partial(qpmhe.ExtendedKalman, innovation=qpmhe.Gate()),
}
QPS, THRESHOLD = 5, 1.345
HEAD = "record | observer | loss | constant, median | observer's, median | constant, worst | " \
    "observer's, worst"


def rows(problem: Problem, compiled: bool) -> Iterator[tuple[str, list[Result]]]:
    """The two results of each record, observer and loss, with their label."""
    for name, records in grouped(problem.records).items():
        for kind, observer in OBSERVERS.items():
            for loss, threshold in (("quadratic", None), ("Huber", THRESHOLD)):
                found = []
                for arrival in ("constant", "observer"):
                    weights = replace(problem.weights, arrival=arrival, threshold=threshold)
                    way = partial(
                        problem.estimator, weights=weights, observer=observer, max_qps=QPS,
                        warm_start=True,
                    )
                    found.append(judge(problem, "", arrival, way, records, compiled))
                yield f"{name} | {kind} | {loss}", found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table for each problem."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", metavar="NAME", help="folders of the gallery; all")
    parser.add_argument("--data", type=Path, default=Path(), help="folder above the data sets")
    parser.add_argument("--quick", action="store_true", help="few runs, nothing compiled")
    given = parser.parse_args(arguments)
    for name in given.folders or FOLDERS:
        for problem in FOLDERS[name](given.data / DATA.get(name, name), given.quick):
            print(f"\n{problem.title}, errors in {problem.unit}, N = {problem.weights.horizon}\n")
            print(f"| {HEAD} |\n|{' --- |' * 7}", flush=True)
            for label, (constant, own) in rows(problem, not given.quick):
                medians = (f"{one.errors[one.which]:.3g}" for one in (constant, own))
                worst = (f"{one.errors.max():.3g}" for one in (constant, own))
                print(f"| {label} | {' | '.join((*medians, *worst))} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
