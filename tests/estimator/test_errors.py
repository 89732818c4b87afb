import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import (
    BackendError,
    InvalidInputError,
    ModelError,
    OptionError,
    QpmheError,
    SetError,
    ShapeError,
    WeightError,
)

A = np.array([[1.0, 0.1], [-0.2, 0.9]])


def system_of(f=None, h=None, **options):
    sizes = {"n": 2, "p": 1} | options
    return qpmhe.System(f or (lambda x: x @ A.T), h or (lambda x: x[..., :1]), **sizes)


def cost_of(n=2, p=1, **weights):
    return qpmhe.QuadraticCost(
        **({"prior": np.eye(n), "disturbance": np.eye(n), "noise": np.eye(p)} | weights)
    )


def estimator(system=None, observer=None, cost=None, **options):
    """An estimator that works, but for what is given."""
    return qpmhe.MovingHorizonEstimator(
        system or system_of(),
        observer or qpmhe.Luenberger([[0.3], [0.1]]),
        cost or cost_of(),
        **({"horizon": 3, "initial_state": [1.0, 2.0]} | options),
    )


def with_input():
    return estimator(system_of(lambda x, u: x @ A.T + u, m=2))


def cases(*rows):
    """Parametrisation that names each case by its first value."""
    return [pytest.param(*row, id=repr(row[0])) for row in rows]


def check(kind, fragments, build):
    with pytest.raises(kind) as caught:
        build()
    error, text = caught.value, str(caught.value)
    assert isinstance(error, InvalidInputError)
    assert isinstance(error, QpmheError)
    assert isinstance(error, ValueError)
    for fragment in fragments:
        assert fragment in text


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


# The model


@pytest.mark.parametrize("value", [0, -1, 1.5, 2.0, True, "2", None])
@pytest.mark.parametrize("name", ["n", "p"])
def test_sizes_of_states_and_outputs(name, value):
    check(
        OptionError, [f"{name} is {value!r}", "integer >= 1"], lambda: system_of(**{name: value})
    )


@pytest.mark.parametrize("value", [-1, 1.5, True, "1", None])
def test_sizes_of_inputs(value):
    check(OptionError, [f"m is {value!r}", "integer >= 0"], lambda: system_of(m=value))


@pytest.mark.parametrize("name", ["f", "h"])
@pytest.mark.parametrize("value", [A, "f", 3.0], ids=["matrix", "text", "number"])
def test_functions_that_are_none(name, value):
    functions = {"f": lambda x: x, "h": lambda x: x[..., :1], name: value}
    check(
        ModelError, [f"{name} is {value!r}", "expected a function"],
        lambda: qpmhe.System(functions["f"], functions["h"], n=2, p=1),
    )


@pytest.mark.parametrize(
    ("shape", "n"), [((3,), 2), ((2, 1), 2), ((1, 2), 2), ((), 2), ((1,), 2), ((2,), 1)], ids=str
)
def test_f_of_the_wrong_shape(shape, n):
    check(
        ModelError, [f"f returned shape {shape} at x = ", f"expected ({n},)", "Check n, p, m"],
        lambda: system_of(lambda x: np.ones(shape), n=n),
    )


@pytest.mark.parametrize(
    ("shape", "p"), [((2,), 1), ((1, 1), 1), ((), 2), ((1,), 2), ((2, 1), 2)], ids=str
)
def test_h_of_the_wrong_shape(shape, p):
    check(
        ModelError, [f"h returned shape {shape} at x = ", f"expected ({p},)", "Check n, p, m"],
        lambda: system_of(h=lambda x: np.ones(shape), p=p),
    )


def test_an_input_that_the_system_does_not_know_of():
    check(
        ModelError, ["f needs more than one argument", "pass m"],
        lambda: system_of(lambda x, u: x),
    )
    check(
        ModelError, ["h needs more than one argument", "pass m"],
        lambda: system_of(h=lambda x, u: x[:1]),
    )


def test_a_function_without_arguments():
    check(
        ModelError, ["f takes no argument", "f(x) or f(x, u)"],
        lambda: system_of(lambda: np.ones(2), m=1),
    )


def write_state(x, u):
    x[0] = 2.0 * x[0]
    return x


def write_input(x, u):
    u += 1.0
    return x + u


@pytest.mark.parametrize("f", [write_state, write_input])
def test_f_that_changes_its_argument(f):
    check(ModelError, ["f changes its argument in place", "copy"], lambda: system_of(f, m=2))


def test_h_that_changes_its_argument():
    def h(x):
        x -= 1.0
        return x[:1]

    check(ModelError, ["h changes its argument in place", "copy"], lambda: system_of(h=h))


def test_a_rate_that_changes_its_argument():
    check(
        ModelError, ["rate changes its argument in place"],
        lambda: qpmhe.System.from_ode(
            lambda x: write_state(x, None), lambda x: x[..., :1], dt=0.1, n=2, p=1
        ),
    )


def raising(x):
    raise ZeroDivisionError("no way out")


@pytest.mark.parametrize("name", ["f", "h"])
@pytest.mark.parametrize(
    ("function", "fragments"),
    [
        pytest.param(
            raising, ["raised ZeroDivisionError: no way out", "[1.0, 2.0]", "initial state"],
            id="raises",
        ),
        pytest.param(
            lambda x: np.sqrt(x - 1.5), ["[nan, 0.70", "initial state [1.0, 2.0]", "finite"],
            id="NaN",
        ),
        pytest.param(
            lambda x: 1.0 / (x - 1.0), ["[inf, 1.0]", "initial state [1.0, 2.0]", "finite"],
            id="infinite",
        ),
    ],
)
def test_functions_without_a_value_at_the_initial_state(name, function, fragments):
    functions = {"f": lambda x: x, "h": lambda x: x, name: function}
    check(
        ModelError, [name, *fragments],
        lambda: estimator(
            qpmhe.System(functions["f"], functions["h"], n=2, p=2),
            qpmhe.Luenberger(np.eye(2)), cost_of(2, 2),
        ),
    )


def test_reset_to_a_state_without_a_value_changes_nothing():
    mhe = estimator(system_of(h=lambda x: np.sqrt(x[..., :1])))
    mhe.update([1.0])
    before = mhe.state.copy()
    check(ModelError, ["h is [nan] at the initial state [-1.0, 2.0]"], lambda: mhe.reset([-1, 2]))
    assert mhe.time == 1
    np.testing.assert_array_equal(mhe.state, before)


@pytest.mark.parametrize("name", ["f", "h"])
def test_a_shape_that_is_wrong_at_the_initial_state_only(name):
    def odd(x):
        if x[0] > 10.0:
            return np.ones(3)
        raise ValueError("out of reach")

    functions = {"f": lambda x: x, "h": lambda x: x, name: odd}
    check(
        ModelError, [f"{name} returned shape (3,)", "expected (2,)"],
        lambda: estimator(
            qpmhe.System(functions["f"], functions["h"], n=2, p=2),
            qpmhe.Luenberger(np.eye(2)), cost_of(2, 2), initial_state=[12.0, 1.0],
        ),
    )


@pytest.mark.parametrize("dt", [0, -0.1, math.nan, math.inf, True, "0.1", None])
def test_sampling_times(dt):
    check(
        OptionError, [f"dt is {dt!r}", "finite number > 0"],
        lambda: qpmhe.System.from_ode(lambda x: -x, lambda x: x, dt=dt, n=1, p=1),
    )


@pytest.mark.parametrize("method", ["rk45", "RK4", "", None, 4])
def test_discretisations(method):
    check(
        OptionError, [f"method is {method!r}", "euler, rk4"],
        lambda: qpmhe.System.from_ode(
            lambda x: -x, lambda x: x, dt=0.1, n=1, p=1, method=method
        ),
    )


def test_a_rate_of_the_wrong_shape():
    check(
        ModelError, ["rate returned shape (3,)", "expected (2,)"],
        lambda: qpmhe.System.from_ode(lambda x: np.ones(3), lambda x: x[:1], dt=0.1, n=2, p=1),
    )


# Samples: a wrong one leaves the estimator as it was


def unharmed(build, calls, sample):
    """Errors between samples change nothing that comes after, bit for bit."""
    spoilt, twin = build(), build()
    for _ in range(5):
        for kind, fragments, call in calls:
            before, time = spoilt.state.copy(), spoilt.time
            check(kind, fragments, lambda call=call: call(spoilt))
            assert spoilt.time == time
            np.testing.assert_array_equal(spoilt.state, before)
        one, other = spoilt.update(*sample), twin.update(*sample)
        np.testing.assert_array_equal(one.trajectory, other.trajectory)
        np.testing.assert_array_equal(one.candidate, other.candidate)
        assert (one.time, one.cost, one.candidate_cost) == (
            other.time, other.cost, other.candidate_cost
        )


@pytest.mark.parametrize(
    ("y", "kind", "fragments"),
    cases(
        ([1.0, 2.0], ShapeError, ["y has shape (2,)", "expected (1,)"]),
        ([], ShapeError, ["y has shape (0,)", "expected (1,)"]),
        ([[1.0]], ShapeError, ["y has shape (1, 1)", "expected (1,)"]),
        ([1j], InvalidInputError, ["y is [1j]", "real numbers"]),
        (["high"], InvalidInputError, ["y is ['high']", "real numbers"]),
        ([[1.0], 2.0], InvalidInputError, ["y is [[1.0], 2.0]", "real numbers"]),
    ),
)
def test_measurements(y, kind, fragments):
    unharmed(estimator, [(kind, fragments, lambda mhe: mhe.update(y))], ([1.5],))


def test_a_scalar_is_no_measurement_of_two_outputs():
    def build():
        return estimator(
            system_of(h=lambda x: x, p=2), qpmhe.Luenberger(0.1 * np.eye(2)), cost_of(2, 2)
        )

    unharmed(
        build,
        [
            (ShapeError, ["y has shape ()", "expected (2,)"], lambda mhe: mhe.update(1.0)),
            (ShapeError, ["y has shape (1,)", "expected (2,)"], lambda mhe: mhe.update([1.0])),
        ],
        ([1.0, 2.0],),
    )


@pytest.mark.parametrize(
    ("u", "kind", "fragments"),
    cases(
        ((), InvalidInputError, ["u is missing", "2 inputs", "update(y, u)"]),
        ((None,), InvalidInputError, ["u is missing", "2 inputs", "update(y, u)"]),
        (([1.0],), ShapeError, ["u has shape (1,)", "expected (2,)"]),
        ((1.0,), ShapeError, ["u has shape ()", "expected (2,)"]),
        (([1.0, 2.0, 3.0],), ShapeError, ["u has shape (3,)", "expected (2,)"]),
        (([[1.0, 2.0]],), ShapeError, ["u has shape (1, 2)", "expected (2,)"]),
        (("up",), InvalidInputError, ["u is 'up'", "real numbers"]),
        (([1.0, 1j],), InvalidInputError, ["u is [1.0, 1j]", "real numbers"]),
    ),
)
def test_inputs(u, kind, fragments):
    unharmed(
        with_input, [(kind, fragments, lambda mhe: mhe.update([1.0], *u))], ([1.5], [0.1, 0.2])
    )


@pytest.mark.parametrize("u", [[0.0], 0.0, []], ids=repr)
def test_unexpected_inputs(u):
    unharmed(
        estimator,
        [(InvalidInputError, ["u was given", "no inputs"], lambda mhe: mhe.update([1.0], u))],
        ([1.5],),
    )


@pytest.mark.parametrize(
    ("measurements", "kind", "fragments"),
    [
        (np.ones((5, 2)), ShapeError, ["measurements has shape (5, 2)", "(T, 1)"]),
        (np.ones((5, 1, 1)), ShapeError, ["measurements has shape (5, 1, 1)", "(T, 1)"]),
        (1.0, ShapeError, ["measurements has shape ()", "(T, 1)"]),
        ([[1.0], [1.0, 2.0]], InvalidInputError, ["measurements"]),
        ([[1.0], ["high"]], InvalidInputError, ["measurements", "high"]),
        ([[1.0], [1j]], InvalidInputError, ["measurements", "1j"]),
    ],
    ids=["wide", "deep", "scalar", "ragged", "text", "complex"],
)
def test_records(measurements, kind, fragments):
    unharmed(estimator, [(kind, fragments, lambda mhe: mhe.run(measurements))], ([1.5],))


@pytest.mark.parametrize(
    ("inputs", "kind", "fragments"),
    [
        (None, InvalidInputError, ["u is missing", "2 inputs"]),
        (np.ones((4, 2)), ShapeError, ["inputs has 4 samples", "expected 5"]),
        (np.ones((6, 2)), ShapeError, ["inputs has 6 samples", "expected 5"]),
        (np.ones((5, 1)), ShapeError, ["inputs has shape (5, 1)", "(T, 2)"]),
        (np.ones((5, 3)), ShapeError, ["inputs has shape (5, 3)", "(T, 2)"]),
        (np.ones(5), ShapeError, ["inputs has shape (5,)", "(T, 2)"]),
        ([[1.0, 2.0]] * 4 + [[1.0]], InvalidInputError, ["inputs"]),
    ],
    ids=["none", "short", "long", "narrow", "wide", "vector", "ragged"],
)
def test_records_of_inputs(inputs, kind, fragments):
    unharmed(
        with_input, [(kind, fragments, lambda mhe: mhe.run(np.ones((5, 1)), inputs))],
        ([1.5], [0.1, 0.2]),
    )


@pytest.mark.parametrize("inputs", [np.ones((5, 1)), np.ones((5, 0)), np.ones(5)], ids=str)
def test_unexpected_records_of_inputs(inputs):
    unharmed(
        estimator,
        [(InvalidInputError, ["inputs"], lambda mhe: mhe.run(np.ones((5, 1)), inputs))],
        ([1.5],),
    )
