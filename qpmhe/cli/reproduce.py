"""``qpmhe reproduce``: the paper's example on screen and on disk."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from qpmhe_solvers import backend, create

from ..errors import InvalidInputError
from ..plots import save, trajectories
from ..studies import PaperStudy, Row, backend_rows, ipopt_rows, paper_rows
from ..studies.paper import CAPS, ITERATIONS, SETTLED, compared_backends

__all__ = ["run"]


def run(
    console: Console, study: PaperStudy, backend_name: str, out: Path, with_ipopt: bool
) -> None:
    """Run the study, print its tables, and write figure and CSV files into a folder.

    Parameters
    ----------
    console : rich.console.Console
        Where to print.
    study : PaperStudy
        Seed, length and discretisation.
    backend_name : str
        QP backend of the first table.
    out : Path
        Folder for the files; it is made.
    with_ipopt : bool
        Whether CasADi with Ipopt runs beside.

    Raises
    ------
    BackendError
        If the backend is unknown or not installed.
    InvalidInputError
        If the folder cannot be made, or CasADi is missing though asked for.
    """
    create(backend_name)  # before any work: a wrong name must not cost a minute
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"cannot make the folder {out}: {error.strerror}.") from error
    names = compared_backends()
    runs = len(ITERATIONS) + (4 if with_ipopt else 0) + sum(
        len(CAPS) if backend(name).iteration_cap else 1 for name in names
    )
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(),
        MofNCompleteColumn(), TimeRemainingColumn(), console=console, transient=True,
    ) as progress:
        task = progress.add_task("paper's example", total=runs * study.steps)

        def tick() -> None:
            progress.advance(task)

        rows = paper_rows(study, backend_name, tick)
        if with_ipopt:
            progress.update(task, description="CasADi with Ipopt")
            rows += ipopt_rows(study, tick)
        progress.update(task, description="backends")
        compared = list(backend_rows(study, tick=tick))
    converged = next(row for row in rows if row.label == "converged")
    console.print(_paper_table(study, backend_name, rows))
    console.print(_backend_table(compared, converged.mean_cost))
    for path in _write(study, out, rows, compared, converged.mean_cost):
        console.print(f"wrote {path}", highlight=False)


def _paper_table(study: PaperStudy, backend_name: str, rows: list[Row]) -> Table:
    table = Table(
        title=f"Batch reactor, {study.steps} samples, {study.method}, seed {study.seed}, "
        f"N = {study.model.scenario.horizon}, QPs by {backend_name}",
        title_justify="left",
        caption="RMSE of the state, over all times and from t = "
        f"{SETTLED:g} {study.model.scenario.time_unit} on. Kept: the observer's candidate was "
        "the estimate.",
        caption_justify="left",
    )
    table.add_column("QPs per sample", no_wrap=True)
    for name in ("RMSE\nall t", f"RMSE\nt >= {SETTLED:g}", "median\nus/step", "95 %\nus/step",
                 "improved", "kept"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            row.label, f"{row.rmse:.4f}", f"{row.rmse_settled:.4f}",
            f"{row.median_time * 1e6:.0f}", f"{row.high_time * 1e6:.0f}",
            f"{row.improved:.0%}", f"{1 - row.improved:.0%}",
        )
    return table


def _backend_table(compared: list[tuple[str, int | None, Row]], converged: float) -> Table:
    table = Table(
        title="Backends at i = 2 on the same data",
        title_justify="left",
        caption="Cap: iterations inside each QP. J excess: mean true cost above the converged "
        "one's, relative. Times hold the building of the QP.",
        caption_justify="left",
    )
    table.add_column("backend", no_wrap=True)
    for name in ("cap", "RMSE", "J excess", "improved", "median\nus/step"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("what stopped\nthe steps")
    previous = ""
    for name, cap, row in compared:
        if name != previous and previous:
            table.add_section()
        table.add_row(
            name if name != previous else "", "none" if cap is None else str(cap),
            f"{row.rmse:.4f}", f"{_excess(row, converged):.1e}", f"{row.improved:.0%}",
            f"{row.median_time * 1e6:.0f}", row.stopped,
        )
        previous = name
    return table


def _excess(row: Row, converged: float) -> float:
    return row.mean_cost / converged - 1.0


def _write(
    study: PaperStudy,
    out: Path,
    rows: list[Row],
    compared: list[tuple[str, int | None, Row]],
    converged: float,
) -> list[Path]:
    record, scenario = study.record(), study.model.scenario
    times = scenario.dt * np.arange(study.steps + 1, dtype=np.float64)
    drawn = {row.label: row.states for row in rows if row.label in _DRAWN}
    axes = trajectories(
        times, record.states, drawn, scenario.labels, f"time t ({scenario.time_unit})"
    )
    paths = save(axes[0].figure, out / "reproduce")
    columns = {"t": times}
    for j in range(record.states.shape[1]):
        columns[f"real_x{j + 1}"] = record.states[:, j]
    columns["y"] = np.append(record.measurements[:, 0], np.nan)
    for row in rows:
        for j in range(row.states.shape[1]):
            columns[f"{row.label.replace(' ', '_').replace('=', 'is')}_x{j + 1}"] = row.states[:, j]
    paths.append(out / "reproduce.csv")
    _write_csv(paths[-1], list(columns), np.column_stack(list(columns.values())).tolist())
    paths.append(out / "reproduce_summary.csv")
    _write_csv(
        paths[-1],
        ["run", "rmse", "rmse_settled", "median_s", "p95_s", "improved", "mean_J", "stopped"],
        [
            [row.label, row.rmse, row.rmse_settled, row.median_time, row.high_time, row.improved,
             row.mean_cost, row.stopped]
            for row in rows
        ],
    )
    paths.append(out / "reproduce_backends.csv")
    _write_csv(
        paths[-1],
        ["backend", "cap", "rmse", "J_excess", "improved", "median_s", "stopped"],
        [
            [name, cap, row.rmse, _excess(row, converged), row.improved, row.median_time,
             row.stopped]
            for name, cap, row in compared
        ],
    )
    return paths


_DRAWN = ("i = 0", "i = 2", "i = 5", "converged")


def _write_csv(path: Path, header: list[str], rows: list[list[object]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
