"""Time per step and memory of qpmhe against the horizon N and the number of states n.

One QP per step. N is varied on the batch reactor (n = 2), n on the chain of masses (N = 30). All
sizes and engines take turns, so that a change of the machine's speed meets all. The exponents
are those of t ~ N^a and t ~ n^a, fitted to the larger half of the sizes: small ones pay mostly
for Python. Memory is what tracemalloc sees, which are Python's objects and NumPy's arrays.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import tracemalloc
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator
from problems import Problem, chain_problem, reactor_problem
from report import LIGHT, environment
from rich import box
from rich.console import Console
from rich.table import Table
from stopwatch import timed

import qpmhe
from qpmhe.codegen.compiler import find_compiler

HORIZONS = (10, 20, 50, 100, 200, 500, 1000)
#: Masses and dimensions: n = 2, 4, 6, 12, 24, 48, 96.
CHAINS = ((1, 1), (1, 2), (1, 3), (2, 3), (4, 3), (8, 3), (16, 3))
ENGINES = {
    "python": {"label": "Python engine, NumPy model", "color": "#D55E00", "marker": "o"},
    "compiled": {"label": "compiled engine", "color": "#0072B2", "marker": "s"},
}
#: Samples after the window is full, until the wrong start is forgotten.
SETTLE = 40


@dataclass(frozen=True)
class Point:
    """What was measured at one size; times in microseconds, memory in KiB."""

    engine: str
    n: int
    horizon: int
    median_us: float
    quartiles_us: tuple[float, float]
    memory_kib: float


def build(problem: Problem, engine: str) -> qpmhe.MovingHorizonEstimator:
    system = problem.casadi_system() if engine == "compiled" else problem.system
    return qpmhe.MovingHorizonEstimator(
        system, problem.observer, problem.cost, horizon=problem.horizon,
        initial_state=problem.scenario.initial_estimate, max_qps=1, engine=engine,
    )


def memory(problem: Problem, engine: str, measurements: Any) -> float:
    """KiB that an estimator with a full window holds, over what its model holds."""
    build(problem, engine)  # what is imported, compiled or cached once is not counted
    gc.collect()
    tracemalloc.start()
    try:
        mhe = build(problem, engine)
        for y in measurements:
            mhe.update(y)
        gc.collect()
        return tracemalloc.get_traced_memory()[0] / 1024
    finally:
        tracemalloc.stop()


class Timed:
    """One engine at one size, with a full window, and its times in microseconds."""

    def __init__(self, problem: Problem, engine: str, steps: int) -> None:
        self.problem, self.engine = problem, engine
        settled = problem.horizon + SETTLE
        self.record = problem.scenario.simulate(0, settled + steps).measurements
        self.mhe = build(problem, engine)
        for y in self.record[:settled]:
            self.mhe.update(y)
        self.times: list[float] = []

    def advance(self, count: int) -> None:
        """Time the next samples."""
        for y in self.record[self.mhe.time : self.mhe.time + count]:
            self.times.append(1e6 * timed(self.mhe.update, y)[1])

    def point(self) -> Point:
        """What came out, and the memory."""
        problem = self.problem
        low, median, high = (float(q) for q in np.quantile(self.times, (0.25, 0.5, 0.75)))
        kept = memory(problem, self.engine, self.record[: problem.horizon + 1])
        return Point(self.engine, problem.n, problem.horizon, median, (low, high), kept)


def measure(problems: list[Problem], engines: list[str], steps: int) -> list[Point]:
    """Median times of full windows, all sizes and engines in turn, and the memory."""
    all_timed = [Timed(problem, engine, steps) for problem in problems for engine in engines]
    gc.collect()
    gc.disable()
    try:
        for _ in range(0, steps, 10):
            for one in all_timed:
                one.advance(10)
    finally:
        gc.enable()
    return [one.point() for one in all_timed]


def exponent(sizes: list[int], values: list[float]) -> float:
    """A of values ~ sizes^a, over the larger half of the sizes; NaN for fewer than two."""
    first = len(sizes) // 2 if len(sizes) > 2 else 0
    if len(sizes) - first < 2:
        return float("nan")
    return float(np.polyfit(np.log(sizes[first:]), np.log(values[first:]), 1)[0])


def curves(points: list[Point], size: str, value: str) -> dict[str, tuple[list[int], list[float]]]:
    """Sizes and values of each engine."""
    return {
        engine: (
            [getattr(point, size) for point in points if point.engine == engine],
            [getattr(point, value) for point in points if point.engine == engine],
        )
        for engine in ENGINES
        if any(point.engine == engine for point in points)
    }


def show(console: Console, title: str, points: list[Point], size: str) -> None:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for name in (
        "N" if size == "horizon" else "n", "engine", "median us", "quartiles us", "memory KiB"
    ):
        table.add_column(name, justify="left" if name == "engine" else "right")
    for point in points:
        table.add_row(
            str(getattr(point, size)), point.engine, f"{point.median_us:,.1f}",
            " ".join(f"{q:,.1f}" for q in point.quartiles_us), f"{point.memory_kib:,.0f}",
        )
    console.print(table)


def draw(panels: list[tuple[str, str, dict[str, Any]]], path: Path) -> None:
    """Log-log curves side by side, with their exponents."""
    with rc_context(LIGHT):
        figure = Figure(figsize=(3.4 * len(panels), 3.3), layout="constrained")
        all_axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for axes, (x_label, y_label, lines) in zip(all_axes, panels, strict=True):
            for engine, (sizes, values) in lines.items():
                style = ENGINES[engine]
                axes.loglog(
                    sizes, values, color=style["color"], marker=style["marker"], markersize=4,
                    linewidth=1.3, label=f"exponent {exponent(sizes, values):.2f}",
                )
            ticks = sorted({size for sizes, _ in lines.values() for size in sizes})
            axes.xaxis.set_major_locator(FixedLocator(ticks))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter(FuncFormatter(lambda size, _: f"{size:g}"))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.grid(axis="y")
            axes.set_xlabel(x_label)
            axes.set_ylabel(y_label)
            axes.legend(loc="upper left", handlelength=1.6)
        handles = all_axes[0].get_legend_handles_labels()[0]
        figure.legend(
            handles, [ENGINES[engine]["label"] for engine in panels[0][2]],
            loc="outside upper center", ncols=len(handles),
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=200)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=60, help="timed steps of each size")
    parser.add_argument("--quick", action="store_true", help="fewer sizes and steps")
    parser.add_argument("--engines", nargs="+", choices=tuple(ENGINES), help="default: what works")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    chosen = parser.parse_args()
    engines = chosen.engines or [
        engine for engine in ENGINES if engine == "python" or find_compiler()
    ]
    steps = min(chosen.steps, 20) if chosen.quick else chosen.steps
    horizons, chains = (HORIZONS[:5], CHAINS[:5]) if chosen.quick else (HORIZONS, CHAINS)
    console = Console()
    surroundings = environment(["qpmhe", "casadi"])
    with console.status("reactor") as status:
        along_horizon = measure([reactor_problem(horizon) for horizon in horizons], engines, steps)
        status.update("chain of masses")
        along_n = measure([chain_problem(*sizes) for sizes in chains], engines, steps)
    show(console, "reactor, n = 2, one QP", along_horizon, "horizon")
    show(console, "chain of masses, N = 30, one QP", along_n, "n")
    by_horizon = curves(along_horizon, "horizon", "median_us")
    by_n = curves(along_n, "n", "median_us")
    kept = curves(along_horizon, "horizon", "memory_kib")
    exponents = {
        name: {engine: exponent(*line) for engine, line in lines.items()}
        for name, lines in (("time, N", by_horizon), ("time, n", by_n), ("memory, N", kept))
    }
    for name, values in exponents.items():
        text = ", ".join(f"{engine} {value:.2f}" for engine, value in values.items())
        console.print(f"exponent of {name}: {text}", highlight=False)
    draw(
        [
            ("N (batch reactor, n = 2)", "median time per step (µs)", by_horizon),
            ("n (chain of masses, N = 30)", "median time per step (µs)", by_n),
            ("N (batch reactor, n = 2)", "memory of an estimator (KiB)", kept),
        ],
        chosen.out / "scaling.png",
    )
    content = {
        "environment": surroundings,
        "exponents": exponents,
        "horizon": [asdict(point) for point in along_horizon],
        "n": [asdict(point) for point in along_n],
    }
    (chosen.out / "scaling.json").write_text(json.dumps(content, indent=1) + "\n")
    versions = ", ".join(f"{name} {number}" for name, number in surroundings["versions"].items())
    console.print(
        f"{surroundings['cpu']}, load {surroundings['load_at_start']:.1f} at the start; Python "
        f"{surroundings['python']}, {versions}. Written: {chosen.out}/scaling.json and .png",
        highlight=False,
    )


if __name__ == "__main__":
    main()
