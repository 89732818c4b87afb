"""Static figures of times: distribution and performance profiles, with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from .answers import Case
from .matplotlib_axes import LIGHT, plain, time_axis, title
from .profile import SOLVED, Profile, last_ratio
from .style import Style
from .times import spreads
from .words import percent, usual_first

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

__all__ = ["performance", "times"]


def performance(found: list[Profile], drawn: Mapping[str, Style]) -> Figure | None:
    """Performance profiles, if there are any."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if not found:
        return None
    last = last_ratio(found)
    with rc_context(LIGHT):
        figure = Figure(figsize=(7.2, 4.2), layout="constrained")
        axes = figure.subplots()
        for one in found:
            style, (x, y) = drawn[one.backend], one.steps(last)
            axes.step(
                x, y, where="post", color=style.color, linestyle=style.line, linewidth=1.5,
                label=one.words,
            )
        axes.set_xscale("log", base=2)
        axes.set_xlim(0.99, last)
        axes.xaxis.set_major_formatter(plain)
        axes.set_ylim(-0.02, 1.03)
        axes.yaxis.set_major_formatter(lambda share, _: f"{share:.0%}")
        axes.set_xlabel("time relative to the fastest backend on the problem")
        axes.set_ylabel(f"share of {found[0].problems} problems solved")
        axes.set_title(
            f"Solved: J on average within {percent(SOLVED)} of the converged one", color="0.2",
            fontsize=9, loc="left",
        )
        figure.legend(loc="outside right center", fontsize=8)
    return figure


def times(
    case: Case, cells: DataFrame, drawn: Mapping[str, Style], deadline: float | None
) -> Figure | None:
    """Step times without a cap, a panel for each number of QPs per sample."""
    from matplotlib.figure import Figure

    found = [one for one in spreads(cells) if one.cap == "none"]
    start = min((one.start for one in found), key=usual_first, default="")
    found = [one for one in found if one.start == start]
    words = list(dict.fromkeys(one.qps for one in found if one.backend != "observer"))
    if not words:
        return None
    words.sort(key=lambda word: (not word.isdigit(), word.zfill(9)))
    names = sorted({one.backend for one in found} - {"observer"}, reverse=True)
    names = ["observer", *names] if any(one.backend == "observer" for one in found) else names
    figure = Figure(
        figsize=(1.6 + 2.3 * max(2, len(words)), 1.5 + 0.27 * len(names)), layout="constrained"
    )
    panels = figure.subplots(1, len(words), sharey=True, sharex=True, squeeze=False)[0]
    low, high = min(one.low for one in found), max(one.most for one in found)
    for axes, word in zip(panels, words, strict=True):
        for one in found:
            if one.qps != word and one.backend != "observer":
                continue
            style, place = drawn[one.backend], names.index(one.backend)
            axes.plot([one.low, one.high], [place] * 2, color=style.color, linewidth=0.9)
            axes.barh(
                place, one.third - one.first, left=one.first, height=0.55, color=style.color,
                alpha=0.25, edgecolor=style.color,
            )
            axes.plot(one.median, place, style.marker, color=style.color, markersize=4.5)
            axes.plot(one.most, place, "|", color=style.color, markersize=7)
        if deadline is not None:
            axes.axvline(deadline, color="0.35", linestyle=":", linewidth=1.0)
        axes.set_xscale("log")
        axes.set_xlim(0.85 * low, 1.15 * high)
        time_axis(axes.xaxis, low, high)
        axes.tick_params(axis="x", labelrotation=45)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
        axes.set_title(
            "QPs to convergence" if word == "converged" else f"{word} QP{'s' * (word != '1')}",
            fontsize=9, color="0.2",
        )
    panels[0].set_yticks(range(len(names)), names)
    figure.supxlabel(
        "time per step (box: quartiles; whiskers: 1 % and 99 %; tick: longest)"
        + ("" if deadline is None else "; dotted: deadline"), fontsize=9, color="0.2",
    )
    title(figure, case, "no cap on the solver"
          + (f"; start {start}" if cells["start"].nunique() > 1 else ""))
    return figure
