"""Records of the data set: ranges of fixed anchors, at times of their own, and a reference path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from ..command import DataError
from ..problem import Array

SOURCE = (
    "Comprehensive outdoor UWB dataset by the ADIP laboratory, Hanyang University (Apache-2.0), is "
    "in github.com/cucudasluv/UWB-dataset: put the CSV files of a record, those of the anchors and "
    "the trajectory, gzipped or not, into a folder; DIR is this folder or one above several."
)
RANGE = "distanceFromTag"
# Of the median time between two ranges of an anchor: ranges so close make one sample.
TOGETHER = 0.25
# Of the larger by the smaller extent of the anchors on the map; flatter ones are in a line.
FLAT = 0.01


class Walk(NamedTuple):
    """A record of the data set.

    Attributes
    ----------
    name : str
        Its folder's.
    anchors : (p, 3) array
        Positions of the anchors in m.
    times, steps : (T,) array
        Time of each sample since the first one, and from it to the next, in s.
    ranges : (T, p) array
        Measured distances in m, NaN where an anchor was silent.
    path : (T, 2) array
        The reference position in m.
    """

    name: str
    anchors: Array
    times: Array
    steps: Array
    ranges: Array
    path: Array


def folders(above: Path) -> list[Path]:
    """The folders of records: each has a trajectory."""
    found = sorted({path.parent for path in above.rglob("trajectory.csv*")})
    if not found:
        raise DataError(f"no trajectory.csv or trajectory.csv.gz in it or below it. {SOURCE}")
    return found


def read(folder: Path) -> Walk:
    """A record; what lies before or behind its reference is left out.

    Raises
    ------
    DataError
        If files are missing or not those of the data set, an anchor moves, or the anchors' places
        leave the position open.
    """
    known = _table(next(iter(sorted(folder.glob("trajectory.csv*")))), ("timestamp", "x", "y"))
    known = known.sort_values("timestamp").drop_duplicates("timestamp")
    found = [
        table for path in sorted(folder.glob("*.csv*"))
        if (table := _table(path, ("time", "id", "x", "y", "z", RANGE), optional=True)) is not None
    ]
    if not found or len(known) < 2:
        raise DataError(f"{folder.name} has no ranges ({RANGE}), or no trajectory. {SOURCE}")
    all_ranges = pd.concat(found).sort_values("time", kind="stable")
    all_ranges = all_ranges[
        all_ranges["time"].between(known["timestamp"].iloc[0], known["timestamp"].iloc[-1])
        & (all_ranges[RANGE] > 0.0)
    ]
    anchors = _anchors(folder.name, all_ranges)
    start = all_ranges["time"].iloc[0]
    when = 1e-9 * (all_ranges["time"] - start).to_numpy()
    which = np.searchsorted(np.unique(all_ranges["id"]), all_ranges["id"])
    times, ranges = samples(when, which, all_ranges[RANGE].to_numpy(), len(anchors))
    if len(times) < 2:
        raise DataError(f"{folder.name} has {len(times)} samples within its trajectory.")
    at = 1e-9 * (known["timestamp"] - start).to_numpy()
    path = np.column_stack([np.interp(times, at, known[name]) for name in ("x", "y")])
    steps = np.diff(times)
    return Walk(folder.name, anchors, times, np.append(steps, np.median(steps)), ranges, path)


def samples(when: Array, which: Array, measured: Array, count: int) -> tuple[Array, Array]:
    """Times (T,) and ranges (T, count) of samples: ranges that come nearly at once make one.

    Where all anchors were silent for more than a usual step, there are samples without ranges.

    Parameters
    ----------
    when, which, measured : (K,) array
        Times in order, numbers of the anchors, and ranges.
    count : int
        Number of anchors.
    """
    own = np.concatenate([np.diff(when[which == j]) for j in range(count)])
    if not own.size or not np.median(own) > 0.0:
        raise DataError("the anchors range too seldom: no anchor has two ranges at two times")
    width, times, rows = TOGETHER * float(np.median(own)), [], []
    for t, j, r in zip(when, which, measured, strict=True):
        if not times or t - times[-1] > width or np.isfinite(rows[-1][j]):
            times.append(t)
            rows.append(np.full(count, np.nan))
        rows[-1][j] = r
    gaps = np.diff(times)
    parts = np.append(np.maximum(np.rint(gaps / np.median(gaps)), 1.0), 1.0).astype(int)
    filled = np.full((parts.sum(), count), np.nan)
    first = np.cumsum(parts) - parts
    filled[first] = rows
    return np.interp(np.arange(len(filled)), first, times), filled


def check_geometry(name: str, anchors: Array) -> None:
    """Raise a `DataError` where distances to these anchors leave a position open."""
    extents = np.linalg.svd(anchors[:, :2] - anchors[:, :2].mean(axis=0), compute_uv=False)
    remedy = "take a record with three anchors or more that are not in a line on the map."
    if len(anchors) < 3:
        raise DataError(
            f"{name} has {len(anchors)} anchor{'s' * (len(anchors) > 1)}: distances to it leave "
            f"the position open; {remedy}"
        )
    if extents[1] <= FLAT * extents[0]:
        raise DataError(
            f"the {len(anchors)} anchors of {name} are in a line: a position and its mirror image "
            f"have the same distances; {remedy}"
        )


def _anchors(name: str, ranges: pd.DataFrame) -> Array:
    """The position of each anchor (p, 3), by its number."""
    if ranges.empty:
        raise DataError(f"{name} has no ranges at the times of its trajectory")
    places = ranges.groupby("id")[["x", "y", "z"]]
    moved = places.nunique().max(axis=1)
    if moved.max() > 1:
        raise DataError(f"anchor {moved.idxmax():g} of {name} moves; the model wants it fixed")
    anchors = places.first().to_numpy(float)
    check_geometry(name, anchors)
    return anchors


def _table(path: Path, columns: Sequence[str], optional: bool = False) -> pd.DataFrame | None:
    """These columns of a file; None if they are not there and need not be."""
    try:
        table = pd.read_csv(path)
    except (OSError, ValueError, UnicodeDecodeError) as error:
        raise DataError(f"{path.name} of {path.parent.name} cannot be read ({error})") from error
    table.columns = [str(name).strip().lstrip("%").removeprefix("field.") for name in table]
    missing = [name for name in columns if name not in table]
    if missing and optional:
        return None
    if missing:
        raise DataError(f"{path.name} of {path.parent.name} has no column {missing[0]!r}")
    numbers = table[list(columns)].apply(pd.to_numeric, errors="coerce")
    return numbers.dropna()
