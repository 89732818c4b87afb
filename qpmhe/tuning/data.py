"""The records that weights are tuned on, checked, and which of their blocks are held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import finite, shown

from .._checks import Array, numbers, vector
from ..errors import InvalidInputError, OptionError, ShapeError
from ..estimation.time_index import index_of, paired_record
from ..model.system import System
from ..models.scenario import Record

Mask = NDArray[np.bool_]

# Blocks of a record, at most, and measured numbers for each parameter, at least.
_BLOCKS, _LEAST = 12, 10


@dataclass(frozen=True, eq=False)
class TuningRecord:
    """A record to tune on.

    Parameters
    ----------
    measurements : (T, p) array_like, DataFrame or Series
        y(0), ..., y(T-1), NaN where they are missing. An index of times is the time axis, as in
        `MovingHorizonEstimator.run`.
    inputs : (T, m) array_like, DataFrame or Series, optional
        The inputs of the same times, without the model's parameters.
    states : (T, n) or (T + 1, n) array_like or DataFrame, optional
        The true states, NaN throughout in a column where a state has no truth. Where states and
        measurements have an index of times, they are paired by it.
    dt : (T,) array_like, optional
        Length of each step, from t to t + 1, where they are not the sampling time; to be left out
        where the measurements have times.
    initial_state : (n,) array_like, optional
        The estimate of x(0); the one given to `qpmhe.tune`, or the system's, if left out.
    name : str, optional
        What messages call it, such as its file.
    time_unit : str or pandas.Timedelta
        The model's unit of time, for an index of times.
    """

    measurements: ArrayLike
    inputs: ArrayLike | None = None
    states: ArrayLike | None = None
    dt: ArrayLike | None = None
    initial_state: ArrayLike | None = None
    name: str | None = None
    time_unit: Any = "s"


class Data:
    """A checked record: y (T, p), u (T, m), dt (T,) or None, truth or None, z(0), blocks."""

    def __init__(self, name: str, given: TuningRecord, system: System, inputs: int,
                 initial_state: Array | None) -> None:
        self.name = name
        names = f"measurements of {name}", f"inputs of {name}"
        paired = paired_record(
            system, given.measurements, given.inputs, inputs, given.time_unit, names
        )
        self.y = paired.measurements
        self.observed: Mask = np.isfinite(self.y)
        samples = len(self.y)
        if not samples:
            raise InvalidInputError(f"{name} has no samples; leave this record out.")
        if not self.observed.any():
            raise InvalidInputError(
                f"all measurements of {name} are missing; leave this record out, or check its "
                "columns."
            )
        if inputs and given.inputs is None:
            raise InvalidInputError(
                f"{name} has no inputs, and the system takes {inputs}; give (measurements, inputs)."
            )
        us = self.u = np.zeros((samples, 0)) if paired.inputs is None else paired.inputs
        if not np.isfinite(us).all():
            raise InvalidInputError(
                f"inputs of {name}: {int((~np.isfinite(us)).sum())} numbers missing; expected "
                f"{samples} samples without gaps. Hold the last value in gaps."
            )
        self.dt: Array | None = paired.lengths
        if given.dt is not None:
            if paired.times is not None:
                raise InvalidInputError(
                    f"{name} has step lengths (dt) and an index of times; leave out dt."
                )
            self.dt = vector(f"dt of {name}", given.dt, samples)
            if not (self.dt > 0.0).all():
                raise InvalidInputError(f"dt of {name} has steps <= 0; sort the record by time.")
            if not system.has_timed:
                raise InvalidInputError(
                    f"{name} has step lengths (dt), but the system is discrete; make it by "
                    "System.from_ode, or resample the record."
                )
        self.truth = None if given.states is None else _truth(
            name, paired.states(given.states, f"states of {name}"), system,
            np.asarray(self.observed.any(axis=1)),
        )
        start = initial_state
        if given.initial_state is not None:
            start = vector(f"initial_state of {name}", given.initial_state, system.n)
        if start is None:
            raise InvalidInputError(
                f"{name} has no initial_state; give tune(..., initial_state=x0), the estimate at "
                "the first measurement."
            )
        self.start: Array = start
        self.block = np.zeros(samples, np.intp)
        self.held: Mask = np.zeros(samples, np.bool_)

    def __len__(self) -> int:
        return len(self.y)

    def first(self, count: int) -> Data:
        """The first samples alone."""
        part = copy(self)
        for name in ("y", "observed", "u", "dt", "block", "held"):
            array = getattr(self, name)
            setattr(part, name, None if array is None else array[:count])
        return part

    def inputs(self, system: System, parameters: Mapping[str, float]) -> Array:
        """The inputs, followed by the model's parameters where these are inputs."""
        behind = list(parameters.values())[: system.m - self.u.shape[1]]
        return np.hstack((self.u, np.tile(behind, (len(self), 1)))) if behind else self.u


def _truth(name: str, given: ArrayLike, system: System, observed: Mask) -> Array:
    samples = len(observed)
    truth = numbers(f"states of {name}", given, finite=False)
    if truth.ndim != 2 or truth.shape[1] != system.n or len(truth) not in (samples, samples + 1):
        raise ShapeError(
            f"states of {name} have shape {truth.shape}; expected ({samples}, {system.n}), or one "
            "row more."
        )
    missing = ~np.isfinite(truth)
    # Where nothing was measured either, as in a gap of the record, it may be missing.
    needed = missing[:samples][observed]
    partly = needed.any(axis=0) & ~missing.all(axis=0)
    if partly.any() or missing.all():
        j = int(np.argmax(partly)) if partly.any() else 0
        rows = np.flatnonzero(missing[:samples, j] & observed)
        raise InvalidInputError(
            f"the truth of state {j + 1} of {name} is missing in {rows.size} rows, first in row "
            f"{rows[0]}; interpolate it, or make its whole column NaN: then the state counts as "
            "one without truth. Leave states out if no state has any."
        )
    return truth


def checked_data(
    records: Any, system: System, inputs: int, initial_state: ArrayLike | None
) -> list[Data]:
    """The records as `qpmhe.tune` takes them."""
    if isinstance(records, (TuningRecord, Record)) or index_of(records) is not None:
        records = [records]
    if not isinstance(records, Sequence) or isinstance(records, str) or not len(records):
        raise InvalidInputError(
            f"records is {shown(records)}; expected a list such as [(Y, U), ...], of arrays of "
            "measurements (T, p) and inputs (T, m), or of qpmhe.tuning.TuningRecord."
        )
    start = None if initial_state is None else vector("initial_state", initial_state, system.n)
    if start is None and system.signals is not None:
        start = np.array([float(one.value) for one in system.signals.states])
    found = []
    for k, one in enumerate(records):
        if isinstance(one, Record):
            made = TuningRecord(
                one.measurements, one.inputs, one.states,
                initial_state=one.initial_estimate if initial_state is None else None,
            )
        elif isinstance(one, TuningRecord):
            made = one
        elif isinstance(one, tuple) and 1 <= len(one) <= 3:
            made = TuningRecord(*one)
        elif isinstance(one, np.ndarray) or index_of(one) is not None:
            made = TuningRecord(one)
        else:
            raise InvalidInputError(
                f"records[{k}] is {shown(one)}; expected (Y,), (Y, U), (Y, U, X) or a "
                "qpmhe.tuning.TuningRecord."
            )
        found.append(Data(made.name or f"records[{k}]", made, system, inputs, start))
    return found


def hold_out(data: list[Data], share: float, least: int) -> None:
    """Cut each record into blocks of at least `least` samples; hold out some of them."""
    part = finite(share)
    if part is None or not 0.0 <= part <= 0.5:
        raise OptionError(f"held_out is {shown(share)}; expected a share from 0 to 0.5.")
    count = 0
    for one in data:
        parts = max(1, min(_BLOCKS, len(one) // least))
        one.block = count + np.arange(len(one)) * parts // len(one)
        count += parts
    if share == 0.0:
        return
    # Spread evenly, and never the first one: it begins with the initial error.
    wanted = max(1, round(share * count))
    chosen = np.unique(((np.arange(wanted) + 0.5) / wanted * count).astype(np.intp))
    if count < 3:
        samples = sum(map(len, data))
        raise InvalidInputError(
            f"the records have {samples} samples, too few for held-out blocks of {least}; record "
            "for longer, predict fewer steps ahead, or give held_out=0: then nothing judges the "
            "weights."
        )
    for one in data:
        one.held = np.isin(one.block, chosen)


def check_enough(data: list[Data], names: Sequence[str], noise: Sequence[int]) -> None:
    """Check that what is not held out can determine the parameters, `noise` the outputs' levels."""
    seen = sum(one.observed[~one.held].sum(axis=0) for one in data)
    for j in noise:
        if not seen[j]:
            raise InvalidInputError(
                f"output {j + 1} is missing in all blocks that tune, so its noise cannot be tuned; "
                "take structure='scalar', name the others only, as in structure={'noise': "
                "{'level': [0]}, 'disturbance': 'diagonal'}, or hold out other blocks."
            )
        values = [one.y[:, j][one.observed[:, j]] for one in data]
        if np.ptp(np.concatenate(values)) == 0.0:
            raise InvalidInputError(
                f"output {j + 1} never changes: all its measurements are {values[0][0]:g}, so its "
                "noise cannot be tuned. Check the sensor and the column, or leave it out of the "
                "structure of the noise."
            )
    if int(np.sum(seen)) < _LEAST * len(names):
        raise InvalidInputError(
            f"{int(np.sum(seen))} measured numbers are too few for {len(names)} parameters "
            f"({', '.join(names)}); expected {_LEAST} for each at least. Record for longer, or "
            "take structure='scalar' or groups."
        )


def constant_inputs(data: list[Data], needed: bool) -> list[int]:
    """The inputs that never change, which identify no parameters."""
    us = np.concatenate([one.u for one in data])
    still = np.flatnonzero(np.ptp(us, axis=0) == 0.0).tolist() if us.size else []
    if needed and us.shape[1] and len(still) == us.shape[1]:
        raise InvalidInputError(
            "all inputs are constant in all records: their effect cannot be distinguished from an "
            "offset, so parameters of the model cannot be tuned. Record with inputs that change, "
            "or leave parameters out."
        )
    return still
