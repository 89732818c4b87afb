"""Options that several commands take: what each is called, and what its help says."""

from __future__ import annotations

from typing import Annotated

import typer

Model = Annotated[
    str, typer.Argument(help="Model of the zoo, package.module:function or file.py:function.")
]
Horizon = Annotated[int | None, typer.Option(min=1, help="Horizon N; default is the model's.")]
InitialState = Annotated[
    str | None, typer.Option(help="Initial estimate, numbers between commas; default is the "
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
TimeScale = Annotated[float, typer.Option(help="Length of the record's unit of time in the "
                                               "model's: 0.001 for milliseconds and seconds.")]
Engine = Annotated[
    str | None,
    typer.Option(help="python, compiled or auto, which takes the compiled step where qpmhe "
                      "compile has made it."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]
