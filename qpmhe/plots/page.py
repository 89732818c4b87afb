"""What a notebook shows of a run: its main numbers, and small plots of states and costs."""

from __future__ import annotations

import base64
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING

from .steps import costs
from .style import LIGHT, run_times
from .trajectories import run_labels, trajectories

if TYPE_CHECKING:
    from ..estimation.run import Run

# The first states alone are drawn of a run with many.
_MOST = 6


def run_page(run: Run) -> str:
    """A run as HTML, as notebooks show it: a table, and an image within the text."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    rows = "".join(
        f"<tr><td style='text-align:left'>{escape(name)}</td>"
        f"<td style='text-align:left'>{escape(fact)}</td></tr>"
        for name, fact in run.facts().items()
    )
    table = f"<table><caption>qpmhe.Run</caption>{rows}</table>"
    if not len(run):
        return table
    with rc_context(LIGHT):
        count = min(run.states.shape[1], _MOST)
        total = count + run.has_costs
        figure = Figure(figsize=(5.6, 0.5 + 1.1 * total), layout="constrained")
        panels = list(figure.subplots(total, 1, sharex=True, squeeze=False)[:, 0])
        times, when = run_times(run, None, None)
        errors = run.covariances
        trajectories(
            times, None, {"estimate": run.states[:, :count]},
            run_labels(run)[:count], "" if run.has_costs else when, panels[:count],
            covariances=None if errors is None else errors[:, :count, :count],
        )
        if run.has_costs:
            costs(run, axes=panels[-1])
        data = BytesIO()
        figure.savefig(data, format="png", dpi=110)
    image = base64.b64encode(data.getvalue()).decode()
    return (
        f"{table}<img alt='states over time' style='max-width:100%' "
        f"src='data:image/png;base64,{image}'>"
    )
