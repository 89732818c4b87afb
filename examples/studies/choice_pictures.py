"""The pictures of docs/how-to-choose.md."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from choice_studies import DISTANCES, HORIZONS, OBSERVED, observed, weighed
from choice_tables import SETTLED, Figures
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from qpmhe.plots.style import LIGHT

#: Name, colour, marker and dashes of Okabe and Ito's palette.
PRIORS = (
    ("the zoo's observer, constant weight, 1 QP", "#0072B2", "s", "-"),
    ("the zoo's observer, constant weight, converged", "#56B4E9", "x", ":"),
    ("EKF, constant weight, 2 QPs", "#E69F00", "^", "--"),
    ("EKF, ObserverPrior, 2 QPs", "#D55E00", "o", "-"),
)
#: The widest marker first, so that those which lie on it are seen.
OBSERVERS = (
    ("unscented", "UnscentedKalman", "#CC79A7", "D", 7.0),
    ("extended", "ExtendedKalman", "#D55E00", "o", 5.0),
    ("constant", "design_luenberger", "#009E73", "^", 4.0),
    ("own", "the zoo's", "#0072B2", "s", 3.0),
)


def horizons(figures: Figures, path: Path) -> None:
    """Settled error against N, a panel a model."""

    def of(zoo: str) -> tuple[Callable[[int], float], ...]:
        return (
            lambda N: figures.error(zoo, 1, horizon=N, which=SETTLED),
            lambda N: figures.error(zoo, None, horizon=N, which=SETTLED),
            lambda N: figures.error(zoo, 2, weighed(zoo, "constant"), N, SETTLED),
            lambda N: figures.error(zoo, 2, weighed(zoo, "observer"), N, SETTLED),
        )

    with rc_context(LIGHT):
        figure = Figure((8.4, 4.9), layout="constrained")
        grid = figure.subplots(2, 4, sharex=True, sharey=True)
        for axes, zoo in zip(grid.flat, figures.models, strict=False):
            for (label, color, marker, dashes), error in zip(PRIORS, of(zoo), strict=True):
                axes.plot(
                    HORIZONS, [error(N) for N in HORIZONS], dashes, color=color, marker=marker,
                    markersize=4, linewidth=1.2, label=label,
                )
            scale(axes, zoo, (1.0, 1.5, 2.0, 3.0, 5.0, 10.0))
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(FixedLocator(HORIZONS))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        finish(figure, grid, len(figures.models), "N (samples)", "settled error (ratio)", path)


def observers(figures: Figures, path: Path) -> None:
    """Error over all times against the initial error, a panel a model."""
    zoos = [zoo for zoo in figures.models if zoo in OBSERVED]
    distances = list(DISTANCES.values())
    errors = {
        (zoo, kind, qps): np.array(
            [figures.error(zoo, qps, observed(zoo, kind, d)) for d in distances]
        )
        for zoo in zoos for kind, *_ in OBSERVERS for qps in (0, 2)
    }
    finite = [value for line in errors.values() for value in line if np.isfinite(value)]
    lost = 2.0 * max(finite, default=1.0)
    with rc_context(LIGHT):
        figure = Figure((8.4, 3.1), layout="constrained")
        grid = figure.subplots(1, max(1, len(zoos)), squeeze=False, sharey=True)
        for axes, zoo in zip(grid.flat, zoos, strict=False):
            for kind, name, color, marker, size in OBSERVERS:
                for qps, dashes in ((0, ":"), (2, "-")):
                    line = errors[zoo, kind, qps]
                    axes.plot(
                        range(len(distances)), np.where(np.isinf(line), lost, line), dashes,
                        color=color, marker=marker, markersize=size, linewidth=1.2,
                        markerfacecolor="white" if qps == 0 else color,
                        label=f"{name}, {'alone' if qps == 0 else '2 QPs'}",
                    )
            scale(axes, zoo, (0.5, 1.0, 2.0, 5.0, 10.0), lost if np.isinf([
                line for (model, *_), line in errors.items() if model == zoo
            ]).any() else None)
            axes.set_xticks(range(len(distances)), [f"{d:g}" for d in distances])
        finish(figure, grid, len(zoos), "initial error (units of the zoo's)", "error (ratio)", path)


def scale(axes: Any, title: str, ticks: tuple[float, ...], lost: float | None = None) -> None:
    """A logarithmic axis of ratios with plain numbers, and a word where there is none."""
    axes.set_title(title, fontsize=9)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(FixedLocator(ticks))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    if lost is not None:
        axes.annotate(
            "lost", (1.0, lost), xycoords=("axes fraction", "data"), xytext=(-24, -2),
            textcoords="offset points", ha="right", va="center", color="0.2",
        )


def finish(figure: Figure, grid: Any, used: int, x: str, y: str, path: Path) -> None:
    """Labels, a legend for all panels, and the file."""
    for axes in list(grid.flat)[used:]:
        axes.set_visible(False)
    for axes in grid[-1]:
        axes.set_xlabel(x)
    for row in grid:
        row[0].set_ylabel(y)
    handles, labels = grid.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2 if used > 4 else 4)
    figure.savefig(path, dpi=120, metadata={"Software": None})
