"""What fits nothing is refused where it is given: with its value, the expectation, the remedy."""

import itertools
import math
from operator import and_

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import (
    InvalidInputError,
    ModelError,
    OptionError,
    SetError,
    ShapeError,
    WeightError,
)

from .spoil import A, check, cost_of, estimator, system_of

TERMS = ("prior", "disturbance", "noise")
NO_NUMBERS = ["real numbers"]


def test_parts():
    parts = {
        "system": "qpmhe.System", "observer": "qpmhe.Luenberger",
        "cost": "qpmhe.QuadraticCost or qpmhe.RobustCost",
    }
    for name, value in itertools.product(parts, ("part", ("a", "b"), qpmhe.Box(0.0, 1.0))):
        text = [f"{name} is {value!r}", f"expected a {parts[name]}"]
        check(InvalidInputError, text, estimator, **{name: value})
    check(
        InvalidInputError, ["observer is <class", "qpmhe.Luenberger"],
        estimator, observer=qpmhe.Luenberger,
    )
    for n, p in ((3, 1), (1, 1), (2, 2)):
        text = [f"{n} states and {p} outputs", "expected 2 and 1"]
        check(ShapeError, text, estimator, cost=cost_of(n, p))
    for name, size, right in (("prior", 3, 2), ("disturbance", 1, 2), ("noise", 2, 1)):
        sizes = dict(zip(TERMS, (2, 2, 1), strict=True)) | {name: size}
        observer = qpmhe.ExtendedKalman(**{term: np.eye(k) for term, k in sizes.items()})
        text = [f"{name} covariance has shape ({size}, {size})", f"expected ({right}, {right})"]
        check(ShapeError, text, estimator, observer=observer)
    check(
        InvalidInputError, ["Luenberger has no covariance", "qpmhe.ExtendedKalman"],
        estimator, cost=cost_of(prior=qpmhe.ObserverPrior()),
    )


def injected(gain):
    return estimator(observer=qpmhe.Luenberger(gain))


def test_gains():
    for gain, kind, text in (
        (0.3, ShapeError, ["gain has shape (1, 1)", "(n, p) = (2, 1)"]),
        (np.ones((2, 1, 1)), ShapeError, ["gain has shape (2, 1, 1)", "(n, p) = (2, 1)"]),
        ([[0.1], [math.inf]], InvalidInputError, ["gain is ", "inf", "finite"]),
        ("high", InvalidInputError, ["gain is 'high'", "numbers"]),
        ([[1j], [0.1]], InvalidInputError, ["gain is ", "1j", "numbers"]),
        ([[0.1], [0.1, 0.2]], InvalidInputError, ["gain is ", "0.2", "numbers"]),
        (None, InvalidInputError, ["gain is ", "nan", "numbers"]),
    ):
        check(kind, text, injected, gain)


INITIAL_STATES = [
    (1.0, ShapeError, ["shape ()", "(2,)"]),
    ([[1.0, 2.0]], ShapeError, ["shape (1, 2)", "(2,)"]),
    ([math.inf, 1.0], InvalidInputError, ["[inf, 1.0]", "finite"]),
    ([1.0, None], InvalidInputError, ["nan", "finite"]),
    ([1.0, 2j], InvalidInputError, ["2j", *NO_NUMBERS]),
    ([1.0, [2.0, 3.0]], InvalidInputError, ["[1.0, [2.0, 3.0]]", *NO_NUMBERS]),
    ([-1.0, 2.0], ModelError, ["h is [nan] at the initial state [-1.0, 2.0]"]),
]


def test_initial_states():
    system = system_of(h=lambda x: np.sqrt(x[..., :1]))
    mhe = estimator(system)
    mhe.update([1.0])
    before = mhe.state.copy()
    for state, kind, text in INITIAL_STATES:
        text = text if kind is ModelError else ["initial_state", *text]
        check(kind, text, estimator, system, initial_state=state)
        check(kind, text, mhe.reset, state)
        assert mhe.time == 1
        np.testing.assert_array_equal(mhe.state, before)


BAD_MATRICES = [
    (np.diag([1.0, -2.0]), WeightError, ["eigenvalue -2", "positive definite"]),
    (np.ones((2, 2)), WeightError, ["eigenvalue ", "positive definite"]),
    ([[1.0, 0.5], [0.0, 1.0]], WeightError, ["not symmetric", "by 0.5"]),
    (np.ones((2, 3)), ShapeError, ["shape (2, 3)", "square"]),
    ([1.0, 2.0], ShapeError, ["shape (2,)", "np.diag"]),
    ([[1.0, 0.0], [0.0, math.nan]], InvalidInputError, ["nan", "finite"]),
    ("heavy", InvalidInputError, ["'heavy'", *NO_NUMBERS]),
    ([[1.0, 1j], [-1j, 1.0]], InvalidInputError, ["1j", *NO_NUMBERS]),
]


def test_weights_and_covariances():
    for name, (value, kind, text) in itertools.product(TERMS, BAD_MATRICES):
        check(kind, [f"{name} ", *text], cost_of, 2, 2, **{name: value})
        covariances = dict.fromkeys(TERMS, np.eye(2)) | {name: value}
        for build in (qpmhe.QuadraticCost.from_covariances, qpmhe.ExtendedKalman):
            words = text
            if name == "disturbance" or (name == "prior" and build is qpmhe.ExtendedKalman):
                words = [word.replace("definite", "semidefinite") for word in text]
                if value is BAD_MATRICES[1][0]:  # singular ones will do
                    build(**covariances)
                    continue
            check(kind, [f"{name} covariance ", *words], build, **covariances)


def test_sets():
    Box, Polytope, empty = qpmhe.Box, qpmhe.Polytope, ["the set is empty", "no point satisfies all"]
    quarter = Polytope([[1.0, 0.0]], [0.0]) & Polytope([[0.0, -1.0]], [0.0])
    for build, one, other, kind, text in (
        (Box, [0.0, 0.0], [1.0], SetError, ["(2,)", "(1,)", "equal length"]),
        (Box, [[0.0]], [[1.0]], SetError, ["(1, 1)", "vectors"]),
        (Box, [0.0, math.nan], [1.0, 1.0], SetError, ["nan", "-inf or inf"]),
        (Box, [0.0, 2.0], [1.0, 1.0], SetError, ["component 1", "lower 2.0", "upper 1.0"]),
        (Box, [math.inf], [math.inf], SetError, ["component 0", "lower inf", "lower <= upper"]),
        (Box, [-math.inf], [-math.inf], SetError, ["component 0", "upper -inf"]),
        (Box, ["a"], [1.0], InvalidInputError, ["lower is ['a']", *NO_NUMBERS]),
        (Polytope, np.eye(2), [1.0], SetError, ["shape (2, 2)", "bound (1,)", "(r, d) and (r,)"]),
        (Polytope, [1.0, 2.0], [1.0, 2.0], SetError, ["matrix has shape (1, 2)", "bound (2,)"]),
        (Polytope, np.ones((2, 0)), [1.0] * 2, SetError, ["matrix has shape (2, 0)", "(r, d)"]),
        (Polytope, np.diag([1.0, 0.0]), [1.0] * 2, SetError, ["row 1 of matrix is zero", "leave"]),
        (Polytope, [[1.0, math.nan]], [1.0], InvalidInputError, ["matrix is [[1.0, nan]]"]),
        (Polytope, [[1.0, 0.0]], [math.inf], InvalidInputError, ["bound is [inf]", "finite"]),
        (Polytope, [[1.0, 0.0]], [1j], InvalidInputError, ["bound is [1j]", *NO_NUMBERS]),
        (Polytope, [[1.0], [-1.0]], [0.0, -1.0], SetError, [*empty, "Polytope(", "2 rows"]),
        (Polytope, [[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]], [-1.0, 0.0, 0.0], SetError, empty),
        (and_, Box([0.0], [1.0]), Box([2.0], [3.0]), SetError, empty),
        (and_, Box([0.0] * 2, [1.0] * 2), Polytope([[-1.0, -1.0]], [-2.1]), SetError, empty),
        (and_, Polytope([[-1.0, -1.0]], [-2.1]), Box([0.0] * 2, [1.0] * 2), SetError, empty),
        (and_, quarter, Polytope([[-1.0, 1.0]], [-1.0]), SetError, empty),
        (and_, quarter, Polytope([[1.0] * 3], [1.0]), SetError, ["dimensions 2 and 3", "equal"]),
    ):
        check(kind, text, build, one, other)
    for value in (None, 1.0, ([0.0], [1.0])):
        with pytest.raises(TypeError, match="unsupported operand"):
            quarter & value


def ode(rate=lambda x: -x, h=lambda x: x[..., :1], **options):
    return qpmhe.System.from_ode(rate, h, **{"n": 2, "p": 1, "dt": 0.1} | options)


def test_sets_of_a_system():
    large, rows = qpmhe.Box([0.0] * 3, [1.0] * 3), qpmhe.Polytope(np.ones((1, 4)), [1.0])
    for name, right in (("states", 2), ("disturbances", 2), ("noises", 1)):
        for value, text in (
            (large, [f"{name} has dimension 3", f"expected {right}"]),
            (rows, [f"{name} has dimension 4", f"expected {right}"]),
            ((0.0, 1.0), [f"{name} is (0.0, 1.0)", "qpmhe.Box", "qpmhe.Polytope"]),
        ):
            check(SetError, text, system_of, **{name: value})
            check(SetError, text, ode, **{name: value})


def test_sizes_and_options_of_a_system():
    for make, name, expected, values in (
        (system_of, "n", "integer >= 1", [0, 2.0, True, "2", None]),
        (system_of, "p", "integer >= 1", [0, 2.0, True, "2", None]),
        (system_of, "m", "integer >= 0", [-1, 1.5, True, "1", None]),
        (ode, "dt", "finite number > 0", [0, math.nan, math.inf, True, "0.1", None]),
        (ode, "method", "'euler', 'rk4'", ["RK4", None, 4]),
    ):
        for value in values:
            check(OptionError, [f"{name} is {value!r}", expected], make, **{name: value})


def double(x, u=None):
    (x if u is None else u)[...] *= 2.0
    return x


def test_functions_of_a_system():
    for name, size in (("f", "n"), ("h", "p")):
        for value in (A, "f", 3.0):
            functions = {"f": lambda x: x, "h": lambda x: x[..., :1], name: value}
            text = [f"{name} is {value!r}", "expected a function"]
            check(ModelError, text, qpmhe.System, **functions, n=2, p=1)
        for shape, right in (((2, 1), 2), ((1, 2), 2), ((), 2), ((1,), 2), ((2,), 1)):
            made = {name: lambda x, shape=shape: np.ones(shape), size: right}
            text = [f"{name} returned shape {shape} at x = ", f"expected ({right},)", "Check n, p"]
            check(ModelError, text, system_of, **made)
        text = [f"{name} needs 2 arguments", "pass m"]
        check(ModelError, text, system_of, **{name: lambda x, u: x})
        text = [f"{name} changes its argument in place", "copy"]
        check(ModelError, text, system_of, **{name: double}, p=2)
        check(ModelError, text, system_of, **{name: double}, p=2, m=2)
    text = ["f takes no argument", "f(x) or f(x, u)"]
    check(ModelError, text, system_of, lambda: np.ones(2), m=1)
    check(ModelError, ["rate returned shape (3,)", "expected (2,)"], ode, lambda x: np.ones(3))
    check(ModelError, ["rate changes its argument in place"], ode, double)


@pytest.mark.parametrize("name", ["f", "h"])
def test_functions_without_a_value_at_the_initial_state(name):
    def odd(x):
        if x[0] > 10.0:
            return np.ones(3)
        raise ValueError("out of reach")

    start = "initial state [1.0, 2.0]"
    for function, text, at in (
        (lambda x: 1 // 0, ["raised ZeroDivisionError: ", "[1.0, 2.0]"], 1.0),
        (lambda x: np.sqrt(x - 1.5), ["[nan, 0.70", start, "finite"], 1.0),
        (lambda x: 1.0 / (x - 1.0), ["[inf, 1.0]", start, "finite"], 1.0),
        (odd, ["returned shape (3,)", "expected (2,)"], 12.0),
    ):
        functions = {"f": lambda x: x, "h": lambda x: x, name: function}
        check(
            ModelError, [name, *text], estimator, qpmhe.System(**functions, n=2, p=2),
            qpmhe.Luenberger(np.eye(2)), cost_of(2, 2), initial_state=[at, 2.0],
        )
