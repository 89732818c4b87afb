"""The window of a compiled estimator, handed over to the Python step."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..estimation.conditions import Conditions
from ..estimation.engine import PythonEngine, Taken
from ..model.sets import ConvexSet
from .directions import Directions
from .layout import SET_NAMES


def samples_of(record: Any, directions: Directions) -> list[Taken]:
    """The samples in the window of an ``mhe_estimator``, as the Python step takes them."""
    length, horizon = int(record["length"]), len(record["stages"])
    m = directions.system.m
    places = (int(record["first"]) + np.arange(length)) % horizon
    return [
        Taken(
            np.where(stage["is_observed"], stage["y"], np.nan), stage["u"][:m].copy(),
            float(stage["step"]) if stage["is_irregular"] else None, _conditions(stage, directions),
        )
        for stage in record["stages"][places]
    ]


def hand_over(record: Any, directions: Directions, usual: Conditions, engine: PythonEngine) -> None:
    """Let a new Python engine continue where an ``mhe_estimator`` stands."""
    horizon, length = len(record["stages"]), int(record["length"])
    time, newest = int(record["time"]), int(record["newest"])
    names, first = record.dtype.names, record["stages"][int(record["first"])]
    covariance = None
    if "covariance_end" in names:
        covariance = (first["covariance"] if length else record["covariance_end"]).copy()
    root = None
    if "root_end" in names and (first["is_vague"] if length else record["is_vague_end"]):
        root = (first["root"] if length else record["root_end"]).copy()
    rejections = None
    if "rejections_end" in names:
        rejections = (first["rejections"] if length else record["rejections_end"]).copy()
    count = min(time, horizon) + 1
    history = [record["history"][(newest - k) % (horizon + 1)].copy() for k in range(count)][::-1]
    engine.take_over(
        usual, time - length, (first["z"] if length else record["z_end"]).copy(),
        covariance, root, rejections, samples_of(record, directions),
        record["trajectory"][: length + 1].copy() if record["has_trajectory"] else None,
        history, (int(record["far"]), int(record["dropped"])),
        record["smoothed"].copy() if record["has_smoothed"] else None,
        record["trusted"].copy() if "trusted" in names else None,
    )


def _conditions(stage: Any, directions: Directions) -> Conditions | None:
    """What a stage came with; None if it came without any conditions."""
    found: dict[str, Any] = {}
    if stage["has_own_noise"]:
        found["noise_weight"] = stage["own_noise_weight"].copy()
    if stage["has_own_disturbance"]:
        weight = stage["own_disturbance_weight"]
        found["disturbance_weight"] = np.array(directions.weight_of_w(weight))
    for letter, name in zip("wvx", SET_NAMES, strict=True):
        one = directions.system.set_of(name)
        if one is not None and stage[f"has_own_{letter}"]:
            sides = directions.read_sides(name, stage[f"own_{letter}"], one)
            found[name] = ConvexSet(matrix=one.matrix, **sides)
    if not stage["is_sampled"].all():
        found["sampled"] = stage["is_sampled"].astype(np.bool_)
    return Conditions(**found) if found else None
