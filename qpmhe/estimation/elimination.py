"""The QP where some directions of x(i+1) - f have no disturbance, in the unknowns that are free."""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP, Solution, SolveStatus
from qpmhe_solvers.qp import band_of

from .._linalg import cholesky
from .constraints import Constraints

Array = NDArray[np.float64]

# Shorter columns are zeros.
_LEAST = 1e-150

#: Why there is no minimiser.
SINGULAR = "the factorisation failed: the weights leave a direction undetermined, or not finite"


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

    def of(self, around: Around, qp: QP, w_rows: slice) -> Eliminated | None:
        """A QP of the subproblem without these directions; None where no minimiser is finite.

        Its rows on d have the places ``w_rows``.
        """
        kept = np.ones(qp.rows, np.bool_)
        kept[w_rows] = ~self._fixed
        drift = qp.row_lower[:-1, w_rows][:, self._fixed] @ self._back.T
        factors = self._minimiser(around, drift)
        if factors is None:
            return None
        step = factors.moved(factors.start, drift)
        if not np.isfinite(step).all():
            return None
        return Eliminated(self, factors, step, qp, kept, around.curvature)

    def empty(self, size: int, rows: int) -> QP:
        """A QP in z with half of its square for an objective."""
        found = self._qp
        if found is None or found.sizes != (1, size, rows):
            self._qp = found = QP(1, size, rows)
            found.bounded = False
        found.gradient[...] = 0.0
        found.band[...], found.band[0, :, 0] = 0.0, 1.0
        return found

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


class Eliminated:
    """One QP without its noise-free directions.

    Attributes
    ----------
    step : (K + 1, n) array
        The minimiser d* without inequalities.
    """

    def __init__(
        self, elimination: Elimination, factors: _Factors, step: Array, qp: QP,
        kept: NDArray[np.bool_], curvature: tuple[Array, Array] | None,
    ) -> None:
        self.step = step
        self._elimination, self._factors, self._base, self._kept = elimination, factors, qp, kept
        self._curvature = curvature
        values = qp.rows_times(step)
        self._lower, self._upper = (
            (side - values)[:, kept] for side in (qp.row_lower, qp.row_upper)
        )
        if qp.bounded:
            self._bounds = np.flatnonzero(
                (np.isfinite(qp.lower) | np.isfinite(qp.upper)).any(axis=0)
            )
            # Bounds are rows behind the others.
            self._lower, self._upper = (
                np.hstack((rows, (side - step)[:, self._bounds]))
                for rows, side in ((self._lower, qp.lower), (self._upper, qp.upper))
            )

    @property
    def solution(self) -> Solution | None:
        """The minimiser, where it is the solution."""
        missed = max(self._lower.max(initial=0.0), -self._upper.min(initial=0.0))
        if self._curvature is not None or not missed <= 0.0:
            return None
        base = self._base
        none = np.zeros(base.size), np.zeros(base.stages * base.rows)
        return Solution(self.step, SolveStatus.SOLVED, 0, None, *none)

    @cached_property
    def along(self) -> Array:
        """The derivatives (K + 1, n, n + K r) of d by z."""
        return self._factors.directions()

    @cached_property
    def qp(self) -> QP:
        """The QP in z, until the next one."""
        base, kept, along = self._base, self._kept, self.along
        stages, count, size = base.stages, self._lower.shape[1], along.shape[-1]
        rows = np.empty((stages, count, size))
        general = int(kept.sum())
        np.matmul(base.row_own[:, kept], along, out=rows[:, :general])
        rows[:-1, :general] += base.row_next[:-1, kept] @ along[1:]
        if base.bounded:
            rows[:, general:] = along[:, self._bounds]
        found = self._elimination.empty(size, stages * count)
        found.row_own[0] = rows.reshape(-1, size)
        found.row_lower[0], found.row_upper[0] = self._lower.ravel(), self._upper.ravel()
        if self._curvature is not None:
            _bend(found, along, self.step, *self._curvature)
        return found

    def restored(self, solution: Solution) -> Solution:
        """A solution of the QP in z, or of one with more rows, as one of the QP."""
        base, general, along = self._base, int(self._kept.sum()), self.along
        d = None
        if solution.d is not None:
            d = self.step + along @ solution.d[0, : along.shape[-1]]
        duals: tuple[Array | None, Array | None] = (None, None)
        if solution.row_duals is not None:
            found = solution.row_duals[: self._lower.size].reshape(self._lower.shape)
            bound_duals, row_duals = np.zeros((base.stages, base.n)), np.zeros(base.row_lower.shape)
            row_duals[:, self._kept] = found[:, :general]
            if base.bounded:
                bound_duals[:, self._bounds] = found[:, general:]
            duals = bound_duals.ravel(), row_duals.ravel()
        return Solution(
            d, solution.status, solution.iterations, None, *duals, message=solution.message
        )


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
        triangle = _Triangle(r + n + 1)
        for i in range(count - 1, -1, -1):
            block = rows[i]
            later[:, :-1].dot(along[i], out=block[own:])
            block[own:, -1] += later[:, -1]
            made = triangle(block)
            turned[i], later = made[:r], made[r : r + n, r:]
        back = np.linalg.inv(turned[:, :, :r])
        self._added = basis @ back
        self._moved = a - self._added @ turned[:, :, r:-1]
        self._constant = -(self._added @ turned[:, :, -1:])[:, :, 0]
        everything = np.concatenate((np.column_stack((first, first_side)), later))
        units = np.ldexp(1.0, np.frexp(np.abs(first).max(axis=0))[1])
        order = _order(everything[:, :-1] / units)
        made = _Triangle(n + 1)(everything[:, np.append(order, n)], units[order])
        self._first = np.empty((n, n))
        self._first[order] = np.linalg.inv(made[:n, :n])
        #: d_0 of the minimiser.
        self.start: Array = -(self._first @ made[:n, n])

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


class _Triangle:
    """R of a factorisation Q R of rows and their sides, which are the last of some columns.

    The longest rows come first, in units of the columns: rounding in a row is then small beside
    this row, however long others are.
    """

    def __init__(self, columns: int) -> None:
        from scipy.linalg.lapack import dgeqrf  # late: most estimators do without

        self._dgeqrf, self._work = dgeqrf, 32 * columns
        self._upper = np.triu(np.ones((columns - 1, columns)))

    def __call__(self, rows: Array, units: Array | None = None) -> Array:
        """The triangle (columns - 1, columns), for units (columns - 1,) or the largest entries."""
        sizes = np.abs(rows[:, :-1])
        if units is None:
            units = np.maximum.reduce(sizes, axis=0)
        sizes /= np.maximum(units, _LEAST)
        # Of equal ones those of the disturbances, whose columns come first.
        order = np.negative(np.maximum.reduce(sizes, axis=1)).argsort(kind="stable")
        factors = self._dgeqrf(rows.take(order, axis=0), self._work)[0]
        return np.asarray(factors[: len(self._upper)] * self._upper)


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
