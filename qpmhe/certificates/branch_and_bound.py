"""Matrix inequalities and Lipschitz constants shown on a whole region, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from ..model.system import System
from .deadline import PART_SECONDS, Deadline
from .enclosures import MOST_ACTIVE, Enclosure, SmoothModel, joint_jacobians
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
_MOST_LIPSCHITZ_CELLS, _TOLERANCE = 20_000, 1e-3
_SAMPLES, _SEED = 400, 20210829


@dataclass(frozen=True, eq=False)
class Cover:
    """How far the verification of an inequality went."""

    proved: bool
    cells: int
    violations: Array  # (V, n + m): states and inputs at which the inequality does not hold
    jacobians: Array  # (V, n + p, n): the Jacobians there
    late: bool = False  # whether it ended because the time was over


class Cells:
    """The cells of a region that remain, each with the bound of the cell that it is a part of."""

    def __init__(self, region: Region) -> None:
        self._region = region
        self.lower, self.upper = region.lower[None], region.upper[None]
        self.inherited = np.array([np.inf])
        self.taken = 0

    def take(self, most: int) -> tuple[Array, Array]:
        """The cells with the largest inherited bounds, which decide the result."""
        order = np.argsort(self.inherited, kind="stable")
        rest, chosen = order[:-most], order[-most:]
        low, high = self.lower[chosen], self.upper[chosen]
        self.lower, self.upper = self.lower[rest], self.upper[rest]
        self.inherited = self.inherited[rest]
        self.taken += len(chosen)
        return low, high

    def halve(self, low: Array, high: Array, scores: Array, bounds: Array) -> None:
        """Put the halves of cells back, along the coordinates with the largest scores."""
        region, rows = self._region, np.arange(low.shape[0])
        known = np.isfinite(scores).all(axis=1) & (scores.max(axis=1) > 0.0)
        width = np.where(region.upper > region.lower, region.upper - region.lower, np.inf)
        which = np.where(known[:, None], scores, (high - low) / width).argmax(axis=1)
        middle = 0.5 * (low[rows, which] + high[rows, which])
        first_high, second_low = high.copy(), low.copy()
        first_high[rows, which] = second_low[rows, which] = middle
        lower, upper = np.vstack((low, second_low)), np.vstack((first_high, high))
        stay = ~region.outside(lower, upper)
        self.lower = np.vstack((self.lower, lower[stay]))
        self.upper = np.vstack((self.upper, upper[stay]))
        self.inherited = np.append(self.inherited, np.tile(bounds, 2)[stay])


def _scores(enclosure: Enclosure, left: NDArray[Any]) -> Array:
    """What the width of each coordinate adds to the error and the corners of some cells."""
    sizes = np.abs(enclosure.slopes)
    weight = np.nan_to_num(sizes).max(axis=(0, 2, 3), initial=0.0)
    # Of coordinates beyond the most active ones, all that they do is in the error.
    share = np.ones(weight.size)
    share[np.argsort(weight)[::-1][:MOST_ACTIVE]] = _CORNER_SHARE
    scores: Array = enclosure.excess[left] + share * sizes[left].sum(axis=(2, 3))
    return scores


class Enclosing(Protocol):
    """Whatever encloses Jacobians over cells."""

    def enclose(self, lower: Array, upper: Array) -> Enclosure:
        """As `SmoothModel.enclose`."""


def cover(
    model: Enclosing, region: Region, form: Form, most_cells: int = _MOST_CELLS,
    seconds: float | Deadline = PART_SECONDS,
) -> Cover:
    """Show an inequality on a region by dividing it until each cell is shown."""
    deadline, cells = Deadline.of(seconds), Cells(region)
    corners = 2 ** min(region.lower.size, MOST_ACTIVE)
    order = len(form.P)
    chunk = int(np.clip(_WORK / (corners * (2 * order + len(form.R)) ** 3), 1, _CHUNK))
    nowhere = np.empty((0, region.lower.size)), np.empty((0, 0, 0))
    while len(cells.lower):
        if cells.taken and deadline.passed:
            return Cover(False, cells.taken, *nowhere, late=True)
        low, high = cells.take(chunk)
        enclosure = model.enclose(low, high)
        matrices, count = _at_corners(enclosure)
        with np.errstate(all="ignore"):
            shown = definite(form.matrices(matrices)).reshape(count, -1).all(axis=1)
        if shown.all():
            continue
        left = np.flatnonzero(~shown)
        low, high, centres = low[left], high[left], enclosure.jacobian[left]
        middle = 0.5 * (low + high)
        broken = _broken(form, centres) & region.contains(middle[:, : region.n])
        if broken.any():
            return Cover(False, cells.taken, middle[broken], centres[broken])
        if cells.taken > most_cells:
            return Cover(False, cells.taken, *nowhere)
        cells.halve(low, high, _scores(enclosure, left), np.full(len(left), np.inf))
    return Cover(True, cells.taken, *nowhere)


def _at_corners(enclosure: Enclosure) -> tuple[Matrices, int]:
    """The matrices at all corners of each cell, one after another, and how many cells there are."""
    corners, error = enclosure.corners()
    cells, count = corners.shape[:2]
    middle = corners.reshape(cells * count, *corners.shape[2:])
    return Matrices(middle, np.repeat(error, count, axis=0)), cells


def _broken(form: Form, jacobians: Array) -> NDArray[np.bool_]:
    """Where the inequality does not hold at a single Jacobian."""
    known = np.isfinite(jacobians).all(axis=(1, 2))
    single = form.matrices(Matrices.exact(jacobians[known])).middle
    broken = np.zeros(len(jacobians), dtype=np.bool_)
    broken[known] = np.linalg.eigvalsh(0.5 * single + 0.5 * np.swapaxes(single, 1, 2))[:, 0] <= 0.0
    return broken


@dataclass(frozen=True, eq=False)
class LipschitzConstant:
    """L_h or L_f, with what it rests on."""

    value: float  # in units of the output, or of the state, per unit of the state
    evidence: Evidence  # PROVED for an upper bound, SAMPLED for the largest value seen
    note: str  # how it was found


def lipschitz(
    system: System, region: Region, name: Literal["f", "h"],
    seconds: float | Deadline = PART_SECONDS,
) -> LipschitzConstant:
    r"""The smallest L with :math:`|h(x_1) - h(x_2)| \le L |x_1 - x_2|`, or that of f.

    On a convex set it is the supremum of the Jacobian's spectral norm. Cells are divided until the
    bound exceeds the largest norm seen by a thousandth at most, or the time is over.
    """
    deadline, n = Deadline.of(seconds), system.n
    rows = slice(0, n) if name == "f" else slice(n, None)
    points = region.sample(_SAMPLES, np.random.default_rng(_SEED))
    norms = np.linalg.norm(joint_jacobians(system, points)[:, rows], 2, axis=(1, 2))
    seen, model = float(norms.max()), SmoothModel(system, region)
    cells, bound = Cells(region), 0.0
    while len(cells.lower) and not model.reason:
        if cells.taken and (deadline.passed or cells.taken > _MOST_LIPSCHITZ_CELLS):
            bound = max(bound, float(cells.inherited.max()))
            break
        low, high = cells.take(_CHUNK)
        enclosure = model.enclose(low, high)
        matrices, count = _at_corners(enclosure)
        with np.errstate(all="ignore"):
            each = norm_bound(matrices[:, rows]).reshape(count, -1).max(axis=1)
        each = np.where(np.isnan(each), np.inf, each)
        left = np.flatnonzero(each > seen * (1.0 + _TOLERANCE))
        bound = max(bound, float(np.delete(each, left).max(initial=0.0)))
        cells.halve(low[left], high[left], _scores(enclosure, left), each[left])
    if model.reason or not np.isfinite(bound):
        why = model.reason or f"no bound was found with {cells.taken} cells{model.unknown}"
        note = f"largest of {len(points)} gradients; {why}"
        return LipschitzConstant(seen, Evidence.SAMPLED, note)
    return LipschitzConstant(bound, Evidence.PROVED, f"bounded on {cells.taken} cells")
