"""Records of the Samsung INR21700-30T cell, resampled so that charge is kept.

The data are those of P. Kollmeyer and M. Skells, *Samsung INR21700 30T 3Ah Li-ion Battery Data*,
McMaster University, Mendeley Data, https://doi.org/10.17632/9xyvy2njj3; they are not part of this
project. Current is negative on discharge.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from ..command import DataError

Array = NDArray[np.float64]

DOI = "10.17632/9xyvy2njj3"
C20, HPPC = "c20_25degC.mat", "hppc_25degC.mat"
SOURCE = (
    "P. Kollmeyer, M. Skells, Samsung INR21700 30T 3Ah Li-ion Battery Data, McMaster University, "
    f"is at https://doi.org/{DOI}: put the .mat files of the drive cycles into one folder."
)
_FIELDS = "Time", "Voltage", "Current", "Ah", "Battery_Temp_degC"


class Raw(NamedTuple):
    """As logged, repeated instants left out: s, V, A, A h and degC, each (K,)."""

    time: Array
    voltage: Array
    current: Array
    charge: Array
    temperature: Array


class Record(NamedTuple):
    """Means over each of T steps, and the counted charge at their T + 1 ends.

    Attributes
    ----------
    voltage, current : (T, 1) array
        V and A.
    charge : (T + 1,) array
        A h since the record began.
    temperature : (T,) array
        Of the cell's case, degC.
    """

    voltage: Array
    current: Array
    charge: Array
    temperature: Array


def load(folder: Path, name: str) -> Raw:
    """A file of the data set.

    Raises
    ------
    DataError
        If it is not there, cannot be read, or its current and its counter disagree.
    """
    path = folder / name
    if not path.is_file():
        raise DataError(f"{path} is not there. {SOURCE}")
    try:
        meas = loadmat(path, squeeze_me=True)["meas"][()]
        data = np.array([meas[field] for field in _FIELDS], dtype=float)
    except Exception as error:  # whatever the reader makes of a file that is something else
        raise DataError(f"{path} cannot be read ({error}). {SOURCE}") from error
    # The tester logs an instant twice where it goes on to the next step of its programme.
    new = np.concatenate([[True], np.diff(np.maximum.accumulate(data[0])) > 0])
    raw = Raw(*data[:, new])
    if not np.isfinite(data).all() or raw.time.size < 2:
        raise DataError(f"{path} has missing values. {SOURCE}")
    empty = int(np.argmin(raw.charge))  # the counter may begin anew behind that
    found, counted = passed(raw)[empty] / 3600, raw.charge[empty] - raw.charge[0]
    if not abs(found - counted) < 0.01 * np.ptp(raw.charge):
        raise DataError(f"{path}: {found:.3f} Ah by current, {counted:.3f} by counter. {SOURCE}")
    return raw


def passed(raw: Raw) -> Array:
    """The charge (A s) since the first sample.

    By the current where it is logged every second or more often, and by the counter elsewhere:
    the counter's last digit is 0.036 A s, and what happens between two samples ten seconds
    apart is not in the current.
    """
    steps = np.diff(raw.time)
    by_current = 0.5 * (raw.current[1:] + raw.current[:-1]) * steps
    return _sum(np.where(steps <= 1.0, by_current, 3600.0 * np.diff(raw.charge)))


def resample(raw: Raw, dt: float) -> Record:
    """Means over steps of dt seconds: the voltage goes with the current it was under."""
    time = raw.time - raw.time[0]
    grid = dt * np.arange(int(time[-1] / dt) + 1)

    def mean(integral: Array) -> Array:
        value: Array = np.diff(np.interp(grid, time, integral)) / dt
        return value

    voltage, temperature = (
        mean(_sum(0.5 * (x[1:] + x[:-1]) * np.diff(time))) for x in (raw.voltage, raw.temperature)
    )
    charge = np.interp(grid, time, raw.charge - raw.charge[0])
    return Record(voltage[:, None], mean(passed(raw))[:, None], charge, temperature)


def drive_cycles(folder: Path) -> dict[str, Path]:
    """Files of the folder that are neither of the two for identification, by a short name.

    Raises
    ------
    DataError
        If there are none.
    """
    files = {
        path.name.split("_")[0].upper(): path
        for path in sorted(folder.glob("*.mat")) if path.name not in (C20, HPPC)
    }
    if not files:
        raise DataError(f"{folder} holds no drive cycle (*.mat). {SOURCE}")
    return files


def _sum(increments: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(increments)])
