"""The figures of a report, each described once: see `drawing`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._checks import Array
from ..row import CONFIGURATION
from ..summary import PROBLEM, RANKED_BY, alone, measure, sequential
from .answers import NEAR
from .drawing import Axis, Drawing, Panel, PlotMark, Style, styles
from .words import (
    cap_words,
    configuration_words,
    missing,
    number,
    percent,
    qps_words,
    ranked,
    seconds,
    usual_first,
)

if TYPE_CHECKING:
    from pandas import DataFrame

#: A problem counts as solved if J is on average within this part of the converged one.
SOLVED = 0.01
_QUANTILES = (0.01, 0.25, 0.5, 0.75, 0.99, 1.0)
# Diameters of points, by QPs per sample.
_SIZES, _LARGEST = {"0": 9.5, "1": 5.1, "2": 6.5}, 8.1


def accuracy(summary: DataFrame) -> Drawing | None:
    """Accuracy against time, one point per configuration, and the Pareto front."""
    by = measure(summary)
    rows = summary[summary["time_median"].notna() & np.isfinite(summary[by].astype(float))]
    if rows.empty:
        return None
    best = rows[rows["pareto"]].sort_values("time_median")
    marks = [PlotMark(
        "front", best["time_median"].tolist(), best[by].tolist(),
        words=[configuration_words(row) for _, row in best.iterrows()],
    )]
    for backend, mine in rows.groupby("backend", sort=False):
        marks.append(PlotMark(
            "points", mine["time_median"].tolist(), mine[by].tolist(), str(backend),
            [_told(row, by) for _, row in mine.iterrows()], _bars(mine, by),
            sizes=[_SIZES.get(qps_words(one), _LARGEST) for one in mine["qps"]],
            hollow=mine["solver_iterations"].notna().tolist(),
            pale=(mine["failures"] > 0).tolist(),
        ))
    return Drawing([Panel(
        Axis("median time per step", "time", rows["time_median"].tolist()),
        Axis(RANKED_BY[by], "error", rows[by].tolist()), marks,
    )])


def anytime(summary: DataFrame, start: str) -> Drawing | None:
    """RMSE and cost ratio against the cap, a line for each backend and number of QPs per sample.

    The sequences of QPs begin at ``start``. Without the cost ratio where the study has none, and
    nothing of one backend at one cap.
    """
    rest = summary[
        sequential(summary) & (summary["failures"] == 0) & (summary["start"] == start)
    ]
    if len(rest[["backend", "solver_iterations"]].drop_duplicates()) < 2:
        return None
    others = summary[~sequential(summary)]
    caps = sorted({int(cap) for cap in rest["solver_iterations"] if not missing(cap)})
    order = [*map(str, caps), "none"]
    panels: list[Panel] = []
    metrics = [("rmse", "RMSE"), ("cost_ratio", "J / converged J")]
    metrics = [(name, label) for name, label in metrics if rest[name].notna().any()]
    for metric, label in metrics:
        marks = [
            PlotMark("level", order, [float(row[metric])] * len(order), str(row["backend"]))
            for _, row in others.iterrows() if not missing(row[metric])
        ]
        for (backend, qps), rows in rest.groupby(["backend", "qps"], dropna=False, sort=False):
            marks.append(PlotMark(
                "line", [cap_words(one) for one in rows["solver_iterations"]],
                rows[metric].astype(float).tolist(), str(backend), bars=_bars(rows, metric),
                meta={"qps": qps_words(qps)},
            ))
        title = "cap on the solver's iterations" if metric == metrics[-1][0] else ""
        panels.append(Panel(
            Axis(title, "category", order),
            Axis(label, "error", summary[metric].astype(float).tolist()), marks,
        ))
    return Drawing(panels) if panels else None


#: What errors are drawn against: the column, the words of the axis and the letter of files.
AXES = {
    "horizon": ("horizon N", "N"), "noise_level": ("noise level", "noise"),
    "qps": ("QPs per sample i", "i"),
}


def sweeps(summary: DataFrame) -> dict[str, tuple[Drawing, dict[str, Style]]]:
    """Errors against N, noise level and i where they vary: the drawing, and how lines look.

    The runs are uncapped, with the usual start and one backend, which the name states: the first in
    the alphabet of those within 1 % of the best. Bars are confidence limits over the seeds. There
    is a line for each i, else for each N.
    """
    drawn = {}
    for (model, steps), rows in summary.groupby(["model", "steps"], sort=False):
        rows = rows[(rows["failures"] == 0) & rows["solver_iterations"].isna()]
        rest = rows[sequential(rows)]
        least = rest.groupby("backend")[measure(rows)].min()
        if least.isna().all():
            continue
        backend = min(least.index[least <= (1 + NEAR) * least.min()])
        start = min(rest["start"], key=usual_first)
        mine = rows["backend"] == backend
        same = rows["observer"] == rows.loc[mine, "observer"].iloc[0]
        rows = rows[(mine | alone(rows) & same) & rows["start"].isin([start, "candidate"])]
        varying = [name for name in AXES if rows[name].nunique(dropna=False) > 1]
        for name in varying:
            lines = next((one for one in ("qps", "horizon", "noise_level")
                          if one != name and one in varying), None)
            others = [one for one in varying if one not in (name, lines)]
            groups = rows.groupby(others, sort=True) if others else [((), rows)]
            for values, group in groups:
                fixed = "".join(
                    f", {AXES[one][1]} = {value:g}"
                    for one, value in zip(others, values, strict=True)
                )
                title = f"{model}, {backend}{fixed}"
                if summary["steps"].nunique() > 1:
                    title += f", T = {steps}"
                drawn[f"{title} error-{AXES[name][1]}"] = _sweep(group, name, lines)
    return drawn


def _sweep(rows: DataFrame, name: str, lines: str | None) -> tuple[Drawing, dict[str, Style]]:
    by, words = measure(rows), AXES[name][0]
    marks, looks = [], []
    for value, mine in [(None, rows)] if lines is None else rows.groupby(lines, dropna=False):
        look = str(mine["backend"].iloc[-1])
        if lines == "qps":
            look = {"0": "observer", "converged": "converged"}.get(
                word := qps_words(value), f"i = {word}"
            )
        elif lines is not None:
            look = f"{AXES[lines][1]} = {value:g}"
        looks.append(look)
        mine = mine.sort_values(name, na_position="last")
        x = [qps_words(one) for one in mine[name]] if name == "qps" else mine[name].tolist()
        y = mine[by].astype(float).tolist()
        marks.append(PlotMark("line", x, y, look, bars=_bars(mine, by)))
    axis = Axis(words, "values", sorted(set(rows[name].dropna().astype(float))))
    if name == "qps":
        axis = Axis(words, "category", ranked(map(qps_words, rows["qps"])))
    values = rows[by].astype(float).tolist()
    found = Drawing([Panel(axis, Axis(RANKED_BY[by], "error", values), marks)])
    return found, styles(looks)


def times(found: list[Spread], deadline: float | None) -> Drawing | None:
    """Step times: boxes of quartiles with 1 % and 99 % whiskers, and the longest step."""
    if not found:
        return None
    # A category's first name is the lowest.
    sequences = {one.backend for one in found if one.qps != "0"}
    others = {one.backend for one in found} - sequences
    names = [*sorted(others, reverse=True), *sorted(sequences, reverse=True)]
    marks = []
    for one in found:
        low, first, median, third, high, most = map(seconds, one.quantiles)
        marks.append(PlotMark(
            "box", one.quantiles, [one.backend], one.backend,
            [f"{one.backend}, {one.steps} steps\n1 % {low}, 25 % {first}, median {median}\n"
             f"75 % {third}, 99 % {high}, longest {most}"],
            meta={} if one.qps == "0" else {"qps": one.qps},
        ))
    values = [value for one in found for value in one.quantiles]
    return Drawing(
        [Panel(Axis("time per step", "time", values), Axis("", "category", names), marks)],
        deadline,
        "time per step (box: quartiles; whiskers: 1 % and 99 %; tick: longest)"
        + ("" if deadline is None else "; dotted: deadline"),
    )


def performance(found: list[Profile]) -> Drawing | None:
    """Performance profiles as steps over a logarithmic axis of time ratios."""
    if not found:
        return None
    largest = max((float(one.ratios[-1]) for one in found if one.ratios.size), default=1.0)
    last = max(2.0, 1.15 * largest)
    marks = []
    for one in found:
        x, y = one.steps(last)
        marks.append(PlotMark(
            "steps", x.tolist(), y.tolist(), one.backend, label=one.words,
        ))
    return Drawing([Panel(
        Axis("time / fastest backend's time", "ratio", [1.0, last]),
        Axis(f"share of {found[0].problems} problems solved", "share"), marks,
    )])


def _told(row: Any, by: str) -> str:
    """What a point tells of its configuration."""
    shown = {"rmse": "RMSE"} | {by: RANKED_BY[by]}
    return "\n".join([
        configuration_words(row) + (" (Pareto front)" if row["pareto"] else ""),
        *(f"{words} {number(row[name])} ({number(row[f'{name}_low'])} to "
          f"{number(row[f'{name}_high'])})" for name, words in shown.items()),
        f"RMSE settled {number(row['rmse_settled'])}, J / converged {number(row['cost_ratio'])}",
        f"time median {seconds(row['time_median'])} ({seconds(row['time_median_low'])} to "
        f"{seconds(row['time_median_high'])}), 99 % {seconds(row['time_p99'])}",
        f"improved {percent(row['improved'])} of the steps, {row['seeds']} seeds"
        + (f", {row['failures']} failed" if row["failures"] else ""),
    ])


def _bars(rows: DataFrame, name: str) -> tuple[list[float], list[float]]:
    """Confidence limits as error bars, none where runs failed."""
    mean = rows[name].astype(float).where(rows["failures"] == 0)
    low, high = (mean - rows[f"{name}_low"]).fillna(0.0), (rows[f"{name}_high"] - mean).fillna(0.0)
    return low.tolist(), high.tolist()


@dataclass(frozen=True)
class Spread:
    """Quantiles of all step times of one configuration: 1, 25, 50, 75, 99 %, and the longest."""

    backend: str
    qps: str
    quantiles: list[float]
    steps: int


def spreads(cells: DataFrame, start: str) -> list[Spread]:
    """Quantiles over the steps of all seeds: without QPs, and without a cap from this start."""
    uncapped = cells["solver_iterations"].isna() & (cells["start"] == start)
    found = []
    for (backend, qps), rows in cells[uncapped | ~sequential(cells)].groupby(
        ["backend", "qps"], dropna=False
    ):
        parts = [np.asarray(one, dtype=float) for one in rows["times"] if one is not None]
        parts = [one[np.isfinite(one)] for one in parts if one.ndim == 1]
        values = np.concatenate(parts) if parts else np.empty(0)
        if values.size:
            found.append(Spread(
                str(backend), qps_words(qps), np.quantile(values, _QUANTILES).tolist(), values.size,
            ))
    return found


@dataclass(frozen=True)
class Profile:
    r"""Share of problems that a solver solves within a factor of the fastest one's time.

    :math:`\rho_s(\tau) = |\{p : t_{p,s} \le \tau \min_{s'} t_{p,s'}\}| / |P|`
    (Dolan and More, Mathematical Programming 91, 2002, doi 10.1007/s101070100263).
    ``ratios``, sorted, are those of the problems that it solves; ``problems`` is |P|.
    """

    backend: str
    words: str
    ratios: Array
    problems: int

    def steps(self, last: float) -> tuple[Array, Array]:
        """Corners of the curve up to the ratio ``last``: ratios and shares."""
        x = np.concatenate(([1.0], self.ratios, [last]))
        y = np.concatenate(([0.0], np.arange(1, self.ratios.size + 1), [self.ratios.size]))
        return x, y / self.problems


def profiles(frame: DataFrame) -> list[Profile]:
    """A profile for each backend over the problems: model, horizon, length of the record, and seed.

    A backend is represented by its configuration that solves most problems, of several such by
    the one with the lowest geometric mean time (median per step). Solved means: the run finished
    and its J is on average within `SOLVED` of the converged one. There are no profiles without
    times, with fewer than two problems, or if no problem counts as solved.
    """
    problems = [*PROBLEM, "seed"]
    cells = frame[sequential(frame)]
    names = [tuple(row) for row in cells[problems].astype(str).to_numpy()]
    count = len(set(names))
    if count < 2 or not cells["time_median"].notna().any():
        return []
    solved = (
        (cells["outcome"] == "done") & (cells["cost_ratio"].astype(float) <= 1 + SOLVED)
        & cells["time_median"].notna()
    )
    if not solved.any():
        return []
    cells = cells.assign(problem=names, solved=solved, time=cells["time_median"].astype(float))
    # The same settings on different problems are one configuration here.
    keys = [key for key in CONFIGURATION if key not in problems]
    best: dict[str, tuple[tuple[float, float], Any, DataFrame]] = {}
    for _, rows in cells.groupby(keys, dropna=False):
        mine = rows[rows["solved"]]
        mean = float(np.log(mine["time"]).mean()) if len(mine) else np.inf
        rank = (-len(mine), mean)
        backend = str(rows["backend"].iloc[0])
        if backend not in best or rank < best[backend][0]:
            best[backend] = rank, rows.iloc[0], mine
    fastest: dict[Any, float] = {}
    for _, _, mine in best.values():
        for problem, time in zip(mine["problem"], mine["time"], strict=True):
            fastest[problem] = min(time, fastest.get(problem, np.inf))
    return [
        Profile(
            backend, configuration_words(row),
            np.sort([t / fastest[p] for p, t in zip(mine["problem"], mine["time"], strict=True)]),
            count,
        )
        for backend, (_, row, mine) in sorted(best.items())
    ]
