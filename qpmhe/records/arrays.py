"""A record as arrays, read as a whole."""

from __future__ import annotations

import numpy as np

from .._checks import Array
from ..model.system import System
from .measurements import ColumnNames, Measurement, RecordReader, seconds_between
from .steps import Steps


def read_arrays(
    path: str, columns: ColumnNames, system: System, usual: float | None, scale: float
) -> tuple[Array, Array | None, Array | None]:
    """Outputs, inputs and, where they differ, lengths of the steps; NaN in y fills the gaps."""
    reader, steps = RecordReader(path, columns), Steps(system, usual=usual, scale=scale)
    ys: list[Array] = []
    us: list[Array] = []
    lengths: list[float | None] = []
    before: Measurement | None = None
    try:
        for sample in reader.samples():
            if before is not None:
                value = sample.time.value
                size = abs(value) if isinstance(value, float) else 0.0
                try:
                    step = steps.between(seconds_between(before.time, sample.time), size)
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
        raise reader.error("it has a header and no samples; expected a line for each.", None)
    dt = None
    if any(each is not None for each in lengths):
        usual = steps.usual or np.nan
        dt = np.array([usual if each is None else each for each in [*lengths, None]])
    return np.array(ys), np.array(us) if us[0].size else None, dt
