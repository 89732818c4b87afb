"""The cheapest discretisation of a model that is accurate enough at some points."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from .discretize import Discretization
from .points import Magnitude, Points, points
from .sets import ConvexSet

Array = NDArray[np.float64]
# Makes, of a discretisation, a function of step lengths (K,), states (K, n) and inputs (K, m).
Stepper = Callable[[Discretization], Callable[[Array, Array, Array], Array]]

#: What `method="auto"` tries: numbers of substeps of each method.
TRIED = {"rk4": (1, 2, 4, 8, 16, 32), "radau": (1, 2, 4, 8, 16)}
#: The largest error that it allows, as a share of the states.
TOLERANCE = 1e-6
# Work of a substep in those of rk4.
_WORK = {"rk4": 1, "radau": 4}
# What all are compared with, and how well twice as many substeps must agree with it.
_REFERENCE, _AGREES = Discretization("radau", 32), 0.1
# Points are of these magnitudes, or within the bounds of X.
_MAGNITUDES = tuple(Magnitude(*one) for one in ((1.0, 0.2), (0.3, 0.2), (1.0, -1.0), (1.0, 0.2)))


class Choice(NamedTuple):
    """A discretisation, and the error of each that was tried.

    Attributes
    ----------
    how : Discretization
        The cheapest one that is accurate enough.
    tolerance : float
        The largest error, as a share of the states.
    errors : dict
        The largest error of each method and number of substeps; infinity where it fails.
    """

    how: Discretization
    tolerance: float
    errors: dict[Discretization, float]

    def __str__(self) -> str:
        lines = [
            f"step: {self.how.words}, the cheapest with an error up to {self.tolerance:g} of "
            "the states, of"
        ]
        for one, error in self.errors.items():
            text = f"{error:.1e}" if error < 1.0 else "above 1"
            lines.append(
                f"  {one.method:<6} {one.steps:>3}   error {text:<8} "
                f"work {_WORK[one.method] * one.steps}"
            )
        return "\n".join(lines)


def choice(
    stepper: Stepper, methods: tuple[str, ...], dt: float, n: int, m: int,
    states: ConvexSet | None, scales: Array | None, tolerance: float,
) -> Choice:
    """Compare discretisations with a fine one, and choose the cheapest that will do.

    Parameters
    ----------
    stepper : callable
        Makes the step of a discretisation.
    methods : tuple of str
        Those of `TRIED` that the model has.
    dt : float
        Sampling time.
    n, m : int
        Numbers of states and inputs.
    states : ConvexSet or None
        X, within whose bounds the points are.
    scales : (n,) array or None
        Typical magnitudes of the states.
    tolerance : float
        The largest error, as a share of each state or its scale.

    Raises
    ------
    ModelError
        If no point has a step, or no discretisation is accurate enough.
    """
    where = points(_MAGNITUDES, n, m, states, 1.0 if scales is None else scales)
    with np.errstate(all="ignore"):
        exact, finer = (
            _stepped(stepper(one), dt, where)
            for one in (_REFERENCE, _REFERENCE._replace(steps=2 * _REFERENCE.steps))
        )
        x = np.array([one for one, _ in where])
        sizes = np.maximum(np.abs(x), np.abs(exact))
        if scales is not None:
            sizes = np.maximum(sizes, scales)
        sizes[sizes == 0.0] = 1.0
        known = (np.abs(exact - finer) <= _AGREES * tolerance * sizes).all(axis=1)
        if not known.any():
            raise ModelError(
                "method='auto' finds no step that it could compare others with: at none of the "
                f"states {x.tolist()} do {_REFERENCE.steps} substeps of radau in dt = {dt:g} and "
                "twice as many agree. Give scales or bounded states, so that they are where the "
                "system works, or choose method and steps yourself."
            )
        errors = {}
        for method in methods:
            for steps in TRIED[method]:
                one = Discretization(method, steps)
                error = (np.abs(_stepped(stepper(one), dt, where) - exact) / sizes)[known]
                errors[one] = float(np.where(np.isfinite(error), error, np.inf).max())
    good = [one for one, error in errors.items() if error <= tolerance]
    if not good:
        best = min(errors, key=lambda one: errors[one])
        raise ModelError(
            f"no discretisation that method='auto' tries has an error of at most {tolerance:g} of "
            f"the states in dt = {dt:g}; the least one is {errors[best]:.1e}, of {best.words}. "
            "Take a larger tolerance or a shorter dt, or choose method and steps yourself."
        )
    cheapest = min(good, key=lambda one: (_WORK[one.method] * one.steps, errors[one]))
    return Choice(cheapest, tolerance, errors)


def _stepped(step: Callable[[Array, Array, Array], Array], dt: float, where: Points) -> Array:
    """The next states at all points; NaN where the functions raise."""
    x, u = (np.array(one) for one in zip(*where, strict=True))
    with suppress(Exception):
        return step(np.full(len(x), dt), x, u)
    found = np.full(x.shape, np.nan)
    for k in range(len(x)):
        try:
            found[k] = step(np.array([dt]), x[k : k + 1], u[k : k + 1])[0]
        except Exception:  # outside of the functions' domain
            continue
    return found

