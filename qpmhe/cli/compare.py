"""``qpmhe compare`` and ``qpmhe study``: run a study, show its summary, write its report."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from .._checks import count, make_folder
from ..errors import OptionError
from ..studies import Store, Study, StudyError, run
from ..studies.grid import WORDS, Measure
from ..studies.report import check_libraries
from . import options
from .report import show_report
from .values import named_as_options, read_numbers

_JOBS = typer.Option(min=1, help="Cells to run in parallel, default all cores; to measure "
                                 "times, give 1.")
_SCHEDULER = typer.Option(help="Address of a Dask scheduler whose workers run the cells.")
_FAILING = typer.Option(metavar="DIR", help="Folder for QPs on which a backend failed or gave "
                                             "up without a cap, for qpmhe solve-qp; stored "
                                             "cells do not run again.")
_RETRY = typer.Option("--retry-failed", help="Rerun failed cells.")


@options.reads_record("max_gap")
def compare(
    model: Annotated[
        list[str] | None,
        typer.Option(help="Model of the zoo, package.module:function or file.py:function; may be "
                     "repeated. The paper's reactor if left out."),
    ] = None,
    record: Annotated[
        list[str] | None,
        typer.Option(help=f"Measured record with times to compare on, {options.KINDS}; may be "
                          "repeated. Seeds and noise levels do not apply."),
    ] = None,
    backend: Annotated[
        list[str] | None,
        typer.Option(help="QP backend; may be repeated. All installed ones if left out."),
    ] = None,
    observer: Annotated[
        list[str] | None,
        typer.Option(help="Observer: model for the model's own, ekf, gated, ukf, steady, or a "
                          "function, named as for --model, that takes a "
                          "qpmhe.baselines.Problem; may be repeated."),
    ] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(help="Another estimator to compare with: ekf, ukf, enkf, particles, or such "
                          "a function; NAME=... names it; may be repeated."),
    ] = None,
    qps: Annotated[
        str, typer.Option(help="QPs per sample, separated by commas; 0 is the observer, none "
                          "iterates to convergence.")
    ] = "0,1,2,5,none",
    solver_iterations: Annotated[
        str, typer.Option(help="Caps on the iterations inside each QP, separated by commas.")
    ] = "1,2,5,10,none",
    horizons: Annotated[
        str, typer.Option(help="Horizons N, separated by commas; default is the model's own.")
    ] = "default",
    noise_levels: Annotated[
        str, typer.Option(help="Factors on the standard deviations of the simulated disturbance "
                               "and noise, separated by commas.")
    ] = "1",
    start: Annotated[
        list[str] | None, typer.Option(help="candidate or best; may be repeated.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds.")] = 20,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Samples of each record; default is the model's own, or 100 if no "
                                 "model is named."),
    ] = None,
    measure: Annotated[
        Measure, typer.Option(help="What to measure; for times alone, one cell runs at a time.")
    ] = "both",
    deadline: Annotated[
        float | None, typer.Option(help="Deadline of a step in seconds; the report shows how "
                                        "many steps miss it.")
    ] = None,
    covariances: Annotated[
        bool, typer.Option("--covariances", help="Compute covariances and the NEES, too.")
    ] = False,
    cell_timeout: Annotated[
        float, typer.Option(help="Seconds after which a cell is stopped.")
    ] = 60.0,
    store: Annotated[
        Path, typer.Option(help="File of the results; a stopped study resumes from it.")
    ] = Path("results/compare.sqlite"),
    out: Annotated[Path, typer.Option(help="Folder of the report.")] = Path("results/compare"),
    jobs: Annotated[int | None, _JOBS] = None,
    scheduler: Annotated[str | None, _SCHEDULER] = None,
    retry_failed: Annotated[bool, _RETRY] = False,
    keep_failing: Annotated[Path | None, _FAILING] = None,
    reading: Any = None,
) -> None:
    """Compare QP backends, caps and numbers of QPs: accuracy and time, a table and a report."""
    if model is None and steps is None and record is None:
        steps = 100  # all backends at all caps are to be done within ten minutes
    with named_as_options(
        "noise_levels", "seeds", "steps", "deadline", "cell_timeout", starts="--start",
        observers="--observer", estimators="--estimator",
    ):
        what = Study(
            models=model or ("batch_reactor",), records=record or (),
            reading=reading if record else {}, backends=backend or None,
            observers=observer or ("model",), estimators=_labelled(estimator or ()),
            qps=_numbers("qps", qps),
            solver_iterations=_numbers("solver_iterations", solver_iterations),
            horizons=_numbers("horizons", horizons),
            noise_levels=read_numbers("--noise-levels", noise_levels).tolist(),
            starts=start or ("candidate",), seeds=seeds, steps=steps, measure=measure,
            deadline=deadline, covariances=covariances, cell_timeout=cell_timeout,
        )
    _run(
        what, store, out, jobs=jobs, scheduler=scheduler, retry_failed=retry_failed,
        keep_failing=keep_failing,
    )


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
    keep_failing: Annotated[Path | None, _FAILING] = None,
) -> None:
    """Run the study in a file; if it is stopped, the same command resumes it."""
    target = file.with_suffix(".sqlite") if store is None else store
    _run(
        Study.from_toml(file), target,
        target.with_name(f"{target.stem}-report") if out is None else out,
        jobs=jobs, scheduler=scheduler, retry_failed=retry_failed, keep_failing=keep_failing,
    )


def _run(what: Study, store: Path, out: Path, **options: Any) -> None:
    console = Console()
    # What the report lacks would otherwise be known only when all cells have run.
    check_libraries()
    make_folder(store.parent)
    make_folder(out)
    # As after Ctrl-C, worker processes and progress bar end before this process.
    before = signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
    try:
        with named_as_options("jobs"):
            # The tables on standard output can be redirected without the bar.
            frame = run(what, Store(store), progress=Console(stderr=True), **options).frame()
    except (KeyboardInterrupt, SystemExit):
        console.print(
            f"stopped; all finished cells are in {store}, and the same command resumes the study."
        )
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
    cells = frame[frame["key"].isin({cell.key for cell in what.cells()})]
    failed = cells[cells["outcome"] == "failed"]
    if 0 < len(failed) < len(cells):
        reasons = failed["reason"].value_counts()
        count = f", {reasons.iloc[0]} for this reason" if len(reasons) > 1 else ""
        console.print(
            f"{len(failed)} of {len(cells)} cells failed{count}: {reasons.index[0]}\n"
            "The report gives all reasons.",
            style="yellow", highlight=False, markup=False, soft_wrap=True,
        )
    show_report(console, store, out)
    _show_kept(console, options["keep_failing"])
    if 0 < len(failed) == len(cells):
        raise StudyError(
            f"no cell of the study finished, {len(failed)} failed; the first reason: "
            f"{failed['reason'].iloc[0].rstrip('.')}. Correct that, then give the same command "
            "with --retry-failed."
        )


def _show_kept(console: Console, folder: Path | None) -> None:
    if folder is None:
        return
    count = sum(1 for _ in folder.glob("*/*.npz"))
    console.print(
        f"{folder} has {count} QP{'s' * (count != 1)} that a backend failed on or gave up without "
        f"a cap. Solve them again: qpmhe solve-qp {folder} --all" if count
        else f"{folder} has no QPs: every backend solved its QPs, or stopped at a cap.",
        highlight=False, markup=False, soft_wrap=True,
    )


def _labelled(texts: Sequence[str]) -> dict[str, str]:
    """Names of estimators, and of the functions that make them."""
    found: dict[str, str] = {}
    for text in texts:
        parts = re.fullmatch(r"([^=:()]+)=(.*)", text, re.DOTALL)
        name, maker = (parts[1].strip(), parts[2].strip()) if parts else (text, text)
        if found.setdefault(name, maker) != maker:
            raise OptionError(
                f"--estimator has the name {name!r} for {found[name]!r} and for {maker!r}; give "
                "each a name of its own, as in NAME=ekf."
            )
    return found


def _numbers(name: str, text: str) -> list[int | None]:
    """The numbers of an option, in which a word stands for None."""
    found: list[int | None] = []
    for item in text.split(","):
        word = item.strip()
        least = 0 if name == "qps" else 1
        try:
            found.append(None if word == WORDS[name] else count(name, int(word), least))
        except ValueError as error:
            option = name.replace("_", "-")
            raise OptionError(
                f"--{option} has {word!r}; expected integers >= {least} separated by commas, or "
                f"{WORDS[name]!r}."
            ) from error
    return found
