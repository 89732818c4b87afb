"""A model's functions at many states at once: values, Jacobians, failures and jumps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from ..errors import ModelError
from ..model.functions import BatchedFunction
from ..model.system import System

_REMEDY = "Take a smaller region, or make the model defined on all of it."
_PAIRS, _SEED = 400, 20210829
# A function with derivatives changes on 2^-40 of an interval by about that share.
_HALVINGS, _LEFT, _LEAST = 40, 1e-3, 1e-9


class _Batched(Protocol):
    @property
    def batch(self) -> Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]: ...


def evaluated(name: str, function: _Batched, x: Array, u: Array) -> Array:
    """A function's values; the state is named where it raises."""
    with np.errstate(all="ignore"):
        try:
            return np.array(function.batch(x, u), np.float64)
        except Exception as error:  # a user's function may raise anything
            raise ModelError(_raised(name, function, x, u, error)) from error


def _raised(name: str, function: _Batched, x: Array, u: Array, first: Exception) -> str:
    for k in range(len(x)):
        try:
            np.array(function.batch(x[k : k + 1], u[k : k + 1]), np.float64)
        except Exception as error:
            return (
                f"{name} raises {type(error).__name__} at {_place(x[k], u[k])}, within the region: "
                f"{error}. {_REMEDY}"
            )
    return (
        f"{name} raises {type(first).__name__} at several states of the region at once, though "
        f"not at any of them alone: {first}. Write it for one state at a time."
    )


def _place(x: Array, u: Array) -> str:
    return f"x = {x.tolist()}" + (f", u = {u.tolist()}" if u.size else "")


def check_values(system: System, points: Array, *, output_only: bool = False) -> None:
    """Raise a ModelError where f or h raises or is not finite."""
    x, u = points[:, : system.n], points[:, system.n :]
    for name, function in (("f", system.f), ("h", system.h))[output_only:]:
        values = evaluated(name, function, x, u)
        broken = ~np.isfinite(values).all(axis=1)
        if broken.any():
            k = int(np.argmax(broken))
            raise ModelError(
                f"{name} is not finite at {_place(x[k], u[k])}, within the region: it returned "
                f"{values[k].tolist()}. {_REMEDY}"
            )


def find_jump(system: System, points: Array) -> str:
    """Which of f and h seems to jump between some states, in words; empty if none does.

    Segments between states drawn at random are halved towards the larger change.
    """
    rng = np.random.default_rng(_SEED)
    first, second = rng.integers(len(points), size=(2, _PAIRS))
    start, end = points[first], points[second].copy()
    end[:, system.n :] = start[:, system.n :]
    for name, function in (("f", system.f), ("h", system.h)):
        try:
            where, size = _largest_jump(function, start, end, system.n)
        except Exception:  # a user's function may raise outside of the region
            continue
        if size > 0.0:
            return f"{name} seems to jump, by {size:.3g} at {np.round(where, 6).tolist()}"
    return ""


def _largest_jump(
    function: BatchedFunction, low: Array, high: Array, n: int
) -> tuple[Array, float]:
    """Where on some segments the largest jump is, and its size; 0 if there is none."""

    def at(points: Array) -> Array:
        return np.array(function.batch(points[:, :n], points[:, n:]), np.float64) / unit

    with np.errstate(all="ignore"):
        unit = np.ones(())
        sizes = np.fmax(np.abs(at(low)), np.abs(at(high))).max(axis=0)
        unit = np.where(sizes > 0.0, sizes, 1.0)
        below, above = at(low), at(high)
        first = np.zeros(len(low))
        for _ in range(_HALVINGS):
            middle = 0.5 * low + 0.5 * high
            between = at(middle)
            halves = np.abs(between - below).max(axis=1), np.abs(above - between).max(axis=1)
            first = np.maximum(first, np.maximum(*halves))
            left = (halves[0] >= halves[1])[:, None]
            low, high = np.where(left, low, middle), np.where(left, middle, high)
            below, above = np.where(left, below, between), np.where(left, between, above)
        jumps = np.abs(above - below)
        size = jumps.max(axis=1)
        least = np.maximum(_LEFT * first, _LEAST * np.abs(below).max(axis=1))
    size = np.where(size > least, (jumps * unit)[np.arange(len(jumps)), jumps.argmax(axis=1)], 0.0)
    worst = int(size.argmax())
    return 0.5 * (low[worst] + high[worst]), float(size[worst])


def joint_jacobians(system: System, points: Array) -> Array:
    """The joint Jacobians at some states."""
    check_values(system, points)  # a step in the imaginary direction may not see NaN
    x, u = points[:, : system.n], points[:, system.n :]
    joint = np.concatenate(
        (
            evaluated("the Jacobian of f", system.f_jacobian, x, u),
            evaluated("the Jacobian of h", system.h_jacobian, x, u),
        ),
        axis=1,
    )
    broken = ~np.isfinite(joint).all(axis=(1, 2))
    if broken.any():
        raise ModelError(
            f"the Jacobians of f and h are not finite at {points[broken][0].tolist()}, within the "
            "region; expected functions with derivatives there. Take a smaller region."
        )
    return np.asarray(joint, np.float64)
