"""The commands and their options; each command's work is in a file of its own."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from .. import __version__
from ..errors import QpmheError

__all__ = ["app", "main"]

app = typer.Typer(
    name="qpmhe",
    help="Suboptimal moving horizon estimation by sequences of convex QPs.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


class Discretisation(StrEnum):
    """Values of --method."""

    EULER = "euler"
    RK4 = "rk4"


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"qpmhe {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Suboptimal moving horizon estimation by sequences of convex QPs."""


@app.command()
def solvers() -> None:
    """Table of the QP backends: what is installed, and what each can do."""
    from .solvers import show

    show(Console())


@app.command()
def reproduce(
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    steps: Annotated[int, typer.Option(min=1, help="Number of measurements.")] = 150,
    backend: Annotated[str, typer.Option(help="QP backend of the first table.")] = "auto",
    out: Annotated[Path, typer.Option(help="Folder for figure and CSV files.")] = Path("results"),
    method: Annotated[
        Discretisation, typer.Option(help="Discretisation of the reactor.")
    ] = Discretisation.EULER,
    ipopt: Annotated[
        bool, typer.Option("--ipopt", help="Put CasADi with Ipopt, the paper's tool, beside.")
    ] = False,
) -> None:
    """Reproduce the paper's example: tables on screen, figure and CSV files on disk."""
    from ..studies import PaperStudy
    from .reproduce import run

    run(Console(), PaperStudy(seed, steps, method.value), backend, out, ipopt)


def main() -> None:
    """Entry point: our own errors are told in a line, not as a traceback."""
    try:
        app()
    except QpmheError as error:
        Console(stderr=True).print(f"[bold red]Error:[/] {error}", highlight=False)
        sys.exit(2)
