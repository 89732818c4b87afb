"""Channels that have clocks of their own, as the rows of a table with one time axis.

A row holds the values whose times are equal to within a tolerance. Outputs without a value there
are missing, inputs keep their last one, and nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .tables import RecordError, Table, TableRow

_BATCH = 4096
# Times of several channels that differ by less are one sample, as a share of the shortest mean
# step: files round their times.
_TOGETHER = 1e-6


class Signal(NamedTuple):
    """A channel's values (T,), and their times (T,)."""

    times: NDArray[Any]
    values: NDArray[Any]


@dataclass(eq=False)
class Channels:
    """What a file holds.

    Parameters
    ----------
    names, units : list of str
        One for each channel; the names differ, a unit that is not known is blank.
    load : callable
        Reads the channels at some positions.
    close : callable
        Closes the file.
    time : str
        What the file calls its time.
    dates : bool
        Whether times are integers that count nanoseconds since 1970, not numbers.
    start : datetime, optional
        The date of time 0, where times are seconds since then.
    notes : list of str
        What the user should know of the file; `load` may add to it.
    hint : str
        What an error about its columns adds.
    same_clock : str
        What else an error about two clocks advises.
    """

    names: list[str]
    units: list[str]
    load: Callable[[Sequence[int]], list[Signal]]
    close: Callable[[], None] = lambda: None
    time: str = "time"
    dates: bool = False
    start: datetime | None = None
    notes: list[str] = field(default_factory=list)
    hint: str = ""
    same_clock: str = ""


class ChannelTable(Table):
    """The table of some channels; only these are read.

    Parameters
    ----------
    name : str
        The file.
    channels : Channels
        What it holds.
    tolerance : float, optional
        Times that differ by no more than this, in seconds or the file's unit, are one sample.
    """

    unit = "sample"
    has_clocks = True

    def __init__(self, name: str, channels: Channels, tolerance: float | None = None) -> None:
        super().__init__(name)
        self._channels, self._tolerance = channels, tolerance
        self.header = [channels.time, *channels.names]
        self.close, self.hint, self.notes = channels.close, channels.hint, channels.notes
        self._chosen = list(range(len(channels.names)))
        self._held: list[int] = []

    @property
    def units(self) -> list[str]:
        """Units of the time and of the channels; blank where the file does not say."""
        return ["", *(self._channels.units[i] for i in self._chosen)]

    @property
    def start(self) -> datetime | None:
        """The date of time 0, where the file states it."""
        return self._channels.start

    def select(self, columns: Sequence[int], held: Sequence[int]) -> dict[int, int]:
        """Read these columns alone."""
        columns = list(dict.fromkeys(columns))
        self.header = [self.header[i] for i in (0, *columns)]
        self._chosen = [i - 1 for i in columns]
        self._held = [k for k, i in enumerate(columns) if i in held]
        return {i: k for k, i in enumerate((0, *columns))}

    def __iter__(self) -> Iterator[TableRow]:
        signals, fault = self._in_order(self._channels.load(self._chosen))
        clocks: dict[bytes, int] = {}
        owners = [clocks.setdefault(each.times.tobytes(), len(clocks)) for each in signals]
        firsts = [owners.index(k) for k in range(len(clocks))]
        self._check_clocks({self.header[k + 1]: signals[k].times for k in firsts})
        times = [signals[k].times for k in firsts]
        axis, samples = merged(times, self._width(times))
        places = [np.full(len(axis), -1) for _ in times]
        for place, sample in zip(places, samples, strict=True):
            place[sample] = np.arange(len(sample))
        columns, first = [places[k] for k in owners], 0
        for k in self._held:
            columns[k] = np.maximum.accumulate(columns[k])
            if (columns[k] >= 0).any():
                first = max(first, int(np.argmax(columns[k] >= 0)))
        if first:
            self.notes.append(
                f"{first} samples of {self.name} come before the first value of an input, and were "
                "left out."
            )
        for start in range(first, len(axis), _BATCH):
            span = slice(start, start + _BATCH)
            fields = [self._times(axis[span])]
            for place, (_, values) in zip(columns, signals, strict=True):
                is_there = place[span] >= 0
                found = iter(_texts(values[place[span][is_there]]))
                fields.append([next(found) if there else "" for there in is_there.tolist()])
            for k, row in enumerate(zip(*fields, strict=True)):
                self.position = start + k + 1
                yield TableRow(self.position, list(row), True)
        if fault is not None:
            raise fault

    def _times(self, times: NDArray[Any]) -> list[str]:
        """Times as a CSV file would have them."""
        zone, start = "Z", self._channels.start
        if start is not None:
            zone = "" if start.tzinfo is None else zone
            since = start.replace(tzinfo=start.tzinfo or UTC) - datetime(1970, 1, 1, tzinfo=UTC)
            first = 1000 * (since // timedelta(microseconds=1))
            times = first + np.round(1e9 * times).astype(np.int64)
        elif not self._channels.dates:
            return _texts(times)
        return [f"{text}{zone}" for text in np.datetime_as_string(times.astype("M8[ns]")).tolist()]

    def _in_order(self, signals: list[Signal]) -> tuple[list[Signal], RecordError | None]:
        """The signals up to the first time that is none or goes backwards, and the error of it."""
        fault: RecordError | None = None
        last: Any = np.inf
        wrongs = [
            ~np.isfinite(times) | (times < np.append(times[:1], times[:-1])) for times, _ in signals
        ]
        for k, ((times, _), wrong) in enumerate(zip(signals, wrongs, strict=True)):
            at = int(np.argmax(wrong)) if wrong.any() else 0
            before = times[at - 1] if at else -np.inf
            if not wrong.any() or before >= last:
                continue
            last = before
            if np.isfinite(times[at]):
                earlier, later = self._times(times[at - 1:at + 1])
                what = (
                    f"time goes backwards from {earlier} to {later} at value {at + 1}; sort the "
                    "file by time, or split it there."
                )
            else:
                what = f"the time of value {at + 1} is {times[at]}; correct the file."
            fault = RecordError(what, self.name, column=self.header[k + 1])
        if fault is None:
            return signals, None
        kept = []
        for (times, values), wrong in zip(signals, wrongs, strict=True):
            ends = np.flatnonzero(wrong | (times > last))
            end = ends[0] if ends.size else len(times)
            kept.append(Signal(times[:end], values[:end]))
        return kept, fault

    def _check_clocks(self, clocks: dict[str, NDArray[Any]]) -> None:
        """Raise where two clocks cannot be one: more lies between them than they last."""
        spans = [(name, times[0], times[-1]) for name, times in clocks.items() if len(times)]
        for name, begin, end in spans:
            for other, start, stop in spans:
                total = (end - begin) + (stop - start)
                if total > 0 and start - end > total:
                    a, b, c, d = self._times(np.array([begin, end, start, stop]))
                    raise RecordError(
                        f"{name!r} lasts from {a} to {b}, and {other!r} from {c} to {d}: these are "
                        f"two clocks; take channels of one clock{self._channels.same_clock}.",
                        self.name,
                    )

    def _width(self, times: list[NDArray[Any]]) -> float:
        """The tolerance in the unit of these times."""
        if self._tolerance is not None:
            return (1e9 if self._channels.dates else 1.0) * self._tolerance
        steps = [float(each[-1] - each[0]) / (len(each) - 1) for each in times if len(each) > 1]
        return _TOGETHER * min(steps, default=0.0)


def merged(
    times: Sequence[NDArray[Any]], tolerance: float
) -> tuple[NDArray[Any], list[NDArray[np.intp]]]:
    """One time axis for several clocks.

    Parameters
    ----------
    times : sequence of (T_k,) arrays
        Times of each clock, in order.
    tolerance : float
        A sample begins at the earliest time that is left, and holds the times of other clocks up
        to this much later, one of each clock.

    Returns
    -------
    (T,) array, list of (T_k,) arrays
        The times of the samples, and the sample of each time of each clock.
    """
    if len(times) == 1:
        return times[0], [np.arange(len(times[0]))]
    every = np.concatenate(times) if times else np.zeros(0)
    order = np.argsort(every, kind="stable")
    owners = np.repeat(np.arange(len(times)), [len(each) for each in times])[order]
    moments, is_first = every[order], np.zeros(len(every), np.bool_)
    seen: set[int] = set()
    start: Any = None
    for begin in range(0, len(every), _BATCH):
        span = slice(begin, begin + _BATCH)
        pairs = zip(moments[span].tolist(), owners[span].tolist(), strict=True)
        for position, (time, owner) in enumerate(pairs, begin):
            if start is None or time - start > tolerance or owner in seen:
                start = time
                seen.clear()
                is_first[position] = True
            seen.add(owner)
    sample = np.empty(len(every), np.intp)
    sample[order] = np.cumsum(is_first) - 1
    ends = np.cumsum([len(each) for each in times])[:-1]
    return moments[is_first], np.split(sample, ends)


def _texts(values: NDArray[Any]) -> list[str]:
    """Values as a CSV file would have them, with all digits."""
    if values.dtype.kind == "b":
        values = values.astype(np.int8)
    return [
        each.decode("utf-8", "replace") if isinstance(each, bytes) else str(each)
        for each in values.tolist()
    ]
