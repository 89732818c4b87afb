"""``qpmhe estimate``: a measured record in, its estimates out."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..errors import InvalidInputError, ModelError, OptionError
from . import options
from .values import read_box, read_numbers, read_state, with_arguments

if TYPE_CHECKING:
    from ..records import Latency
    from ..records.bounds import BoundOptions


@options.reads_record("truth")
def estimate(
    model: options.Model,
    record: Annotated[
        str,
        typer.Argument(help=f"{options.KINDS}, with times; - is standard input."),
    ],
    out: Annotated[
        str, typer.Option(help="File to write, .csv, .parquet or .jsonl; - is standard output.")
    ] = "-",
    horizon: options.Horizon = None,
    backend: Annotated[str | None, typer.Option(help="QP backend.")] = None,
    max_qps: Annotated[
        str | None, typer.Option(help="QPs per sample; 0 is the observer, none iterates to "
                                "convergence.")
    ] = None,
    max_solver_iterations: Annotated[
        str | None, typer.Option(help="Cap on the solver's iterations in each QP; none removes "
                                      "it.")
    ] = None,
    initial_state: options.InitialState = None,
    engine: options.Engine = None,
    weights: Annotated[
        Path | None,
        typer.Option(help="File that qpmhe tune wrote: take observer, cost, horizon, QPs per "
                          "sample and the model's parameters from it."),
    ] = None,
    covariances: Annotated[
        Literal["none", "std", "full"],
        typer.Option(help="Write standard deviations or full covariances of the estimates."),
    ] = "none",
    step_time: Annotated[
        bool, typer.Option(help="Write the seconds that each step took.")
    ] = True,
    bound: Annotated[
        bool,
        typer.Option("--bound", help="Write the proved set around the observer that contains the "
                                     "true state, and the bound on the estimate's error."),
    ] = False,
    bound_box: Annotated[
        str | None,
        typer.Option(help="For --bound: set of states, such as 0.1:9,-1:9; default as for "
                          "certify."),
    ] = None,
    bound_input_box: Annotated[
        str | None, typer.Option(help="For --bound: set of inputs, in the form of --bound-box.")
    ] = None,
    initial_error: Annotated[
        str | None,
        typer.Option(help="For --bound: largest |x - z| at the start, one length or a number "
                          "for each state; default is the scenario's."),
    ] = None,
    max_disturbance: options.MaxDisturbance = None,
    max_noise: options.MaxNoise = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an estimation that was interrupted.")
    ] = False,
    overwrite: options.Overwrite = False,
    checkpoint_every: Annotated[
        int | None, typer.Option(min=1, help="Samples between checkpoints; default 100.")
    ] = None,
    equal_steps: Annotated[
        bool,
        typer.Option("--equal-steps", help="Require equal steps; each row is written at once."),
    ] = False,
    format: Annotated[  # noqa: A002 - as the option
        Literal["auto", "csv", "jsonl"],
        typer.Option(help="Lines on standard input and output: CSV, or JSON objects."),
    ] = "auto",
    latency: Annotated[
        bool,
        typer.Option("--latency", help="Report the time from a line in to a line out, at the end "
                                       "and on the signal USR1."),
    ] = False,
    deadline: Annotated[
        float | None, typer.Option(help="For --latency: seconds after which a line is late.")
    ] = None,
    diagnose: Annotated[
        str | None,
        typer.Option(metavar="FILE.html", help="Look for faults of sensors, model and weights, "
                                               "and write a page about them."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print errors only.")] = False,
    reading: Any = None,
) -> None:
    """Estimate the states of a measured record; in a pipe, line by line."""
    given: dict[str, Any] = {
        name: value for name, value in locals().items() if value is not None
    }
    given |= given.pop("reading")
    if max_qps is not None:
        given["max_qps"] = _number("--max-qps", max_qps)
    if max_solver_iterations is not None:
        given["max_solver_iterations"] = _number(
            "--max-solver-iterations", max_solver_iterations
        )
    if initial_state is not None:
        given["initial_state"] = read_state(initial_state)
    bounds = {name: given.pop(name, None) for name in _OF_BOUND}
    if bound or any(value is not None for value in bounds.values()):
        given["bound"] = bound_options(**bounds)
    if weights is not None:
        given = _weighted(given)
    given.pop("deadline", None)
    if given.pop("latency") or deadline is not None:
        from ..records import Latency

        given["latency"] = Latency(deadline)
    run(Console(stderr=True), **given)


_OF_BOUND = ("bound_box", "bound_input_box", "initial_error", "max_disturbance", "max_noise")


def bound_options(
    bound_box: str | None = None, bound_input_box: str | None = None, **sizes: str | None
) -> BoundOptions:
    """The options of --bound, read."""
    from ..records.bounds import BoundOptions

    numbers = {
        name: None if text is None else read_numbers(f"--{name.replace('_', '-')}", text)
        for name, text in sizes.items()
    }
    return BoundOptions(
        None if bound_box is None else read_box("--bound-box", bound_box),
        None if bound_input_box is None else read_box("--bound-input-box", bound_input_box),
        **numbers,
    )


def _weighted(given: dict[str, Any]) -> dict[str, Any]:
    """The options, with what the file of weights says of observer, cost, model and horizon."""
    from ..models.loading import find
    from ..records.record_model import load_system
    from ..tuning import WeightsError, load

    path, model = given.pop("weights"), given["model"]
    found = load(path)
    named = with_arguments(model, found.parameters)
    remedy = f"make weights for this model: qpmhe tune {model} RECORD --out FILE."
    try:
        system = load_system(find(named))
    except ModelError as error:
        if not found.parameters:
            raise
        raise WeightsError(
            f"{path} holds the parameters {', '.join(found.parameters)}, and with them "
            f"{str(error).rstrip('.')}; {remedy}"
        ) from error
    sizes = [len(each) for each in (found.prior, found.disturbance, found.noise)]
    if sizes != [system.n, system.r, system.p]:
        raise WeightsError(
            f"{path} holds weights of {sizes[0]} states, {sizes[1]} disturbances and {sizes[2]} "
            f"outputs, and model {model!r} has {system.n}, {system.r} and {system.p}; {remedy}"
        )
    if found.max_qps is not None:
        given = {"max_qps": found.max_qps, **given}
    return {
        "horizon": found.horizon, **given, "model": named,
        "observer": found.observer(system=system), "cost": found.cost(),
    }


def run(
    console: Console, model: str, record: str, out: str, *, diagnose: str | None = None,
    quiet: bool = False, latency: Latency | None = None, **options: Any,
) -> None:
    """Call `qpmhe.records.estimate_record` with the options, and print what happened."""
    from ..records import estimate_record

    if diagnose is not None:
        _check_page(diagnose)

    # A bar would stand among the rows.
    mixed = out == "-" and sys.stdout is not None and sys.stdout.isatty()
    try:
        with _reported(console, latency), Progress(
            TextColumn("estimating"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
            console=console, transient=True, redirect_stdout=False,  # it holds the rows
            disable=quiet or mixed or not console.is_terminal,
        ) as bar:
            task = bar.add_task("", total=None)
            summary = estimate_record(
                model, record, out, keep_run=diagnose is not None, latency=latency, **options,
                progress=lambda done, total: bar.update(task, completed=done, total=total),
                report=None if quiet else lambda text: _warn(console, text),
            )
    except BrokenPipeError:
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        if out != "-":
            console.print("interrupted; continue with --resume.", highlight=False)
        raise
    most_failed = 2 * summary.failed > summary.samples + summary.inserted
    is_broken = summary.model_is_wrong or most_failed
    if not quiet:
        _print(console, summary, out)
    if diagnose is not None:
        _diagnose(console, summary, diagnose, quiet)
    if summary.failure and (is_broken or not quiet):
        _warn(console, summary.failure)
    if is_broken:
        raise SystemExit(3)


@contextmanager
def _reported(console: Console, latency: Latency | None) -> Iterator[None]:
    """Print the latency at the end, however that comes, and on a signal."""
    if latency is None:
        yield
        return

    def show(*_: Any) -> None:
        console.print(str(latency), highlight=False, soft_wrap=True)

    number = getattr(signal, "SIGUSR1", None)  # Windows has none
    before = None if number is None else signal.signal(number, show)
    try:
        yield
    finally:
        if number is not None:
            signal.signal(number, before)
        show()


def _check_page(path: str) -> None:
    if Path(path).suffix.lower() not in (".html", ".htm") or Path(path).is_dir():
        raise OptionError(f"--diagnose is {path!r}; expected the name of an .html file to write.")


def _diagnose(console: Console, summary: Any, path: str, quiet: bool) -> None:
    """Look for faults in the run, and write the page."""
    from ..diagnosis import diagnose

    model = summary.model
    try:
        found = diagnose(
            summary.run, labels=model.states, outputs=model.outputs, inputs=model.inputs,
            dt=model.dt,
        )
    except InvalidInputError as error:  # the estimates are written all the same
        _warn(console, f"no diagnosis: {error}")
        return
    found.report(path)
    if not quiet:
        console.print(escape(str(found)), highlight=False, soft_wrap=True)
        console.print(f"wrote {escape(path)}", highlight=False, soft_wrap=True)


def _warn(console: Console, text: str) -> None:
    console.print(f"[bold yellow]warning:[/] {escape(text)}", highlight=False, soft_wrap=True)


def _print(console: Console, summary: Any, out: str) -> None:
    words = [f"{summary.samples} samples"]
    if summary.before:
        words[0] += f" after {summary.before} before"
    words.append(f"{summary.improved} improved on the observer")
    if summary.engine != "python":
        words.append(f"engine {summary.engine}")
    for number, text in (
        (summary.incomplete, "with missing outputs"),
        (summary.inserted, "inserted into gaps"),
        (summary.held, "missing inputs held"),
        (summary.repeated, "skipped because they repeat a time"),
    ):
        if number:
            words.append(f"{number} {text}")
    where = "" if out == "-" else f"; wrote {escape(out)}"
    console.print(", ".join(words) + where, highlight=False, soft_wrap=True)
    for note in summary.notes:
        console.print(f"[yellow]note:[/] {escape(note)}", highlight=False, soft_wrap=True)


def _number(option: str, text: str) -> int | None:
    if text.strip() == "none":
        return None
    try:
        return int(text)
    except ValueError:
        raise OptionError(f"{option} is {text!r}; expected an integer, or 'none'.") from None
