"""What an estimator is, as a snapshot says it: whether the snapshot fits another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..costs.contracts import spare
from ..memory.snapshot import mismatch
from ..model.points import FEW, Points, points
from ..model.residuals import Residual
from ..model.system import System
from ..observers import Observer, Sample
from ..terms.base import read_only
from .settings import Settings

Array = NDArray[Any]

SET_NAMES = ("states", "disturbances", "noises")

# Two machines compute the same number with at most this difference: as a share of its size, and
# as a share of the largest entry of its array.
_ROUNDING, _FLOOR = 1e-7, 1e-10


def described(
    system: System, observer: Observer, cost: Cost, settings: Settings
) -> dict[str, Any]:
    """Model, observer and cost as arrays, numbers and names, to compare with another's.

    f and h, and the functions that a user has written for observer and cost, are described by their
    values at some points. Options that may change between saving and loading are left
    out: caps, backend and tolerances of the QPs, ``infeasible`` and ``warm_start``.
    """
    found: dict[str, Any] = {
        "candidate": settings.candidate, "arrival": settings.arrival, "sampling time": system.dt,
    }
    for name in system.described:
        _describe(name, getattr(system, name), found)
    if settings.restart:
        found["restart"] = settings.restart
    if system.held:
        found["hold"] = np.array(list(system.held.items()))
    if settings.parameters:
        found["number of parameters"] = len(settings.parameters)
    for name in SET_NAMES:
        _describe(f"set of {name}", system.soft.get(name, getattr(system, name)), found)
    if system.constraints is not None:
        found["constraints"] = system.constraints.described()
    for name, size in (("output_residual", system.p), ("state_residual", system.n)):
        residual = getattr(system, name)
        if residual is not None:
            found[name] = _values_of(residual, size)
    _describe("observer", observer, found)
    _describe("cost", cost, found)
    for name in ("prior", "disturbance", "noise", "discount"):
        _describe(f"cost.{name}", getattr(cost, name), found)
    where = points(FEW, system.n, system.m)
    for name, function in (("f", system.f), ("h", system.h)):
        found[f"model ({name})"] = _values_at(where, function.shape, function)
    if not observer.needs_jacobians:
        found["observer (its correction)"] = _corrections(system, observer, where)
    sizes = np.ldexp(1.0, np.arange(-4, 5, 2))[:, None]
    residuals = [(one, cost.stage_weight) for one in sizes * np.ones(len(cost.stage_weight))]
    found["cost (its values)"] = _values_at(
        residuals, (), lambda r, weight: cost.stage_costs(r[None], weight)[0]
    )
    return found


def _values_at(points: Sequence[tuple[Any, ...]], shape: tuple[int, ...], function: Any) -> Array:
    """A function's values, NaN where it is not defined."""
    values = np.full((len(points), *shape), np.nan)
    for k, point in enumerate(points):
        try:
            with np.errstate(all="ignore"):
                values[k] = function(*point)
        except Exception:  # outside of the function's domain
            continue
    return values


def _corrections(system: System, observer: Observer, points: Points) -> Array:
    """The corrections of an observer without Jacobians, at fitting errors of all sizes."""
    errors = np.ldexp(1.0, np.arange(-4, 5, 2))[:, None] * np.linspace(1.0, 2.0, system.p)
    observer, covariance = spare(observer), observer.initial_covariance()
    count, memory = len(observer.sensors), observer.initial_memory()

    def correction(x: Array, u: Array, error: Array) -> Array:
        sample = Sample(system, u, covariance=covariance)
        if memory is not None:
            sample.memory, sample.next_memory = read_only(np.array(memory)), np.array(memory)
        if count:
            sample.rejections, sample.next_rejections = np.zeros((2, count), np.int64)
        return observer.correct(x, error, sample)[0]

    given = [(x, u, error) for (x, u), error in zip(points, errors, strict=True)]
    return _values_at(given, (system.n,), correction)


def _values_of(residual: Residual, size: int) -> Array:
    """Differences of points of all magnitudes: who wraps them otherwise is another."""
    a, b = np.random.default_rng(20210829).uniform(-1.0, 1.0, (2, 32, size))
    powers = np.arange(-8, 24)[:, None]
    return residual(np.ldexp(a, powers), np.ldexp(b, powers))


def _describe(name: str, value: Any, found: dict[str, Any]) -> None:
    if isinstance(value, np.ndarray):
        found[name] = value.copy()
    elif value is None or isinstance(value, (bool, int, float, str)):
        found[name] = value
    elif isinstance(value, np.generic):
        found[name] = value.item()
    elif isinstance(value, (tuple, list)):
        for k, item in enumerate(value):
            _describe(f"{name}[{k}]", item, found)
    elif not (callable(value) or isinstance(value, (Mapping, System))):  # mappings are caches
        found[name] = type(value).__qualname__
        if not type(value).__module__.startswith("qpmhe."):
            return  # an attribute of a user's class need not be a parameter
        parts = dict(vars(value)) if hasattr(value, "__dict__") else {}
        for kind in type(value).__mro__:
            slots = getattr(kind, "__slots__", ())
            parts |= {key: getattr(value, key) for key in slots if hasattr(value, key)}
        if isinstance(value, Cost):
            parts["stage_weight"] = value.stage_weight
        for key in sorted(parts):
            _describe(f"{name}.{key.lstrip('_')}", parts[key], found)


def check_description(found: Any, mine: dict[str, Any]) -> None:
    """Raise if the state is of an estimator that differs, and name the difference."""
    if not isinstance(found, dict):
        raise TypeError("the estimator is not described")
    for name in (*mine, *found):
        if name not in found or name not in mine or not _alike(found[name], mine[name]):
            raise mismatch(name)


def _alike(one: Any, two: Any) -> bool:
    if not isinstance(one, (float, np.ndarray)) or not isinstance(two, (float, np.ndarray)):
        return type(one) is type(two) and bool(one == two)
    one, two = np.asarray(one), np.asarray(two)
    if one.shape != two.shape or one.dtype != two.dtype:
        return False
    if one.dtype != np.float64:
        return bool((one == two).all())
    size = np.abs(two)
    largest = size[np.isfinite(size)].max(initial=0.0)
    return near(one, two, size + _FLOOR / _ROUNDING * largest)


def near(found: Array | float, expected: Array | float, size: Array | float) -> bool:
    """Whether numbers differ by no more than the rounding of terms of this size."""
    found, expected = np.asarray(found), np.asarray(expected)
    finite = np.isfinite(expected)
    if not np.array_equal(found[~finite], expected[~finite], equal_nan=True):
        return False
    with np.errstate(all="ignore"):
        close = np.abs(found - expected) <= _ROUNDING * np.asarray(size)
    return bool((~finite | close).all())


