"""The QP where some directions of x(i+1) - f have no disturbance, in as many unknowns as are free."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP, Solution, SolveStatus
from qpmhe_solvers.qp import band_of
from qpmhe_solvers.solver import ContainedSolver

from .._linalg import cholesky
from .constraints import Constraints

Array = NDArray[np.float64]

_SINGULAR = "the factorisation failed: the weights leave a direction undetermined, or not finite"


class Elimination:
    r"""Takes the noise-free directions out of the QPs of a subproblem.

    The increments follow :math:`d_{i+1} = A_i d_i + B e_i + c_i`, with the disturbances e in the
    free directions B. Householder reflections turn the rows of the cost in :math:`d_{i+1}, \dots,
    d_K` into rows of :math:`d_{i+1}` alone, from the last stage to the first; the prior's come
    last. Nothing is squared, so that a prior may be as vague as it likes beside the noise.

    With :math:`z_0 = R (d_0 - d_0^*)` and :math:`z_i = T_i e_i + F_i d_i + t_i` from these
    triangles, half of J is :math:`\tfrac12 |z|^2` and a constant: z = 0 is the minimiser d* without
    inequalities. Where that violates some, a backend has the QP in z, which has no row for a
    noise-free direction.

    References
    ----------
    Powell and Reid, On applying Householder transformations to linear least squares problems, IFIP
    Congress 1968; Cox and Higham, Stability of Householder QR factorization for weighted least
    squares problems, BIT 38, 1998.
    """

    def __init__(self, constraints: Constraints, n: int, p: int) -> None:
        rows, directions = constraints.disturbances, constraints.directions
        assert rows is not None
        self._n, self._basis, self._fixed = n, constraints.basis, rows.fixed
        scale = np.ones(n) if directions is None else directions.scale
        #: The least c with N'c = b, in the metric of the roll-out, is this times b.
        self._back: Array = scale[:, None] * np.linalg.pinv(rows.matrix[rows.fixed] * scale)
        r = self._basis.shape[1]
        self._range = np.zeros((n + p, r + p))
        self._range[:n, :r], self._range[n:, r:] = self._basis, np.eye(p)
        self._qp: QP | None = None

    def solve(
        self, around: Around, qp: QP, w_rows: slice, solver: ContainedSolver, limit: float | None
    ) -> Solution:
        """Solve a QP of the subproblem, whose rows on d have these places, within a time limit."""
        kept = np.ones(qp.rows, np.bool_)
        kept[w_rows] = ~self._fixed
        drift = qp.row_lower[:-1, w_rows][:, self._fixed] @ self._back.T
        free = self._minimiser(around, drift)
        if free is None:
            return Solution(None, SolveStatus.FAILED, 0, message=_SINGULAR)
        step = free.moved(free.start, drift)
        if not np.isfinite(step).all():
            return Solution(None, SolveStatus.FAILED, 0, message=_SINGULAR)
        values = qp.rows_times(step)
        lower, upper = qp.row_lower - values, qp.row_upper - values
        missed = np.maximum(lower, -upper)[:, kept].max(initial=0.0)
        if qp.bounded:
            missed = max(missed, np.maximum(qp.lower - step, step - qp.upper).max())
        none = np.zeros(qp.size), np.zeros(qp.stages * qp.rows)
        if around.curvature is None and missed <= 0.0:
            return Solution(step, SolveStatus.SOLVED, 0, None, *none)
        bounds = np.flatnonzero(
            (np.isfinite(qp.lower) | np.isfinite(qp.upper)).any(axis=0)
            if qp.bounded else np.zeros(self._n, np.bool_)
        )
        along = free.directions()
        reduced = self._reduced(qp, along, kept, bounds)
        reduced.row_lower[...] = np.concatenate(
            (lower[:, kept], (qp.lower - step)[:, bounds]), axis=1
        ).ravel()
        reduced.row_upper[...] = np.concatenate(
            (upper[:, kept], (qp.upper - step)[:, bounds]), axis=1
        ).ravel()
        if around.curvature is not None:
            _bend(reduced, along, step, *around.curvature)
        solution = solver.solve(reduced, None, limit)
        d = None if solution.d is None else step + along @ solution.d[0]
        duals: tuple[Array | None, Array | None] = (None, None)
        if solution.row_duals is not None:
            found = solution.row_duals.reshape(qp.stages, -1)
            bound_duals, row_duals = none[0].reshape(qp.stages, -1), none[1].reshape(qp.stages, -1)
            count = int(kept.sum())
            row_duals[:, kept], bound_duals[:, bounds] = found[:, :count], found[:, count:]
            duals = none
        return Solution(
            d, solution.status, solution.iterations, None, *duals, message=solution.message
        )

    def _minimiser(self, around: Around, drift: Array) -> _Factors | None:
        """The factors and the minimiser without inequalities; None where there is none."""
        n, (rows, side) = self._n, around.first
        q = around.weights[..., :n, :n]
        weights, mu = around.weights, around.damping
        target = around.residuals.copy()
        target[:, :n] += drift
        force = np.matmul(target[:, None, :], weights)[:, 0]
        if mu:
            weights = weights.copy()
            weights[..., :n, :n] += mu * q
            force[:, :n] += mu * np.matmul(drift[:, None, :], q)[:, 0]
        roots = _roots(self._range.T @ weights @ self._range)
        pivots = np.diagonal(roots, axis1=-2, axis2=-1)
        regular = roots + np.where(pivots == 0.0, 1.0, 0.0)[..., None] * np.eye(roots.shape[-1])
        targets = np.matmul((force @ self._range)[:, None, :], np.linalg.inv(regular))[:, 0]
        targets = np.where(pivots == 0.0, 0.0, targets)
        try:
            return _Factors(
                roots, targets, around.minus_jacobian, self._basis, drift, rows, side
            )
        except np.linalg.LinAlgError:
            return None

    def _reduced(
        self, qp: QP, along: Array, kept: NDArray[np.bool_], bounds: NDArray[np.intp]
    ) -> QP:
        """The QP in z, with the rows that are left and the bounds as rows."""
        stages, size = qp.stages, along.shape[-1]
        count = int(kept.sum()) + bounds.size
        reduced = self._qp
        if reduced is None or reduced.sizes != (1, size, stages * count):
            self._qp = reduced = QP(1, size, stages * count)
            reduced.bounded = False
        reduced.gradient[...] = 0.0
        reduced.band[...], reduced.band[0, :, 0] = 0.0, 1.0
        rows = np.empty((stages, count, size))
        mine = rows[:, : count - bounds.size]
        np.matmul(qp.row_own[:, kept], along, out=mine)
        mine[:-1] += qp.row_next[:-1, kept] @ along[1:]
        rows[:, count - bounds.size :] = along[:, bounds]
        reduced.row_own[0] = rows.reshape(-1, size)
        return reduced


class Around:
    """What the elimination reads of the QP around a trajectory.

    Attributes
    ----------
    minus_jacobian : (K, n + p, n) array
        -[A; C].
    residuals, weights : array
        Of the stages, as in `Trial`; zero residuals for the nearest point.
    first : (k, n) and (k,) array
        Rows R and s of the first state: its part of half of J is that of |R d_0 + s|^2.
    damping : float
        mu.
    curvature : (array, array) or None
        What constraints add to the Hessian: blocks (K + 1, n, n), and those below (K, n, n).
    """

    __slots__ = ("curvature", "damping", "first", "minus_jacobian", "residuals", "weights")

    def __init__(
        self, minus_jacobian: Array, residuals: Array, weights: Array, first: tuple[Array, Array]
    ) -> None:
        self.minus_jacobian, self.residuals, self.weights = minus_jacobian, residuals, weights
        self.first, self.damping = first, 0.0
        self.curvature: tuple[Array, Array] | None = None


class _Factors:
    """The triangles, and the trajectories that they lead to."""

    def __init__(
        self, roots: Array, targets: Array, minus_jacobian: Array, basis: Array, drift: Array,
        first: Array, first_side: Array,
    ) -> None:
        (n, r), count = basis.shape, len(minus_jacobian)
        a, own = -minus_jacobian[:, :n], roots.shape[-1]
        rows = np.empty((count, own + n, r + n + 1))
        rows[:, :own, :r] = roots[..., :r]
        np.matmul(roots[..., r:], minus_jacobian[:, n:], out=rows[:, :own, r:-1])
        rows[:, :own, -1] = targets
        along = np.empty((count, n, r + n + 1))
        along[:, :, :r], along[:, :, r:-1], along[:, :, -1] = basis, a, drift
        turned, later = np.empty((count, r, r + n + 1)), np.zeros((n, n + 1))
        for i in range(count - 1, -1, -1):
            block = rows[i]
            np.matmul(later[:, :-1], along[i], out=block[own:])
            block[own:, -1] += later[:, -1]
            sizes = np.abs(block[:, :-1]).max(axis=0)
            triangle = _triangle(block, 1.0 / np.where(sizes > 0.0, sizes, 1.0))
            turned[i], later = triangle[:r], triangle[r : r + n, r:]
        back = np.linalg.inv(turned[:, :, :r])
        self._added = basis @ back
        self._moved = a - self._added @ turned[:, :, r:-1]
        self._constant = -(self._added @ turned[:, :, -1:])[:, :, 0]
        everything = np.concatenate((np.column_stack((first, first_side)), later))
        units = np.ldexp(1.0, -np.frexp(np.abs(first).max(axis=0))[1])
        order = _order(everything[:, :-1] * units)
        triangle = _triangle(everything[:, np.append(order, n)], units[order])
        self._first = np.empty((n, n))
        self._first[order] = np.linalg.inv(triangle[:n, :n])
        #: d_0 of the minimiser.
        self.start: Array = -(self._first @ triangle[:n, n])

    def moved(self, start: Array, drift: Array) -> Array:
        """The trajectory (K + 1, n) with the best disturbances behind a first state."""
        steps = np.empty((len(drift) + 1, start.size))
        steps[0] = start
        constant = self._constant + drift
        for i, move in enumerate(self._moved):
            np.add(move.dot(steps[i]), constant[i], out=steps[i + 1])
        return steps

    def directions(self) -> Array:
        """The derivatives (K + 1, n, n + K r) of the trajectory by z."""
        count, n, r = self._added.shape
        along = np.zeros((count + 1, n, n + count * r))
        along[0, :, :n] = self._first
        for i, move in enumerate(self._moved):
            end = n + i * r
            np.matmul(move, along[i, :, :end], out=along[i + 1, :, :end])
            along[i + 1, :, end : end + r] = self._added[i]
        return along


def _triangle(rows: Array, units: Array) -> Array:
    """R of a factorisation Q R of rows and their sides, which are the last column.

    The longest rows come first, in units of the columns: rounding in a row is then small beside
    this row, however long others are.
    """
    order = np.argsort(-(np.abs(rows[:, :-1]) * units).max(axis=1), kind="stable")
    return np.asarray(np.linalg.qr(rows[order], mode="r"))


def _order(rows: Array) -> NDArray[np.intp]:
    """The order of columns by what is left of them."""
    from scipy.linalg.lapack import dgeqp3  # late: most estimators do without

    return np.asarray(dgeqp3(rows)[1] - 1, np.intp)


def _roots(weights: Array) -> Array:
    """R with R'R = W, upper triangular, for one or many weights, positive semidefinite."""
    with suppress(np.linalg.LinAlgError):
        return np.asarray(np.swapaxes(np.linalg.cholesky(weights), -1, -2))
    if weights.ndim == 2:
        return cholesky(weights).T
    return np.array([cholesky(one).T for one in weights])


def _bend(reduced: QP, along: Array, step: Array, own: Array, below: Array) -> None:
    """Add a Hessian of blocks and blocks below them, around a step, to the QP in z."""
    crossing = np.swapaxes(along[1:], 1, 2) @ below @ along[:-1]
    added = (np.swapaxes(along, 1, 2) @ own @ along).sum(axis=0)
    added += crossing.sum(axis=0) + crossing.sum(axis=0).T
    reduced.band += band_of(0.5 * (added + added.T))
    force = np.matmul(own, step[:, :, None])[:, :, 0]
    force[1:] += np.matmul(below, step[:-1, :, None])[:, :, 0]
    force[:-1] += np.matmul(np.swapaxes(below, 1, 2), step[1:, :, None])[:, :, 0]
    reduced.gradient[0] = np.einsum("kij,ki->j", along, force)
