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

_MOST_CORNERS = 256  # among samples; more add little


@dataclass(frozen=True, eq=False)
class Region:
    """A box of states, and of the inputs that may act meanwhile; made by `bounded_region`.

    Parameters
    ----------
    lower, upper : (n + m,) array
        The sides, of states first. A polytope is taken by the box around it, whose sides are
        proved by duality and rounded outward.
    n : int
        The number of states.
    """

    lower: Array
    upper: Array
    n: int

    @property
    def diameter(self) -> float:
        """The largest distance of two of its states."""
        return float(np.linalg.norm((self.upper - self.lower)[: self.n]))

    def to_dict(self) -> dict[str, Any]:
        """The sides and the diameter, in types that JSON knows."""
        return {
            "lower": self.lower.tolist(), "upper": self.upper.tolist(), "diameter": self.diameter
        }

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which of the states (..., n) lie in the region."""
        x = numbers("points", points, finite=False)
        inside: NDArray[np.bool_] = np.asarray(
            np.all((x >= self.lower[: self.n]) & (x <= self.upper[: self.n]), axis=-1)
        )
        return inside

    def sample(self, count: int, generator: np.random.Generator) -> Array:
        """About so many points (K, n + m), states and inputs: the middle, corners, random ones."""
        sides = [dict.fromkeys(each) for each in zip(self.lower, self.upper, strict=True)]
        corners = np.array(list(itertools.islice(itertools.product(*sides), _MOST_CORNERS)))
        inner = generator.uniform(self.lower, self.upper, (count, self.lower.size))
        return np.vstack((0.5 * (self.lower + self.upper), corners, inner))


def bounded_region(
    system: System, region: ConvexSet | Region | None, inputs: Box | None = None
) -> Region:
    """Check a set of states, and put a box around it and the inputs."""
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
            f"the region is of {where.n} states and {where.lower.size - where.n} inputs; "
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
    return Region(lower, upper, system.n)


def stated_region(region: Any) -> Region | None:
    """A set that the user states; bounded or not, and for all inputs if not a region."""
    if region is None or isinstance(region, Region):
        return region
    if not isinstance(region, ConvexSet):
        raise SetError(f"region is {region!r}; expected a qpmhe.Box or a qpmhe.Polytope.")
    return Region(*bounds(region), region.dimension)


def bounds(states: ConvexSet) -> tuple[Array, Array]:
    """Outward bounds on the components of a set's members; infinite where there are none."""
    if states.matrix.shape[0] == 0:
        return states.lower, states.upper
    n, eye = states.dimension, np.eye(states.dimension)
    G = np.vstack((eye, -eye, states.matrix, -states.matrix))
    g = np.concatenate((states.upper, -states.lower, states.row_upper, -states.row_lower))
    G, g = G[np.isfinite(g)], g[np.isfinite(g)]
    found = [_support(G, g, e) for e in (*-eye, *eye)]
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


def _support(G: Array, g: Array, e: Array) -> tuple[float, float]:
    """y^T g for the multipliers y >= 0 of max e^T x over G x <= g, and a bound on |G^T y - e|_1.

    The former is infinite where there is no maximum.
    """
    from scipy.optimize import linprog

    answer = linprog(-e, A_ub=G, b_ub=g, bounds=(None, None), method="highs")
    if answer.x is None or answer.status != 0:
        return np.inf, 0.0
    y = np.maximum(-np.asarray(answer.ineqlin.marginals, np.float64), 0.0)
    rounding = 4.0 * (y.size + 2) * np.finfo(np.float64).eps
    side = float(y @ g) + rounding * float(y @ np.abs(g))
    residual = float(np.abs(G.T @ y - e).sum())
    return side, residual + rounding * float((np.abs(G).T @ y + np.abs(e)).sum())


def beyond(inner: Region, outer: Region) -> str:
    """Where a region reaches beyond another, in words; empty if it lies within it."""
    n, size = inner.n, outer.lower.size
    if outer.n != n:
        return f"it has {n} states instead of {outer.n}"
    away = (inner.lower[:size] < outer.lower) | (inner.upper[:size] > outer.upper)
    return ", ".join(
        f"{_name(j, n)} may be in [{inner.lower[j]:.6g}, {inner.upper[j]:.6g}], beyond "
        f"[{outer.lower[j]:.6g}, {outer.upper[j]:.6g}]" for j in np.flatnonzero(away)
    )


def _name(j: Any, n: int) -> str:
    return f"x[{j}]" if j < n else f"u[{j - n}]"
