"""Whether algebraic states have values over the prior, and those of one branch of solutions."""

from __future__ import annotations

import warnings
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import ModelWarning
from ..model.index import unsolved
from ..model.system import System
from .reach import prior_deviations, prior_points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Solutions that differ by more than this share of their magnitude are two.
_APART = 1e-5


def check_branches(
    system: System, cost: Cost, covariance: Array | None, state: Array, u: Array, level: int
) -> None:
    """Warn, at a level of the stack, where algebraic states have no value, or one of two.

    The solution at the initial state is followed to points of the prior, and compared with what
    Newton's method finds there from the guess, as the step does. Where neither has a solution,
    although the functions have values, a fold lies between. Where one has none, nothing is known.
    Arguments are those of `StepComparison`.
    """
    equations = system.origin.equations
    if equations is None:
        return
    other: tuple[Array, ...] | None = None
    missing = ""
    with suppress(Exception), np.errstate(all="ignore"):  # outside of the functions' domain
        x = prior_points(system, state, prior_deviations(cost, covariance))
        inputs, n = np.tile(u, (len(x), 1)), state.size
        w, solved = equations.solver.iterated(x, inputs)
        start = equations.solver.complete(state[None], u[None])[0]
        followed = equations.solver.followed(start, x, inputs)
        other = _another(start, w, solved, followed, n)
        lost = ~solved & ~np.isfinite(followed).all(axis=1)
        lost[lost] = np.isfinite(equations.joint.batch(w[lost], inputs[lost])).all(axis=1)
        if lost.any():
            k = int(np.argmax(lost))
            missing = unsolved(
                equations.joint, equations.slope, equations.guess, x[k], w[k], u)
    if missing:
        warnings.warn(
            f"within one standard deviation of the prior, {missing} Where estimates come to such "
            "states, the model fails and the step keeps the candidate: bound the states, or give a "
            "tighter prior.",
            ModelWarning,
            stacklevel=level + 1,
        )
    if other is None:
        return
    begun, at, found, beyond = (np.array2string(one, precision=4, separator=", ")
                                  for one in other)
    warnings.warn(
        f"algebraic_guess = {equations.guess.tolist()} leads to two branches of algebraic states: "
        f"to z = {found} at x = {at}, a point of the prior, where the solution at the initial "
        f"state, z = {begun}, becomes {beyond} as x moves there. Estimates may jump between "
        "them. Give a guess near the solution at the initial state, or a tighter prior, or bound "
        "the states.",
        ModelWarning,
        stacklevel=level + 1,
    )


def _another(
    start: Array, w: Array, solved: Mask, followed: Array, n: int
) -> tuple[Array, ...] | None:
    """The solution at the state, a point where another one is found, and both there."""
    found, other = np.where(solved[:, None], w[:, n:], np.nan), followed[:, n:]
    sizes = np.nanmax(np.abs(np.concatenate((found, other))), axis=0)
    apart = (np.abs(found - other) > _APART * sizes).any(axis=1)
    k = int(np.argmax(apart))
    return (start[n:], w[k, :n], found[k], other[k]) if apart[k] else None
