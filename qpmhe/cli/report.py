"""``qpmhe report`` and ``qpmhe export``: a study's results on screen, as a page, as a table."""

from __future__ import annotations

from collections.abc import Callable, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from .. import studies
from ..studies.environment import environment_words
from ..studies.report.answers import Case, cases, chosen
from ..studies.report.words import cap_words, number, percent, qps_words, seconds
from ..studies.summary import TOLERANCE
from . import options
from .values import read_width

if TYPE_CHECKING:
    from pandas import DataFrame

_MOST_ROWS = 40
_BEST = "[bold green]{}*[/]"


@dataclass(frozen=True)
class _Column:
    """A column of the table: of the summary, heading, words, whether less is better."""

    name: str
    heading: str
    words: Callable[[Any], str]
    less: bool | None = None  # None: neither is better


# In the order in which they stand.
_COLUMNS = (
    _Column("rmse", "RMSE", number, True),
    _Column("rmse_half", "± 95 %", number),
    _Column("rmse_settled", "RMSE\nsettled", number, True),
    _Column("nees", "NEES", number),
    _Column("cost", "J", number, True),
    _Column("cost_ratio", "J /\nconv.", number, True),
    _Column("time_median", "median", seconds, True),
    _Column("time_p95", "95 %", seconds, True),
    _Column("time_p99", "99 %", seconds, True),
    _Column("time_max", "max", seconds, True),
    _Column("late", "late", percent, True),
    _Column("improved", "impr.", percent, False),
    _Column("kept", "kept", percent),
    _Column("fallback", "fall-\nback", percent, True),
    _Column("failed_steps", "failed\nsteps", percent, True),
    _Column("cap_hits", "cap\nhits", percent),
)
# Those that are always shown: NEES and late are there only where they were asked for.
_ALWAYS = ("rmse", "time_median", "late", "nees")
# The others, in the order in which they are given the room that is left.
_THEN = (
    "cost_ratio", "improved", "rmse_half", "rmse_settled", "time_p99", "failed_steps", "cap_hits",
    "fallback", "time_p95", "kept", "time_max", "cost",
)


def report(
    store: Annotated[Path, typer.Argument(help="File of the results.")],
    out: Annotated[Path, typer.Option(help="Folder of the report.")] = Path("results/report"),
    width: options.Width = None,
) -> None:
    """Summarise a store on screen, and write its report: an HTML page and figures."""
    show_report(Console(), store, out, read_width(width))


def export(
    store: Annotated[Path, typer.Argument(help="File of the results.")],
    file: Annotated[Path, typer.Argument(help="File to write, .csv, .parquet or .tex.")],
) -> None:
    """Write the rows of a store into a CSV or Parquet file, or their summary as LaTeX tables."""
    Console().print(f"wrote {studies.export(store, file)}", highlight=False)


def show_report(
    console: Console, store: Path, out: Path, width: str | float | None = None
) -> None:
    """Write a store's report, and print its answers and tables."""
    page = studies.write_report(store, out, width=width)
    held = studies.Store(store)
    summary = studies.summarise(held.frame())
    show(console, summary)
    for found in held.meta()["environments"]:
        words = environment_words(found, summary["backend"])
        console.print(f"[dim]{escape(words)}[/]", highlight=False)
    kinds = "PNG and SVG" if width is None else "PDF, PNG and SVG"
    console.print(f"wrote {page}, and its figures as {kinds} beside it", highlight=False)


def show(console: Console, summary: DataFrame) -> None:
    """Print the answers and a table for each model and horizon, the best of a column marked.

    Deadline and NEES are always shown if requested, further columns if they fit. Of more than 40
    configurations, only the Pareto front, the answers, and each backend's fastest near its best are
    shown.
    """
    for case in cases(summary):
        console.print()
        console.print(f"[bold]{case.title}[/]", highlight=False)
        for answer in case.answers():
            console.print(f"  [bold]{answer.question}:[/] {answer.text}", highlight=False)
        rows = case.summary.assign(
            rmse_half=(case.summary["rmse_high"] - case.summary["rmse_low"]) / 2
        )
        filled = {one.name for one in _COLUMNS if rows[one.name].notna().any()}
        chosen_ones = filled & {*_ALWAYS, *([] if case.by == "rmse" else ["cost"])}
        for name in _THEN:
            more = chosen_ones | {name}
            if name in filled and _width(console, _table(case, rows, more)) <= console.width:
                chosen_ones = more
        console.print(_table(case, rows, chosen_ones, filled - chosen_ones))


def _width(console: Console, table: Table) -> int:
    unlimited = console.options.update_width(10_000)
    return Measurement.get(console, unlimited, table).maximum


def _table(
    case: Case, rows: DataFrame, names: Set[str], absent: Set[str] = frozenset()
) -> Table:
    columns = [one for one in _COLUMNS if one.name in names]
    best = {
        one.name: _best(rows.loc[case.whole.index], one.name, one.less) for one in columns
    }
    drawn, caption = rows, "*: best."
    if rows["time_median"].notna().any():
        caption = "*: best; among equals, the fastest. front: Pareto front. Times: Python step."
    if len(rows) > _MOST_ROWS:
        drawn = rows.loc[sorted(_selection(case) | {one for one in best.values() if one >= 0})]
        caption = (
            f"{len(drawn)} of {len(rows)} configurations: the Pareto front, the best of each "
            f"column, and each backend's fastest near its best RMSE. {caption}"
        )
    if absent:
        left_out = [
            ("time " if one.name.startswith("time_") else "")
            + one.heading.replace("-\n", "").replace("\n", " ")
            for one in _COLUMNS if one.name in absent
        ]
        caption += f" Only in the report, for want of room: {', '.join(left_out)}."
    table = Table(
        box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), caption=caption, caption_justify="left",
    )
    starts = ["start"] if rows["start"].nunique() > 1 else []
    for head in ["backend", "QPs", "cap", *starts]:
        named = head == "backend"  # where all else does not fit, names are broken
        table.add_column(
            head, no_wrap=not named, overflow="fold", min_width=8 if named else None,
            justify="left" if named else "right",
        )
    for one in columns:
        table.add_column(one.heading, no_wrap=True, justify="right")
    table.add_column("failed\nruns", no_wrap=True, justify="right")
    table.add_column("", no_wrap=True)
    for index, row in drawn.sort_values(["time_median", "rmse"]).iterrows():
        cells = [
            _BEST.format(one.words(row[one.name])) if index == best[one.name]
            else one.words(row[one.name]) + " " for one in columns
        ]
        table.add_row(
            str(row["backend"]), qps_words(row["qps"]).replace("converged", "conv."),
            cap_words(row["solver_iterations"]), *(str(row[name]) for name in starts), *cells,
            f"{row['failures']} of {row['seeds']}" if row["failures"] else "-",
            "front" if row["pareto"] else "",
        )
    return table


def _best(rows: DataFrame, name: str, less: bool | None) -> int:
    """Index of the best value's row; -1 where all agree."""
    if less is None:
        return -1
    values = rows[name].astype(float) * (1.0 if less else -1.0)
    values = values[np.isfinite(values)]
    if values.empty or values.min() == values.max():
        return -1
    equal = rows.loc[values.index[values <= values.min() + TOLERANCE * abs(values.min())]]
    return int(equal.sort_values(["time_median", "rmse"]).index[0])


def _selection(case: Case) -> set[int]:
    found: set[int] = set(case.summary.index[case.summary["pareto"]])
    for _, rows in case.summary.groupby("backend"):
        best = chosen(rows)
        if best is None:
            found.add(rows.index[0])
        else:
            found.add(next(row for row in best if row is not None).name)
    return found | {row.name for row in chosen(case.summary) or () if row is not None}
