from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse

from qpmhe_solvers import QP
from qpmhe_solvers.dispatch import DispatchSolver, qpsolvers_arguments
from qpmhe_solvers.layout import Layout, Structure, Style

from .problems import ARRAYS, CASES, make

LETTERS = ("P", "q", "G", "h", "A", "b", "lb", "ub")
forms = pytest.mark.parametrize(
    "how",
    [
        {"dense": dense, "box": box, "needs_row": needs_row, "keep_empty": keep_empty}
        for dense in (False, True) for box in (False, True)
        for needs_row, keep_empty in ((False, False), (True, False), (False, True))
    ],
    ids=lambda how: " ".join(key for key, value in how.items() if value) or "plain",
)


class Form:
    """A layout in the form of qpsolvers, as `DispatchSolver` uses it."""

    def __init__(self, qp, dense, box, needs_row, keep_empty):
        style = Style(
            "dense" if dense else "csc", bounds="box" if box else "rows", sides=1,
            needs_row=needs_row,
        )
        self.layout = Layout(style, Structure.of(qp, exact=True), *qp.sizes)
        self.arguments = qpsolvers_arguments(self.layout, keep_empty)

    def fill(self, qp):
        self.layout.fill(qp, None)

    def multipliers(self, **given):
        """Multipliers in an answer of qpsolvers, as the solver hands them on."""
        solver = object.__new__(DispatchSolver)
        solver.name, solver._keywords = "", {}
        solver._translation = SimpleNamespace(start=False)
        answer = SimpleNamespace(x=None, found=True, extras={}, **given)
        solver._solve_problem = lambda *_, **__: answer
        return solver._run(None, self.layout, None, None).duals


def key(qp):
    return qp.stages, qp.n, qp.rows, Structure.of(qp, exact=True).key


def expected(dense, box, needs_row, keep_empty):
    """P to ub by plain loops over the dense twin, and for each row of G and A its constraint."""
    size = dense.gradient.size
    sides = (
        (dense.matrix, dense.row_lower, dense.row_upper, size),
        (np.eye(size), dense.lower, dense.upper, 0),
    )
    rows, limits, origins = [], [], []
    for sign in (1.0, -1.0):
        for matrix, lower, upper, first in sides[:1] if box else sides[::-1]:
            side = upper if sign > 0 else lower
            for i, row in enumerate(matrix):
                if np.isfinite(side[i]) and (first == 0 or lower[i] != upper[i]):
                    rows.append(sign * row)
                    limits.append(sign * side[i])
                    origins.append((sign, first + i))
    if needs_row and not rows:
        rows, limits = [np.zeros(size)], [1.0]
    level = [i for i in range(len(dense.matrix)) if dense.row_lower[i] == dense.row_upper[i]]
    finite = np.isfinite(dense.lower).any() or np.isfinite(dense.upper).any()
    bounds = (dense.lower, dense.upper) if box and finite else (None, None)

    def given(values, *shape):
        return np.reshape(values, (len(values), *shape)) if values or keep_empty else None

    arguments = (
        dense.hessian, dense.gradient, given(rows, size), given(limits),
        given([dense.matrix[i] for i in level], size), given([dense.row_upper[i] for i in level]),
        *bounds,
    )
    return arguments, origins, [size + i for i in level]


def check_arguments(form, wanted):
    for letter, given, value in zip(LETTERS, form.arguments, wanted, strict=True):
        assert (given is None) == (value is None), letter
        if value is not None:
            full = given.toarray() if scipy.sparse.issparse(given) else given
            assert full.shape == value.shape
            np.testing.assert_array_equal(full, value, err_msg=letter)


def parts(arguments):
    """Every array among the arguments, those inside of matrices too, by name."""
    for letter, one in zip(LETTERS, arguments, strict=True):
        if scipy.sparse.issparse(one):
            for name in ("data", "indices", "indptr"):
                yield f"{letter}.{name}", getattr(one, name)
        elif one is not None:
            yield letter, one


@forms
@pytest.mark.parametrize("case", CASES)
def test_the_form_is_that_of_plain_loops(case, how):
    for seed in range(2):
        qp, dense = make(**CASES[case], seed=seed)
        form = Form(qp, **how)
        form.fill(qp)
        check_arguments(form, expected(dense, how["box"], how["needs_row"], how["keep_empty"])[0])


@forms
@pytest.mark.parametrize("case", CASES)
def test_filling_again_is_making_anew(case, how):
    qp, _ = make(**CASES[case], seed=0)
    other, _ = make(**CASES[case], seed=1)
    for name in ("lower", "upper", "row_lower", "row_upper"):  # the same pattern, other numbers
        getattr(other, name)[...] = 3.0 * getattr(qp, name)
    assert key(other) == key(qp)
    form, anew = Form(qp, **how), Form(other, **how)
    form.fill(qp)
    before = list(parts(form.arguments))
    form.fill(other)
    anew.fill(other)
    after, wanted = list(parts(form.arguments)), list(parts(anew.arguments))
    assert all(one is two for (_, one), (_, two) in zip(before, after, strict=True))
    for (name, one), (same, two) in zip(after, wanted, strict=True):
        assert name == same
        np.testing.assert_array_equal(one, two, err_msg=name)


@pytest.mark.parametrize("box", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_matrices_are_what_the_solvers_can_take(case, box):
    qp, _ = make(**CASES[case])
    form, twin = (
        Form(qp, dense=False, box=box, needs_row=True, keep_empty=True)
        for _ in range(2)
    )
    for matrix in form.arguments[0:6:2]:
        assert type(matrix) is scipy.sparse.csc_matrix
        assert matrix.indices.dtype == matrix.indptr.dtype == np.int32
        for column in range(qp.size):
            indices = matrix.indices[matrix.indptr[column] : matrix.indptr[column + 1]]
            assert (np.diff(indices) > 0).all()
    others = dict(parts(twin.arguments))
    for name, array in parts(form.arguments):
        assert array.flags.writeable
        assert array.flags.c_contiguous
        assert array.dtype == np.float64 or name.endswith(("indices", "indptr"))
        assert not np.shares_memory(array, others[name])
        assert not any(np.shares_memory(array, getattr(qp, one)) for one in ARRAYS)


@pytest.mark.parametrize("box", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_multipliers_go_back_to_their_constraints(case, box):
    rng = np.random.default_rng(0)
    qp, dense = make(**CASES[case])
    form = Form(qp, dense=True, box=box, needs_row=True, keep_empty=False)
    arguments, origins, level = expected(dense, box, True, False)
    z, y = (rng.standard_normal(0 if one is None else len(one)) for one in arguments[3:6:2])
    z_box = rng.standard_normal(0 if arguments[6] is None else qp.size)
    wanted = np.zeros(qp.size + qp.stages * qp.rows)
    for (sign, constraint), multiplier in zip(origins, z, strict=False):  # not the void row's
        wanted[constraint] += sign * multiplier
    wanted[level] += y
    wanted[: z_box.size] += z_box
    for _ in range(2):  # nothing is left over from the first time
        np.testing.assert_array_equal(form.multipliers(z=z, y=y, z_box=z_box), wanted)


@pytest.mark.parametrize("missing", ["z", "y", "z_box"])
@pytest.mark.parametrize("value", [None, np.zeros(1)], ids=["none", "too few"])
def test_missing_multipliers_are_not_made_up(missing, value):
    qp, _ = make(**CASES["all kinds"])
    form = Form(qp, dense=True, box=True, needs_row=False, keep_empty=False)
    told = {
        "z": np.ones(len(form.arguments[3])), "y": np.ones(len(form.arguments[5])),
        "z_box": np.ones(qp.size),
    }
    assert form.multipliers(**told) is not None
    told[missing] = value
    assert form.multipliers(**told) is None


def test_the_pattern_is_that_of_limits_and_sizes_only():
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
