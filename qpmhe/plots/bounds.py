"""The error of a run, and its bounds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .._checks import Array
from ..errors import ShapeError
from .style import COLORS, LIGHT, STYLES, panels


def error_and_bounds(
    times: Array, error: Array | None, bounds: Mapping[str, Array], *,
    diameter: float | None = None, time_label: str = "time t", error_label: str = "error",
    axes: Any = None,
) -> Any:
    """Draw the error's length and its bounds over time on a logarithmic axis; return the axes.

    Parameters
    ----------
    times : (T + 1,) array
        Times of the states.
    error : (T + 1,) array or None
        Length of the error; None for bounds alone.
    bounds : mapping of label to (T + 1,) array
        At most five; a `ShapeError` is raised if lengths differ.
    diameter : float, optional
        Diameter of the certified set, above which a bound says nothing.
    time_label, error_label : str
        Labels of the time axis, with its unit, and of the error.
    axes : matplotlib Axes, optional
        Where to draw; a new figure if left out, which `qpmhe.plots.save` can write.
    """
    from matplotlib import rc_context

    curves = dict(bounds) if error is None else {error_label: error, **bounds}
    for label, values in curves.items():
        if np.shape(values) != np.shape(times):
            raise ShapeError(
                f"{label!r} has shape {np.shape(values)}; expected {np.shape(times)}, a value for "
                "each time."
            )
    shown = {label: _shown(values) for label, values in curves.items()}
    ends = [value for each in shown.values() for value in each[np.isfinite(each)]]
    with rc_context(LIGHT):
        (drawn,) = panels(1, axes, 3.4)
        drawn.set_yscale("log")
        if diameter is not None:
            drawn.axhline(diameter, color="0.75", linewidth=0.8)
            drawn.annotate(
                "diameter of the certified set: above, a bound says nothing",
                (times[-1], diameter), xytext=(-3, -3), textcoords="offset points", color="0.45",
                fontsize=8, ha="right", va="top",
            )
        if error is not None:
            drawn.plot(
                times, shown[error_label], color=COLORS["estimate"], linewidth=1.1,
                label=error_label,
            )
        for style, label in zip(STYLES[1:], bounds, strict=False):
            drawn.plot(times, shown[label], linewidth=1.4, label=label, **style)
        if ends:
            drawn.set_ylim(0.5 * min(ends), 3.0 * max(*ends, diameter or 0.0))
        drawn.margins(x=0.01)
        drawn.set_xlabel(time_label)
        drawn.set_ylabel("length of the error, |x - x̂|")
        drawn.figure.legend(loc="outside upper center", ncols=2)
    return drawn


def _shown(values: Array) -> Array:
    """What a logarithmic axis can show."""
    return np.where(np.isfinite(values) & (values > 0.0), values, np.nan)
