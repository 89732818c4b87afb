"""The bounded sets of states over which a property is certified."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import Array, numbers
from ..errors import SetError
from ..model.residuals import Angles
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system
from .evidence import CertificateError

_MOST_CORNERS, _DIRECTIONS = 256, 32  # among samples; in which vertices are sought


@dataclass(frozen=True, eq=False)
class Region:
    """A bounded convex set of states, and the inputs that may act there.

    ``lower`` and ``upper``, (n + m,), are the sides of a box around states and inputs. It holds
    them all: for a polytope, they are proved by duality and rounded outward.
    """

    states: ConvexSet
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
        """The largest distance between two of its states, or a little more."""
        return float(np.linalg.norm((self.upper - self.lower)[: self.n]))

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which of the states (..., n) lie in the region."""
        x = numbers("points", points, finite=False)
        inside = np.all((x >= self.states.lower) & (x <= self.states.upper), axis=-1)
        if not self.is_box:
            rows = x @ self.states.matrix.T
            inside &= np.all(
                (rows >= self.states.row_lower) & (rows <= self.states.row_upper), axis=-1
            )
        return np.asarray(inside)

    def outside(self, lower: Array, upper: Array) -> NDArray[np.bool_]:
        """Which cells, given by corners (B, n + m), certainly have no state of the region."""
        if self.is_box:
            return np.zeros(len(lower), np.bool_)
        least, most = row_bounds(self.states.matrix, lower[:, : self.n], upper[:, : self.n])
        away: NDArray[np.bool_] = np.any(
            (least > self.states.row_upper) | (most < self.states.row_lower), axis=1
        )
        return away

    def sample(self, count: int, generator: np.random.Generator) -> Array:
        """About so many points (K, n + m), states and inputs: the middle, corners, random ones."""
        sides = [dict.fromkeys(each) for each in zip(self.lower, self.upper, strict=True)]
        corners = np.array(list(itertools.islice(itertools.product(*sides), _MOST_CORNERS)))
        inner = generator.uniform(self.lower, self.upper, (count, self.lower.size))
        points = np.vstack((0.5 * (self.lower + self.upper), corners, inner))
        if not self.is_box:  # its vertices, and the rest moved towards their middle
            n, (G, g) = self.n, inequalities(self.states)
            others = np.random.default_rng(0).standard_normal((_DIRECTIONS, n))
            vertices = np.array([support(G, g, e)[0] for e in (*np.eye(n), *-np.eye(n), *others)])
            middle = vertices.mean(axis=0)
            points[1 : len(vertices) + 1, :n] = vertices[: len(points) - 1]
            away = points[:, :n] - middle
            with np.errstate(all="ignore"):
                room = (g - G @ middle) / (away @ G.T)
            share = np.where(room > 0.0, room, np.inf).min(axis=1, initial=1.0)
            points[:, :n] = middle + (1.0 - 1e-9) * share[:, None] * away
            points[0, :n] = middle
        return points


def bounded_region(
    system: System, region: ConvexSet | Region | None, inputs: Box | None = None
) -> Region:
    """Check a set of states, and put a box around it."""
    checked_system(system)
    for name in ("output_residual", "state_residual"):
        residual = getattr(system, name)
        if residual is not None and not isinstance(residual, Angles):
            raise CertificateError(
                f"the system has {name} = {shown(residual)}: certificates take plain differences "
                f"only, or angles. Leave {name} out, with outputs and states that do not wrap "
                "within the region."
            )
    where = region if isinstance(region, Region) else _bounded(system, region, inputs)
    if where.n != system.n or where.lower.size != system.n + system.m:
        raise SetError(
            f"the region has {where.n} states and {where.lower.size - where.n} inputs; "
            f"expected {system.n} and {system.m}."
        )
    if where is region and inputs is not None:
        raise SetError("the region already has bounds on the inputs; leave inputs out.")
    if isinstance(system.state_residual, Angles):
        angles = system.state_residual
        width = (where.upper - where.lower)[angles.components]
        half = 0.5 * np.asarray(angles.periods)
        wide = width >= half
        if wide.any():
            names = ", ".join(f"x[{j}]" for j in angles.components[wide])
            raise CertificateError(
                f"the region is {width[wide].tolist()} wide in the angle {names}, where "
                f"differences may wrap; expected less than half a period, {half[wide].tolist()}. "
                "Take a region that is narrower there."
            )
    return where


def _bounded(system: System, region: ConvexSet | None, inputs: Box | None) -> Region:
    """A set of states with a box around it."""
    chosen = system.states if region is None else region
    if chosen is None:
        raise SetError(
            "there is no region: the system has no state set; pass region=qpmhe.Box(lower, "
            "upper), the states on which to certify it."
        )
    if not isinstance(chosen, ConvexSet):
        raise SetError(f"region is {chosen!r}; expected a qpmhe.Box or a qpmhe.Polytope.")
    if chosen.dimension != system.n:
        raise SetError(f"region has dimension {chosen.dimension}; expected {system.n}.")
    if system.m and not (isinstance(inputs, Box) and inputs.dimension == system.m):
        raise SetError(
            f"inputs is {inputs!r}; expected a qpmhe.Box of dimension {system.m}: the system has "
            "inputs, and certificates hold only for inputs within bounds."
        )
    if not system.m and inputs is not None:
        raise SetError("inputs are bounded, but the system has none; leave inputs out.")
    lower, upper = bounds(chosen)
    if inputs is not None:
        lower, upper = np.append(lower, inputs.lower), np.append(upper, inputs.upper)
    free = ~(np.isfinite(lower) & np.isfinite(upper))
    if free.any():
        which = ", ".join(_name(j, system.n) for j in np.flatnonzero(free))
        raise SetError(
            f"the region is unbounded in {which}; expected a bounded set. Intersect it with the "
            "states that occur: region & qpmhe.Box(lower, upper)."
        )
    return Region(chosen, lower, upper)


def stated_region(region: Any) -> Region | None:
    """A set that the user states; bounded or not, and for all inputs if not a region."""
    if region is None or isinstance(region, Region):
        return region
    if not isinstance(region, ConvexSet):
        raise SetError(f"region is {region!r}; expected a qpmhe.Box or a qpmhe.Polytope.")
    return Region(region, *bounds(region))


def bounds(states: ConvexSet) -> tuple[Array, Array]:
    """Outward bounds on the components of a set's members; infinite where there are none."""
    if states.matrix.shape[0] == 0:
        return states.lower, states.upper
    n = states.dimension
    G, g = inequalities(states)
    found = [support(G, g, e)[1:] for e in (*-np.eye(n), *np.eye(n))]
    sides, residuals = np.moveaxis(np.reshape(found, (2, n, 2)), -1, 0)
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


def inequalities(states: ConvexSet) -> tuple[Array, Array]:
    """All inequalities of a set, as G x <= g."""
    eye = np.eye(states.dimension)
    G = np.vstack((eye, -eye, states.matrix, -states.matrix))
    g = np.concatenate((states.upper, -states.lower, states.row_upper, -states.row_lower))
    finite = np.isfinite(g)
    return G[finite], g[finite]


def row_bounds(rows: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Outward bounds on linear forms over boxes; exact where a form is a coordinate."""
    positive, negative = np.maximum(rows, 0.0).T, np.minimum(rows, 0.0).T
    single = (np.count_nonzero(rows, axis=1) == 1) & (np.abs(rows).sum(axis=1) == 1.0)
    terms = np.where(single, 0.0, 4.0 * (rows.shape[1] + 2))
    size = np.maximum(np.abs(low), np.abs(high)) @ np.abs(rows).T
    rounding = terms * np.finfo(np.float64).eps * size
    return low @ positive + high @ negative - rounding, high @ positive + low @ negative + rounding


def support(G: Array, g: Array, e: Array) -> tuple[Array, float, float]:
    """A vertex that maximises e^T x over G x <= g, y^T g, and a bound on |G^T y - e|_1.

    The multipliers y >= 0 are the maximum's; y^T g is infinite where there is none.
    """
    from scipy.optimize import linprog

    answer = linprog(-e, A_ub=G, b_ub=g, bounds=(None, None), method="highs")
    if answer.x is None or answer.status != 0:
        return np.full(e.size, np.nan), np.inf, 0.0
    y = np.maximum(-np.asarray(answer.ineqlin.marginals, np.float64), 0.0)
    rounding = 4.0 * (y.size + 2) * np.finfo(np.float64).eps
    side = float(y @ g) + rounding * float(y @ np.abs(g))
    residual = float(np.abs(G.T @ y - e).sum()) + rounding * float(
        (np.abs(G).T @ y + np.abs(e)).sum()
    )
    return np.asarray(answer.x, np.float64), side, residual


def beyond(inner: Region, outer: Region) -> str:
    """Where a region reaches beyond another, in words; empty if it lies within it.

    An inequality must be one of the inner region's own, or hold on the box around it.
    """
    n, size = inner.n, outer.lower.size
    if outer.n != n:
        return f"it has {n} states instead of {outer.n}"
    own = {(*row, limit) for row, limit in zip(*inequalities(inner.states), strict=True)}
    eye = np.eye(size)[n:]
    rows, limits = inequalities(outer.states)
    rows = np.vstack((np.pad(rows, ((0, 0), (0, size - n))), eye, -eye))
    limits = np.concatenate((limits, outer.upper[n:], -outer.lower[n:]))
    most = row_bounds(rows, inner.lower[:size], inner.upper[:size])[1]
    for row, limit, value in zip(rows, limits, most, strict=True):
        if value > limit and (*row[:n], limit) not in own:
            terms = " + ".join(f"{row[j]:.6g} {_name(j, n)}" for j in np.flatnonzero(row))
            return f"{terms} <= {limit:.6g} is not shown to hold there: it may be {value:.6g}"
    return ""


def _name(j: Any, n: int) -> str:
    return f"x[{j}]" if j < n else f"u[{j - n}]"
