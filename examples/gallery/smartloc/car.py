"""A car between houses, by GPS and GLONASS pseudoranges and its own speed and turn rate.

Houses hide satellites and reflect their signals: errors of tens of metres, which last for seconds,
many at once and all of one sign. A gate shuts on what disagrees with a state that such errors have
made; a loss that redescends, over a window in which the car drives round some corners, does not
depend on that state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

import qpmhe
from qpmhe.plots.style import LIGHT, line_styles
from qpmhe.tuning import Weights

from ..problem import Array, Problem, Record, Result, Way
from ..report import BY_HAND, tracks
from .bank import Bank
from .record import Drive, folders, read

# Seconds: of the windows, of the delay, and before an error counts.
SHORT, LONG, DELAY, SETTLING = 10.0, 80.0, 40.0, 10.0
# Metres from the truth, and runs from each: of the starts.
STARTS, FEW, FAR = {5.0: 2, 100.0: 4}, {5.0: 1, 100.0: 1}, {100.0: 4}
HUBER = 1.345
CAUSAL = f"MHE, Geman-McClure, {LONG:.0f} s"
LATE = f"the same, {DELAY:.0f} s late"
LONG_HUBER = f"MHE, Huber, {LONG:.0f} s"
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
    """Speed, turn rate and length of each step, and where the satellites are."""
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


def distance(x: Array, truth: Array) -> Array:
    """The error on the map, in m."""
    found: Array = np.hypot(*(x[:, :2] - truth).T)
    return found


def problems(folder: Path, quick: bool) -> list[Problem]:
    """Each record of the folder, with all signals and with the strong ones only."""
    found = []
    for one in folders(folder):
        drive = read(one)
        if quick:
            found.append(problem(one.name, "", drive, FEW, compiled=False))
            continue
        every = problem(one.name, "", drive, STARTS)
        found += [
            replace(every, tuning=tuning(drive)),
            problem(f"{one.name}_strong", f", signals of {STRONG:.0f} dBHz and more",
                    drive.strong(STRONG), FAR),
        ]
    return found


def tuning(drive: Drive) -> dict[str, Any]:
    """Options of `qpmhe.tune`: what the odometry adds is known, the receiver's errors are not."""
    kinds = names(drive)
    groups = {
        one: [k for k, kind in enumerate(kinds) if kind == one]
        for one in ("clock", "drift", "offset") if one in kinds
    }
    noise = {"pseudorange": list(range(drive.ranges.shape[1]))}
    return {"objective": "likelihood", "structure": {"disturbance": groups, "noise": noise}}


def problem(
    name: str, which: str, drive: Drive, away: Mapping[float, int], compiled: bool = True
) -> Problem:
    """A record from starts near and far; ``away`` has the numbers of runs by the distances."""
    u, half = inputs(drive), len(drive.times) // 2
    late = drive.times - drive.times[0] >= SETTLING
    truth = np.where(late[:, None], drive.positions[:, :2], np.nan)
    return Problem(
        name, f"A car between houses{which}", system(drive),
        [
            Record(f"start {one:.0f} m off", drive.ranges, u, truth, [begin], half)
            for one, count in away.items() for begin in starts(drive, one, count)
        ],
        weights(drive), distance, "m", 100.0, own=partial(own, drive, compiled), note=(
            f"Errors on the map, without the first {SETTLING:.0f} s; the late estimates have none "
            f"of the last {DELAY:.0f} s."
        ),
    )


def own(drive: Drive, compiled: bool, problem: Problem, weights: Weights) -> dict[str, Way]:
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
    # Of all starts the least cost is taken: no graduation.
    redescending = qpmhe.RobustCost(prior=prior, disturbance=walk, noise=qpmhe.GemanMcClure(
        noise, drive.deviation * np.sqrt(noise[0, 0]), per_component=True, graduation=1.0,
    ))
    bank = Bank(
        partial(problem.estimator, weights=weights, cost=redescending, **options),
        np.sqrt(weights.prior.diagonal()[:2]), delay=min(round(DELAY / step), horizon),
        compiled=compiled,
    )
    return {
        "EKF, Huber innovation": partial(
            problem.estimator, weights=weights, max_qps=0, horizon=1, project_observer=False,
            observer=partial(qpmhe.ExtendedKalman, innovation=qpmhe.HuberInnovation(HUBER)),
        ),
        LONG_HUBER: partial(problem.estimator, weights=weights, cost=huber, **options),
        CAUSAL: bank.causal,
        LATE: bank.late,
    }


def draw(problems: Sequence[Problem], results: Sequence[Sequence[Result]]) -> Any:
    """A map of each record, and the errors in time, with weights by hand from far away."""
    with rc_context(LIGHT):
        figure = Figure(figsize=(10.0, 5.2 * len(problems)), layout="constrained")
        panels = figure.subplots(len(problems), 2, squeeze=False, width_ratios=(1.0, 1.2))
        for (places, errors), problem, found in zip(panels, problems, results, strict=True):
            record = problem.records[-1]
            shown = {
                one.estimator: one.middle for one in found if one.weights == BY_HAND
                and one.record == record.name and one.estimator in ("EKF", LONG_HUBER, CAUSAL, LATE)
            }
            tracks(record.truth, {name: path[:, :2] for name, path in shown.items()},
                   labels=("east", "north"), axes=places)
            places.set_title(problem.title, loc="left")
            times = np.cumsum(record.inputs[:, 2]) - record.inputs[0, 2]
            for style, (name, path) in zip(line_styles(shown), shown.items(), strict=True):
                errors.plot(times, problem.error(path, record.truth), linewidth=1.2, label=name,
                            **style)
            errors.set(xlabel="time (s)", ylabel="error (m)", ylim=(0.0, None))
            errors.legend()
    return figure
