"""``qpmhe export-qps``: dumped QPs as a test set of qpbenchmark."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from ..studies.qpbenchmark_set import Matrices, export_qpbenchmark

__all__ = ["run"]


def run(
    console: Console, paths: Sequence[Path], out: Path, *, matrices: Matrices = "sparse"
) -> None:
    """Export the QPs, and print how to run qpbenchmark on them.

    Parameters
    ----------
    console : rich.console.Console
        Where to print.
    paths : sequence of Path
        Files of `qpmhe.solvers.dump`, or folders of such.
    out : Path
        The folder to write.
    matrices : {"sparse", "dense"}
        What solvers that take both kinds are given.

    Raises
    ------
    InvalidInputError, OptionError
        As `qpmhe.studies.export_qpbenchmark` says.
    """
    exported = export_qpbenchmark(paths, out, matrices=matrices)
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
