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
from .regions import Region, bounded_region, bounds, inequalities, row_bounds

_CHUNK = 256
_MOST_CELLS = 40_000
_SAMPLES, _SEED = 2000, 20210829
# More than the rounding of a few sums and products.
_OUTWARD = 1.0 + 1e-12
_SLACKS = (1e-12, 1e-9, 1e-6, 1e-3)


@dataclass(frozen=True, eq=False)
class Invariance:
    r"""Whether f and the disturbances keep the state in a region.

    Attributes
    ----------
    holds : bool or None
        True where it is proved, False where a state that leaves is known, None where neither is.
    text : str
        In words: through which side the state leaves, from where, and how far it reaches; or why
        it is not known.
    region : Region
        The region.
    limit, reach : float
        c, and the largest :math:`g^\top x^+` that is known; NaN where no state is known to leave.
    at : (n + m,) array or None
        From where: state and input.
    cells : int
        How many cells were examined.
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

    Parameters
    ----------
    system, region, inputs
        As for `certify`.
    disturbance : float or (r,) array_like
        The largest disturbance w: a length, or half-widths by component; G w acts on the state.
    seconds : float or Deadline
        How long it may take, about.

    Raises
    ------
    SetError, ModelError, ShapeError, OptionError
        If the region is no bounded set of states, f raises in it, or the disturbance does not fit.
    """
    deadline, where = Deadline.of(seconds), bounded_region(system, region, inputs)
    rows, limits = inequalities(where.states)
    added, cells = _added(system, rows, disturbance), Cells(where)
    model = SmoothModel(system, where)
    unknown = "it is not known whether x stays"
    if model.reason:
        return Invariance(None, f"{unknown}: {model.reason}", where)
    points = where.sample(_SAMPLES, np.random.default_rng(_SEED))
    while True:
        found = _leaving(model, where, rows, limits, added, points, cells.taken)
        if found is not None:
            return found
        if not len(cells.lower):
            return Invariance(True, "x stays in the region", where, cells=cells.taken)
        if cells.taken and (deadline.passed or cells.taken > _MOST_CELLS):
            end = "when its time was over" if deadline.passed else "the most that are allowed"
            text = f"{unknown}, after {cells.taken} cells, {end}"
            return Invariance(None, text, where, cells=cells.taken)
        low, high = cells.take(_CHUNK)
        reach, parts = _reach(model, rows, low, high)
        excess = reach - (limits - added)
        left = np.flatnonzero(~(excess <= 0.0).all(axis=1))
        low, high, excess = low[left], high[left], excess[left]
        points = 0.5 * low + 0.5 * high
        points = points[where.contains(points[:, : where.n])]
        worst = np.where(np.isnan(excess), np.inf, excess).argmax(axis=1)
        cells.halve(low, high, parts[left, worst], np.full(len(left), np.inf))


def inner_region(region: Region, metric: Array, radius: float) -> Region | None:
    r"""The states all of whose neighbours with :math:`|e|_P \le b` are in a region.

    While x stays there, and :math:`|x - z|_P \le b`, z stays in the region. With b the larger of
    the observer's initial bound and its limit, that is at all times; the inner region's own
    invariance can be certified in turn.

    Parameters
    ----------
    region : Region
    metric : (n, n) array
        P.
    radius : float
        b.

    Returns
    -------
    Region or None
        None if it is empty, or has no interior.
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
    n, (middle, half) = model.n, halved(low, high)
    start, end = low.copy(), high.copy()
    start[:, :n] = end[:, :n] = middle[:, :n]
    with np.errstate(all="ignore"):
        enclosure = model.enclose(low, high)
        J = enclosure.centre[:, :n]
        spread = np.abs(enclosure.slopes[:, :, :n]).sum(axis=1) + enclosure.error[:, :n]
        slopes = np.abs(np.einsum("ri,bij->brj", rows, J)) + np.einsum(
            "ri,bij->brj", np.abs(rows), spread + 1e-14 * np.abs(J)
        )
        parts = slopes * half[:, None, :n] * _OUTWARD
        at_middle, over_cell = model.values(start, end), model.values(low, high)
        first = row_bounds(rows, at_middle.low[:, :n], at_middle.high[:, :n])
        mean = first[1] + parts.sum(axis=2) * _OUTWARD
        mean += 1e-15 * np.abs(mean)
        direct = row_bounds(rows, over_cell.low[:, :n], over_cell.high[:, :n])[1]
        reach = np.fmin(mean, direct)
    # Inputs count by what their width adds to the values at the middle.
    width = (first[1] - first[0])[:, :, None] * (half[:, None, n:] > 0.0)
    return reach, np.concatenate((parts, width), axis=2)


def _leaving(
    model: SmoothModel, region: Region, rows: Array, limits: Array, added: Array, points: Array,
    cells: int,
) -> Invariance | None:
    """The state among some of the region's from which f reaches farthest, if it leaves."""
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
    reach, limit, row = float(most[k, side]), float(limits[side]), rows[side]
    sign, relation = (1.0, "<=") if row[np.flatnonzero(row)[0]] > 0.0 else (-1.0, ">=")
    names = _words(sign * row)
    who = "f and the disturbances reach" if added[side] > 0.0 else "f reaches"
    text = (
        f"{who} {names} = {sign * reach:.4g} through the face {names} {relation} "
        f"{sign * limit:.4g}, from {place(*np.split(np.round(points[k], 4), [n]))}"
    )
    return Invariance(False, text, region, limit, reach, points[k], cells)


def _words(row: Array) -> str:
    """A linear form in words."""
    text = ""
    for j in np.flatnonzero(row):
        sign = "-" if row[j] < 0.0 else "+"
        text += f" {sign} " if text else sign.strip("+")
        text += ("" if abs(row[j]) == 1.0 else f"{abs(row[j]):.4g} ") + f"x{j + 1}"
    return text
