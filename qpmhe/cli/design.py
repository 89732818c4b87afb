"""``qpmhe certify --design``: weights, discount and horizon that fit each other."""

from __future__ import annotations

from rich import box as boxes
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..certificates.deadline import Deadline
from ..certificates.evidence import NotCertifiedError
from ..certificates.lyapunov import Design, Kind, design
from ..certificates.report import Report

_MEANING: dict[Kind, str] = {
    "minimiser": "J(estimate) <= J(truth), as of a global minimiser",
    "measured": "J(estimate), known once it is there",
}


def show_design(
    console: Console, found: Report, horizons: list[int], seconds: float
) -> Design | None:
    """Design for the model, region and sizes of a report, and print what is to be pasted."""
    system, certificate = found.example.system, found.certificate
    horizon = horizons[0] if len(horizons) == 1 else None
    with console.status("looking for a Lyapunov function"):
        try:
            made = design(
                system, found.region, sizes=certificate.sizes, horizon=horizon,
                seconds=Deadline(seconds),
            )
        except NotCertifiedError as error:
            console.print(f"[bold red]No design:[/] {escape(str(error))}", highlight=False)
            return None
    console.print(
        f"\n[bold]Lyapunov design ({made.evidence})[/], for {escape(str(made.sizes))}",
        highlight=False,
    )
    console.print(_table(made), highlight=False)
    for note in made.notes:
        console.print(f"Note: {escape(note)}", highlight=False)
    console.print()
    console.print(made.code(), highlight=False, markup=False, soft_wrap=True)
    return made


def _table(made: Design) -> Table:
    """What holds for the horizon proposed."""
    table = Table(
        box=boxes.SIMPLE, padding=(0, 1, 0, 0), caption_justify="left",
        caption="Contraction: by which factor the error shrinks over a window that starts at an "
        "estimate. Least N: from which it is below 1. Limit: of each state's error, for noises "
        "that always act in the worst direction; -, none in advance; in brackets, no less than "
        "the region's width, so that it says nothing.",
    )
    names = [f"x{j + 1}" for j in range(made.region.n)]
    if len(names) > 3:
        names[1:-1] = ["..."]
    table.add_column("what bounds J(estimate)", overflow="fold", vertical="bottom")
    for name in ("\nN", "contrac-\ntion", "least\nN"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column(f"limit\n{', '.join(names)}", overflow="fold")
    for kind, meaning in _MEANING.items():
        least, limits = "1", "-"
        if kind == "minimiser":
            least = str(made.least_horizon() or "-")
            found = made.components(made.limit())
            widths = (made.region.upper - made.region.lower)[: found.size]
            limits = ", ".join(
                f"{value:.3g}" if value < width else f"({value:.3g})"
                for value, width in zip(found.tolist(), widths.tolist(), strict=True)
            )
        factor = made.contraction(kind=kind)
        table.add_row(meaning, str(made.horizon), f"{factor:.3g}", least, limits)
    return table
