"""A figure described once, and drawn with plotly.js for the page and with matplotlib for files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...plots import COLORS
from .words import percent, time_tick

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INK, _GRID, _LINE = "#333333", "#ececec", "#999999"
# Inches below which a legend has no room beside the panels.
_NARROW = 5.0


@dataclass(frozen=True)
class Style:
    """How a backend looks: a colour, and shape and dash for plotly, matplotlib and text."""

    color: str
    symbol: str
    marker: str
    glyph: str
    dash: str
    line: Any


# Okabe and Ito's without black, which the observer has, and yellow, which is lost on white.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# One more shape than colours: no pair comes again before 42 backends.
_SHAPES = (
    ("circle", "o", "●"), ("square", "s", "■"), ("diamond", "D", "◆"), ("triangle-up", "^", "▲"),
    ("cross", "P", "✚"), ("x", "X", "✖"), ("triangle-down", "v", "▼"),
)
_DASHES: tuple[tuple[str, Any], ...] = (
    ("solid", "-"), ("dash", "--"), ("dot", ":"), ("dashdot", "-."), ("longdash", (0, (9, 3))),
)
_OBSERVER = Style(COLORS["observer"], "star", "*", "★", "dash", "--")


def styles(backends: Iterable[str]) -> dict[str, Style]:
    """A style for each name in this order, and the observer's."""
    found = {}
    names = dict.fromkeys(str(one) for one in backends)
    for place, name in enumerate(one for one in names if one != "observer"):
        symbol, marker, glyph = _SHAPES[place % len(_SHAPES)]
        dash, line = _DASHES[place % len(_DASHES)]
        color = _COLORS[place % len(_COLORS)]
        found[name] = Style(color, symbol, marker, glyph, dash, line)
    return {**found, "observer": _OBSERVER}


@dataclass(frozen=True)
class Axis:
    """An axis, whose ticks follow from its kind and its values, or categories.

    Kinds: "linear"; "time", logarithmic seconds; "error", logarithmic where values differ much;
    "ratio", logarithmic from 1; "share"; "category"; "values", with a tick at each, logarithmic
    where they differ much.
    """

    title: str
    kind: str
    values: Sequence[Any] = ()

    def limits(self) -> tuple[float, float]:
        """The least and the largest finite value."""
        values = np.asarray(self.values, dtype=float)
        values = values[np.isfinite(values)]
        return (float(values.min()), float(values.max())) if values.size else (1.0, 1.0)

    def ticks(self) -> list[tuple[float, str]]:
        """Values and words of the ticks; none where the drawing program chooses them."""
        if self.kind == "values":
            return [(value, f"{value:g}") for value in self.values]
        if self.kind not in ("time", "error", "ratio"):
            return []
        low, high = self.limits()
        if self.kind == "ratio":
            powers = range(int(np.ceil(np.log2(high))) + 1)
            return [(2.0**k, f"{2**k:g}") for k in powers]
        if low <= 0.0 or (self.kind == "error" and high <= 8 * low):
            return []
        decades = np.log10(high / low)
        steps = (1, 2, 5) if decades < 1.6 else (1, 3) if decades < 3.2 else (1,)
        powers = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1)
        words = time_tick if self.kind == "time" else "{:g}".format
        return [(step * 10.0**k, words(step * 10.0**k)) for k in powers for step in steps]


@dataclass(frozen=True)
class Mark:
    """A series in the style of its backend.

    Kinds: "points", "line" (with markers), "level" (a horizontal line), "steps", "curve" (a plain
    line), "box" (one box of quartiles; x has the quantiles 0.01, 0.25, 0.5, 0.75, 0.99, 1) and
    "front" (ringed points joined by steps). ``hover``, ``sizes`` (radius in points), ``hollow`` and
    ``pale`` have an entry per point; ``bars`` are the lengths of error bars below and above. The
    page's menus and the columns of a file choose by ``meta``; ``label`` is for a legend.
    """

    kind: str
    x: Sequence[Any]
    y: Sequence[Any]
    backend: str = ""
    hover: Sequence[str] = ()
    bars: tuple[Sequence[float], Sequence[float]] | None = None
    sizes: Sequence[float] = ()
    hollow: Sequence[bool] = ()
    pale: Sequence[bool] = ()
    meta: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""


@dataclass(frozen=True)
class Panel:
    """Marks on a pair of axes."""

    x: Axis
    y: Axis
    marks: list[Mark]


@dataclass(frozen=True)
class Drawing:
    """Panels one above the other; ``height`` in pixels, ``deadline`` a vertical line.

    ``note`` stands below the figure in a file, in place of the axes' titles; ``gap`` is between
    two panels, relative to their height.
    """

    panels: list[Panel]
    height: int
    deadline: float | None = None
    note: str = ""
    gap: float = 0.22

    def choose(self, **meta: Any) -> Drawing:
        """The marks that have these values, or none of these keys."""
        def fits(mark: Mark) -> bool:
            return all(mark.meta.get(key, value) == value for key, value in meta.items())

        panels = [Panel(one.x, one.y, [*filter(fits, one.marks)]) for one in self.panels]
        return replace(self, panels=panels)


def interactive(drawing: Drawing | None, drawn: Mapping[str, Style]) -> dict[str, Any] | None:
    """The figure, if there is one, as plotly.js takes it, in plain lists and numbers."""
    if drawing is None:
        return None
    count = len(drawing.panels)
    layout: dict[str, Any] = {
        "height": drawing.height, "autosize": True, "showlegend": False,
        "font": {"family": "system-ui, -apple-system, Segoe UI, Roboto, sans-serif",
                 "size": 13, "color": _INK},
        "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 8, "r": 14, "t": 24, "b": 8},
        "hoverlabel": {"align": "left", "bgcolor": "white", "font": {"size": 12}},
        "hovermode": "closest",
        # Its own background would be the opposite of a page that it takes for black.
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#8a8a8a", "activecolor": _INK},
    }
    data: list[dict[str, Any]] = []
    part = 1 / (count + drawing.gap * (count - 1))
    for place, panel in enumerate(drawing.panels):
        suffix = str(place + 1) if place else ""
        top = 1 - place * (1 + drawing.gap) * part
        layout[f"xaxis{suffix}"] = {**_plotly_axis(panel.x), "anchor": f"y{suffix}"}
        layout[f"yaxis{suffix}"] = {
            **_plotly_axis(panel.y), "domain": [max(0.0, top - part), min(1.0, top)]
        }
        data += [
            {**trace, "xaxis": f"x{suffix}", "yaxis": f"y{suffix}"} for mark in panel.marks
            for trace in _traces(mark, drawn.get(mark.backend, _OBSERVER))
        ]
    low, high = drawing.panels[0].x.limits() if drawing.deadline else (1.0, 0.0)
    if drawing.deadline is not None and low <= drawing.deadline <= high:
        layout["shapes"] = [{
            "type": "line", "x0": drawing.deadline, "x1": drawing.deadline, "yref": "paper",
            "y0": 0, "y1": 1, "line": {"color": "#555555", "dash": "dot", "width": 1.5},
        }]
        layout["annotations"] = [{
            "x": float(np.log10(drawing.deadline)), "y": 1, "yref": "paper", "text": "deadline",
            "showarrow": False, "xanchor": "center", "yanchor": "bottom",
        }]
    return {"data": data, "layout": layout}


def _plotly_axis(axis: Axis) -> dict[str, Any]:
    found: dict[str, Any] = {
        "title": {"text": axis.title, "standoff": 10}, "automargin": True, "gridcolor": _GRID,
        "zeroline": False, "linecolor": _LINE, "ticks": "outside", "tickcolor": _LINE,
        "ticklen": 4,
    }
    if axis.kind == "category":
        found |= {"type": "category", "categoryorder": "array", "categoryarray": [*axis.values]}
    elif axis.kind == "share":
        found |= {"range": [-0.02, 1.03], "tickformat": ".0%"}
    elif ticks := axis.ticks():
        found |= {"type": "log", "tickvals": [value for value, _ in ticks],
                  "ticktext": [words for _, words in ticks]}
        if axis.kind == "ratio":
            found["range"] = [-0.01, float(np.log10(axis.limits()[1]))]
    return found


def _traces(mark: Mark, style: Style) -> list[dict[str, Any]]:
    color = style.color
    base: dict[str, Any] = {"type": "scatter", "meta": {**mark.meta}}
    if mark.hover:
        base |= {"text": [*mark.hover], "hovertemplate": "%{text}<extra></extra>"}
    else:
        base["hoverinfo"] = "skip"
    x, y = _plain(mark.x), _plain(mark.y)
    if mark.bars is not None:
        base["error_y"] = {
            "type": "data", "symmetric": False, "thickness": 1, "width": 0,
            "color": _faint(color, 0.4), "arrayminus": _plain(mark.bars[0]),
            "array": _plain(mark.bars[1]),
        }
    if mark.kind == "front":
        ring = {"size": 23, "color": "rgba(0,0,0,0)", "line": {"color": "#555555", "width": 1.2}}
        line = {"color": _LINE, "width": 1.5, "shape": "hv"}
        return [{**base, "x": x, "y": y, "mode": "lines", "line": line},
                {**base, "x": x, "y": y, "mode": "markers", "marker": ring}]
    if mark.kind == "points":
        return [{**base, "x": x, "y": y, "mode": "markers", "marker": {
            "color": color,
            "opacity": [0.3 if pale else 0.9 for pale in mark.pale],
            "symbol": [style.symbol + ("-open" if hollow else "") for hollow in mark.hollow],
            "size": [1.6 * size for size in mark.sizes],
            "line": {"width": [1.8 if hollow else 0 for hollow in mark.hollow], "color": color},
        }}]
    if mark.kind == "box":
        low, first, median, third, high, most = x
        return [
            {**base, "type": "box", "orientation": "h", "y": y, "q1": [first], "median": [median],
             "q3": [third], "lowerfence": [low], "upperfence": [high], "width": 0.55,
             "line": {"color": color, "width": 1.5}, "fillcolor": _faint(color, 0.18),
             "hoverinfo": "skip"},
            {**base, "x": [median, most], "y": y * 2, "mode": "markers",
             "text": [*mark.hover] * 2,
             "marker": {"symbol": [style.symbol, "line-ns-open"], "color": color,
                        "size": [9, 12], "line": {"width": [0, 2], "color": color}}},
        ]
    line = {"color": color, "width": 1.5, "dash": style.dash}
    if mark.kind == "steps":
        line |= {"width": 2, "shape": "hv"}
    trace = {**base, "x": x, "y": y, "mode": "lines", "line": line}
    if mark.kind == "line":
        trace |= {"mode": "lines+markers",
                  "marker": {"color": color, "symbol": style.symbol, "size": 9}}
    return [trace]


def _plain(values: Sequence[Any]) -> list[Any]:
    """A list for JSON, in which what is not finite is None."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        return list(values)
    return [one if np.isfinite(one) else None for one in array.tolist()]


def _faint(color: str, alpha: float) -> str:
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha})"


def static(
    drawing: Drawing, drawn: Mapping[str, Style], size: tuple[float, float], title: str,
    columns: Sequence[tuple[str, Mapping[str, Any]]] = (("", {}),),
) -> Figure:
    """The figure with matplotlib: a row for each panel, a column for each choice of marks."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from ...plots.style import LIGHT

    with rc_context(LIGHT):
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(
            len(drawing.panels), len(columns), sharex=True, sharey="row", squeeze=False
        )
        for column, (heading, choice) in enumerate(columns):
            chosen = drawing.choose(**choice).panels
            for row, panel in enumerate(chosen):
                axes = grid[row, column]
                for mark in panel.marks:
                    _draw(axes, mark, panel, drawn.get(mark.backend, _OBSERVER))
                _set_axis(axes, "x", panel.x)
                _set_axis(axes, "y", panel.y)
                if drawing.deadline is not None:
                    axes.axvline(drawing.deadline, color="0.35", linestyle=":", linewidth=1.0)
                if row == 0:
                    axes.set_title(heading, fontsize=9, color="0.2")
                if row == len(chosen) - 1 and not drawing.note:
                    axes.set_xlabel(panel.x.title)
                if column == 0:
                    axes.set_ylabel(panel.y.title)
        figure.suptitle(title, color="0.2", fontsize=9)
        if drawing.note:
            figure.supxlabel(drawing.note, fontsize=9, color="0.2")
        _legends(figure, drawing, drawn)
    return figure


def _draw(axes: Any, mark: Mark, panel: Panel, style: Style) -> None:
    color, dash = style.color, style.line
    x = _positions(panel.x, mark.x) if mark.kind != "box" else mark.x
    y = _positions(panel.y, mark.y)
    if mark.bars is not None:
        axes.errorbar(x, y, yerr=mark.bars, fmt="none", ecolor=color, elinewidth=0.5, alpha=0.5)
    if mark.kind == "front":
        axes.step(x, y, where="post", color="0.6", linewidth=1.2)
        axes.scatter(x, y, s=190, facecolors="none", edgecolors="0.35", linewidths=0.9)
        for number, point in enumerate(zip(x, y, strict=True), start=1):
            axes.annotate(str(number), point, xytext=(0, 9), ha="center", color="0.2", fontsize=8,
                          textcoords="offset points")
    elif mark.kind == "points":
        for px, py, size, hollow, pale in zip(
            x, y, mark.sizes, mark.hollow, mark.pale, strict=True
        ):
            axes.scatter(
                px, py, marker=style.marker, s=size**2, edgecolors=color, linewidths=1.0,
                facecolors="none" if hollow else color, alpha=0.3 if pale else 0.9,
            )
    elif mark.kind == "box":
        low, first, median, third, high, most = x
        axes.plot([low, high], y * 2, color=color, linewidth=0.9)
        axes.barh(y, third - first, left=first, height=0.55, color=color, alpha=0.25,
                  edgecolor=color)
        axes.plot(median, y[0], style.marker, color=color, markersize=4.5)
        axes.plot(most, y[0], "|", color=color, markersize=7)
    elif mark.kind == "steps":
        axes.step(x, y, where="post", color=color, linestyle=dash, linewidth=1.5)
    elif mark.kind == "level":
        axes.axhline(y[0], color=color, linestyle="--", linewidth=1.2)
    else:
        axes.plot(x, y, color=color, linestyle=dash, marker=style.marker, markersize=4.5,
                  linewidth=1.0)


def _positions(axis: Axis, values: Sequence[Any]) -> list[Any]:
    return [axis.values.index(one) for one in values] if axis.kind == "category" else [*values]


def _set_axis(axes: Any, name: str, axis: Axis) -> None:
    from matplotlib.ticker import NullLocator

    line = getattr(axes, f"{name}axis")
    if axis.kind == "category":
        line.set_ticks(range(len(axis.values)), [*axis.values])
        axes.margins(**{name: 0.12 if name == "x" else 0.05})
    elif axis.kind == "share":
        getattr(axes, f"set_{name}lim")(-0.02, 1.03)
        line.set_major_formatter(lambda share, _: percent(round(share, 3)))
    elif ticks := axis.ticks():
        low, high = axis.limits()
        if axis.kind != "values" or high > 8.0 * low > 0.0:
            getattr(axes, f"set_{name}scale")("log")
        if axis.kind == "ratio":
            getattr(axes, f"set_{name}lim")(0.99, high)
        else:
            low, high = getattr(axes, f"get_{name}lim")()
        shown = [(value, words) for value, words in ticks if low <= value <= high]
        line.set_ticks([value for value, _ in shown], [words for _, words in shown])
        line.set_minor_locator(NullLocator())


def _legends(figure: Any, drawing: Drawing, drawn: Mapping[str, Style]) -> None:
    from matplotlib.lines import Line2D

    marks = [mark for panel in drawing.panels for mark in panel.marks]
    kinds = {mark.kind for mark in marks}
    beside: list[Any] = []
    for mark in marks:
        if mark.kind == "front":
            beside = [
                Line2D([], [], linestyle="none", marker=f"${number}$", color="0.2", markersize=6,
                       label=words)
                for number, words in enumerate(mark.hover, start=1)
            ]
        elif mark.label:
            style = drawn[mark.backend]
            beside.append(Line2D([], [], color=style.color, linestyle=style.line, label=mark.label))
    if beside:
        narrow = figure.get_figwidth() < _NARROW
        (figure.axes[0] if narrow else figure).legend(
            handles=beside, loc="best" if narrow else "outside right center", fontsize=8,
            title_fontsize=8, title="Pareto front" if "front" in kinds else None,
        )
    if kinds & {"points", "line"}:
        present = {mark.backend for mark in marks} - {""}
        names = [name for name in drawn if name in present]
        plain = present - {mark.backend for mark in marks if mark.kind != "level"}
        figure.legend(
            handles=[
                Line2D([], [], color=drawn[name].color, markersize=5.5, label=name, linewidth=1.2,
                       marker="none" if name in plain else drawn[name].marker,
                       linestyle=drawn[name].line if "line" in kinds else "none")
                for name in names
            ],
            loc="outside lower center", ncols=min(6, len(names)), fontsize=8,
        )
