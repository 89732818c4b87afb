"""A file of measurements as a data frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._checks import need, positive
from .measurements import Columns, FieldReader, Header, RecordReader, Time, unit_of
from .readers import ReadingOptions
from .tables import RecordError, Table

if TYPE_CHECKING:
    from pandas import DataFrame


def read(
    path: str | Path, columns: Sequence[str] | None = None, *, time: str | None = None,
    time_scale: float = 1.0, **options: Any,
) -> DataFrame:
    """Read a file of measurements of any kind that qpmhe knows.

    CSV, JSON lines (.jsonl), gzip of both and Parquet have one row for each time. The channels of
    other files have clocks of their own; a row of the frame then has the values of all channels at
    one time, NaN where a channel has none: nothing is interpolated, so held inputs are
    ``frame[inputs].ffill()``. By the end of the name:

    - ``.mf4``, ``.mdf``: MDF of measurement systems (``pip install 'qpmhe[mf4]'``);
    - ``.mat``: MAT, v4 to v7.3, variables and structs (v7.3: ``'qpmhe[mat]'``);
    - ``.h5``, ``.hdf5``, ``.hdf``: HDF5, datasets and tables in groups (``'qpmhe[hdf5]'``);
    - ``.mcap``, ``.db3``, ``.bag``, the folder of a bag: ROS 2 and ROS 1 (``'qpmhe[ros]'``).

    In MAT and HDF5 files, the time of an array is the variable of a usual name (``time``, ``t``,
    ...) with its length in its own group, or in the nearest one around that. Of arrays with two
    dimensions, the one with the time's length counts the samples; both may have it, then the rows
    do. MAT and HDF5 files do not say which time is a date: their times are numbers.

    Parameters
    ----------
    path : str or Path
        The file.
    columns : sequence of str, optional
        Which ones to read, all by default: names, or their last part (``angular_velocity.z`` of
        ``/imu/data.angular_velocity.z``). Only these are loaded.
    time : str, optional
        Column or variable of the time, if it has no usual name.
    time_scale : float
        Seconds in the file's unit of time, for times that are numbers.
    **options
        As for `qpmhe.records.ReadingOptions`.

    Returns
    -------
    pandas.DataFrame
        Columns of numbers, of texts where a column begins with text. The index is a DatetimeIndex
        where times are dates, else a TimedeltaIndex. ``frame.attrs["units"]`` has the units that
        the file states, ``frame.attrs["notes"]`` what else there is to know. Of an MDF file that
        states when the measurement started, ``frame.attrs["start"]`` is this date, in ISO 8601:
        ``frame.index - pandas.Timestamp(frame.attrs["start"])`` are the seconds since then.

    Raises
    ------
    RecordError
        If the file is cut off or of another kind, a column is missing (the error has the nearest
        names), a field is no number, or times go backwards.
    InvalidInputError
        If a package for this kind of file is not installed.
    """
    pandas = need("pandas", "a data frame")
    wanted = _Wanted(None if columns is None else tuple(columns), time)
    positive("time_scale", time_scale)
    reading = ReadingOptions(**options)
    reader = RecordReader(str(path), wanted, reading)
    fields = FieldReader(reading.decimal, reading.missing)
    try:
        found = [_Column(fields) for _ in wanted.names]
        times: list[Time] = []
        for row, moment in reader.rows():
            times.append(moment)
            for column, position in zip(found, reader.columns.outputs, strict=True):
                column.values.append(reader.value(row, position, column.read))
    finally:
        reader.close()
    if not times:
        raise RecordError("it has no samples.", reader.name)
    frame = pandas.DataFrame(
        {name: column.values for name, column in zip(wanted.names, found, strict=True)},
        index=_index(pandas, times, time_scale),
    )
    frame.attrs.update(units=wanted.units, notes=[*reader.notes])
    if wanted.start is not None:
        frame.attrs["start"] = wanted.start.isoformat()  # Parquet keeps what JSON has
    return frame


class _Wanted:
    """Which columns to read."""

    def __init__(self, given: tuple[str, ...] | None, time: str | None) -> None:
        self.time, self._given = time, given
        self.names: list[str] = []
        self.units: dict[str, str] = {}
        self.start: Any = None

    def find(self, table: Table) -> Columns:
        """Their positions in a table."""
        header, self.start = Header(table), table.start
        remedy = "name it in columns."
        if self._given is None:
            time = header.time(self.time, ())
            chosen = tuple(i for i in range(len(header.names)) if i != time)
        else:
            chosen = tuple(
                header.find((name,), f"column {name!r}", remedy) for name in self._given
            )
            time = header.time(self.time, chosen)
        self.names = [header.names[i] for i in chosen]
        units = [unit_of(header.names[i]) if table.units is None else table.units[i]
                 for i in chosen]
        self.units = {name: unit for name, unit in zip(self.names, units, strict=True) if unit}
        return Columns(time, chosen, ())


class _Column:
    """A column of numbers, unless its first field that is not missing is a text."""

    def __init__(self, fields: FieldReader) -> None:
        self._fields, self._is_text = fields, False
        self.values: list[Any] = []

    def read(self, field: str) -> float | str:
        """The value of a field."""
        if self._is_text:
            return field
        try:
            return self._fields.number(field)
        except ValueError as error:
            if str(error) != "is not a number" or any(each == each for each in self.values):
                raise
        self._is_text = True
        self.values[:] = [""] * len(self.values)
        return field


def _index(pandas: Any, times: list[Time], scale: float) -> Any:
    if times[0].kind == "number":
        factor = 1e9 * scale
        exact = int(factor) if factor.is_integer() else factor  # times may have more digits
        index = pandas.to_timedelta([round(exact * each.value) for each in times], unit="ns")
    elif times[0].kind == "duration":
        index = pandas.to_timedelta([each.value for each in times], unit="ns")
    else:
        has_zone = times[0].kind == "date with a zone"
        index = pandas.to_datetime([each.value for each in times], unit="ns", utc=has_zone)
    return index.rename("time")
