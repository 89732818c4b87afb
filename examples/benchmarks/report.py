"""Tables, JSON and pictures of the comparison."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, NullLocator
from measurement import SAME, Measurement, Series
from peers.casadi_program import FLAGS
from rich import box
from rich.console import Console
from rich.table import Table

from qpmhe.codegen.compiler import find_compiler

__all__ = ["environment", "picture", "rows", "show", "tell_once", "write"]

#: Shares of the time lost to other processes above this are reported.
BUSY = 0.03

# Okabe and Ito's palette, told apart by all colour vision; hatches tell the rest.
KINDS: dict[str, dict[str, Any]] = {
    "qpmhe": {"label": "qpmhe, converged", "color": "#0072B2"},
    "capped": {"label": "qpmhe, capped", "color": "#8CC8EE"},
    "peer": {"label": "other tools, converged", "color": "#B8B8B8"},
    "one": {"label": "other tools, one QP", "color": "#E2E2E2"},
    "other": {"label": "another problem", "color": "#F0C987", "hatch": "///"},
}
LIGHT: dict[str, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "0.6",
    "axes.labelcolor": "0.2",
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 9.0,
    "grid.color": "0.92",
    "grid.linewidth": 0.6,
    "hatch.color": "0.55",
    "hatch.linewidth": 0.5,
    "legend.frameon": False,
    "xtick.color": "0.4",
    "xtick.labelcolor": "0.2",
    "ytick.color": "0.6",
    "ytick.labelcolor": "0.2",
}


def environment(packages: Iterable[str]) -> dict[str, Any]:
    """Machine and versions.

    Parameters
    ----------
    packages : iterable of str
        Distributions that took part.
    """
    versions = {}
    for name in sorted({*packages, "numpy", "scipy"}):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "load_at_start": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": versions,
        "c_compiler": _compiler(),
        "c_flags": " ".join(FLAGS),
        "threads": int(os.environ.get("OMP_NUM_THREADS", "0")),
    }


def _cpu() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in text.splitlines() if "model name" in line]
    return names[0] if names else platform.machine()


def _compiler() -> str | None:
    compiler = find_compiler()
    if compiler is None:
        return None
    done = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False)
    return (done.stdout.splitlines() or [compiler[0]])[0]


@cache
def tell_once(text: str) -> None:
    """Print a line, unless it has been printed."""
    Console().print(text, highlight=False, markup=False)


def rows(result: Measurement) -> list[dict[str, Any]]:
    """One row for each estimator, as in the JSON file; times in microseconds.

    A ratio tells how many times faster than Ipopt; it is None where an estimator that should
    have reached the converged J did not.
    """
    base = None if result.reference is None else _quantiles(result.reference)[1]
    return [_row(result, one, base) for one in result.series if one.times]


def _quantiles(one: Series) -> list[float]:
    return [float(q) for q in 1e6 * np.quantile([*one.times.values()], (0.25, 0.5, 0.75))]


def _row(result: Measurement, one: Series, base: float | None) -> dict[str, Any]:
    low, median, high = _quantiles(one)
    excess, same = one.excess(result.reference_costs), result.same_cost(one)
    return {
        "problem": result.problem.name,
        "n": result.problem.n,
        "horizon": result.problem.horizon,
        "estimator": one.peer.name,
        "kind": one.peer.kind,
        "package": one.peer.package,
        "median_us": median,
        "mean_us": 1e6 * float(np.mean([*one.times.values()])),
        "quartiles_us": [low, high],
        "ratio": None if base is None or same is False else base / median,
        "times_ours": _times_ours(result, one, same),
        "is_reference": one is result.reference,
        "excess": float(np.median(excess)) if excess.size else None,
        "excess_worst": float(excess.max()) if excess.size else None,
        "same_cost": same,
        "difference": result.difference(one),
        "rmse": None if one.peer.most_calls else math.sqrt(float(np.mean(one.squares))),
        "steps": len(one.times),
        "waited_s": one.waited,
        "setup_s": one.setup_seconds,
        "limitations": one.peer.limitations,
    }


def _times_ours(result: Measurement, one: Series, same: bool | None) -> float | None:
    """Its median over our compiled step's, converged or with one QP as it is."""
    amount = "converged" if one.peer.converges else "1 QP"
    ours = next((
        other for other in result.series if other.peer.name == f"qpmhe compiled, {amount}"
    ), None)
    if one.peer.kind != "peer" or ours is None or same is False:
        return None
    return _quantiles(one)[1] / _quantiles(ours)[1]


def show(console: Console, result: Measurement) -> None:
    """Print a problem's table, the verdict on J first."""
    table_rows = rows(result)
    wrong = [row["estimator"] for row in table_rows if row["same_cost"] is False]
    checked = sum(row["same_cost"] is not None for row in table_rows)
    console.print()
    if wrong:
        console.print(
            f"[bold]{result.problem.name}: not the converged J (within {SAME:g} in 95 % of the "
            f"steps), so without ratio:[/bold] {', '.join(wrong)}"
        )
    console.print(
        f"{result.problem.name}: {checked - len(wrong)} of {checked} estimators that converge "
        f"reached the same J within {SAME:g}.", highlight=False,
    )
    table = Table(
        title=result.problem.title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    for name in (
        "estimator", "median\nus", "mean\nus", "quartiles\nus", "x faster\nthan Ipopt",
        "J above\nconverged", "largest\ndifference", "RMSE", "setup\ns",
    ):
        table.add_column(name, justify="left" if name == "estimator" else "right", no_wrap=True)
    for row in sorted(table_rows, key=lambda row: row["median_us"]):
        table.add_row(
            row["estimator"], _short(row["median_us"]), _short(row["mean_us"]),
            " ".join(_short(q) for q in row["quartiles_us"]),
            "reference" if row["is_reference"] else _or_dash(row["ratio"], "{:.3g}"),
            _excess(row["excess"]), _or_dash(row["difference"], "{:.0e}"),
            _or_dash(row["rmse"], "{:.4f}"),
            f"{row['setup_s']:.2f}",
        )
    console.print(table)
    told = "; ".join(
        f"{row['estimator']} {row['times_ours']:.3g}" for row in table_rows if row["times_ours"]
    )
    if told:
        console.print(f"Times as long as our compiled step: {told}.", highlight=False)
    if result.waited > BUSY:
        console.print(
            f"Other processes had the processor for {result.waited:.0%} of the time; this is taken "
            "off, but their traffic in caches and memory is not.", highlight=False,
        )
    for reason in dict.fromkeys(reason for _, reason in result.left_out):
        names = "; ".join(name for name, own in result.left_out if own == reason)
        console.print(f"left out: {names}: {reason}", highlight=False, markup=False)


def _short(microseconds: float) -> str:
    return f"{microseconds:.1f}" if microseconds < 100 else f"{microseconds:,.0f}"


def _excess(value: float | None) -> str:
    if value is not None and abs(value) < 1e-9:
        return "< 1e-9"
    return _or_dash(value, "{:.1e}")


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def write(
    path: Path, surroundings: dict[str, Any], results: list[Measurement], notes: list[str]
) -> None:
    """Write all rows, what was left out, and the environment as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {
        "environment": surroundings,
        "limitations": notes,
        "rows": [row for result in results for row in rows(result)],
        "left_out": [
            {"problem": result.problem.name, "estimator": name, "reason": reason}
            for result in results for name, reason in result.left_out
        ],
    }
    path.write_text(json.dumps(content, indent=1) + "\n")


def picture(result: Measurement, path: Path) -> None:
    """Draw the times per step as horizontal bars on a logarithmic scale, as PNG.

    Parameters
    ----------
    result : Measurement
        One problem's.
    path : Path
        The file; its folder is made.
    """
    ordered = sorted(rows(result), key=lambda row: -row["median_us"])
    times = np.array([row["median_us"] for row in ordered])
    quartiles = np.array([row["quartiles_us"] for row in ordered]).T
    kinds = [_style(row) for row in ordered]
    with rc_context(LIGHT):
        figure = Figure(figsize=(7.6, 1.3 + 0.27 * len(ordered)), layout="constrained")
        axes = figure.subplots()
        bars = axes.barh(
            range(len(ordered)), times, height=0.66, color=[kind["color"] for kind in kinds],
            xerr=np.abs(quartiles - times), error_kw={"elinewidth": 0.8, "ecolor": "0.35"},
        )
        for bar, kind in zip(bars, kinds, strict=True):
            bar.set_hatch(kind.get("hatch"))
        axes.set_xscale("log")
        low, high = 10 ** math.floor(math.log10(times.min())), times.max()
        axes.set_xlim(low, high * (high / low) ** 0.32)  # room for the figures beside the bars
        for place, row in enumerate(ordered):
            axes.annotate(
                _label(row), (max(row["quartiles_us"][1], row["median_us"]), place),
                xytext=(5, 0), textcoords="offset points", va="center", color="0.2", fontsize=8,
            )
        axes.set_yticks(range(len(ordered)), [row["estimator"] for row in ordered])
        axes.tick_params(axis="y", length=0)
        axes.xaxis.set_major_formatter(FuncFormatter(_time))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.grid(axis="x")
        axes.margins(y=0.01)
        axes.set_xlabel(
            "median time per step in one thread (whiskers: quartiles),\n"
            "and how many times faster than the reference"
        )
        figure.suptitle(result.problem.title, color="0.2", fontsize=10)
        used = [kind for kind in KINDS.values() if kind in kinds]
        figure.legend(
            handles=[
                Patch(facecolor=kind["color"], hatch=kind.get("hatch"), label=kind["label"])
                for kind in used
            ],
            loc="outside lower center", ncols=len(used),
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=200)


def _style(row: dict[str, Any]) -> dict[str, Any]:
    capped = row["same_cost"] is None
    kind = {"qpmhe": "capped", "peer": "one"}.get(row["kind"]) if capped else None
    return KINDS[kind or row["kind"]]


def _label(row: dict[str, Any]) -> str:
    if row["is_reference"]:
        note = "reference"
    elif row["ratio"] is None:
        note = "other J" if row["same_cost"] is False else ""
    else:
        note = f"{row['ratio']:.3g} ×"
    return f"{_time(row['median_us'])}  {note}"


def _time(microseconds: float, _: int | None = None) -> str:
    for unit, size in (("s", 1e6), ("ms", 1e3)):
        if microseconds >= size:
            return f"{microseconds / size:.3g} {unit}"
    return f"{microseconds:.3g} µs"
