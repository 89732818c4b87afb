"""Where a function seems to jump, so that no derivative speaks for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..functions import BatchedFunction
from ..system import System
from .errors import JumpError

if TYPE_CHECKING:
    from .search import Search

__all__ = ["jump_about", "jump_between", "jumping"]

Array = NDArray[np.float64]

# Beyond the steps of derivatives by differences.
_REACH = 1e-4
_STATES, _PAIRS, _SEED = 8, 400, 20210829
# A function with derivatives changes on 2^-40 of an interval by about that share.
_HALVINGS, _LEFT, _LEAST = 40, 1e-3, 1e-9


def jumping(search: Search, *, everywhere: bool = False) -> JumpError | None:
    """What to tell of a search next to whose states there is a jump; None if there is none.

    Parameters
    ----------
    search : Search
        The search; the states with the steepest Jacobians are looked at.
    everywhere : bool
        Whether to look between all its states as well.
    """
    steepness = np.abs(search.jacobians).max(axis=(1, 2))
    steepest = search.points[np.argsort(-steepness)[:_STATES]]
    told = next((told for point in steepest if (told := jump_about(search.system, point))), "")
    if everywhere:
        told = told or jump_between(search.system, search.points)
    if not told:
        return None
    return JumpError(
        f"{told}; certificates need functions with derivatives",
        ("a model without the jump", "a region without it"),
    )


def jump_about(system: System, point: Array) -> str:
    """Which of f and h seems to jump next to a state, in words; empty if none does.

    Parameters
    ----------
    system : System
        The system.
    point : (n + m,) array
        State and input.
    """
    n = system.n
    moves = _REACH * np.maximum(1.0, np.abs(point[:n]))[:, None] * np.eye(n, point.size)
    return _told(system, point - moves, point + moves)


def jump_between(system: System, points: Array) -> str:
    """Which of f and h seems to jump between some states, in words; empty if none does.

    Parameters
    ----------
    system : System
        The system.
    points : (K, n + m) array
        States and inputs of a convex set.
    """
    rng = np.random.default_rng(_SEED)
    first, second = rng.integers(len(points), size=(2, _PAIRS))
    ends = points[first].copy(), points[second].copy()
    ends[1][:, system.n :] = ends[0][:, system.n :]
    return _told(system, *ends)


def _told(system: System, low: Array, high: Array) -> str:
    for name, function in (("f", system.f), ("h", system.h)):
        try:
            where, size = _traced(function, low, high, system.n)
        except Exception:  # a user's function may raise outside of the region
            continue
        worst = int(size.argmax())
        if size[worst] > 0.0:
            return (
                f"{name} seems to jump, by {size[worst]:.3g} at "
                f"{np.round(where[worst], 6).tolist()}"
            )
    return ""


def _traced(function: BatchedFunction, low: Array, high: Array, n: int) -> tuple[Array, Array]:
    """Where the largest change on each segment is, and its size if it is a jump, else 0.

    The change is traced to ever smaller parts of the segment: that of a function with
    derivatives vanishes, that of a jump stays.
    """

    def at(points: Array) -> Array:
        return np.array(function.batch(points[:, :n], points[:, n:]), np.float64)

    with np.errstate(all="ignore"):
        below, above = at(low), at(high)
        first = np.zeros(len(low))
        for _ in range(_HALVINGS):
            middle = 0.5 * low + 0.5 * high
            between = at(middle)
            halves = np.abs(between - below).max(axis=1), np.abs(above - between).max(axis=1)
            first = np.maximum(first, np.maximum(*halves))
            left = (halves[0] >= halves[1])[:, None]
            low, high = np.where(left, low, middle), np.where(left, middle, high)
            below, above = np.where(left, below, between), np.where(left, between, above)
        size = np.abs(above - below).max(axis=1)
        least = np.maximum(_LEFT * first, _LEAST * (1.0 + np.abs(below).max(axis=1)))
    return 0.5 * (low + high), np.where(size > least, size, 0.0)
