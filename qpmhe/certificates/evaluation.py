"""A model's functions at many states at once: values, Jacobians and failures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from ..errors import ModelError
from ..model.system import System

_REMEDY = "Take a smaller region, or make the model defined on all of it."


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
