import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import ModelError, OptionError

from .spoil import A, check, cost_of, estimator, system_of


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
        ModelError, ["f needs 2 arguments", "pass m"],
        lambda: system_of(lambda x, u: x),
    )
    check(
        ModelError, ["h needs 2 arguments", "pass m"],
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
        OptionError, [f"method is {method!r}", "'euler', 'rk4'"],
        lambda: qpmhe.System.from_ode(
            lambda x: -x, lambda x: x, dt=0.1, n=1, p=1, method=method
        ),
    )


def test_a_rate_of_the_wrong_shape():
    check(
        ModelError, ["rate returned shape (3,)", "expected (2,)"],
        lambda: qpmhe.System.from_ode(lambda x: np.ones(3), lambda x: x[:1], dt=0.1, n=2, p=1),
    )
