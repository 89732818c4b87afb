"""A motor whose inertia shows only while it accelerates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

import qpmhe
from qpmhe.plots.style import LIGHT, MEASURED, REAL, line_styles
from qpmhe.tuning import Weights

from ..problem import Array, Problem, Record, Result, Way

DT = 0.01  # s
TORQUE = 0.05  # N m / A
FRICTION = 2e-4  # N m s: the model's
STICTION = 0.006  # N m: not in the model
NOMINAL = 2.0  # g m^2
PRIOR = (2.0, 0.6)  # standard deviations: speed in rad/s, inertia in g m^2
DISTURBANCE, NOISE = 0.03, 0.3  # rad/s
QUICK, STIFF = 0.03, 3e-4  # g m^2: what the inertia may change in one sample
HOLD = 0.1
HORIZON = 20
# Samples: until it runs steadily, with another inertia from CHANGE on, until it accelerates again.
STEADY, CHANGE, AGAIN, END = 8 * HORIZON, 18 * HORIZON, 21 * HORIZON, 26 * HORIZON
INERTIAS = 2.4, 1.4  # g m^2
SEEDS, FEW = 12, 1
LOST = 100.0  # per cent
HELD, STIFFER = "MHE, 2 QPs, held", "MHE, 2 QPs, stiff"
SHOWN = (HELD, "MHE, 2 QPs", STIFFER)
NOTE = (
    "Unseen: while the speed is steady, up to the change. Again: from two horizons after the first "
    "acceleration on; what is before tunes."
)


def rate(x: Array, u: Array, inertia: Array) -> Array:
    """The speed's, in rad/s per s; current in, inertia in g m^2."""
    return 1e3 * (TORQUE * u - FRICTION * x) / inertia


def speed(x: Array, *_: Array) -> Array:
    """What the encoder gives."""
    return x


def system(hold: float | None = None) -> qpmhe.System:
    """Speed and inertia; the latter drifts."""
    return qpmhe.augment_parameters(
        rate, speed, n=1, p=1, m=1, dt=DT, nominal=[NOMINAL], drifting=True, hold=hold
    )


def simulate(seed: int) -> tuple[Array, Array, Array]:
    """Measurements (T, 1), currents (T, 1) and inertias (T, 1) of one run."""
    generator, x = np.random.default_rng(seed), 0.0
    inertias = np.where(np.arange(END) < CHANGE, *INERTIAS)
    y, u = np.zeros((END, 1)), np.zeros((END, 1))
    for t, inertia in enumerate(inertias):
        steady = STEADY <= t < AGAIN
        wanted = 40.0 if steady else 40.0 + 15.0 * np.sign(np.sin(np.pi * t / 25.0))
        u[t] = np.clip(0.2 * (wanted - x) + (FRICTION * x + STICTION) / TORQUE, -3.0, 3.0)
        y[t] = x + NOISE * generator.standard_normal()
        torque = TORQUE * u[t, 0] - FRICTION * x - STICTION * np.tanh(x)
        x += DT * 1e3 * torque / inertia + 0.5 * DISTURBANCE * generator.standard_normal()
    return y, u, inertias[:, None]


def problems(_: Path, quick: bool) -> list[Problem]:
    """The same runs, judged while the inertia is unseen and where it is seen again."""
    time, start = np.arange(END)[:, None], np.array([0.0, NOMINAL])
    runs = [simulate(seed) for seed in range(FEW if quick else SEEDS)]
    records = [
        Record(name, y, u, np.where(judged, truth, np.nan), [start], tunes)
        for name, judged, tunes in (
            ("unseen", (time >= STEADY + HORIZON) & (time < CHANGE), 0),
            ("again", time >= AGAIN + 2 * HORIZON, AGAIN + HORIZON),
        )
        for y, u, truth in runs
    ]
    weights = Weights(
        np.diag(PRIOR) ** 2, np.diag([DISTURBANCE, QUICK]) ** 2, np.array([[NOISE**2]]), HORIZON
    )
    groups = {"disturbance": {"speed": [0], "inertia": [1]}, "noise": {"encoder": [0]}}
    return [Problem(
        "weak_excitation", "Inertia of a motor", system(), records, weights,
        lambda x, real: 100.0 * np.abs(x[:, 1:] / real - 1.0)[:, 0], "per cent", LOST,
        tuning=None if quick else {"held_out": 0.0, "structure": groups}, own=own, note=NOTE,
    )]


def own(problem: Problem, given: Weights) -> dict[str, Way]:
    """Stiff ones, and the same weights with the inertia held."""
    held = replace(problem, system=system(HOLD))
    stiff = replace(given, disturbance=np.diag([given.disturbance[0, 0], STIFF**2]))
    return {
        "EKF, stiff": partial(problem.estimator, weights=stiff, max_qps=0),
        STIFFER: partial(problem.estimator, weights=stiff, max_qps=2),
        HELD: partial(held.estimator, weights=given, max_qps=2),
        "MHE, converged, held": partial(held.estimator, weights=given, max_qps=None),
    }


def draw(problems: Sequence[Problem], results: Sequence[Sequence[Result]]) -> Any:
    """Speed, and the inertia with its estimates in the first run."""
    found, record, time = results[0], problems[0].records[0], DT * np.arange(END)
    inertias = np.where(np.arange(END) < CHANGE, *INERTIAS)
    with rc_context(LIGHT):
        figure = Figure(figsize=(9.6, 6.0), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    above.plot(time, record.measurements[:, 0], **MEASURED)
    above.set_ylabel("speed (rad/s)")
    below.plot(time, inertias, **REAL)
    first = {one.estimator: one.estimates[0] for one in found if one.record == "unseen"}
    for style, name in zip(line_styles(SHOWN), SHOWN, strict=True):
        below.plot(time, first[name][:, 1], linewidth=1.2, label=name, **style)
    for axes in (above, below):
        axes.axvspan(DT * STEADY, DT * AGAIN, color="0.92", zorder=0)
    below.set(xlabel="time (s)", ylabel="inertia (g m²)")
    below.set_ylim(1.0, 3.2)
    figure.legend(*below.get_legend_handles_labels(), loc="outside upper center", ncols=5)
    return figure
