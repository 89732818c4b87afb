"""A figure described in words and numbers, drawn with Matplotlib for the page and for files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from ...plots import COLORS
from ...plots.style import LIGHT, legend_columns, svg
from .words import percent, time_tick

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Inches below which a legend has no room beside the panels.
_NARROW = 5.0
# A panel of fewer inches has room for fewer ticks.
_FEW_TICKS = 3.5


@dataclass(frozen=True)
class Style:
    """How a backend looks: its colour, shape, shape as a letter, and dashes."""

    color: str
    marker: str
    glyph: str
    line: Any


# Okabe and Ito's without black, which the observer has, and yellow, which is lost on white.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# One more shape than colours: no pair comes again before 42 backends.
_SHAPES = (
    ("o", "●"), ("s", "■"), ("D", "◆"), ("^", "▲"), ("P", "✚"), ("X", "✖"), ("v", "▼"),
)
_DASHES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (9, 3)))
_OBSERVER = Style(COLORS["observer"], "*", "★", "--")


def styles(backends: Iterable[str]) -> dict[str, Style]:
    """A style for each name in this order, and the observer's."""
    found = {}
    names = dict.fromkeys(str(one) for one in backends)
    for place, name in enumerate(one for one in names if one != "observer"):
        marker, glyph = _SHAPES[place % len(_SHAPES)]
        line, color = _DASHES[place % len(_DASHES)], _COLORS[place % len(_COLORS)]
        found[name] = Style(color, marker, glyph, line)
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

    def ticks(self, narrow: bool = False) -> list[tuple[float, str]]:
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
        decades = np.log10(high / low) * (1.6 if narrow else 1.0)
        steps = (1, 2, 5) if decades < 1.6 else (1, 3) if decades < 3.2 else (1,)
        powers = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1)
        words = time_tick if self.kind == "time" else "{:g}".format
        return [(step * 10.0**k, words(step * 10.0**k)) for k in powers for step in steps]


@dataclass(frozen=True)
class PlotMark:
    """A series in the style of its backend.

    Kinds: "points", "line" (with markers), "level" (a horizontal line), "steps", "curve" (a plain
    line), "box" (one box of quartiles; x has the quantiles 0.01, 0.25, 0.5, 0.75, 0.99, 1) and
    "front" (ringed points joined by steps, whose words are the legend). ``words``, ``sizes``
    (diameters in points), ``hollow`` and ``pale`` have an entry per point; ``bars`` are the lengths
    of error bars below and above. Columns of a figure choose by ``meta``; ``label`` is for a
    legend.
    """

    kind: str
    x: Sequence[Any]
    y: Sequence[Any]
    backend: str = ""
    words: Sequence[str] = ()
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
    marks: list[PlotMark]


@dataclass(frozen=True)
class Drawing:
    """Panels one above the other; ``deadline`` is a vertical line.

    ``note`` stands below the figure, in place of the axes' titles.
    """

    panels: list[Panel]
    deadline: float | None = None
    note: str = ""

    def choose(self, **meta: Any) -> Drawing:
        """The marks that have these values, or none of these keys."""
        def fits(mark: PlotMark) -> bool:
            return all(mark.meta.get(key, value) == value for key, value in meta.items())

        panels = [Panel(one.x, one.y, [*filter(fits, one.marks)]) for one in self.panels]
        return replace(self, panels=panels)


@dataclass
class Picture:
    """A figure, and the backend and the words that a page gives to the marks with these ids."""

    figure: Figure
    marks: dict[str, tuple[str, str]] = field(default_factory=dict)

    def tag(self, artist: Any, backend: str, words: str = "") -> None:
        """Give an artist an id."""
        name = f"mark-{len(self.marks)}"
        artist.set_gid(name)
        self.marks[name] = backend, words

    def element(self, prefix: str) -> str:
        """The figure as SVG for a page: marks name their backend, and tell their words."""
        def marked(found: re.Match[str]) -> str:
            backend, words = (escape(one) for one in self.marks[found[1]])
            return f'<g data-backend="{backend}">' + (f"<title>{words}</title>" if words else "")

        return re.sub(rf'<g id="{prefix}-(mark-\d+)">', marked, svg(self.figure, prefix))


def draw(
    drawing: Drawing, drawn: Mapping[str, Style], size: tuple[float, float], title: str,
    columns: Sequence[tuple[str, Mapping[str, Any]]] = (("", {}),),
) -> Picture:
    """The figure: a row for each panel, a column for each choice of marks."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(LIGHT):
        figure = Figure(figsize=size, layout="constrained")
        picture = Picture(figure)
        grid = figure.subplots(
            len(drawing.panels), len(columns), sharex=True, sharey="row", squeeze=False
        )
        for column, (heading, choice) in enumerate(columns):
            chosen = drawing.choose(**choice).panels
            for row, panel in enumerate(chosen):
                axes = grid[row, column]
                for mark in panel.marks:
                    _draw(picture, axes, mark, panel, drawn.get(mark.backend, _OBSERVER))
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
    return picture


def _draw(picture: Picture, axes: Any, mark: PlotMark, panel: Panel, style: Style) -> None:
    color, dash = style.color, style.line
    x = _positions(panel.x, mark.x) if mark.kind != "box" else mark.x
    y = _positions(panel.y, mark.y)
    lines: list[Any] = []
    if mark.bars is not None:
        lines += axes.errorbar(
            x, y, yerr=mark.bars, fmt="none", ecolor=color, elinewidth=0.5, alpha=0.5
        )[2]
    if mark.kind == "front":
        axes.step(x, y, where="post", color="0.6", linewidth=1.2)
        axes.scatter(x, y, s=190, facecolors="none", edgecolors="0.35", linewidths=0.9)
        for number, point in enumerate(zip(x, y, strict=True), start=1):
            axes.annotate(str(number), point, xytext=(0, 9), ha="center", color="0.2", fontsize=8,
                          textcoords="offset points")
    elif mark.kind == "points":
        for px, py, size, hollow, pale, words in zip(
            x, y, mark.sizes, mark.hollow, mark.pale, mark.words, strict=True
        ):
            picture.tag(axes.scatter(
                px, py, marker=style.marker, s=size**2, edgecolors=color, linewidths=1.0,
                facecolors="none" if hollow else color, alpha=0.3 if pale else 0.9,
            ), mark.backend, words)
    elif mark.kind == "box":
        low, first, median, third, high, most = x
        (box,) = axes.barh(y, third - first, left=first, height=0.55, color=color, alpha=0.25,
                           edgecolor=color)
        picture.tag(box, mark.backend, mark.words[0])
        lines += [
            *axes.plot([low, high], y * 2, color=color, linewidth=0.9),
            *axes.plot(median, y[0], style.marker, color=color, markersize=4.5),
            *axes.plot(most, y[0], "|", color=color, markersize=7),
        ]
    elif mark.kind == "steps":
        lines += axes.step(x, y, where="post", color=color, linestyle=dash, linewidth=1.5)
    elif mark.kind == "level":
        lines.append(axes.axhline(y[0], color=color, linestyle="--", linewidth=1.2))
    else:
        lines += axes.plot(x, y, color=color, linestyle=dash, marker=style.marker, markersize=4.5,
                           linewidth=1.0)
    for line in lines:
        picture.tag(line, mark.backend, mark.label)


def _positions(axis: Axis, values: Sequence[Any]) -> list[Any]:
    return [axis.values.index(one) for one in values] if axis.kind == "category" else [*values]


def _panel_width(axes: Any) -> float:
    """Inches for a panel and its labels."""
    return float(axes.figure.get_figwidth() / axes.get_gridspec().ncols)


def _set_axis(axes: Any, name: str, axis: Axis) -> None:
    from matplotlib.ticker import NullLocator

    line = getattr(axes, f"{name}axis")
    if axis.kind == "category":
        line.set_ticks(range(len(axis.values)), [*axis.values])
        axes.margins(**{name: 0.12 if name == "x" else 0.05})
    elif axis.kind == "share":
        getattr(axes, f"set_{name}lim")(-0.02, 1.03)
        line.set_major_formatter(lambda share, _: percent(round(share, 3)))
    elif ticks := axis.ticks(name == "x" and _panel_width(axes) < _FEW_TICKS):
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
                for number, words in enumerate(mark.words, start=1)
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
                       linestyle="none" if "line" not in kinds else
                       "--" if name in plain else drawn[name].line)
                for name in names
            ],
            loc="outside lower center", fontsize=8,
            ncols=legend_columns(names, figure.get_figwidth(), 6),
        )
