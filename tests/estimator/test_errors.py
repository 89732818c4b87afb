import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import (
    BackendError,
    InvalidInputError,
    OptionError,
    SetError,
    ShapeError,
    WeightError,
)

from .spoil import cases, check, cost_of, estimator, system_of, with_input


def test_the_estimator_that_the_cases_spoil_works():
    assert estimator().update([1.0]).state.shape == (2,)
    assert with_input().update([1.0], [0.0, 0.0]).state.shape == (2,)


# Options


@pytest.mark.parametrize(
    ("name", "value", "least"),
    [
        *(("horizon", value, 1) for value in (0, -1, 1.5, 3.0, True, "3", None)),
        *(("max_qps", value, 0) for value in (-1, 1.5, True, "2")),
    ],
)
def test_counts_out_of_range(name, value, least):
    check(
        OptionError, [f"{name} is {value!r}", f"expected an integer >= {least}"],
        lambda: estimator(**{name: value}),
    )


@pytest.mark.parametrize("value", [0, -2, 1.5, True, "5"])
def test_iteration_caps_out_of_range(value):
    check(
        OptionError, [f"iterations is {value!r}", "expected an integer >= 1", "max_qps=0"],
        lambda: estimator(max_solver_iterations=value),
    )


def test_the_iteration_cap_is_named_as_the_user_writes_it():
    check(
        OptionError, ["max_solver_iterations is 0"], lambda: estimator(max_solver_iterations=0)
    )


@pytest.mark.parametrize("value", [0, 0.0, -1e-9, math.nan, math.inf, "tight", True, None, [1e-7]])
@pytest.mark.parametrize("name", ["tolerance", "solver_tolerance"])
def test_tolerances_out_of_range(name, value):
    check(
        OptionError, [f"{name} is {value!r}", "expected a finite number > 0"],
        lambda: estimator(**{name: value}),
    )


@pytest.mark.parametrize(
    "option",
    [
        {"horizon": np.int64(3)},
        {"max_qps": np.int32(2)},
        {"max_solver_iterations": np.int64(5)},
        {"solver_tolerance": np.float32(1e-5)},
        {"tolerance": np.float64(1e-5)},
        {"max_qps": None},
        {"max_solver_iterations": None},
    ],
    ids=str,
)
def test_numbers_of_numpy_are_numbers(option):
    assert estimator(**option).update([1.0]).state.shape == (2,)


@pytest.mark.parametrize("name", ["nosuch", "", "OSQP", None, 3, ["osqp"]])
def test_an_unknown_backend_lists_the_known_ones(name):
    known = [entry.name for entry in qpmhe.solvers.backends()]
    assert "auto" in known
    check(
        BackendError, [f"backend {name!r} is not known", *known], lambda: estimator(backend=name)
    )


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_available_backends_are_accepted(backend):
    assert estimator(backend=backend).update([1.0]).cost >= 0.0


@pytest.mark.parametrize("name", ["fast", "Python", None, 0])
def test_an_unknown_engine(name):
    check(OptionError, [f"engine is {name!r}", "'python'"], lambda: estimator(engine=name))


# Parts


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("system", "qpmhe.System"),
        ("observer", "qpmhe.Luenberger"),
        ("cost", "qpmhe.QuadraticCost"),
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
    pytest.param([1.0, 2.0], ShapeError, ["shape (1, 2)", "square"], id="vector"),
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
    check(kind, [f"{name} covariance ", *fragments], lambda: build(**covariances))


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("build", [qpmhe.QuadraticCost, qpmhe.QuadraticCost.from_covariances])
def test_a_prior_of_another_size(build, size):
    check(
        ShapeError, [f"prior has shape ({size}, {size})", "expected (2, 2)"],
        lambda: build(prior=np.eye(size), disturbance=np.eye(2), noise=np.eye(1)),
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
    check(SetError, [f"{name} is (0.0, 1.0)", "qpmhe.Box"], lambda: make((0.0, 1.0)))
