"""Differential equations: the methods, the ways of writing a rate, steps of any length."""

import itertools
import math

import numpy as np
import pytest

import qpmhe

from . import plain
from .spoil import estimator
from .ways import NONE


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


def in_place(x):
    value = np.empty_like(x)
    value[..., 0], value[..., 1] = x[..., 1], -np.sin(x[..., 0])
    return value


@pytest.mark.parametrize("method", [plain.euler, plain.rk4])
def test_every_way_of_writing_the_rate(method):
    for rate in (
        in_place, lambda x: np.array([x[1], -np.sin(x[0])]), lambda x: (x[1], -np.sin(x[0])),
        lambda x: np.array([x[1], -math.sin(x[0])]), lambda x: [x[1], -math.sin(x[0])],
    ):
        def step(x, dt=0.1):
            return method(lambda x, u: in_place(x))(x, None, dt)

        options = {"dt": 0.1, "n": 2, "p": 1, "method": method.__name__}
        system = qpmhe.System.from_ode(rate, lambda x: x[..., :1], **options)
        given = qpmhe.System.from_ode(
            rate, lambda x: x[..., :1], **options, h_jacobian=lambda x: np.eye(1, 2),
            rate_jacobian=lambda x: np.array([[0.0, 1.0], [-np.cos(x[0]), 0.0]]),
        )
        assert (given.f_jacobian.method, given.h_jacobian.method) == ("given", "given")
        check(system, step)
        check(given, step, lambda x, step=step: plain.differences(step, x))
        for one, dt in itertools.product((system, given), (0.02, 1.0)):  # of any length
            found = one.timed.f(np.array([0.4, -0.7]), np.array([dt]))
            np.testing.assert_allclose(found, step(np.array([0.4, -0.7]), dt), rtol=1e-12)


def test_what_the_timed_system_keeps_and_a_step_of_the_usual_length():
    box = qpmhe.Box([-9.0, -9.0], [9.0, 9.0])
    system = qpmhe.System.from_ode(
        lambda x, u: in_place(x), lambda x, u: x[..., :1] * u[..., :1], dt=0.1, n=2, p=1, m=1,
        states=box, disturbances=box,
    )
    timed = system.timed
    assert timed.states is timed.disturbances is box
    # Outputs do not see the step.
    np.testing.assert_allclose(timed.h(np.array([0.5, 1.0]), np.array([3.0, 0.7])), [1.5])
    one, other = (estimator(system, qpmhe.Luenberger([0.3, 0.1])) for _ in range(2))
    for t, y in enumerate(np.random.default_rng(4).standard_normal(8)):
        # A weight of one output may be a scalar.
        plainly = one.update(y, 1.0, noise_weight=[[2.0]])
        named = other.update(y, 1.0, dt=0.1 if t % 3 else None, noise_weight=2.0)
        np.testing.assert_allclose(named.trajectory, plainly.trajectory, rtol=1e-9, atol=1e-10)
