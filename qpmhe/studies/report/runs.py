"""The trajectories that the page holds: the best configurations' first, up to a size."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from .plotly_axes import axis, figure
from .words import configuration_words

if TYPE_CHECKING:
    from pandas import DataFrame

    from .answers import Case
    from .write import Source

__all__ = ["MOST_STATES", "Runs", "choose"]

#: States that the page draws.
MOST_STATES = 12


@dataclass
class Runs:
    """The runs of one case.

    Parameters
    ----------
    figure : plotly figure or None
        Axes and real states.
    observer : list or None
        The observer's estimates, an encoded array a state.
    all : dict of str to list
        The same for each run that can be chosen, by the cell's key.
    entries : list of (key, text)
        The runs in words, the best first.
    static : list of (text, trajectory)
        What the static figure draws.
    left_out : int
        Runs for which there was no room.
    """

    figure: Any = None
    observer: list[Any] | None = None
    all: dict[str, list[Any]] = field(default_factory=dict)
    entries: list[tuple[str, str]] = field(default_factory=list)
    static: list[tuple[str, Any]] = field(default_factory=list)
    left_out: int = 0


def choose(source: Source, cells: DataFrame, case: Case, most: int) -> Runs:
    """Collect the runs of one case.

    Parameters
    ----------
    source : Source
        Where the trajectories are.
    cells : pandas.DataFrame
        Cells of the case.
    case : Case
        Their summary.
    most : int
        Bytes that may be spent.
    """
    from .answers import chosen

    runs = Runs()
    seed = cells["seed"].min()
    first = cells[(cells["seed"] == seed) & (cells["outcome"] == "done")]
    pareto = {
        configuration_words(row): bool(row["pareto"]) for _, row in case.summary.iterrows()
    }
    ranked = sorted(
        (not pareto[configuration_words(row)], float(row["rmse"]), configuration_words(row),
         str(row["key"]))
        for _, row in first.iterrows()
    )
    best = chosen(case.summary)
    named = [configuration_words(row) for row in best or () if row is not None]
    spent = 0
    for behind, _, words, key in ranked:
        if spent >= most and "observer" not in words and words not in named:
            runs.left_out += 1
            continue
        trajectory = source.trajectory(key)
        if trajectory is None:
            continue
        estimates = np.asarray(trajectory["estimates"], dtype="<f4")
        if runs.figure is None:
            runs.figure = _figure(trajectory)
        encoded = [_encoded(one) for one in estimates.T[:MOST_STATES]]
        spent += sum(len(one["bdata"]) for one in encoded)
        if words == "observer":
            runs.observer = encoded
        runs.all[key] = encoded
        runs.entries.append((key, words if behind else f"{words} (Pareto front)"))
        if words == "observer" or words in named:
            runs.static.append((words, trajectory))
    runs.entries.sort(key=lambda entry: entry[1] == "observer")
    return runs


def _figure(trajectory: Mapping[str, Any]) -> Any:
    """The states of one model: the real ones, and empty traces for the page to fill."""
    import plotly.graph_objects as go

    labels = [str(one) for one in trajectory["labels"]]
    labels = labels[:MOST_STATES]
    n, times = len(labels), np.asarray(trajectory["times"], dtype=np.float32)
    states = np.asarray(trajectory["states"], dtype=np.float32)
    drawing = figure(
        90 + (170 if n <= 4 else 115) * n, showlegend=True,
        legend={"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "xanchor": "left"},
        margin={"l": 8, "r": 14, "t": 40, "b": 8},
    )
    gap = 0.12  # of a panel's height
    for j in range(n):
        suffix = str(j + 1) if j else ""
        axes = {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}"}
        lines = (
            ("real", {"color": "#bbbbbb", "width": 4}),
            ("observer", {"color": "#222222", "width": 1.2, "dash": "dot"}),
            ("estimate", {"color": "#D55E00", "width": 1.8}),
        )
        for role, line in lines:
            drawing.add_trace(go.Scatter(
                x=times, y=states[:, j] if role == "real" else [], mode="lines", line=line,
                name=role, showlegend=j == 0, legendgroup=role, meta={"role": role, "state": j},
                **axes,
            ))
        top = 1 - j * (1 + gap) / (n + gap * (n - 1))
        bottom = top - 1 / (n + gap * (n - 1))
        drawing.update_layout({
            f"yaxis{suffix}": axis(labels[j], domain=[max(0.0, bottom), top]),
            f"xaxis{suffix}": axis(
                f"time ({trajectory['time_unit']})" if j == n - 1 else "",
                anchor=f"y{suffix}", matches="x" if j else None,
                showticklabels=j == n - 1,
            ),
        })
    return drawing


def _encoded(values: Any) -> dict[str, str]:
    """An array as plotly reads it, at a quarter of the size of digits."""
    return {"dtype": "f4", "bdata": b64encode(np.ascontiguousarray(values).tobytes()).decode()}
