"""The look that all figures share: light ink, and colours that all readers can distinguish."""

from __future__ import annotations

import sys
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InvalidInputError, ShapeError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's palette; dashes distinguish the rest.
STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#D55E00", "linestyle": "-"},
    {"color": "#0072B2", "linestyle": "--"},
    {"color": "#009E73", "linestyle": "-."},
    {"color": "#CC79A7", "linestyle": ":"},
    {"color": "#E69F00", "linestyle": "-"},
    {"color": "#56B4E9", "linestyle": "--"},
)
#: How the truth is drawn.
REAL: dict[str, Any] = {"color": "0.25", "linewidth": 2.2, "alpha": 0.5, "label": "real"}
#: How a band is filled that is proved to hold the truth.
PROVED = "#E3ECF4"
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
    "grid.color": "0.92",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "xtick.color": "0.4",
    "xtick.labelcolor": "0.2",
    "ytick.color": "0.4",
    "ytick.labelcolor": "0.2",
}


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
                "plt.subplots makes; leave axes out for a figure of its own."
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


def save(figure: Figure, stem: str | PathLike[str]) -> list[Path]:
    """Write a figure as PNG and SVG, and return the paths of the files.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        The figure; of axes, ``axes.figure``.
    stem : str or Path
        Path without suffix; its folder is made. ``.png`` or ``.svg`` at its end is taken off,
        any other dot belongs to the name: of ``run_0.5`` comes ``run_0.5.png``.

    Raises
    ------
    InvalidInputError
        If the figure is none, or the path names no file.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if not isinstance(figure, Figure):
        raise InvalidInputError(
            f"figure is of type {type(figure).__name__}; expected a matplotlib Figure: of axes, "
            "axes.figure."
        )
    try:
        path = Path(stem)
    except TypeError as error:
        raise InvalidInputError(
            f"stem is {stem!r}; expected a path without suffix, such as 'results/states'."
        ) from error
    name = path.stem if path.suffix.lower() in (".png", ".svg") else path.name
    if name in ("", ".."):
        raise InvalidInputError(
            f"stem is {str(stem)!r}, a folder; expected the file's name without suffix as well, "
            "such as 'results/states'."
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    paths = [path.with_name(name + suffix) for suffix in (".png", ".svg")]
    with rc_context(LIGHT):
        for one in paths:
            figure.savefig(one, dpi=200)
    return paths
