"""The bounded sets of states over which a property is certified."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import Array, numbers
from ..errors import SetError
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system

# Of a polytope's vertices and corners, as starting points of searches; more add little.
_MOST_CORNERS = 256


@dataclass(frozen=True, eq=False)
class Region:
    """A bounded convex set of states, and the inputs that may act meanwhile.

    Make one with `bounded_region`.

    Parameters
    ----------
    states : ConvexSet
    inputs : Box or None
        Bounds on the inputs u; None for a system without.
    lower, upper : (n + m,) array
        Corners of a box around states and inputs. It holds them all: for a polytope, its
        sides are proved by duality and rounded outward.
    """

    states: ConvexSet
    inputs: Box | None
    lower: Array
    upper: Array

    @property
    def n(self) -> int:
        """The number of states."""
        return self.states.dimension

    @property
    def is_box(self) -> bool:
        """Whether the states form a box, so that its corners are theirs."""
        return not self.states.matrix.size

    @property
    def diameter(self) -> float:
        """The largest distance of two of its states, or a little more."""
        return float(np.linalg.norm((self.upper - self.lower)[: self.n]))

    def to_dict(self) -> dict[str, Any]:
        """The box around the region and its diameter, in types that JSON knows."""
        return {
            "lower": self.lower.tolist(), "upper": self.upper.tolist(), "box": self.is_box,
            "diameter": self.diameter,
        }

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which of the states (..., n) lie in the region."""
        x = numbers("points", points, finite=False)
        inside = np.all((x >= self.states.lower) & (x <= self.states.upper), axis=-1)
        if not self.is_box:
            rows = x @ self.states.matrix.T
            inside &= np.all(
                (rows >= self.states.row_lower) & (rows <= self.states.row_upper), axis=-1
            )
        found: NDArray[np.bool_] = inside
        return found

    def outside(self, lower: Array, upper: Array) -> NDArray[np.bool_]:
        """Which cells, given by corners (B, n + m), certainly have no state of the region."""
        away = np.zeros(lower.shape[0], dtype=np.bool_)
        if self.is_box:
            return away
        low, high = lower[:, : self.n], upper[:, : self.n]
        rows = self.states.matrix
        positive, negative = np.maximum(rows, 0.0), np.minimum(rows, 0.0)
        least = low @ positive.T + high @ negative.T
        most = high @ positive.T + low @ negative.T
        size = np.maximum(np.abs(low), np.abs(high)) @ np.abs(rows).T
        rounding = 4.0 * (self.n + 2) * np.finfo(np.float64).eps * size
        above = least - rounding > self.states.row_upper
        away |= np.any(above | (most + rounding < self.states.row_lower), axis=1)
        return away

    def sample(self, count: int, generator: np.random.Generator) -> Array:
        """About so many points (K, n + m) of the region, at least one: states and inputs.

        The first is its middle; corners of its box that belong to it come next, then random ones.
        """
        sides = [
            (low,) if low == high else (low, high)
            for low, high in zip(self.lower, self.upper, strict=True)
        ]
        corners = np.array(list(itertools.islice(itertools.product(*sides), _MOST_CORNERS)))
        share = generator.random((4 * count, self.lower.size))
        inner = self.lower + share * (self.upper - self.lower)
        middle = (0.5 * (self.lower + self.upper))[None]
        if self.is_box:
            return np.vstack((middle, corners, inner[:count]))
        centre = np.append(_centre(self.states, self.lower, self.upper), middle[0, self.n :])
        points = np.vstack((middle, corners, inner))
        # Points outside are drawn towards one inside until they reach the boundary.
        points = centre + _shares(self.states, centre, points) * (points - centre)
        points = points[self.contains(points[:, : self.n])]
        return np.vstack((centre, points[: len(corners) + count]))


def bounded_region(
    system: System, region: ConvexSet | Region | None, inputs: Box | None = None
) -> Region:
    """Check a set of states, and put a box around it."""
    checked_system(system)
    if isinstance(region, Region):
        if region.n != system.n or region.lower.size != system.n + system.m:
            raise SetError(
                f"the region is of {region.n} states and {region.lower.size - region.n} inputs; "
                f"expected {system.n} and {system.m}."
            )
        if inputs is not None and not (
            isinstance(inputs, Box)
            and np.array_equal(inputs.lower, region.lower[region.n :])
            and np.array_equal(inputs.upper, region.upper[region.n :])
        ):
            raise SetError(
                f"inputs is {inputs!r}, but the region that was passed already has bounds on "
                "the inputs; leave inputs out, or pass a qpmhe.Box of states with them."
            )
        return region
    chosen = system.states if region is None else region
    if chosen is None:
        raise SetError(
            "there is no region: the system has no state set; pass region=qpmhe.Box(lower, "
            "upper), the states for which the certificate is wanted."
        )
    if not isinstance(chosen, ConvexSet):
        raise SetError(f"region is {chosen!r}; expected a qpmhe.Box or a qpmhe.Polytope.")
    if chosen.dimension != system.n:
        raise SetError(f"region has dimension {chosen.dimension}; expected {system.n}.")
    if system.m and not (isinstance(inputs, Box) and inputs.dimension == system.m):
        raise SetError(
            f"inputs is {inputs!r}; expected a qpmhe.Box of dimension {system.m}: the system has "
            "inputs, and what is certified holds for those within bounds only."
        )
    if not system.m and inputs is not None:
        raise SetError("inputs are bounded, but the system has none; leave inputs out.")
    lower, upper = _bounds(chosen)
    if inputs is not None:
        lower, upper = np.append(lower, inputs.lower), np.append(upper, inputs.upper)
    free = ~(np.isfinite(lower) & np.isfinite(upper))
    if free.any():
        which = ", ".join(
            f"x[{j}]" if j < system.n else f"u[{j - system.n}]" for j in np.flatnonzero(free)
        )
        raise SetError(
            f"the region is unbounded in {which}; expected a bounded set. Intersect it with the "
            "states that occur: region & qpmhe.Box(lower, upper)."
        )
    return Region(chosen, inputs, lower, upper)


def stated_region(region: Any) -> Region | None:
    """A set that the user states; bounded or not, and for all inputs if not a region."""
    if region is None or isinstance(region, Region):
        return region
    if not isinstance(region, ConvexSet):
        raise SetError(f"region is {region!r}; expected a qpmhe.Box or a qpmhe.Polytope.")
    return Region(region, None, *_bounds(region))


def _bounds(states: ConvexSet) -> tuple[Array, Array]:
    """Outward bounds on the components of a set's members; infinite where there are none."""
    if states.matrix.shape[0] == 0:
        return states.lower, states.upper
    n = states.dimension
    G, g = _inequalities(states)
    eye = np.eye(n)
    sides, residuals = np.full((2, n), np.inf), np.zeros((2, n))
    for which, sign in enumerate((-1.0, 1.0)):
        for j in range(n):
            sides[which, j], residuals[which, j] = _dual_bound(G, g, sign * eye[j])
    if not np.isfinite(sides).all():
        return -sides[0], sides[1]
    # e^T x <= y^T g + |G^T y - e|_1 |x|_inf for every y >= 0: weak duality, with the
    # multipliers' error in it. Hence |x|_inf <= max(side) / (1 - max(residual)).
    worst = float(residuals.max())
    if not worst < 0.5:
        return np.full(n, -np.inf), np.full(n, np.inf)
    size = float(np.maximum(sides, 0.0).max()) / (1.0 - worst) * (1.0 + 1e-12)
    sides += residuals * size + 1e-15 * (size + np.abs(sides))
    return np.maximum(-sides[0], states.lower), np.minimum(sides[1], states.upper)


def _inequalities(states: ConvexSet) -> tuple[Array, Array]:
    """All inequalities of a set, as G x <= g."""
    eye = np.eye(states.dimension)
    G = np.vstack((eye, -eye, states.matrix, -states.matrix))
    g = np.concatenate((states.upper, -states.lower, states.row_upper, -states.row_lower))
    finite = np.isfinite(g)
    return G[finite], g[finite]


def _dual_bound(G: Array, g: Array, e: Array) -> tuple[float, float]:
    """y^T g and a bound on |G^T y - e|_1 for multipliers of max e^T x over G x <= g."""
    from scipy.optimize import linprog

    answer = linprog(g, A_eq=G.T, b_eq=e, bounds=(0.0, None), method="highs")
    if answer.x is None or answer.status != 0:
        return np.inf, 0.0
    y = np.maximum(np.asarray(answer.x, np.float64), 0.0)
    rounding = 4.0 * (y.size + 2) * np.finfo(np.float64).eps
    side = float(y @ g) + rounding * float(y @ np.abs(g))
    residual = float(np.abs(G.T @ y - e).sum()) + rounding * float(
        (np.abs(G).T @ y + np.abs(e)).sum()
    )
    return side, residual


def _centre(states: ConvexSet, lower: Array, upper: Array) -> Array:
    """A point inside, as far from the inequalities as can be (Chebyshev's)."""
    from scipy.optimize import linprog

    n = states.dimension
    rows = np.vstack((states.matrix, -states.matrix))
    side = np.append(states.row_upper, -states.row_lower)
    finite = np.isfinite(side)
    rows, side = rows[finite], side[finite]
    away = np.linalg.norm(rows, axis=1)
    answer = linprog(
        np.append(np.zeros(n), -1.0), A_ub=np.column_stack((rows, away)), b_ub=side,
        bounds=[*zip(lower[:n], upper[:n], strict=True), (0.0, None)], method="highs",
    )
    if answer.x is None:
        raise SetError(f"no point of {states!r} was found; is the set empty?")
    return np.asarray(answer.x, np.float64)[:n]


def _shares(states: ConvexSet, centre: Array, points: Array) -> Array:
    """How far from the centre to each point one may go, at most all the way: (K, 1)."""
    n = states.dimension
    rows = np.vstack((states.matrix, np.eye(n)))
    low = np.append(states.row_lower, states.lower)
    high = np.append(states.row_upper, states.upper)
    start = rows @ centre[:n]
    along = (points[:, :n] - centre[:n]) @ rows.T
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(
            along > 0, (high - start) / along, np.where(along < 0, (low - start) / along, np.inf)
        )
    limited: Array = np.clip(share.min(axis=1, keepdims=True), 0.0, 1.0) * (1.0 - 1e-12)
    return limited


def beyond(inner: Region, outer: Region) -> str:
    """Where a region reaches beyond another, in words; empty if it lies within it.

    Sides are compared as they are; a general inequality must be one of the inner region's own, or
    hold on the box around it.
    """
    n = inner.n
    if outer.n != n:
        return f"it has {n} states instead of {outer.n}"
    words = _sides("x", inner.lower[:n], inner.upper[:n], outer.states.lower, outer.states.upper)
    if outer.lower.size > n:
        words = words or _sides("u", inner.lower[n:], inner.upper[n:], outer.lower[n:],
                              outer.upper[n:])
    return words or _rows(inner, outer.states)


def _sides(letter: str, low: Array, high: Array, outer_low: Array, outer_high: Array) -> str:
    for j in range(low.size):
        if low[j] < outer_low[j] or high[j] > outer_high[j]:
            return (
                f"{letter}[{j}] in [{low[j]:.6g}, {high[j]:.6g}] is not within "
                f"[{outer_low[j]:.6g}, {outer_high[j]:.6g}]"
            )
    return ""


def _rows(inner: Region, outer: ConvexSet) -> str:
    own, sides = _inequalities(inner.states)
    low, high = inner.lower[: inner.n], inner.upper[: inner.n]
    size = np.maximum(np.abs(low), np.abs(high))
    rows = np.vstack((outer.matrix, -outer.matrix))
    limits = np.append(outer.row_upper, -outer.row_lower)
    for row, limit in zip(rows, limits, strict=True):
        if not np.isfinite(limit):
            continue
        same = (own == row).all(axis=1)
        if same.any() and sides[same].min() <= limit:
            continue
        rounding = 4.0 * (inner.n + 2) * np.finfo(np.float64).eps * float(np.abs(row) @ size)
        most = float(np.maximum(row * low, row * high).sum()) + rounding
        if not most <= limit:
            return (
                f"the inequality {np.round(row, 6).tolist()} x <= {limit:.6g} is not shown to hold "
                f"on it: the left-hand side may be {most:.6g}"
            )
    return ""
