"""Jacobians of the user's own: compared with differences, then used as they are."""

import json
import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import ModelError

NONE = np.zeros(0)
LINEAR = np.array([[1.0, 0.1], [-0.2, 0.9]])


def system_of(f, n=2, **options):
    options.setdefault("scales", np.ones(n))
    return qpmhe.System(f, lambda x: x[..., :1], n=n, p=1, **options)


def spiral(x):
    return np.stack([x[..., 0] * x[..., 1], np.sin(x[..., 0]) + 2.0 * x[..., 1]], axis=-1)


def spiral_jacobian(x):
    return np.array([[x[1], x[0]], [np.cos(x[0]), 2.0]])


@pytest.mark.parametrize("wrong", [0.05, -3.0, 1e4])
@pytest.mark.parametrize("entry", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_wrong_entry_is_named_with_both_values(entry, wrong):
    def jacobian(x):
        value = spiral_jacobian(x)
        value[entry] += wrong
        return value

    with pytest.raises(ModelError) as caught:
        system_of(spiral, f_jacobian=jacobian)
    text = str(caught.value)
    assert f"f_jacobian[{entry[0]}, {entry[1]}] is " in text
    x = np.array(json.loads(text.split("x = ")[1].split(", but")[0]))
    assert f"is {jacobian(x)[entry]:.6g} at" in text
    right = float(text.split("there is ")[1].split(". Correct")[0])
    assert right == pytest.approx(spiral_jacobian(x)[entry], rel=1e-5)


def test_a_wrong_entry_of_the_output_jacobian_is_named():
    with pytest.raises(ModelError, match=r"h_jacobian\[1, 0\] is 3 "):
        qpmhe.System(
            spiral, lambda x: x * np.array([1.0, 2.0]), n=2, p=2,
            h_jacobian=lambda x: np.array([[1.0, 0.0], [3.0, 2.0]]), scales=[1.0, 1.0],
        )


def test_a_wrong_entry_of_the_rate_jacobian_is_named():
    with pytest.raises(ModelError, match=r"rate_jacobian\[0, 1\] is "):
        qpmhe.System.from_ode(
            spiral, lambda x: x[..., :1], dt=1e-6, n=2, p=1,
            rate_jacobian=lambda x: spiral_jacobian(x) + np.array([[0.0, 1.0], [0.0, 0.0]]),
            scales=[1.0, 1.0],
        )


def test_a_transposed_jacobian_is_refused():
    with pytest.raises(ModelError, match=r"f_jacobian\[\d, \d\] is .* leave it out"):
        system_of(lambda x: x @ LINEAR.T, f_jacobian=lambda x: LINEAR.T)


@pytest.mark.parametrize("big", [1e3, 1e6])
def test_a_row_of_large_units_hides_no_wrong_entry(big):
    with pytest.raises(ModelError, match=r"f_jacobian\[1, 1\] is 1.5 "):
        system_of(
            lambda x: x * np.array([big, 1.0]), f_jacobian=lambda x: np.diag([big, 1.5])
        )


@pytest.mark.parametrize("shape", [(2,), (3, 2), (2, 2, 1), (4,), ()])
def test_a_jacobian_of_the_wrong_shape_is_refused(shape):
    with pytest.raises(ModelError) as caught:
        system_of(spiral, f_jacobian=lambda x: np.ones(shape))
    assert f"f_jacobian returned shape {shape}" in str(caught.value)
    assert "expected (2, 2)" in str(caught.value)


@pytest.mark.parametrize(
    "jacobian",
    [
        pytest.param(spiral_jacobian, id="one state"),
        pytest.param(lambda x: [[x[1], x[0]], [math.cos(x[0]), 2.0]], id="list, math"),
        pytest.param(
            lambda x: np.stack(
                [
                    np.stack([x[..., 1], x[..., 0]], axis=-1),
                    np.stack([np.cos(x[..., 0]), 2.0 + 0.0 * x[..., 0]], axis=-1),
                ],
                axis=-2,
            ),
            id="batched",
        ),
        pytest.param(
            lambda x: np.array([[x[1], x[0]], [np.cos(x[0]), 2.0 + 0.0 * x[0]]]), id="columns"
        ),
    ],
)
def test_right_jacobians_are_used_as_given(jacobian):
    system = system_of(spiral, f_jacobian=jacobian)
    assert (system.f_jacobian.method, system.h_jacobian.method) == ("given", "complex step")
    x = np.random.default_rng(6).standard_normal((5, 2))
    expected = [spiral_jacobian(xi) for xi in x]
    np.testing.assert_allclose(
        system.f_jacobian.batch(x, np.zeros((5, 0))), expected, rtol=1e-14
    )
    np.testing.assert_allclose(system.f_jacobian(x[2], NONE), expected[2], rtol=1e-14)


def test_a_constant_jacobian_serves_all_states():
    system = system_of(lambda x: x @ LINEAR.T, f_jacobian=lambda x: LINEAR)
    found = system.f_jacobian.batch(np.ones((4, 2)), np.zeros((4, 0)))
    np.testing.assert_array_equal(found, [LINEAR] * 4)


@pytest.mark.parametrize("written", [[0.0, 2.0], [[0.0, 2.0]]])
def test_the_gradient_of_a_single_output_may_be_a_vector(written):
    system = qpmhe.System(
        spiral, lambda x: 2.0 * x[..., 1:], n=2, p=1, h_jacobian=lambda x: np.array(written)
    )
    assert system.h_jacobian.batch(np.ones((3, 2)), np.zeros((3, 0))).shape == (3, 1, 2)
    np.testing.assert_array_equal(system.h_jacobian(np.ones(2), NONE), [[0.0, 2.0]])


def test_a_jacobian_that_ignores_the_input():
    system = system_of(
        lambda x, u: x * 2.0 + u, m=2, f_jacobian=lambda x: 2.0 * np.eye(2)
    )
    assert system.f_jacobian.method == "given"
    found = system.f_jacobian.batch(np.ones((3, 2)), np.ones((3, 2)))
    np.testing.assert_array_equal(found, [2.0 * np.eye(2)] * 3)


def test_a_jacobian_that_is_wrong_at_the_initial_state_is_refused_there():
    # At the probes, near one, the wrong term is lost among the others.
    system = system_of(
        lambda x: x + 1e-9 * x**4, f_jacobian=lambda x: np.diag(1.0 + 0.0 * x)
    )
    system.check(np.array([1.0, 2.0]), NONE)
    with pytest.raises(ModelError) as caught:
        system.check(np.array([1.0, 1000.0]), NONE)
    assert "f_jacobian[1, 1] is 1 at x = [1.0, 1000.0]" in str(caught.value)
    assert "there is 5" in str(caught.value)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)
    with pytest.raises(ModelError, match=r"f_jacobian\[1, 1\] is 1 at"):
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.1, 0.1]), cost, horizon=2, initial_state=[1.0, 1000.0]
        )


def test_a_jacobian_that_changes_its_argument_is_refused():
    def jacobian(x):
        x *= 2.0
        return np.diag(x)

    with pytest.raises(ModelError, match="f_jacobian changes its argument in place"):
        system_of(lambda x: x**2, f_jacobian=jacobian)


def test_at_a_kink_any_slope_between_the_sides_is_a_derivative():
    def kinked(x):
        return np.where(x > 0, 0.9 * x, 0.3 * x)

    for slope in (0.3, 0.6, 0.9):
        system = qpmhe.System(
            kinked, lambda x: x, n=1, p=1, scales=[1.0],
            f_jacobian=lambda x, slope=slope: np.where(
                x > 0, 0.9, np.where(x < 0, 0.3, slope)
            )[..., None],
        )
        system.check(np.zeros(1), np.zeros(0))
    wrong = qpmhe.System(
        kinked, lambda x: x, n=1, p=1, scales=[1.0],
        f_jacobian=lambda x: np.where(x > 0, 0.9, np.where(x < 0, 0.3, 1.2))[..., None],
    )
    with pytest.raises(qpmhe.errors.ModelError, match=r"is 1\.2 at"):
        wrong.check(np.zeros(1), np.zeros(0))
