"""A QP in the form that a solver takes, by plain rules, and its multipliers on the way back."""

import copy
import itertools
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse

from qpmhe_solvers import QP
from qpmhe_solvers.dispatch import DispatchSolver, qpsolvers_arguments
from qpmhe_solvers.layout import Layout, Structure, Style
from qpmhe_solvers.qp import ARRAYS, Places

from .problems import CASES, make

STYLES = {
    "osqp": Style("csc", triangle="upper", bounds="rows", equalities="among"),
    "clarabel": Style(
        "csc", triangle="upper", bounds="rows", equalities="among", sides=1, infinite=False
    ),
    "piqp": Style("csc", triangle="upper", infinite=False),
    "proxqp": Style("dense"),
    "daqp": Style("dense", equalities="among"),
    "proxqp_sparse": Style("csc", bounds="rows"),
    # In the form of qpsolvers.
    **{
        f"qpsolvers {matrices} {bounds} {needs_row}": Style(
            matrices, bounds=bounds, sides=1, needs_row=needs_row
        )
        for matrices, bounds, needs_row in itertools.product(
            ("dense", "csc"), ("box", "rows"), (False, True)
        )
    },
}
styles = pytest.mark.parametrize("name", STYLES)
cases = pytest.mark.parametrize("case", CASES)


def laid_out(name, qp):
    exact = name.startswith("qpsolvers")
    layout = Layout(STYLES[name], Structure.of(qp, exact=exact), *qp.sizes)
    layout.fill(qp, None if exact else layout.voids(qp))
    return layout


def full(matrix):
    return matrix.toarray() if scipy.sparse.issparse(matrix) else matrix


def limits(layout, dense):
    """The tightest limits that the layout puts on each constraint, checking every row."""
    low, high = np.full((2, layout.count), [[-np.inf], [np.inf]])

    def impose(row, lower, upper, constraint, sign=1.0):
        if not row.any():  # void, which some solvers need: 0 lies between its limits
            assert lower <= 0.0 <= upper
            return
        np.testing.assert_array_equal(row, sign * dense.normals[constraint])
        if sign < 0:
            lower, upper = -upper, -lower
        low[constraint] = max(low[constraint], lower)
        high[constraint] = min(high[constraint], upper)

    one_sided, among = layout.style.sides == 1, layout.style.equalities == "among"
    equal = np.count_nonzero(layout.structure.equal) if among else 0
    for k, row in enumerate(full(layout.matrix)):
        upper = layout.upper[k]
        lower = upper if k < equal else -np.inf
        if not one_sided:
            lower = layout.lower[k]
        impose(row, lower, upper, layout.constraints[k], layout.signs[k])
    for row, level, constraint in zip(
        full(layout.equality_matrix), layout.level, layout.equalities, strict=True
    ):
        impose(row, level, level, constraint)
    if layout.boxed:
        low[: layout.size] = np.maximum(low[: layout.size], layout.box_lower)
        high[: layout.size] = np.minimum(high[: layout.size], layout.box_upper)
    return low, high


def parts(layout):
    """Every array of a layout, those inside of matrices too."""
    for name in ("hessian", "gradient", "matrix", "equality_matrix", "all_lower", "all_upper"):
        one = getattr(layout, name)
        inside = ("data", "indices", "indptr") if scipy.sparse.issparse(one) else ()
        yield from ((f"{name} {part}", getattr(one, part)) for part in inside)
        if one is not None and not inside:
            yield name, one


@styles
@cases
def test_a_layout_says_what_the_qp_says(case, name):
    for seed in range(2):
        qp, dense = make(**CASES[case], seed=seed)
        layout = laid_out(name, qp)
        hessian = full(layout.hessian)
        if STYLES[name].triangle == "upper":
            hessian = hessian + np.triu(hessian, 1).T
        np.testing.assert_array_equal(hessian, dense.hessian)
        np.testing.assert_array_equal(layout.gradient, dense.gradient)
        for found, wanted in zip(limits(layout, dense), (dense.low, dense.high), strict=True):
            np.testing.assert_array_equal(found, wanted)
        apart = np.count_nonzero(layout.structure.equal) * (STYLES[name].equalities == "apart")
        assert layout.equalities.size == apart
        if STYLES[name].sides == 1 and name.startswith("qpsolvers"):
            assert np.isfinite(layout.upper).all()


@styles
@cases
def test_filling_again_is_making_anew(case, name):
    qp, _ = make(**CASES[case], seed=0)
    other, _ = make(**CASES[case], seed=1)
    for limit in ARRAYS[2:4] + ARRAYS[6:]:  # the same pattern, other numbers
        getattr(other, limit)[...] = 3.0 * getattr(qp, limit)
    layout, anew = laid_out(name, qp), dict(parts(laid_out(name, other)))
    before = dict(parts(layout))
    layout.fill(other, None if name.startswith("qpsolvers") else layout.voids(other))
    for part, array in parts(layout):
        assert array is before[part]
        np.testing.assert_array_equal(array, anew[part], err_msg=part)
        assert not np.shares_memory(array, anew[part])
        assert not np.shares_memory(array, qp.numbers)
        assert array.flags.writeable
        assert array.flags.c_contiguous
        assert array.dtype == (np.int32 if part.endswith(("indices", "indptr")) else np.float64)
    for matrix in (layout.hessian, layout.matrix, layout.equality_matrix):
        if scipy.sparse.issparse(matrix):
            assert type(matrix) is scipy.sparse.csc_matrix
            assert matrix.has_sorted_indices
            assert matrix.has_canonical_format


@pytest.mark.parametrize("name", list(STYLES)[:6])
def test_a_layout_has_room_for_missing_measurements(name):
    qp, _ = make(7, 3, 2, bounds="part", sides="two")
    layout = laid_out(name, qp)
    for stage in range(6):
        other, dense = make(7, 3, 2, bounds="part", sides="two")
        other.row_lower[stage, 1], other.row_upper[stage, 1] = -np.inf, np.inf
        dense.low[21:], dense.high[21:] = other.row_lower.ravel(), other.row_upper.ravel()
        assert Structure.of(other).key == Structure.of(qp).key
        for source in (other, qp, other):  # nothing is left of the one before
            layout.fill(source, layout.voids(source))
        low, high = limits(layout, dense)
        np.testing.assert_array_equal(low[21:], dense.low[21:])
        np.testing.assert_array_equal(high[21:], dense.high[21:])


@styles
@cases
def test_multipliers_go_back_to_their_constraints(case, name):
    qp, _ = make(**CASES[case])
    layout, rng = laid_out(name, qp), np.random.default_rng(0)
    rows = rng.standard_normal(len(full(layout.matrix)))
    equal = rng.standard_normal(layout.equalities.size)
    box = rng.standard_normal(qp.size) if layout.boxed else None
    wanted = np.zeros(layout.count + 1)  # the last is that of a void row
    for value, constraint, sign in zip(rows, layout.constraints, layout.signs, strict=True):
        wanted[constraint] += sign * value
    wanted[layout.equalities] += equal
    wanted[: qp.size] += 0.0 if box is None else box
    for _ in range(2):  # nothing is left over from the first time
        np.testing.assert_array_equal(layout.duals(rows, equal, box), wanted[:-1])


@pytest.mark.parametrize("keep_empty", [False, True])
def test_the_arguments_of_qpsolvers(keep_empty):
    for name in (one for one in STYLES if one.startswith("qpsolvers")):
        for case in CASES.values():
            layout = laid_out(name, make(**case)[0])
            given = qpsolvers_arguments(layout, keep_empty)
            own = (
                layout.hessian, layout.gradient, layout.matrix, layout.upper,
                layout.equality_matrix, layout.level, layout.box_lower, layout.box_upper,
            )
            kept = [True, True] + 2 * [keep_empty or layout.upper.size > 0]
            kept += 2 * [keep_empty or layout.level.size > 0] + 2 * [layout.boxed]
            for one, other, is_kept in zip(given, own, kept, strict=True):
                assert one is (other if is_kept else None)


@pytest.mark.parametrize("missing", ["z", "y", "z_box"])
def test_missing_multipliers_are_not_made_up(missing):
    layout = laid_out("qpsolvers dense box False", make(**CASES["all kinds"])[0])
    arguments = qpsolvers_arguments(layout, False)
    usual = {
        "z": np.ones(len(arguments[3])), "y": np.ones(len(arguments[5])),
        "z_box": np.ones(layout.size),
    }
    for value in (usual[missing], None, np.zeros(1)):
        solver = object.__new__(DispatchSolver)
        solver.name, solver._keywords = "", {}
        solver._translation = SimpleNamespace(start=False)
        answer = SimpleNamespace(x=None, found=True, extras={}, **usual | {missing: value})
        solver._solve_problem = lambda *_, answer=answer, **__: answer
        found = solver._run(None, layout, None, None).duals
        assert (found is None) == (value is not usual[missing])


def test_the_pattern_is_that_of_limits_and_sizes_only():
    def key(qp):
        return *qp.sizes, Structure.of(qp, exact=True).key

    qp, seen = QP(2, 1, 1), [key(QP(1, 2, 1)), key(QP(2, 1, 1))]
    for name, value in (
        ("lower", 0.0), ("upper", 0.0), ("row_lower", 1.0), ("row_upper", 2.0), ("row_upper", 1.0),
    ):
        getattr(qp, name)[1, 0] = value
        seen.append(key(qp))
    assert len(set(seen)) == len(seen)
    for name in ARRAYS:
        getattr(qp, name)[...] += 0.5
    assert key(qp) == seen[-1]


def test_all_numbers_of_a_qp_are_in_one_array():
    qp, _ = make(**CASES["all kinds"])
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
