"""What ends the observer's bound: events after which its inequality says nothing."""

from __future__ import annotations

import numpy as np

from .._checks import Array
from ..estimation.estimate import Status
from ..estimation.run import Run, RunSource
from .regions import Region

#: Of an estimator whose observer does not run on.
REINITIALIZED = (
    "the candidate comes from an observer that starts again at each sample, whose states this "
    "bound is not about"
)
#: Where the data contradict what is assumed.
CONTRADICTION = (
    "no state of the region fits the bound: the disturbances, the noises or the initial error were "
    "larger than stated, or the model is another one"
)
_EVENTS = (
    (Status.MISSING, "a measurement was missing"),
    (Status.MODEL_FAILED, "the model failed, and the observer started again"),
    (Status.METRIC_SINGULAR, "the observer was projected in a metric of the projection's own"),
)
_PROJECTED = (
    Status.OBSERVER_PROJECTED,
    "the observer was projected onto X in another metric than the certified one, "
    "metric=observer_bound.metric",
)


def event_of(status: Status, projects: bool) -> str:
    """Which event of a step ends the bound, in words; empty if none does.

    ``projects`` says whether a projection onto X keeps it.
    """
    events = _EVENTS if projects else (*_EVENTS, _PROJECTED)
    return next((text for flag, text in events if flag in status), "")


def outside(region: Region, observer: Array) -> str:
    """What to say of an observer outside of the region; empty within it."""
    if region.contains(observer):
        return ""
    return f"the observer was outside of the region, at {np.round(observer, 6).tolist()}"


def input_beyond(region: Region, u: Array) -> str:
    """What to say of an input that is not certified; empty of one that is."""
    low, high = region.lower[region.n :], region.upper[region.n :]
    if bool(((low <= u) & (u <= high)).all()):
        return ""
    return f"the input {u.tolist()} is outside of what was certified"


def step_of(length: float, usual: float | None) -> str:
    """What to say of a step of another length than the one that was certified."""
    return f"the step had the length {length:.6g}, and {usual or 0.0:.6g} is certified"


def events_of(run: Run, region: Region, projects: bool) -> list[tuple[int, str]]:
    """Samples of a run after which the bound does not follow, and why: the first of each kind."""
    found = []
    for flag, text in _EVENTS if projects else (*_EVENTS, _PROJECTED):
        there = (run.flags & flag.value) != 0
        if there.any():
            found.append((int(there.argmax()), text))
    away = ~region.contains(run.observer_states[:-1])
    if away.any():
        t = int(away.argmax())
        found.append((t, outside(region, run.observer_states[t])))
    return found if run.source is None else found + _of_source(run.source, region)


def _of_source(source: RunSource, region: Region) -> list[tuple[int, str]]:
    """What a run's inputs, steps and settings say against the bound."""
    found = [(0, REINITIALIZED)] if source.settings.candidate != "observer" else []
    low, high = region.lower[region.n :], region.upper[region.n :]
    if source.inputs is not None:
        beyond = ((source.inputs < low) | (source.inputs > high)).any(axis=1)
        if beyond.any():
            t = int(beyond.argmax())
            found.append((t, input_beyond(region, source.inputs[t])))
    if source.steps is not None:
        other = np.asarray(source.steps) != source.system.dt
        if other.any():
            t = int(other.argmax())
            found.append((t, step_of(float(source.steps[t]), source.system.dt)))
    return found
