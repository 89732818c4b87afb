"""Checks of what certificates are asked about."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from .._checks import count
from ..costs import Cost
from ..errors import InvalidInputError, ModelError, OptionError, ShapeError
from ..observers import Observer
from ..system import System

__all__ = ["checked_horizons", "checked_ingredients", "checked_length", "checked_system"]


def checked_system(system: Any) -> System:
    """Insist on a system.

    Parameters
    ----------
    system : System
        The system.

    Raises
    ------
    ModelError
        If it is something else.
    """
    if not isinstance(system, System):
        raise ModelError(f"system is {system!r}; expected a qpmhe.System.")
    return system


def checked_ingredients(system: Any, observer: Any, cost: Any) -> None:
    """Insist on a system, an observer and a cost that go together.

    Parameters
    ----------
    system, observer, cost
        What an estimator is made of.

    Raises
    ------
    ModelError, InvalidInputError, ShapeError
        If one is something else, or of other dimensions.
    """
    checked_system(system)
    if not isinstance(observer, Observer):
        raise InvalidInputError(
            f"observer is {observer!r}; expected an observer, such as qpmhe.Luenberger(gain)."
        )
    if not isinstance(cost, Cost):
        raise InvalidInputError(
            f"cost is {cost!r}; expected a cost, such as qpmhe.QuadraticCost(prior=..., "
            "disturbance=..., noise=...)."
        )
    if (cost.n, cost.p) != (system.n, system.p):
        raise ShapeError(
            f"the cost is for {cost.n} states and {cost.p} outputs; expected {system.n} and "
            f"{system.p}, those of the system. Give its weights these sizes."
        )


def checked_horizons(horizon: Any) -> list[int]:
    """Insist on one horizon or several; sorted, each once.

    Parameters
    ----------
    horizon : int or sequence of int
        N, or several of them.

    Raises
    ------
    OptionError
        If one is no integer of at least 1.
    """
    given = list(horizon) if isinstance(horizon, Iterable) else [horizon]
    if isinstance(horizon, str) or not given:
        raise OptionError(f"horizon is {horizon!r}; expected an integer >= 1, or several of them.")
    return sorted({count("horizon", each, 1) for each in given})


def checked_length(name: str, value: Any) -> float:
    """Insist on a finite number that is no less than zero.

    Parameters
    ----------
    name : str
        What error texts call it.
    value : float
        A bound on a Euclidean length.

    Raises
    ------
    OptionError
        If it is something else.
    """
    kinds = (int, float, np.integer, np.floating)
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, kinds) or not 0.0 <= value < math.inf:
        raise OptionError(
            f"{name} is {value!r}; expected a finite number >= 0, which bounds a Euclidean length."
        )
    return float(value)
