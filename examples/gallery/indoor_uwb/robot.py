"""A robot indoors: the distance to one of its anchors at a time, and its wheels' speeds.

Its start is the middle of the room, and the heading there is unknown: 24 headings are tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import qpmhe
from qpmhe.tuning import Weights

from ..command import DataError
from ..problem import Array, Problem, Record, Result, Way
from ..report import tracks

SOURCE = (
    "The Labyrinth Dataset by Tim Pfeifer, TU Chemnitz (CC BY-SA 4.0), is in github.com/TUC-ProAut/"
    "libRSF, folder datasets/Indoor_UWB: put input.txt and ground_truth.txt into one folder."
)
HEADINGS, FEW = 24, 4
HORIZON, THRESHOLD = 80, 1.345
# Those of a first trial: standard deviations in m and rad.
BY_HAND = Weights(
    prior=np.diag([1.0, 1.0, 2.0]) ** 2, disturbance=np.diag([0.004, 0.004, 0.01]) ** 2,
    noise=np.array([[0.12**2]]), horizon=HORIZON,
)


def rate(x: Array, u: Array) -> Array:
    """Of position (m) and heading (rad), by speed, turn rate, and the anchor's position."""
    speed, turn = u[..., 0], u[..., 1]
    return np.stack((speed * np.cos(x[..., 2]), speed * np.sin(x[..., 2]), turn), axis=-1)


def distance(x: Array, u: Array) -> Array:
    """To the anchor whose turn it is."""
    offsets = x[..., :2] - u[..., 2:]
    return np.sqrt((offsets * offsets).sum(axis=-1, keepdims=True) + 1e-6)


def read(folder: Path) -> tuple[Array, Array, Array, float]:
    """Distances (T, 1), inputs (T, 4), true positions (T, 2), and the sampling time in s."""
    try:
        lines = [one.split() for one in (folder / "input.txt").read_text().splitlines() if one]
        ranges = np.array([line[1:6] for line in lines if line[0] == "range2"], float)
        wheels = np.array([line[1:6] for line in lines if line[0] == "odom2diff"], float)
        truth = np.array([
            one.split()[1:4] for one in (folder / "ground_truth.txt").read_text().splitlines()
            if one
        ], float)
    except (IndexError, ValueError) as problem:
        raise DataError(f"its lines are not those of the data set ({problem})") from problem
    if not len(ranges) == len(wheels) == len(truth) or not np.allclose(ranges[:, 0], wheels[:, 0]):
        raise DataError("its distances, wheels' speeds and positions are not of the same times")
    times, (right, left), track = ranges[:, 0], wheels[:, 1:3].T, 2.0 * wheels[:, 4]
    # By a fit to the truth the wheels are the other way round.
    inputs = np.column_stack((0.5 * (right + left), (left - right) / track, ranges[:, 3:5]))
    return ranges[:, 1:2], inputs, truth[:, 1:], float(np.median(np.diff(times)))


def problems(folder: Path, quick: bool) -> list[Problem]:
    """The record from the middle of its anchors, with headings all around."""
    y, u, truth, dt = read(folder)
    low, high = u[:, 2:].min(axis=0), u[:, 2:].max(axis=0)
    count = FEW if quick else HEADINGS
    starts = [
        np.array([*(0.5 * (low + high)), angle]) for angle in 2 * np.pi * np.arange(count) / count
    ]
    system = qpmhe.System.from_ode(
        rate, distance, dt=dt, n=3, p=1, m=4, state_residual=qpmhe.angles([2]),
    )
    known = np.column_stack((truth, np.full(len(truth), np.nan)))
    return [Problem(
        "indoor_uwb", "Indoor positions by ultra-wideband", system,
        [Record("24 headings", y, u, truth, starts, len(y) // 2, known)], BY_HAND,
        lambda x, real: np.hypot(*(x[:, :2] - real).T), "m", 1.0,
        tuning={"objective": "prediction", "held_out": 0.0, "structure": {
            "disturbance": {"position": [0, 1], "heading": [2]}, "noise": {"range": [0]},
        }}, own=own,
    )]


def own(problem: Problem, weights: Weights) -> dict[str, Way]:
    """With a loss for outliers and a prior that no filter has made certain."""
    cost = Weights(
        weights.prior, weights.disturbance, weights.noise, HORIZON, threshold=THRESHOLD,
        arrival="constant",
    ).cost()
    return {
        "MHE, Huber, constant prior, 5 QPs": partial(
            problem.estimator, weights=weights, cost=cost, max_qps=5, warm_start=True
        )
    }


def draw(problems: Sequence[Problem], results: Sequence[Sequence[Result]]) -> Any:
    """The room."""
    (record,) = problems[0].records
    lines = {
        one.estimator: one.middle[:, :2] for one in results[0]
        if one.estimator in ("EKF", "MHE, Huber, constant prior, 5 QPs")
    }
    axes = tracks(record.truth, lines, landmarks=np.unique(record.inputs[:, 2:], axis=0))
    axes.legend()
    return axes.figure
