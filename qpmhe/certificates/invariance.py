r"""Whether a region is invariant: f(x, u) + G w in it for all its states x, inputs u and w.

On a cell with middle m, with the Jacobian J enclosed over the cell and the inputs over theirs,

.. math::
    f_i(x, u) \in f_i(m, u) + \sum_j [-1, 1]\, |J_{ij}|\, h_j, \qquad h_j \text{ the half-widths},

and cells are divided until that, and what disturbances add, is within the sides, or a state is
found from which it is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, numbers
from ..errors import OptionError, ShapeError
from ..model.sets import Box, ConvexSet
from ..model.system import System
from .branch_and_bound import Cells
from .deadline import PART_SECONDS, Deadline
from .enclosures import SmoothModel, halved, place
from .evidence import Evidence, json_ready
from .inequalities import Matrices, definite
from .intervals import Interval
from .regions import Region, bounded_region

_MOST_CELLS = 40_000
_SAMPLES, _SEED = 2000, 20210829
# More than the rounding of a few sums and products.
_OUTWARD = 1.0 + 1e-12
_SLACKS = (1e-12, 1e-9, 1e-6, 1e-3)


@dataclass(frozen=True, eq=False)
class Invariance:
    """Whether f and the disturbances keep the state in a region: ``holds``, None if not known.

    ``text`` says it in words: through which side the state leaves, from where (``at``, state and
    input), how far it reaches and what the ``limit`` is; or why it is not known.
    """

    holds: bool | None
    text: str
    region: Region
    limit: float = np.nan
    reach: float = np.nan
    at: Array | None = None
    cells: int = 0

    @property
    def evidence(self) -> Evidence | None:
        """PROVED, for either answer; None where there is none."""
        return None if self.holds is None else Evidence.PROVED

    def __str__(self) -> str:
        return self.text

    def to_dict(self) -> dict[str, Any]:
        """All but the region, in types that JSON knows."""
        content: dict[str, Any] = json_ready(
            {name: value for name, value in vars(self).items() if name != "region"}
        )
        return content


def certify_invariance(
    system: System, region: ConvexSet | Region | None = None, *, inputs: Box | None = None,
    disturbance: ArrayLike = 0.0, seconds: float | Deadline = PART_SECONDS,
) -> Invariance:
    """Prove that a region is invariant, or say where the state leaves it.

    Arguments and errors are those of `certify`; the ``disturbance`` is the largest w, a length or
    half-widths by component (r,), which acts on the state as G w.
    """
    deadline, where = Deadline.of(seconds), bounded_region(system, region, inputs)
    added, model = _added(system, disturbance), SmoothModel(system, where)
    unknown = "it is not known whether x stays"
    if model.reason:
        return Invariance(None, f"{unknown}: {model.reason}", where)
    cells = Cells(where, _MOST_CELLS, deadline)
    points = where.sample(_SAMPLES, np.random.default_rng(_SEED))
    leaving = _leaving(model, where, added, points)
    for low, high in cells if leaving is None else ():
        reached, parts = _reached(model, low, high)
        excess = np.maximum(
            reached.high - (where.upper[: where.n] - added),
            where.lower[: where.n] + added - reached.low,
        )
        left = np.flatnonzero(~(excess <= 0.0).all(axis=1))
        low, high, excess = low[left], high[left], excess[left]
        leaving = _leaving(model, where, added, 0.5 * low + 0.5 * high)
        if leaving is not None:
            break
        if len(left):
            worst = np.where(np.isnan(excess), np.inf, excess).argmax(axis=1)
            cells.halve(low, high, parts[left, worst])
    if leaving is not None:
        return Invariance(False, *leaving, cells.taken)
    if cells.done:
        return Invariance(True, "x stays in the region", where, cells=cells.taken)
    end = "when its time was over" if cells.late else "the most that are allowed"
    text = f"{unknown}, after {cells.taken} cells, {end}"
    return Invariance(None, text, where, cells=cells.taken)


def inner_region(region: Region, metric: Array, radius: float) -> Region | None:
    r"""The states all of whose neighbours with :math:`|e|_P \le b` are in a region.

    While x stays there, and :math:`|x - z|_P \le b`, z stays in the region. With b the larger of
    the observer's initial bound and its limit, that is at all times; the inner region's own
    invariance can be certified in turn. None if it is empty, or has no interior.
    """
    n, lower, upper = region.n, region.lower.copy(), region.upper.copy()
    reach = radius * supports(metric, np.eye(n))
    lower[:n] = np.nextafter(lower[:n] + reach, np.inf)
    upper[:n] = np.nextafter(upper[:n] - reach, -np.inf)
    return Region(lower, upper, n) if (lower[:n] < upper[:n]).all() else None


def supports(metric: Array, rows: Array) -> Array:
    """The largest g^T e over |e|_P <= 1, for each row g, rounded up."""
    guess = np.einsum("ij,ji->i", rows, np.linalg.solve(metric, rows.T))
    for slack in _SLACKS:
        squares = guess * (1.0 + slack)
        # g^T P^-1 g < c exactly where g g^T / c < P, by Schur's complement.
        less = rows[:, :, None] * rows[:, None, :] / squares[:, None, None]
        P = Matrices.exact(np.broadcast_to(metric, less.shape))
        if (squares > 0.0).all() and definite(P - Matrices(less, 1e-15 * np.abs(less))).all():
            found: Array = np.sqrt(squares) * _OUTWARD
            return found
    return np.full(len(rows), np.inf)


def _added(system: System, disturbance: ArrayLike) -> Array:
    """What disturbances add to each state at most."""
    size = numbers("disturbance", disturbance)
    if size.shape not in ((), (system.r,)):
        raise ShapeError(
            f"disturbance has shape {size.shape}; expected a length, or {system.r} half-widths."
        )
    if (size < 0.0).any():
        raise OptionError(f"disturbance is {size.tolist()}; expected >= 0.")
    G = np.eye(system.n) if system.disturbance_matrix is None else system.disturbance_matrix
    added: Array = np.linalg.norm(G, axis=1) * size if size.ndim == 0 else np.abs(G) @ size
    return added * _OUTWARD


def _reached(model: SmoothModel, low: Array, high: Array) -> tuple[Interval, Array]:
    """Where f is over cells (B, n), and what each coordinate's width adds (B, n, N)."""
    n, free, (middle, half) = model.n, model.free, halved(low, high)
    start, end = low.copy(), high.copy()
    start[:, :n] = end[:, :n] = middle[:, :n]
    parts = np.zeros((len(low), n, low.shape[1]))
    with np.errstate(all="ignore"):
        found = model.enclose(low, high)
        size = (np.abs(found.centre) + np.abs(found.slopes).sum(axis=1) + found.error)
        size = size[:, : free.size] * (1.0 + 1e-14) * half[:, None, free] * _OUTWARD
        parts[:, free[:, None], free] = size
        parts[:, model.moved] = np.nan  # of these, the values over the cell decide
        at_middle, over_cell = model.values(start, end), model.values(low, high)
        reach = parts.sum(axis=2) * _OUTWARD
        mean = Interval(at_middle.low[:, :n], at_middle.high[:, :n]) + Interval(-reach, reach)
        reached = Interval(
            np.fmax(mean.low, over_cell.low[:, :n]), np.fmin(mean.high, over_cell.high[:, :n])
        )
    # Inputs count by what their width adds to the values at the middle.
    width = (at_middle.high - at_middle.low)[:, :n, None]
    parts[:, :, n:] = width * (half[:, None, n:] > 0.0)
    return reached, parts


def _leaving(
    model: SmoothModel, region: Region, added: Array, points: Array
) -> tuple[str, Region, float, float, Array] | None:
    """From which of some states f leaves farthest, in words, and how far, if it leaves."""
    if not len(points):
        return None
    n, found = region.n, model.values(points, points)
    less = added / _OUTWARD**2  # it was rounded up
    limits = np.stack((region.upper[:n], -region.lower[:n]))[:, None]
    reach = np.stack((found.low[:, :n], -found.high[:, :n])) + less
    widths = (region.upper - region.lower)[:n]
    beyond = (reach - limits) / np.where(widths > 0.0, widths, 1.0)
    beyond = np.where(np.isnan(beyond), -np.inf, beyond)
    side, k, i = np.unravel_index(int(beyond.argmax()), beyond.shape)
    if not beyond[side, k, i] > 0.0:
        return None
    sign, relation = (-1.0, ">=") if side else (1.0, "<=")
    reached, limit = float(reach[side, k, i]), float(limits[side, 0, i])
    who = "f and the disturbances reach" if added[i] > 0.0 else "f reaches"
    text = (
        f"{who} x{i + 1} = {sign * reached:.4g} through the face x{i + 1} {relation} "
        f"{sign * limit:.4g}, from {place(np.round(points[k], 4), n)}"
    )
    return text, region, limit, reached, points[k]
