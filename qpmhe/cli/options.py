"""Options that several commands take: what each is called, and what its help says."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from typing import Annotated, Any, Literal

import typer

Model = Annotated[
    str, typer.Argument(help="Model of the zoo, package.module:function or file.py:function.")
]
Horizon = Annotated[int | None, typer.Option(min=1, help="Horizon N; default is the model's.")]
InitialState = Annotated[
    str | None, typer.Option(help="Initial estimate, numbers separated by commas; default is the "
                                  "model's.")
]
Engine = Annotated[
    str | None,
    typer.Option(help="python, compiled, or auto: the compiled step if qpmhe compile has made it."),
]
Width = Annotated[
    str | None,
    typer.Option(help="Also write the figures as PDF, this wide: single (84 mm), double "
                      "(174 mm) or a number of inches."),
]
MaxDisturbance = Annotated[
    str | None,
    typer.Option(help="Largest |w| for proved bounds, one length or a number for each component; "
                      "default is W, else three standard deviations."),
]
MaxNoise = Annotated[str | None, typer.Option(help="Largest |v| for proved bounds, likewise.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]

#: What a record may be.
KINDS = "CSV (also .gz), Parquet, MF4, MAT, HDF5, MCAP or ROS bag"

# How a record is read: type, default and option.
_READING: dict[str, tuple[Any, Any, Any]] = {
    "time": (str | None, None, typer.Option(help="Column of the time.")),
    "outputs": (str | None, None, typer.Option(
        help="Columns of the outputs: y1=COLUMN,y2=COLUMN.")),
    "inputs": (str | None, None, typer.Option(
        help="Columns of the inputs: u1=COLUMN,u2=COLUMN.")),
    "truth": (str | None, None, typer.Option(
        help="Columns of true states: x1=COLUMN,x2=COLUMN.")),
    "dt": (float | None, None, typer.Option(
        help="Usual step of a discrete-time model, in the model's unit of time.")),
    "time_scale": (float, 1.0, typer.Option(
        help="The record's unit of time in the model's: 0.001 for a record in ms and a model in "
             "s.")),
    "max_gap": (int, 500, typer.Option(
        min=0, help="Largest number of missing samples in a row.")),
    "skip_repeated": (bool, False, typer.Option(
        "--skip-repeated", help="Skip lines with the same time as the line before.")),
    "same_time": (float | None, None, typer.Option(
        help="Times of channels with clocks of their own that differ by at most this (in s, or the "
             "file's unit) are one sample.")),
    "log_time": (bool, False, typer.Option(
        "--log-time", help="Of ROS bags: take the times of the log, not those of the headers.")),
    "separator": (str | None, None, typer.Option(
        help="Separator of a CSV file: a character, or comma, semicolon, tab, bar, space.")),
    "decimal": (Literal["auto", ".", ","], "auto", typer.Option(help="Decimal mark.")),
    "encoding": (str, "utf-8", typer.Option(help="Text encoding of a CSV file.")),
    "skip_lines": (int, 0, typer.Option(min=0, help="Lines of a CSV file above its header.")),
    "time_format": (str | None, None, typer.Option(
        help="Format of the dates, such as '%d/%m/%Y %H:%M:%S'; ISO dates and DD.MM.YYYY need "
             "none.")),
    "missing": (list[str] | None, None, typer.Option(
        metavar="WORD", help="Word for a missing value; may be repeated.")),
}


def reads_record(*left_out: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options for reading a record, without some.

    The command gets those that were given, or have a default, as the dict ``reading``.
    """
    chosen = [name for name in _READING if name not in left_out]

    def extended(command: Callable[..., None]) -> Callable[..., None]:
        @wraps(command)
        def called(**given: Any) -> None:
            reading = {name: given.pop(name) for name in chosen}
            given["reading"] = {name: one for name, one in reading.items() if one is not None}
            command(**given)

        # Typer reads the options from `__signature__`, which functions need not have.
        own = dict(signature(command, eval_str=True).parameters)
        del own["reading"]
        for name in chosen:
            kind, default, option = _READING[name]
            own[name] = Parameter(name, Parameter.KEYWORD_ONLY, default=default,
                                  annotation=Annotated[kind, option])
        called.__signature__ = signature(command).replace(  # type: ignore[attr-defined]
            parameters=[one.replace(kind=Parameter.KEYWORD_ONLY) for one in own.values()]
        )
        called.__annotations__ = {name: one.annotation for name, one in own.items()}
        return called

    return extended
