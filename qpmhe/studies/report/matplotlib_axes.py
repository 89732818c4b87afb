"""Axes, legends and colours of the static figures, with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ...plots.style import LIGHT
from .answers import Case
from .style import Style
from .words import missing, time_tick

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["LIGHT", "error_axis", "legend", "limits", "panel", "plain", "time_axis", "title"]


def plain(value: float, _: Any = None) -> str:
    """A tick without an exponent where that is readable."""
    return f"{value:g}"


def time_axis(axis: Any, low: float, high: float) -> None:
    """Ticks of a logarithmic axis of seconds, named in us, ms and s."""
    from matplotlib.ticker import LogLocator, NullLocator

    decades = np.log10(high / low)
    axis.set_major_locator(
        LogLocator(subs=(1.0, 2.0, 5.0) if decades < 1.7 else (1.0, 3.0) if decades < 3 else (1.0,))
    )
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(time_tick)


def error_axis(axes: Any, values: Any) -> None:
    """Logarithmic where the values differ much, with plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator

    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if finite.size and finite.min() > 0 and finite.max() > 8 * finite.min():
        axes.set_yscale("log")
        wide = finite.max() > 1e3 * finite.min()
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(plain)


def limits(rows: DataFrame, name: str) -> Any:
    """Confidence limits of a metric as matplotlib's error bars (2, k), none where runs failed."""
    mean = rows[name].astype(float).where(rows["failures"] == 0)
    low, high = (mean - rows[f"{name}_low"]).fillna(0.0), (rows[f"{name}_high"] - mean).fillna(0.0)
    return np.array([low, high])


def title(figure: Any, case: Case, more: str) -> None:
    """Name the case above the figure, and what its signs mean."""
    figure.suptitle(f"{case.title}\n{more}", color="0.2", fontsize=9)


def legend(
    figure: Any, names: list[str], drawn: Mapping[str, Style], lines: bool = False
) -> None:
    """A legend of backends below the figure, of markers or of lines with markers."""
    from matplotlib.lines import Line2D

    order = sorted(set(names) - {"observer"}) + (["observer"] if "observer" in names else [])
    figure.legend(
        handles=[
            Line2D(
                [], [], color=drawn[name].color, marker=drawn[name].marker, markersize=5.5,
                linestyle=drawn[name].line if lines else "none", linewidth=1.2, label=name,
            )
            for name in order
        ],
        loc="outside lower center", ncols=min(6, len(order)), fontsize=8,
    )


def panel(qps: Any) -> str:
    """Title of the panel of a number of QPs per sample."""
    return "QPs to convergence" if missing(qps) else f"{int(qps)} QP{'s' * (int(qps) != 1)}"
