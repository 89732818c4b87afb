import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import qpmhe
from qpmhe_solvers import (
    QP,
    Backend,
    InvalidInputError,
    RawSolution,
    ShapeError,
    Solver,
    SolverOptions,
    SolveStatus,
    backend,
    band_index,
    create,
)

from .problems import ARRAYS, EVERY, make, registered

# stages, n, rows
SIZES = [
    (1, 1, 0), (1, 1, 1), (1, 3, 0), (1, 3, 2), (2, 1, 0), (2, 1, 2), (2, 2, 1),
    (6, 1, 1), (4, 2, 0), (4, 2, 3), (5, 3, 1), (3, 5, 2),
]
sizes = pytest.mark.parametrize(("stages", "n", "rows"), SIZES)


def check_views(qp, dense):
    size = qp.size
    banded = np.zeros((size, size))
    for column in range(size):
        for offset in range(2 * qp.n):
            if column + offset < size:
                banded[column + offset, column] = qp.lapack_band[offset, column]
                banded[column, column + offset] = qp.lapack_band[offset, column]
    np.testing.assert_array_equal(banded, dense.hessian)
    np.testing.assert_array_equal(qp.dense(), dense.hessian)
    np.testing.assert_array_equal(qp.csc().toarray(), dense.hessian)
    assert qp.csc_rows().shape == dense.matrix.shape
    np.testing.assert_array_equal(qp.csc_rows().toarray(), dense.matrix)
    np.testing.assert_array_equal(qp.dense_rows(), dense.matrix)


def check_products(qp, dense, rng):
    d = rng.standard_normal((qp.stages, qp.n))
    y = rng.standard_normal((qp.stages, qp.rows))
    close = {"rtol": 1e-12, "atol": 1e-12}
    assert qp.hessian_times(d).shape == d.shape
    np.testing.assert_allclose(qp.hessian_times(d).ravel(), dense.hessian @ d.ravel(), **close)
    assert qp.rows_times(d).shape == y.shape
    np.testing.assert_allclose(qp.rows_times(d).ravel(), dense.matrix @ d.ravel(), **close)
    assert qp.rows_transposed_times(y).shape == d.shape
    np.testing.assert_allclose(
        qp.rows_transposed_times(y).ravel(), dense.matrix.T @ y.ravel(), **close
    )
    assert qp.objective(d) == pytest.approx(dense.objective(d), rel=1e-12, abs=1e-12)
    assert qp.violation(d) == pytest.approx(dense.violation(d), rel=1e-12, abs=1e-12)


@sizes
def test_views_are_one_matrix(stages, n, rows):
    check_views(*make(stages, n, rows, seed=1))


@sizes
@pytest.mark.parametrize("sides", ["none", "mixed"])
@pytest.mark.parametrize("bounds", ["none", "part"])
def test_products_equal_dense(stages, n, rows, bounds, sides):
    qp, dense = make(stages, n, rows, seed=2, bounds=bounds, sides=sides)
    check_products(qp, dense, np.random.default_rng(3))


@given(
    stages=st.integers(1, 6), n=st.integers(1, 4), rows=st.integers(0, 3),
    bounds=st.sampled_from(["none", "all", "part", "fixed"]),
    sides=st.sampled_from(["none", "two", "one", "equal", "mixed"]), seed=st.integers(0, 10**6),
)
@settings(max_examples=60, derandomize=True, deadline=None)
def test_any_qp_equals_its_dense_twin(stages, n, rows, bounds, sides, seed):
    qp, dense = make(stages, n, rows, seed=seed, bounds=bounds, sides=sides)
    check_views(qp, dense)
    check_products(qp, dense, np.random.default_rng(seed))


@sizes
def test_csc_indices_are_sorted_and_own(stages, n, rows):
    qp, dense = make(stages, n, rows, seed=4)
    for view, full in ((qp.csc, dense.hessian), (qp.csc_rows, dense.matrix)):
        first, second = view(), view()
        for column in range(qp.size):
            indices = first.indices[first.indptr[column] : first.indptr[column + 1]]
            assert (np.diff(indices) > 0).all()
        for part in ("data", "indices", "indptr"):
            mine, other = getattr(first, part), getattr(second, part)
            assert not np.shares_memory(mine, other)
            assert not any(np.shares_memory(mine, getattr(qp, name)) for name in ARRAYS)
            mine[...] = 0  # what a solver that works in place might do
        np.testing.assert_array_equal(view().toarray(), full)


def test_csc_pattern_does_not_depend_on_the_numbers():
    qp, _ = make(4, 2, 1, seed=5)
    for view, empty in ((qp.csc(), QP(4, 2, 1).csc()), (qp.csc_rows(), QP(4, 2, 1).csc_rows())):
        np.testing.assert_array_equal(view.indices, empty.indices)
        np.testing.assert_array_equal(view.indptr, empty.indptr)


def test_views_follow_changed_numbers():
    qp, _ = make(4, 2, 1, seed=6)
    qp.dense(), qp.csc(), qp.csc_rows(), qp.dense_rows()
    other, dense = make(4, 2, 1, seed=7)
    qp.band[...], qp.row_own[...], qp.row_next[...] = other.band, other.row_own, other.row_next
    check_views(qp, dense)


def test_lapack_band_is_a_view():
    qp, _ = make(3, 2)
    assert qp.lapack_band.shape == (4, 6)
    assert qp.lapack_band.flags.f_contiguous
    assert np.shares_memory(qp.lapack_band, qp.band)


@sizes
def test_entries_beyond_the_last_stage_are_never_read(stages, n, rows):
    qp, dense = make(stages, n, rows, seed=8, sides="two")
    for column in range(n):
        qp.band[-1, column, n - column :] = 1e9
    qp.row_next[-1] = 1e9
    np.testing.assert_array_equal(qp.dense(), dense.hessian)
    np.testing.assert_array_equal(qp.csc().toarray(), dense.hessian)
    np.testing.assert_array_equal(qp.dense_rows(), dense.matrix)
    check_products(qp, dense, np.random.default_rng(9))


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_band_index_fills_a_panel(n):
    block = np.random.default_rng(n).standard_normal((2 * n, n))
    panel = np.take(np.append(block.ravel(), 0.0), band_index(n)).reshape(n, 2 * n)
    for column in range(n):
        for offset in range(2 * n):
            inside = column + offset < 2 * n
            assert panel[column, offset] == (block[column + offset, column] if inside else 0.0)


def test_a_new_qp_has_no_inequality_and_looks_for_some():
    qp = QP(3, 2, 1)
    assert (qp.stages, qp.n, qp.rows, qp.size, qp.bounded) == (3, 2, 1, 6, True)
    assert qp.band.shape == (3, 2, 4)
    assert qp.row_own.shape == qp.row_next.shape == (3, 1, 2)
    assert qp.finite()
    assert qp.violation(np.full((3, 2), 1e6)) == 0.0
    assert not np.shares_memory(qp.band, QP(3, 2, 1).band)


@pytest.mark.parametrize(
    ("name", "index", "value", "missed"),
    [
        ("lower", (1, 0), 0.25, 0.25),
        ("upper", (2, 1), -0.5, 0.5),
        ("row_lower", (0, 0), 1.5, 1.5),
        ("row_upper", (2, 0), -2.0, 2.0),
    ],
)
def test_violation_sees_every_side(name, index, value, missed):
    qp, _ = make(3, 2, 1, bounds="none")
    qp.bounded = True
    d = np.zeros((3, 2))
    assert qp.violation(d) == 0.0
    getattr(qp, name)[index] = value
    assert qp.violation(d) == missed


def test_violation_is_zero_on_the_edge():
    qp = QP(2, 2)
    d = np.array([[1.0, -2.0], [0.5, 3.0]])
    qp.lower[...] = qp.upper[...] = d
    assert qp.violation(d) == 0.0


@pytest.mark.parametrize("inequality", ["bounds", "rows"])
def test_violation_of_nan_is_not_zero(inequality):
    if inequality == "bounds":
        qp, _ = make(3, 2, bounds="all")
    else:
        qp, _ = make(3, 2, 1, sides="two")
    assert not qp.violation(np.full((3, 2), np.nan)) <= 0.0


@pytest.mark.parametrize("name", ARRAYS)
def test_finite_sees_nan_everywhere(name):
    qp, _ = make(3, 2, 1, bounds="part", sides="one")
    assert qp.finite()
    getattr(qp, name)[1].flat[-1] = np.nan
    assert not qp.finite()


@pytest.mark.parametrize("name", ARRAYS)
def test_finite_allows_infinity_in_bounds_only(name):
    qp, _ = make(3, 2, 1)
    getattr(qp, name)[0].flat[0] = np.inf
    assert qp.finite() is (name in ("lower", "upper", "row_lower", "row_upper"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1), "stages is 0; a QP needs an integer stages >= 1"),
        ((-3, 1), "stages is -3; a QP needs an integer stages >= 1"),
        ((1, 0), "n is 0; a QP needs an integer n >= 1"),
        ((1, 1, -1), "rows is -1; a QP needs an integer rows >= 0"),
    ],
)
def test_sizes_out_of_range(arguments, message):
    with pytest.raises(ShapeError, match=message) as caught:
        QP(*arguments)
    assert isinstance(caught.value, InvalidInputError)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((2.5, 1), r"stages is 2\.5"), ((1, "3"), "n is '?3"), ((1, 1, 0.5), r"rows is 0\.5")],
)
def test_sizes_that_are_not_integers(arguments, message):
    with pytest.raises(ShapeError, match=message):
        QP(*arguments)


def pushed():
    """Each unknown wants to be 5 and may be 1; nothing else is said of it."""
    qp = QP(3, 2)
    qp.band[:, :, 0], qp.gradient[...] = 1.0, -5.0
    qp.lower[...], qp.upper[...] = -1.0, 1.0
    return qp


@pytest.mark.parametrize("name", EVERY)
def test_bounds_that_are_filled_in_are_met(name):
    qp = pushed()
    solution = create(name, SolverOptions(absolute_tolerance=1e-9)).solve(qp)
    if not backend(name).inequalities:
        assert solution.status is SolveStatus.UNCONSTRAINED
        assert solution.residuals.primal == pytest.approx(4.0)
        return
    assert solution.status.usable
    np.testing.assert_allclose(solution.d, 1.0, atol=1e-4)


def test_a_copy_shares_nothing():
    qp, _ = make(3, 2, 1, bounds="all", sides="two")
    for bounded in (True, False):
        qp.bounded = bounded
        twin = qp.copy()
        for name in QP.__slots__:
            np.testing.assert_array_equal(getattr(twin, name), getattr(qp, name))
            assert type(getattr(twin, name)) is type(getattr(qp, name))
        for name in ARRAYS:
            assert not np.shares_memory(getattr(twin, name), getattr(qp, name))


@pytest.mark.parametrize("boxed", [False, True])
def test_the_estimator_promises_that_there_are_no_bounds_where_there_are_none(boxed):
    seen = []

    class Spy(Solver):
        def _solve(self, qp, start):
            seen.append(qp.bounded)
            return RawSolution(np.zeros(qp.size), False)

    box = {"states": qpmhe.Box([-1.0], [1.0])} if boxed else {}
    system = qpmhe.System(lambda x: 0.8 * x, lambda x: x, n=1, p=1, **box)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    with registered(Backend("spy", Spy, "looks")):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.8]), cost, horizon=3, initial_state=[0.5], backend="spy",
            max_qps=1,
        )
        for _ in range(5):
            mhe.update([0.4])
    assert seen == [boxed] * 5
