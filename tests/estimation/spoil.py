"""An estimator that works, for tests that spoil one thing about it."""

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, QpmheError

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


def observer_alone(system, observer, start, **options):
    """An estimator without QPs, if nothing else is asked for."""
    options = {"initial_state": start, "max_qps": 0} | options
    return estimator(system, observer, cost_of(system.n, system.p), **options)


def with_input():
    return estimator(system_of(lambda x, u: x @ A.T + u, m=2))


def check(kind, fragments, build, /, *arguments, **options):
    """That build raises our own error of this kind, with the fragments in its message."""
    with pytest.raises(kind) as caught:
        build(*arguments, **options)
    error, text = caught.value, str(caught.value)
    assert isinstance(error, InvalidInputError)
    assert isinstance(error, QpmheError)
    assert isinstance(error, ValueError)
    for fragment in fragments:
        assert fragment in text


def unharmed(build, calls, sample):
    """Errors between samples change nothing that comes after, bit for bit."""
    spoilt, twin = build(), build()
    for _ in range(5):
        for kind, fragments, call in calls:
            before, time = spoilt.state.copy(), spoilt.time
            check(kind, fragments, call, spoilt)
            assert spoilt.time == time
            np.testing.assert_array_equal(spoilt.state, before)
        one, other = spoilt.update(*sample), twin.update(*sample)
        np.testing.assert_array_equal(one.trajectory, other.trajectory)
        np.testing.assert_array_equal(one.candidate, other.candidate)
        assert (one.time, one.cost, one.candidate_cost) == (
            other.time, other.cost, other.candidate_cost
        )
