"""The commands and their options; each command's work is in a file of its own."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from .. import __version__
from ..errors import QpmheError
from .estimate import estimate

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


class Measure(StrEnum):
    """Values of --measure."""

    BOTH = "both"
    ACCURACY = "accuracy"
    TIME = "time"


class Matrices(StrEnum):
    """Values of --matrices."""

    SPARSE = "sparse"
    DENSE = "dense"


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


app.command()(estimate)


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


_STORE = typer.Option(help="File of the results; a run that was stopped goes on from it.")
_OUT = typer.Option(help="Folder of the report.")
_JOBS = typer.Option(min=1, help="Cells at a time; all cores if left out. Times want 1.")
_SCHEDULER = typer.Option(help="Address of a Dask scheduler whose workers run the cells.")
_RETRY = typer.Option("--retry-failed", help="Run cells that failed before once more.")


@app.command()
def compare(
    model: Annotated[
        list[str] | None,
        typer.Option(help="Model of the zoo, package.module:function or file.py:function; may be "
                     "repeated. The paper's reactor if left out."),
    ] = None,
    backend: Annotated[
        list[str] | None,
        typer.Option(help="QP backend; may be repeated. All installed ones if left out."),
    ] = None,
    qps: Annotated[
        str, typer.Option(help="QPs per sample, between commas; 0 is the observer.")
    ] = "0,1,2,5,converged",
    solver_iterations: Annotated[
        str, typer.Option(help="Caps on the iterations inside each QP, between commas.")
    ] = "1,2,5,10,none",
    horizons: Annotated[
        str, typer.Option(help="Horizons N, between commas; default is the model's own.")
    ] = "default",
    start: Annotated[
        list[str] | None, typer.Option(help="candidate or best; may be repeated.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds.")] = 20,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Samples of each record; if left out, the model's own, and 100 "
                     "where no model is named."),
    ] = None,
    measure: Annotated[
        Measure, typer.Option(help="What to measure; times alone run one cell at a time.")
    ] = Measure.BOTH,
    deadline: Annotated[
        float | None, typer.Option(help="Seconds a step may take; the share above is told.")
    ] = None,
    covariances: Annotated[
        bool, typer.Option("--covariances", help="Compute covariances and the NEES, too.")
    ] = False,
    cell_timeout: Annotated[
        float, typer.Option(help="Seconds after which a cell is given up.")
    ] = 60.0,
    store: Annotated[Path, _STORE] = Path("results/compare.sqlite"),
    out: Annotated[Path, _OUT] = Path("results/compare"),
    jobs: Annotated[int | None, _JOBS] = None,
    scheduler: Annotated[str | None, _SCHEDULER] = None,
    retry_failed: Annotated[bool, _RETRY] = False,
) -> None:
    """Which QP backend, at which cap, gives which accuracy in which time: table and report."""
    from .compare import compare as run

    if model is None and steps is None:
        steps = 100  # all backends at all caps are to be done within ten minutes
    run(
        Console(), store=store, out=out, models=model or ("batch_reactor",), backends=backend,
        qps=qps, solver_iterations=solver_iterations, horizons=horizons,
        starts=start or ("candidate",), seeds=seeds, steps=steps, measure=measure.value,
        deadline=deadline, covariances=covariances, cell_timeout=cell_timeout, jobs=jobs,
        scheduler=scheduler, retry_failed=retry_failed,
    )


@app.command()
def study(
    file: Annotated[Path, typer.Argument(help="The study, a TOML file.")],
    store: Annotated[
        Path | None, typer.Option(help="File of the results; beside the study if left out.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the report; beside the store if left out.")
    ] = None,
    jobs: Annotated[int | None, _JOBS] = None,
    scheduler: Annotated[str | None, _SCHEDULER] = None,
    retry_failed: Annotated[bool, _RETRY] = False,
) -> None:
    """Run a study of your own; stopped at any moment, the same command goes on."""
    from .compare import study as run

    run(
        Console(), file, store=store, out=out, jobs=jobs, scheduler=scheduler,
        retry_failed=retry_failed,
    )


@app.command()
def report(
    store: Annotated[Path, typer.Argument(help="File of the results.")],
    out: Annotated[Path, _OUT] = Path("results/report"),
) -> None:
    """Summary of a store on screen, and its report: one HTML page, and figures."""
    from .report import report as run

    run(Console(), store, out)


@app.command()
def export(
    store: Annotated[Path, typer.Argument(help="File of the results.")],
    file: Annotated[Path, typer.Argument(help="What to write: .csv or .parquet.")],
) -> None:
    """Write the rows of a store into a CSV or Parquet file."""
    from .compare import export as run

    run(Console(), store, file)


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


@app.command("export-qps")
def export_qps(
    files: Annotated[
        list[Path], typer.Argument(help="Files of qpmhe.solvers.dump, or folders of them.")
    ],
    out: Annotated[
        Path, typer.Option(help="Folder of the test set.")
    ] = Path("results/qpbenchmark"),
    matrices: Annotated[
        Matrices, typer.Option(help="What the solvers are handed.")
    ] = Matrices.SPARSE,
) -> None:
    """Write dumped QPs as a test set of qpbenchmark."""
    from .export_qps import run

    run(Console(), files, out, matrices=matrices.value)


def main() -> None:
    """Entry point: our own errors are told in a line, not as a traceback."""
    try:
        app()
    except QpmheError as error:
        Console(stderr=True).print(
            f"[bold red]Error:[/] {escape(str(error))}", highlight=False, soft_wrap=True
        )
        sys.exit(2)
