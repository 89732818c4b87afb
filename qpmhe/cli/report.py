"""``qpmhe report`` and ``qpmhe export``: a study's results on screen, as a page, as a table."""

from __future__ import annotations

from collections.abc import Callable, Set
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
from ..studies.row import SHOWN
from ..studies.summary import TOLERANCE, with_halves, with_observers
from . import options
from .values import read_width

if TYPE_CHECKING:
    from pandas import DataFrame

_MOST_ROWS = 40
_BEST = "[bold green]{}*[/]"


# The columns that a terminal may show, in their order, and how their numbers are written.
_COLUMNS = {name: one for name, one in SHOWN.items() if one.short}
_WORDS: dict[str, Callable[[Any], str]] = {
    "number": number, "seconds": seconds, "share": percent,
}


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
    frame = held.frame()
    show(console, studies.summarise(with_observers(frame)))
    for found in held.meta()["environments"]:
        words = environment_words(found, frame["backend"])
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
        rows = with_halves(case.summary)
        filled = {name for name in _COLUMNS if rows[name].notna().any()}
        chosen_ones = {
            name for name in filled
            if _COLUMNS[name].rank == 0 or (name == "cost" and case.by != "rmse")
        }
        for name in sorted(filled - chosen_ones, key=lambda name: _COLUMNS[name].rank):
            more = chosen_ones | {name}
            if _width(console, _table(case, rows, more)) <= console.width:
                chosen_ones = more
        console.print(_table(case, rows, chosen_ones, filled - chosen_ones))


def _width(console: Console, table: Table) -> int:
    unlimited = console.options.update_width(10_000)
    return Measurement.get(console, unlimited, table).maximum


def _table(
    case: Case, rows: DataFrame, names: Set[str], absent: Set[str] = frozenset()
) -> Table:
    columns = {name: one for name, one in _COLUMNS.items() if name in names}
    best = {
        name: _best(rows.loc[case.whole.index], name, one.less) for name, one in columns.items()
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
            ("time " if one.kind == "seconds" else "")
            + str(one.short).replace("-\n", "").replace("\n", " ")
            for name, one in _COLUMNS.items() if name in absent
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
    for one in columns.values():
        table.add_column(str(one.short), no_wrap=True, justify="right")
    table.add_column("failed\nruns", no_wrap=True, justify="right")
    table.add_column("", no_wrap=True)
    for index, row in drawn.sort_values(["time_median", "rmse"]).iterrows():
        cells = [
            (_BEST if index == best[name] else "{} ").format(_WORDS[one.kind](row[name]))
            for name, one in columns.items()
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
