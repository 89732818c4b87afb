"""``qpmhe tune``: measured records in, the weights of an estimator out."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markup import escape

from .._checks import make_folder
from ..errors import OptionError
from ..models.loading import ModelSource, find
from . import options
from .values import arguments_of, named_as_options, read_state, with_arguments

if TYPE_CHECKING:
    from ..records.record_model import RecordModel
    from ..tuning import Tuning, TuningRecord


@options.reads_record()
def tune(
    model: options.Model,
    record: Annotated[
        list[str], typer.Argument(help=f"Records with times: {options.KINDS}.")
    ],
    out: Annotated[Path, typer.Option(help="TOML file to write.")] = Path("weights.toml"),
    horizon: options.Horizon = None,
    structure: Annotated[
        Literal["diagonal", "scalar", "full"],
        typer.Option(help="Which parts of the covariances of disturbance and noise to tune."),
    ] = "diagonal",
    prior: Annotated[
        bool, typer.Option("--prior", help="Tune the covariance of the prior, too; needs "
                                           "several records.")
    ] = False,
    parameter: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=START", help="Argument of the model's function to tune; may be "
                     "repeated."),
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option(help="Use Huber's loss of the noise beyond this many standard deviations, "
                          "for records with outliers."),
    ] = None,
    objective: Annotated[
        Literal["auto", "likelihood", "prediction", "truth"],
        typer.Option(help="What to minimise after the likelihood; auto: the state error if --truth "
                          "is given."),
    ] = "auto",
    observers: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="Observers to compare, separated by commas: ekf, gated, "
                     "ukf, steady, file.py:function, or all for the first four; each is tuned "
                     "alone and with 1 and 2 QPs, and the simplest about as good as the best is "
                     "taken."),
    ] = None,
    initial_state: options.InitialState = None,
    held_out: Annotated[float, typer.Option(help="Share of the blocks held out to judge the "
                                                 "result.")] = 0.25,
    horizons: Annotated[
        str | None, typer.Option(help="Horizons to compare afterwards, separated by commas.")
    ] = None,
    starts: Annotated[
        int | None, typer.Option(min=1, help="Starting points of the search; 2 if the likelihood "
                                             "alone is searched, else 1.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the starting points.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Searches to run in parallel.")] = 1,
    engine: options.Engine = None,
    overwrite: options.Overwrite = False,
    picture: Annotated[
        Path | None, typer.Option(help="PNG of the weights and the held-out scores.")
    ] = None,
    reading: Any = None,
) -> None:
    """Choose the weights of an estimator from records; if stopped, the same command resumes."""
    from ..plots import save
    from ..records.record_model import load_record_model
    from ..tuning import tune as run
    from ..tuning.weights import covariances_of

    if out.exists() and not overwrite:
        raise OptionError(
            f"{out} exists already; give another --out, or replace it with --overwrite."
        )
    make_folder(out.parent)
    wanted, started, source = _integers("--horizons", horizons), _starts(parameter), find(model)
    given: dict[str, Any] = {
        "engine": engine, "horizon": horizon,
        "initial_state": None if initial_state is None else read_state(initial_state),
    }
    loaded = load_record_model(
        with_arguments(source.name, started),
        **{name: value for name, value in given.items() if value is not None},
    )
    mhe, records = loaded.estimator, _records(record, loaded, reading)
    try:
        with named_as_options(
            "held_out", "initial_state", "structure", "objective", "threshold", "horizon",
            "observers", "starts", "seed", "jobs",
        ):
            tuning = run(
                _maker(source) if started else mhe.system, records,
                **covariances_of(mhe.observer, mhe.cost), horizon=mhe.horizon,
                initial_state=mhe.initial_state, parameters=started, threshold=threshold,
                structure={"prior": "scalar" if prior else None, "disturbance": structure,
                           "noise": structure},
                observers=None if observers is None else _observers(observers),
                objective=objective, held_out=held_out, starts=starts, seed=seed, jobs=jobs,
                names={"states": loaded.states, "outputs": loaded.outputs},
                checkpoint=out.with_name(f"{out.name}.search"), progress=Console(stderr=True),
                engine=mhe.settings.engine,
            )
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted; the same command resumes.", highlight=False)
        raise
    _print(tuning, wanted)
    tuning.save(out)
    if picture is not None:
        save(tuning.plot()[0].figure, picture)
    Console().print(
        f"{sum(tuning.seconds.values()):.1f} s; wrote {escape(str(out))}. Use it: qpmhe estimate "
        f"{escape(model)} RECORD --weights {escape(str(out))}", highlight=False, soft_wrap=True,
    )


def _records(paths: list[str], model: RecordModel, reading: dict[str, Any]) -> list[TuningRecord]:
    from ..records.arrays import read_record
    from ..tuning import TuningRecord

    found = []
    for path in paths:
        y, u, lengths, _, states = read_record(path, model, **reading, report=_note)
        found.append(TuningRecord(y, u, states, lengths, name=path))
    return found


def _print(tuning: Tuning, horizons: list[int]) -> None:
    console = Console()
    console.print(str(tuning), highlight=False, markup=False, soft_wrap=True)
    for row in tuning.horizons(horizons) if horizons else ():
        console.print(
            f"N = {row.horizon:<4d} prior by the {row.arrival + ':':<10s} score {row.score:.4g}, "
            f"{1e6 * row.seconds:.0f} us a sample", highlight=False,
        )


def _note(text: str) -> None:
    Console(stderr=True).print(
        f"[yellow]note:[/] {escape(text)}", highlight=False, soft_wrap=True
    )


def _maker(source: ModelSource) -> Any:
    from ..records.record_model import load_system

    return lambda **parameters: load_system(replace(source, arguments=arguments_of(parameters)))


def _starts(given: list[str] | None) -> dict[str, float]:
    found = {}
    for item in given or []:
        name, equals, value = (part.strip() for part in item.partition("="))
        try:
            found[name] = float(value)
        except ValueError:
            equals = ""
        if not equals or not name.isidentifier():
            raise OptionError(
                f"--parameter is {item!r}; expected NAME=START with a number, such as mass=0.5."
            )
    return found


def _observers(text: str) -> str | list[str]:
    """The names of --observers: those in a list that commas outside of brackets separate."""
    found = [one.strip() for one in re.split(r",(?![^()]*\))", text) if one.strip()]
    return "all" if found == ["all"] else found


def _integers(option: str, text: str | None) -> list[int]:
    try:
        return [int(item) for item in text.split(",")] if text else []
    except ValueError:
        raise OptionError(f"{option} is {text!r}; expected integers separated by commas.") from None
