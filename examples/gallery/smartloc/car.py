"""A car between houses, by GPS and GLONASS pseudoranges and its own speed and turn rate.

Houses hide satellites and reflect their signals: errors of tens of metres, which last for seconds,
many at once and all of one sign. A gate shuts on what disagrees with a state that such errors have
made; a loss that redescends, over a window in which the car drives round some corners, does not
depend on that state.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

import qpmhe
from qpmhe.tuning import Weights

from ..problem import Array, Problem, Record, Result, Way
from ..report import tracks
from .bank import Bank
from .record import Drive, folders, read

# Seconds: of the windows, of the delay, and before an error counts.
SHORT, LONG, DELAY, SETTLING = 10.0, 80.0, 40.0, 10.0
# Metres from the truth, and runs from each: of the starts.
STARTS, FEW = {5.0: 4, 100.0: 4}, {5.0: 1, 100.0: 1}
HUBER = 1.345
#: dBHz: weaker signals are reflected ones more often than not.
STRONG = 35.0
# Random walks a root of a second: of position, height, heading, clock, its drift, the offsets of
# other systems' clocks and the zero of the gyroscope. In m and rad.
WALKS = {"position": 0.1, "height": 0.05, "heading": 0.002, "clock": 0.7, "drift": 0.25,
         "gyroscope": 2e-6, "offset": 0.05}
INITIAL = {"position": 50.0, "height": 20.0, "heading": 1.8, "clock": 100.0, "drift": 100.0,
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
    found[4] = np.nanmedian(left[np.isfinite(left).any(axis=1)][0])
    return found


def starts(drive: Drive, away: float, count: int) -> list[Array]:
    """States that far from the true first place, in directions and with headings all around."""
    angles = 2.0 * np.pi * np.arange(count) / count
    truth = drive.positions[np.isfinite(drive.positions[:, 0])][0]
    return [
        start(drive, truth + away * np.array([np.cos(one), np.sin(one), 0.0]), 2.0 * one)
        for one in angles
    ]


def problems(folder: Path, quick: bool) -> list[Problem]:
    """Each record of the folder, with all signals and with the strong ones only."""
    found = []
    for one in folders(folder):
        drive = read(one)
        found.append(problem(one.name, "", drive, quick))
        if not quick:
            found.append(problem(
                f"{one.name}_strong", f", signals of {STRONG:.0f} dBHz and more",
                drive.strong(STRONG), quick,
            ))
    return found


def problem(name: str, which: str, drive: Drive, quick: bool) -> Problem:
    """A record from starts near and far."""
    made, by_hand, u = system(drive), weights(drive), inputs(drive)
    half = len(drive.times) // 2
    truth = np.where(
        (drive.times - drive.times[0] >= SETTLING)[:, None], drive.positions[:, :2], np.nan
    )
    known = np.full((len(truth), made.n), np.nan)
    known[:, :3] = drive.positions
    groups = {kind: [] for kind in names(drive)}
    for state, kind in enumerate(names(drive)):
        groups[kind].append(state)
    return Problem(
        name, f"A car between houses{which}", made,
        [
            Record(f"start {away:.0f} m off", drive.ranges, u, truth, [begin], half, known)
            for away, count in (FEW if quick else STARTS).items()
            for begin in starts(drive, away, count)
        ],
        by_hand, lambda x, real: np.hypot(*(x[:, :2] - real).T), "m", 100.0,
        tuning=None if quick else {
            "structure": {"disturbance": groups, "noise": {"pseudorange": range(made.p)}},
        },
        own=partial(own, drive, quick),
    )


def own(
    drive: Drive, quick: bool, problem: Problem, weights: Weights
) -> dict[str, Way]:
    """Over windows in which the car drives round some corners, and against reflections."""
    step = float(np.median(drive.lengths))
    horizon = min(round(LONG / step), len(drive.times))
    options: dict[str, Any] = {"horizon": horizon, "max_qps": 5, "warm_start": True}
    prior, walk, noise = (
        np.linalg.inv(one) for one in (weights.prior, weights.disturbance, weights.noise)
    )
    huber = qpmhe.RobustCost(
        prior=prior, disturbance=walk, noise=qpmhe.Huber(noise, HUBER, per_component=True)
    )
    redescending = qpmhe.RobustCost(
        prior=prior, disturbance=walk, noise=qpmhe.GemanMcClure(
            noise, drive.deviation * np.sqrt(noise[0, 0]), per_component=True, graduation=1.0
        )
    )
    bank = Bank(
        partial(problem.estimator, weights=weights, cost=redescending, delay=round(DELAY / step),
                **options),
        np.sqrt(weights.prior.diagonal()[:2]), compiled=not quick,
    )
    return {
        "EKF, Huber innovation": partial(
            problem.estimator, weights=weights, max_qps=0, horizon=1, project_observer=False,
            observer=partial(qpmhe.ExtendedKalman, innovation=qpmhe.HuberInnovation(HUBER)),
        ),
        f"MHE, Huber, {LONG:.0f} s": partial(
            problem.estimator, weights=weights, cost=huber, **options
        ),
        f"MHE, Geman-McClure, {LONG:.0f} s": bank.causal,
        f"the same, {DELAY:.0f} s late": bank.late,
    }


def draw(problems: Sequence[Problem], results: Sequence[Sequence[Result]]) -> Any:
    """The map of the first record, and the errors in time."""
    problem, found = problems[0], results[0]
    record = [one for one in problem.records if one.name == found[-1].record][0]
    wanted = ["EKF", *own_names()]
    shown = {
        one.estimator: one.middle for one in found
        if one.weights == BY_HAND and one.record == record.name and one.estimator in wanted
    }
    with rc_context(LIGHT):
        figure = Figure(figsize=(11.0, 5.6), layout="constrained")
        places, errors = figure.subplots(1, 2, width_ratios=(1, 1.2))
    return figure
