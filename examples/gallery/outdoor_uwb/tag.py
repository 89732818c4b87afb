"""A walker outdoors: distances to four anchors that stand close together, and nothing else.

The walker keeps its velocity but for a random walk. Where it starts is only known by the first
distances: it is tried all around the anchors.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from ..report import tracks
from .ranges import SOURCE, Walk, folders, read

__all__ = ["SOURCE", "draw", "problems"]

STARTS, FEW = 12, 2
QUICK = 300  # samples, what --quick takes of each record
HEIGHT = 1.0  # m, of a tag that somebody carries
HORIZON = 80
# A walker changes its speed by 0.05 m/s from sample to sample. A range is good to 0.1 m, but its
# error lasts for a second or so: white noise that says as little of the position is larger.
SPEED, RANGE = 0.05, 0.2
SHOWN = ("EKF", "EKF, gated", "MHE, Geman-McClure, 5 QPs")
ROBUST = {
    "Huber, 5 QPs": (qpmhe.Huber, 5), "Cauchy, 5 QPs": (qpmhe.Cauchy, 5),
    "Geman-McClure, 2 QPs": (qpmhe.GemanMcClure, 2),
    "Geman-McClure, 5 QPs": (qpmhe.GemanMcClure, 5),
}


def model(anchors: Array) -> qpmhe.System:
    """Position (m) and velocity (m/s) of the tag; the input is the length of the step in s."""
    east, north, above = anchors[:, 0], anchors[:, 1], (anchors[:, 2] - HEIGHT) ** 2

    def move(x: Array, u: Array) -> Array:
        return np.concatenate((x[..., :2] + u[..., :1] * x[..., 2:], x[..., 2:]), axis=-1)

    def distances(x: Array) -> Array:
        # Smooth where the tag is at an anchor, to a centimetre.
        level = (x[..., :1] - east) ** 2 + (x[..., 1:2] - north) ** 2
        return np.sqrt(level + above + 1e-4)

    return qpmhe.System(
        move, distances, n=4, p=len(anchors), m=1, disturbance_matrix=np.eye(4)[:, 2:],
    )


def starts(walk: Walk, count: int) -> list[Array]:
    """All around the anchors, as far as the first ranges say, and standing still."""
    centre, far = walk.anchors[:, :2].mean(axis=0), first_range(walk)
    angles = 2 * np.pi * np.arange(count) / count
    return [np.array([*(centre + far * np.array([np.cos(a), np.sin(a)])), 0, 0]) for a in angles]


def first_range(walk: Walk) -> float:
    """The median of the first ranges, of which some may be wrong."""
    return float(np.median(walk.ranges[np.isfinite(walk.ranges)][: 5 * len(walk.anchors)]))


def problem_of(walk: Walk, quick: bool) -> Problem:
    """A record, whose first half tunes."""
    p = len(walk.anchors)
    by_hand = Weights(
        prior=np.diag([first_range(walk)] * 2 + [1.0, 1.0]) ** 2,
        disturbance=np.eye(2) * SPEED**2, noise=np.eye(p) * RANGE**2, horizon=HORIZON,
    )
    known = np.column_stack((walk.path, np.full((len(walk.path), 2), np.nan)))
    record = Record(
        walk.name, walk.ranges, walk.steps[:, None], walk.path,
        starts(walk, FEW if quick else STARTS), len(walk.path) // 2, known,
    )
    gated = partial(qpmhe.ExtendedKalman, innovation=qpmhe.Gate())
    return Problem(
        f"outdoor_uwb_{walk.name}", f"Outdoor positions by ultra-wideband, {walk.name}",
        model(walk.anchors), [record], by_hand,
        lambda x, real: np.hypot(*(x[:, :2] - real).T), "m", 5.0,
        # The filter's own error in the first half: the strongest of the baselines sets the weights.
        tuning=None if quick else {
            "objective": "truth", "held_out": 0.0, "observer": gated, "max_qps": 0, "structure": {
                "disturbance": {"speed": [0, 1]}, "noise": {"range": list(range(p))},
            },
        }, own=own,
    )


def problems(folder: Path, quick: bool) -> list[Problem]:
    """One for each record: the anchors may differ."""
    walks = [read(one) for one in folders(folder)]
    return [problem_of(cut(walk, QUICK) if quick else walk, quick) for walk in walks]


def cut(walk: Walk, count: int) -> Walk:
    """Its first samples."""
    part = {name: getattr(walk, name)[:count] for name in ("times", "steps", "ranges", "path")}
    return walk._replace(**part)


def own(problem: Problem, weights: Weights) -> dict[str, Way]:
    """A gated observer, losses for outliers, and a prior that no filter has made certain."""
    gated = partial(qpmhe.ExtendedKalman, innovation=qpmhe.Gate())
    prior, disturbance, noise = (
        np.linalg.inv(one) for one in (weights.prior, weights.disturbance, weights.noise)
    )
    found: dict[str, Way] = {}
    for name, (loss, count) in ROBUST.items():
        cost = qpmhe.RobustCost(
            prior=prior, disturbance=disturbance, noise=loss(noise, per_component=True)
        )
        found[f"MHE, {name}"] = partial(
            problem.estimator, weights=weights, observer=gated, cost=cost, max_qps=count,
            warm_start=True,
        )
    return found


def draw(problems: Sequence[Problem], results: Sequence[Sequence[Result]]) -> Any:
    """A map of each record, and its errors over time."""
    with rc_context(LIGHT):
        figure = Figure(figsize=(7.2, 3.7 * len(problems)), layout="constrained")
        grid = figure.subplots(2 * len(problems), 1, squeeze=False)[:, 0]
        for k, (problem, found) in enumerate(zip(problems, results, strict=True)):
            (record,), (above, below) = problem.records, grid[2 * k : 2 * k + 2]
            # The weights of the last table: the tuned ones, if there are.
            lines = {one.estimator: one.middle for one in found if one.estimator in SHOWN}
            lines = {name: lines[name][:, :2] for name in SHOWN if name in lines}
            tracks(record.truth, lines, axes=above)
            low, high = record.truth.min(axis=0), record.truth.max(axis=0)
            margin = 0.05 * np.max(high - low)
            above.set(xlim=(low[0] - margin, high[0] + margin), title=record.name,
                      ylim=(low[1] - margin, high[1] + margin))
            times = np.cumsum(record.inputs[:, 0]) - record.inputs[0, 0]
            for style, path in zip(line_styles(lines), lines.values(), strict=True):
                below.plot(times, problem.error(path, record.truth), linewidth=1.0, **style)
            below.set(xlabel="time (s)", ylabel="error (m)", yscale="log", xlim=(0, times[-1]))
        grid[0].legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.15), frameon=False)
    return figure
