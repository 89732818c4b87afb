"""Checks of what a batch is given: whose it is, and whether it fits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import numbers
from ..errors import InvalidInputError, ModelError, ShapeError
from ..model.derivatives import Jacobian
from ..model.system import System
from ..observers import Observer
from .calls import Calls

__all__ = ["check_starts", "input_record", "inputs_of", "measurements_of", "record_of", "starts_of"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def starts_of(value: ArrayLike, members: int, n: int) -> Array:
    """Initial states (K, n), a copy, from one for all (n,) or one for each (K, n)."""
    given = numbers("initial_states", _even("initial_states", value, "states", ""))
    if given.ndim == 0 and n == 1:
        given = given.reshape(1)
    if given.shape not in ((n,), (members, n)):
        raise ShapeError(
            f"initial_states has shape {given.shape}; expected ({members}, {n}), a row for each "
            f"member, or ({n},) for all of them."
        )
    return np.array(np.broadcast_to(given, (members, n)))


def check_starts(system: System, observer: Observer, states: Array) -> None:
    """Insist on initial states that a single estimator takes; see there.

    Parameters
    ----------
    system, observer
        The estimators'.
    states : (K, n) array
        The initial states.

    Raises
    ------
    InvalidInputError
        If one does not fit; the text names the member.
    """
    if system.states is not None:
        for k, state in enumerate(states):
            if system.states.violation(state) > 0.0:
                raise InvalidInputError(
                    f"initial_states[{k}] is {state.tolist()}, which is outside of the state "
                    f"set {system.states!r}; start within it."
                )
    u = np.zeros((len(states), system.m))
    different, first = np.unique(states, axis=0, return_index=True)
    suspects = first[_suspects(system, different, u[: len(different)])]
    for k in np.unique([0, *suspects]):
        try:
            system.check(states[k], u[k])
        except ModelError as error:
            raise ModelError(f"initial_states[{k}]: {error}") from error
    for k in first:
        observer.check(system, states[k])


def _suspects(system: System, states: Array, u: Array) -> Mask:
    """States at which `System.check` may find fault, found by calls on all of them."""
    calls = Calls(system)
    with np.errstate(all="ignore"):
        good: Mask = np.asarray(np.isfinite(calls.f.at(states, u)).all(axis=1))
        values = calls.h.at(states, u)
        good &= np.isfinite(values).all(axis=1)
        for jacobian, function in (
            (system.f_jacobian, calls.f_jacobian), (system.h_jacobian, calls.h_jacobian)
        ):
            if jacobian.method == "finite differences":
                continue
            try:
                expected = np.asarray(_differences(jacobian, states, u))
                close = np.abs(function.at(states, u) - expected) <= 1e-4 * np.abs(expected) + 1e-6
                good &= close.all(axis=(1, 2))
            except Exception:  # outside of the domain beside some state: all are looked at
                good[:] = False
    return ~good


def _differences(jacobian: Jacobian, states: Array, u: Array) -> Any:
    return jacobian._differences(states, u)


def measurements_of(value: ArrayLike | None, members: int, p: int) -> Array:
    """Measurements (K, p) of one time; (K,) will do where p is 1, None is nothing at all."""
    if type(value) is np.ndarray and value.shape == (members, p) and value.dtype == np.float64:
        return value
    if value is None:
        return np.full((members, p), np.nan)
    if isinstance(value, (list, tuple)):
        nothing = np.nan if p == 1 and not any(map(np.ndim, _there(value))) else [np.nan] * p
        value = [nothing if row is None else row for row in value]
    given = numbers("Y", _even("Y", value, "components", _MISSING), finite=False)
    if given.shape == (members,) and p == 1:
        given = given[:, None]
    if given.shape != (members, p):
        raise ShapeError(
            f"Y has shape {given.shape}; expected ({members}, {p}), a row for each member. "
            "Rows of NaN stand for members without a measurement."
        )
    return given


def inputs_of(value: ArrayLike | None, members: int, m: int) -> Array:
    """Inputs (K, m) of one time, from one for all (m,) or one for each (K, m)."""
    if _without_inputs(value, m, "update(Y, U)"):
        return np.zeros((members, 0))
    assert value is not None
    given = numbers("U", _even("U", value, "components", ""), finite=False)
    if given.ndim == 0 and m == 1:
        given = given.reshape(1)
    if given.shape not in ((m,), (members, m)):
        raise ShapeError(
            f"U has shape {given.shape}; expected ({members}, {m}), a row for each member, or "
            f"({m},) for all of them."
        )
    return np.array(np.broadcast_to(given, (members, m)))


def record_of(value: ArrayLike, members: int, p: int) -> Array:
    """Measurements (K, T, p) of a record; (K, T) will do where p is 1."""
    given = numbers("Y", _even("Y", value, "samples", _MISSING), finite=False)
    if given.ndim == 2 and p == 1:
        given = given[:, :, None]
    if given.ndim != 3 or given.shape[::2] != (members, p):
        raise ShapeError(
            f"Y has shape {given.shape}; expected ({members}, T, {p}): a record for each member, "
            "with a row for each sample."
        )
    return given


def input_record(value: ArrayLike | None, members: int, m: int, steps: int) -> Array:
    """Inputs (K, T, m) of a record, from one for all (T, m) or one for each (K, T, m)."""
    if _without_inputs(value, m, "run(Y, U)"):
        return np.zeros((members, steps, 0))
    assert value is not None
    given = numbers("U", _even("U", value, "samples", ""), finite=False)
    if given.ndim == 1 and m == 1:
        given = given[:, None]
    if given.shape not in ((steps, m), (members, steps, m)):
        raise ShapeError(
            f"U has shape {given.shape}; expected ({members}, {steps}, {m}), a record for each "
            f"member as long as its measurements, or ({steps}, {m}) for all of them."
        )
    return np.broadcast_to(given, (members, steps, m))


_MISSING = " Fill up with NaN, which stands for what was not measured."


def _there(rows: Any) -> list[Any]:
    return [row for row in rows if row is not None]


def _without_inputs(value: ArrayLike | None, m: int, call: str) -> bool:
    """Whether there are none, as it must be where the system has none."""
    if value is None and m:
        raise InvalidInputError(f"U is missing; the system has {m} inputs: {call}.")
    if value is not None and m == 0:
        raise InvalidInputError("U was given, but the system has no inputs; leave it out.")
    return value is None


def _even(name: str, value: ArrayLike, parts: str, remedy: str) -> ArrayLike:
    """The value, if it is no list of rows of different lengths."""
    if isinstance(value, (list, tuple)):
        lengths = sorted({len(row) for row in value if hasattr(row, "__len__")})
        if len(lengths) > 1:
            raise ShapeError(
                f"{name} has rows of {lengths[0]} to {lengths[-1]} {parts}; expected the same "
                f"number for every member.{remedy}"
            )
    return value
