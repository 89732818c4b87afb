"""Axes and colours of the page's figures, with plotly."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from .style import Style
from .words import time_tick

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["axis", "bars", "error_axis", "figure", "log_axis", "pale", "time_axis"]

_INK, _GRID = "#333333", "#ececec"


def figure(height: int, **layout: Any) -> Any:
    """An empty figure of the page's style, of a height in pixels, with more of the layout."""
    import plotly.graph_objects as go

    return go.Figure(layout={
        "template": "none",
        "height": height,
        "autosize": True,
        "showlegend": False,
        "font": {"family": "system-ui, -apple-system, Segoe UI, Roboto, sans-serif",
                 "size": 13, "color": _INK},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 8, "r": 14, "t": 14, "b": 8},
        "hoverlabel": {"align": "left", "bgcolor": "white", "font": {"size": 12}},
        "hovermode": "closest",
        **layout,
    })


def axis(title: str, **more: Any) -> dict[str, Any]:
    """Settings of a linear axis."""
    return {
        "title": {"text": title, "standoff": 10}, "automargin": True, "gridcolor": _GRID,
        "zeroline": False, "linecolor": "#999999", "ticks": "outside", "tickcolor": "#999999",
        "ticklen": 4, **more,
    }


def log_axis(title: str, values: Any, words: Callable[[float], str]) -> dict[str, Any]:
    """A logarithmic axis with ticks in words, as many as find room on a narrow screen."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite) & (finite > 0)]
    low, high = (finite.min(), finite.max()) if finite.size else (1.0, 1.0)
    decades = np.log10(high / low)
    steps = (1, 2, 5) if decades < 1.5 else (1, 3) if decades < 3.5 else (1,)
    powers = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1)
    ticks = [step * 10.0**k for k in powers for step in steps]
    return axis(title, type="log", tickvals=ticks, ticktext=[words(one) for one in ticks])


def time_axis(title: str, values: Any) -> dict[str, Any]:
    """A logarithmic axis of seconds, named in us, ms and s."""
    return log_axis(title, values, time_tick)


def error_axis(title: str, values: Any, **more: Any) -> dict[str, Any]:
    """Logarithmic where the values differ much."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if finite.size and finite.min() > 0 and finite.max() > 8 * finite.min():
        return log_axis(title, finite, "{:g}".format) | more
    return axis(title, **more)


def bars(rows: DataFrame, name: str, style: Style) -> dict[str, Any]:
    """Confidence limits of a metric as error bars, none where runs failed."""
    mean = rows[name].astype(float).where(rows["failures"] == 0)
    return {
        "type": "data", "symmetric": False, "thickness": 1, "width": 0,
        "color": pale(style.color, 0.4),
        "array": (rows[f"{name}_high"] - mean).fillna(0.0),
        "arrayminus": (mean - rows[f"{name}_low"]).fillna(0.0),
    }


def pale(color: str, alpha: float) -> str:
    """A colour let through."""
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha})"
