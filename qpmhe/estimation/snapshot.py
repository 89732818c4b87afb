"""Snapshots: writing them, and checking that they fit the estimator that reads them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import InvalidInputError
from ..model.residuals import Residual
from ..model.system import System, probe_points
from ..observers import Observer
from .settings import Settings

Array = NDArray[Any]

SET_NAMES = ("states", "disturbances", "noises")

# Two machines compute the same number with at most this difference: as a share of its size, and
# as a share of the largest entry of its array.
_ROUNDING, _FLOOR = 1e-7, 1e-10

_STRUCTURE = "structure"


def written(memory: dict[str, Any]) -> dict[str, Any]:
    """An engine's memory as arrays by name, and the rest as one JSON text.

    `numpy.savez` writes such a dict without pickle, and JSON with ``numpy.ndarray.tolist``.
    """
    arrays: dict[str, Any] = {}

    def without_arrays(value: Any, path: str) -> Any:
        if isinstance(value, np.ndarray):
            arrays[path] = value
            return {"array": path, "dtype": value.dtype.str, "shape": value.shape}
        if isinstance(value, Mapping):
            return {key: without_arrays(one, f"{path}/{key}") for key, one in value.items()}
        if isinstance(value, (list, tuple)):
            return [without_arrays(one, f"{path}/{k}") for k, one in enumerate(value)]
        return value

    parts = {key: without_arrays(value, key) for key, value in memory.items()}
    return {_STRUCTURE: json.dumps(parts)} | arrays


def read(state: Any) -> dict[str, Any]:
    """The memory that `written` saved; arrays may have become lists."""
    if not isinstance(state, Mapping):
        raise InvalidInputError(
            f"the state is a {type(state).__name__}; expected the dict that state_dict returned."
        )
    given = dict(state)
    if _STRUCTURE not in given:
        names = ", ".join(map(repr, list(given)[:10]))
        raise InvalidInputError(
            f"the state has no {_STRUCTURE!r} ({f'only {names}' if names else 'it is empty'}); "
            "expected the whole dict that state_dict returned."
        )

    def with_arrays(value: Any) -> Any:
        if isinstance(value, list):
            return [with_arrays(one) for one in value]
        if not isinstance(value, dict):
            return value
        if set(value) != {"array", "dtype", "shape"}:
            return {key: with_arrays(one) for key, one in value.items()}
        name = value["array"]
        if name not in given:
            raise _MisfitError(
                f"the state has no {name!r}; expected the whole dict that state_dict returned."
            )
        array = given[name]
        if isinstance(array, list):
            array = np.array(array, value["dtype"]).reshape(value["shape"])
        return array

    with reading():
        found = with_arrays(json.loads(str(given[_STRUCTURE])))
        if not isinstance(found, dict):
            raise TypeError(f"{_STRUCTURE} is {found!r}")
    return found


def described(
    system: System, observer: Observer, cost: Cost, settings: Settings
) -> dict[str, Any]:
    """Model, observer and cost as arrays, numbers and names, to compare with another's.

    f and h are described by their values at some points; other differences show when the
    stored stages are computed again. Options that may change between saving and loading are left
    out: caps, backend and tolerances of the QPs, ``infeasible`` and ``warm_start``.
    """
    found: dict[str, Any] = {
        "candidate": settings.candidate, "arrival": settings.arrival, "sampling time": system.dt,
    }
    for name in system.described:
        _describe(name, getattr(system, name), found)
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
    for name, function in (("f", system.f), ("h", system.h)):
        values = np.full((5, *function.shape), np.nan)
        for value, (x, u) in zip(values, probe_points(None, system.n, system.m), strict=True):
            try:
                with np.errstate(all="ignore"):
                    value[...] = function(x, u)
            except Exception:  # outside of the function's domain
                continue
        found[f"model ({name})"] = values
    return found


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


def check_root(root: Array, covariance: Array) -> None:
    """Raise if a root of the observer's covariance is not its upper triangular one."""
    deviations = np.sqrt(np.abs(covariance.diagonal()))
    size = np.multiply.outer(deviations, deviations)
    if np.tril(root, -1).any() or not near(root.T @ root, covariance, size):
        raise mismatch("observer")


class _MisfitError(InvalidInputError):
    """The state is of another estimator, or not whole."""


def mismatch(what: str) -> InvalidInputError:
    """The error for estimators that differ in ``what``."""
    return _MisfitError(
        f"the state is from an estimator with another {what}, or damaged; create this estimator "
        "with the arguments of that one."
    )


@contextmanager
def reading() -> Iterator[None]:
    """Turn any exception while reading a snapshot into `InvalidInputError`."""
    try:
        yield
    except _MisfitError:
        raise
    except Exception as error:
        raise InvalidInputError(
            f"the state is damaged ({type(error).__name__}: {error}); expected what "
            "state_dict returned, unchanged."
        ) from error


def checked_array(
    name: str, value: Any, shape: tuple[int, ...], kind: Any = np.float64, finite: bool = True
) -> Array:
    """A copy of an array of a snapshot, with its shape, type and finiteness checked."""
    if not isinstance(value, np.ndarray) or value.dtype != kind or value.shape != shape:
        found = (value.shape, value.dtype) if isinstance(value, np.ndarray) else type(value)
        raise TypeError(f"{name} is {found}; expected an array {shape} of {np.dtype(kind)}")
    if finite and not np.isfinite(value).all():
        raise ValueError(f"{name} is not finite")
    return value.copy()


def check_size(name: str, value: Any, fits: Callable[[int], bool]) -> int:
    """An integer of a snapshot, checked."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not fits(int(value)):
        raise ValueError(f"{name} is {value!r}")
    return int(value)
