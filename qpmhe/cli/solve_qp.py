"""``qpmhe solve-qp`` and ``qpmhe export-qps``: dumped QPs, solved again here or by qpbenchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from qpmhe_solvers import (
    QP,
    Residuals,
    Solution,
    SolverOptions,
    SolveStatus,
    available,
    create,
)
from qpmhe_solvers.files import StoredQP, load, qp_files

from ..studies.qpbenchmark_set import Matrices, export_qpbenchmark

# A backend is timed this many times, or until this many seconds are over.
_REPEATS, _ENOUGH = 7, 0.5

_STYLES = {SolveStatus.SOLVED: "green", SolveStatus.FAILED: "red"}


class Replay(NamedTuple):
    """The result of one QP in one backend."""

    backend: str
    solution: Solution
    residuals: Residuals | None
    objective: float
    seconds: float


def run(
    console: Console, paths: Sequence[Path], backends: Sequence[str] = (), *,
    max_iterations: int | None = None, tolerance: float | None = None, every: bool = False,
) -> bool:
    """Solve each QP of the files with each backend, and print a table for each file."""
    changes: dict[str, Any] = {}
    if max_iterations is not None:
        changes["max_iterations"] = max_iterations
    if tolerance is not None:
        changes["absolute_tolerance"] = tolerance
    wanted = list(dict.fromkeys((*backends, *(available() if every else ()))))
    for name in wanted:
        create(name)
    stored = [load(path) for path in qp_files(paths)]
    options = [replace(one.options or SolverOptions(), **changes) for one in stored]
    tables: list[list[Replay]] = []
    for one, asked in zip(stored, options, strict=True):
        rows: list[Replay] = []
        for name in wanted or [one.backend if one.backend in available() else "auto"]:
            # A solver can crash the process: then the last line on screen names it.
            with console.status(f"{escape(str(one.path))}: {escape(name)}"):
                rows.append(replay(one, name, asked))
        console.print(_table(one, asked, rows), highlight=False)
        for row in rows:
            if row.solution.message and not _solved(row):
                console.print(
                    f"{escape(row.backend)}: {escape(row.solution.message)}", highlight=False
                )
        console.print()
        tables.append(rows)
    if len(tables) > 1:
        console.print(_summary(tables), highlight=False)
    return all(any(_solved(row) for row in rows) for rows in tables)


def replay(stored: StoredQP, name: str, options: SolverOptions) -> Replay:
    """Solve a QP with a backend, each time with a fresh solver, as a first sample does."""
    solution = create(name, options).solve(stored.qp, stored.start)  # untimed: with imports
    times: list[float] = []
    while len(times) < _REPEATS and sum(times) < _ENOUGH:
        solver = create(name, options)
        solver.prepare(stored.qp.size)
        began = perf_counter()
        solver.solve(stored.qp, stored.start)
        times.append(perf_counter() - began)
    return _judged(name, stored.qp, solution, median(times))


def _judged(name: str, qp: QP, solution: Solution, seconds: float = np.nan) -> Replay:
    d = solution.d
    if d is None:
        return Replay(name, solution, None, np.nan, seconds)
    bound_duals, row_duals = solution.bound_duals, solution.row_duals
    if not qp.bounded and not qp.rows:
        bound_duals, row_duals = np.zeros(qp.size), np.zeros(0)
    with np.errstate(all="ignore"):
        residuals = Residuals.of(qp, d, bound_duals, row_duals)
        return Replay(name, solution, residuals, qp.objective(d), seconds)


def _solved(row: Replay) -> bool:
    return row.solution.status is SolveStatus.SOLVED


def _table(stored: StoredQP, options: SolverOptions, rows: list[Replay]) -> Table:
    qp, before = stored.qp, stored.solution
    bounds = int(np.isfinite(qp.lower).sum() + np.isfinite(qp.upper).sum())
    sides = int(np.isfinite(qp.row_lower).sum() + np.isfinite(qp.row_upper).sum())
    cap = "none" if options.max_iterations is None else options.max_iterations
    table = Table(
        title=escape(
            f"{stored.path}: {qp.stages} stages of {qp.n}, {bounds} bounds, {sides} sides of "
            f"rows; cap {cap}, tolerance {options.absolute_tolerance:g}"
            + (f"; dumped by {stored.backend}" if stored.backend else "")
        ),
        title_justify="left",
        caption="Primal (the largest violation), dual and gap: residuals, recomputed from the "
        "data. d - d0: largest difference from the dumped iterate. ms: median of first solves "
        "with a fresh solver.",
        caption_justify="left",
        padding=(0, 0), box=SIMPLE_HEAD, show_edge=False,
    )
    table.add_column("backend", overflow="fold")  # the one that gives way on a narrow screen
    table.add_column("status", no_wrap=True)
    for name in ("iter.", "primal", "dual", "gap", "objective", "d - d0", "ms"):
        table.add_column(name, justify="right", no_wrap=True)
    reference = None if before is None else before.d
    if before is not None:
        _add(table, _judged("as dumped", qp, before), reference)
        table.add_section()
    for row in rows:
        _add(table, row, reference)
    return table


def _add(table: Table, row: Replay, reference: np.ndarray | None) -> None:
    solution, found = row.solution, row.residuals
    apart = np.nan
    if solution.d is not None and reference is not None:
        apart = float(np.abs(solution.d - reference).max())
    style = _STYLES.get(solution.status, "yellow")
    table.add_row(
        escape(row.backend), f"[{style}]{solution.status.name}[/]",
        "-" if solution.iterations is None else str(solution.iterations),
        *(["-"] * 3 if found is None else
          [_short(found.primal), _short(found.dual), _short(found.gap)]),
        "-" if np.isnan(row.objective) else f"{row.objective:.7g}",
        _short(apart),
        "-" if np.isnan(row.seconds) else f"{1e3 * row.seconds:.3g}",
    )


def _short(value: float) -> str:
    if np.isnan(value):
        return "-"
    return "0" if value == 0.0 else f"{value:.1e}"


def _summary(tables: list[list[Replay]]) -> Table:
    names = list(dict.fromkeys(row.backend for rows in tables for row in rows))
    table = Table(
        title=f"{len(tables)} QPs", title_justify="left",
        caption="ms: median over the QPs, and the longest.", caption_justify="left",
        padding=(0, 0), box=SIMPLE_HEAD, show_edge=False,
    )
    table.add_column("backend", overflow="fold")
    for name in ("tried", *(status.name.lower() for status in SolveStatus), "ms", "longest"):
        table.add_column(name, justify="right", no_wrap=True)
    for name in names:
        rows = [row for replays in tables for row in replays if row.backend == name]
        counts = [sum(row.solution.status is status for row in rows) for status in SolveStatus]
        times = [1e3 * row.seconds for row in rows]
        table.add_row(
            escape(name), str(len(rows)), *("-" if count == 0 else str(count) for count in counts),
            f"{median(times):.3g}", f"{max(times):.3g}",
        )
    return table


def export_qps(
    files: Annotated[
        list[Path], typer.Argument(help="Files of qpmhe.solvers.dump, or folders of them.")
    ],
    out: Annotated[
        Path, typer.Option(help="Folder of the test set.")
    ] = Path("results/qpbenchmark"),
    matrices: Annotated[
        Matrices, typer.Option(help="Matrices for solvers that take both kinds.")
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
