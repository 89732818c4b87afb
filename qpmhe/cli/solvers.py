"""``qpmhe solvers``: the backends and their capabilities."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from qpmhe_solvers import backends

__all__ = ["show"]


def show(console: Console) -> None:
    """Print one row per registered backend, in order of registration."""
    table = Table(
        title="QP backends",
        title_justify="left",
        caption="ineq.: handles bounds and rows. cap: honours max_iterations. x at cap: has an "
        "iterate to judge when capped. x0: uses a start. time: honours a time limit.",
        caption_justify="left",
        padding=(0, 0),
    )
    for name in ("backend", "installed", "method", "matrices"):
        table.add_column(name, no_wrap=True)
    for name in ("in-\neq.", "cap", "x at\ncap", "x0", "time"):
        table.add_column(name, justify="center", no_wrap=True)
    for entry in backends():
        if entry.module is None:
            installed = "built in"
        else:
            installed = entry.version if entry.available else f"pip install {entry.distribution}"
        flags = (
            entry.inequalities, entry.iteration_cap, entry.iterate_at_cap, entry.warm_start,
            entry.time_limit,
        )
        table.add_row(
            entry.name, installed, entry.method, entry.matrices,
            *("yes" if flag else "-" for flag in flags),
            style=None if entry.available else "dim",
        )
    console.print(table)
