"""A robot indoors: the distance to one of its anchors at a time, and its wheels' speeds.

Neither start nor heading is known: every estimator starts in the middle of the anchors with one of
24 headings, and then at far places. All distances read too long by about the same, which is the
fourth state; the same without it stands beside.
"""

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
from qpmhe.plots.style import LIGHT
from qpmhe.tuning import Weights

from ..command import DataError
from ..problem import Array, Problem, Record, Result, Way
from ..report import BY_HAND, tracks

SOURCE = (
    "The Labyrinth Dataset by Tim Pfeifer, TU Chemnitz (CC BY-SA 4.0), is in github.com/TUC-ProAut/"
    "libRSF, folder datasets/Indoor_UWB: put input.txt and ground_truth.txt into one folder."
)
HEADINGS, FEW = 24, 4
HORIZON, THRESHOLD = 80, 1.345
LOST = 0.5  # m
MARGIN = 0.25  # of the room's size, on each side
# Standard deviations by hand, of position (m), heading (rad) and offset (m).
PRIOR, DISTURBANCE, NOISE = [1.0, 1.0, 2.0, 0.1], [0.004, 0.004, 0.01, 0.001], 0.12
QUADRATIC, ROBUST = "MHE, constant prior", "MHE, Huber, 5 QPs"
SHOWN = "EKF", "UKF", ROBUST
NOTE = (
    f"{QUADRATIC}: 5 QPs, horizon {HORIZON}, warm-started; {ROBUST}: with a robust loss as well. "
    "Like all MHE within the room of the anchors, widened by a quarter."
)


def step(x: Array, u: Array) -> Array:
    """Drive on an arc: u is speed (m/s), turn rate (rad/s), the anchor's position, and time (s)."""
    distance, turn = u[..., 0] * u[..., 4], u[..., 1] * u[..., 4]
    middle = x[..., 2] + 0.5 * turn
    moved = (distance * np.cos(middle), distance * np.sin(middle), turn)
    return x + np.stack((*moved, *(0.0 * turn for _ in range(x.shape[-1] - 3))), axis=-1)


def measured(x: Array, u: Array) -> Array:
    """The distance to the anchor whose turn it is, and the offset where it is a state."""
    away = x[..., :2] - u[..., 2:4]
    # The small number keeps the derivative finite on an anchor.
    reach = np.sqrt((away * away).sum(axis=-1, keepdims=True) + 1e-6)
    return reach if x.shape[-1] == 3 else reach + x[..., 3:]


def read(folder: Path) -> tuple[Array, Array, Array]:
    """Distances (T, 1), inputs (T, 5) as `step` takes them, and true positions (T, 2)."""
    lines: dict[str, list[list[str]]] = {"range2": [], "odom2diff": [], "point2": []}
    for name in ("input.txt", "ground_truth.txt"):
        for line in (folder / name).read_text().splitlines():
            kind, *words = line.split() or [""]
            if kind in lines:
                lines[kind].append(words[:5])
    try:
        ranges = np.array(lines["range2"], float)
        wheels = np.array(lines["odom2diff"], float)
        points = np.array([words[:3] for words in lines["point2"]], float)
        times, at = ranges[:, 0], ranges[:, 3:5]
        right, left, _, half_track = (
            np.interp(times, wheels[:, 0], column) for column in wheels[:, 1:].T
        )
        truth = np.column_stack([
            np.interp(times, points[:, 0], column) for column in points[:, 1:].T
        ])
    except (IndexError, ValueError) as error:
        raise DataError(f"its lines are not those of the data set ({error})") from error
    if len(times) < HORIZON or (np.diff(times) < 0.0).any():
        raise DataError(f"it has {len(times)} distances; expected {HORIZON} or more, in time order")
    after = np.append(np.diff(times), np.median(np.diff(times)))
    # By a fit to the truth the wheels are the other way round.
    turn = (left - right) / (2.0 * half_track)
    return ranges[:, 1:2], np.column_stack((0.5 * (right + left), turn, at, after)), truth


def problems(folder: Path, quick: bool) -> list[Problem]:
    """With and without the offset."""
    record = read(folder)
    return [problem(*record, n, FEW if quick else HEADINGS) for n in (4, 3)]


def problem(y: Array, u: Array, truth: Array, n: int, headings: int) -> Problem:
    """The record from the middle of its anchors and from far, with headings all around."""
    low, high = u[:, 2:4].min(axis=0), u[:, 2:4].max(axis=0)
    size, free, half = high - low, np.full(n - 2, np.inf), len(y) // 2
    system = qpmhe.System(
        step, measured, n=n, p=1, m=5, state_residual=qpmhe.angles([2]),
        states=qpmhe.Box([*(low - MARGIN * size), *-free], [*(high + MARGIN * size), *free]),
    )

    def record(name: str, places: Sequence[Any], count: int) -> Record:
        starts = [
            np.array([*place, angle, *np.zeros(n - 3)])
            for place in places for angle in 2 * np.pi * np.arange(count) / count
        ]
        return Record(name, y, u, truth, starts, half)

    far = [low, high, [low[0], high[1]], [high[0], low[1]], low - size, high + size]
    groups = {"position": [0, 1], "heading": [2], "offset": [3]}
    return Problem(
        "indoor_uwb" if n == 4 else "indoor_uwb_no_offset",
        "Indoor positions" if n == 4 else "Indoor positions, no offset",
        system,
        [record(f"{headings} headings", [low + 0.5 * size], headings),
         record("corners, outside", far, max(1, headings // 3))],
        Weights(np.diag(PRIOR[:n]) ** 2, np.diag(DISTURBANCE[:n]) ** 2, np.array([[NOISE**2]]),
                HORIZON),
        lambda x, real: np.hypot(*(x[:, :2] - real).T), "m", LOST,
        tuning={"objective": "likelihood", "held_out": 0.0, "structure": {
            "disturbance": dict(list(groups.items())[: n - 1]), "noise": {"range": [0]},
        }},
        own=own, note=NOTE,
    )


def own(problem: Problem, weights: Weights) -> dict[str, Way]:
    """With a prior that no filter has made certain, and with a loss for outliers as well."""
    constant = replace(weights, arrival="constant")
    way = partial(problem.estimator, max_qps=5, warm_start=True)
    return {
        QUADRATIC: partial(way, weights=constant),
        ROBUST: partial(way, weights=replace(constant, threshold=THRESHOLD)),
    }


def draw(problems: Sequence[Problem], results: Sequence[Sequence[Result]]) -> Any:
    """The room, with each estimator's runs of median and of largest error."""
    record = problems[0].records[0]
    found = [
        one for one in results[0]
        if one.estimator in SHOWN and (one.weights, one.record) == (BY_HAND, record.name)
    ]
    with rc_context(LIGHT):
        figure = Figure(figsize=(8.6, 5.0), layout="compressed")
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        anchors = np.unique(record.inputs[:, 2:4], axis=0)
        for axes, which in zip(panels, ("median", "worst"), strict=True):
            paths = {}
            for one in found:
                path = one.middle if which == "median" else one.estimates[np.argmax(one.errors)]
                paths[one.estimator] = path[:, :2]
            tracks(record.truth, paths, landmarks=anchors, axes=axes)
            axes.set_title(f"{which} run of {record.name}")
        # A filter that is lost may be far away.
        low, high = anchors.min(axis=0), anchors.max(axis=0)
        axes.set(xlim=(low[0] - 0.5, high[0] + 0.7), ylim=(low[1] - 0.5, high[1] + 0.5))
        figure.legend(
            *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5
        )
    return figure
