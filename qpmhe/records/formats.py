"""Files with channels, each read by the library that keeps its format: MDF, MAT, HDF5, ROS bags."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import need
from .channels import Channels, Signal
from .tables import TIMES, RecordError, first_line, nearest_first

# Longer arrays, such as images, are no signals.
_LONGEST = 64
# An error shows so many names.
_NEAREST = 5
# What is read at once: bytes of an MDF file, and messages of a bag.
_FRAGMENT, _MESSAGES = 2**22, 2**14
# MDF was made in this year; a file with an earlier date comes from a device without a set clock.
_FIRST_MDF = 1991
# What keeps the whole part of a file that is cut off, by the end of its name.
_MENDS = {
    ".mcap": "'mcap recover {0} -o whole.mcap' keeps what is whole.",
    ".db3": "'sqlite3 {0} .recover | sqlite3 whole.db3' keeps what is whole.",
    ".bag": "'rosbag reindex {0}' keeps what is whole.",
}
_Path = tuple[str | int, ...]


def read_mdf(file: str) -> Channels:
    """MDF 3 and 4 of measurement systems: dates, or seconds since a start that is not known."""
    asammdf = need("asammdf", "an MDF file", "mf4")
    with open(file, "rb") as stream:
        if stream.read(8) not in (b"MDF     ", b"UnFinMF "):
            raise RecordError(
                "it cannot be read as MDF: its first bytes are not those of one; it may be cut "
                "off, or of another kind.", file,
            )
    mdf = _attempt(file, "MDF", Exception, lambda: asammdf.MDF(file))
    mdf.configure(read_fragment_size=_FRAGMENT)  # 256 MB unless told otherwise
    groups = [getattr(each.channel_group, "acq_name", "") or f"group {k + 1}"
              for k, each in enumerate(mdf.groups)]
    places = [
        (k, i) for k, each in enumerate(mdf.groups) for i in range(len(each.channels))
        if mdf.masters_db.get(k) != i
    ]
    channels = [mdf.groups[k].channels[i] for k, i in places]

    def load(chosen: Sequence[int]) -> list[Signal]:
        found = []
        for one in chosen:
            (group, index), channel = places[one], channels[one]
            master = mdf.groups[group].channels[mdf.masters_db[group]] if (
                group in mdf.masters_db) else None
            if master is None or getattr(master, "sync_type", 1) != 1:
                raise RecordError(
                    "its group has no time, but another master channel or none; take another "
                    "channel.", file, column=channel.name,
                )
            (signal,) = _attempt(file, "MDF", Exception, partial(
                mdf.select, [(None, group, index)], ignore_value2text_conversions=True
            ))
            valid = np.ones(len(signal.timestamps), np.bool_)
            if signal.invalidation_bits is not None:
                valid = ~np.asarray(signal.invalidation_bits, np.bool_)
            found.append(_signal(file, channel.name, signal.timestamps[valid],
                                 signal.samples[valid]))
        return found

    return Channels(
        _distinct([each.name for each in channels], [groups[k] for k, _ in places]),
        [each.unit or "" for each in channels], load, mdf.close,
        start=mdf.start_time if mdf.start_time.year >= _FIRST_MDF else None,
    )


def read_mat(file: str, time: str | None = None) -> Channels:
    """MAT files: variables and fields of structs beside a time of their length."""
    from scipy.io import loadmat
    from scipy.io.matlab import matfile_version

    hint = " Objects such as timeseries are not read: save their Time and Data as arrays."
    major, _ = _attempt(file, "MAT", Exception, lambda: matfile_version(file))
    if major != 2:
        content = _attempt(file, "MAT", Exception, lambda: loadmat(file, simplify_cells=True))
        return _of_tree(file, _variables(content), {}, time, hint=hint)
    kind = "a MAT file of version 7.3"  # which is HDF5
    load, h5py = need("pymatreader", kind, "mat").read_mat, need("h5py", kind, "mat")
    root = _attempt(file, "MAT", OSError, lambda: h5py.File(file, "r"))

    def listed() -> dict[str, Any]:
        found = {name: _matrix(item) for name, item in root.items() if name[0] != "#"}
        others = [name for name, item in found.items() if item is None]
        return found | _variables(load(file, variable_names=others) if others else {})

    tree = _attempt(file, "MAT", Exception, listed, root.close)
    return _of_tree(file, tree, {}, time, root.close, hint)


def _variables(content: dict[str, Any]) -> dict[str, Any]:
    return {
        name: _grown(value) for name, value in content.items() if not name.startswith(("__", "#"))
    }


def _matrix(item: Any) -> Any:
    """A matrix of numbers in a MAT file of version 7.3, or a struct of some; None if another."""
    kind = item.attrs.get("MATLAB_class", b"")
    if kind == b"struct" and hasattr(item, "items"):
        fields = {name: _matrix(each) for name, each in item.items()}
        return None if any(each is None for each in fields.values()) else fields
    if hasattr(item, "items") or "MATLAB_empty" in item.attrs or item.dtype.kind not in "biuf":
        return None
    return np.zeros(0) if kind == b"char" else _Matrix(item)


class _Matrix:
    """A matrix of a MAT file, which has its columns first; read when it is needed."""

    def __init__(self, item: Any) -> None:
        self._item, self.dtype = item, item.dtype
        self.shape = tuple(each for each in item.shape[::-1] if each != 1)

    def __getitem__(self, key: Any) -> Any:
        if len(self.shape) == 2 == len(self._item.shape) == len(key):
            return self._item[key[::-1]]
        return np.squeeze(self._item[()].T)[key]


def read_hdf5(file: str, time: str | None = None) -> Channels:
    """HDF5 files: datasets beside a time of their length in their group, or in one around it."""
    h5py = need("h5py", "an HDF5 file", "hdf5")
    errors = (OSError, RuntimeError, KeyError)
    root = _attempt(file, "HDF5", errors, lambda: h5py.File(file, "r"))
    units: dict[_Path, str] = {}

    def grown(group: Any, path: _Path) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, item in group.items():
            if isinstance(item, h5py.Group):
                found[name] = grown(item, (*path, name))
            elif item.dtype.names:  # a table
                found[name] = {field: _Field(item, field) for field in item.dtype.names}
            else:
                found[name] = item
                unit = item.attrs.get("units", item.attrs.get("unit", ""))
                units[*path, name] = unit.decode() if isinstance(unit, bytes) else str(unit)
        return found

    tree = _attempt(file, "HDF5", errors, lambda: grown(root, ()), root.close)
    return _of_tree(file, tree, units, time, root.close)


class _Field:
    """A column of a table in an HDF5 file."""

    def __init__(self, table: Any, name: str) -> None:
        self._table, self._name = table, name
        self.dtype = table.dtype[name]
        self.shape = (*table.shape, *self.dtype.shape)

    def __getitem__(self, key: Any) -> Any:
        return self._table[self._name][key]


def _grown(value: Any) -> Any:
    """Structs and arrays of them as dicts, and anything else as an array."""
    if isinstance(value, Mapping):
        return {str(name): _grown(item) for name, item in value.items()}
    is_list = isinstance(value, (list, np.ndarray)) and len(np.shape(value)) == 1
    if is_list and any(isinstance(item, Mapping) for item in value):
        return {f"[{k}]": _grown(item) for k, item in enumerate(value)}
    try:
        return np.asarray(value)
    except ValueError:  # of cells of different lengths
        return np.zeros(0)


def _of_tree(
    file: str, tree: dict[str, Any], units: dict[_Path, str], time: str | None,
    close: Callable[[], None] = lambda: None, hint: str = "",
) -> Channels:
    """The channels of groups in groups, each with the nearest time that has its length."""
    names: list[str] = []
    found: list[tuple[_Path, Any, Any, Any]] = []  # path, array, index of its column, times
    notes: list[str] = []
    used: set[str] = set()

    def walk(group: dict[str, Any], path: _Path, times: list[Any]) -> None:
        clock = _clock(group, time)
        if clock is not None:
            used.add(clock)
            times = [group[clock], *times]
        for name, item in group.items():
            here = (*path, name)
            if isinstance(item, dict):
                walk(item, here, times)
            elif name != clock:
                add(here, item, times)

    def add(path: _Path, item: Any, times: list[Any]) -> None:
        shape = tuple(item.shape)
        if item.dtype.kind not in "biufSUOM" or not 1 <= len(shape) <= 2 or 0 in shape:
            return
        lengths = [int(np.prod(each.shape)) for each in times]
        fits = [(each, shape.index(length)) for each, length in zip(times, lengths, strict=True)
                if length in shape]
        clock, axis = fits[0] if fits else (None, 0)
        name = ".".join(map(str, path)).replace(".[", "[")
        if len(shape) == 1 or shape[1 - axis] == 1:
            names.append(name)
            found.append((path, item, (slice(None), *[0] * (len(shape) - 1))
                          if axis == 0 else (0, slice(None)), clock))
            return
        if clock is not None and shape[0] == shape[1]:
            notes.append(f"{name} of {file} is {shape[0]} x {shape[1]}: its rows are the samples.")
        for k in range(min(shape[1 - axis], _LONGEST)):
            names.append(f"{name}[{k}]")
            found.append((path, item, (slice(None), k) if axis == 0 else (k, slice(None)), clock))

    walk(tree, (), [])
    if time is not None and not used:
        close()
        several = nearest_first({str(path[-1]) for path, *_ in found}, time)[:_NEAREST]
        raise RecordError(
            f"there is no variable {time!r} for the time; the nearest are "
            f"{', '.join(map(repr, several))}. Name it with --time NAME.{hint}", file,
        )

    def load(chosen: Sequence[int]) -> list[Signal]:
        loaded = []
        for one in chosen:
            _, item, index, clock = found[one]
            if clock is None:
                raise RecordError(
                    f"there is no time of its length, {' x '.join(map(str, item.shape))}; name the "
                    "variable of the time with --time NAME.", file, column=names[one],
                )
            times, values = _attempt(file, "HDF5", (OSError, RuntimeError), lambda: (
                np.asarray(clock[()]), np.asarray(item[index])  # noqa: B023 - called at once
            ))
            loaded.append(_signal(file, names[one], times.reshape(-1), values))
        return loaded

    return Channels(
        names, [units.get(path, "") for path, *_ in found], load, close,
        time=min(used, default=time or "time"), notes=notes, hint=hint,
    )


def _clock(group: dict[str, Any], time: str | None) -> str | None:
    """The name of the time in a group."""
    wanted = TIMES if time is None else (time.lower(),)
    for word in wanted:
        for name, item in group.items():
            if name.lower() == word and not isinstance(item, dict) and (
                item.dtype.kind in "iuf" and max(item.shape, default=0) == np.prod(item.shape)
            ):
                return name
    return None


def read_bag(file: str, log_time: bool = False) -> Channels:
    """ROS 2 bags, MCAP files of ROS, and ROS 1 bags: times of the headers, or of the log."""
    kind = "a ROS bag"
    highlevel = need("rosbags.highlevel", kind, "ros")
    typesys = need("rosbags.typesys", kind, "ros")
    store = typesys.get_typestore(typesys.Stores.LATEST)
    reader = _attempt(file, kind, Exception, lambda: highlevel.AnyReader(
        [Path(file)], default_typestore=store
    ))
    _attempt(file, kind, Exception, reader.open)
    names: list[str] = []
    found: list[tuple[Any, _Path]] = []
    stamped: dict[int, bool] = {}
    texts: dict[str, str] = {}

    def look() -> None:
        for connection in reader.connections:
            for _, _, raw in reader.messages([connection]):
                message = reader.deserialize(raw, connection.msgtype)
                stamped[connection.id] = not log_time and _stamp(message) != 0
                texts[connection.topic] = (
                    "header.stamp" if stamped[connection.id] else "the log's time"
                )
                for path in _paths(message):
                    names.append(connection.topic + "".join(
                        f"[{each}]" if isinstance(each, int) else f".{each}" for each in path
                    ))
                    found.append((connection, path))
                break

    _attempt(file, kind, Exception, look, reader.close)
    notes: list[str] = []

    def load(chosen: Sequence[int]) -> list[Signal]:
        paths: dict[int, list[int]] = {}
        for one in chosen:
            paths.setdefault(found[one][0].id, []).append(one)
        times = {key: _Pieces(np.int64) for key in paths}
        values = {one: _Pieces() for one in chosen}
        wanted = [each for each in reader.connections if each.id in paths]

        def collect() -> None:
            for connection, logged, raw in reader.messages(wanted) if wanted else ():
                message, key = reader.deserialize(raw, connection.msgtype), connection.id
                times[key].add(_stamp(message) if stamped[key] else logged)
                for one in paths[key]:
                    values[one].add(_at(message, found[one][1]))

        _attempt(file, kind, Exception, collect)
        notes.append(f"times of {file}: " + ", ".join(
            f"{texts[topic]} of {topic}" for topic in dict.fromkeys(c.topic for c in wanted)
        ) + ".")
        return [
            _signal(file, names[one], times[found[one][0].id].whole(), values[one].whole())
            for one in chosen
        ]

    return Channels(
        _distinct(names, [f"connection {c.id}" for c, _ in found]), [""] * len(names), load,
        reader.close, dates=True, notes=notes, same_clock=", or give --log-time",
    )


class _Pieces:
    """Values one after another: the newest in a list, which takes many times the memory."""

    def __init__(self, kind: Any = None) -> None:
        self._kind, self._packed, self._newest = kind, list[NDArray[Any]](), list[Any]()

    def add(self, value: Any) -> None:
        self._newest.append(value)
        if len(self._newest) == _MESSAGES:
            self._packed.append(np.array(self._newest, self._kind))
            self._newest.clear()

    def whole(self) -> NDArray[Any]:
        newest = [np.array(self._newest, self._kind)] if self._newest or not self._packed else []
        return np.concatenate([*self._packed, *newest])


def _stamp(message: Any) -> int:
    """The time of a message's header in nanoseconds; 0 without one."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else 10**9 * stamp.sec + stamp.nanosec


def _paths(value: Any, path: _Path = ()) -> Iterator[_Path]:
    """Where the numbers and texts of a message are."""
    if is_dataclass(value):
        for each in fields(value):
            if each.name != "__msgtype__" and (path or each.name != "header"):
                yield from _paths(getattr(value, each.name), (*path, each.name))
    elif isinstance(value, (list, np.ndarray)):
        if len(value) <= _LONGEST:
            for k, item in enumerate(value):
                yield from _paths(item, (*path, k))
    else:
        yield path


def _at(message: Any, path: _Path) -> Any:
    """The value at a place; NaN where a list is shorter."""
    for each in path:
        if isinstance(each, str):
            message = getattr(message, each)
        elif each < len(message):
            message = message[each]
        else:
            return np.nan
    return message


def _signal(file: str, name: str, times: NDArray[Any], values: NDArray[Any]) -> Signal:
    if values.ndim != 1 or values.dtype.names or len(times) != len(values):
        raise RecordError(
            f"its values have the shape {values.shape} at {len(times)} times; expected one number "
            "at each. Take another channel.", file, column=name,
        )
    if times.dtype.kind == "u":
        times = times.astype(np.int64)
    return Signal(times, values)


def _distinct(names: list[str], groups: list[str]) -> list[str]:
    """The names; those that occur again with their group, and a number if that is not enough."""
    count: dict[str, int] = {}
    for name in names:
        count[name] = count.get(name, 0) + 1
    found: dict[str, None] = {}
    for name, group in zip(names, groups, strict=True):
        wanted = name if count[name] == 1 else f"{group}/{name}"
        number, full = 2, wanted
        while full in found:
            full, number = f"{wanted}#{number}", number + 1
        found[full] = None
    return list(found)


def _attempt(
    file: str, kind: str, errors: Any, function: Callable[[], Any],
    close: Callable[[], None] = lambda: None,
) -> Any:
    """What a library answers; what it says of a file as one line."""
    try:
        return function()
    except errors as error:
        text = first_line(error) or type(error).__name__
    shown, sys.unraisablehook = sys.unraisablehook, lambda _: None
    gc.collect()  # half-made objects of asammdf complain when they go
    sys.unraisablehook = shown
    close()
    mend = _MENDS.get(Path(file).suffix.lower(), "").format(file)
    raise RecordError(
        f"it cannot be read as {kind} ({text}); it may be cut off, or of another kind."
        f"{' If it is cut off, ' * bool(mend)}{mend}", file,
    )
