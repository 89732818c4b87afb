"""The page's figures of accuracy, with plotly.

A trace carries in ``meta`` what the page filters by: ``backend``, ``qps`` and ``cap``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .plotly_axes import axis, bars, error_axis, figure, time_axis
from .style import Style
from .words import cap_words, configuration_words, missing, number, percent, qps_words, seconds

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["accuracy", "anytime"]

_SIZES = {"0": 15, "1": 9, "2": 11}
_LARGEST = 14
# Opacity of configurations of which runs failed: their means are over the other seeds.
_PALE = 0.3


def accuracy(
    summary: DataFrame, drawn: Mapping[str, Style], metric: str, label: str, front: Any
) -> Any:
    """Accuracy against time, a point a configuration.

    Parameters
    ----------
    summary : pandas.DataFrame
        Configurations of one model and horizon.
    drawn : mapping of backend to Style
        How backends are drawn.
    metric, label : str
        Column of the vertical axis, and its name with unit.
    front : array of bool
        Which rows are on the Pareto front.
    """
    import plotly.graph_objects as go

    rows = summary[summary["time_median"].notna() & np.isfinite(summary[metric].astype(float))]
    if rows.empty:
        return None
    best = summary[np.asarray(front, dtype=bool)].sort_values("time_median")
    drawing = figure(480)
    drawing.add_trace(go.Scatter(
        x=best["time_median"], y=best[metric], mode="lines", hoverinfo="skip",
        line={"color": "#999999", "width": 1.5, "shape": "hv"}, meta={"role": "front"},
    ))
    drawing.add_trace(go.Scatter(
        x=best["time_median"], y=best[metric], mode="markers", hoverinfo="skip",
        marker={"size": 23, "color": "rgba(0,0,0,0)", "line": {"color": "#555555", "width": 1.2}},
        meta={"role": "front"},
    ))
    for backend, mine in rows.groupby("backend", sort=False):
        style = drawn[str(backend)]
        capped = mine["solver_iterations"].notna()
        drawing.add_trace(go.Scatter(
            x=mine["time_median"], y=mine[metric], mode="markers", name=str(backend),
            error_y=bars(mine, metric, style),
            marker={
                "color": style.color,
                "opacity": [_PALE if failed else 0.9 for failed in mine["failures"]],
                "symbol": [style.symbol + ("-open" if open_ else "") for open_ in capped],
                "size": [_SIZES.get(qps_words(one), _LARGEST) for one in mine["qps"]],
                "line": {"width": [1.8 if open_ else 0 for open_ in capped],
                         "color": style.color},
            },
            text=[_hover(row) for _, row in mine.iterrows()],
            hovertemplate="%{text}<extra></extra>",
            meta={"backend": str(backend)},
        ))
    drawing.update_layout(
        xaxis=time_axis("median time per step", rows["time_median"]),
        yaxis=error_axis(label, rows[metric]),
    )
    return drawing


def _hover(row: Any) -> str:
    lines = [
        f"<b>{configuration_words(row)}</b>" + (" (Pareto front)" if row["pareto"] else ""),
        f"RMSE {number(row['rmse'])} ({number(row['rmse_low'])} to {number(row['rmse_high'])})",
        f"RMSE settled {number(row['rmse_settled'])}, J / converged {number(row['cost_ratio'])}",
        f"time median {seconds(row['time_median'])} ({seconds(row['time_median_low'])} to "
        f"{seconds(row['time_median_high'])}), 99 % {seconds(row['time_p99'])}",
        f"improved {percent(row['improved'])} of the steps, {row['seeds']} seeds"
        + (f", {row['failures']} failed" if row["failures"] else ""),
    ]
    return "<br>".join(lines)


def anytime(summary: DataFrame, drawn: Mapping[str, Style], label: str) -> Any:
    """RMSE and cost ratio against the cap, a line a backend and number of QPs per sample."""
    import plotly.graph_objects as go

    caps = sorted({int(c) for c in summary["solver_iterations"] if not missing(c)})
    order = [*map(str, caps), "none"]
    drawing = figure(560, grid={"rows": 2, "columns": 1, "pattern": "independent"})
    rest = summary[(summary["backend"] != "observer") & (summary["failures"] == 0)]
    observer = summary[summary["backend"] == "observer"]
    for place, metric in enumerate(("rmse", "cost_ratio")):
        axes = {"xaxis": "x2", "yaxis": "y2"} if place else {}
        for (backend, qps, start), rows in rest.groupby(
            ["backend", "qps", "start"], dropna=False, sort=False
        ):
            style = drawn[str(backend)]
            drawing.add_trace(go.Scatter(
                x=[cap_words(one) for one in rows["solver_iterations"]], y=rows[metric],
                mode="lines+markers", error_y=bars(rows, metric, style),
                line={"color": style.color, "width": 1.5, "dash": style.dash},
                marker={"color": style.color, "symbol": style.symbol, "size": 9},
                text=[_hover(row) for _, row in rows.iterrows()],
                hovertemplate="%{text}<extra></extra>",
                meta={"backend": str(backend), "qps": qps_words(qps), "start": str(start)},
                **axes,
            ))
        for _, row in observer.iterrows():
            drawing.add_trace(go.Scatter(
                x=order, y=[row[metric]] * len(order), mode="lines",
                text=[_hover(row)] * len(order),
                hovertemplate="%{text}<extra></extra>",
                line={"color": drawn["observer"].color, "width": 1.5, "dash": "dash"},
                meta={"backend": "observer"}, **axes,
            ))
    category = {"type": "category", "categoryorder": "array", "categoryarray": order}
    drawing.update_layout(
        xaxis=axis("", **category, domain=[0, 1]),
        xaxis2=axis("cap on the solver's iterations", **category, domain=[0, 1]),
        yaxis=error_axis(label, summary["rmse"], domain=[0.56, 1.0]),
        yaxis2=error_axis("J / converged J", summary["cost_ratio"], domain=[0.0, 0.46]),
    )
    return drawing
