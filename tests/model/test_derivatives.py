"""Jacobians: of expressions, by differences, or the user's own, in any unit."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import ModelError
from tests.estimation.spoil import check
from tests.estimation.untraced import untraced

NONE = np.zeros(0)
DIFFERENCES = "finite differences"
LINEAR = np.array([[1.0, 0.1], [-0.2, 0.9]])


def system_of(f, jacobian=None, n=2, **options):
    """Of a function that is called as it is written."""
    written = untraced(f)
    return qpmhe.System(written, lambda x: x[..., :1], n=n, p=1, f_jacobian=jacobian, **options)


def estimator(system, deviation, gain, start, noise=1.0):
    """Costs in the unit of the deviation."""
    prior = deviation**2 * np.eye(system.n)
    cost = qpmhe.QuadraticCost.from_covariances(prior=prior, disturbance=prior / 100, noise=noise)
    observer = gain if isinstance(gain, qpmhe.Observer) else qpmhe.Luenberger(gain)
    return qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=3, initial_state=start)


def compare(jacobian, points, expected, **tolerance):
    """One state at a time, and all at once."""
    points = np.array(points)
    singles = [jacobian(x, NONE) for x in points]
    np.testing.assert_allclose(singles, expected, **tolerance)
    batch = jacobian.batch(points, np.zeros((len(points), 0)))
    np.testing.assert_allclose(batch, expected, **tolerance)


# Functions as they are written


def components(a, b, c):
    return [np.exp(0.3 * a) * np.sin(b), a * b / (1.0 + c * c), np.tanh(c) + np.sqrt(a)]


def slopes(a, b, c):
    e, square = math.exp(0.3 * a), 1.0 + c * c
    return [
        [0.3 * e * math.sin(b), e * math.cos(b), 0.0],
        [b / square, a / square, -2.0 * a * b * c / square**2],
        [0.5 / math.sqrt(a), 0.0, 1.0 - math.tanh(c) ** 2],
    ]


@pytest.mark.parametrize("f", [
    lambda x: np.stack(components(x[..., 0], x[..., 1], x[..., 2]), axis=-1),
    lambda x: np.array(components(*x)), lambda x: components(*x),
])
def test_derivatives_of_expressions_are_exact_and_others_are_differences(f):
    points = np.random.default_rng(1).uniform(0.1, 4.0, (20, 3))
    expected = [slopes(*x) for x in points]
    exact, written = qpmhe.System(f, lambda x: x[..., :1], n=3, p=1), system_of(f, n=3)
    assert (exact.f_jacobian.method, written.f_jacobian.method) == ("traced", DIFFERENCES)
    compare(exact.f_jacobian, points, expected, rtol=1e-12, atol=1e-15)
    compare(written.f_jacobian, points, expected, rtol=1e-9, atol=1e-9)


def real_array(x):
    value = np.zeros(2)
    value[0] = x[0] ** 2
    value[1] = x[0] * x[1]
    return value


def test_differences_of_functions_with_kinks_and_of_all_sizes():
    generator = np.random.default_rng(2)
    points = generator.uniform(0.2, 3.0, (10, 2)) * generator.choice([-1.0, 1.0], (10, 2))
    for f, jacobian in (
        (lambda x: np.abs(x) * x[..., ::-1],
         lambda a, b: [[np.sign(a) * b, abs(a)], [abs(b), np.sign(b) * a]]),
        (lambda x: [float(x[0]) ** 2, x[1]], lambda a, b: [[2 * a, 0], [0, 1]]),
        (real_array, lambda a, b: [[2 * a, 0], [b, a]]),
        # Rows of large units hide nothing.
        (lambda x: np.stack([1e6 * x[..., 0], np.abs(x[..., 1])], axis=-1),
         lambda a, b: [[1e6, 0.0], [0.0, np.sign(b)]]),
    ):
        system = system_of(f)
        assert system.f_jacobian.method == DIFFERENCES
        expected = np.array([jacobian(*x) for x in points])
        size = min(np.abs(expected).max(initial=1.0), 1e3)
        compare(system.f_jacobian, points, expected, rtol=1e-6, atol=1e-6 * size)


def test_functions_that_are_others_at_the_probes_than_where_they_are_used():
    for f, at, expected in (
        # A reaction rate is flat at one kelvin, and steep at the temperatures of use.
        (lambda x: [x[0] - 0.1 * x[0] * math.exp(10.0 - 3500.0 / x[1]), x[1]], [2.0, 350.0],
         [[0.9, -0.2 * 3500.0 / 350.0**2], [0.0, 1.0]]),
        # No value at the probes.
        (lambda x: np.sqrt(x - 10.0), [12.0, 14.0], np.diag([0.5 / 2**0.5, 0.25])),
        # Another function above a threshold that no probe reaches.
        (lambda x: [math.exp(float(x[0]) - 100.0) if x[0] > 90.0 else x[0] ** 2, x[1]],
         [100.0, 1.0], np.eye(2)),
    ):
        system, x = system_of(f), np.array(at)
        system = system.at(x, NONE)
        assert system.f_jacobian.method == DIFFERENCES
        np.testing.assert_allclose(system.f_jacobian(x, NONE), expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e8])
def test_differences_at_a_bound_go_inwards(unit):
    def f(x):
        """Defined for x >= 0 alone, and for real numbers alone."""
        a, b = x / unit
        return [unit * (0.5 * math.sqrt(a) * a + 0.1 * b), unit * (b**1.5 + math.sqrt(a) * a)]

    box = qpmhe.Box([0.0, 0.0], [np.inf, np.inf])
    system = system_of(f, states=box, scales=[unit, unit])
    for share in (0.0, 1e-12, 1e-7, 0.1):
        for a, b in ((share, 1.0), (1.0, share), (share, share)):
            np.testing.assert_allclose(
                system.f_jacobian(unit * np.array([a, b]), NONE),
                [[0.75 * math.sqrt(a), 0.1], [1.5 * math.sqrt(a), 1.5 * math.sqrt(b)]],
                rtol=1e-6, atol=5e-3,  # of a root of a third order, a quotient of second order
            )


def test_differences_at_an_upper_bound_are_of_second_order():
    def f(x):
        if x[0] > 1.0:
            raise ValueError("beyond the bound")
        return [math.exp(float(x[0]))]

    system = system_of(f, n=1, states=qpmhe.Box([-1.0], [1.0]), scales=[1.0])
    points = np.array([[1.0], [1.0 - 1e-9], [0.5], [-1.0]])
    compare(system.f_jacobian, points, np.exp(points)[..., None], rtol=1e-9)


# Jacobians of the user's own


def spiral(x):
    return np.stack([x[..., 0] * x[..., 1], np.sin(x[..., 0]) + 2.0 * x[..., 1]], axis=-1)


def slope(x):
    return np.array([[x[1], x[0]], [np.cos(x[0]), 2.0]])


def test_a_wrong_entry_is_named_with_both_values():
    for entry in np.ndindex(2, 2):
        def jacobian(x, entry=entry):
            value = slope(x)
            value[entry] += 0.05
            return value

        words = [f"f_jacobian[{entry[0]}, {entry[1]}] is ", "but the derivative"]
        check(ModelError, words, system_of, spiral, jacobian, scales=[1.0, 1.0])


def test_wrong_jacobians():
    check(
        ModelError, ["rate_jacobian[0, 1] is "], qpmhe.System.from_ode, spiral, lambda x: x,
        rate_jacobian=lambda x: slope(x) + np.eye(2, k=1), dt=1e-6, n=2, p=2, scales=[1.0, 1.0],
    )
    for text, f, jacobian in (
        (["f_jacobian[", "leave it out"], lambda x: x @ LINEAR.T, lambda x: LINEAR.T),
        # A row of large units hides no wrong entry.
        (["f_jacobian[1, 1] is 1.5 "], lambda x: x * np.array([1e6, 1.0]),
         lambda x: np.diag([1e6, 1.5])),
        (["f_jacobian returned shape (3, 2)", "expected (2, 2)"], spiral, lambda x: np.ones((3, 2)))
    ):
        check(ModelError, text, system_of, f, jacobian, scales=[1.0, 1.0])
    # At the probes, near one, the wrong term is lost among the others.
    system = system_of(lambda x: x + 1e-9 * x**4, lambda x: np.diag(1.0 + 0.0 * x))
    words = ["f_jacobian[1, 1] is 1 at x = [1.0, 1000.0]", "there is 5"]
    check(ModelError, words, estimator, system, 1.0, [0.1, 0.1], [1.0, 1000.0])


def test_right_jacobians_are_used_as_given():
    x = np.random.default_rng(6).standard_normal((5, 2))
    for jacobian in (
        slope, lambda x: [[x[1], x[0]], [math.cos(x[0]), 2.0]],
        lambda x: np.array([[x[1], x[0]], [np.cos(x[0]), 2.0 + 0.0 * x[0]]]),
    ):
        system = system_of(spiral, jacobian)
        assert (system.f_jacobian.method, system.h_jacobian.method) == ("given", "traced")
        compare(system.f_jacobian, x, [slope(xi) for xi in x], rtol=1e-14)
    linear = system_of(lambda x: x @ LINEAR.T, lambda x: LINEAR)
    compare(linear.f_jacobian, x, [LINEAR] * 5)
    system = qpmhe.System(  # of one output a vector will do
        spiral, lambda x: 2.0 * x[..., 1:], n=2, p=1, h_jacobian=lambda x: np.array([0.0, 2.0])
    )
    compare(system.h_jacobian, np.ones((3, 2)), [[[0.0, 2.0]]] * 3)
