"""Matrix inequalities and Lipschitz constants shown on a whole region, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from ..model.system import System
from .deadline import PART_SECONDS, Deadline
from .enclosures import MOST_ACTIVE, Enclosure, SmoothModel, check_values, evaluated
from .evidence import Evidence
from .inequalities import Form, Matrices, definite, norm_bound
from .regions import Region

_CHUNK = 256
_MOST_CELLS = 40_000
# Operations on one chunk, about: large systems take fewer cells at a time, so that the clock
# is checked often enough.
_WORK = 4e7
# Cells are split by what their width adds to the error; what it adds to the corners counts
# a little, for cells that reach out of a polytope.
_CORNER_SHARE = 1e-3
_MOST_OUTPUT_CELLS = 20_000
_TOLERANCE = 1e-3
_SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Cover:
    """How far the verification of an inequality went."""

    proved: bool
    cells: int
    margin: float  # smallest eigenvalue on the proved cells, of the matrix with unit diagonal
    violations: Array  # (V, n + m): states and inputs at which the inequality does not hold
    jacobians: Array  # (V, n + p, n): the Jacobians there
    late: bool = False  # whether it ended because the time was over


def cover(
    model: SmoothModel, region: Region, form: Form, most_cells: int = _MOST_CELLS,
    seconds: float | Deadline = PART_SECONDS,
) -> Cover:
    """Show an inequality on a region by dividing it until each cell is shown."""
    deadline = Deadline.of(seconds)
    chunk = _chunk(model.n, model.p, region.lower.size)
    lower, upper = region.lower[None], region.upper[None]
    cells, margin = 0, np.inf
    nowhere = np.empty((0, region.lower.size)), np.empty((0, model.n + model.p, model.n))
    while lower.shape[0]:
        if cells and deadline.passed:
            return Cover(False, cells, margin, *nowhere, late=True)
        taken = lower[-chunk:], upper[-chunk:]
        lower, upper = lower[:-chunk], upper[:-chunk]
        cells += taken[0].shape[0]
        enclosure = model.enclose(*taken)
        shown, least = _shown(form, enclosure)
        margin = min(margin, float(least[shown].min(initial=np.inf)))
        if shown.all():
            continue
        left = np.flatnonzero(~shown)
        low, high = taken[0][left], taken[1][left]
        middle = 0.5 * (low + high)
        broken = _broken(form, enclosure.centre[left])
        broken &= region.contains(middle[:, : model.n])
        if broken.any():
            return Cover(False, cells, margin, middle[broken], enclosure.centre[left][broken])
        if cells > most_cells:
            return Cover(False, cells, margin, *nowhere)
        low, high, _ = _halved(
            region, low, high, _scores(region, enclosure, left, low, high, _CORNER_SHARE)
        )
        lower, upper = np.vstack((lower, low)), np.vstack((upper, high))
    return Cover(True, cells, margin, *nowhere)


def _chunk(n: int, p: int, coordinates: int) -> int:
    """How many cells to look at at once."""
    corners = 2 ** min(coordinates, MOST_ACTIVE)
    return int(np.clip(_WORK / (corners * (2 * n + p) ** 3), 1, _CHUNK))


def _shown(form: Form, enclosure: Enclosure) -> tuple[NDArray[np.bool_], Array]:
    corners, error = enclosure.corners()
    cells, count = corners.shape[:2]
    with np.errstate(all="ignore"):
        matrices = form.matrices(
            Matrices(
                corners.reshape(cells * count, *corners.shape[2:]), np.repeat(error, count, axis=0)
            )
        )
        proved, least = definite(matrices)
    every: NDArray[np.bool_] = np.all(proved.reshape(cells, count), axis=1)
    smallest: Array = least.reshape(cells, count).min(axis=1)
    return every, smallest


def _broken(form: Form, jacobians: Array) -> NDArray[np.bool_]:
    """Where the inequality does not hold at a single Jacobian."""
    known = np.isfinite(jacobians).all(axis=(1, 2))
    broken = np.zeros(jacobians.shape[0], dtype=np.bool_)
    if known.any():
        single = form.matrices(Matrices.exact(jacobians[known])).middle
        broken[known] = np.linalg.eigvalsh(
            0.5 * single + 0.5 * np.swapaxes(single, 1, 2)
        )[:, 0] <= 0.0
    return broken


def _scores(
    region: Region, enclosure: Enclosure, left: NDArray[Any], low: Array, high: Array,
    corner_share: float,
) -> Array:
    """What each coordinate adds to the error of the cells that are left, (B, N)."""
    corners = np.abs(enclosure.slopes[left]).sum(axis=(2, 3))
    scores = enclosure.excess[left] + corner_share * corners
    known = np.isfinite(scores).all(axis=1) & (scores.max(axis=1) > 0.0)
    width = np.where(region.upper > region.lower, region.upper - region.lower, np.inf)
    return np.where(known[:, None], scores, (high - low) / width)


def _halved(
    region: Region, low: Array, high: Array, scores: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Halves of cells along their largest scores, and which of all are not outside the region."""
    rows, which = np.arange(low.shape[0]), scores.argmax(axis=1)
    middle = 0.5 * (low[rows, which] + high[rows, which])
    first_high, second_low = high.copy(), low.copy()
    first_high[rows, which] = second_low[rows, which] = middle
    lower, upper = np.vstack((low, second_low)), np.vstack((first_high, high))
    stay = ~region.outside(lower, upper)
    return lower[stay], upper[stay], stay


@dataclass(frozen=True, eq=False)
class LipschitzConstant:
    """L_h, with what it rests on."""

    value: float  # in units of the output per unit of the state
    evidence: Evidence  # PROVED for an upper bound, SAMPLED for the largest value seen
    attained: float  # the largest norm of the Jacobian that was seen, a lower bound
    at: Array  # (n + m,): where
    note: str  # how the bound was found


def output_lipschitz(
    system: System, region: Region, model: SmoothModel | None = None,
    seconds: float | Deadline = PART_SECONDS,
) -> LipschitzConstant:
    r"""The smallest :math:`L_h` with :math:`|h(x_1) - h(x_2)| \le L_h |x_1 - x_2|`.

    On a convex set it is the supremum of the Jacobian's spectral norm. For an affine h this
    is one number; otherwise cells are divided until the bound exceeds the largest norm seen
    by a thousandth at most, or the time is over; f is not used.
    """
    deadline = Deadline.of(seconds)
    model = model or SmoothModel(system, region)
    points = region.sample(_SAMPLES, np.random.default_rng(20210829))
    x, u = points[:, : system.n], points[:, system.n :]
    check_values(system, points, output_only=True)
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
        if cells and (deadline.passed or cells > _MOST_OUTPUT_CELLS):
            end = ", when its time was over" if deadline.passed else ", the most that are allowed"
            bound = max(bound, float(inherited.max()))
            if np.isfinite(bound):
                break
            return seen(f"no bound was found with {cells} cells{end}")
        # The largest bounds first: they decide the result.
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
        low, high, stay = _halved(
            region, low, high, _scores(region, enclosure, open_, low, high, 1.0)
        )
        lower, upper = np.vstack((lower, low)), np.vstack((upper, high))
        inherited = np.append(inherited, np.tile(bounds[open_], 2)[stay])
    how = "h is affine" if model.affine_output else f"bounded on {cells} cells{end}"
    return LipschitzConstant(bound, Evidence.PROVED, attained, at, how)


def constant_output(system: System, region: Region) -> Matrices | None:
    """An enclosure of the Jacobian of h where that is shown to be constant, (1, p, n)."""
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
