"""Lipschitz constants of the output function on a region (ass:lipschitz)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..system import System
from .deadline import PART_SECONDS, Deadline
from .enclosures import Enclosure, SmoothModel
from .evaluation import evaluated, insist_on_values
from .evidence import Evidence
from .regions import Region
from .verification import Matrices, norm_bound

__all__ = ["LipschitzConstant", "constant_output", "output_lipschitz"]

Array = NDArray[np.float64]

_CHUNK = 256
_MOST_CELLS = 20_000
_TOLERANCE = 1e-3
_SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class LipschitzConstant:
    """L_h, with what it rests on.

    Parameters
    ----------
    value : float
        The constant, in units of the output per unit of the state.
    evidence : Evidence
        PROVED for an upper bound, SAMPLED for the largest value seen.
    attained : float
        The largest norm of the Jacobian that was seen, a lower bound.
    at : (n + m,) array
        Where.
    note : str
        How the bound was found.
    """

    value: float
    evidence: Evidence
    attained: float
    at: Array
    note: str


def output_lipschitz(
    system: System, region: Region, model: SmoothModel | None = None,
    seconds: float | Deadline = PART_SECONDS,
) -> LipschitzConstant:
    r"""The smallest :math:`L_h` with :math:`|h(x_1) - h(x_2)| \le L_h |x_1 - x_2|`.

    On a convex set it is the supremum of the Jacobian's spectral norm. For an affine h this
    is one number; otherwise cells are divided until the bound exceeds the largest norm seen
    by a thousandth at most, or the time is over; f is not looked at.

    Parameters
    ----------
    system : System
        The system.
    region : Region
        Where.
    model : SmoothModel, optional
        The system's functions, if they were made before.
    seconds : float or Deadline
        How long this may take. What is known then is told: a bound that is less tight, or the
        largest norm seen.

    Raises
    ------
    ModelError
        If h raises or is not finite in the region.
    """
    deadline = Deadline.of(seconds)
    model = model or SmoothModel(system, region)
    points = region.sample(_SAMPLES, np.random.default_rng(20210829))
    x, u = points[:, : system.n], points[:, system.n :]
    insist_on_values(system, points, output_only=True)
    gradients = evaluated("the Jacobian of h", system.h_jacobian, x, u)
    usable = np.isfinite(gradients).all(axis=(-2, -1))
    norms = np.full(len(x), np.inf)
    norms[usable] = np.linalg.norm(gradients[usable], 2, axis=(-2, -1))
    worst = int(norms.argmax())
    attained, at = float(norms[worst]), points[worst]

    def seen(why: str) -> LipschitzConstant:
        return LipschitzConstant(
            attained, Evidence.SAMPLED, attained, at, f"largest of {norms.size} gradients; {why}"
        )

    if model.output_reason:
        return seen(f"h cannot be run with intervals ({model.output_reason})")
    lower, upper = region.lower[None], region.upper[None]
    inherited = np.array([np.inf])  # the bound on the cell that each was a part of
    bound, cells, end = 0.0, 0, ""
    while lower.shape[0]:
        if cells and (deadline.passed or cells > _MOST_CELLS):
            end = ", when its time was over" if deadline.passed else ", the most that are allowed"
            bound = max(bound, float(inherited.max()))
            if np.isfinite(bound):
                break
            return seen(f"no bound was found with {cells} cells{end}")
        # Those with the largest bounds first, which are what the result would be.
        order = np.argsort(inherited, kind="stable")
        lower, upper, inherited = lower[order], upper[order], inherited[order]
        low, high = lower[-_CHUNK:], upper[-_CHUNK:]
        lower, upper, inherited = lower[:-_CHUNK], upper[:-_CHUNK], inherited[:-_CHUNK]
        cells += low.shape[0]
        enclosure = model.enclose(low, high, output_only=True)
        bounds = _norm_bounds(enclosure)
        largest, middle = _largest(enclosure, 0.5 * low + 0.5 * high, region)
        if largest > attained:
            attained, at = largest, middle
        goal = np.inf if model.affine_output else attained * (1.0 + _TOLERANCE)
        open_ = ~(bounds <= goal)
        bound = max(bound, float(bounds[~open_].max(initial=0.0)))
        if not open_.any():
            continue
        low, high = low[open_], high[open_]
        width = np.where(region.upper > region.lower, region.upper - region.lower, np.inf)
        blame = np.abs(enclosure.slopes[open_]).sum(axis=(2, 3)) + enclosure.excess[open_]
        known = np.isfinite(blame).all(axis=1) & (blame.max(axis=1) > 0.0)
        which = np.where(known[:, None], blame, (high - low) / width).argmax(axis=1)
        rows = np.arange(low.shape[0])
        middles = 0.5 * (low[rows, which] + high[rows, which])
        first, second = high.copy(), low.copy()
        first[rows, which] = second[rows, which] = middles
        halves = np.vstack((low, second)), np.vstack((first, high))
        stay = ~region.outside(*halves)
        lower, upper = np.vstack((lower, halves[0][stay])), np.vstack((upper, halves[1][stay]))
        inherited = np.append(inherited, np.tile(bounds[open_], 2)[stay])
    how = "h is affine" if model.affine_output else f"bounded on {cells} cells{end}"
    return LipschitzConstant(bound, Evidence.PROVED, attained, at, how)


def constant_output(system: System, region: Region) -> Matrices | None:
    """An enclosure of the Jacobian of h where that is shown to be constant, (1, p, n).

    Parameters
    ----------
    system : System
        The system; its own Jacobian of h is not looked at.
    region : Region
        Where.
    """
    model = SmoothModel(system, region)
    if not model.affine_output:
        return None
    found = model.enclose(region.lower[None], region.upper[None], output_only=True)
    corners, error = found.corners()
    if corners.shape[1] != 1 or not np.isfinite(error).all():
        return None
    return Matrices(corners[:, 0], error)


def _largest(enclosure: Enclosure, middles: Array, region: Region) -> tuple[float, Array]:
    """The largest norm of the Jacobian of h in the middle of a cell, and where."""
    usable = np.isfinite(enclosure.centre).all(axis=(1, 2)) & region.contains(
        middles[:, : region.n]
    )
    norms = np.full(middles.shape[0], -np.inf)
    with np.errstate(all="ignore"):
        norms[usable] = np.linalg.norm(enclosure.centre[usable], 2, axis=(-2, -1))
    worst = int(norms.argmax())
    return float(norms[worst]), middles[worst]


def _norm_bounds(enclosure: Enclosure) -> Array:
    """Upper bounds on the norm of the Jacobian of h on each cell, infinite where unknown."""
    corners, error = enclosure.corners()
    count = corners.shape[1]
    C = corners.reshape(-1, *corners.shape[2:])
    with np.errstate(all="ignore"):
        bounds = norm_bound(Matrices(C, np.repeat(error, count, axis=0)))
    each: Array = bounds.reshape(-1, count).max(axis=1)
    return np.where(np.isnan(each), np.inf, each)
