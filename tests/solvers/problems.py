"""Random QPs, each beside a dense twin assembled entry by entry."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest

from qpmhe_solvers import QP, available, backend, register, unregister
from qpmhe_solvers.scaling import Scaling

EVERY = available()
WITH_INEQUALITIES = [name for name in EVERY if backend(name).inequalities]


ARRAYS = (
    "band", "gradient", "lower", "upper", "row_own", "row_next", "row_lower", "row_upper"
)


@contextmanager
def registered(entry):
    """Have a backend on the list for a while."""
    register(entry)
    try:
        yield entry
    finally:
        unregister(entry.name)


def overwrite(qp, other):
    """Write the numbers of another QP of the same sizes into this one, in place."""
    for name in ARRAYS:
        getattr(qp, name)[...] = getattr(other, name)
    qp.bounded = other.bounded


def numbers(qp):
    """Copies of all that a QP holds."""
    return {name: getattr(qp, name).copy() for name in ARRAYS}


@dataclass
class Dense:
    """The QP in the stacked unknown x, from plain loops: min x'Hx/2 + g'x, a <= Fx <= b."""

    hessian: np.ndarray
    gradient: np.ndarray
    matrix: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    row_lower: np.ndarray
    row_upper: np.ndarray

    def objective(self, d):
        x = np.ravel(d)
        return 0.5 * x @ self.hessian @ x + self.gradient @ x

    def violation(self, d):
        x, worst = np.ravel(d), 0.0
        for value, low, high in self._sides(x):
            worst = max(worst, low - value, value - high)
        return worst

    def stationarity(self, d, bound_duals, row_duals):
        x = np.ravel(d)
        force = self.hessian @ x + self.gradient + bound_duals + self.matrix.T @ row_duals
        return np.abs(force).max()

    def complementarity(self, d, bound_duals, row_duals):
        """Largest product of a multiplier and the distance to its side; itself if there is none."""
        x, worst = np.ravel(d), 0.0
        multipliers = [*bound_duals, *row_duals]
        for (value, low, high), multiplier in zip(self._sides(x), multipliers, strict=True):
            distance = high - value if multiplier > 0 else value - low
            worst = max(worst, abs(multiplier) * (abs(distance) if np.isfinite(distance) else 1.0))
        return worst

    def gap(self, d, bound_duals, row_duals):
        x = np.ravel(d)
        total = x @ self.hessian @ x + self.gradient @ x
        multipliers = [*bound_duals, *row_duals]
        for (_, low, high), multiplier in zip(self._sides(x), multipliers, strict=True):
            if multiplier != 0:
                total += multiplier * (high if multiplier > 0 else low)
        return abs(total)

    def minimiser(self):
        """The solution by quadprog, called directly: min x'Gx/2 - a'x, C'x >= b."""
        quadprog = pytest.importorskip("quadprog")
        equal, normals, sides = [], [], []
        for row, low, high in self._rows_and_sides():
            if low == high:
                equal.append((row, low))
                continue
            if np.isfinite(low):
                normals.append(row)
                sides.append(low)
            if np.isfinite(high):
                normals.append(-row)
                sides.append(-high)
        if not equal and not normals:
            return np.linalg.solve(self.hessian, -self.gradient)
        normals = [row for row, _ in equal] + normals
        sides = [side for _, side in equal] + sides
        return quadprog.solve_qp(
            self.hessian, -self.gradient, np.array(normals).T, np.array(sides), len(equal)
        )[0]

    def _sides(self, x):
        yield from zip(x, self.lower, self.upper, strict=True)
        yield from zip(self.matrix @ x, self.row_lower, self.row_upper, strict=True)

    def _rows_and_sides(self):
        yield from zip(np.eye(self.gradient.size), self.lower, self.upper, strict=True)
        yield from zip(self.matrix, self.row_lower, self.row_upper, strict=True)


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
    for k in range(stages):
        width = min(2 * n, qp.size - k * n)
        factor = rng.standard_normal((width, width))
        weights = 10.0 ** rng.uniform(-decades / 2, decades / 2, width)
        for i in range(width):
            for j in range(width):
                curvature = sum(factor[r, i] * weights[r] * factor[r, j] for r in range(width))
                hessian[k * n + i, k * n + j] += curvature + 0.5 * weights[i] * (i == j)
    for i in range(qp.size):
        for j in range(i):
            hessian[j, i] = hessian[i, j]  # to the last bit, for exact comparisons
    for k in range(stages):
        for c in range(n):
            for o in range(2 * n - c):
                if k * n + c + o < qp.size:
                    qp.band[k, c, o] = hessian[k * n + c + o, k * n + c]

    qp.gradient[:] = 10.0 * rng.standard_normal((stages, n))
    matrix = np.zeros((stages * rows, qp.size))
    for k in range(stages):
        for r in range(rows):
            for c in range(n):
                qp.row_own[k, r, c] = matrix[k * rows + r, k * n + c] = rng.standard_normal()
                # The last stage's is never read, so it may be anything.
                qp.row_next[k, r, c] = rng.standard_normal()
                if k + 1 < stages:
                    matrix[k * rows + r, (k + 1) * n + c] = qp.row_next[k, r, c]

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
    return qp, Dense(
        hessian, qp.gradient.ravel().copy(), matrix, qp.lower.ravel().copy(),
        qp.upper.ravel().copy(), qp.row_lower.ravel().copy(), qp.row_upper.ravel().copy(),
    )


def of_order_one(qp):
    """A QP that solvers are handed as it is, made of another one, and its dense twin."""
    scaling = Scaling(held=False)
    scaling.scale(qp)
    qp = scaling.qp.copy()
    return qp, Dense(
        qp.dense(), qp.gradient.ravel(), qp.dense_rows(), qp.lower.ravel(), qp.upper.ravel(),
        qp.row_lower.ravel(), qp.row_upper.ravel(),
    )


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
    "badly scaled": {
        "stages": 6, "n": 2, "rows": 1, "bounds": "part", "sides": "two", "decades": 4.0,
    },
    "single stage": {"stages": 1, "n": 3, "rows": 2, "bounds": "part", "sides": "two"},
    "n=1": {"stages": 8, "n": 1, "rows": 1, "bounds": "part", "sides": "one"},
    "one unknown": {"stages": 1, "n": 1, "bounds": "all"},
}
