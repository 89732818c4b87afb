"""Random QPs, each beside a dense twin assembled entry by entry."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np
import pytest

from qpmhe_solvers import QP, SolverOptions, available, backend, register, unregister
from qpmhe_solvers.scaling import Scaling

EVERY = available()
WITH_INEQUALITIES = [name for name in EVERY if backend(name).inequalities]
NATIVE = [
    name for name in EVERY if backend(name).keeps_workspace and name not in ("auto", "banded")
]
TIGHT = SolverOptions(absolute_tolerance=1e-9)


@contextmanager
def registered(entry):
    """Have a backend on the list for a while."""
    register(entry)
    try:
        yield entry
    finally:
        unregister(entry.name)


class Dense:
    """The QP in the stacked unknown x by full matrices: min x'Hx/2 + g'x, low <= Nx <= high.

    The first rows of N are those of the identity: the bounds are before the general rows.
    """

    def __init__(self, hessian, gradient, matrix, qp):
        self.hessian, self.gradient, self.matrix = hessian, gradient, matrix
        self.normals = np.vstack((np.eye(qp.size), matrix))
        self.low = np.concatenate((qp.lower, qp.row_lower), axis=None)
        self.high = np.concatenate((qp.upper, qp.row_upper), axis=None)

    def objective(self, d):
        x = np.ravel(d)
        return 0.5 * x @ self.hessian @ x + self.gradient @ x

    def violation(self, d):
        value = self.normals @ np.ravel(d)
        return np.maximum(self.low - value, value - self.high).max(initial=0.0)

    def stationarity(self, d, duals):
        force = self.hessian @ np.ravel(d) + self.gradient + self.normals.T @ duals
        return np.abs(force).max()

    def complementarity(self, d, duals):
        """Largest product of a multiplier and the distance to its side; itself if there is none."""
        value = self.normals @ np.ravel(d)
        distance = np.where(duals > 0, self.high - value, value - self.low)
        return np.abs(duals * np.where(np.isfinite(distance), distance, 1.0)).max()

    def gap(self, d, duals):
        x, sides = np.ravel(d), np.where(duals > 0, self.high, self.low)
        return abs(x @ self.hessian @ x + self.gradient @ x + duals @ np.where(duals, sides, 0.0))

    def minimiser(self):
        """The solution by quadprog, called directly: min x'Gx/2 - a'x, C'x >= b."""
        quadprog = pytest.importorskip("quadprog")
        equal = self.low == self.high
        above, below = np.isfinite(self.low) & ~equal, np.isfinite(self.high) & ~equal
        if not (equal | above | below).any():
            return np.linalg.solve(self.hessian, -self.gradient)
        normals = np.vstack((self.normals[equal], self.normals[above], -self.normals[below]))
        sides = np.concatenate((self.low[equal], self.low[above], -self.high[below]))
        return quadprog.solve_qp(
            self.hessian, -self.gradient, normals.T, sides, np.count_nonzero(equal)
        )[0]


def make(stages, n, rows=0, *, seed=0, bounds="none", sides="none", decades=0.0):
    """Make a random feasible QP and its dense twin.

    ``bounds`` is none, all, part (some sides infinite) or fixed (some sides equal);
    ``sides``, of the rows, is none, two, one, equal or mixed; the weights spread over
    ``decades`` powers of ten. Where there are inequalities, the gradient is large enough
    for some of them to bind.
    """
    rng = np.random.default_rng(seed)
    qp = QP(stages, n, rows)
    hessian = np.zeros((qp.size, qp.size))
    for first in range(0, qp.size, n):
        width = min(2 * n, qp.size - first)
        factor = rng.standard_normal((width, width))
        weights = 10.0 ** rng.uniform(-decades / 2, decades / 2, width)
        block = slice(first, first + width)
        hessian[block, block] += factor.T * weights @ factor + 0.5 * np.diag(weights)
    hessian = np.tril(hessian) + np.tril(hessian, -1).T  # to the last bit, for exact comparisons
    for k, c, o in np.ndindex(qp.band.shape):
        if c + o < 2 * n and k * n + c + o < qp.size:
            qp.band[k, c, o] = hessian[k * n + c + o, k * n + c]

    qp.gradient[:] = 10.0 * rng.standard_normal((stages, n))
    # The last stage's is never read, so it may be anything.
    qp.row_own[...], qp.row_next[...] = np.moveaxis(rng.standard_normal((stages, rows, n, 2)), 3, 0)
    matrix = np.zeros((stages * rows, qp.size + n))
    for k, r, c in np.ndindex(stages, rows, n):
        matrix[k * rows + r, k * n + c] = qp.row_own[k, r, c]
        matrix[k * rows + r, (k + 1) * n + c] = qp.row_next[k, r, c]
    matrix = matrix[:, : qp.size]

    inside = 0.2 * rng.standard_normal(qp.size)
    qp.bounded = bounds != "none"
    if qp.bounded:
        around = inside.reshape(stages, n)
        qp.lower[:] = around - rng.uniform(0.05, 0.5, (stages, n))
        qp.upper[:] = around + rng.uniform(0.05, 0.5, (stages, n))
        if bounds == "part":
            qp.lower[rng.random((stages, n)) < 0.5] = -np.inf
            qp.upper[rng.random((stages, n)) < 0.5] = np.inf
        elif bounds == "fixed":
            qp.lower[:, 0] = qp.upper[:, 0] = around[:, 0]
    if sides != "none":
        value = (matrix @ inside).reshape(stages, rows)
        qp.row_lower[:] = value - rng.uniform(0.05, 0.5, (stages, rows))
        qp.row_upper[:] = value + rng.uniform(0.05, 0.5, (stages, rows))
        if sides == "one":
            above = rng.random((stages, rows)) < 0.5
            qp.row_lower[above], qp.row_upper[~above] = -np.inf, np.inf
        elif sides == "equal":
            qp.row_lower[:] = qp.row_upper[:] = value
        elif sides == "mixed":
            kind = np.arange(stages * rows).reshape(stages, rows) % 4
            qp.row_lower[kind == 0] = qp.row_upper[kind == 0] = value[kind == 0]
            qp.row_lower[kind == 1], qp.row_upper[kind == 2] = -np.inf, np.inf
    return qp, Dense(hessian, qp.gradient.ravel().copy(), matrix, qp)


def of_order_one(qp):
    """A QP that solvers are handed as it is, made of another one, and its dense twin."""
    scaling = Scaling(held=False)
    scaling.scale(qp)
    qp = scaling.qp.copy()
    return qp, Dense(qp.dense(), qp.gradient.ravel(), qp.dense_rows(), qp)


def in_units(qp, states, cost, rows):
    """The same QP for the unknowns ``states * d``, with a cost and rows of other units."""
    other, n = qp.copy(), qp.n
    row = (np.arange(n)[:, None] + np.arange(2 * n)) % n
    other.band *= cost / (states[:, None] * states[row])
    other.gradient *= cost / states
    for array in (other.lower, other.upper):
        array *= states
    for array in (other.row_own, other.row_next):
        array *= rows[:, None] / states
    for array in (other.row_lower, other.row_upper):
        array *= rows
    return other


# What every backend that knows inequalities must solve.
CASES = {
    "no inequality": {"stages": 5, "n": 2},
    "boxes": {"stages": 6, "n": 2, "bounds": "all"},
    "boxes partly infinite": {"stages": 6, "n": 3, "bounds": "part"},
    "fixed unknowns": {"stages": 4, "n": 2, "bounds": "fixed"},
    "two-sided rows": {"stages": 6, "n": 2, "rows": 1, "sides": "two"},
    "one-sided rows": {"stages": 6, "n": 2, "rows": 2, "sides": "one"},
    "equality rows": {"stages": 5, "n": 3, "rows": 1, "sides": "equal"},
    "unused rows": {"stages": 5, "n": 2, "rows": 2, "bounds": "all"},
    "only unused rows": {"stages": 3, "n": 2, "rows": 2},
    "all kinds": {"stages": 7, "n": 3, "rows": 2, "bounds": "part", "sides": "mixed"},
    "badly scaled": {"stages": 6, "n": 2, "rows": 1, "sides": "two", "decades": 4.0},
    "single stage": {"stages": 1, "n": 3, "rows": 2, "bounds": "part", "sides": "two"},
    "n=1": {"stages": 8, "n": 1, "rows": 1, "bounds": "part", "sides": "one"},
    "one unknown": {"stages": 1, "n": 1, "bounds": "all"},
}
