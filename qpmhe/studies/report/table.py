"""The table of a report's page: a row for each configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..row import SHOWN, Column
from ..summary import with_halves
from .answers import Case
from .words import cap_words, missing, number, percent, qps_words, ranked

if TYPE_CHECKING:
    from pandas import DataFrame

# The table is in the order of the first of these that it has.
_ORDER = ("time_median", "rmse", "cost")
_WHY = {
    "CONVERGED": "converged", "UNCONVERGED": "not converged", "NO_DECREASE": "no decrease",
    "CAP_REACHED": "no decrease at cap",
    "SOLVER_STOPPED": "solver stopped",
    "SOLVER_FAILED": "solver failed", "MODEL_FAILED": "model failed", "TIME_UP": "time up",
    "ROWS_DROPPED": "rows dropped", "CANDIDATE_OUTSIDE": "candidate outside",
    "RESTORED": "restored", "RESTARTED": "observer restarted",
}


@dataclass(frozen=True)
class Entry:
    """What an entry shows, and by what its column is sorted; texts stand at the left."""

    text: str
    rank: str = ""
    left: bool = False


@dataclass(frozen=True)
class PageTable:
    """Headings, whether their columns are texts, and rows with the key of their case."""

    headings: list[tuple[str, bool]]
    rows: list[tuple[str, list[Entry]]]


def table(cases: list[Case]) -> PageTable:
    """The configurations of all cases, the fastest first."""
    import pandas as pd

    summary = pd.concat([case.summary.assign(case=case.key) for case in cases], ignore_index=True)
    order = next((one for one in _ORDER if summary[one].notna().any()), _ORDER[0])
    summary = with_halves(summary.sort_values(order, kind="stable"))
    columns = _named(summary)
    for name, one in sorted(SHOWN.items(), key=lambda item: item[1].rank):
        if summary[name].notna().any():
            columns[one.title] = [_number(value, one) for value in summary[name]]
    columns["RMSE by state"] = [Entry(_numbers(one), left=True) for one in summary["rmse_states"]]
    columns["why a sequence ended"] = [Entry(_why(one), left=True) for one in summary["reasons"]]
    return PageTable(
        [(heading, cells[0].left) for heading, cells in columns.items()],
        [*zip(summary["case"], map(list, zip(*columns.values(), strict=True)), strict=True)],
    )


def _named(summary: DataFrame) -> dict[str, list[Entry]]:
    """The columns that name a configuration, without those in which all agree."""
    columns = {"backend": [Entry(str(one), left=True) for one in summary["backend"]]}
    horizons = ["usual" if missing(one) else str(int(one)) for one in summary["horizon"]]
    for heading, words in (
        ("model", summary["model"].astype(str)), ("N", horizons),
        ("start", summary["start"].astype(str)),
    ):
        if len(set(words)) > 1:
            columns[heading] = [Entry(one, left=heading != "N") for one in words]
    for heading, words in (
        ("QPs", [qps_words(one) for one in summary["qps"]]),
        ("cap", [cap_words(one) for one in summary["solver_iterations"]]),
    ):
        places = {word: str(place) for place, word in enumerate(ranked(words))}
        columns[heading] = [Entry(one, places[one]) for one in words]
    columns["front"] = [Entry("front" if one else "", left=True) for one in summary["pareto"]]
    return columns


def _number(value: Any, column: Column) -> Entry:
    """A count, or a number with three digits in the column's unit; unknown ones are last."""
    if missing(value):
        return Entry(number(value), "Infinity")
    words = str(int(value)) if column.kind == "count" else number(column.scale * value)
    return Entry(words, repr(float(value)))


def _numbers(values: Any) -> str:
    return ", ".join(f"{one:.3g}" for one in values) if isinstance(values, list) else ""


def _why(shares: Any) -> str:
    if not isinstance(shares, dict):
        return ""
    return ", ".join(
        f"{_WHY[flag]} {percent(share)}" for flag, share in shares.items() if flag in _WHY
    )
