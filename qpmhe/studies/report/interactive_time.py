"""The page's figures of times: distribution and performance profiles, with plotly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .plotly_axes import axis, figure, pale, time_axis
from .profile import Profile, last_ratio
from .style import Style
from .times import Spread
from .words import number, percent, seconds

__all__ = ["distribution", "performance"]


def distribution(
    found: list[Spread], drawn: Mapping[str, Style], deadline: float | None
) -> Any:
    """Step times: boxes of quartiles with 1 % and 99 % whiskers, and the longest step."""
    import plotly.graph_objects as go

    if not found:
        return None
    backends = sorted({one.backend for one in found} - {"observer"}, reverse=True)
    drawing = figure(180 + 34 * (len(backends) + 1), margin={"l": 8, "r": 14, "t": 24, "b": 8})
    for one in found:
        style = drawn[one.backend]
        meta = {"backend": one.backend}
        if one.backend != "observer":
            meta |= {"qps": one.qps, "cap": one.cap, "start": one.start}
        told = (
            f"<b>{one.backend}</b>, {one.steps} steps<br>1 % {seconds(one.low)}, "
            f"25 % {seconds(one.first)}, median {seconds(one.median)},<br>"
            f"75 % {seconds(one.third)}, 99 % {seconds(one.high)}, longest {seconds(one.most)}"
        )
        drawing.add_trace(go.Box(
            y=[one.backend], q1=[one.first], median=[one.median], q3=[one.third],
            lowerfence=[one.low], upperfence=[one.high], orientation="h", hoverinfo="skip",
            width=0.55, line={"color": style.color, "width": 1.5},
            fillcolor=pale(style.color, 0.18), meta=meta,
        ))
        drawing.add_trace(go.Scatter(
            x=[one.median, one.most], y=[one.backend] * 2, mode="markers",
            marker={"symbol": [style.symbol, "line-ns-open"], "color": style.color,
                    "size": [9, 12], "line": {"width": [0, 2], "color": style.color}},
            text=[told] * 2, hovertemplate="%{text}<extra></extra>", meta=meta,
        ))
    low, high = min(one.low for one in found), max(one.most for one in found)
    drawing.update_layout(
        xaxis=time_axis("time per step", [low, high]),
        yaxis=axis("", type="category", categoryorder="array",
                    categoryarray=[*backends, "observer"], ticks=""),
    )
    if deadline is not None and low <= deadline <= high:
        drawing.add_vline(x=deadline, line={"color": "#555555", "dash": "dot", "width": 1.5})
        drawing.add_annotation(
            x=np.log10(deadline), y=1, yref="paper", text="deadline", showarrow=False,
            xanchor="center", yanchor="bottom",
        )
    return drawing


def performance(found: list[Profile], drawn: Mapping[str, Style]) -> Any:
    """Performance profiles as steps over a logarithmic axis of time ratios."""
    import plotly.graph_objects as go

    if not found:
        return None
    last = last_ratio(found)
    drawing = figure(420)
    for one in found:
        style = drawn[one.backend]
        x, y = one.steps(last)
        drawing.add_trace(go.Scatter(
            x=x, y=y, mode="lines", line={"color": style.color, "dash": style.dash, "width": 2,
                                          "shape": "hv"},
            text=[
                f"<b>{one.words}</b><br>{percent(share)} of {one.problems} problems within "
                f"{number(ratio)} times the fastest"
                for ratio, share in zip(x, y, strict=True)
            ],
            hovertemplate="%{text}<extra></extra>", meta={"backend": one.backend},
        ))
    ticks = [2.0**k for k in range(int(np.ceil(np.log2(last))) + 1)]
    drawing.update_layout(
        xaxis=axis(
            "time relative to the fastest", type="log", tickvals=ticks,
            ticktext=[f"{tick:g}" for tick in ticks], range=[-0.01, np.log10(last)],
        ),
        yaxis=axis("share of problems solved", range=[-0.02, 1.03], tickformat=".0%"),
    )
    return drawing
