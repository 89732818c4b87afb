"""The commands."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from typer.core import TyperGroup

from qpmhe_solvers import backends

from .._version import __version__
from ..errors import QpmheError
from . import options
from .compare import compare, study
from .compile import compile
from .doctor import doctor
from .estimate import estimate
from .report import export, report
from .reproduce import reproduce
from .solve_qp import export_qps
from .tune import tune

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

# What typer's checks of numbers expect, by the name of what pydantic found.
_EXPECTED = {
    "int_parsing": "an integer", "float_parsing": "a number",
    "greater_than_equal": "an integer >= {ge}",
}


class _Group(TyperGroup):
    """Commands whose errors name the value that an option has, in plain words."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            error.message = _plain(error)
            raise


def _plain(error: typer.BadParameter) -> str:
    """The message of a bad value, without pydantic's words, which only newer typers have."""
    find = getattr(error.__cause__, "errors", None)
    if find is None:
        return error.message
    found = find()[0]
    if found["type"] in _EXPECTED:
        expected = _EXPECTED[found["type"]].format(**found.get("ctx", {}))
        return f"{found['input']}; expected {expected}."
    return error.message.removeprefix("Value error, ")


app = typer.Typer(
    cls=_Group, name="qpmhe",
    help="Suboptimal moving horizon estimation by sequences of convex QPs.", no_args_is_help=True,
    add_completion=False, pretty_exceptions_enable=False,
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


for command in (estimate, tune, reproduce, compare, study, report, export, compile, doctor):
    app.command()(command)
app.command("export-qps")(export_qps)


@app.command()
def solvers() -> None:
    """List the QP backends: what is installed, and what each can do."""
    table = Table(
        title="QP backends",
        title_justify="left",
        caption="version: own: needs no package; none: not installed (pip install its name). "
        "in-eq: handles bounds and rows. cap: honours max_iterations. at cap: returns an "
        "iterate when capped. x0: uses a start. y0: starts from the last multipliers. "
        "time: honours a time limit. inf: detects infeasible QPs. ws: keeps its workspace from QP "
        "to QP.",
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
    Console().print(table)


@app.command()
def certify(
    model: Annotated[
        str, typer.Argument(help="Model of the zoo, package.module:function or file.py:function.")
    ],
    box: Annotated[
        str | None, typer.Option(help="Region of the states, such as 0.1:9,-1:9. Default: the "
                                      "model's, else a box around a simulated record."),
    ] = None,
    horizon: Annotated[
        str | None, typer.Option(help="Horizons N, separated by commas. Default: the model's own.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write all results to this JSON file.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Write the observer's bound to this JSON file, for "
                                       "qpmhe.certificates.load.")
    ] = None,
    input_box: Annotated[
        str | None, typer.Option(help="Bounds on the inputs, in the form of --box.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated record.")] = 0,
    seconds: Annotated[
        float, typer.Option(help="Time limit of the search, in seconds.")
    ] = 60.0,
    details: Annotated[
        bool, typer.Option("--details", help="Show the theorem's assumptions and constants.")
    ] = False,
    design: Annotated[
        bool, typer.Option("--design", help="Design weights, discount and horizon by a "
                                            "Lyapunov function, and print code to paste.")
    ] = False,
    guard: Annotated[
        bool, typer.Option("--guard", help="Try a guard of estimates on the simulated record, or "
                                           "say why there is none.")
    ] = False,
    max_disturbance: options.MaxDisturbance = None,
    max_noise: options.MaxNoise = None,
) -> None:
    """Prove how far the observer can be from the true state."""
    from .certify import certify as run

    certified = run(
        Console(), model, box, horizon, report, out=out, input_box=input_box, seed=seed,
        seconds=seconds, details=details, with_design=design, guard=guard,
        max_disturbance=max_disturbance, max_noise=max_noise,
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


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Show our own warnings in one line; their place in the package helps nobody here."""
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
            if not category.__module__.startswith(("qpmhe.", "qpmhe_solvers.")):
                usual(message, category, *place, **more)
                return
            Console(stderr=True).print(
                f"[bold yellow]warning:[/] {escape(str(message))}", highlight=False, soft_wrap=True
            )

        warnings.showwarning = show
        yield


def main() -> None:
    """Entry point: report our own errors and warnings in one line, without a traceback."""
    try:
        with _plain_warnings():
            app()
    except QpmheError as error:
        Console(stderr=True).print(
            f"[bold red]Error:[/] {escape(str(error))}", highlight=False, soft_wrap=True
        )
        sys.exit(2)
