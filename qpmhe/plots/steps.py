"""The steps of a run: costs, outcomes, times."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .._checks import positive
from ..estimation.estimate import Status
from .checks import check_run
from .style import COLORS, OBSERVER, STYLES, date_axis, label_decades, panels, run_times

if TYPE_CHECKING:
    from ..estimation.run import Run

# A cost is drawn as at least this part of the small ones, the quantile _SMALL: a window without
# data would stretch the axis over all decades.
_FLOOR, _SMALL = 0.3, 0.02
_EVENTS = (
    ("improved", Status.IMPROVED, COLORS["estimate"], "|"),
    ("kept", Status.CANDIDATE, COLORS["observer"], "x"),
    ("missing data", Status.MISSING, COLORS["measurement"], "."),
    ("solver stopped or failed", Status.SOLVER_STOPPED, "#CC79A7", "v"),
    ("model failed", Status.MODEL_FAILED, "#009E73", "D"),
)


def costs(
    run: Run, *, dt: float | None = None, time_label: str | None = None, axes: Any = None
) -> Any:
    """True cost J of estimates and candidates, on a logarithmic axis; kept steps are marked.

    Raises the errors of `states`.

    Parameters
    ----------
    run : Run
    dt, time_label
        As for `states`.
    axes : matplotlib Axes, optional
        Where to draw; a figure is made if left out.
    """
    check_run(run)
    times, when = run_times(run, dt, time_label)
    (panel,) = panels(1, axes, 2.6)
    times = times[1:]
    known = run.costs[np.isfinite(run.costs) & (run.costs > 0.0)]
    floor = _FLOOR * float(np.quantile(known, _SMALL)) if known.size else 1e-300
    for values, label, style in (
        (run.candidate_costs, "candidate", OBSERVER), (run.costs, "estimate", STYLES[0]),
    ):
        panel.semilogy(times, np.maximum(values, floor), linewidth=1.3, label=label, **style)
    kept = (run.flags & Status.CANDIDATE.value) != 0
    if kept.any():
        panel.semilogy(
            times[kept], np.maximum(run.costs[kept], floor), "x", color=COLORS["observer"],
            markersize=4.0,
            label="candidate kept",
        )
    date_axis(run, dt, panel)
    label_decades(panel.yaxis)
    panel.set(xlabel=when, ylabel="true cost J")
    panel.margins(x=0.01)
    panel.legend(frameon=False)
    return panel


def outcomes(
    run: Run, *, dt: float | None = None, time_label: str | None = None, axes: Any = None
) -> Any:
    """What happened at each step, a row for each kind of event: improved, kept, and why.

    A line stands for steps in a row.

    Parameters
    ----------
    run, dt, time_label, axes
        As for `costs`, with the same errors.
    """
    check_run(run)
    times, when = run_times(run, dt, time_label)
    (panel,) = panels(1, axes, 1.6)
    times = times[1:]
    failed = Status.SOLVER_FAILED.value
    rows: list[str] = []
    for label, flag, color, marker in _EVENTS:
        value = flag.value | (failed if flag is Status.SOLVER_STOPPED else 0)
        there = (run.flags & value) != 0
        if there.any():
            # Markers of neighbours overlap to a pattern: only the ends of a line have one.
            goes_on = there[1:] & there[:-1]
            ends = there & ~(np.append(False, goes_on) & np.append(goes_on, False))
            panel.plot(times, np.where(there, len(rows), np.nan), marker, color=color,
                       markersize=5.0, markevery=np.flatnonzero(ends).tolist(), linestyle="-",
                       linewidth=3.0, solid_capstyle="butt")
            rows.append(f"{label} ({there.mean():.0%})")
    panel.set_yticks(range(len(rows)), rows)
    panel.set_ylim(max(len(rows), 1) - 0.5, -0.5)
    date_axis(run, dt, panel)
    panel.set_xlabel(when)
    panel.margins(x=0.01)
    return panel


def step_times(run: Run, *, deadline: float | None = None, axes: Any = None) -> Any:
    """Share of the steps that took longer than a time, and the same for the solver's part.

    Parameters
    ----------
    run, axes
        As for `costs`, with the same errors.
    deadline : float, optional
        Seconds, drawn as a line.
    """
    check_run(run)
    if deadline is not None:
        deadline = positive("deadline", deadline)
    (panel,) = panels(1, axes, 2.6)
    for seconds, label, style in (
        (run.times, "whole step", STYLES[0]), (run.solve_times, "QP solver", STYLES[1]),
    ):
        known = np.sort(seconds[np.isfinite(seconds) & (seconds > 0.0)])
        if known.size:
            share = 1.0 - np.arange(known.size) / known.size
            panel.loglog(known * 1e6, share, drawstyle="steps-post", label=label, **style)
    if deadline is not None:
        late = float((run.times > deadline).sum()) / max(1, len(run))
        panel.axvline(
            deadline * 1e6, color="0.4", linewidth=1.0, linestyle=":",
            label=f"deadline ({late:.1%} late)",
        )
    label_decades(panel.xaxis)
    label_decades(panel.yaxis)
    panel.set(xlabel="time (µs)", ylabel="share of steps that took longer")
    if panel.get_legend_handles_labels()[0]:
        panel.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, frameon=False)
    return panel
