"""Differences of a function that takes many states at once: by one call, checked, and no more."""

import numpy as np
import pytest

import qpmhe

from ..estimation.untraced import untraced

A = np.array([[0.9, 0.2], [-0.1, 0.7]])
X, U = np.array([[1.0, -2.0], [0.3, 5.0], [-4.0, 0.1]]), np.zeros((3, 0))


def vectorised(x):
    first = x[..., 0]
    return np.stack((first - 0.1 * first * first, x[..., 1] + 0.1 * np.sin(first)), -1)


def jacobian(x):
    return np.array([[1.0 - 0.2 * x[0], 0.0], [0.1 * np.cos(x[0]), 1.0]])


def counted(function):
    """The function, untraced, and the shapes of the states that it is called with."""
    shapes = []

    def call(x):
        shapes.append(x.shape)
        return function(x)

    return untraced(call), shapes


def slopes(function, **options):
    """Jacobians of f at `X`, as an estimator that starts at the first state computes them."""
    f, shapes = counted(function)
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1, **options)
    system = system.evaluated_by(system.model()).at(X[0], U[0])
    assert system.derivatives["f"] == "finite differences"
    del shapes[:]
    return system.f_jacobian.batch(X, U), shapes


@pytest.mark.parametrize("options", [
    {}, {"states": qpmhe.Box([-4.0, -2.0], [1.0, 5.0])},  # each state is in a corner
], ids=["free", "bounded"])
def test_one_call_serves_all_states(options):
    found, shapes = slopes(vectorised, **options)
    np.testing.assert_allclose(found, [jacobian(x) for x in X], rtol=1e-8, atol=1e-9)
    many = [shape for shape in shapes if len(shape) == 2]
    assert many == [(12, 2)]  # 3 states, 2 components, 2 sides
    assert len(shapes) - len(many) == (4 if options else 1)  # values, and the one compared


@pytest.mark.parametrize("function", [
    lambda x: A @ x,  # a matrix of two states passes, the values do not
    lambda x: np.array([x[0], x[1] * x[0]]),
    lambda x: x / (1.0 + np.linalg.norm(x)),  # of all states together
], ids=["product", "entries", "norm"])
def test_a_function_of_one_state_is_called_state_by_state(function):
    found, shapes = slopes(function)
    assert set(shapes) == {(2,)}
    alone = [slopes_at(function, x) for x in X]
    np.testing.assert_allclose(found, alone, rtol=1e-7, atol=1e-8)


def test_a_branch_that_another_state_takes_is_noticed():
    def function(x):
        return np.where(x.max() > 4.0, 2.0 * x, x)

    found, shapes = slopes(function)  # the second state of `X` alone is beyond the branch
    assert (12, 2) in shapes
    np.testing.assert_allclose(found, [np.eye(2), 2.0 * np.eye(2), np.eye(2)], rtol=1e-8)


def slopes_at(function, x):
    steps = 1e-6 * np.eye(2)
    return np.transpose([(function(x + d) - function(x - d)) / 2e-6 for d in steps])


def test_a_batch_that_goes_wrong_later_is_noticed_and_made_good():
    many = []

    def changing(x):
        if x.ndim == 2 and len(many) > 4:
            return vectorised(x) + 0.1 * np.abs(x).max()
        many.extend([0] * (x.ndim == 2))
        return vectorised(x)

    system = qpmhe.System(untraced(changing), lambda x: x[..., :1], n=2, p=1)
    system = system.evaluated_by(system.model()).at(X[0], U[0])
    many.extend(range(9))
    for _ in range(2):
        found = system.f_jacobian.batch(X, U)
        np.testing.assert_allclose(found, [jacobian(x) for x in X], rtol=1e-8, atol=1e-9)
    assert not system.f_jacobian._at_once


def test_no_value_of_the_step_comes_from_such_a_call():
    """J of each trial, and the observer, are evaluated state by state."""
    f, shapes = counted(vectorised)
    made = {"n": 2, "p": 1}
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=9.0 * np.eye(2), noise=4.0)
    options = {
        "horizon": 3, "initial_state": X[0], "max_qps": 2, "engine": "python", "backend": "banded",
    }

    def run(system):
        observer = qpmhe.Luenberger([[0.3], [0.1]])
        mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, **options)
        return mhe.run(np.linspace(1.0, 0.2, 8)[:, None])

    found = run(qpmhe.System(f, lambda x: x[..., :1], **made))
    assert any(len(shape) == 2 for shape in shapes)
    exact = run(qpmhe.System(f, lambda x: x[..., :1], f_jacobian=jacobian, **made))
    np.testing.assert_array_equal(found.candidate_costs, exact.candidate_costs)
    np.testing.assert_allclose(found.states, exact.states, rtol=1e-6)
