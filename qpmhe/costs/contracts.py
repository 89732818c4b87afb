"""What users' own losses and costs have to return, checked once at a few points."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, TypeVar

import numpy as np

from .._checks import Array
from .._linalg import inverse
from ..errors import ModelError
from .base import Cost
from .losses import Loss

Part = TypeVar("Part")

# Residuals in standard deviations: on both sides of usual thresholds, and outliers.
_RESIDUALS = np.array([1e-3, 0.5, 3.0, 100.0])


def spare(part: Part) -> Part:
    """A copy to try, as a part may note what it is asked; the part itself if it has no copy."""
    try:
        return deepcopy(part)
    except Exception:
        return part


def numbers_of(method: str, value: object, shape: tuple[int, ...]) -> Array:
    """What a user's method returned, as numbers of the expected shape."""
    try:
        found = np.asarray(value)
        kind = found.dtype.kind
    except Exception:
        found, kind = np.empty(()), "O"
    if kind not in "fiub":
        raise ModelError(
            f"{method} returned {type(value).__name__} without real numbers; expected an array of "
            f"shape {shape}."
        )
    if found.shape != shape:
        raise ModelError(f"{method} returned shape {found.shape}; expected {shape}.")
    return np.asarray(found, np.float64)


def check_loss(loss: Loss) -> None:
    """Check shapes and signs of a loss and its slope; raise a `ModelError` that names the method.

    The loss is at least zero, and increases: its slope is nowhere below zero.
    """
    loss = spare(loss)
    size, count = loss.dimension, _RESIDUALS.size
    deviations = np.sqrt(inverse(loss.weight).diagonal())
    residuals = _RESIDUALS[:, None] * deviations
    shape = (count, size) if loss.per_component else (count,)
    forms = np.repeat(_RESIDUALS**2, size).reshape(count, size)
    q = forms if loss.per_component else forms[:, 0]
    form = loss.c_form
    if form is not None and form.kind == "own":  # with its own `cost` it may need neither
        for method in ("value", "slope"):
            _not_negative(loss, method, _called(loss, method, q), shape)
    _not_negative(loss, "cost", _called(loss, "cost", residuals, loss.weight), (count,))
    found = _called(loss, "majorise", residuals, loss.weight)
    numbers_of(f"{type(loss).__name__}.majorise", found, (count, size, size))


def check_own_cost(cost: Cost, prior: Array) -> None:
    """Check shapes and signs of a cost's terms; raise a `ModelError` that names the method.

    Parameters
    ----------
    cost : Cost
        The cost.
    prior : (n, n) array
        The weight of the initial error.
    """
    name, cost = type(cost).__name__, spare(cost)
    weight, count = cost.stage_weight, _RESIDUALS.size
    residuals, offset = (
        _RESIDUALS[:, None] * np.sqrt(inverse(matrix).diagonal()) for matrix in (weight, prior)
    )
    _not_negative(cost, "stage_costs", _called(cost, "stage_costs", residuals, weight), (count,))
    forms = _called(cost, "majorise", residuals, weight)
    shape = weight.shape if np.ndim(forms) == 2 else (count, *weight.shape)
    numbers_of(f"{name}.majorise", forms, shape)
    _not_negative(cost, "prior_cost", _called(cost, "prior_cost", offset[1], prior), ())
    forms = _called(cost, "majorise_prior", offset[1], prior)
    numbers_of(f"{name}.majorise_prior", forms, prior.shape)


def _called(part: object, method: str, *arguments: Array) -> Any:
    """What a method returns for copies of its arguments."""
    try:
        with np.errstate(all="ignore"):
            return getattr(part, method)(*(argument.copy() for argument in arguments))
    except Exception as error:
        raise ModelError(
            f"{type(part).__name__}.{method} raised {type(error).__name__}: {error}"
        ) from error


def _not_negative(part: object, method: str, value: object, shape: tuple[int, ...]) -> None:
    name = f"{type(part).__name__}.{method}"
    found = numbers_of(name, value, shape)
    if not (found >= 0.0).all():
        raise ModelError(
            f"{name} returned {found.ravel().min():g} for residuals of {_RESIDUALS.tolist()} "
            "standard deviations; expected numbers that are at least 0."
        )
