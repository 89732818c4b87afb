import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qpmhe_solvers import QP, SolverOptions, SolveStatus, create

from .problems import make, numbers, overwrite

SIZES = [(1, 1), (1, 4), (2, 1), (9, 1), (2, 2), (11, 2), (6, 5)]


def minimiser(dense):
    return np.linalg.solve(dense.hessian, -dense.gradient)


@pytest.mark.parametrize("decades", [0.0, 4.0])
@pytest.mark.parametrize(("stages", "n"), SIZES)
def test_equals_a_dense_solve(stages, n, decades):
    qp, dense = make(stages, n, decades=decades)
    solution = create("banded").solve(qp)
    assert solution.status is SolveStatus.SOLVED
    assert solution.d.shape == (stages, n)
    np.testing.assert_allclose(solution.d.ravel(), minimiser(dense), rtol=1e-9, atol=1e-9)


@given(
    stages=st.integers(1, 8), n=st.integers(1, 4), decades=st.sampled_from([0.0, 2.0, 4.0]),
    seed=st.integers(0, 10**6),
)
@settings(max_examples=80, derandomize=True, deadline=None)
def test_minimises_any_unconstrained_qp(stages, n, decades, seed):
    qp, dense = make(stages, n, decades=decades, seed=seed)
    solution = create("banded").solve(qp)
    assert solution.status is SolveStatus.SOLVED
    force = dense.hessian @ solution.d.ravel() + dense.gradient
    scale = np.abs(dense.hessian).max() * np.abs(solution.d).max() + np.abs(dense.gradient).max()
    assert np.abs(force).max() <= 1e-12 * scale


@pytest.mark.parametrize("inequality", ["bounds", "rows"])
def test_solved_where_no_inequality_binds(inequality):
    qp, dense = make(5, 2, 1)
    wide = 10.0 + np.abs(minimiser(dense)).max() * 100.0
    if inequality == "bounds":
        qp.bounded = True
        qp.lower[...], qp.upper[...] = -wide, wide
    else:
        qp.row_lower[...], qp.row_upper[...] = -wide, wide
    solution = create("banded").solve(qp)
    assert solution.status is SolveStatus.SOLVED
    np.testing.assert_allclose(solution.d.ravel(), minimiser(dense), rtol=1e-9, atol=1e-9)
    assert not solution.bound_duals.any()
    assert not solution.row_duals.any()


@pytest.mark.parametrize("side", ["lower", "upper", "row_lower", "row_upper"])
def test_unconstrained_where_one_inequality_is_violated(side):
    qp, dense = make(5, 2, 1)
    x = minimiser(dense)
    qp.bounded = True
    value = dense.matrix @ x if side.startswith("row") else x
    sign = 1.0 if side.endswith("lower") else -1.0
    getattr(qp, side).flat[3] = value[3] + 0.5 * sign
    solution = create("banded").solve(qp)
    assert solution.status is SolveStatus.UNCONSTRAINED
    assert solution.status.usable
    np.testing.assert_allclose(solution.d.ravel(), x, rtol=1e-9, atol=1e-9)
    assert solution.residuals.primal == pytest.approx(0.5, abs=1e-9)
    assert solution.residuals.dual < 1e-9
    assert solution.residuals.gap < 1e-9


def test_solved_on_the_edge():
    qp, _ = make(4, 2)
    d = create("banded").solve(qp).d
    qp.bounded = True
    qp.lower[...] = qp.upper[...] = d
    assert create("banded").solve(qp).status is SolveStatus.SOLVED
    qp.upper[2, 1] = np.nextafter(d[2, 1], -np.inf)
    assert create("banded").solve(qp).status is SolveStatus.UNCONSTRAINED


@pytest.mark.parametrize("stage", [0, 2, 4])
@pytest.mark.parametrize("kind", ["negative", "zero", "indefinite"])
def test_fails_where_the_hessian_is_not_positive_definite(kind, stage):
    qp, _ = make(5, 2)
    qp.band[...] = 0.0
    qp.band[:, :, 0] = 1.0
    if kind == "indefinite":
        qp.band[stage, 0, 1] = 2.0  # [[1, 2], [2, 1]]
    else:
        qp.band[stage, 1, 0] = -1.0 if kind == "negative" else 0.0
    solution = create("banded").solve(qp)
    assert solution.status is SolveStatus.FAILED
    assert not solution.status.usable
    assert solution.d is None
    assert "H is not positive definite" in solution.message


def test_recovers_from_a_failure():
    qp, dense = make(5, 2)
    solver = create("banded")
    qp.band[2, 0, 0] *= -1.0
    assert solver.solve(qp).status is SolveStatus.FAILED
    qp.band[2, 0, 0] *= -1.0
    np.testing.assert_allclose(solver.solve(qp).d.ravel(), minimiser(dense), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("stage", [0, 4])
@pytest.mark.parametrize("name", ["band", "gradient"])
def test_fails_on_numbers_that_are_not_finite(name, stage, value):
    qp, _ = make(5, 2)
    getattr(qp, name)[stage].flat[0] = value
    solution = create("banded").solve(qp)
    assert solution.status is SolveStatus.FAILED
    assert solution.d is None


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("lower", "lower"), ("upper", "upper"), ("row_lower", "row_lower"),
        ("row_upper", "row_upper"), ("row_own", "row_upper"), ("row_next", "row_lower"),
    ],
)
@pytest.mark.parametrize("backend", ["banded", "auto"])
def test_nan_does_not_hide_a_violation(backend, name, side):
    qp, dense = make(5, 2, 1)
    x = minimiser(dense)
    qp.bounded = True
    value = (dense.matrix @ x if side.startswith("row") else x)[0]
    getattr(qp, side).flat[0] = value + (1.0 if side.endswith("lower") else -1.0)
    getattr(qp, name)[3].flat[0] = np.nan
    assert create(backend).solve(qp).status is not SolveStatus.SOLVED


@pytest.mark.parametrize("sides", ["none", "two"])
def test_does_not_modify_the_qp(sides):
    qp, _ = make(5, 2, 1, bounds="part", sides=sides)
    before = numbers(qp)
    create("banded").solve(qp, np.ones((5, 2)))
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(qp, name), array)


def test_one_solver_serves_all_sizes_and_changes():
    solver = create("banded")
    for seed in range(3):
        for stages, n in SIZES:
            qp, dense = make(stages, n, seed=seed)
            d = solver.solve(qp).d
            np.testing.assert_allclose(d.ravel(), minimiser(dense), rtol=1e-8, atol=1e-8)
            other, dense = make(stages, n, seed=seed + 100)
            overwrite(qp, other)
            changed = solver.solve(qp).d
            np.testing.assert_array_equal(changed, create("banded").solve(other).d)


def test_options_and_start_change_nothing():
    qp, _ = make(5, 2)
    plain = create("banded").solve(qp)
    options = SolverOptions(max_iterations=1, absolute_tolerance=1e-1, warm_start=False)
    optioned = create("banded", options).solve(qp, np.ones((5, 2)))
    np.testing.assert_array_equal(plain.d, optioned.d)
    assert plain.iterations == optioned.iterations == 0


def test_the_start_is_not_needed_to_solve_without_a_gradient():
    qp = QP(3, 2)
    qp.band[:, :, 0] = 1.0
    np.testing.assert_array_equal(create("banded").solve(qp).d, np.zeros((3, 2)))
