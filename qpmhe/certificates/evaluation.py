"""A model's functions on many states at once; where they fail is told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from ..system import System

__all__ = ["evaluated", "insist_on_values"]

Array = NDArray[np.float64]

_REMEDY = "Take a smaller region, or make the model defined on all of it."


class _Batched(Protocol):
    @property
    def batch(self) -> Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]: ...


def evaluated(name: str, function: _Batched, x: Array, u: Array) -> Array:
    """A function's values; the state is named where it raises.

    Parameters
    ----------
    name : str
        What error texts call it.
    function : object with a method ``batch``
        f, h, or a Jacobian of theirs.
    x, u : (K, n) and (K, m) array
        States and inputs.

    Raises
    ------
    ModelError
        If the function raises.
    """
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
    told = f"x = {x.tolist()}"
    return told + (f", u = {u.tolist()}" if u.size else "")


def insist_on_values(system: System, points: Array, *, output_only: bool = False) -> None:
    """Insist that f and h neither raise nor return what is not finite.

    Parameters
    ----------
    system : System
        The system.
    points : (K, n + m) array
        States and inputs.
    output_only : bool
        Whether to look at h alone.

    Raises
    ------
    ModelError
        If they do; it names the state.
    """
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
