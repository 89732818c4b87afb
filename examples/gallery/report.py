"""The table of a problem, in the terminal and as files, and its pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from qpmhe.plots.style import LIGHT, REAL, line_styles

from .problem import Array, Problem, Result

BY_HAND, TUNED = "by hand", "tuned"
WIDTH = 120
ENGINES = {"compiled": "C", "python": "py"}


def frame(results: Sequence[Result]) -> pd.DataFrame:
    """The figures of all runs; errors in the problem's unit, times in seconds."""
    rows = [{
        "weights": one.weights, "record": one.record, "estimator": one.estimator,
        "runs": len(one.errors), "median": np.median(one.errors), "worst": one.errors.max(),
        "whole median": np.median(one.whole), "whole worst": one.whole.max(),
        "lost": one.lost, "outside": one.outside,
        "step": one.seconds, "engine": one.engine,
    } for one in results]
    return pd.DataFrame(rows)


def cells(row: Any, whole: bool, bounded: bool) -> list[str]:
    """A row of the table as text."""
    texts = [row["estimator"], number(row["median"]), number(row["worst"])]
    if whole:
        texts += [number(row["whole median"]), number(row["whole worst"])]
    engine, micro = ENGINES.get(row["engine"], row["engine"]), 1e6 * row["step"]
    step = f"{micro:.1f}" if micro < 10.0 else f"{micro:.0f}"
    shares = [f"{100 * row[name]:.0f}" for name in ("lost", *["outside"] * bounded)]
    return [*texts, *shares, f"{step} {engine}"]


def number(value: float) -> str:
    """Three digits, or the power of ten of what is beyond all bounds."""
    if not np.isfinite(value):
        return "-"
    return f"{value:#.3g}" if 1e-3 <= abs(value) < 1e3 else f"{value:.0e}"


def headings(whole: bool, bounded: bool) -> list[str]:
    """Those of `cells`."""
    names = ["estimator", "median", "worst", *["all", "worst"] * whole]
    return [*names, "lost %", *["not in X %"] * bounded, "us/step"]


def legend(whole: bool) -> str:
    """What the columns mean."""
    parts = "Errors of the part that judges; all: of the whole record. " if whole else ""
    return f"{parts}us/step: median time, by the step in C or in Python (py)."


def verdict(problem: Problem, rows: pd.DataFrame, baselines: Sequence[str]) -> str:
    """Which estimator has the lowest errors; a baseline that wins is called one."""
    found = []
    for figure in ("median", "worst"):
        best = rows.loc[rows[figure].idxmin()]
        others = rows[rows["estimator"].isin(baselines)]
        rival = others.loc[others[figure].idxmin()]
        if best["estimator"] in baselines:
            words = "a baseline: it wins"
        else:
            words = f"of the baselines {rival['estimator']}, {number(rival[figure])}"
        found.append(
            f"Lowest {figure} error: {best['estimator']}, {number(best[figure])} {problem.unit} "
            f"({words})."
        )
    return " ".join(found)


def write(
    problem: Problem, results: Sequence[Result], baselines: Sequence[str], console: Console,
    out: Path,
) -> list[Path]:
    """Print the tables, and write them as Markdown and CSV."""
    table = frame(results)
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / f"{problem.name}.csv", index=False)
    whole = any(record.tunes for record in problem.records)
    bounded = problem.system.states is not None
    columns, text = headings(whole, bounded), [f"# {problem.title}", ""]
    for (weights, record), rows in table.groupby(["weights", "record"], sort=False):
        title = (f"{record}, weights {weights}, {rows['runs'].iloc[0]} runs; "
                 f"root mean square error in {problem.unit}")
        shown = Table(*columns, title=f"{problem.title}: {title}", box=None, title_justify="left",
                      caption=legend(whole), caption_justify="left", collapse_padding=True,
                      pad_edge=False)
        lines = [cells(row, whole, bounded) for _, row in rows.iterrows()]
        for column in shown.columns:
            column.no_wrap = True
            column.justify = "left" if column is shown.columns[0] else "right"
        for line in lines:
            shown.add_row(*line)
        words = verdict(problem, rows, baselines)
        # Digits that do not fit are worse than lines that wrap.
        console.print(shown, width=max(console.width, WIDTH), crop=False)
        console.print(f"[bold]{words}[/]\n", highlight=False, soft_wrap=True)
        text += [f"## {title}", "", *markdown(columns, lines), "", legend(whole), "", words, ""]
    if problem.note:
        console.print(f"{problem.note}\n", highlight=False, soft_wrap=True)
        text += [problem.note, ""]
    (out / f"{problem.name}.md").write_text("\n".join(text), encoding="utf-8")
    return [out / f"{problem.name}.md", out / f"{problem.name}.csv"]


def markdown(columns: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    """A table's lines."""
    ruler = ["---", *["---:"] * (len(columns) - 1)]
    return ["| " + " | ".join(line) + " |" for line in (columns, ruler, *lines)]


def tracks(
    truth: Array, estimates: Mapping[str, Array], *, unit: str = "m",
    labels: tuple[str, str] = ("x", "y"), landmarks: Array | None = None, axes: Any = None,
) -> Any:
    """Paths on a map: the true one, and at most six estimates (T, 2) of it."""
    if axes is None:
        with rc_context(LIGHT):
            axes = Figure(figsize=(6.4, 6.0), layout="constrained").subplots()
    axes.plot(truth[:, 0], truth[:, 1], **REAL)
    for style, (name, path) in zip(line_styles(estimates), estimates.items(), strict=True):
        axes.plot(path[:, 0], path[:, 1], linewidth=1.2, label=name, **style)
    if landmarks is not None:
        axes.plot(landmarks[:, 0], landmarks[:, 1], "^", color="0.2", label="anchors")
    axes.set(xlabel=f"{labels[0]} ({unit})", ylabel=f"{labels[1]} ({unit})", aspect="equal")
    return axes
