"""The banded factorisation: exact without inequalities, and honest where one is violated."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qpmhe_solvers import SolverOptions, SolveStatus, create
from qpmhe_solvers.qp import ARRAYS

from .problems import make, numbers, overwrite

SIZES = [(1, 1), (1, 4), (2, 1), (9, 1), (2, 2), (11, 2), (6, 5)]
FAILED, SOLVED = SolveStatus.FAILED, SolveStatus.SOLVED


def minimiser(dense):
    return np.linalg.solve(dense.hessian, -dense.gradient)


def solved(qp, start=None):
    return create("banded").solve(qp, start)


@given(
    stages=st.integers(1, 8), n=st.integers(1, 4), decades=st.sampled_from([0.0, 2.0, 4.0]),
    seed=st.integers(0, 10**6),
)
@settings(max_examples=80, derandomize=True, deadline=None)
def test_minimises_any_unconstrained_qp(stages, n, decades, seed):
    qp, dense = make(stages, n, decades=decades, seed=seed)
    solution = solved(qp)
    assert (solution.status, solution.d.shape) == (SOLVED, (stages, n))
    force = dense.hessian @ solution.d.ravel() + dense.gradient
    scale = np.abs(dense.hessian).max() * np.abs(solution.d).max() + np.abs(dense.gradient).max()
    assert np.abs(force).max() <= 1e-12 * scale


def test_one_solver_serves_all_sizes_and_changes():
    solver = create("banded")
    for seed in range(3):
        for stages, n in SIZES:
            qp, dense = make(stages, n, seed=seed)
            d = solver.solve(qp).d
            np.testing.assert_allclose(d.ravel(), minimiser(dense), rtol=1e-8, atol=1e-8)
            other, _ = make(stages, n, seed=seed + 100)
            overwrite(qp, other)
            np.testing.assert_array_equal(solver.solve(qp).d, solved(other).d)


@pytest.mark.parametrize("side", ["lower", "upper", "row_lower", "row_upper"])
def test_unconstrained_where_one_inequality_is_violated(side):
    qp, dense = make(5, 2, 1)
    x = minimiser(dense)
    wide, qp.bounded = 10.0 + np.abs(x).max() * 100.0, True
    qp.lower[...] = qp.row_lower[...] = -wide
    qp.upper[...] = qp.row_upper[...] = wide
    solution = solved(qp)
    assert solution.status is SOLVED
    assert not np.append(solution.bound_duals, solution.row_duals).any()
    value = dense.matrix @ x if side.startswith("row") else x
    sign = 1.0 if side.endswith("lower") else -1.0
    getattr(qp, side).flat[3] = value[3] + 0.5 * sign
    before = numbers(qp)
    solution = solved(qp)
    assert solution.status is SolveStatus.UNCONSTRAINED
    assert solution.status.usable
    np.testing.assert_allclose(solution.d.ravel(), x, rtol=1e-9, atol=1e-9)
    assert solution.residuals.primal == pytest.approx(0.5, abs=1e-9)
    assert max(solution.residuals.dual, solution.residuals.gap) < 1e-9
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(qp, name), array)


def test_solved_on_the_edge():
    qp, _ = make(4, 2)
    d = solved(qp).d
    qp.bounded = True
    qp.lower[...] = qp.upper[...] = d
    assert solved(qp).status is SOLVED
    qp.upper[2, 1] = np.nextafter(d[2, 1], -np.inf)
    assert solved(qp).status is SolveStatus.UNCONSTRAINED


@pytest.mark.parametrize("stage", [0, 2, 4])
def test_fails_where_the_hessian_is_not_positive_definite_and_recovers(stage):
    for place, value in (((1, 0), -1.0), ((1, 0), 0.0), ((0, 1), 2.0), ((0, 0), np.inf)):
        qp, solver = make(5, 2)[0], create("banded")
        qp.band[...] = 0.0
        qp.band[:, :, 0] = 1.0
        usual = qp.band[stage][place]
        qp.band[stage][place] = value
        solution = solver.solve(qp)
        assert (solution.status, solution.d) == (FAILED, None)
        words = "H is not positive definite" if np.isfinite(value) else ""
        assert words in solution.message
        qp.band[stage][place] = usual
        np.testing.assert_array_equal(solver.solve(qp).d, -qp.gradient)


@pytest.mark.parametrize("name", ARRAYS[2:])
@pytest.mark.parametrize("backend", ["banded", "auto"])
def test_nan_does_not_hide_a_violation(backend, name):
    qp, dense = make(5, 2, 1)
    qp.bounded = True
    side = {"row_own": "row_upper", "row_next": "row_lower"}.get(name, name)
    value = (dense.matrix if side.startswith("row") else np.eye(10))[0] @ minimiser(dense)
    getattr(qp, side).flat[0] = value + (1.0 if side.endswith("lower") else -1.0)
    getattr(qp, name)[3].flat[0] = np.nan
    assert create(backend).solve(qp).status is not SOLVED


def test_options_and_start_change_nothing():
    qp, _ = make(5, 2)
    options = SolverOptions(max_iterations=1, absolute_tolerance=1e-1, warm_start=False)
    plain, optioned = solved(qp), create("banded", options).solve(qp, np.ones((5, 2)))
    np.testing.assert_array_equal(plain.d, optioned.d)
    assert plain.iterations == optioned.iterations == 0
