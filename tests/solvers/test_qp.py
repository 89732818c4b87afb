"""A QP's views and products are those of one matrix; its sizes, data and options are validated."""

import copy
import dataclasses
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import qpmhe
from qpmhe_solvers import (
    QP,
    Backend,
    InvalidInputError,
    OptionError,
    QpmheError,
    RawSolution,
    ShapeError,
    Solver,
    SolverOptions,
    band_index,
)
from qpmhe_solvers.qp import ARRAYS, Places

from .problems import make, overwrite, registered

# stages, n, rows
SIZES = [
    (1, 1, 0), (1, 1, 1), (1, 3, 0), (1, 3, 2), (2, 1, 0), (2, 1, 2), (2, 2, 1),
    (6, 1, 1), (4, 2, 0), (4, 2, 3), (5, 3, 1), (3, 5, 2),
]
sizes = pytest.mark.parametrize(("stages", "n", "rows"), SIZES)


def check(qp, dense, seed=3):
    banded = np.zeros((qp.size, qp.size))
    for offset, column in np.ndindex(qp.lapack_band.shape):
        if column + offset < qp.size:
            banded[column + offset, column] = qp.lapack_band[offset, column]
            banded[column, column + offset] = qp.lapack_band[offset, column]
    for hessian in (banded, qp.dense(), qp.csc().toarray()):
        np.testing.assert_array_equal(hessian, dense.hessian)
    for matrix in (qp.csc_rows().toarray(), qp.dense_rows()):
        np.testing.assert_array_equal(matrix, dense.matrix)
    rng = np.random.default_rng(seed)
    d, y = rng.standard_normal((qp.stages, qp.n)), rng.standard_normal((qp.stages, qp.rows))
    for found, wanted in (
        (qp.hessian_times(d), (dense.hessian @ d.ravel()).reshape(d.shape)),
        (qp.rows_times(d), (dense.matrix @ d.ravel()).reshape(y.shape)),
        (qp.rows_transposed_times(y), (dense.matrix.T @ y.ravel()).reshape(d.shape)),
        (qp.objective(d), dense.objective(d)), (qp.violation(d), dense.violation(d)),
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


@given(
    size=st.one_of(
        st.sampled_from(SIZES), st.tuples(st.integers(1, 6), st.integers(1, 4), st.integers(0, 3))
    ),
    bounds=st.sampled_from(["none", "all", "part", "fixed"]),
    sides=st.sampled_from(["none", "two", "one", "equal", "mixed"]), seed=st.integers(0, 10**6),
)
@settings(max_examples=100, derandomize=True, deadline=None)
def test_any_qp_equals_its_dense_twin(size, bounds, sides, seed):
    qp, dense = make(*size, seed=seed, bounds=bounds, sides=sides)
    check(qp, dense, seed)
    # What is beyond the last stage is never read.
    for column in range(qp.n):
        qp.band[-1, column, qp.n - column :] = 1e9
    qp.row_next[-1] = 1e9
    assert (qp.csc().toarray() == dense.hessian).all()
    assert (qp.dense_rows() == dense.matrix).all()
    np.testing.assert_array_equal(qp.dense(), dense.hessian)
    assert qp.violation(np.ones((qp.stages, qp.n))) < 1e6
    # Views follow changed numbers.
    other, dense = make(*size, seed=seed + 1, bounds=bounds, sides=sides)
    overwrite(qp, other)
    check(qp, dense, seed)


@sizes
def test_csc_indices_are_sorted_own_and_of_the_sizes_only(stages, n, rows):
    qp, dense = make(stages, n, rows, seed=4)
    empty = QP(stages, n, rows)
    for name, full in (("csc", dense.hessian), ("csc_rows", dense.matrix)):
        first, second, none = getattr(qp, name)(), getattr(qp, name)(), getattr(empty, name)()
        assert first.has_sorted_indices
        assert first.has_canonical_format
        for part in ("data", "indices", "indptr"):
            mine, other = getattr(first, part), getattr(second, part)
            assert part == "data" or (mine == getattr(none, part)).all()
            assert not np.shares_memory(mine, other)
            assert not np.shares_memory(mine, qp.numbers)
            mine[...] = 0  # what a solver that works in place might do
        np.testing.assert_array_equal(getattr(qp, name)().toarray(), full)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_band_index_fills_a_panel(n):
    block = np.random.default_rng(n).standard_normal((2 * n, n))
    panel = np.take(np.append(block.ravel(), 0.0), band_index(n)).reshape(n, 2 * n)
    for column, offset in np.ndindex(n, 2 * n):
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
    assert qp.lapack_band.flags.f_contiguous
    assert np.shares_memory(qp.lapack_band, qp.band)


def test_faults_of_huge_numbers_are_not_made_up():
    def fault(gradient=0.0, lower=-np.inf, upper=np.inf):
        qp = QP(2, 2, 1)
        qp.gradient[...], qp.row_lower[0], qp.row_upper[0] = gradient, lower, upper
        with np.errstate(all="ignore"):
            return qp.fault()

    assert fault(1e200) == ""  # whose squares overflow
    assert "not finite" in fault(np.inf)
    assert "not finite" in fault(upper=np.nan)
    assert fault(upper=-np.inf) == ""
    assert "a lower bound is above its upper bound" in fault(lower=0.0, upper=-np.inf)


def test_all_numbers_of_a_qp_are_in_one_array():
    qp, _ = make(7, 3, 2, bounds="part", sides="mixed")
    for one in (qp, qp.copy(), pickle.loads(pickle.dumps(qp)), copy.deepcopy(qp)):
        one.gradient = np.asfortranarray(one.gradient + 1.0)  # is written, not exchanged
        one.row_lower -= 0.5
        places = Places.of(*one.sizes)
        np.testing.assert_array_equal(one.all_lower, np.append(one.lower, one.row_lower))
        np.testing.assert_array_equal(one.all_upper, np.append(one.upper, one.row_upper))
        np.testing.assert_array_equal(one.limits, np.append(one.all_lower, one.all_upper))
        assert one.numbers[places.one] == 1.0
        for start, array in (
            (0, one.band), (places.gradient, one.gradient), (places.own, one.row_own),
            (places.own + one.row_own.size, one.row_next),
        ):
            np.testing.assert_array_equal(one.numbers[start : start + array.size], array.ravel())


@pytest.mark.parametrize(
    ("name", "index", "value", "missed"),
    [
        ("lower", (1, 0), 0.25, 0.25), ("upper", (2, 1), -0.5, 0.5),
        ("row_lower", (0, 0), 1.5, 1.5), ("row_upper", (2, 0), -2.0, 2.0),
    ],
)
def test_violation_sees_every_side(name, index, value, missed):
    qp, d = make(3, 2, 1)[0], np.zeros((3, 2))
    qp.bounded = True
    assert qp.violation(d) == 0.0
    getattr(qp, name)[index] = value
    assert qp.violation(d) == missed
    assert not qp.violation(d * np.nan) <= 0.0
    qp.lower[...], qp.upper[...] = d, d  # on the edge
    assert qp.violation(d) == (missed if name.startswith("row") else 0.0)


@pytest.mark.parametrize("name", ARRAYS)
def test_finite_sees_nan_everywhere_and_allows_infinite_limits(name):
    for value, allowed in ((np.nan, False), (np.inf, "er" in name)):
        qp, _ = make(3, 2, 1)
        assert qp.finite()
        getattr(qp, name)[1].flat[-1] = value
        assert qp.finite() is allowed


def test_sizes_out_of_range():
    for arguments, message in [
        ((0, 1), "stages is 0; a QP needs an integer stages >= 1"),
        ((1, -3), "n is -3; a QP needs an integer n >= 1"),
        ((1, 1, -1), "rows is -1; a QP needs an integer rows >= 0"),
        ((2.5, 1), r"stages is 2\.5"), ((1, "3"), "n is '?3"), ((1, 1, 0.5), r"rows is 0\.5"),
    ]:
        with pytest.raises(ShapeError, match=message) as caught:
            QP(*arguments)
        assert isinstance(caught.value, InvalidInputError)


@pytest.mark.parametrize("bounded", [True, False])
def test_a_copy_shares_nothing(bounded):
    qp, _ = make(3, 2, 1, bounds="all", sides="two")
    qp.bounded = bounded
    twin = qp.copy()
    for name in QP.__slots__:
        np.testing.assert_array_equal(getattr(twin, name), getattr(qp, name))
        assert type(getattr(twin, name)) is type(getattr(qp, name))
    assert not np.shares_memory(twin.numbers, qp.numbers)


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
        mhe.run(np.full(5, 0.4))
    assert seen == [boxed] * 5


# Of each option: its default, values in range and out of it, and what a message expects.
ABOVE = "expected a finite number > 0"
OPTIONS = {
    "max_iterations": (
        None, [1, 10**9], [0, -2, 2.0, math.inf, "5", True],
        r"expected an integer >= 1 or None.*max_qps=0",
    ),
    "absolute_tolerance": (
        1e-7, [1, np.float64(1e-12)], [0.0, -1e-9, math.nan, math.inf, None, "1e-6", True], ABOVE
    ),
    "relative_tolerance": (
        0.0, [0, 0.5], [-1e-9, math.nan, math.inf, None, False], "expected a finite number >= 0"
    ),
    "time_limit": (None, [1e-9, 3600], [0, -1.0, math.nan, math.inf, "1 s", True], ABOVE),
    "warm_start": (True, [False], [1, None, "yes"], "expected True or False"),
}


def test_options_are_validated():
    options = SolverOptions()
    assert set(OPTIONS) == {field.name for field in dataclasses.fields(options)}
    for name, (default, good, bad, expectation) in OPTIONS.items():
        check_option(options, name, default, good, bad, expectation)
    with pytest.raises(TypeError, match="max_iter"):
        SolverOptions(max_iter=3)


def check_option(options, name, default, good, bad, expectation):
    assert getattr(options, name) == default
    with pytest.raises(dataclasses.FrozenInstanceError, match=name):
        setattr(options, name, default)
    for value in good:
        assert getattr(SolverOptions(**{name: value}), name) == value
    for value in bad:
        with pytest.raises(OptionError, match=f"^{name} is {value!r}; {expectation}") as caught:
            dataclasses.replace(options, **{name: value})
        assert isinstance(caught.value, InvalidInputError)
        assert isinstance(caught.value, QpmheError)
        assert isinstance(caught.value, ValueError)
