"""Cases in which samples come with conditions of their own, and the usual ones change."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

import qpmhe

if TYPE_CHECKING:
    from .cases import Case


def narrowed(one: qpmhe.ConvexSet, lower: float, upper: float) -> qpmhe.ConvexSet:
    """The set with its sides so many times as far from its middle; of one side, from 0."""
    sides = []
    for low, high in ((one.lower, one.upper), (one.row_lower, one.row_upper)):
        with np.errstate(invalid="ignore"):
            one_side = np.where(np.isfinite(low), abs(low), abs(high))
            half = np.where(np.isfinite(high - low), 0.5 * (high - low), one_side)
            half[~np.isfinite(half)] = 0.0
        sides += [low + (1.0 - lower) * half, high - (1.0 - upper) * half]
    return one.with_sides(*sides)


def weights(one: Case, t: int) -> dict[str, np.ndarray]:
    """Weights of noise and disturbance; diagonal where the cost's are."""
    found = {}
    for name in ("noise", "disturbance"):
        usual = getattr(one.cost, name)
        other = np.diag(usual.diagonal() * (1.0 + 0.5 * np.sin(t + np.arange(len(usual)))))
        if np.count_nonzero(usual - np.diag(usual.diagonal())):
            other += 0.2 * other[0, 0]
        found[f"{name}_weight"] = other
    return found


def bounds(one: Case, lower: float, upper: float) -> dict[str, Any]:
    """Narrower sets of all that the system has."""
    sets = {name: one.system.set_of(name) for name in ("states", "disturbances", "noises")}
    found = {n: narrowed(each, lower, upper) for n, each in sets.items() if each is not None}
    return {"bounds": found} if found else {}


def with_conditions(one: Case) -> Case:
    """The case with other weights, bounds, sensors, parameters and steps at some samples."""
    samples, p = [], one.system.p
    given = len(one.options.get("parameters", ()))
    for t, sample in enumerate(one.samples):
        kind, own, own_weights = t % 7, {}, weights(one, t)
        if kind in (1, 6):
            own["noise_weight"] = own_weights["noise_weight"]
        if kind in (2, 6):
            own["disturbance_weight"] = own_weights["disturbance_weight"]
        if kind in (3, 6):
            own["sensors"] = [t % p] if t % 2 else np.arange(p) == t % p
            own["y"] = np.array(sample["y"], float)[[t % p]]
        if kind in (4, 6):
            own |= bounds(one, 0.8, 0.6 + 0.05 * (t % 3))
        if kind in (5, 6) and one.system.dt:
            own["dt"] = 0.7 * one.system.dt
        if kind in (2, 5) and given:
            own["parameters"] = np.array(one.options["parameters"]) * (1.0 + 0.1 * np.cos(t))
        samples.append(sample | own)
    return replace(one, samples=tuple(samples))


def with_changes(one: Case) -> Case:
    """The case with other usual weights, bounds and parameters from some samples on."""
    third, all_weights = len(one.samples) // 3, weights(one, 1)
    parameters = one.options.get("parameters", ())
    changes = {
        0: {"noise_weight": all_weights["noise_weight"]},
        third: bounds(one, 0.9, 0.8) | {"disturbance_weight": all_weights["disturbance_weight"]},
        2 * third: weights(one, 2),
    }
    if parameters:
        changes[third]["parameters"] = 1.2 * np.array(parameters)
    return replace(one, changes=changes)


def with_parameters(one: Case, *values: float) -> Case:
    """The case with the last inputs as parameters."""
    count = len(values)
    samples = tuple(
        {k: v[:-count] if k == "u" else v for k, v in sample.items()} for sample in one.samples
    )
    if one.system.m == count:
        for sample in samples:
            del sample["u"]
    return replace(one, samples=samples).with_options(parameters=values)
