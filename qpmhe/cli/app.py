"""The commands."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from .._version import __version__
from ..errors import QpmheError
from .compare import compare, study
from .estimate import estimate
from .report import export, report
from .reproduce import reproduce
from .solve_qp import export_qps

__all__ = ["app", "main"]

app = typer.Typer(
    name="qpmhe", help="Suboptimal moving horizon estimation by sequences of convex QPs.",
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
)


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


for command in (estimate, reproduce, compare, study, report, export):
    app.command()(command)
app.command("export-qps")(export_qps)


@app.command()
def solvers() -> None:
    """Table of the QP backends: what is installed, and what each can do."""
    from .solvers import show

    show(Console())


@app.command()
def certify(
    model: Annotated[
        str, typer.Argument(help="Model of the zoo, package.module:function or file.py:function.")
    ],
    box: Annotated[
        str | None, typer.Option(help="Set of states, such as 0.1:9,-1:9; the model's own, or one "
                                 "about a simulated record, if left out."),
    ] = None,
    horizon: Annotated[
        str | None, typer.Option(help="Horizons N, between commas; the model's own if left out.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="JSON file of everything; the picture goes beside it.")
    ] = None,
    input_box: Annotated[
        str | None, typer.Option(help="Bounds on the inputs, in the form of --box.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated record.")] = 0,
    seconds: Annotated[
        float, typer.Option(help="How long the search may take, about.")
    ] = 60.0,
) -> None:
    """What the theorem guarantees for a model: its assumptions checked, its constants computed."""
    from .certify import certify as run

    certified = run(
        Console(), model, box, horizon, report, input_box=input_box, seed=seed, seconds=seconds
    )
    if not certified:
        raise typer.Exit(1)


@app.command("solve-qp")
def solve_qp(
    files: Annotated[
        list[Path], typer.Argument(help="Files of qpmhe.solvers.dump, or folders of them.")
    ],
    backend: Annotated[
        list[str] | None, typer.Option(help="QP backend; may be repeated.")
    ] = None,
    max_iterations: Annotated[
        int | None, typer.Option(min=1, help="Cap on the solver's iterations.")
    ] = None,
    tolerance: Annotated[float | None, typer.Option(help="Absolute tolerance.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Try all installed backends.")] = False,
) -> None:
    """Solve dumped QPs again, with one backend or many."""
    from .solve_qp import run

    solved = run(
        Console(), files, backend or [], max_iterations=max_iterations, tolerance=tolerance,
        every=every,
    )
    if not solved:
        raise typer.Exit(1)


def main() -> None:
    """Entry point: our own errors are reported in a line, without a traceback."""
    try:
        app()
    except QpmheError as error:
        Console(stderr=True).print(
            f"[bold red]Error:[/] {escape(str(error))}", highlight=False, soft_wrap=True
        )
        sys.exit(2)
