"""A record as arrays, read as a whole."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .._checks import Array
from ..estimation.steps import Steps
from .measurements import ColumnNames, Measurement, RecordReader, spacing
from .readers import ReadingOptions
from .record_model import RecordModel


class RecordArrays(NamedTuple):
    """Outputs (T, p), NaN in gaps; inputs (T, m) or None; and what else a record has.

    ``lengths`` (T,) are the step lengths if they differ, ``usual`` is the usual one, and ``states``
    (T, n) are the true states, if columns for them are named.
    """

    measurements: Array
    inputs: Array | None
    lengths: Array | None
    usual: float | None
    states: Array | None = None


def read_record(
    path: str, model: RecordModel, *, time: str | None = None, outputs: str | None = None,
    inputs: str | None = None, truth: str | None = None, dt: float | None = None,
    time_scale: float = 1.0, max_gap: int | None = None,
    report: Callable[[str], None] | None = None, **options: Any,
) -> RecordArrays:
    """Read a record of a model; the options are those of ``qpmhe estimate``, and ``truth``.

    What the user should know of its steps goes to `report`.
    """
    reading = ReadingOptions(**options)
    system, usual = model.estimator.system, model.dt if dt is None else dt
    columns = ColumnNames(model.outputs, model.inputs, time, outputs, inputs)
    make_steps = partial(Steps, system, usual=usual, scale=time_scale, max_gap=max_gap)
    steps = make_steps()
    found, notes = _read(path, columns, steps, reading)
    if report is not None:
        for note in [*notes, *([f"{path}: {steps.note}"] if steps.note else [])]:
            report(note)
    if truth is None:
        return found
    columns = ColumnNames(model.states, (), time, truth, option="truth")
    return found._replace(states=_read(path, columns, make_steps(), reading)[0].measurements)


def _read(
    path: str, columns: ColumnNames, steps: Steps, reading: ReadingOptions
) -> tuple[RecordArrays, list[str]]:
    reader = RecordReader(path, columns, reading)
    ys: list[Array] = []
    us: list[Array] = []
    lengths: list[float | None] = []
    before: Measurement | None = None
    try:
        for sample in reader.samples():
            if before is not None:
                try:
                    step = steps.between(*spacing(before.time, sample.time))
                except ValueError as error:
                    raise reader.error(f"{error}.", sample.line) from error
                ys += [np.full(sample.y.size, np.nan)] * step.inserted
                us += [before.u] * step.inserted
                lengths += [step.length] * (step.inserted + 1)
            ys.append(sample.y)
            us.append(sample.u)
            before = sample
    finally:
        reader.close()
    if not ys:
        raise reader.error("it has a header but no samples; expected one line per sample.", None)
    dt = None
    if any(each is not None for each in lengths):
        typical = steps.usual or np.nan
        dt = np.array([typical if each is None else each for each in [*lengths, None]])
    inputs = np.array(us) if us[0].size else None
    return RecordArrays(np.array(ys), inputs, dt, steps.usual), reader.notes
