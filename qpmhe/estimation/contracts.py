"""Whether a user's own observer and losses return what the estimator takes, at a few points."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpmhe_solvers.values import shown

from .._checks import Array
from ..costs import Cost, Loss, RobustCost
from ..errors import InvalidInputError
from ..model.system import System
from ..observers import Observer, Sample

# Forms q at which a loss is tried, in squares of standard deviations.
_FORMS = np.array([0.0, 1e-6, 0.1, 1.0, 10.0, 1e4])


def check_observer(observer: Observer, system: System, state: Array, u: Array) -> None:
    """Check what a user's observer returns at a state, without and with a fitting error.

    Raises
    ------
    InvalidInputError
        If `Observer.correct` does not return a correction (n,) and a covariance (n, n) or None, or
        `Observer.filter` something else than such a pair or None, or the metric is no matrix.
    """
    name, n = type(observer).__name__, system.n
    if _is_ours(observer):
        return
    metric = observer.metric
    if metric is not None and np.shape(metric) != (n, n):
        raise InvalidInputError(
            f"{name}.metric is {shown(metric)}; expected a matrix ({n}, {n}) in which the error "
            "contracts, or None. Call an attribute of your own something else."
        )
    covariance = observer.initial_covariance()
    slopes: tuple[Array | None, Array | None] = (None, None)
    if observer.needs_jacobians:
        slopes = system.f_jacobian(state, u), system.h_jacobian(state, u)
    counts = np.zeros(len(observer.sensors), np.int64)
    for size in (0.0, 1e-3):
        v = np.full(system.p, size)
        for method in ("correct", "filter"):
            sample = Sample(
                system, u, *slopes,
                covariance=None if covariance is None else covariance.copy(),
                rejections=counts, next_rejections=counts.copy(),
            )
            try:
                with np.errstate(all="ignore"):
                    found = getattr(observer, method)(state.copy(), v.copy(), sample)
            except Exception:  # bad luck at this point: the step falls back there
                continue
            if not (found is None and method == "filter"):
                _check_pair(f"{name}.{method}", found, n, covariance is not None)


def _check_pair(name: str, found: Any, n: int, has_covariance: bool) -> None:
    """Raise unless something is a vector (n,) and a covariance (n, n) or None."""
    expected = (
        f"expected a pair: a vector ({n},) and "
        + (f"a covariance ({n}, {n})" if has_covariance else f"None, or a covariance ({n}, {n})")
    )
    if not isinstance(found, (tuple, list)) or len(found) != 2:
        raise InvalidInputError(f"{name} returned {shown(found)}; {expected}.")
    vector, covariance = found
    if np.shape(vector) != (n,):
        raise InvalidInputError(
            f"{name} returned a first value of shape {np.shape(vector)}; {expected}."
        )
    if np.shape(covariance) != (n, n) and (has_covariance or covariance is not None):
        raise InvalidInputError(
            f"{name} returned a second value of shape {np.shape(covariance)}; {expected}."
        )


def check_losses(cost: Cost) -> None:
    """Check values and slopes of the losses that a user has written.

    Raises
    ------
    InvalidInputError
        If a loss does not return one number for each of many forms q, is negative or not 0 at 0, or
        falls: rho must rise from rho(0) = 0, so that rho' >= 0.
    """
    if not isinstance(cost, RobustCost):
        return
    for part in ("prior", "disturbance", "noise"):
        loss: Loss = getattr(cost, f"{part}_loss")
        if _is_ours(loss):
            continue
        name = type(loss).__name__
        for method, what in (("_value", "rho(q)"), ("_slope", "rho'(q)")):
            try:
                with np.errstate(all="ignore"):
                    found = getattr(loss, method)(_FORMS.copy())
            except Exception as error:
                raise InvalidInputError(
                    f"{name}.{method} raised {type(error).__name__}: {error}, for the forms q = "
                    f"{_FORMS.tolist()}; expected {what} of each."
                ) from error
            if np.shape(found) != _FORMS.shape:
                raise InvalidInputError(
                    f"{name}.{method} returned shape {np.shape(found)} for forms q of shape "
                    f"{_FORMS.shape}; expected {what} of each."
                )
            values = np.asarray(found, np.float64)
            wrong = ~(values >= 0.0)
            if method == "_value" and not wrong[0]:
                wrong[0] = values[0] != 0.0
            if wrong.any():
                k = int(np.argmax(wrong))
                raise InvalidInputError(
                    f"{name}.{method}({_FORMS[k]:g}) is {values[k]:g}; expected {what} >= 0, and "
                    "rho(0) = 0: a loss rises from 0."
                )


def _is_ours(thing: object) -> bool:
    """Whether a class is of this package, and tested there."""
    return type(thing).__module__.partition(".")[0] == "qpmhe"
