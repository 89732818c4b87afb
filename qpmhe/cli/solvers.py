"""``qpmhe solvers``: the backends and their capabilities."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from qpmhe_solvers import backends

__all__ = ["show"]

# Heading, and the capability that it stands for; the table fits into 80 columns.
_FLAGS = {
    "in-\neq": "inequalities",
    "\ncap": "iteration_cap",
    "at\ncap": "iterate_at_cap",
    "\nx0": "warm_start",
    "\ny0": "keeps_duals",
    "\ntime": "time_limit",
    "\ninf": "reports_infeasibility",
    "\nws": "keeps_workspace",
}
_SHORT = {
    "augmented Lagrangian": "augm. Lagrangian", "banded": "band",
    "banded, then a QP": "banded, then QP",
}


def show(console: Console) -> None:
    """Print one row per registered backend, in order of registration."""
    table = Table(
        title="QP backends",
        title_justify="left",
        caption="version: own needs no package, none is not installed (pip install it by its "
        "name). in-eq: handles bounds and rows. cap: honours max_iterations. at cap: has an "
        "iterate to judge when capped. x0: uses a start. y0: starts from the last multipliers. "
        "time: honours a time limit. inf: says so where a QP is infeasible. ws: keeps its "
        "workspace from QP to QP.",
        caption_justify="left",
        box=None,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for name in ("backend", "version", "method", "reads"):
        table.add_column(name, no_wrap=True, vertical="bottom")
    for heading in _FLAGS:
        table.add_column(heading, justify="center", no_wrap=True)
    for entry in backends():
        version = entry.version if entry.available else "none"
        table.add_row(
            entry.name, "own" if entry.module is None else version,
            _SHORT.get(entry.method, entry.method), _SHORT.get(entry.matrices, entry.matrices),
            *("x" if getattr(entry, flag) else "-" for flag in _FLAGS.values()),
            style=None if entry.available else "dim",
        )
    console.print(table)
