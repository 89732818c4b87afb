"""A QP's views and products are those of one matrix; its sizes, data and options are validated."""

import copy
import dataclasses
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qpmhe_solvers import QP, InvalidInputError, OptionError, QpmheError, ShapeError, SolverOptions
from qpmhe_solvers.qp import ARRAYS

from .problems import make

# stages, n, rows
SIZES = [(1, 1, 0), (1, 1, 1), (1, 3, 2), (2, 1, 2), (2, 2, 1), (6, 1, 1), (4, 2, 0), (3, 5, 2)]


def check(qp, dense, seed):
    banded = np.zeros((qp.size, qp.size))
    for offset, column in np.ndindex(qp.lapack_band.shape):
        if column + offset < qp.size:
            banded[column + offset, column] = qp.lapack_band[offset, column]
            banded[column, column + offset] = qp.lapack_band[offset, column]
    for hessian in (banded, qp.dense(), qp.csc().toarray()):
        np.testing.assert_array_equal(hessian, dense.hessian)
    for matrix in (qp.csc_rows().toarray(), qp.dense_rows()):
        np.testing.assert_array_equal(matrix, dense.matrix)
    for matrix in (qp.csc(), qp.csc_rows()):
        assert matrix.has_canonical_format
        matrix.data[...], matrix.indices[...] = 0, 0  # what a solver that works in place might do
    rng = np.random.default_rng(seed)
    d, y = rng.standard_normal((qp.stages, qp.n)), rng.standard_normal((qp.stages, qp.rows))
    for found, wanted in (
        (qp.hessian_times(d), (dense.hessian @ d.ravel()).reshape(d.shape)),
        (qp.rows_times(d), (dense.matrix @ d.ravel()).reshape(y.shape)),
        (qp.rows_transposed_times(y), (dense.matrix.T @ y.ravel()).reshape(d.shape)),
        (qp.objective(d), dense.objective(d)), (qp.violation(d), dense.violation(d)),
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(qp.limits, np.append(dense.low, dense.high))


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
    # What is beyond the last stage is never read.
    for column in range(qp.n):
        qp.band[-1, column, qp.n - column :] = 1e9
    qp.row_next[-1] = 1e9
    check(qp, dense, seed)
    twins = qp.copy(), pickle.loads(pickle.dumps(qp)), copy.deepcopy(qp)
    # Views follow changed numbers.
    other, new = make(*size, seed=seed + 1, bounds=bounds, sides=sides)
    qp.numbers[...], qp.bounded = other.numbers, other.bounded
    check(qp, new, seed)
    for twin in twins:
        assert (twin.sizes, twin.bounded) == (qp.sizes, bounds != "none")
        check(twin, dense, seed)


def test_limits_that_are_missed_crossed_or_not_finite():
    for name, at, value, missed in (
        ("lower", 2, 0.25, 0.25), ("row_upper", 2, -2.0, 2.0),
    ):
        qp, d = QP(3, 2, 1), np.zeros((3, 2))
        assert (qp.violation(d + 1e6), qp.bounded, qp.size) == (0.0, True, 6)
        getattr(qp, name).flat[at] = value
        assert qp.violation(d) == missed
        assert not qp.violation(d * np.nan) <= 0.0
    for name in ARRAYS:
        for value in (np.nan, np.inf):
            qp, _ = make(3, 2, 1)
            getattr(qp, name)[1].flat[-1] = value
            assert qp.finite() is (value == np.inf and "er" in name)
    for name, value, words in (
        ("gradient", 1e200, ""), ("gradient", np.inf, "not finite"),  # squares overflow
        ("row_upper", np.nan, "not finite"), ("row_upper", -np.inf, ""),
        ("row_lower", np.inf, "a lower bound is above its upper bound"),
    ):
        qp = QP(2, 2, 1)
        qp.row_upper[0] = 0.0
        getattr(qp, name)[0] = value
        with np.errstate(all="ignore"):
            assert words in qp.fault()
            assert bool(words) == bool(qp.fault())


def test_sizes_out_of_range():
    for arguments, message in [
        ((0, 1), "stages is 0; a QP needs an integer stages >= 1"), ((1, "3"), "n is '?3"),
        ((1, 1, -1), "rows is -1; a QP needs an integer rows >= 0"),
    ]:
        with pytest.raises(ShapeError, match=message):
            QP(*arguments)


# Of each option: its default, values in range and out of it, and what a message expects.
ABOVE = "expected a finite number > 0"
OPTIONS = {
    "max_iterations": (
        None, [1, 10**9], [0, 2.0, math.inf, "5", True], r"expected an integer >= 1 or None.*qps=0"
    ),
    "absolute_tolerance": (1e-7, [1, np.float64(1e-12)], [0.0, math.nan, None, "1e-6"], ABOVE),
    "relative_tolerance": (0.0, [0, 0.5], [-1e-9, math.inf], "expected a finite number >= 0"),
    "time_limit": (None, [1e-9, 3600], [0, -1.0, math.inf, True], ABOVE),
    "warm_start": (True, [False], [1, None, "yes"], "expected True or False"),
}


def test_options_are_validated():
    options = SolverOptions()
    assert set(OPTIONS) == {field.name for field in dataclasses.fields(options)}
    for name, (default, good, bad, expectation) in OPTIONS.items():
        assert getattr(options, name) == default
        with pytest.raises(dataclasses.FrozenInstanceError, match=name):
            setattr(options, name, default)
        for value in good:
            assert getattr(SolverOptions(**{name: value}), name) == value
        for value in bad:
            with pytest.raises(OptionError, match=f"^{name} is {value!r}; {expectation}") as caught:
                dataclasses.replace(options, **{name: value})
            for kind in (InvalidInputError, QpmheError, ValueError):
                assert isinstance(caught.value, kind)
    with pytest.raises(TypeError, match="max_iter"):
        SolverOptions(max_iter=3)
