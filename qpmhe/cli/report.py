"""``qpmhe report``: a study's results on screen, and as a page with figures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from ..studies.report.answers import Case, cases, chosen
from ..studies.report.words import cap_words, number, percent, qps_words, seconds
from ..studies.summary import TOLERANCE

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["report", "show"]

_MOST_ROWS = 40
_BEST = "[bold green]{}*[/]"
# Column of the summary, heading, words, whether less is better (None: neither), and whether it
# is shown on narrow terminals too.
_COLUMNS: tuple[tuple[str, str, Callable[[Any], str], bool | None, bool], ...] = (
    ("rmse", "RMSE", number, True, True),
    ("rmse_half", "± 95 %", number, None, False),
    ("rmse_settled", "RMSE\nsettled", number, True, False),
    ("cost_ratio", "J /\nconv.", number, True, True),
    ("time_median", "median", seconds, True, True),
    ("time_p99", "99 %", seconds, True, False),
    ("late", "late", percent, True, False),
    ("improved", "impr.", percent, False, True),
    ("failed_steps", "failed\nsteps", percent, True, False),
)


def report(console: Console, store_path: str | Path, out: str | Path) -> Path:
    """Show a store's answers and summary, and write its report.

    Parameters
    ----------
    console : rich.console.Console
        Where to print.
    store_path : path
        The store.
    out : path
        Folder of the report; it is made.

    Returns
    -------
    Path
        The HTML file.

    Raises
    ------
    StoreError
        If there is no such store, or it cannot be read.
    InvalidInputError
        If it holds nothing yet, the folder cannot be made, or a library is missing.
    """
    from ..studies.report import write_report
    from ..studies.store import Store
    from ..studies.summary import summarise

    store = Store(store_path)
    page = write_report(store, out)
    show(console, summarise(store.frame()))
    console.print(f"wrote {page}, and its figures as PNG and SVG beside it", highlight=False)
    return page


def show(console: Console, summary: DataFrame, *, every: bool = False) -> None:
    """Print the answers and a table for each model and horizon, the best of a column marked.

    Parameters
    ----------
    console : rich.console.Console
        Where to print.
    summary : pandas.DataFrame
        See `qpmhe.studies.summarise`.
    every : bool
        All configurations, however many. Otherwise, of more than 40, those of the Pareto
        front, of the answers, and the fastest near the best of each backend.
    """
    for case in cases(summary):
        console.print()
        console.print(f"[bold]{case.title}[/]", highlight=False)
        for answer in case.answers():
            console.print(f"  [bold]{answer.question}:[/] {answer.text}", highlight=False)
        table = _table(case, every, wide=True)
        unlimited = console.options.update_width(10_000)
        if Measurement.get(console, unlimited, table).maximum > console.width:
            table = _table(case, every, wide=False)
        console.print(table)


def _table(case: Case, every: bool, wide: bool) -> Table:
    rows = case.summary.assign(
        rmse_half=(case.summary["rmse_high"] - case.summary["rmse_low"]) / 2
    )
    columns = [one for one in _COLUMNS if (wide or one[4]) and rows[one[0]].notna().any()]
    best = {name: _best(rows.loc[case.whole.index], name, less) for name, _, _, less, _ in columns}
    drawn, caption = rows, "*: the best, of equals the fastest. front: Pareto front."
    if not every and len(rows) > _MOST_ROWS:
        drawn = rows.loc[sorted(_selection(case) | {one for one in best.values() if one >= 0})]
        caption = (
            f"{len(drawn)} of {len(rows)} configurations: the Pareto front, the best of each "
            f"column, and of each backend the fastest near its best RMSE. {caption}"
        )
    table = Table(
        box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), caption=caption, caption_justify="left",
    )
    starts = ["start"] if rows["start"].nunique() > 1 else []
    for head in ["backend", "QPs", "cap", *starts]:
        table.add_column(head, no_wrap=True, justify="left" if head == "backend" else "right")
    for _, heading, _, _, _ in columns:
        table.add_column(heading, no_wrap=True, justify="right")
    table.add_column("failed\nruns", no_wrap=True, justify="right")
    table.add_column("", no_wrap=True)
    for index, row in drawn.sort_values(["time_median", "rmse"]).iterrows():
        cells = [
            _BEST.format(words(row[name])) if index == best[name] else words(row[name]) + " "
            for name, _, words, _, _ in columns
        ]
        table.add_row(
            str(row["backend"]), qps_words(row["qps"]).replace("converged", "conv."),
            cap_words(row["solver_iterations"]), *(str(row[name]) for name in starts), *cells,
            f"{row['failures']} of {row['seeds']}" if row["failures"] else "-",
            "front" if row["pareto"] else "",
        )
    return table


def _best(rows: DataFrame, name: str, less: bool | None) -> int:
    """Index of the best value's row; -1 where all agree, as then nothing is told."""
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
