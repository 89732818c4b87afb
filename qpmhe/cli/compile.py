"""``qpmhe compile``: the C steps of models made ahead, into the cache."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from .. import codegen
from ..errors import QpmheError
from ..records.record_model import load_record_model
from .values import read_state


def compile(
    models: Annotated[
        list[str],
        typer.Argument(help="Models of the zoo, package.module:function or file.py:function."),
    ],
    horizon: Annotated[
        int | None, typer.Option(min=1, help="Horizon N; default is each model's own.")
    ] = None,
    initial_state: Annotated[
        str | None, typer.Option(help="Initial estimate, numbers separated by commas; default is "
                                      "each model's own.")
    ] = None,
) -> None:
    """Compile the steps of models, so that engine="auto" finds them in the cache."""
    options: dict[str, Any] = {} if horizon is None else {"horizon": horizon}
    if initial_state is not None:
        options["initial_state"] = read_state(initial_state)
    console, failed = Console(), False
    for model in models:
        try:
            estimator = load_record_model(model, **options).estimator
            with console.status(f"compiling {escape(model)}"):
                made = codegen.compile(estimator)
        except QpmheError as error:
            failed = True
            console.print(
                f"[bold]{escape(model)}[/]: [bold red]not compiled:[/] {escape(str(error))}",
                highlight=False, soft_wrap=True,
            )
            continue
        what = "compiled and checked" if made.is_new else "in the cache already, checked"
        console.print(
            f"[bold]{escape(model)}[/], N = {estimator.horizon}: {what} in "
            f"{made.seconds:.2g} s", highlight=False, soft_wrap=True,
        )
        console.print(f"  {escape(str(made.path))}", highlight=False, soft_wrap=True)
    if failed:
        raise typer.Exit(1)
