"""Snapshots: how they are written and read, and what is checked of each part."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidInputError

Array = NDArray[Any]

_STRUCTURE = "structure"
# Raised whenever the fields of the memory change.
_FORMAT = 2


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
    structure = {"format": _FORMAT, "digest": _digest(parts, arrays), "memory": parts}
    return {_STRUCTURE: json.dumps(structure)} | arrays


def _digest(parts: dict[str, Any], arrays: Mapping[str, Any]) -> str:
    """A number that all bits of a snapshot decide, but for those of NaN."""
    found = hashlib.sha256(json.dumps(parts).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        if array.dtype.kind == "f":
            array = np.where(np.isnan(array), np.nan, array)
        found.update(f"{name} {array.dtype.str} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


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

    arrays: dict[str, Any] = {}

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
        if not isinstance(array, np.ndarray):
            array = np.array(array, value["dtype"]).reshape(value["shape"])
        arrays[name] = array
        return array

    with reading():
        structure = json.loads(str(given[_STRUCTURE]))
        if not isinstance(structure, dict):
            raise TypeError(f"{_STRUCTURE} is {structure!r}")
        if structure.get("format") != _FORMAT:
            raise _MisfitError(
                f"the state has the format {structure.get('format', 1)!r} of another version of "
                f"qpmhe; expected {_FORMAT}. Continue from it with the version that saved it, or "
                "give this estimator the last samples again."
            )
        found = with_arrays(structure["memory"])
        if not isinstance(found, dict):
            raise TypeError(f"the memory is {found!r}")
        if structure["digest"] != _digest(structure["memory"], arrays):
            raise ValueError("its digest is another")
    return found


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
