"""Limits that mean none, whatever their number, and bounds without width."""

import numpy as np
import pytest

from qpmhe_solvers import QP, SolveStatus, create

from .problems import CASES, TIGHT, WITH_INEQUALITIES, make

ACCURACY = {"scs": 1e-4, "ecos": 1e-4, "qpsolvers:piqp": 1e-4, "qpsolvers:proxqp": 1e-4}
EXACT = [one for one in ("auto", "daqp", "quadprog") if one in WITH_INEQUALITIES]


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
@pytest.mark.parametrize("far", [1e10, 1e12, 1e20, 1e300])
def test_a_far_limit_is_none(name, far):
    """The minimiser is that of dense equations without the limits that are far."""
    qp, dense = make(**CASES["all kinds"])
    best = dense.minimiser().reshape(qp.stages, qp.n)
    qp.limits[np.isneginf(qp.limits)] = -far
    qp.limits[np.isposinf(qp.limits)] = far
    qp.bounded = True
    solution = create(name, TIGHT).solve(qp)
    assert solution.status is SolveStatus.SOLVED or name == "ecos", solution.message
    accuracy = ACCURACY.get(name, 1e-5) * max(1.0, np.abs(best).max())
    np.testing.assert_allclose(solution.d, best, rtol=0, atol=accuracy)


@pytest.mark.parametrize("name", EXACT)
def test_a_far_limit_that_is_reached_counts(name):
    """Two unknowns whose sum is known a billion times worse than each beside the other."""
    qp, little = QP(1, 2, 0), 2.0**-31
    qp.band[0, :, 0], qp.band[0, 0, 1] = 1.0, little - 1.0
    qp.gradient[...], qp.lower[...], qp.bounded = 1.0, -1e9, True
    # Without the limit both would be -1 / little.
    solution = create(name, TIGHT).solve(qp)
    assert solution.status is SolveStatus.SOLVED
    np.testing.assert_allclose(solution.d, [[-1e9, -1e9]], rtol=1e-9)
    assert qp.violation(solution.d) <= 1e-7 * 1e9


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
def test_bounds_without_width_are_equations(name):
    """An unknown that is fixed at all stages, against the equations without it."""
    rng, stages, n = np.random.default_rng(3), 6, 3
    root = rng.standard_normal((stages * n, stages * n))
    qp = QP(stages, n, 0)
    full = np.zeros((stages * n, stages * n))
    for k in range(stages):  # block tridiagonal
        span = slice(k * n, min(k + 2, stages) * n)
        full[span, span] += root[span, span] @ root[span, span].T + np.eye(root[span].shape[0])
    for j in range(stages * n):
        below = full[j : min(j + 2 * n, stages * n), j]
        stage = j // n
        below = below[: (stage + 2) * n - j]
        qp.band[stage, j % n, : below.size] = below
    np.testing.assert_array_equal(qp.dense(), full)
    qp.gradient[...] = rng.standard_normal((stages, n))
    value = rng.standard_normal(stages)
    qp.lower[:, 2] = qp.upper[:, 2] = value
    qp.bounded = True
    fixed = np.arange(stages) * n + 2
    free = np.setdiff1d(np.arange(stages * n), fixed)
    best = np.zeros(stages * n)
    best[fixed] = value
    right = qp.gradient.ravel()[free] + full[np.ix_(free, fixed)] @ value
    best[free] = -np.linalg.solve(full[np.ix_(free, free)], right)
    solution = create(name, TIGHT).solve(qp)
    assert solution.status is SolveStatus.SOLVED or name == "ecos", solution.message
    np.testing.assert_allclose(solution.d.ravel(), best, atol=ACCURACY.get(name, 1e-5))
    push = full @ solution.d.ravel() + qp.gradient.ravel()
    if solution.bound_duals is not None:
        np.testing.assert_allclose(push + solution.bound_duals, 0.0, atol=1e-2)
