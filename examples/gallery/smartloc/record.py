"""Records of *The smartLoc Dataset*: pseudoranges, odometry and the true positions of a car."""

from __future__ import annotations

import gzip
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..command import DataError
from ..problem import Array

SOURCE = (
    "The smartLoc Dataset by Pierre Reisdorf, Tim Pfeifer and others, TU Chemnitz (CC BY-SA 4.0), "
    "is in github.com/TUC-ProAut/libRSF, folder datasets/smartLoc: put the input and the ground "
    "truth of a record into one folder."
)
LIGHT, EARTH = 299792458.0, 7.2921151467e-5  # m/s; rad/s
# SBAS and QZSS keep the time of GPS.
SHARED_TIME = {2: 1, 16: 1}


@dataclass(frozen=True, eq=False)
class Drive:
    """A record on the steps of its odometry; one column for each satellite.

    Parameters
    ----------
    times : (T,) array
        In s.
    ranges : (T, P) array
        Pseudoranges in m, NaN where there is none.
    satellites : (T, P, 3) array
        Their positions, east, north and up of the car's first position, in m. The Earth's rotation
        while the signal travels is corrected.
    offset : (P, K) array
        1 where a satellite's system has an offset of its own to the time of the first system.
    odometry : (T, 2) array
        Speed in m/s and turn rate in rad/s.
    positions : (T, 3) array
        The true ones, east, north and up in m; NaN where there is none.
    strengths : (T, P) array
        Carrier to noise density of the pseudoranges, in dBHz.
    deviation : float
        Standard deviation in m that the receiver reports for the best twentieth of its
        pseudoranges.
    """

    times: Array
    ranges: Array
    satellites: Array
    offset: Array
    odometry: Array
    positions: Array
    strengths: Array
    deviation: float

    @property
    def lengths(self) -> Array:
        """Those of the steps, in s; the last one is taken to be usual."""
        found = np.diff(self.times)
        return np.append(found, np.median(found))

    def strong(self, least: float) -> Drive:
        """The record without pseudoranges of weaker signals, in dBHz."""
        return replace(self, ranges=np.where(self.strengths >= least, self.ranges, np.nan))


def folders(folder: Path) -> list[Path]:
    """The folder, if a record is in it, or those of its folders in which one is."""
    if _files(folder, "input"):
        return [folder]
    found = [one for one in sorted(folder.iterdir()) if one.is_dir() and "smartloc" in
             one.name.lower() and _files(one, "input")]
    if not found:
        raise DataError("no file of the data set in it, such as input.txt.gz, nor in a folder "
                        "smartloc* of it")
    return found


def read(folder: Path) -> Drive:
    """The record in a folder."""
    lines = _lines(folder, "input")
    odometry = _numbers(lines, "odom3", 8)
    ranges = _numbers(lines, "pseudorange3", 10)
    truth = _numbers(_lines(folder, "ground", "gt"), "point3", 4)
    odometry, truth = (one[np.argsort(one[:, 0], kind="stable")] for one in (odometry, truth))
    times = odometry[:, 0]
    if len(times) < 2 or not len(ranges) or not len(truth):
        raise DataError("its files hold no odometry, no pseudoranges or no true positions")
    if not np.all(np.diff(times) > 0):
        raise DataError("two lines of its odometry have the same time")
    origin = truth[0, 1:]
    step = _nearest(times, ranges[:, 0])
    near = np.abs(times[step] - ranges[:, 0]) <= 0.5 * np.median(np.diff(times))
    step, ranges = step[near], ranges[near]
    if not len(ranges):
        raise DataError("none of its pseudoranges is of the time of its odometry")
    names, columns = np.unique(ranges[:, [7, 6]], axis=0, return_inverse=True)
    columns = columns.ravel()
    y, strengths = np.full((2, len(times), len(names)), np.nan)
    satellites = np.full((len(times), len(names), 3), np.nan)
    y[step, columns], strengths[step, columns] = ranges[:, 1], ranges[:, 9]
    satellites[step, columns] = local(rotated(ranges[:, 3:6], origin), origin)
    at = np.column_stack([
        np.interp(times, truth[:, 0], one, left=np.nan, right=np.nan)
        for one in local(truth[:, 1:], origin).T
    ])
    return Drive(
        times, y, _filled(satellites), _offsets(ranges[:, 7], columns), odometry[:, [1, 6]], at,
        strengths, float(np.sqrt(np.quantile(ranges[:, 2], 0.05))),
    )


def local(points: Array, origin: Array) -> Array:
    """East, north and up of an origin, both Earth-centred; up is away from the Earth's centre."""
    x, y, _ = origin
    east = np.array([-y, x, 0.0]) / np.hypot(x, y)
    up = origin / np.linalg.norm(origin)
    return (points - origin) @ np.stack((east, np.cross(up, east), up)).T


def rotated(satellites: Array, receiver: Array) -> Array:
    """Satellites in the Earth's axes at the time of reception: it turns while a signal travels."""
    angle = EARTH / LIGHT * np.linalg.norm(satellites - receiver, axis=1)
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = satellites.T
    return np.column_stack((cos * x + sin * y, cos * y - sin * x, z))


def _offsets(systems: Array, columns: Array) -> Array:
    """Which satellites have which offset: none has the system with the most pseudoranges."""
    clocks = np.array([SHARED_TIME.get(int(one), int(one)) for one in systems])
    kinds, counts = np.unique(clocks, return_counts=True)
    others = kinds[np.argsort(-counts, kind="stable")][1:]
    found = np.zeros((columns.max() + 1, len(others)))
    for k, kind in enumerate(others):
        found[columns[clocks == kind], k] = 1.0
    return found


def _filled(satellites: Array) -> Array:
    """Where a satellite is not seen: its last place, or its first; no measurement uses it."""
    found = satellites.copy()
    for column in np.moveaxis(found, 1, 0):
        seen = np.flatnonzero(np.isfinite(column[:, 0]))
        last = np.maximum.accumulate(np.where(np.isfinite(column[:, 0]), np.arange(len(column)), 0))
        column[:] = column[np.maximum(last, seen[0])]
    return found


def _nearest(times: Array, wanted: Array) -> Array:
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    found: Array = after - (wanted - times[after - 1] < times[after] - wanted)
    return found


def _files(folder: Path, *words: str) -> list[Path]:
    """Text files, packed or not, with one of the words in their names."""
    return [
        one for one in sorted(folder.iterdir())
        if one.name.lower().endswith((".txt", ".txt.gz")) and any(
            word in one.name.lower() for word in words
        )
    ]


def _lines(folder: Path, *words: str) -> list[list[str]]:
    found = _files(folder, *words)
    if len(found) != 1:
        raise DataError(f"expected one .txt or .txt.gz file named {' or '.join(words)}, "
                        f"found {[one.name for one in found]}")
    try:
        with (gzip.open if found[0].suffix == ".gz" else open)(found[0], "rt") as file:
            return [line.split() for line in file if line.strip()]
    except (UnicodeDecodeError, EOFError) as problem:
        raise DataError(f"{found[0].name} is no text ({problem})") from problem


def _numbers(lines: list[list[str]], kind: str, count: int) -> Array:
    """The first numbers of the lines of one kind."""
    try:
        return np.array([line[1 : 1 + count] for line in lines if line[0] == kind],
                        float).reshape(-1, count)
    except ValueError as problem:
        raise DataError(f"a line {kind} has not the {count} numbers of the data set "
                        f"({problem})") from problem
