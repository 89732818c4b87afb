"""What ``python -m examples.gallery.NAME`` runs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from qpmhe.errors import QpmheError
from qpmhe.plots import save

from .baselines import estimators, filters
from .problem import Problem, Record, Result, judge
from .report import BY_HAND, TUNED, write

#: From the folder of the data, and whether it is to be quick, to the problems.
Make = Callable[[Path, bool], Sequence[Problem]]
#: From problems and results to a figure.
Draw = Callable[[Sequence[Problem], Sequence[Sequence[Result]]], Any]


class DataError(Exception):
    """A folder that does not hold what it should; the text says what is wrong."""


def grouped(records: Sequence[Record]) -> dict[str, list[Record]]:
    """The records by their names."""
    found: dict[str, list[Record]] = {}
    for record in records:
        found.setdefault(record.name, []).append(record)
    return found


def results_of(problem: Problem, console: Console, quick: bool = False) -> list[Result]:
    """All estimators with all weights on all records of a problem."""
    weights = {BY_HAND: problem.weights}
    if problem.tuning is not None:
        weights[TUNED] = problem.tuned(console)
    found = []
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task(problem.title, total=None)
        for which, one in weights.items():
            for records in grouped(problem.records).values():
                for name, way in estimators(problem, one).items():
                    progress.update(task, description=f"{problem.title}: {which}, {name}")
                    found.append(judge(problem, which, name, way, records, not quick))
    return found


def main(
    name: str, description: str, make: Make, draw: Draw | None = None, source: str = "",
    arguments: Sequence[str] | None = None,
) -> int:
    """Run a folder of the gallery.

    Parameters
    ----------
    name, description : str
        The folder's name, and the first line of the help.
    make, draw : callable
        What makes the problems, and the picture of their results.
    source : str
        A sentence: where the data are to be had; "" for a folder that needs none.
    arguments : sequence of str, optional
        Those of the command line.

    Returns
    -------
    int
        0; 2 if the data are not what they should be.
    """
    parser = argparse.ArgumentParser(prog=f"python -m examples.gallery.{name}",
                                     description=description)
    if source:
        parser.add_argument("--data", type=Path, help="folder of the data set, or the one above")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the results")
    parser.add_argument("--quick", action="store_true", help="few runs, nothing compiled")
    given, console = parser.parse_args(arguments), Console()
    folder = given.data if source else Path()
    if folder is not None and source and (folder / name).is_dir():
        folder = folder / name
    if folder is None or not folder.is_dir():
        missing = "give --data DIR" if folder is None else f"there is no folder {folder}"
        console.print(f"{name} needs its data set: {missing}. {source}", highlight=False,
                      soft_wrap=True)
        return 0
    files, results = [], []
    try:
        problems = make(folder, given.quick)
        for problem in problems:
            found = results_of(problem, console, given.quick)
            rivals = list(filters(problem, problem.weights))
            files += write(problem, found, rivals, console, given.out)
            results.append(found)
    except (DataError, QpmheError, OSError) as error:
        print(f"error: {folder}: {error}", file=sys.stderr)
        return 2
    if draw is not None:
        files += save(draw(problems, results), given.out / name)
    console.print("wrote", *files, highlight=False, soft_wrap=True)
    return 0
