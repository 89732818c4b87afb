"""Records from pandas: an index of times is the time axis, by which rows are paired.

Objects of pandas are recognised without importing it: they exist only where the user has.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import Array, numbers, record
from ..errors import InvalidInputError, ShapeError
from ..model.system import System
from .steps import Steps

if TYPE_CHECKING:
    import pandas

# Times are of one sample if they differ by less, as a share of the mean step: they are rounded.
_TOGETHER = 1e-6


class PairedRecord(NamedTuple):
    """A record with a row for each sample, those that fill gaps included.

    Parameters
    ----------
    measurements : (T, p) array
        y, NaN in gaps.
    inputs : (T, m) array or None
        u; in gaps the row of their time, else the last one.
    lengths : (T,) array or None
        Length of each step in the model's unit of time; None if all are usual.
    times : pandas.DatetimeIndex or TimedeltaIndex, of T + 1 times; None without any
        Times of the samples, and of the state after the last.
    rows : (T,) array of int
        The row of the user's measurements that each sample is; -1 in gaps.
    """

    measurements: Array
    inputs: Array | None
    lengths: Array | None
    times: pandas.Index | None
    rows: NDArray[np.intp]

    def states(self, values: Any, name: str) -> Any:
        """True states at these samples: rows by their times, or those of the measurements."""
        if self.times is None:
            return values
        given = numbers(name, values, finite=False)
        if given.ndim != 2:
            return given  # refused where its shape is checked
        index = index_of(values)
        if has_times(index):
            _check_order(name, index, increasing=False)
            found = _positions(index, self.times, name)
        elif len(given) in (count := int((self.rows >= 0).sum()), count + 1):
            found = np.append(self.rows, count if len(given) > count else -1)
        else:
            return given
        return np.where((found >= 0)[:, None], given[found], np.nan)


def paired_record(
    system: System, measurements: ArrayLike, inputs: ArrayLike | None, width: int,
    time_unit: Any = "s", names: tuple[str, str] = ("measurements", "inputs"),
) -> PairedRecord:
    """Pair the rows of measurements and inputs, by their times where they have any.

    Parameters
    ----------
    system : System
        Its sampling time, if it has one, says which steps are usual.
    measurements, inputs : array_like, DataFrame or Series
        Rows y (T, p) and u (T, m).
    width : int
        m, the inputs that the user gives.
    time_unit : str or pandas.Timedelta
        The model's unit of time.
    names : tuple of str
        How messages call measurements and inputs.

    Raises
    ------
    ShapeError, InvalidInputError
        If a shape is wrong, times go backwards or repeat, a measurement has no inputs, or steps
        are none of this system.
    """
    if not (isinstance(time_unit, str) or hasattr(time_unit, "total_seconds")):
        raise _no_unit(time_unit)
    ys = record(names[0], measurements, system.p)
    us = None if inputs is None else record(names[1], inputs, width)
    times, others = index_of(measurements), index_of(inputs)
    if not has_times(times):
        if us is not None and len(us) != len(ys):
            raise ShapeError(
                f"{names[1]} has {len(us)} samples; expected {len(ys)}, one for each measurement."
            )
        if times is not None and others is not None and not times.equals(others):
            raise InvalidInputError(
                f"{names[1]} and {names[0]} have different indexes; give "
                f"{names[1]}.loc[{names[0]}.index], or arrays, which are paired by position."
            )
        return PairedRecord(ys, us, None, None, np.arange(len(ys)))
    _check_order(names[0], times)
    if us is not None and not has_times(others):
        if len(us) != len(ys):
            raise ShapeError(
                f"{names[1]} has {len(us)} rows without times; expected {len(ys)}, one for each "
                "measurement, or an index of times."
            )
        others = times
    return _filled(system, ys, us, times, others, time_unit, names)


def stored_index(index: pandas.Index | None) -> dict[str, NDArray[Any]]:
    """An index of times as arrays, for a file: nanoseconds, and the zone or "duration"."""
    if index is None:
        return {}
    durations = not hasattr(index, "tz")
    zone = "duration" if durations else "" if index.tz is None else str(index.tz)
    return {"index": index.as_unit("ns").asi8, "index_zone": np.array(zone)}


def read_index(arrays: dict[str, NDArray[Any]]) -> pandas.Index | None:
    """Take out of a file's arrays what `stored_index` put there; None without, or without pandas.

    A time zone whose name is not known here is read as UTC.
    """
    times, zone = arrays.pop("index", None), str(arrays.pop("index_zone", ""))
    if times is None or find_spec("pandas") is None:
        return None
    pandas = import_module("pandas")
    if zone == "duration":
        return pandas.to_timedelta(times, unit="ns")
    if not zone:
        return pandas.to_datetime(times, unit="ns")
    universal = pandas.to_datetime(times, unit="ns", utc=True)
    try:
        return universal.tz_convert(zone)
    except (KeyError, ValueError):  # zoneinfo's error of an unknown name is a KeyError
        return universal


def _filled(
    system: System, ys: Array, us: Array | None, times: Any, others: Any, time_unit: Any,
    names: tuple[str, str],
) -> PairedRecord:
    """The record with its gaps filled, and its steps."""
    seconds, unit = _elapsed(times), unit_seconds(time_unit)
    spacings = np.diff(seconds)
    usual = system.dt
    if usual is None and spacings.size:
        usual = float(np.median(spacings)) / unit
    steps = Steps(system, usual=usual, scale=1.0 / unit, scaling="time_unit", spacing="")
    first = [0] if len(ys) else []
    # Each sample's row, the row before it, and its time after that row.
    rows, before, after, lengths = [*first], [*first], [0.0] * len(first), []
    for row, spacing in enumerate(spacings):
        try:
            step = steps.between(float(spacing), max(1e-9, 4e-16 * float(seconds[-1])))
        except ValueError as error:
            raise InvalidInputError(f"{names[0]} at {times[row + 1]}: {error}.") from error
        count = step.inserted + 1
        rows += [-1] * step.inserted + [row + 1]
        before += [row] * step.inserted + [row + 1]
        after += [spacing * k / count for k in range(1, count)] + [0.0]
        lengths += [step.length] * count
    if steps.note:
        raise InvalidInputError(f"{names[0]}: {steps.note}")
    pandas = sys.modules["pandas"]
    index = times.take(before)
    if any(after):
        index += pandas.to_timedelta(np.round(1e9 * np.array(after)), unit="ns")
    if len(ys):
        step_time = pandas.NaT if steps.usual is None else pandas.Timedelta(steps.usual * unit, "s")
        index = index.append(times[-1:] + step_time)
    else:
        index = index.insert(0, pandas.NaT)
    index.name = times.name
    is_row = np.array(rows, np.intp)
    measured = np.where((is_row >= 0)[:, None], ys[is_row], np.nan) if len(ys) else ys
    paired = None
    if us is not None and len(ys):
        paired = _inputs_at(us, times, others, index, is_row, names)
    elif us is not None:
        paired = us[:0]
    steps_taken = None
    if any(one is not None for one in lengths):
        steps_taken = np.array([
            steps.usual if one is None else one for one in [*lengths, None]
        ], dtype=np.float64)
    return PairedRecord(measured, paired, steps_taken, index, is_row)


def _inputs_at(
    us: Array, times: Any, others: Any, index: Any, rows: NDArray[np.intp], names: tuple[str, str]
) -> Array:
    """The inputs at each sample: the row of its time; in a gap without one, the last."""
    if others is not times:
        _check_order(names[1], others, increasing=False)
    place = _positions(others, index, names[1])
    place = place[:-1]
    found = place[rows >= 0]
    missing = np.flatnonzero(found < 0)
    remedy = f"give {names[1]}.reindex({names[0]}.index, method='ffill') if they hold until changed"
    if missing.size:
        raise InvalidInputError(
            f"{names[1]} has no row at {times[missing[0]]}, and at {missing.size} of "
            f"{len(times)} times of {names[0]}; {remedy}."
        )
    unused = np.setdiff1d(np.flatnonzero((others > times[0]) & (others < times[-1])), place)
    if unused.size:
        raise InvalidInputError(
            f"{names[1]} has {unused.size} rows at times without a sample, such as "
            f"{others[unused[0]]}; {remedy}, or {names[0]} rows of NaN at these times."
        )
    # What fills a gap follows a row that is known.
    known = np.maximum.accumulate(np.where(place >= 0, np.arange(len(place)), 0))
    return us[place[known]]


def _positions(index: Any, times: Any, name: str) -> NDArray[np.intp]:
    """The row of an index at each of some times that increase; -1 where it has none."""
    order = index.argsort()
    tolerance = _TOGETHER * (times[:-1].max() - times[0]) / max(1, len(times) - 2)
    try:
        at = index[order].get_indexer(times, method="nearest", tolerance=tolerance)
    except TypeError as error:
        raise InvalidInputError(
            f"the times of {name} cannot be compared with those of the measurements ({error}); "
            "give both the same kind of index, with the same time zone."
        ) from error
    return np.where(at >= 0, order[at], -1)


def index_of(values: Any) -> Any:
    """The index of a Series or DataFrame, None for anything else."""
    pandas: Any = sys.modules.get("pandas")
    kinds = (getattr(pandas, "Series", ()), getattr(pandas, "DataFrame", ()))
    is_of_pandas: bool = pandas is not None and isinstance(values, kinds)
    return values.index if is_of_pandas else None


def names_of(values: Any) -> list[str] | None:
    """The names of a Series' entries; None for anything else, and where they are no texts."""
    index = index_of(values)
    if index is None or np.ndim(values) != 1 or not all(isinstance(one, str) for one in index):
        return None
    return [*index]


def has_times(index: Any) -> bool:
    """Whether an index is one of times."""
    pandas: Any = sys.modules.get("pandas")
    return index is not None and isinstance(
        index, (pandas.DatetimeIndex, pandas.TimedeltaIndex)
    )


def _check_order(name: str, index: Any, increasing: bool = True) -> None:
    """Raise unless each time is there once, and later than the one before."""
    if index.hasnans:
        raise InvalidInputError(
            f"the index of {name} has NaT in row {int(np.argmax(index.isna()))}; drop such rows."
        )
    if not index.is_unique:
        again = int(np.argmax(index.duplicated()))
        raise InvalidInputError(
            f"the index of {name} has {index[again]} twice; keep one row for each time."
        )
    if increasing and not index.is_monotonic_increasing:
        back = 1 + int(np.argmax(np.diff(index.asi8) < 0))
        raise InvalidInputError(
            f"the index of {name} goes backwards at {index[back]}, row {back}; give "
            f"{name}.sort_index()."
        )


def _elapsed(times: Any) -> Array:
    """Seconds since the first time."""
    if not len(times):
        return np.zeros(0)
    seconds: Array = (times - times[0]).total_seconds().to_numpy(np.float64)
    return seconds


def unit_seconds(time_unit: Any) -> float:
    """Seconds of a unit of time."""
    pandas = sys.modules["pandas"]
    try:
        found = pandas.Timedelta(1, time_unit) if isinstance(time_unit, str) else (
            pandas.Timedelta(time_unit)
        )
        seconds = float(found.total_seconds())
    except (ValueError, TypeError, AttributeError):
        seconds = np.nan
    if not seconds > 0.0:
        raise _no_unit(time_unit)
    return seconds


def elapsed_times(index: Any, time_unit: Any) -> Array:
    """The times of an index in this unit: durations, or since the first date."""
    durations = index - index[0] if hasattr(index, "tz") and len(index) else index
    return np.asarray(durations.total_seconds(), np.float64) / unit_seconds(time_unit)


def unit_name(time_unit: Any) -> str:
    """A unit of time in a label."""
    return time_unit if isinstance(time_unit, str) else f"{time_unit.total_seconds():g} s"


def _no_unit(time_unit: Any) -> InvalidInputError:
    return InvalidInputError(
        f"time_unit is {shown(time_unit)}; expected a unit of pandas, such as 's', 'min' or 'h', "
        "or a positive pandas.Timedelta."
    )
