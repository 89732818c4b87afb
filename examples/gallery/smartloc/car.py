"""A car between houses, by GPS and GLONASS pseudoranges and its own speed and turn rate.

Houses hide satellites and reflect their signals: errors of tens of metres, which last for seconds,
many at once and all of one sign. A gate shuts on what disagrees with a state that such errors have
made; a loss that redescends, over a window in which the car drives round some corners, does not
depend on that state.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import qpmhe
from qpmhe.tuning import Weights

from ..problem import Array, Problem, Record, Result, Way
from ..report import tracks
from .record import Drive, folders, read

# Seconds: of the windows, of the delay, and before an error counts.
SHORT, LONG, DELAY, SETTLING = 10.0, 80.0, 40.0, 10.0
# Random walks a root of a second: of position, height, heading, clock, its drift, the offsets of
# other systems' clocks and the zero of the gyroscope. In m and rad.
WALKS = {"position": 0.1, "height": 0.05, "heading": 0.002, "clock": 0.7, "drift": 0.25,
         "gyroscope": 2e-6, "offset": 0.05}
INITIAL = {"position": 50.0, "height": 20.0, "heading": 0.5, "clock": 100.0, "drift": 100.0,
           "gyroscope": 0.003, "offset": 20.0}
#: m, of a pseudorange that may be reflected.
NOISE = 10.0
STATES = ("position", "position", "height", "heading", "clock", "drift", "gyroscope")


def system(drive: Drive) -> qpmhe.System:
    """East, north, up, heading, clock error and its drift (as ranges), gyroscope's zero, offsets.

    Inputs are speed, turn rate and length of the step, and the satellites' positions.
    """
    offset = drive.offset
    count, others = offset.shape

    def f(x: Array, u: Array) -> Array:
        speed, turn, dt = u[0], u[1] + x[6], u[2]
        heading = x[3] + 0.5 * dt * turn
        return np.stack([
            x[0] + dt * speed * np.cos(heading), x[1] + dt * speed * np.sin(heading), x[2],
            x[3] + dt * turn, x[4] + dt * x[5], *x[5:],
        ])

    def h(x: Array, u: Array) -> Array:
        away = u[3:].reshape(count, 3) - x[:3]
        return np.sqrt((away * away).sum(axis=1)) + x[4] + offset @ x[7:]

    return qpmhe.System(f, h, n=7 + others, p=count, m=3 + 3 * count)


def inputs(drive: Drive) -> Array:
    """u of each step."""
    return np.column_stack(
        (drive.odometry, drive.lengths, drive.satellites.reshape(len(drive.times), -1))
    )


def names(drive: Drive) -> list[str]:
    """What each state is."""
    return [*STATES, *["offset"] * drive.offset.shape[1]]


def weights(drive: Drive) -> Weights:
    """Covariances by hand."""
    step = np.median(drive.lengths)
    walks, initial = (np.array([of[one] for one in names(drive)]) for of in (WALKS, INITIAL))
    return Weights(
        np.diag(initial**2), np.diag(walks**2 * step),
        np.eye(drive.ranges.shape[1]) * NOISE**2, horizon=round(SHORT / step),
    )


def start(drive: Drive, where: Array, heading: float) -> Array:
    """A state at a place, with the clock that the first pseudoranges have there."""
    found = np.zeros(len(names(drive)))
    found[:3], found[3] = where, heading
    left = drive.ranges - np.linalg.norm(drive.satellites - where, axis=2)
    first = left[np.isfinite(left).any(axis=1)][0]
    found[4] = np.nanmedian(first)
    return found
