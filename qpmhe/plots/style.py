"""The look that all figures share: light ink, and colours that all readers can distinguish."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from io import StringIO
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import finite, shown

from .._checks import positive
from ..errors import InvalidInputError, OptionError, ShapeError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..estimation.run import Run

#: One colour for one thing, in all figures; from Okabe and Ito's palette, as those of the rest.
COLORS = {
    "truth": "#A6A6A6", "measurement": "#56B4E9", "observer": "#222222", "estimate": "#D55E00",
}
#: How estimates are drawn, the first one first; dashes distinguish them, too.
STYLES: tuple[dict[str, Any], ...] = (
    {"color": COLORS["estimate"], "linestyle": "-"},
    {"color": "#0072B2", "linestyle": "--"},
    {"color": "#009E73", "linestyle": "-."},
    {"color": "#CC79A7", "linestyle": ":"},
    {"color": "#E69F00", "linestyle": "-"},
    {"color": "#882255", "linestyle": "--"},
)
#: How the truth, measurements and the observer, whose last steps are the candidate, are drawn.
REAL: dict[str, Any] = {"color": COLORS["truth"], "linewidth": 2.2, "label": "truth"}
MEASURED: dict[str, Any] = {
    "color": COLORS["measurement"], "linestyle": "none", "marker": ".", "markersize": 3.0,
    "label": "measurement",
}
OBSERVER: dict[str, Any] = {"color": COLORS["observer"], "linestyle": "--"}
#: How a band is filled that is proved to hold the truth.
PROVED = "#E3ECF4"
# Inches of one column and of two, and the points of letters in them.
_WIDTHS, _LETTERS = {"single": 84.0 / 25.4, "double": 174.0 / 25.4}, 7.0
#: Parameters of matplotlib.
LIGHT: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": "0.6",
    "axes.grid": True,
    "axes.labelcolor": "0.2",
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 9.0,
    "pdf.fonttype": 42,
    "grid.color": "0.92",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "xtick.color": "0.4",
    "xtick.labelcolor": "0.2",
    "ytick.color": "0.4",
    "ytick.labelcolor": "0.2",
}


def line_styles(labels: Iterable[str]) -> list[dict[str, Any]]:
    """Line styles: fixed for the observer and the estimate, in turn for the others."""
    names = [str(label).lower() for label in labels]
    found: dict[int, dict[str, Any]] = {
        k: OBSERVER for k, name in enumerate(names)
        if name.startswith(("observer", "candidate", "i = 0"))
    }
    first = next((k for k, name in enumerate(names) if name.startswith(("estimate", "mhe"))), None)
    rest = list(STYLES)
    if first is not None:
        found[first] = rest.pop(0)
    return [found[k] if k in found else rest.pop(0) for k in range(len(names))]


def run_times(
    run: Run, dt: float | None, time_label: str | None
) -> tuple[NDArray[np.float64], str]:
    """Times of the states of a run, and the label of their axis: its unit if steps are known.

    The days of Matplotlib where the run has dates, for `date_axis`.
    """
    index = _dates(run, dt)
    if index is not None:
        dates: Any = import_module("matplotlib.dates")
        return np.asarray(dates.date2num(index), np.float64), time_label or ""
    if dt is None and run.elapsed is not None:
        return run.elapsed, time_label or time_words(1.0, run.time_unit)
    return (1.0 if dt is None else positive("dt", dt)) * np.arange(len(run) + 1.0), (
        time_label or time_words(dt, run.time_unit)
    )


def _dates(run: Run, dt: float | None) -> Any:
    """The dates of a run's states; None where it has none, or counts its steps."""
    index: Any = run.index
    return index if dt is None and hasattr(index, "tz") else None


def date_axis(run: Run, dt: float | None, panel: Any) -> None:
    """Label the times of `run_times` as dates, where they are, in the zone of the run's index."""
    index = _dates(run, dt)
    if index is not None:
        dates: Any = import_module("matplotlib.dates")
        locator = dates.AutoDateLocator(tz=index.tz, minticks=3)
        panel.xaxis.set_major_locator(locator)
        panel.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator, tz=index.tz))


def time_words(dt: float | None, unit: str = "s") -> str:
    """The label of an axis of times."""
    return f"time t ({'samples' if dt is None else unit})"


def label_decades(axis: Any) -> None:
    """Label a logarithmic axis also within a decade, where fewer than two decades are in view."""
    low, high = sorted(axis.get_view_interval())
    if axis.get_scale() != "log" or not 0.0 < low < high or np.log10(high / low) >= 2.0:
        return
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def legend_columns(names: Sequence[str], inches: float, most: int) -> int:
    """The number of columns, at most ``most``, of a legend that has room in a figure this wide."""
    for columns in range(min(most, len(names)), 1, -1):
        groups = np.array_split([len(name) for name in names], columns)  # as Matplotlib does
        widths = (0.65 + 0.072 * group.max() for group in groups)
        if sum(widths) <= inches:
            return columns
    return 1


def panels(count: int, axes: Any, height: float = 2.1) -> list[Any]:
    """Axes to draw into: those given, or panels one above the other in a new figure."""
    from matplotlib import rc_context
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    if axes is None:
        # Pyplot shows the figures that it knows: at the end of a notebook's cell, or in windows.
        pyplot = sys.modules.get("matplotlib.pyplot") or _notebooks_pyplot()
        make = Figure if pyplot is None else pyplot.figure
        # Outside of the context, which would undo what a notebook's first figure sets for all.
        figure = make(figsize=(6.4, 0.9 + height * count), layout="constrained")
        with rc_context(LIGHT):
            return list(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0])
    given = list(np.ravel(np.asarray(axes, dtype=object)))
    for one in given:
        if not isinstance(one, Axes):
            raise InvalidInputError(
                f"axes contain {one!r}; expected matplotlib Axes, {count} of them, such as "
                "plt.subplots makes; leave axes out to get a new figure."
            )
    if len(given) != count:
        raise ShapeError(f"axes are {len(given)}; expected {count}, one for each panel.")
    return given


def _notebooks_pyplot() -> Any:
    """Pyplot where a notebook's kernel runs, None elsewhere."""
    if "ipykernel" not in sys.modules:
        return None
    from matplotlib import pyplot

    return pyplot


def save(
    figure: Figure, stem: str | PathLike[str], *, width: str | float | None = None
) -> list[Path]:
    """Write a figure as PNG and SVG, for a paper also as PDF, and return the paths of the files.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        The figure; for axes, ``axes.figure``.
    stem : str or Path
        Path without suffix; its folder is made. ``.png``, ``.svg`` or ``.pdf`` at its end is
        removed; any other dot belongs to the name: ``run_0.5`` gives ``run_0.5.png``.
    width : {"single", "double"} or float, optional
        The width in a paper: a column of 84 mm, two columns of 174 mm, or inches. The files are as
        wide as that, with letters of 7 points, embedded in the PDF.

    Raises
    ------
    InvalidInputError
        If it is not a figure, or the path names no file.
    OptionError
        If the width is neither a name nor in range.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if not isinstance(figure, Figure):
        raise InvalidInputError(
            f"figure is of type {type(figure).__name__}; expected a matplotlib Figure; for axes, "
            "axes.figure."
        )
    try:
        path = Path(stem)
    except TypeError as error:
        raise InvalidInputError(
            f"stem is {stem!r}; expected a path without suffix, such as 'results/states'."
        ) from error
    name = path.stem if path.suffix.lower() in (".png", ".svg", ".pdf") else path.name
    if name in ("", ".."):
        raise InvalidInputError(
            f"stem is {str(stem)!r}, a folder; expected the file's name without suffix as well, "
            "such as 'results/states'."
        )
    inches = inches_of(width)
    path.parent.mkdir(parents=True, exist_ok=True)
    kinds = (".png", ".svg") if inches is None else (".pdf", ".png", ".svg")
    paths = [path.with_name(name + suffix) for suffix in kinds]
    with rc_context(LIGHT), _resized(figure, inches):
        for one in paths:
            figure.savefig(one, dpi=200 if inches is None else 300)
    return paths


def svg(figure: Figure, prefix: str) -> str:
    """A figure as an SVG element of a page, with text as text; the prefix makes its ids unique."""
    from matplotlib import rc_context

    written = StringIO()
    with rc_context(LIGHT):
        figure.savefig(written, format="svg", metadata={"Date": None})
    text = written.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    return re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{prefix}-", text)


def inches_of(width: str | float | None) -> float | None:
    """A width of `save` in inches."""
    if width is None or (isinstance(width, str) and width in _WIDTHS):
        return None if width is None else _WIDTHS[width]
    found = finite(width)
    if found is None or not 1.0 <= found <= 20.0:
        raise OptionError(
            f"width is {shown(width)}; expected 'single' (84 mm), 'double' (174 mm) or inches "
            "from 1 to 20."
        )
    return found


@contextmanager
def _resized(figure: Figure, width: float | None) -> Iterator[None]:
    """Draw a figure in this width meanwhile, with the letters of a paper."""
    from matplotlib.legend import Legend
    from matplotlib.text import Text

    if width is None:
        yield
        return
    size: tuple[float, float] = tuple(figure.get_size_inches())
    texts: list[Any] = figure.findobj(Text)
    fonts = [(text, text.get_fontsize(), text.get_wrap()) for text in texts]
    legends: list[Any] = figure.findobj(Legend)
    boxes = [one._legend_handle_box for one in legends]
    columns = [[(one, list(one.get_children())) for one in box.get_children()] for box in boxes]
    try:
        # Lower than in proportion would squeeze panels between letters that shrink less.
        figure.set_size_inches(width, size[1] * min(1.0, max(width / size[0], 0.7)))
        for text in texts:
            text.set_fontsize(_LETTERS)
        for name in ("_suptitle", "_supxlabel"):
            if (text := getattr(figure, name)) is not None:
                text.set_wrap(True)
        for legend in legends:
            _narrow(legend, figure)
        yield
    finally:
        figure.set_size_inches(size)
        for text, font, wraps in fonts:
            text.set(fontsize=font, wrap=wraps)
        for box, former in zip(boxes, columns, strict=True):
            box._children = [column for column, _ in former]
            for column, items in former:
                column._children = items


def _narrow(legend: Any, figure: Figure) -> None:
    """Give a legend so few columns that it fits; Matplotlib fixes them when it is made."""
    box, most = legend._legend_handle_box, 0.98 * figure.bbox.width
    columns = list(box.get_children())
    items = [item for column in columns for item in column.get_children()]
    for number in range(len(columns), 0, -1):
        parts = np.array_split(np.arange(len(items)), number)
        box._children = columns[:number]
        for column, part in zip(columns, parts, strict=False):
            column._children = [items[k] for k in part]
        if legend.get_window_extent().width <= most:
            return
