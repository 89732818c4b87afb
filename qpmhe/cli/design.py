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
    "decrease": "J(estimate) <= J(candidate), any number of QPs",
}


def show_design(
    console: Console, found: Report, horizons: list[int], seconds: float
) -> Design | None:
    """Design for the model, region and sizes of a report, and print what is to be pasted."""
    system, observer, certificate = found.example.system, found.example.observer, found.certificate
    horizon = horizons[0] if len(horizons) == 1 else None
    with console.status("looking for a Lyapunov function"):
        try:
            made = design(
                system, found.region, observer=observer, sizes=certificate.sizes, horizon=horizon,
                stability=certificate.stability, seconds=Deadline(seconds),
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
    table = Table(
        box=boxes.SIMPLE, padding=(0, 1, 0, 0), caption_justify="left",
        caption="Contraction: by which factor the error shrinks over a window that starts at an "
        "estimate. Least N: from which it is below 1. Limit: of each state's error, for noises "
        "that always act in the worst direction; -, none in advance for this N.",
    )
    table.add_column("what bounds J(estimate)", overflow="fold", vertical="bottom")
    numbers = f"contraction\nN = {made.horizon}", "least\nN"
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True, vertical="bottom")
    table.add_column(
        f"limit\nx1{f', ..., x{n}' if (n := made.region.n) > 1 else ''}", overflow="fold"
    )
    for kind in made.kinds:
        limits = "-"
        if kind != "measured" and made.contraction(kind=kind) < 1.0:
            found = made.components(made.limit(kind=kind))
            limits = ", ".join(f"{value:.3g}" for value in found.tolist())
        table.add_row(
            _MEANING[kind], f"{made.contraction(kind=kind):.3g}",
            str(made.least_horizon(kind) or "-"), limits,
        )
    return table
