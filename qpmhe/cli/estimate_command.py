"""Options of ``qpmhe estimate``; the work is in `qpmhe.cli.estimate`."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer
from rich.console import Console

__all__ = ["estimate"]


class Uncertainty(StrEnum):
    """Values of --covariances."""

    NONE = "none"
    STD = "std"
    FULL = "full"


class DecimalMark(StrEnum):
    """Values of --decimal."""

    AUTO = "auto"
    POINT = "."
    COMMA = ","


def estimate(
    model: Annotated[
        str,
        typer.Argument(help="Model of the zoo, package.module:function or file.py:function."),
    ],
    record: Annotated[
        str,
        typer.Argument(help="CSV (also .gz) or Parquet file with a time column; - is standard "
                       "input."),
    ],
    out: Annotated[
        str, typer.Option(help="What to write: .csv, .parquet, or - for standard output.")
    ] = "-",
    time: Annotated[str | None, typer.Option(help="Column of the time.")] = None,
    outputs: Annotated[
        str | None, typer.Option(help="Columns of the outputs: y1=COLUMN,y2=COLUMN.")
    ] = None,
    inputs: Annotated[
        str | None, typer.Option(help="Columns of the inputs: u1=COLUMN,u2=COLUMN.")
    ] = None,
    horizon: Annotated[int | None, typer.Option(help="N; the model's own if left out.")] = None,
    backend: Annotated[str | None, typer.Option(help="QP backend.")] = None,
    max_qps: Annotated[
        str | None, typer.Option(help="QPs per sample; 0 is the observer, or: converged.")
    ] = None,
    max_solver_iterations: Annotated[
        str | None, typer.Option(help="Cap on the iterations inside each QP, or: none.")
    ] = None,
    initial_state: Annotated[
        str | None, typer.Option(help="Numbers between commas; the model's own if left out.")
    ] = None,
    engine: Annotated[str | None, typer.Option(help="python or compiled.")] = None,
    covariances: Annotated[
        Uncertainty, typer.Option(help="Standard deviations or covariances of the estimates.")
    ] = Uncertainty.NONE,
    step_time: Annotated[
        bool, typer.Option(help="Whether to write the seconds of each step.")
    ] = True,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a record that was cut off.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace what is there already.")
    ] = False,
    checkpoint_every: Annotated[
        int | None, typer.Option(min=1, help="Samples from checkpoint to checkpoint; 100.")
    ] = None,
    dt: Annotated[
        float | None, typer.Option(help="Usual step of a discrete-time model, in its unit.")
    ] = None,
    time_scale: Annotated[
        float, typer.Option(help="The record's unit of time in the model's.")
    ] = 1.0,
    equal_steps: Annotated[
        bool, typer.Option("--equal-steps", help="Insist on equal steps; rows come at once.")
    ] = False,
    max_gap: Annotated[
        int | None,
        typer.Option(min=0, help="Most samples in a row that may be missing; 1000."),
    ] = None,
    skip_repeated: Annotated[
        bool, typer.Option("--skip-repeated", help="Pass over lines whose time was there already.")
    ] = False,
    separator: Annotated[
        str | None, typer.Option(help="Of a CSV file: a character, comma, semicolon, tab, ...")
    ] = None,
    decimal: Annotated[DecimalMark, typer.Option(help="Decimal mark.")] = DecimalMark.AUTO,
    encoding: Annotated[str, typer.Option(help="Of a CSV file.")] = "utf-8",
    missing: Annotated[
        list[str] | None,
        typer.Option(metavar="WORD", help="What stands for a missing value; may be repeated."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Tell nothing but errors.")] = False,
) -> None:
    """Estimate the states of a measured record; in a pipe, line by line."""
    from .estimate import run

    run(
        Console(stderr=True), model, record, out, max_qps=max_qps,
        max_solver_iterations=max_solver_iterations, initial_state=initial_state,
        horizon=horizon, backend=backend, engine=engine, quiet=quiet, time=time,
        outputs=outputs, inputs=inputs, separator=separator, decimal=decimal.value,
        encoding=encoding, missing=missing or (), dt=dt, time_scale=time_scale,
        equal_steps=equal_steps, max_gap=max_gap, skip_repeated=skip_repeated,
        covariances=covariances.value, step_time=step_time, resume=resume, overwrite=overwrite,
        checkpoint_every=checkpoint_every,
    )
