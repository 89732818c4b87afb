"""Whether algebraic equations determine the algebraic states: index 1, index 2 and folds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from .functions import BatchedFunction
from .points import Points
from .sets import equilibrated

Array = NDArray[np.float64]
Slope = Callable[[Array, Array], Array]

# A scaled Jacobian is singular where its smallest singular value is below this share of the
# largest: derivatives by differences are known to about 1e-10.
_SINGULAR = 1e-7


def check_index(slope: Slope, n: int, guess: Array, probes: Points) -> None:
    """Raise a `ModelError` where dg/dz is singular at all probes, or at the guess.

    Parameters
    ----------
    slope : callable
        The derivative by w = (x, z), over (K, n + k) and inputs (K, m), of the rate with the
        algebraic residuals below it.
    n : int
        Number of states x.
    guess : (k,) array
        The guess of z.
    probes : list of (w, u)
        Points with z at and around the guess.
    """
    around = _jacobians(slope, n, probes)
    if not around:  # outside of its domain; the estimator checks at the initial state
        return
    at_guess = _jacobians(slope, n, [(np.append(w[:n], guess), u) for w, u in probes])
    if not all(_is_singular(one) for one in (*around, *at_guess)):
        if at_guess and all(_is_singular(one) for one in at_guess):
            j, _ = _dependent(at_guess[0])
            raise ModelError(
                f"the Jacobian dg/dz of the algebraic equations is singular at algebraic_guess = "
                f"{guess.tolist()}, but not beside it: equation {j} does not determine z there, "
                "two solutions may meet (a fold). Give a guess on the side of the solution that "
                "the system takes."
            )
        return
    pattern = np.any([one != 0.0 for one in (*around, *at_guess)], axis=0)
    unmatched = _unmatched(pattern)
    remedy = (
        "The model has index 2 or higher. Differentiate such equations with respect to time until "
        "each determines an algebraic state (index reduction), or remove redundant ones."
    )
    if unmatched:
        without = [j for j in unmatched if not pattern[j].any()]
        text = (
            f"algebraic equation {without[0]} depends on no algebraic state" if without else
            f"algebraic equation {unmatched[0]} depends on algebraic states "
            f"{np.flatnonzero(pattern[unmatched[0]]).tolist()} alone, which other equations "
            "determine already"
        )
        raise ModelError(f"{text}: the Jacobian dg/dz is structurally singular. {remedy}")
    j, others = _dependent(around[0])
    raise ModelError(
        f"the Jacobian dg/dz of the algebraic equations is singular at all points that were tried: "
        f"equation {j} depends on z as a combination of equations {others} does. {remedy}"
    )


def unsolved(
    joint: BatchedFunction, slope: Slope, guess: Array, x: Array, w: Array, u: Array
) -> str:
    """Why the algebraic equations were not solved at x, as text.

    Parameters
    ----------
    joint : BatchedFunction
        The rate with the algebraic residuals below it.
    slope, guess
        As for `check_index`.
    x, u : array
        State (n,) and input (m,).
    w : (n + k,) array
        The last iterate.
    """
    n, start = x.size, f"from algebraic_guess = {guess.tolist()}"
    at = f"at x = {x.tolist()}" + (f", u = {u.tolist()}" if u.size else "")
    with np.errstate(all="ignore"):
        residual = np.asarray(joint.batch(w[None], u[None]))[0, n:]
        found = _jacobians(slope, n, [(w, u)])
    if not np.isfinite(residual).all() or not found:
        j = int(np.argmin(np.isfinite(residual)))
        return (
            f"the algebraic equations have no finite value {at} {start}: equation {j} is "
            f"{residual[j]} at z = {w[n:].tolist()}. Give another guess or initial state, or bound "
            "the states."
        )
    terms = np.abs(found[0]) @ np.maximum(np.abs(w[n:]), np.abs(guess))
    share = np.where(residual == 0.0, 0.0, np.abs(residual) / np.where(terms == 0.0, 1.0, terms))
    j = int(np.argmax(share))
    reason = (
        ", where the Jacobian dg/dz is singular (a fold: no solution may exist beyond it)"
        if _is_singular(found[0]) else ""
    )
    return (
        f"the algebraic equations have no solution {at} that Newton's method finds {start}: it "
        f"stops at z = {w[n:].tolist()}{reason}, where equation {j} has the largest residual, "
        f"{residual[j]:.3g}. Give a guess nearer to a consistent z, or another initial state."
    )


def _jacobians(slope: Slope, n: int, where: Points) -> list[Array]:
    """The Jacobians dg/dz (k, k) at points, without those that have none."""
    found = []
    for w, u in where:
        try:
            with np.errstate(all="ignore"):
                one = np.asarray(slope(w[None], u[None]))[0, n:, n:]
        except Exception:  # outside of the domain of a user's function
            continue
        if np.isfinite(one).all():
            found.append(one)
    return found


def _scaled(matrix: Array) -> Array:
    rows, columns = equilibrated(matrix)
    found: Array = rows[:, None] * matrix * columns
    return found


def _is_singular(matrix: Array) -> bool:
    if not (np.abs(matrix).max(axis=0) * np.abs(matrix).max(axis=1)).all():
        return True
    values = np.linalg.svd(_scaled(matrix), compute_uv=False)
    return bool(values[-1] <= _SINGULAR * values[0])


def _dependent(matrix: Array) -> tuple[int, list[int]]:
    """An equation that depends on others, and on which."""
    weights = np.abs(np.linalg.svd(_scaled(matrix))[0][:, -1])
    j = int(np.argmax(weights))
    others = np.flatnonzero(weights > 1e-3 * weights[j])
    return j, [int(i) for i in others if i != j]


def _unmatched(pattern: NDArray[np.bool_]) -> list[int]:
    """Equations to which no matching gives an unknown of their own."""
    owner = np.full(pattern.shape[1], -1)

    def place(j: int, seen: set[int]) -> bool:
        for column in np.flatnonzero(pattern[j]).tolist():
            if column not in seen:
                seen.add(column)
                if owner[column] < 0 or place(int(owner[column]), seen):
                    owner[column] = j
                    return True
        return False

    return [j for j in range(len(pattern)) if not place(j, set())]
