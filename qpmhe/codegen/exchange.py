"""The memory of the step in C, read from its structure and written to it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..estimation.conditions import Conditions
from ..estimation.engine import PythonEngine
from ..memory.fields import Field, MemorySizes
from ..memory.record import MemoryRecord
from ..memory.snapshot import checked_array
from ..model.sets import ConvexSet
from .directions import Directions
from .layout import SET_NAMES, Layout

Array = NDArray[np.float64]

# What the ring of stages has in place of a record's window; the rest follows from it.
_OF_RING = ("first", "length", "has_trajectory", "has_smoothed_prior")


def _in_order(memory: Any) -> NDArray[np.intp]:
    """Places of the window's stages in the ring, the oldest first."""
    places: NDArray[np.intp] = (int(memory["first"]) + np.arange(memory["length"])) % len(
        memory["stages"]
    )
    return places


def empty_record(layout: Layout, directions: Directions) -> MemoryRecord:
    """A record of what both engines have, for one estimator of a library."""
    n = layout.nx
    covariance = np.zeros((n, n)) if layout.covariance else None
    return MemoryRecord(layout.sizes, np.zeros(n), covariance, directions.system.dt or 0.0)


def record_of(memory: Any, layout: Layout, directions: Directions) -> MemoryRecord:
    """What both engines have, from an ``mhe_estimator``."""
    record, places = empty_record(layout, directions), _in_order(memory)
    length, time = len(places), int(memory["time"])
    for field in layout.sizes.fields("both", "stage", "state"):
        array = record.rows[field.name]
        array[:length] = memory["stages"][field.name][places]
        if field.rows == "state":
            array[length] = memory[f"{field.name}_end"]
    record.y[:length][~record.is_observed[:length]] = 0.0
    record.start, record.end, record.unusual = 0, length, True
    for field in layout.sizes.fields("both", "once"):
        setattr(record, field.name, _single(memory, field, length))
    for k, place in enumerate(places):
        own = _conditions(memory["stages"][place], directions)
        if own is not None:
            record.own[time - length + k] = own
    return record


def own_fields(memory: Any, sizes: MemorySizes) -> dict[str, Any]:
    """Copies of what only the step in C has, from an ``mhe_estimator``."""
    stages = memory["stages"][_in_order(memory)]
    return {
        one.name: _plain(memory[one.name] if one.rows == "once" else stages[one.name]).copy()
        for one in _own(sizes)
    }


def write(memory: Any, sizes: MemorySizes, record: MemoryRecord, own: dict[str, Any]) -> None:
    """Write a record, and what `own_fields` returned, into a new ``mhe_estimator``.

    Raises any exception if the latter is damaged; the estimator is unusable then.
    """
    length = record.length
    stages = memory["stages"][:length]
    memory["length"] = length
    for field in sizes.fields("both", "stage", "state"):
        array = record.rows[field.name]
        stages[field.name] = array[:length]
        if field.rows == "state":
            memory[f"{field.name}_end"] = array[length]
    for field in sizes.fields("both", "once"):
        value = getattr(record, field.name)
        if field.may_be_missing:
            memory[f"has_{field.name}"] = value is not None
        if value is not None and field.of_window:
            memory[field.name][: length + 1] = value
        elif value is not None:
            memory[field.name] = value
    for field in _own(sizes):
        part = memory if field.rows == "once" else stages
        like, name = _plain(part[field.name]), field.name
        given = checked_array(name, own[name], like.shape, like.dtype, field.is_finite)
        kind = part[name].dtype
        part[name] = given if kind.names is None else given.view(kind).reshape(length)


def _single(memory: Any, field: Field, length: int) -> Any:
    """A value of which there is one, as a record has it; None for one that is missing."""
    if field.may_be_missing and not memory[f"has_{field.name}"]:
        return None
    value = np.asarray(memory[field.name])
    if field.kind in ("count", "time"):
        return tuple(value.tolist()) if field.shape else value.item()
    if not field.shape:
        return value.item()
    return value[: length + 1 if field.of_window else None].copy()


def _own(sizes: MemorySizes) -> list[Field]:
    return [
        one for one in sizes.fields("c", "once", "stage")
        if one.engine == "c" and one.name not in _OF_RING
    ]


def _plain(value: Any) -> NDArray[Any]:
    """An array of numbers: of structures their bytes."""
    array = np.asarray(value)
    if array.dtype.names is None:
        return array
    clean = np.zeros(array.shape, array.dtype)  # and so is what lies between the fields
    for name in array.dtype.names:
        clean[name] = array[name]
    return clean.view(np.uint8).reshape(len(array), array.dtype.itemsize)


def sample_arrays(layout: Layout) -> dict[str, tuple[NDArray[Any], int]]:
    """Arrays for what a sample may come with, and their addresses, by their names in C."""
    n, p = layout.nx, layout.ny
    arrays: dict[str, NDArray[Any]] = {
        "noise_weight": np.zeros((p, p)), "disturbance_weight": np.zeros((n, n)),
        "sampled": np.zeros(p, np.uint8),
        **{name: np.zeros(1, layout.set_type(name)) for name in SET_NAMES},
    }
    return {name: (array, array.ctypes.data) for name, array in arrays.items()}


def write_sample(
    sample: Any, arrays: dict[str, tuple[NDArray[Any], int]], directions: Directions,
    dt: float | None, own: Conditions | None,
) -> None:
    """Write a sample's step length and conditions into an ``mhe_sample`` and these arrays."""
    sample["step"] = dt or 0.0
    for name, (array, address) in arrays.items():
        value = None if own is None else getattr(own, name)
        if value is None:
            sample[name] = 0
            continue
        if isinstance(value, ConvexSet):
            directions.write_sides(name, array[0], value)
        else:
            array[...] = directions.weight_of_d(value) if name == "disturbance_weight" else value
        sample[name] = address


def hand_over(
    memory: Any, layout: Layout, directions: Directions, usual: Conditions, engine: PythonEngine,
    replay: bool,
) -> None:
    """Let a new Python engine continue where an ``mhe_estimator`` stands; see its `adopt`."""
    stages, n = memory["stages"][_in_order(memory)], layout.nx
    metric = None
    if layout.projects:
        metric = memory["metric"].reshape(n, n).copy(), bool(memory["metric_settled"])
    engine.adopt(
        usual, record_of(memory, layout, directions), np.hstack((stages["w"], stages["v"])),
        metric, replay,
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
