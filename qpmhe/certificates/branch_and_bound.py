"""A matrix inequality shown on a whole region, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .deadline import PART_SECONDS, Deadline
from .enclosures import MOST_ACTIVE, Enclosure, SmoothModel
from .inequalities import Form
from .regions import Region
from .verification import Matrices, definite

__all__ = ["Cover", "cover"]

Array = NDArray[np.float64]

_CHUNK = 256
_MOST_CELLS = 40_000
# Operations on one chunk, about: large systems take fewer cells at a time, so that the clock
# is looked at often enough.
_WORK = 4e7
# Cells are split by what their width adds to the error; what it adds to the corners counts
# a little, for cells that reach out of a polytope.
_CORNER_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class Cover:
    """How far the verification of an inequality went.

    Parameters
    ----------
    proved : bool
        Whether it holds on the whole region.
    cells : int
        How many cells were looked at.
    margin : float
        The smallest eigenvalue on the proved cells, of the matrix with unit diagonal.
    violations : (V, n + m) array
        States and inputs at which it does not hold.
    jacobians : (V, n + p, n) array
        The Jacobians there.
    late : bool
        Whether it ended because the time was over.
    """

    proved: bool
    cells: int
    margin: float
    violations: Array
    jacobians: Array
    late: bool = False


def cover(
    model: SmoothModel, region: Region, form: Form, most_cells: int = _MOST_CELLS,
    seconds: float | Deadline = PART_SECONDS,
) -> Cover:
    """Show an inequality on a region by dividing it until each cell is shown.

    Parameters
    ----------
    model : SmoothModel
        The functions, which intervals must be able to run.
    region : Region
        Where.
    form : Form
        The inequality.
    most_cells : int
        After so many cells the search is given up.
    seconds : float or Deadline
        After so much time, too.
    """
    deadline = Deadline.of(seconds)
    chunk = _chunk(model.n, model.p, region.lower.size)
    lower, upper = region.lower[None], region.upper[None]
    width = np.where(region.upper > region.lower, region.upper - region.lower, np.inf)
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
            return Cover(
                False, cells, margin, middle[broken], enclosure.centre[left][broken]
            )
        if cells > most_cells:
            return Cover(False, cells, margin, *nowhere)
        halves = _halved(low, high, _scores(enclosure, left, (high - low) / width))
        stay = ~region.outside(*halves)
        lower = np.vstack((lower, halves[0][stay]))
        upper = np.vstack((upper, halves[1][stay]))
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


def _scores(enclosure: Enclosure, left: NDArray[np.intp], relative: Array) -> Array:
    """What each coordinate of a cell is to blame for, (B, N)."""
    scores = enclosure.excess[left] + _CORNER_SHARE * np.abs(enclosure.slopes[left]).sum(
        axis=(2, 3)
    )
    known = np.isfinite(scores).all(axis=1) & (scores.max(axis=1) > 0.0)
    chosen: Array = np.where(known[:, None], scores, relative)
    return chosen


def _halved(low: Array, high: Array, scores: Array) -> tuple[Array, Array]:
    rows, which = np.arange(low.shape[0]), scores.argmax(axis=1)
    middle = 0.5 * (low[rows, which] + high[rows, which])
    first_high, second_low = high.copy(), low.copy()
    first_high[rows, which] = second_low[rows, which] = middle
    return np.vstack((low, second_low)), np.vstack((first_high, high))
