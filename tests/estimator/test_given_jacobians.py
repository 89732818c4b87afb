"""Jacobians of the user's own: compared with differences, then used as they are."""

import json
import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import ModelError

from .spoil import check

NONE = np.zeros(0)
LINEAR = np.array([[1.0, 0.1], [-0.2, 0.9]])


def system_of(f, jacobian, n=2, **options):
    return qpmhe.System(
        f, lambda x: x[..., :1], n=n, p=1, f_jacobian=jacobian, scales=np.ones(n), **options
    )


def spiral(x):
    return np.stack([x[..., 0] * x[..., 1], np.sin(x[..., 0]) + 2.0 * x[..., 1]], axis=-1)


def slope(x):
    return np.array([[x[1], x[0]], [np.cos(x[0]), 2.0]])


@pytest.mark.parametrize("wrong", [0.05, -3.0, 1e4])
def test_a_wrong_entry_is_named_with_both_values(wrong):
    for entry in np.ndindex(2, 2):
        def jacobian(x, entry=entry):
            value = slope(x)
            value[entry] += wrong
            return value

        with pytest.raises(ModelError) as caught:
            system_of(spiral, jacobian)
        text = str(caught.value)
        assert f"f_jacobian[{entry[0]}, {entry[1]}] is " in text
        x = np.array(json.loads(text.split("x = ")[1].split(", but")[0]))
        assert f"is {jacobian(x)[entry]:.6g} at" in text
        right = float(text.split("there is ")[1].split(". Correct")[0])
        assert right == pytest.approx(slope(x)[entry], rel=1e-5)


def changing(x):
    x *= 2.0
    return np.diag(x)


def test_wrong_jacobians():
    big, sizes = np.array([1e6, 1.0]), {"n": 2, "p": 2, "scales": [1.0, 1.0]}
    check(
        ModelError, ["h_jacobian[1, 0] is 3 "], qpmhe.System, spiral, lambda x: x * [1.0, 2.0],
        h_jacobian=lambda x: np.array([[1.0, 0.0], [3.0, 2.0]]), **sizes,
    )
    check(
        ModelError, ["rate_jacobian[0, 1] is "], qpmhe.System.from_ode, spiral, lambda x: x,
        rate_jacobian=lambda x: slope(x) + np.eye(2, k=1), dt=1e-6, **sizes,
    )
    for text, f, jacobian in (
        (["f_jacobian[", "leave it out"], lambda x: x @ LINEAR.T, lambda x: LINEAR.T),
        # A row of large units hides no wrong entry.
        (["f_jacobian[1, 1] is 1.5 "], lambda x: x * big, lambda x: np.diag([1e6, 1.5])),
        (["f_jacobian changes its argument in place"], lambda x: x**2, changing),
    ):
        check(ModelError, text, system_of, f, jacobian)
    for shape in ((2,), (3, 2), (2, 2, 1), ()):
        text = [f"f_jacobian returned shape {shape}", "expected (2, 2)"]
        check(ModelError, text, system_of, spiral, lambda x, shape=shape: np.ones(shape))


@pytest.mark.parametrize(
    "jacobian", [
        slope,
        lambda x: [[x[1], x[0]], [math.cos(x[0]), 2.0]],
        lambda x: np.stack([
            np.stack([x[..., 1], x[..., 0]], axis=-1),
            np.stack([np.cos(x[..., 0]), 2.0 + 0.0 * x[..., 0]], axis=-1),
        ], axis=-2),
        lambda x: np.array([[x[1], x[0]], [np.cos(x[0]), 2.0 + 0.0 * x[0]]]),
    ], ids=["one state", "list, math", "batched", "columns"],
)
def test_right_jacobians_are_used_as_given(jacobian):
    system = system_of(spiral, jacobian)
    assert (system.f_jacobian.method, system.h_jacobian.method) == ("given", "complex step")
    x = np.random.default_rng(6).standard_normal((5, 2))
    expected = [slope(xi) for xi in x]
    found = system.f_jacobian.batch(x, np.zeros((5, 0)))
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    np.testing.assert_allclose(system.f_jacobian(x[2], NONE), expected[2], rtol=1e-14)


def test_constant_jacobians():
    for f, m in ((lambda x: x @ LINEAR.T, 0), (lambda x, u: x @ LINEAR.T + u, 2)):
        system = system_of(f, lambda x: LINEAR, m=m)
        found = system.f_jacobian.batch(np.ones((4, 2)), np.ones((4, m)))
        np.testing.assert_array_equal(found, [LINEAR] * 4)
    for written in ([0.0, 2.0], [[0.0, 2.0]]):  # of one output a vector will do
        system = qpmhe.System(
            spiral, lambda x: 2.0 * x[..., 1:], n=2, p=1,
            h_jacobian=lambda x, written=written: np.array(written),
        )
        assert system.h_jacobian.batch(np.ones((3, 2)), np.zeros((3, 0))).shape == (3, 1, 2)
        np.testing.assert_array_equal(system.h_jacobian(np.ones(2), NONE), [[0.0, 2.0]])


def test_a_jacobian_that_is_wrong_at_the_initial_state_is_refused_there():
    # At the probes, near one, the wrong term is lost among the others.
    system = system_of(lambda x: x + 1e-9 * x**4, lambda x: np.diag(1.0 + 0.0 * x))
    system.check(np.array([1.0, 2.0]), NONE)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)
    check(
        ModelError, ["f_jacobian[1, 1] is 1 at x = [1.0, 1000.0]", "there is 5"],
        qpmhe.MovingHorizonEstimator, system, qpmhe.Luenberger([0.1, 0.1]), cost, horizon=2,
        initial_state=[1.0, 1000.0],
    )


def test_at_a_kink_any_slope_between_the_sides_is_a_derivative():
    def at_zero(slope):
        system = system_of(
            lambda x: np.where(x > 0, 0.9 * x, 0.3 * x),
            lambda x: np.where(x > 0, 0.9, np.where(x < 0, 0.3, slope))[..., None], n=1,
        )
        system.check(np.zeros(1), NONE)

    for between in (0.3, 0.6, 0.9):
        at_zero(between)
    check(ModelError, ["is 1.2 at"], at_zero, 1.2)
