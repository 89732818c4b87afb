"""How accurate discretisations of a model are at some points, and the cheapest that will do."""

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
_WORK = {"euler": 0.25, "rk4": 1.0, "midpoint": 2.0, "radau": 4.0}
# What all are compared with, and how well twice as many substeps must agree with it.
_REFERENCE, _AGREES = Discretization("radau", 32), 0.1
# Numbers of substeps that `table` tries, how well the last must agree, and the most states of
# implicit steps.
_DOUBLED, _ROUGHLY, MOST_SOLVED = (1, 2, 4, 8, 16, 32, 64), 1e-3, 50
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

    @property
    def words(self) -> str:
        """What was chosen, in front of a table."""
        return (
            f"{self.how.words}, the cheapest with an error up to {self.tolerance:g} of the states, "
            "of"
        )


def work(how: Discretization) -> float:
    """What a step in C costs, in substeps of rk4."""
    return _WORK[how.method] * how.steps


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
        sizes = _sizes(x, exact, scales)
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
                found = _stepped(stepper(one), dt, where)
                errors[one] = _largest(((found - exact) / sizes)[known])
    good = [one for one, error in errors.items() if error <= tolerance]
    if not good:
        best = min(errors, key=lambda one: errors[one])
        raise ModelError(
            f"no discretisation that method='auto' tries has an error of at most {tolerance:g} of "
            f"the states in dt = {dt:g}; the least one is {errors[best]:.1e}, of {best.words}. "
            "Take a larger tolerance or a shorter dt, or choose method and steps yourself."
        )
    cheapest = min(good, key=lambda one: (work(one), errors[one]))
    return Choice(cheapest, tolerance, errors)


def table(
    stepper: Stepper, own: Discretization, dt: float, n: int, m: int, states: ConvexSet | None,
    scales: Array | None, methods: tuple[str, ...],
) -> dict[Discretization, float]:
    """The errors of a discretisation and of others, as shares of the states, by what they are.

    The others are finer and finer until one is accurate to `TOLERANCE`. What they are compared with
    are substeps of radau, or for a large model of its own method, where twice as many agree; what
    these still differ by is part of the errors. Empty where none agree.

    Parameters
    ----------
    own : Discretization
        The model's own.
    methods : tuple of str
        Of the others, beside its own.
    stepper, dt, n, m, states, scales
        As for `choice`.
    """
    fine = "radau" if n <= MOST_SOLVED else own.method
    where = points(_MAGNITUDES, n, m, states, 1.0 if scales is None else scales)
    x, values = np.array([one for one, _ in where]), {}
    errors: dict[Discretization, float] = {}
    with np.errstate(all="ignore"):
        exact = np.full(x.shape, np.nan)
        for finest in _DOUBLED:
            before, exact = exact, _stepped(stepper(Discretization(fine, finest)), dt, where)
            values[Discretization(fine, finest)] = exact
            sizes = _sizes(x, exact, scales)
            gaps = (np.abs(exact - before) / sizes).max(axis=1)
            known, there = gaps <= _AGREES * TOLERANCE, np.isfinite(exact).all(axis=1)
            # No step is its own reference.
            if finest > own.steps * (fine == own.method) and known.any() and (known | ~there).all():
                break
        least = 0.0
        if not known.any():
            known = gaps <= _ROUGHLY
            if not known.any():
                return {}
            least = gaps[known].max()

        def add(one: Discretization) -> float:
            if one not in values:
                values[one] = _stepped(stepper(one), dt, where)
            errors[one] = least + _largest(((values[one] - exact) / sizes)[known])
            return errors[one]

        for method in dict.fromkeys((own.method, *methods)):
            for steps in _DOUBLED:
                if method == fine and steps == finest:
                    break
                accurate = add(Discretization(method, steps)) <= TOLERANCE
                if method == own.method and steps < own.steps < (np.inf if accurate else 2 * steps):
                    add(own)
                if accurate:
                    break
        if own not in errors:
            add(own)
    return errors


def _sizes(x: Array, exact: Array, scales: Array | None) -> Array:
    """What errors are shares of: the larger one of the states and their scales."""
    sizes = np.maximum(np.abs(x), np.abs(exact))
    if scales is not None:
        sizes = np.maximum(sizes, scales)
    sizes[sizes == 0.0] = 1.0
    return sizes


def _largest(shares: Array) -> float:
    """The largest of some; infinity where one is no number."""
    return float(np.where(np.isfinite(shares), np.abs(shares), np.inf).max())


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

