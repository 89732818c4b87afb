"""Options that several commands take: what each is called, and what its help says."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

Model = Annotated[
    str, typer.Argument(help="Model of the zoo, package.module:function or file.py:function.")
]
Horizon = Annotated[int | None, typer.Option(min=1, help="Horizon N; default is the model's.")]
InitialState = Annotated[
    str | None, typer.Option(help="Initial estimate, numbers separated by commas; default is the "
                                  "model's.")
]
Time = Annotated[str | None, typer.Option(help="Column of the time.")]
Outputs = Annotated[
    str | None, typer.Option(help="Columns of the outputs: y1=COLUMN,y2=COLUMN.")
]
Inputs = Annotated[str | None, typer.Option(help="Columns of the inputs: u1=COLUMN,u2=COLUMN.")]
Step = Annotated[
    float | None, typer.Option(help="Usual step of a discrete-time model, in the model's unit "
                                    "of time.")
]
TimeScale = Annotated[float, typer.Option(help="The record's unit of time in the model's: 0.001 "
                                               "for a record in ms and a model in s.")]
MaxGap = Annotated[
    int, typer.Option(min=0, help="Largest number of missing samples in a row.")
]
Engine = Annotated[
    str | None,
    typer.Option(help="python, compiled, or auto: the compiled step if qpmhe compile has made it."),
]
Truth = Annotated[
    str | None, typer.Option(help="Columns of true states: x1=COLUMN,x2=COLUMN.")
]
SkipRepeated = Annotated[
    bool, typer.Option("--skip-repeated", help="Skip lines with the same time as the line before.")
]
Separator = Annotated[
    str | None, typer.Option(help="Separator of a CSV file: a character, or comma, semicolon, "
                                  "tab, bar, space.")
]
Decimal = Annotated[Literal["auto", ".", ","], typer.Option(help="Decimal mark.")]
Encoding = Annotated[str, typer.Option(help="Text encoding of a CSV file.")]
SkipLines = Annotated[int, typer.Option(min=0, help="Lines of a CSV file above its header.")]
TimeFormat = Annotated[
    str | None,
    typer.Option(help="Format of the dates, such as '%d/%m/%Y %H:%M:%S'; ISO dates and "
                      "DD.MM.YYYY need none."),
]
Missing = Annotated[
    list[str] | None,
    typer.Option(metavar="WORD", help="Word for a missing value; may be repeated."),
]
Width = Annotated[
    str | None,
    typer.Option(help="Also write the figures as PDF, this wide: single (84 mm), double "
                      "(174 mm) or a number of inches."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]
