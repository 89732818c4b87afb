"""Figures. Matplotlib is imported when the first one is drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["save", "trajectories"]

Array = NDArray[np.float64]

# Okabe and Ito's palette, told apart by all colour vision; dashes tell the rest.
_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#D55E00", "linestyle": "-"},
    {"color": "#0072B2", "linestyle": "--"},
    {"color": "#009E73", "linestyle": "-."},
    {"color": "#CC79A7", "linestyle": ":"},
    {"color": "#E69F00", "linestyle": "-"},
    {"color": "#56B4E9", "linestyle": "--"},
)
_LIGHT: Any = {
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


def trajectories(
    times: Array,
    truth: Array,
    estimates: Mapping[str, Array],
    labels: Sequence[str],
    time_label: str,
) -> Figure:
    """True states and estimates over time, one panel a state, as in the paper's figure.

    Parameters
    ----------
    times : (T + 1,) array
        Times of the states.
    truth : (T + 1, n) array
        The real states.
    estimates : mapping of label to (T + 1, n) array
        At most six estimates, drawn in this order.
    labels : sequence of str
        Axis labels of the states, with units.
    time_label : str
        Label of the time axis, with its unit.

    Returns
    -------
    matplotlib.figure.Figure
        Not shown yet; see `save`.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    n = truth.shape[1]
    with rc_context(_LIGHT):
        figure = Figure(figsize=(6.4, 1.2 + 2.1 * n), layout="constrained")
        panels = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
        for j, panel in enumerate(panels):
            panel.plot(times, truth[:, j], color="0.25", linewidth=2.2, alpha=0.5, label="real")
            for style, (label, states) in zip(_STYLES, estimates.items(), strict=False):
                panel.plot(times, states[:, j], linewidth=1.3, label=label, **style)
            panel.set_ylabel(labels[j])
            panel.margins(x=0.01)
        panels[-1].set_xlabel(time_label)
        handles, names = panels[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper center", ncols=min(len(names), 5))
    return figure


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure as PNG and SVG.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        The figure.
    stem : Path
        Path without suffix; its folder is made.

    Returns
    -------
    list of Path
        The files.
    """
    from matplotlib import rc_context

    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = [stem.with_suffix(".png"), stem.with_suffix(".svg")]
    with rc_context(_LIGHT):
        for path in paths:
            figure.savefig(path, dpi=200)
    return paths
