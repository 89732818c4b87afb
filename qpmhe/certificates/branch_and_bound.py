"""Matrix inequalities and Lipschitz constants shown on a whole region, cell by cell."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from ..model.system import System
from .deadline import PART_SECONDS, Deadline
from .enclosures import MOST_ACTIVE, Enclosure, SmoothModel
from .evidence import Evidence
from .inequalities import Form, Matrices, definite, norm_bound
from .regions import Region

_CHUNK, _MOST_CELLS, _MOST_LIPSCHITZ_CELLS = 256, 40_000, 20_000
# Operations on one chunk, about: large systems take fewer cells at a time, so that the clock
# is checked often enough.
_WORK = 4e7
# Cells are split by what their width adds to the error; what it adds to the corners counts
# a little, for cells that reach out of a polytope.
_CORNER_SHARE = 1e-3
_TOLERANCE = 1e-3  # of a Lipschitz constant, beside the largest norm seen


class Cells:
    """The remaining cells of a region, each with the bound of the cell that it is a part of.

    Iteration is over chunks of those with the largest bounds, which decide the result. It ends
    when none is left, or after ``most``, or when the time is over, but not before one was taken.
    """

    def __init__(
        self, region: Region, most: int, deadline: Deadline, chunk: int = _CHUNK
    ) -> None:
        self._region, self._most, self._deadline, self._chunk = region, most, deadline, chunk
        self._lower, self._upper = region.lower[None], region.upper[None]
        self.inherited = np.array([np.inf])
        self.taken, self.late = 0, False

    def __iter__(self) -> Iterator[tuple[Array, Array]]:
        while not self.done:
            if self.taken:
                self.late = self._deadline.passed
                if self.late or self.taken > self._most:
                    return
            order = np.argsort(self.inherited, kind="stable")
            rest, chosen = order[: -self._chunk], order[-self._chunk :]
            low, high = self._lower[chosen], self._upper[chosen]
            self._lower, self._upper = self._lower[rest], self._upper[rest]
            self.inherited = self.inherited[rest]
            self.taken += len(chosen)
            yield low, high

    @property
    def done(self) -> bool:
        """Whether no cell is left."""
        return not len(self._lower)

    def halve(self, low: Array, high: Array, scores: Array, bounds: Array | float = np.inf) -> None:
        """Put the halves of cells back, along the coordinates with the largest scores."""
        lower, upper = _halves(self._region, low, high, scores)
        stay = ~self._region.outside(lower, upper)
        self._lower = np.vstack((self._lower, lower[stay]))
        self._upper = np.vstack((self._upper, upper[stay]))
        bounds = np.tile(np.broadcast_to(bounds, len(low)), 2)
        self.inherited = np.append(self.inherited, bounds[stay])


def _halves(region: Region, low: Array, high: Array, scores: Array) -> tuple[Array, Array]:
    """The first halves of all cells, and then the second ones."""
    rows = np.arange(low.shape[0])
    known = np.isfinite(scores).all(axis=1) & (scores.max(axis=1) > 0.0)
    width = np.where(region.upper > region.lower, region.upper - region.lower, np.inf)
    which = np.where(known[:, None], scores, (high - low) / width).argmax(axis=1)
    middle = 0.5 * (low[rows, which] + high[rows, which])
    first_high, second_low = high.copy(), low.copy()
    first_high[rows, which] = second_low[rows, which] = middle
    return np.vstack((low, second_low)), np.vstack((first_high, high))


def halves_of(region: Region, low: Array, high: Array, scores: Array) -> tuple[Array, Array]:
    """Halves of cells along the coordinates with the largest scores, within a region."""
    lower, upper = _halves(region, low, high, scores)
    stay = ~region.outside(lower, upper)
    return lower[stay], upper[stay]


def _scores(enclosure: Enclosure, left: NDArray[np.intp]) -> Array:
    """What the width of each coordinate adds to the error and the corners of some cells."""
    sizes = np.abs(enclosure.slopes)
    weight = np.nan_to_num(sizes).max(axis=(0, 2, 3), initial=0.0)
    # Of coordinates beyond the most active ones, all that they do is in the error.
    share = np.ones(weight.size)
    share[np.argsort(weight)[::-1][:MOST_ACTIVE]] = _CORNER_SHARE
    scores: Array = enclosure.excess[left] + share * sizes[left].sum(axis=(2, 3))
    return scores


def _at_corners(enclosure: Enclosure) -> tuple[Matrices, int]:
    """The matrices at all corners of each cell, one after another, and how many cells there are."""
    corners, error = enclosure.corners()
    cells, count = corners.shape[:2]
    middle = corners.reshape(cells * count, *corners.shape[2:])
    return Matrices(middle, np.repeat(error, count, axis=0)), cells


class Cover(NamedTuple):
    """How far the verification of an inequality went."""

    proved: bool
    cells: int
    violations: Array  # (V, n + m): states and inputs at which the inequality does not hold
    jacobians: Array  # the Jacobians there
    late: bool = False  # whether it ended because the time was over


def cover(
    model: SmoothModel, region: Region, form: Form, most_cells: int = _MOST_CELLS,
    seconds: float | Deadline = PART_SECONDS,
) -> Cover:
    """Show an inequality on a region by dividing it until each cell is shown."""
    size = 2 ** min(region.lower.size, MOST_ACTIVE) * (2 * len(form.P) + len(form.R)) ** 3
    chunk = int(np.clip(_WORK / size, 1, _CHUNK))
    deadline, model.late = Deadline.of(seconds), ""
    cells = Cells(region, most_cells, deadline, chunk)
    nowhere = np.empty((0, region.lower.size)), np.empty((0, 0, 0))
    proved: list[tuple[Array, Array]] = []
    for low, high in cells:
        enclosure = model.enclose(low, high)
        matrices, count = _at_corners(enclosure)
        with np.errstate(all="ignore"):
            shown = definite(form.matrices(matrices)).reshape(count, -1).all(axis=1)
        left = np.flatnonzero(~shown)
        proved.append((low[shown], high[shown]))
        low, high, centres = low[left], high[left], enclosure.jacobian[left]
        middle = 0.5 * (low + high)
        broken = _broken(form, centres) & region.contains(middle[:, : region.n])
        if broken.any():
            return Cover(False, cells.taken, middle[broken], centres[broken])
        if len(left):
            cells.halve(low, high, _scores(enclosure, left))
    done = cells.done and model.agrees(proved, deadline)
    return Cover(done, cells.taken, *nowhere, late=cells.late)


def _broken(form: Form, jacobians: Array) -> NDArray[np.bool_]:
    """Where the inequality does not hold at a single Jacobian."""
    known = np.isfinite(jacobians).all(axis=(1, 2))
    single = form.matrices(Matrices.exact(jacobians[known])).middle
    broken = np.zeros(len(jacobians), dtype=np.bool_)
    broken[known] = np.linalg.eigvalsh(0.5 * single + 0.5 * np.swapaxes(single, 1, 2))[:, 0] <= 0.0
    return broken


class LipschitzConstant(NamedTuple):
    """L_h or L_f, with its evidence."""

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
    deadline, model = Deadline.of(seconds), SmoothModel(system, region)
    rows = slice(0, model.free.size) if name == "f" else slice(model.free.size, None)
    jacobians = model.jacobians(model.points)[:, rows]
    seen, bound = float(np.linalg.norm(jacobians, 2, axis=(1, 2)).max()), 0.0
    cells = Cells(region, _MOST_LIPSCHITZ_CELLS, deadline)
    for low, high in cells if not model.reason else ():
        enclosure = model.enclose(low, high)
        matrices, count = _at_corners(enclosure)
        with np.errstate(all="ignore"):
            each = norm_bound(matrices[:, rows]).reshape(count, -1).max(axis=1)
        each = np.where(np.isnan(each), np.inf, each)
        left = np.flatnonzero(each > seen * (1.0 + _TOLERANCE))
        bound = max(bound, float(np.delete(each, left).max(initial=0.0)))
        if len(left):
            cells.halve(low[left], high[left], _scores(enclosure, left), each[left])
    bound = max(bound, float(cells.inherited.max(initial=0.0)))
    if np.isfinite(bound):
        note = f"bounded cell by cell, {cells.taken} in all"
        return LipschitzConstant(bound, Evidence.PROVED, note)
    why = model.reason or f"no bound was found with {cells.taken} cells{model.unknown}"
    note = f"largest of {len(jacobians)} gradients; {why}"
    return LipschitzConstant(seen, Evidence.SAMPLED, note)
