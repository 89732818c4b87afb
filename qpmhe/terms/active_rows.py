"""The exact minimiser of a QP with inequalities that may be missed for a penalty."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP

from .._linalg import solve, unit_diagonal

Array = NDArray[np.float64]

# As in the banded solver: a root is exact for powers of four alone.
_COST_UNITS = 0.5, 1.0

# Rounding of a row, as a share of its terms, and how many times that a solved one may be off.
_ROUNDING, _ACCURACY = 16.0 * float(np.finfo(np.float64).eps), 2.0**20

# Most Newton steps on the optimality conditions: each may change which rows are active, all at once
# until that has not made fewer wrong so many times.
_NEWTON_STEPS = 40
_PATIENCE = 3

# Most solves of each for the forces of its rows.
_ROUNDS = 5


class StageRows:
    """Rows on the unknowns of one stage each and the next, of which most others are zero.

    Parameters
    ----------
    own, following : (K, R, n) array
        Their entries by the unknowns of stage k and of the next; those of the last stage do not
        count.
    which : (r,) array
        Which of the K R rows.
    signs : (r,) array
        Their factors.
    """

    def __init__(
        self, own: Array, following: Array, which: NDArray[np.intp], signs: Array
    ) -> None:
        self._stages, rows, self._n = own.shape
        both = np.concatenate((own, following), axis=2)
        both[-1, :, self._n :] = 0.0
        self._stage = which // rows
        self._entries = signs[:, None] * both.reshape(-1, 2 * self._n)[which]
        self._sizes: Array = np.abs(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def _pairs(self, step: Array) -> Array:
        """The values (r, 2 n) that the rows meet."""
        by_stage = np.zeros((self._stages + 1, self._n))
        by_stage[:-1] = step.reshape(self._stages, self._n)
        pairs = np.concatenate((by_stage[:-1], by_stage[1:]), axis=1)
        found: Array = pairs.take(self._stage, axis=0)
        return found

    def times(self, step: Array) -> Array:
        """The rows' values at a step (K n,)."""
        return np.asarray(np.einsum("ij,ij->i", self._entries, self._pairs(step)))

    def sizes_times(self, step: Array) -> Array:
        """The values of the rows' sizes."""
        return np.asarray(np.einsum("ij,ij->i", self._sizes, self._pairs(step)))

    def squares_times(self, step: Array) -> Array:
        """The values of the rows' squares."""
        return np.asarray(np.einsum("ij,ij->i", self._entries**2, self._pairs(step)))

    def whole(self, which: NDArray[np.bool_]) -> Array:
        """Some of the rows with all their entries, (number, K n)."""
        stage, entries = self._stage[which], self._entries[which]
        found, k = np.zeros((len(stage), self._stages + 1, self._n)), np.arange(len(stage))
        found[k, stage], found[k, stage + 1] = entries[:, : self._n], entries[:, self._n :]
        return found[:, :-1].reshape(len(stage), self._stages * self._n)


class Inequalities(NamedTuple):
    """Inequalities ``rows d <= sides`` of one QP, hard or with penalties.

    ``most`` is the largest force of an active one that is not violated, infinite for hard ones,
    and ``curvature`` by how much it grows beyond per unit of the violation.
    """

    rows: StageRows
    sides: Array
    most: Array
    curvature: Array


def minimised(
    base: QP, inequalities: Inequalities, start: Array | None, forces: Array,
    deadline: float = math.inf,
) -> tuple[Array, Array, int] | None:
    """The minimiser, its forces, and the Newton steps on the optimality conditions.

    The forces and the start say which rows are active at first; without a start it is the
    minimiser with these forces. Each step changes all rows that are wrong, until that has not made
    fewer wrong for some steps; then one row at a time, by one place: inactive, active, violated.
    None where this does not tell which rows are active, or not before the deadline, a time by
    `time.perf_counter`: after the first step, none begins behind that.
    """
    from scipy.linalg.lapack import dpbtrf, dpbtrs  # late, as in `Subproblem`

    rows, sides, most, curvature = inequalities
    # A power of two, so that the root in a Cholesky factor is exact for units that are, too.
    unit = _COST_UNITS[math.frexp(base.band.item(0))[1] % 2]
    factor, info = dpbtrf(unit * base.lapack_band, lower=1)
    if info != 0:
        return None
    free = -dpbtrs(factor, unit * base.gradient.reshape(-1, 1), lower=1)[0][:, 0]
    # H^-1 of the rows that have been active at some time, and how stiff H is against each row: for
    # the others, its diagonal will do.
    known = _KnownColumns(lambda side: dpbtrs(factor, unit * side, lower=1)[0], rows, len(free))
    stiff, soft = 1.0 / rows.squares_times(1.0 / base.band[:, :, 0].ravel()), np.zeros(len(rows))
    np.divide(1.0, curvature, out=soft, where=curvature > 0.0)
    step: Array = free if start is None else start
    held = forces > 0.0
    if start is None and held.any():
        known.add(held)
        step = free - forces[held] @ known.of(held)
    gap = rows.times(step) - sides
    place, fewest, patience = held + 1 * (forces >= most), len(rows) + 1, _PATIENCE
    for steps in range(_NEWTON_STEPS):
        reach = forces + stiff * gap
        new = (reach > 0.0) & ~known.has
        if new.any():
            stiff[new] = 1.0 / known.add(new)
            reach = forces + stiff * gap
        due = (reach > 0.0) + (reach > most).astype(np.intp)
        if patience <= 0:
            due = np.clip(due, place - 1, place + 1)
        wrong = np.flatnonzero(due != place)
        if not wrong.size and steps:
            return step, forces, steps
        if steps and perf_counter() > deadline:
            return None
        patience = _PATIENCE if wrong.size < fewest else patience - 1
        fewest = min(wrong.size, fewest)
        if patience <= 0:  # one at a time does not come back to where it was
            wrong = wrong[-1:]
        place[wrong] = due[wrong]
        active, violated = place > 0, place > 1
        pushed = violated & (curvature == 0.0)
        solved = active & ~pushed
        forces = np.where(pushed, most, 0.0)
        step = free - most[pushed] @ known.of(pushed)
        held_back, moves = rows.whole(solved), known.of(solved).T
        bent, beyond = np.where(violated, (soft, most), 0.0)[:, solved]
        reaction = held_back @ moves + np.diag(bent)
        for _ in range(_ROUNDS):  # after the first, for the rounding of the one before
            # Solved rows are met, or missed by what their force says.
            off = held_back @ step - sides[solved] - bent * (forces[solved] - beyond)
            # The step is a difference of these, and may vanish.
            terms = np.abs(free) + np.abs(step)
            rounding = _ROUNDING * (rows.sizes_times(terms) + np.abs(sides))
            if (np.abs(off) <= rounding[solved]).all():
                break
            if not (np.isfinite(off).all() and np.isfinite(reaction).all()):
                return None
            change = _least_squares(reaction, off)
            forces[solved] += change
            step = step - moves @ change
        if not (np.isfinite(step).all() and np.isfinite(forces).all()):
            return None
        if (np.abs(off) > _ACCURACY * rounding[solved]).any():
            return None
        gap = rows.times(step) - sides
        gap[solved | (np.abs(gap) <= rounding)] = 0.0
    return None


class _KnownColumns:
    """The columns H^-1 c of rows c that have been active at some time; ``has`` says which."""

    def __init__(
        self, solved: Callable[[Array], Array], rows: StageRows, unknowns: int
    ) -> None:
        self._solved, self._rows = solved, rows
        self.has, self._at = np.zeros(len(rows), np.bool_), np.zeros(len(rows), np.intp)
        self._columns = np.empty((0, unknowns))

    def add(self, new: NDArray[np.bool_]) -> Array:
        """Add columns; their products c' H^-1 c."""
        rows = self._rows.whole(new)
        columns = self._solved(rows.T).T
        self._at[new] = len(self._columns) + np.arange(len(rows))
        self._columns = np.concatenate((self._columns, columns))
        self.has |= new
        return np.asarray(np.einsum("ij,ij->i", rows, columns))

    def of(self, which: NDArray[np.bool_]) -> Array:
        """The columns of some rows, as rows."""
        return self._columns[self._at[which]]


def _least_squares(matrix: Array, side: Array) -> Array:
    """The solution of ``matrix x = side``, the least one where rows depend on each other."""
    try:
        return solve(matrix, side[:, None])[:, 0]
    except np.linalg.LinAlgError:
        scaled, units, whole = unit_diagonal(matrix)
        found = np.linalg.lstsq(scaled, np.ldexp(side, -whole - units), rcond=1e-10)[0]
        return np.asarray(np.ldexp(found, -units))
