"""The report's figures as PNG and SVG, with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ...plots import trajectories
from .answers import Case
from .matplotlib_axes import LIGHT, error_axis, legend, limits, panel, time_axis, title
from .runs import Runs
from .static_time import times
from .style import Style
from .words import cap_words, configuration_words, missing, qps_words, usual_first

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

__all__ = ["figures"]

_SIZES = {"0": 90.0, "1": 26.0, "2": 42.0}
_LARGEST = 66.0
_SIGNS = "larger: more QPs per sample; hollow: capped; pale: runs failed; bars: 95 %"
_MOST_STATES = 6


def figures(
    case: Case,
    cells: DataFrame,
    drawn: Mapping[str, Style],
    deadline: float | None,
    runs: Runs,
) -> dict[str, Figure]:
    """Draw one case's figures; those without data are left out.

    Parameters
    ----------
    case : Case
        Its configurations.
    cells : pandas.DataFrame
        Its cells.
    drawn : mapping of backend to Style
        How backends are drawn.
    deadline : float or None
        Seconds per step, for the figure of times.
    runs : Runs
        Trajectories to draw.

    Returns
    -------
    dict of str to matplotlib.figure.Figure
        By the end of the file's name: "accuracy-time", "anytime", "step-times", "run".
    """
    from matplotlib import rc_context

    with rc_context(LIGHT):
        found = {
            "accuracy-time": _accuracy(case, drawn),
            "anytime": _anytime(case, drawn),
            "step-times": times(case, cells, drawn, deadline),
            "run": _run(runs) if runs.static else None,
        }
    return {name: figure for name, figure in found.items() if figure is not None}


def _accuracy(case: Case, drawn: Mapping[str, Style]) -> Any:
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    rows = case.summary
    rows = rows[rows["time_median"].notna() & np.isfinite(rows["rmse"].astype(float))]
    if rows.empty:
        return None
    figure = Figure(figsize=(8.6, 4.8), layout="constrained")
    axes = figure.subplots()
    front = rows[rows["pareto"]].sort_values("time_median")
    axes.step(front["time_median"], front["rmse"], where="post", color="0.6", linewidth=1.2)
    axes.scatter(
        front["time_median"], front["rmse"], s=190, facecolors="none", edgecolors="0.35",
        linewidths=0.9,
    )
    for backend, mine in rows.groupby("backend", sort=False):
        style = drawn[str(backend)]
        axes.errorbar(
            mine["time_median"], mine["rmse"], yerr=limits(mine, "rmse"), fmt="none",
            ecolor=style.color, elinewidth=0.5, alpha=0.5,
        )
        for (capped, failed), part in mine.groupby(
            [mine["solver_iterations"].notna(), mine["failures"] > 0]
        ):
            axes.scatter(
                part["time_median"], part["rmse"], marker=style.marker,
                s=[_SIZES.get(qps_words(one), _LARGEST) for one in part["qps"]],
                facecolors="none" if capped else style.color, edgecolors=style.color,
                linewidths=1.0, alpha=0.3 if failed else 0.9,
            )
    axes.set_xscale("log")
    time_axis(axes.xaxis, rows["time_median"].min(), rows["time_median"].max())
    error_axis(axes, rows["rmse"])
    axes.set_xlabel("median time per step")
    axes.set_ylabel("RMSE")
    for place, (_, row) in enumerate(front.iterrows(), start=1):
        axes.annotate(
            str(place), (row["time_median"], row["rmse"]), xytext=(0, 9), ha="center",
            textcoords="offset points", color="0.2", fontsize=8,
        )
    axes.set_title(f"{case.title}\n{_SIGNS}", fontsize=9, color="0.2", loc="left")
    legend(figure, [str(one) for one in rows["backend"].unique()], drawn)
    figure.legend(
        handles=[
            Line2D([], [], linestyle="none", marker=f"${place}$", color="0.2", markersize=6,
                   label=configuration_words(row))
            for place, (_, row) in enumerate(front.iterrows(), start=1)
        ],
        loc="outside right center", fontsize=8, title="Pareto front", title_fontsize=8,
    )
    return figure


def _anytime(case: Case, drawn: Mapping[str, Style]) -> Any:
    from matplotlib.figure import Figure

    rest = case.whole[case.whole["backend"] != "observer"]
    start = min(rest["start"], key=usual_first, default="")
    rest = rest[rest["start"] == start]
    observer = case.summary[case.summary["backend"] == "observer"]
    if rest.empty:
        return None
    caps = sorted({int(one) for one in rest["solver_iterations"] if not missing(one)})
    order = [*map(str, caps), "none"]
    groups = list(rest.groupby("qps", dropna=False))
    figure = Figure(figsize=(1.4 + 2.1 * max(2, len(groups)), 5.0), layout="constrained")
    panels = figure.subplots(2, len(groups), sharex=True, sharey="row", squeeze=False)
    for row, (metric, label) in enumerate((("rmse", "RMSE"), ("cost_ratio", "J / converged J"))):
        for axes, (qps, mine) in zip(panels[row], groups, strict=True):
            for backend, rows in mine.groupby("backend", sort=False):
                style = drawn[str(backend)]
                places = [order.index(cap_words(one)) for one in rows["solver_iterations"]]
                axes.plot(
                    places, rows[metric].astype(float), color=style.color, linestyle=style.line,
                    marker=style.marker, markersize=4.5, linewidth=1.0,
                )
            for value in observer[metric].astype(float):
                axes.axhline(value, color=drawn["observer"].color, linestyle="--", linewidth=1.2)
            error_axis(axes, case.summary[metric])
            axes.set_xticks(range(len(order)), order)
            axes.margins(x=0.12)
            if row == 0:
                axes.set_title(panel(qps), fontsize=9, color="0.2")
            else:
                axes.set_xlabel("cap on the solver")
        panels[row][0].set_ylabel(label)
    title(figure, case, "cap on the solver's iterations in each QP; dashed: the observer alone"
           + (f"; start {start}" if case.summary["start"].nunique() > 1 else ""))
    legend(figure, [str(one) for one in rest["backend"].unique()], drawn, lines=True)
    return figure


def _run(runs: Runs) -> Any:
    first = runs.static[0][1]
    n = min(_MOST_STATES, len(first["labels"]))
    return trajectories(
        np.asarray(first["times"]), np.asarray(first["states"])[:, :n],
        {words: np.asarray(one["estimates"])[:, :n] for words, one in runs.static[:6]},
        [str(one) for one in first["labels"]][:n], f"time t ({first['time_unit']})",
    )[0].figure
