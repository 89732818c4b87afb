"""What ends an observer's bound along a run: events of its samples, and other models."""

from __future__ import annotations

from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import Array
from ..estimation.estimate import Status
from ..model.system import System
from .enclosures import evaluated
from .evidence import MismatchError
from .model_values import SAME_MODEL
from .properties import ObserverStability
from .regions import Region

#: Of an estimator whose observer does not run on.
REINITIALIZED = (
    "the candidate comes from an observer that restarts at each sample, whose states this bound "
    "does not cover"
)
#: Where the data contradict what is assumed.
CONTRADICTION = (
    "no state of the region fits the bound: the disturbances, the noises or the initial error were "
    "larger than stated, or the model is another one"
)
_EVENTS = {
    Status.MISSING: "a measurement was missing",
    Status.MODEL_FAILED: "the model failed, and the observer restarted",
    Status.METRIC_SINGULAR: "the observer was projected in the projection's own metric",
    Status.RESTARTED: "the observer was restarted from an estimate (RESTARTED)",
}
_PROJECTED = (
    "the observer was projected onto X in another metric than the certified one, "
    "metric=observer_bound.metric"
)


def first_event(
    region: Region, projects: bool, flags: NDArray[np.integer[Any]], observer: Array,
    inputs: Array | None = None, steps: ArrayLike | None = None, usual: float | None = None,
) -> tuple[int | None, str]:
    """The first sample after which a bound on a region does not follow, and why.

    Arguments are those of `ObserverBound.first_event`.
    """
    events = _EVENTS if projects else _EVENTS | {Status.OBSERVER_PROJECTED: _PROJECTED}
    where: list[tuple[Any, str, Any]] = [
        ((flags & flag.value) != 0, text, flags) for flag, text in events.items()
    ]
    outside = "the observer was outside of the region, at {}"
    where.append((~region.contains(observer), outside, observer))
    if inputs is not None:
        low, high = region.lower[region.n :], region.upper[region.n :]
        beyond = ~((low <= inputs) & (inputs <= high)).all(axis=1)
        where.append((beyond, "the input {} is outside of what was certified", inputs))
    if steps is not None:
        text = f"the step had the length {{}}, and {usual or 0.0:.6g} is certified"
        where.append((np.asarray(steps) != usual, text, np.asarray(steps)))
    first = [(int(there.argmax()), *rest) for there, *rest in where if there.any()]
    if not first:
        return None, ""
    t, text, values = min(first, key=itemgetter(0))
    return t, text.format(np.round(values[t], 6).tolist())


def check_model(
    stability: ObserverStability, region: Region, used: System, states: Array, inputs: Array | None
) -> None:
    """Refuse a run of another model: by certified values, and at the run's states by the system."""
    certified = stability.system
    for who, system in (("the system", certified), ("the run's system", used)):
        # Values of functions without an expression are compared at all states of the run below.
        changed = "" if system is None else stability.difference(system, certified is not None)
        if changed:
            raise MismatchError(
                f"{who} is another than was certified: {changed}; certify the system of the run."
            )
    points = np.hstack((states, np.zeros((len(states), 0)) if inputs is None else inputs))
    low, high, n = region.lower[region.n :], region.upper[region.n :], region.n
    # Elsewhere the bound ends, and the model need not be defined.
    usual = ((low <= points[:, n:]) & (points[:, n:] <= high)).all(axis=1)
    times = np.flatnonzero(region.contains(states) & usual)
    if certified is None or not times.size:
        return
    points = points[times]
    for name in ("f", "h"):
        mine, other = (
            evaluated(name, getattr(one, name), points, n) for one in (certified, used)
        )
        # Of each component's own unit.
        size = np.abs(mine).max(axis=0)
        if name == "f":
            size = np.maximum(size, np.abs(points[:, :n]).max(axis=0))
        same = (np.abs(mine - other) <= SAME_MODEL * size).all(axis=1)
        if not same.all():
            k = int(same.argmin())
            raise MismatchError(
                f"{name} of the run's system is {other[k].tolist()} at sample {times[k]}, and that "
                f"of the certified one {mine[k].tolist()}; certify the system of the run."
            )
