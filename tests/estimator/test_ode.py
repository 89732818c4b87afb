"""Differential equations: the methods, the ways of writing a rate, its Jacobian."""

import itertools
import math

import numpy as np

import qpmhe

from . import plain

NONE = np.zeros(0)


def check(system, step, slope=None):
    """One state, and states over leading dimensions, against a step of one state."""
    x = np.random.default_rng(1).uniform(0.3, 2.0, (2, 3, system.n))
    rows = x.reshape(-1, system.n)
    for function, expected in ((system.f, step), (system.f_jacobian, slope)):
        if expected is not None:
            values = np.array([expected(row) for row in rows])
            np.testing.assert_allclose(function(rows[0], NONE), values[0], rtol=1e-12, atol=1e-14)
            found = function.batch(x, np.zeros((2, 3, 0)))
            assert found.shape == (2, 3, *values.shape[1:])
            np.testing.assert_allclose(found.reshape(values.shape), values, rtol=1e-12, atol=1e-14)


def test_linear_rates_give_the_truncated_exponential():
    rate = np.array([[-0.5, 2.0], [-1.0, -0.2]])
    for (method, degree), dt in itertools.product({"euler": 1, "rk4": 4}.items(), (0.01, 0.3)):
        step, term = np.eye(2), np.eye(2)
        for k in range(1, degree + 1):
            term = term @ (dt * rate) / k
            step = step + term
        system = qpmhe.System.from_ode(
            lambda x: x @ rate.T, lambda x: x[..., :1], dt=dt, n=2, p=1, method=method
        )
        check(system, lambda x, step=step: step @ x, lambda x, step=step: step)


def in_place(x):
    value = np.empty_like(x)
    value[..., 0], value[..., 1] = x[..., 1], -np.sin(x[..., 0])
    return value


def test_every_way_of_writing_the_rate():
    for method, rate in itertools.product((plain.euler, plain.rk4), (
        in_place, lambda x: np.array([x[1], -np.sin(x[0])]), lambda x: [x[1], -np.sin(x[0])],
        lambda x: (x[1], -np.sin(x[0])), lambda x: np.array([x[1], -math.sin(x[0])]),
        lambda x: [x[1], -math.sin(x[0])],
    )):
        def step(x, method=method):
            return method(lambda x, u: in_place(x))(x, None, 0.1)

        options = {"dt": 0.1, "n": 2, "p": 1, "method": method.__name__}
        check(qpmhe.System.from_ode(rate, lambda x: x[..., :1], **options), step)
        given = qpmhe.System.from_ode(
            rate, lambda x: x[..., :1], **options, h_jacobian=lambda x: np.eye(1, 2),
            rate_jacobian=lambda x: np.array([[0.0, 1.0], [-np.cos(x[0]), 0.0]]),
        )
        assert (given.f_jacobian.method, given.h_jacobian.method) == ("given", "given")
        check(given, step, lambda x, step=step: plain.differences(step, x))


def test_the_default_method_is_rk4():
    default, named, euler = (
        qpmhe.System.from_ode(lambda x: -(x**3), lambda x: x, dt=0.2, n=1, p=1, **method)
        for method in ({}, {"method": "rk4"}, {"method": "euler"})
    )
    x = np.array([1.3])
    assert default.f(x, NONE) == named.f(x, NONE) != euler.f(x, NONE)


def test_rates_of_one_state_with_jacobians():
    for rate in (lambda x: -(x**3), lambda x: -(x[0] ** 3), lambda x: -math.pow(x[0], 3)):
        for jacobian in (
            lambda x: np.array([[-3.0 * x[0] ** 2]]), lambda x: [[-3.0 * x[0] ** 2]],
            lambda x: -3.0 * x[..., None] ** 2,
        ):
            system = qpmhe.System.from_ode(
                rate, lambda x: x[0], dt=0.1, n=1, p=1, method="euler", rate_jacobian=jacobian
            )
            check(system, lambda x: x - 0.1 * x**3, lambda x: 1.0 - 0.3 * x[:, None] ** 2)
