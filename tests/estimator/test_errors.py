import math
import re
import warnings

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import (
    InvalidInputError,
    ObserverWarning,
    SetError,
    ShapeError,
    WeightError,
)

from .spoil import cases, check, cost_of, estimator, system_of, with_input


def test_the_estimator_that_the_cases_spoil_works():
    assert estimator().update([1.0]).state.shape == (2,)
    assert with_input().update([1.0], [0.0, 0.0]).state.shape == (2,)


# Parts


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("system", "qpmhe.System"),
        ("observer", "qpmhe.Luenberger"),
        ("cost", "qpmhe.QuadraticCost or qpmhe.RobustCost"),
    ],
)
@pytest.mark.parametrize("value", [0.5, "part", ("a", "b"), qpmhe.Box([0.0], [1.0])], ids=repr)
def test_parts_of_the_wrong_type(name, expected, value):
    check(
        InvalidInputError, [f"{name} is {value!r}", f"expected a {expected}"],
        lambda: estimator(**{name: value}),
    )


def test_a_class_is_no_observer():
    check(
        InvalidInputError, ["observer is <class", "qpmhe.Luenberger"],
        lambda: estimator(observer=qpmhe.Luenberger),
    )


@pytest.mark.parametrize(("n", "p"), [(3, 1), (1, 1), (2, 2)])
def test_a_cost_of_other_dimensions(n, p):
    check(
        ShapeError, [f"{n} states and {p} outputs", "expected 2 and 1"],
        lambda: estimator(cost=cost_of(n, p)),
    )


@pytest.mark.parametrize(
    ("gain", "shape"),
    cases(
        (0.3, (1, 1)), ([0.3], (1, 1)), ([0.3, 0.2, 0.1], (3, 1)), ([[0.3, 0.1]], (1, 2)),
        (np.eye(2), (2, 2)), (np.ones((2, 1, 1)), (2, 1, 1)),
    ),
)
def test_a_gain_of_the_wrong_shape(gain, shape):
    check(
        ShapeError, [f"gain has shape {shape}", "(n, p) = (2, 1)"],
        lambda: estimator(observer=qpmhe.Luenberger(gain)),
    )


@pytest.mark.parametrize(
    ("gain", "text"),
    cases(
        ([[math.nan], [0.1]], "nan"), ([[0.1], [math.inf]], "inf"), ("high", "'high'"),
        ([[1j], [0.1]], "1j"), ([[0.1], [0.1, 0.2]], "0.2"), (None, "nan"),
    ),
)
def test_a_gain_that_is_no_matrix_of_numbers(gain, text):
    check(InvalidInputError, ["gain is ", text, "numbers"], lambda: qpmhe.Luenberger(gain))


@pytest.mark.parametrize(
    ("name", "size", "right"), [("prior", 3, 2), ("disturbance", 1, 2), ("noise", 2, 1)]
)
def test_covariances_of_other_dimensions(name, size, right):
    covariances = {"prior": np.eye(2), "disturbance": np.eye(2), "noise": np.eye(1)}
    covariances[name] = np.eye(size)
    check(
        ShapeError,
        [f"{name} covariance has shape ({size}, {size})", f"expected ({right}, {right})"],
        lambda: estimator(observer=qpmhe.ExtendedKalman(**covariances)),
    )


def test_a_prior_from_an_observer_without_covariance():
    check(
        InvalidInputError, ["Luenberger has no covariance", "qpmhe.ExtendedKalman"],
        lambda: estimator(cost=cost_of(prior=qpmhe.ObserverPrior())),
    )


@pytest.mark.parametrize(
    ("state", "kind", "fragments"),
    cases(
        ([1.0], ShapeError, ["shape (1,)", "(2,)"]),
        (1.0, ShapeError, ["shape ()", "(2,)"]),
        ([1.0, 2.0, 3.0], ShapeError, ["shape (3,)", "(2,)"]),
        ([[1.0, 2.0]], ShapeError, ["shape (1, 2)", "(2,)"]),
        ([[1.0], [2.0]], ShapeError, ["shape (2, 1)", "(2,)"]),
        ([1.0, math.nan], InvalidInputError, ["[1.0, nan]", "finite"]),
        ([math.inf, 1.0], InvalidInputError, ["[inf, 1.0]", "finite"]),
        ([1.0, None], InvalidInputError, ["nan", "finite"]),
        (["one", "two"], InvalidInputError, ["['one', 'two']", "real numbers"]),
        ([1.0, 2j], InvalidInputError, ["2j", "real numbers"]),
        ([1.0, [2.0, 3.0]], InvalidInputError, ["[1.0, [2.0, 3.0]]", "real numbers"]),
    ),
)
def test_initial_states(state, kind, fragments):
    check(kind, ["initial_state", *fragments], lambda: estimator(initial_state=state))
    mhe = estimator()
    mhe.update([1.0])
    before = mhe.state.copy()
    check(kind, ["initial_state", *fragments], lambda: mhe.reset(state))
    assert mhe.time == 1
    np.testing.assert_array_equal(mhe.state, before)


STATE_SETS = {
    "box": qpmhe.Box([-5.0, -5.0], [5.0, 5.0]),
    "polytope": qpmhe.Polytope([[1.0, 1.0], [-1.0, -1.0]], [5.0, 5.0]),
    "both": qpmhe.Box([-5.0, -np.inf], [9.0, 9.0]) & qpmhe.Polytope([[1.0, 1.0]], [5.0]),
}


@pytest.mark.parametrize("kind", STATE_SETS)
@pytest.mark.parametrize("project", [True, False])
def test_an_initial_state_outside_of_the_state_set_is_projected(kind, project):
    states = STATE_SETS[kind]
    system, given = system_of(states=states), [2.0, 7.0]
    words = re.escape(f"is {given}, outside of the state set {states!r}; the estimator starts at")
    with pytest.warns(ObserverWarning, match=words):
        mhe = estimator(system, initial_state=given, project_observer=project)
    start = mhe.initial_state
    assert states.violation(start) <= 1e-12
    np.testing.assert_array_equal(mhe.state, start)
    nearest = {"box": [2.0, 5.0], "polytope": [0.0, 5.0], "both": [0.0, 5.0]}[kind]
    np.testing.assert_allclose(start, nearest, rtol=1e-12, atol=1e-12)
    mhe.update([1.0])
    with pytest.warns(ObserverWarning, match=words):
        mhe.reset(given)
    np.testing.assert_array_equal(mhe.state, start)
    mhe.update([1.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ObserverWarning):
            mhe.reset(given)
    assert mhe.time == 1  # as it was


def test_an_initial_state_on_the_boundary_is_inside():
    mhe = estimator(system_of(states=STATE_SETS["both"]), initial_state=[3.0, 2.0])
    np.testing.assert_array_equal(mhe.state, [3.0, 2.0])


# Weights and covariances


BAD_MATRICES = [
    pytest.param(np.diag([1.0, -2.0]), WeightError, ["eigenvalue -2", "positive definite"],
                 id="indefinite"),
    pytest.param(-np.eye(2), WeightError, ["eigenvalue -1", "positive definite"], id="negative"),
    pytest.param(np.diag([1.0, 0.0]), WeightError, ["eigenvalue 0", "positive definite"],
                 id="singular"),
    pytest.param(np.ones((2, 2)), WeightError, ["eigenvalue ", "positive definite"],
                 id="rank one"),
    pytest.param([[1.0, 0.5], [0.0, 1.0]], WeightError, ["not symmetric", "by 0.5"],
                 id="asymmetric"),
    pytest.param(np.ones((2, 3)), ShapeError, ["shape (2, 3)", "square"], id="wide"),
    pytest.param([1.0, 2.0], ShapeError, ["shape (2,)", "np.diag"], id="vector"),
    pytest.param(np.ones((2, 2, 2)), ShapeError, ["shape (2, 2, 2)", "square"], id="cube"),
    pytest.param([[1.0, 0.0], [0.0, math.nan]], InvalidInputError, ["nan", "finite"], id="NaN"),
    pytest.param(math.inf, InvalidInputError, ["inf", "finite"], id="infinite"),
    pytest.param("heavy", InvalidInputError, ["'heavy'", "real numbers"], id="text"),
    pytest.param([[1.0, 1j], [-1j, 1.0]], InvalidInputError, ["1j", "real numbers"],
                 id="complex"),
]


@pytest.mark.parametrize(("value", "kind", "fragments"), BAD_MATRICES)
@pytest.mark.parametrize("name", ["prior", "disturbance", "noise"])
def test_weights(name, value, kind, fragments):
    check(kind, [f"{name} ", *fragments], lambda: cost_of(2, 2, **{name: value}))


@pytest.mark.parametrize(("value", "kind", "fragments"), BAD_MATRICES)
@pytest.mark.parametrize("name", ["prior", "disturbance", "noise"])
@pytest.mark.parametrize("build", [qpmhe.QuadraticCost.from_covariances, qpmhe.ExtendedKalman])
def test_covariances(build, name, value, kind, fragments):
    covariances = {"prior": np.eye(2), "disturbance": np.eye(2), "noise": np.eye(2), name: value}
    if name == "disturbance" or (name == "prior" and build is qpmhe.ExtendedKalman):
        fragments = [text.replace("definite", "semidefinite") for text in fragments]
        symmetric = kind is WeightError and np.array_equal(value, np.transpose(value))
        if symmetric and np.linalg.eigvalsh(value)[0] > -1e-15:
            build(**covariances)
            return
    check(kind, [f"{name} covariance ", *fragments], lambda: build(**covariances))


@pytest.mark.parametrize("build", [qpmhe.QuadraticCost, qpmhe.QuadraticCost.from_covariances])
def test_a_prior_of_another_size(build):
    check(
        ShapeError, ["prior has shape (1, 1)", "expected (2, 2)"],
        lambda: build(prior=np.eye(1), disturbance=np.eye(2), noise=np.eye(1)),
    )
    system = qpmhe.System(lambda x: x, lambda x: x[..., 0], n=3, p=1)
    check(
        ShapeError, ["for 2 disturbances; expected 3", "disturbance_matrix"],
        lambda: qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(np.zeros((3, 1))),
            build(prior=np.eye(3), disturbance=np.eye(2), noise=np.eye(1)),
            horizon=2, initial_state=np.zeros(3),
        ),
    )


# Sets


@pytest.mark.parametrize(
    ("lower", "upper", "kind", "fragments"),
    [
        ([0.0, 0.0], [1.0], SetError, ["(2,)", "(1,)", "equal length"]),
        ([[0.0]], [[1.0]], SetError, ["(1, 1)", "vectors"]),
        ([0.0, math.nan], [1.0, 1.0], SetError, ["nan", "-inf or inf"]),
        ([0.0, 0.0], [math.nan, 1.0], SetError, ["nan", "-inf or inf"]),
        ([0.0, 2.0], [1.0, 1.0], SetError, ["component 1", "lower 2.0", "upper 1.0"]),
        ([math.inf], [math.inf], SetError, ["component 0", "lower inf", "lower <= upper"]),
        ([-math.inf], [-math.inf], SetError, ["component 0", "upper -inf", "lower <= upper"]),
        (["a"], [1.0], InvalidInputError, ["lower is ['a']", "real numbers"]),
        ([0.0], [1j], InvalidInputError, ["upper is [1j]", "real numbers"]),
    ],
)
def test_boxes(lower, upper, kind, fragments):
    check(kind, fragments, lambda: qpmhe.Box(lower, upper))


@pytest.mark.parametrize(
    ("matrix", "bound", "kind", "fragments"),
    [
        (np.eye(2), [1.0], SetError, ["matrix has shape (2, 2)", "bound (1,)", "(r, d) and (r,)"]),
        ([1.0, 2.0], [1.0, 2.0], SetError, ["matrix has shape (1, 2)", "bound (2,)"]),
        (np.eye(2), [[1.0], [1.0]], SetError, ["bound (2, 1)", "(r, d) and (r,)"]),
        (np.ones((2, 2, 2)), [1.0, 1.0], SetError, ["matrix has shape (2, 2, 2)", "(r, d)"]),
        (np.ones((2, 0)), [1.0, 1.0], SetError, ["matrix has shape (2, 0)", "(r, d)"]),
        ([[1.0, 0.0], [0.0, 0.0]], [1.0, 1.0], SetError, ["row 1 of matrix is zero", "leave out"]),
        ([[1.0, math.nan]], [1.0], InvalidInputError, ["matrix is [[1.0, nan]]", "finite"]),
        ([[1.0, 0.0]], [math.inf], InvalidInputError, ["bound is [inf]", "finite"]),
        ([[1.0, 0.0]], [math.nan], InvalidInputError, ["bound is [nan]", "finite"]),
        ("rows", [1.0], InvalidInputError, ["matrix is 'rows'", "real numbers"]),
        ([[1.0, 0.0]], [1j], InvalidInputError, ["bound is [1j]", "real numbers"]),
        ([[1.0, 2.0], [1.0]], [1.0, 1.0], InvalidInputError, ["matrix is [[1.0, 2.0], [1.0]]"]),
        ([[1.0], [-1.0]], [0.0, -1.0], SetError, ["the set is empty", "Polytope(", "2 rows"]),
        (
            [[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]], [-1.0, 0.0, 0.0], SetError,
            ["the set is empty", "no point satisfies all"],
        ),
    ],
)
def test_polytopes(matrix, bound, kind, fragments):
    check(kind, fragments, lambda: qpmhe.Polytope(matrix, bound))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (qpmhe.Box([0.0], [1.0]), qpmhe.Box([2.0], [3.0])),
        (qpmhe.Box([0.0, 0.0], [1.0, 1.0]), qpmhe.Polytope([[-1.0, -1.0]], [-2.1])),
        (qpmhe.Polytope([[1.0, 1.0]], [0.0]), qpmhe.Polytope([[-1.0, -1.0]], [-0.5])),
        (
            qpmhe.Polytope([[1.0, 0.0]], [0.0]) & qpmhe.Polytope([[0.0, -1.0]], [0.0]),
            qpmhe.Polytope([[-1.0, 1.0]], [-1.0]),
        ),
    ],
    ids=["boxes", "box and rows", "rows", "three"],
)
def test_empty_intersections(one, other):
    for left, right in ((one, other), (other, one)):
        fragments = ["the set is empty", "no point satisfies all"]
        check(SetError, fragments, lambda a=left, b=right: a & b)


def test_intersections_of_other_dimensions():
    check(
        SetError, ["dimensions 2 and 3", "expected equal dimensions"],
        lambda: qpmhe.Box([0.0] * 2, [1.0] * 2) & qpmhe.Polytope([[1.0, 1.0, 1.0]], [1.0]),
    )


@pytest.mark.parametrize("other", [None, 1.0, ([0.0], [1.0])], ids=repr)
def test_a_set_meets_sets_only(other):
    with pytest.raises(TypeError, match="unsupported operand"):
        qpmhe.Box([0.0], [1.0]) & other


@pytest.mark.parametrize(
    ("name", "right"), [("states", 2), ("disturbances", 2), ("noises", 1)]
)
@pytest.mark.parametrize("build", ["system", "ode"])
def test_sets_of_the_wrong_dimension_or_type(build, name, right):
    def make(value):
        if build == "system":
            return system_of(**{name: value})
        return qpmhe.System.from_ode(
            lambda x: -x, lambda x: x[..., :1], dt=0.1, n=2, p=1, **{name: value}
        )

    make(qpmhe.Box([-9.0] * right, [9.0] * right))
    check(
        SetError, [f"{name} has dimension 3", f"expected {right}"],
        lambda: make(qpmhe.Box([0.0] * 3, [1.0] * 3)),
    )
    make(qpmhe.Polytope(np.eye(right), [9.0] * right))
    check(
        SetError, [f"{name} has dimension 4", f"expected {right}"],
        lambda: make(qpmhe.Polytope(np.ones((1, 4)), [1.0])),
    )
    check(
        SetError, [f"{name} is (0.0, 1.0)", "qpmhe.Box", "qpmhe.Polytope"],
        lambda: make((0.0, 1.0)),
    )
