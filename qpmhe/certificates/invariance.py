r"""Whether a region is invariant: f(x, u) + G w in it for all its states x, inputs u and w.

The state leaves through a side :math:`g^\top x \le c` exactly where the largest value of
:math:`g^\top f(x, u)`, and what the disturbances add to it, are above c. On a cell with middle m
it is, with the Jacobian J enclosed over the cell and the inputs over theirs, at most

.. math::
    g^\top f(m, u) + \sum_j |g^\top J|_j\, h_j, \qquad h_j \text{ the half-widths},

and cells are divided until it is below c, or above it at a state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, numbers
from ..errors import OptionError, ShapeError
from ..model.sets import Box, ConvexSet
from ..model.system import System
from .branch_and_bound import Cells
from .deadline import PART_SECONDS, Deadline
from .enclosures import SmoothModel, halved, place
from .evidence import Evidence
from .inequalities import Matrices, definite
from .regions import Region, bounded_region, bounds, inequalities, row_bounds

_MOST_CELLS = 40_000
_SAMPLES, _SEED = 2000, 20210829
# More than the rounding of a few sums and products.
_OUTWARD = 1.0 + 1e-12
_SLACKS = (1e-12, 1e-9, 1e-6, 1e-3)


@dataclass(frozen=True, eq=False)
class Invariance:
    """Whether f and the disturbances keep the state in a region: ``holds``, None if not known.

    ``text`` says it in words: through which side the state leaves, from where, and how far it
    reaches; or why it is not known.
    """

    holds: bool | None
    text: str
    region: Region
    cells: int = 0

    @property
    def evidence(self) -> Evidence | None:
        """PROVED, for either answer; None where there is none."""
        return None if self.holds is None else Evidence.PROVED

    def __str__(self) -> str:
        return self.text


def certify_invariance(
    system: System, region: ConvexSet | Region | None = None, *, inputs: Box | None = None,
    disturbance: ArrayLike = 0.0, seconds: float | Deadline = PART_SECONDS,
) -> Invariance:
    """Prove that a region is invariant, or report where the state leaves it.

    Arguments and errors are those of `certify`; the ``disturbance`` is the largest w, a length or
    half-widths by component (r,), which acts on the state as G w.
    """
    deadline, where = Deadline.of(seconds), bounded_region(system, region, inputs)
    rows, limits = inequalities(where.states)
    added, model = _added(system, rows, disturbance), SmoothModel(system, where)
    unknown = "it is not known whether x stays"
    if model.reason:
        return Invariance(None, f"{unknown}: {model.reason}", where)
    cells = Cells(where, _MOST_CELLS, deadline)
    points = where.sample(_SAMPLES, np.random.default_rng(_SEED))
    proved: list[tuple[Array, Array]] = []
    leaving = _leaving(model, where, rows, limits, added, points)
    for low, high in cells if leaving is None else ():
        reach, parts = _reach(model, rows, low, high)
        excess = reach - (limits - added)
        shown = (excess <= 0.0).all(axis=1)
        left = np.flatnonzero(~shown)
        proved.append((low[shown], high[shown]))
        low, high, excess = low[left], high[left], excess[left]
        points = 0.5 * low + 0.5 * high
        points = points[where.contains(points[:, : where.n])]
        leaving = _leaving(model, where, rows, limits, added, points)
        if leaving is not None:
            break
        if len(left):
            worst = np.where(np.isnan(excess), np.inf, excess).argmax(axis=1)
            cells.halve(low, high, parts[left, worst])
    if leaving is not None:
        return Invariance(False, leaving, where, cells.taken)
    if cells.done and not model.agrees(proved, deadline):
        why = model.reason or f"{model.late} when the time was over"
        return Invariance(None, f"{unknown}: {why}", where, cells.taken)
    if cells.done:
        return Invariance(True, "x stays in the region", where, cells.taken)
    end = "when its time was over" if cells.late else "the most that are allowed"
    return Invariance(None, f"{unknown}, after {cells.taken} cells, {end}", where, cells.taken)


def inner_region(region: Region, metric: Array, radius: float) -> Region | None:
    r"""The states all of whose neighbours with :math:`|e|_P \le b` are in a region.

    While x stays there, and :math:`|x - z|_P \le b`, z stays in the region. With b the larger of
    the observer's initial bound and its limit, that is at all times; the inner region's own
    invariance can be certified in turn. None if it is empty, or has no interior.
    """
    states, n = region.states, region.n
    sides, slants = (radius * supports(metric, rows) for rows in (np.eye(n), states.matrix))
    inner = ConvexSet(
        _inward(states.lower, sides), -_inward(-states.upper, sides), states.matrix,
        _inward(states.row_lower, slants), -_inward(-states.row_upper, slants),
    )
    if not (inner.lower < inner.upper).all() or not (inner.row_lower < inner.row_upper).all():
        return None
    lower, upper = region.lower.copy(), region.upper.copy()
    lower[:n], upper[:n] = bounds(inner)
    if not (lower[:n] < upper[:n]).all() or not np.isfinite(upper[:n] - lower[:n]).all():
        return None
    return Region(inner, lower, upper)


def _inward(sides: Array, reach: Array) -> Array:
    """Lower sides moved up by some lengths, rounded up; infinite ones stay."""
    moved: Array = np.where(np.isinf(sides), sides, np.nextafter(sides + reach, np.inf))
    return moved


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


def _added(system: System, rows: Array, disturbance: ArrayLike) -> Array:
    """What disturbances add to each g^T x at most."""
    size = numbers("disturbance", disturbance)
    if size.shape not in ((), (system.r,)):
        raise ShapeError(
            f"disturbance has shape {size.shape}; expected a length, or {system.r} half-widths."
        )
    if (size < 0.0).any():
        raise OptionError(f"disturbance is {size.tolist()}; expected >= 0.")
    G = np.eye(system.n) if system.disturbance_matrix is None else system.disturbance_matrix
    moves = rows @ G
    added: Array = np.linalg.norm(moves, axis=1) * size if size.ndim == 0 else np.abs(moves) @ size
    return added * _OUTWARD


def _reach(model: SmoothModel, rows: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Upper bounds (B, r) on g^T f over cells, and what each coordinate adds (B, r, N)."""
    n, free, (middle, half) = model.n, model.free, halved(low, high)
    start, end = low.copy(), high.copy()
    start[:, :n] = end[:, :n] = middle[:, :n]
    parts = np.zeros((len(low), len(rows), low.shape[1]))
    with np.errstate(all="ignore"):
        enclosure = model.enclose(low, high)
        # The sides of free states alone: others do not move, or else the values decide.
        J, g = enclosure.centre[:, : free.size], rows[:, free]
        spread = np.abs(enclosure.slopes[:, :, : free.size]).sum(axis=1)
        spread += enclosure.error[:, : free.size] + 1e-14 * np.abs(J)
        # r sides, b cells, rows i and columns j.
        slopes = np.abs(np.einsum("ri,bij->brj", g, J))
        slopes += np.einsum("ri,bij->brj", np.abs(g), spread)
        parts[:, :, free] = slopes * half[:, None, free] * _OUTWARD
        at_middle, over_cell = model.values(start, end), model.values(low, high)
        first = row_bounds(rows, at_middle.low[:, :n], at_middle.high[:, :n])
        mean = first[1] + parts.sum(axis=2) * _OUTWARD
        mean += 1e-15 * np.abs(mean)
        reach = row_bounds(rows, over_cell.low[:, :n], over_cell.high[:, :n])[1]
        if not model.moved.size:
            reach = np.fmin(mean, reach)
    # Inputs count by what their width adds to the values at the middle.
    parts[:, :, n:] = (first[1] - first[0])[:, :, None] * (half[:, None, n:] > 0.0)
    return reach, parts


def _leaving(
    model: SmoothModel, region: Region, rows: Array, limits: Array, added: Array, points: Array
) -> str | None:
    """From which of some states f leaves farthest, in words, and how far; None if it does not."""
    if not len(points):
        return None
    n, found = region.n, model.values(points, points)
    # What disturbances add at most was rounded up.
    most = row_bounds(rows, found.low[:, :n], found.high[:, :n])[0] + added / _OUTWARD**2
    widths = (region.upper - region.lower)[:n]
    beyond = (most - limits) / (np.abs(rows) @ np.where(widths > 0.0, widths, 1.0))
    beyond = np.where(np.isnan(beyond), -np.inf, beyond)
    k, side = np.unravel_index(int(beyond.argmax()), beyond.shape)
    if not beyond[k, side] > 0.0:
        return None
    row = rows[side]
    sign, relation = (1.0, "<=") if row[np.flatnonzero(row)[0]] > 0.0 else (-1.0, ">=")
    terms = " ".join(f"{each:+.4g} x{j + 1}" for j, each in enumerate(sign * row) if each)
    names = terms.replace("+1 x", "+x").replace("-1 x", "-x").lstrip("+")
    who = "f and the disturbances reach" if added[side] > 0.0 else "f reaches"
    return (
        f"{who} {names} = {sign * most[k, side]:.4g} through the face {names} {relation} "
        f"{sign * limits[side]:.4g}, from {place(np.round(points[k], 4), n)}"
    )
