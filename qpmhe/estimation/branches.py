"""Whether the guess of algebraic states leads to one branch of solutions over the prior."""

from __future__ import annotations

import warnings
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import ModelWarning
from ..model.algebraic import AlgebraicStates
from ..model.system import System
from .reach import prior_deviations, prior_points

Array = NDArray[np.float64]

# Solutions that differ by more than this share of their magnitude are two.
_APART = 1e-5


def check_branches(
    system: System, cost: Cost, covariance: Array | None, state: Array, u: Array, level: int
) -> None:
    """Warn, at a level of the stack, where algebraic states come to lie on another branch.

    The solution at the initial state is followed to points of the prior, and compared with what
    Newton's method finds there from the guess, as the step does. Where either has none, nothing is
    known. Arguments are those of `StepComparison`.
    """
    equations = system.origin.equations
    if equations is None:
        return
    other: tuple[Array, ...] | None = None
    with suppress(Exception), np.errstate(all="ignore"):  # outside of the functions' domain
        x = prior_points(system, state, prior_deviations(cost, covariance))
        other = _another(equations.solver, state, x, u)
    if other is None:
        return
    start, at, found, followed = (np.array2string(one, precision=4, separator=", ")
                                  for one in other)
    warnings.warn(
        f"algebraic_guess = {equations.guess.tolist()} leads to two branches of algebraic states: "
        f"to z = {found} at x = {at}, a point of the prior, where the solution at the initial "
        f"state, z = {start}, becomes {followed} as x moves there. Estimates may jump between "
        "them. Give a guess near the solution at the initial state, or a tighter prior, or bound "
        "the states.",
        ModelWarning,
        stacklevel=level + 1,
    )


def _another(
    solver: AlgebraicStates, state: Array, x: Array, u: Array
) -> tuple[Array, ...] | None:
    """The solution at the state, a point where another one is found, and both there."""
    inputs, n = np.tile(u, (len(x), 1)), state.size
    found = solver.complete(x, inputs)[:, n:]
    start = solver.complete(state[None], u[None])[0]
    followed = solver.followed(start, x, inputs)[:, n:]
    sizes = np.nanmax(np.abs(np.concatenate((found, followed))), axis=0)
    apart = (np.abs(found - followed) > _APART * sizes).any(axis=1)
    k = int(np.argmax(apart))
    return (start[n:], x[k], found[k], followed[k]) if apart[k] else None
