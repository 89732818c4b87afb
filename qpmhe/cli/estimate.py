"""``qpmhe estimate``: a measured record in, its estimates out."""

from __future__ import annotations

import os
import sys
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..errors import OptionError
from ..records import Summary, estimate_record
from ..records.errors import WriteError

__all__ = ["run"]

# Seconds until a bar appears, and from one of its pictures to the next.
_LONG, _REFRESH = 1.0, 0.1


def run(
    console: Console,
    model: str,
    record: str,
    out: str,
    *,
    max_qps: str | None = None,
    max_solver_iterations: str | None = None,
    initial_state: str | None = None,
    horizon: int | None = None,
    backend: str | None = None,
    engine: str | None = None,
    quiet: bool = False,
    **reading: Any,
) -> None:
    """Estimate a record, with a bar if it takes long, and tell what became of it.

    Parameters
    ----------
    console : rich.console.Console
        Where to tell; not standard output, which may hold the results.
    model, record, out
        As of `qpmhe.records.estimate_record`.
    max_qps, max_solver_iterations : str, optional
        Numbers; ``converged`` and ``none`` stand for None.
    initial_state : str, optional
        Numbers between commas.
    horizon, backend, engine : optional
        Options of the estimator.
    quiet : bool
        Tell nothing but errors.
    **reading
        All else that `qpmhe.records.estimate_record` takes.

    Raises
    ------
    QpmheError
        If something does not fit, or the record cannot be read on.
    SystemExit
        With 1 if whoever read the rows has gone; with 3 if the record was estimated to its end
        with a model that is wrong, or failed at most of the samples.
    """
    options: dict[str, Any] = {"horizon": horizon, "backend": backend, "engine": engine}
    options = {name: value for name, value in options.items() if value is not None}
    if max_qps is not None:
        options["max_qps"] = _number("--max-qps", max_qps, "converged")
    if max_solver_iterations is not None:
        options["max_solver_iterations"] = _number(
            "--max-solver-iterations", max_solver_iterations, "none"
        )
    if initial_state is not None:
        options["initial_state"] = _vector(initial_state)
    # A bar would stand among the rows.
    mixed = out == "-" and sys.stdout is not None and sys.stdout.isatty()
    bar = _Bar(console) if console.is_terminal and not (quiet or mixed) else None
    try:
        summary = estimate_record(
            model, record, out, progress=None if bar is None else bar.show,
            tell=None if quiet else lambda text: _warn(console, text), **reading, **options
        )
    except BrokenPipeError:  # whoever read the rows has had enough
        _leave_standard_output()
        raise SystemExit(1) from None
    except WriteError:
        if out == "-":
            _leave_standard_output()
        raise
    except KeyboardInterrupt:
        if out != "-":
            console.print("stopped; --resume goes on.", highlight=False)
        raise
    finally:
        if bar is not None:
            bar.close()
    most_failed = 2 * summary.failed > summary.samples + summary.inserted
    is_broken = summary.model_is_wrong or most_failed
    if not quiet:
        _tell(console, summary, out)
    if summary.failure and (is_broken or not quiet):
        _warn(console, summary.failure)
    if is_broken:
        raise SystemExit(3)


def _warn(console: Console, text: str) -> None:
    console.print(f"[bold yellow]warning:[/] {escape(text)}", highlight=False, soft_wrap=True)


def _leave_standard_output() -> None:
    """Write nothing more there; Python would try once more at its end, and complain."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _tell(console: Console, summary: Summary, out: str) -> None:
    told = [f"{summary.samples} samples"]
    if summary.before:
        told[0] += f" after {summary.before} before"
    told.append(f"{summary.improved} improved on the observer")
    for number, text in (
        (summary.incomplete, "with outputs missing"),
        (summary.inserted, "more put into gaps"),
        (summary.held, "blank inputs held"),
        (summary.repeated, "passed over, since their times were there already"),
    ):
        if number:
            told.append(f"{number} {text}")
    where = "" if out == "-" else f"; wrote {escape(out)}"
    console.print(", ".join(told) + where, highlight=False, soft_wrap=True)
    for note in summary.notes or ():
        console.print(f"[yellow]note:[/] {escape(note)}", highlight=False, soft_wrap=True)


class _Bar:
    """A bar that appears if there is time to look at it."""

    def __init__(self, console: Console) -> None:
        self._bar = Progress(
            TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
            TimeRemainingColumn(), console=console, transient=True, auto_refresh=False,
        )
        self._task = self._bar.add_task("", total=None)
        self._due, self._samples = monotonic() + _LONG, 0

    def show(self, position: int, total: int | None) -> None:
        """Show how far it is, now and then."""
        self._samples += 1
        if monotonic() < self._due:
            return
        self._bar.start()
        self._bar.update(
            self._task, completed=position, total=total, description=f"{self._samples} samples"
        )
        self._bar.refresh()
        self._due = monotonic() + _REFRESH

    def close(self) -> None:
        """Take it away."""
        self._bar.stop()


def _number(option: str, text: str, word: str) -> int | None:
    if text.strip() == word:
        return None
    try:
        return int(text)
    except ValueError:
        raise OptionError(f"{option} is {text!r}; expected an integer, or {word!r}.") from None


def _vector(text: str) -> NDArray[np.float64]:
    try:
        return np.array([float(item) for item in text.split(",")])
    except ValueError:
        raise OptionError(
            f"--initial-state is {text!r}; expected numbers between commas."
        ) from None
