"""``qpmhe reproduce``: the paper's example on screen and on disk."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from .. import studies
from ..studies.environment import environment, environment_words
from ..studies.paper import SETTLED, Reproduction
from . import options
from .values import read_width


def reproduce(
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    seeds: Annotated[
        int, typer.Option(min=1, help="Number of seeds that the first table averages over, from "
                                      "--seed on.")
    ] = 1,
    steps: Annotated[int, typer.Option(min=1, help="Number of measurements.")] = 150,
    backend: Annotated[str, typer.Option(help="QP backend of the first table.")] = "auto",
    out: Annotated[Path, typer.Option(help="Folder for figure and CSV files.")] = Path("results"),
    method: Annotated[
        Literal["euler", "rk4"], typer.Option(help="Discretisation of the reactor.")
    ] = "euler",
    ipopt: Annotated[
        bool, typer.Option("--ipopt", help="Also run CasADi with Ipopt, the paper's tool.")
    ] = False,
    width: options.Width = None,
) -> None:
    """Reproduce the paper's example: tables on screen, figure and CSV files on disk."""
    console, figures = Console(), read_width(width)
    with Progress(
        TextColumn("paper's example"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(),
        console=Console(stderr=True), transient=True,
    ) as bar:
        task = bar.add_task("")
        found = studies.reproduce(
            out, seed=seed, seeds=seeds, steps=steps, method=method, backend_name=backend,
            ipopt=ipopt, width=figures,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    console.print(_paper_table(found))
    console.print(_backend_table(found))
    names = {row.label for row in found.backends}
    console.print(f"[dim]{escape(environment_words(environment(), names))}[/]", highlight=False)
    for path in found.files:
        console.print(f"wrote {path}", highlight=False)


def _paper_table(found: Reproduction) -> Table:
    study, scenario = found.study, found.study.model.scenario
    table = Table(
        title=f"Batch reactor, {study.steps} samples, {study.method}, {_seeds(found)}, "
        f"N = {scenario.horizon}, QPs by {found.backend}",
        title_justify="left",
        caption=f"RMSE of the state, over all times and from t = {SETTLED:g} {scenario.time_unit} "
        "on. In steps that did not improve, the estimate is the observer's candidate. All runs use "
        "the Python step."
        + ("" if found.seeds == 1 else " RMSE: mean and 95 % confidence interval over the seeds."),
        caption_justify="left",
    )
    table.add_column("QPs per\nsample", no_wrap=True)
    for name in ("RMSE\nall t", f"RMSE\nt >= {SETTLED:g}", "median\nus/step", "95 %\nus/step",
                 "improved"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in found.rows:
        table.add_row(
            row.label, _with_half(row.rmse, row.rmse_half),
            _with_half(row.rmse_settled, row.rmse_settled_half),
            f"{row.median_time * 1e6:.0f}", f"{row.high_time * 1e6:.0f}",
            f"{row.improved:.0%}",
        )
    return table


def _seeds(found: Reproduction) -> str:
    first = found.study.seed
    return f"seed {first}" if found.seeds == 1 else f"seeds {first} to {first + found.seeds - 1}"


def _with_half(mean: float, half: float) -> str:
    return f"{mean:.4f}" if math.isnan(half) else f"{mean:.3f} ± {half:.3f}"


def _backend_table(found: Reproduction) -> Table:
    table = Table(
        title=f"Backends at i = 2, seed {found.study.seed}",
        title_justify="left",
        caption="Cap: iterations inside each QP. J excess: relative excess of the mean true cost "
                "over the converged one. Times include building the QP.",
        caption_justify="left",
    )
    table.add_column("backend", no_wrap=True)
    for name in ("cap", "RMSE", "J excess", "improved", "median\nus/step"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("what stopped\nthe steps")
    previous = ""
    for row in found.backends:
        if row.label != previous and previous:
            table.add_section()
        table.add_row(
            row.label if row.label != previous else "", "none" if row.cap is None else str(row.cap),
            f"{row.rmse:.4f}", f"{found.excess(row):.1e}", f"{row.improved:.0%}",
            f"{row.median_time * 1e6:.0f}", row.stopped,
        )
        previous = row.label
    return table
