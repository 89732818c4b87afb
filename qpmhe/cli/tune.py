"""``qpmhe tune``: measured records in, the weights of an estimator out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markup import escape

from .._checks import Array, make_folder
from ..errors import OptionError
from ..models.loading import build, find
from .values import arguments_of, read_state, with_arguments


def tune(
    model: Annotated[
        str, typer.Argument(help="Model of the zoo, package.module:function or file.py:function.")
    ],
    record: Annotated[
        list[str], typer.Argument(help="CSV (also .gz) or Parquet files with a time column.")
    ],
    out: Annotated[Path, typer.Option(help="What to write, a TOML file.")] = Path("weights.toml"),
    horizon: Annotated[int | None, typer.Option(help="N; default is the model's.")] = None,
    structure: Annotated[
        Literal["diagonal", "scalar", "full"],
        typer.Option(help="What is tuned of the covariances of disturbance and noise."),
    ] = "diagonal",
    prior: Annotated[
        bool, typer.Option("--prior", help="Tune the prior as well; wants several records.")
    ] = False,
    parameter: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=START", help="Argument of the model's function to tune; may be "
                     "repeated."),
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option(help="Huber's loss of the noise beyond so many standard deviations, for "
                     "records with outliers."),
    ] = None,
    objective: Annotated[
        Literal["auto", "likelihood", "prediction", "truth"],
        typer.Option(help="What is lowered after the likelihood; auto is the error, if --truth."),
    ] = "auto",
    truth: Annotated[
        str | None, typer.Option(help="Columns of true states: x1=COLUMN,x2=COLUMN.")
    ] = None,
    time: Annotated[str | None, typer.Option(help="Column of the time.")] = None,
    outputs: Annotated[
        str | None, typer.Option(help="Columns of the outputs: y1=COLUMN,y2=COLUMN.")
    ] = None,
    inputs: Annotated[
        str | None, typer.Option(help="Columns of the inputs: u1=COLUMN,u2=COLUMN.")
    ] = None,
    initial_state: Annotated[
        str | None, typer.Option(help="Numbers between commas; default is the model's.")
    ] = None,
    held_out: Annotated[float, typer.Option(help="Share of the blocks that judge.")] = 0.25,
    horizons: Annotated[
        str | None, typer.Option(help="Horizons to compare afterwards, between commas.")
    ] = None,
    starts: Annotated[int, typer.Option(min=1, help="Starts of the search.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the starts.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Starts at a time.")] = 1,
    engine: Annotated[str | None, typer.Option(help="python, compiled, or auto.")] = None,
    dt: Annotated[
        float | None, typer.Option(help="Usual step of a discrete-time model, in its time unit.")
    ] = None,
    time_scale: Annotated[
        float, typer.Option(help="The record's unit of time in the model's.")
    ] = 1.0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing file of weights.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(help="PNG of the weights and the held-out scores.")
    ] = None,
) -> None:
    """Choose the weights of an estimator from records; if it is stopped, the same call resumes."""
    from ..plots import save
    from ..records.measurements import ColumnNames
    from ..records.record_model import load_record_model
    from ..tuning import TuningRecord
    from ..tuning import tune as run
    from ..tuning.weights import covariances_of

    console = Console()
    if out.exists() and not overwrite:
        raise OptionError(
            f"{out} exists already; give another --out, or replace it by --overwrite."
        )
    make_folder(out.parent)
    wanted = _numbers("--horizons", horizons)
    started = _parameters(parameter or [])
    source = find(model)
    named = with_arguments(source.name, started)
    chosen: dict[str, Any] = {} if engine is None else {"engine": engine}
    if horizon is not None:
        chosen["horizon"] = horizon
    if initial_state is not None:
        chosen["initial_state"] = read_state(initial_state)
    loaded = load_record_model(named, **chosen)
    mhe = loaded.estimator
    columns = ColumnNames(loaded.outputs, loaded.inputs, time, outputs, inputs)
    count = len(loaded.states)
    known = ColumnNames(
        tuple(f"x{i + 1}" for i in range(count)), (), time,
        None if truth is None else _truth_columns(truth, count), None,
    )
    step = loaded.dt if dt is None else dt
    records = []
    for path in record:
        y, u, lengths = _read(path, columns, mhe.system, step, time_scale)
        states = None if truth is None else _read(path, known, mhe.system, step, time_scale)[0]
        records.append(TuningRecord(y, u, states, lengths))
    plan: Any = structure
    if prior:
        plan = {"prior": "scalar", "disturbance": structure, "noise": structure}
    system: Any = mhe.system
    if started:
        def make(**parameters: float) -> Any:
            made = build(replace(source, arguments=arguments_of(parameters)))
            return made[0] if isinstance(made, (tuple, list)) else made.system

        system = make
    found = covariances_of(mhe.observer, mhe.cost)
    try:
        tuning = run(
            system, records, horizon=mhe.horizon, initial_state=mhe.initial_state, structure=plan,
            prior=found["prior"], disturbance=found["disturbance"], noise=found["noise"],
            parameters=started, threshold=threshold,
            objective=objective, held_out=held_out, starts=starts, seed=seed, jobs=jobs,
            names={"states": loaded.states, "outputs": loaded.outputs},
            checkpoint=out.with_name(f"{out.name}.search"), progress=Console(stderr=True),
            engine=mhe.settings.engine,
        )
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted; the same command resumes.", highlight=False)
        raise
    console.print(str(tuning), highlight=False, markup=False, soft_wrap=True)
    for row in tuning.horizons(wanted) if wanted else ():
        console.print(
            f"N = {row.horizon:<4d} prior by the {row.arrival + ':':<10s} score {row.score:.4g}, "
            f"{1e6 * row.seconds:.0f} us a sample", highlight=False,
        )
    tuning.save(out)
    if picture is not None:
        save(tuning.plot()[0].figure, picture)
    console.print(
        f"{sum(tuning.seconds.values()):.1f} s; wrote {escape(str(out))}. Use it: qpmhe estimate "
        f"{escape(model)} RECORD --weights {escape(str(out))}", highlight=False, soft_wrap=True,
    )


def _read(
    path: str, columns: Any, system: Any, usual: float | None, scale: float
) -> tuple[Array, Array | None, Array | None]:
    """Outputs, inputs and lengths of the steps of a file, gaps filled by missing samples."""
    import numpy as np

    from ..records.measurements import RecordReader, seconds_between
    from ..records.steps import Steps

    reader, steps = RecordReader(path, columns), Steps(system, usual=usual, scale=scale)
    ys, us, lengths, before = [], [], [], None
    try:
        for sample in reader.samples():
            if before is not None:
                value = sample.time.value
                size = abs(value) if isinstance(value, float) else 0.0
                try:
                    step = steps.between(seconds_between(before.time, sample.time), size)
                except ValueError as error:
                    raise reader.error(f"{error}.", sample.line) from error
                for _ in range(step.inserted):
                    ys.append(np.full(sample.y.size, np.nan))
                    us.append(before.u)
                lengths += [np.nan if step.length is None else step.length] * (step.inserted + 1)
            ys.append(sample.y)
            us.append(sample.u)
            before = sample
    finally:
        reader.close()
    if not ys:
        raise reader.error("it has a header and no samples; expected a line for each.", None)
    dt = np.array([*lengths, np.nan])
    own = None
    if np.isfinite(dt).any():
        own = np.where(np.isfinite(dt), dt, steps.usual or np.nan)
    return np.array(ys), np.array(us) if us[0].size else None, own


def _truth_columns(truth: str, count: int) -> str:
    """The columns of true states, with no column for states that the option does not name."""
    named = {item.partition("=")[0].strip() for item in truth.split(",")}
    states = [f"x{i + 1}" for i in range(count)]
    if "=" not in truth or named - set(states):
        raise OptionError(
            f"--truth is {truth!r}; expected NAME=COLUMN between commas, with names of "
            f"{', '.join(states)}."
        )
    return ",".join([truth, *(f"{name}=" for name in states if name not in named)])


def _parameters(given: list[str]) -> dict[str, float]:
    found = {}
    for item in given:
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


def _numbers(option: str, text: str | None) -> list[int]:
    try:
        return [int(item) for item in text.split(",")] if text else []
    except ValueError:
        raise OptionError(f"{option} is {text!r}; expected integers between commas.") from None
