"""Small random QPs to test a backend."""

from __future__ import annotations

from typing import Literal

import numpy as np

from .qp import QP, band_of

Bounds = Literal["none", "all", "part"]
Sides = Literal["none", "two", "equal", "mixed"]


def sample(
    stages: int,
    n: int,
    rows: int = 0,
    *,
    bounds: Bounds = "none",
    sides: Sides = "none",
    decades: float = 0.0,
    push: float = 10.0,
    around: float = 0.2,
    seed: int = 0,
) -> QP:
    """Make a random QP with a strictly feasible point."""
    rng = np.random.default_rng(seed)
    qp = QP(stages, n, rows)
    for k in range(stages):
        # A stage's residuals bear on its own unknowns and on those of the next stage.
        weights = 10.0 ** rng.uniform(-decades / 2, decades / 2, 2 * n)
        factor = rng.standard_normal((2 * n, 2 * n))
        block = (factor.T * weights) @ factor + 0.5 * np.diag(weights)
        if k + 1 == stages:
            block[n:], block[:, n:] = 0.0, 0.0
        qp.band[k] += band_of(block[:, :n])
        if k + 1 < stages:
            qp.band[k + 1] += band_of(block[n:, n:])
    qp.gradient[...] = push * rng.standard_normal((stages, n))
    qp.row_own[...], qp.row_next[...] = rng.standard_normal((2, stages, rows, n))
    inside = around * rng.standard_normal((stages, n))
    qp.bounded = bounds != "none"
    if qp.bounded:
        qp.lower[...] = inside - rng.uniform(0.05, 0.5, (stages, n))
        qp.upper[...] = inside + rng.uniform(0.05, 0.5, (stages, n))
        if bounds == "part":
            qp.lower[rng.random((stages, n)) < 0.5] = -np.inf
            qp.upper[rng.random((stages, n)) < 0.5] = np.inf
    if sides != "none":
        value = qp.rows_times(inside)
        qp.row_lower[...] = value - rng.uniform(0.05, 0.5, value.shape)
        qp.row_upper[...] = value + rng.uniform(0.05, 0.5, value.shape)
        kind = np.arange(value.size).reshape(value.shape) % 4
        equal = kind == 0 if sides == "mixed" else np.full(value.shape, sides == "equal")
        qp.row_lower[equal] = qp.row_upper[equal] = value[equal]
        if sides == "mixed":
            qp.row_lower[kind == 1], qp.row_upper[kind == 2] = -np.inf, np.inf
    return qp


def contradiction(stages: int = 6, n: int = 2) -> QP:
    """Make an infeasible QP: two rows require the same sum above 5 and below -5."""
    qp = sample(stages, n, 2, sides="two")
    middle = stages // 2
    qp.row_own[middle], qp.row_next[middle] = 1.0, 0.0
    qp.row_lower[middle], qp.row_upper[middle] = [5.0, -6.0], [6.0, -5.0]
    return qp
