"""``qpmhe export-qps``: dumped QPs as a test set of qpbenchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from ..studies.qpbenchmark_set import Matrices, export_qpbenchmark

__all__ = ["export_qps"]


def export_qps(
    files: Annotated[
        list[Path], typer.Argument(help="Files of qpmhe.solvers.dump, or folders of them.")
    ],
    out: Annotated[
        Path, typer.Option(help="Folder of the test set.")
    ] = Path("results/qpbenchmark"),
    matrices: Annotated[
        Matrices, typer.Option(help="What solvers that take both kinds are given.")
    ] = "sparse",
) -> None:
    """Write dumped QPs as a test set of qpbenchmark."""
    console = Console()
    exported = export_qpbenchmark(files, out, matrices=matrices)
    for path, reason in exported.skipped.items():
        console.print(f"[yellow]left out[/] {escape(str(path))}: {reason}", highlight=False)
    console.print(
        f"wrote {len(exported.problems)} QPs to {escape(str(out))}; solve them with all "
        "installed solvers, and make the report (pip install qpbenchmark):",
        highlight=False,
    )
    results = exported.script.with_name("results.csv")
    console.print(
        f"qpbenchmark {escape(str(exported.script))} --results-path {escape(str(results))} "
        "run --author NAME",
        highlight=False, soft_wrap=True,
    )
