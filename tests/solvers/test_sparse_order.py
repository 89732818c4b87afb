"""The banded solver on H with sparse blocks, whose unknowns are ordered state by state."""

import numpy as np
import pytest

from qpmhe_solvers import QP, SolverOptions, SolveStatus
from qpmhe_solvers.banded import BandedSolver

rng = np.random.default_rng


def chain(n):
    return [(i, i + 1) for i in range(n - 1)]


def ring(n):
    return [*chain(n), (n - 1, 0)]


def grid(n):
    side = int(n**0.5)
    return [(i, i + 1) for i in range(n - 1) if (i + 1) % side] + [
        (i, i + side) for i in range(n - side)]


def matrix(edges, n, r):
    """A random one that couples neighbours."""
    A = np.diag(r.uniform(0.5, 1.0, n))
    for i, j in edges:
        A[i, j], A[j, i] = r.normal(0.0, 0.2, 2)
    return A


def problem(edges, n, stages, seed, prior=1.0, units=0.0):
    """The QP of a linear model with this graph; every other state is measured."""
    r = rng(seed)
    A, unit = matrix(edges, n, r), 10.0 ** r.uniform(-units, units, n)
    A *= unit[:, None] / unit
    Q = 1.0 / (0.1 * unit) ** 2
    R = np.where(np.arange(n) % 2 == 0, 1.0 / unit**2, 0.0)
    H = np.zeros((stages, n, stages, n))
    H[0, :, 0] += np.diag(1.0 / (prior * unit) ** 2)
    for k in range(stages):
        H[k, :, k] += np.diag(R)
        if k + 1 < stages:
            H[k, :, k] += A.T @ (Q[:, None] * A)
            H[k + 1, :, k + 1] += np.diag(Q)
            H[k + 1, :, k] -= Q[:, None] * A
            H[k, :, k + 1] -= (Q[:, None] * A).T
    H = H.reshape(stages * n, stages * n)
    qp = QP(stages, n)
    for k in range(stages):
        for c in range(n):
            column = k * n + c
            length = min(2 * n, qp.size - column)
            qp.band[k, c, :length] = H[column : column + length, column]
    qp.gradient = r.normal(size=(stages, n)) / unit
    qp.bounded = False
    return qp, H, np.tile(unit, stages)


def solved(solver, qp):
    solution = solver.solve(qp)
    assert solution.status is SolveStatus.SOLVED
    return solution.d.ravel()


def same(found, expected):
    assert np.abs(found - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.fixture
def by_stages(monkeypatch):
    """A solver that keeps the order by stages."""
    solver = BandedSolver(SolverOptions())
    monkeypatch.setattr(solver._sparse, "band", lambda qp, unit: None)
    return solver


@pytest.mark.parametrize("edges", [chain, ring, grid])
@pytest.mark.parametrize(("prior", "units"), [(1.0, 0.0), (1e10, 0.0), (1.0, 6.0), (1e-8, 3.0)])
def test_the_order_changes_no_solution(by_stages, edges, prior, units):
    stages, n = (4, 144) if edges is grid else (4, 81)
    qp, H, unit = problem(edges(n), n, stages, 1, prior, units)
    solver = BandedSolver(SolverOptions())
    found = solved(solver, qp) / unit
    assert solver._sparse.band(qp, 1.0) is not None
    # As exact as the other order: both against a solution whose residual was refined.
    scaled, side = H * unit * unit[:, None], -qp.gradient.ravel() * unit
    exact = np.linalg.solve(scaled, side)
    exact += np.linalg.solve(scaled, side - scaled @ exact)
    other = solved(by_stages, qp) / unit
    size = np.abs(exact).max()
    assert np.abs(found - exact).max() <= 10.0 * np.abs(other - exact).max() + 1e-12 * size


def test_a_pattern_that_grows_is_followed_and_a_full_one_is_left(by_stages):
    n, stages, solver = 60, 3, BandedSolver(SolverOptions())
    for count in (n - 1, n, n + 1):
        qp, _, _ = problem([*chain(n), (20, 29), (0, 5)][:count], n, stages, count)
        same(solved(solver, qp), solved(by_stages, qp))
        assert solver._sparse.band(qp, 1.0) is not None
    few, _, _ = problem(chain(n)[:20], n, stages, 7)  # a part of the pattern is in it
    same(solved(solver, few), solved(by_stages, few))
    full, _, _ = problem([(i, j) for i in range(n) for j in range(i)], n, stages, 8)
    full.band[:, :, 0] *= 30.0
    same(solved(solver, full), solved(by_stages, full))
    assert solver._sparse.band(full, 1.0) is None
    assert solver._sparse.band(few, 1.0) is None  # it is not searched for again
    small, _, _ = problem(chain(12), 12, stages, 9)  # another size
    same(solved(solver, small), solved(by_stages, small))


def test_a_pattern_that_grows_in_each_step_is_given_up(by_stages):
    n, stages, solver = 60, 3, BandedSolver(SolverOptions())
    for count in range(20):
        qp, _, _ = problem([*chain(n), *((i, i + 2) for i in range(count))], n, stages, count)
        same(solved(solver, qp), solved(by_stages, qp))
    assert solver._sparse.band(qp, 1.0) is None


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_matrix_without_a_factor_fails(value):
    qp, _, _ = problem(chain(60), 60, 3, 1)
    solver = BandedSolver(SolverOptions())
    solved(solver, qp)
    qp.band[1, 7, 0] = value
    assert solver.solve(qp).status is SolveStatus.FAILED
    qp.band[...] = value  # no entry at all, or each, also beyond H
    for one in (solver, BandedSolver(SolverOptions())):
        solution = one.solve(qp)
        assert solution.status is SolveStatus.FAILED
        assert solution.message.startswith("the factorisation failed")
