"""Tables and picture of the study."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from rich import box
from rich.table import Table

if TYPE_CHECKING:
    from study import Cycle, Result

Row = dict[str, Any]

# Okabe and Ito's colours, with dashes for those who see none.
_STYLES = {
    "constant gain": ("#E69F00", (0, (1, 1.2))),
    "EKF": ("#D55E00", (0, (4, 1.5))),
    "MHE, i=1": ("#0072B2", "solid"),
}
_SPOILT = "2 % read 0 V"


def table(rows: Sequence[Row]) -> Table:
    """All estimators, with and without tuning of the filter on the cycle."""
    result = _table("State of charge, first 300 s left out")
    for column in ("cycle", "estimator"):
        result.add_column(column)
    for column in ("RMSE %", "worst %", "of EKF", "below 5 % from s", "step us"):
        result.add_column(column, justify="right")
    for cycle in _unique(rows, "cycle"):
        mine = [row for row in rows if row["cycle"] == cycle]
        plain = [row for row in mine if not row["condition"]]
        tuned = [row for row in mine if row["condition"].startswith("tuned")]
        reference = next(row for row in plain if row["estimator"] == "EKF")["rmse_percent"]
        if tuned:
            best = min(tuned, key=lambda row: row["rmse_percent"])
            plain.append(best | {"estimator": "best of 9 EKF tunings"})
        for row in plain:
            settled = row["settled_s"]
            result.add_row(
                cycle, row["estimator"], f"{row['rmse_percent']:.2f}", f"{row['max_percent']:.1f}",
                f"{row['rmse_percent'] / reference:.2f}",
                "-" if settled is None else f"{settled:.0f}",
                f"{row['step_us']:.0f}", end_section=row is plain[-1],
            )
    result.caption = "Same model and noise for all; a filter tuned on the cycle knows the truth."
    return result


def stress_table(rows: Sequence[Row]) -> Table:
    """Outliers and wrong prior covariances."""
    return _crossed(
        "RMSE % (worst %) with outliers and wrong priors", "condition",
        [row for row in rows if row["condition"]
         and not row["condition"].startswith(("start", "tuned"))],
    )


def starts_table(rows: Sequence[Row], condition: str) -> Table:
    """Initial states of charge, under one condition."""
    return _crossed(
        f"{condition.replace('start', 'Over initial SOC')}: RMSE % (worst %), RMSE % from 0 s, "
        "below 5 % from s", "start",
        [row for row in rows if row["condition"] == condition], whole=True,
    )


def _crossed(title: str, by: str, rows: Sequence[Row], whole: bool = False) -> Table:
    """A row for each value; with ``whole``, the first 300 s and the time to settle as well."""
    result = _table(title)
    names = _unique(rows, "estimator")
    for column in ("cycle", by):
        result.add_column(column)
    for name in names:
        result.add_column(name, justify="right")
    for cycle in _unique(rows, "cycle"):
        mine = [row for row in rows if row["cycle"] == cycle]
        for value in _unique(mine, by):
            cells = {row["estimator"]: row for row in mine if row[by] == value}
            result.add_row(cycle, str(value), *(_figures(cells[name], whole) for name in names))
    return result


def _figures(row: Row, whole: bool) -> str:
    text = f"{row['rmse_percent']:.2f} ({row['max_percent']:.1f})"
    if whole:
        settled = "-" if row["settled_s"] is None else f"{row['settled_s']:.0f}"
        text += f", {row['rmse_from_0_s_percent']:.2f}, {settled}"
    return text


def _table(title: str) -> Table:
    return Table(title=title, box=box.SIMPLE, collapse_padding=True, pad_edge=False)


def _unique(rows: Sequence[Row], key: str) -> list[Any]:
    return list(dict.fromkeys(row[key] for row in rows))


def draw(cycles: Sequence[Cycle], results: Sequence[Result], dt: float) -> Figure:
    """SOC, its error, and its error with outliers over time, a column for each cycle.

    Parameters
    ----------
    cycles : sequence of Cycle
        What was estimated.
    results : sequence of Result
        What the estimators made of it.
    dt : float
        Sampling time in s.
    """
    mpl.rcParams.update({
        "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
        "axes.edgecolor": "#AAAAAA", "xtick.color": "#AAAAAA", "ytick.color": "#AAAAAA",
        "xtick.labelcolor": "#333333", "ytick.labelcolor": "#333333", "grid.color": "#EBEBEB",
    })
    figure = Figure(figsize=(max(4.6 * len(cycles), 5.0), 7.4), layout="constrained")
    axes = figure.subplots(3, len(cycles), sharex="col", sharey="row", squeeze=False)
    for column, cycle in enumerate(cycles):
        minutes = dt / 60.0 * np.arange(cycle.soc.size)
        top, plain, spoilt = axes[:, column]
        for result in results:
            style = _STYLES.get(result.estimator)
            if result.cycle != cycle.name or style is None:
                continue
            how: dict[str, Any] = {"color": style[0], "ls": style[1], "lw": 1.3}
            if not result.condition:
                estimate = 100 * cycle.soc + result.error
                top.plot(minutes, estimate, label=result.estimator, **how)
                plain.plot(minutes, result.error, **how)
            elif result.condition == _SPOILT:
                spoilt.plot(minutes, result.error, **how)
        top.plot(minutes, 100 * cycle.soc, color="#000000", lw=0.8, label="reference")
        top.set_title(cycle.name)
        for panel in (plain, spoilt):
            panel.axhspan(-2.5, 2.5, color="#F0F0F0", lw=0, zorder=0)
        spoilt.set(xlabel="time (min)", xlim=(0, minutes[-1]))
    axes[0, 0].set(ylabel="state of charge (%)", ylim=(0, 103))
    axes[1, 0].set(ylabel="error (percentage points)", ylim=(-15, 8))
    axes[2, 0].set(ylabel="error (percentage points)\n2 % of the voltages read 0 V", ylim=(-40, 8))
    axes[1, 0].text(0.99, 2.8, "within 2.5", color="#777777", ha="right",
                    transform=axes[1, 0].get_yaxis_transform())
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center",
                  ncols=4, frameon=False)
    return figure
