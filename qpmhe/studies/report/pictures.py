"""The pictures of a report: the same ones in the page and in the files beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ...plots import trajectories
from ..store import Store
from ..summary import sequential
from . import figures
from .answers import Case, chosen, file_name
from .drawing import Picture, Style, draw
from .figures import SOLVED, Profile
from .words import configuration_words, percent, qps_heading, qps_words, ranked, usual_first

if TYPE_CHECKING:
    from pandas import DataFrame

#: States that are drawn of a run, at most.
MOST_STATES = 6
# Inches that a column of panels needs.
_COLUMN = 2.2


@dataclass
class Part:
    """What is drawn of one case: its cells, and the words and trajectories of runs."""

    case: Case
    cells: DataFrame
    deadline: float | None
    runs: list[tuple[str, dict[str, Any]]] = field(default_factory=list)


def chosen_runs(
    source: Store, cells: DataFrame, case: Case
) -> list[tuple[str, dict[str, Any]]]:
    """The first seed's runs of the configurations that the answers name, and of the observer."""
    first = cells[(cells["seed"] == cells["seed"].min()) & (cells["outcome"] == "done")]
    keys = {configuration_words(row): str(row["key"]) for _, row in first.iterrows()}
    named = [configuration_words(row) for row in chosen(case.summary) or () if row is not None]
    found = [
        (words, source.trajectory(keys[words]))
        for words in dict.fromkeys([*reversed(named), "observer"]) if words in keys
    ]
    return [(words, one) for words, one in found if one is not None]


def pictures(
    parts: list[Part], drawn: Mapping[str, Style], profile: list[Profile],
    inches: float | None = None,
) -> dict[str, Picture]:
    """All pictures, by the name of the file; for a paper as wide as so many inches."""
    import pandas as pd

    summary = pd.concat([part.case.summary for part in parts])
    found = {
        file_name(title): draw(drawing, looks, _size(inches, 5.4, 3.8), title.rpartition(" ")[0])
        for title, (drawing, looks) in figures.sweeps(summary).items()
    }
    for part in parts:
        found |= {
            f"{part.case.key}-{name}": picture
            for name, picture in (
                ("accuracy-time", _accuracy(part, drawn, inches)),
                ("anytime", _anytime(part, drawn, inches)),
                ("step-times", _times(part, drawn, inches)),
                ("run", _run(part) if part.runs else None),
            ) if picture is not None
        }
    one = figures.performance(profile)
    if one is not None:
        found["profile"] = draw(
            one, drawn, _size(inches, 7.2, 4.2),
            f"Solved: J on average within {percent(SOLVED)} of the converged one",
        )
    return found


def _size(inches: float | None, width: float, height: float) -> tuple[float, float]:
    return (width, height) if inches is None else (inches, min(height, 0.8 * inches + 0.4))


def _columns(words: list[str], inches: float | None) -> list[tuple[str, dict[str, str]]]:
    """A column of panels for each number of QPs per sample, as many as there is room for."""
    room = len(words) if inches is None else max(1, int(inches / _COLUMN))
    words = words[-room:] if room > 1 or "2" not in words else ["2"]
    return [(qps_heading(one), {"qps": one}) for one in words]


def _start(part: Part) -> tuple[str, str]:
    """The start of the sequences of QPs that is drawn, and words for it where there are others."""
    starts = sorted(map(str, part.case.summary["start"].unique()), key=usual_first)
    return starts[0], f"; start {starts[0]}" if len(starts) > 1 else ""


def _accuracy(part: Part, drawn: Mapping[str, Style], inches: float | None) -> Picture | None:
    one = figures.accuracy(part.case.summary)
    return None if one is None else draw(
        one, drawn, _size(inches, 8.6, 4.8), f"{part.case.title}\nlarger: more QPs per sample; "
        "hollow: capped; pale: runs failed; bars: 95 %",
    )


def _anytime(part: Part, drawn: Mapping[str, Style], inches: float | None) -> Picture | None:
    start, of_start = _start(part)
    one, rest = figures.anytime(part.case.summary, start), part.case.whole
    rest = rest[sequential(rest) & (rest["start"] == start)]
    if one is None or rest.empty:
        return None
    words = ranked(map(qps_words, rest["qps"]))
    return draw(
        one, drawn, _size(inches, 1.4 + 2.1 * max(2, len(words)), 5.0),
        f"{part.case.title}{of_start}", _columns(words, inches),
    )


def _times(part: Part, drawn: Mapping[str, Style], inches: float | None) -> Picture | None:
    start, of_start = _start(part)
    spreads = figures.spreads(part.cells, start)
    words = ranked(one.qps for one in spreads if one.qps != "0")
    one = figures.times(spreads, part.deadline)
    if one is None or not words:
        return None
    height = 1.5 + 0.27 * len(one.panels[0].y.values)
    return draw(
        one, drawn, _size(inches, 1.6 + 2.3 * max(2, len(words)), height),
        f"{part.case.title}\nno cap on the solver{of_start}", _columns(words, inches),
    )


def _run(part: Part) -> Picture:
    first = part.runs[0][1]
    labels = [str(one) for one in first["labels"]][:MOST_STATES]
    n = len(labels)
    truth = np.asarray(first["states"])[:, :n]
    return Picture(trajectories(
        np.asarray(first["times"]), truth if np.isfinite(truth).any() else None,
        {words: np.asarray(one["estimates"])[:, :n] for words, one in part.runs},
        labels, f"time t ({first['time_unit']})",
    )[0].figure)
