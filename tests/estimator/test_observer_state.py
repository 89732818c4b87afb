"""z(t+1), the observer's own state, beside each estimate and along a run."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

GAIN = np.array([[0.4], [0.1]])
A = np.array([[0.9, 0.2], [-0.1, 0.7]])


def made(f=lambda x: x @ A.T, horizon=3, **options):
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=4.0 * np.eye(2), noise=3.0)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost, horizon=horizon, initial_state=[1.0, -1.0],
        engine="python", **options,
    )


@pytest.mark.parametrize("arrival", ["observer", "smoothed"])
def test_it_is_the_observer_whatever_becomes_of_the_estimate(arrival):
    mhe, z = made(arrival=arrival, warm_start=True), np.array([1.0, -1.0])
    np.testing.assert_array_equal(mhe.observer_state, z)
    for y in np.random.default_rng(0).standard_normal(9):
        z = A @ z + GAIN[:, 0] * (y - z[0])
        estimate = mhe.update([y])
        np.testing.assert_allclose(estimate.observer_state, z, rtol=1e-12)
        np.testing.assert_array_equal(mhe.observer_state, estimate.observer_state)
        assert not np.allclose(estimate.state, z)


def test_the_caller_may_change_it():
    mhe, other = made(), made()
    for y in (0.3, -0.4, 0.5):
        estimate, expected = mhe.update([y]), other.update([y])
        np.testing.assert_array_equal(estimate.observer_state, expected.observer_state)
        estimate.observer_state[:] = 1e6


def test_a_reinitialized_candidate_ends_in_its_own_observer():
    mhe = made(candidate="reinitialized")
    for y in np.random.default_rng(1).standard_normal(8):
        estimate = mhe.update([y])
        np.testing.assert_array_equal(estimate.observer_state, estimate.candidate[-1])


def test_an_observer_that_starts_again_has_the_state_that_it_starts_from():
    def f(x):
        if x[0] > 50.0:
            raise ValueError("too hot")
        return A @ x

    mhe = made(f, horizon=2, max_qps=3)
    mhe.update([0.5])
    mhe.update([200.0])
    failed = mhe.update([0.5])
    assert Status.MODEL_FAILED in failed.status
    expected = failed.state if failed.improved else failed.candidate[-1]
    np.testing.assert_array_equal(failed.observer_state, expected)
    np.testing.assert_array_equal(mhe.update([0.4]).candidate[-2], expected)


def test_a_run_has_all_of_them():
    ys = np.random.default_rng(2).standard_normal(7)
    mhe, other = made(), made()
    first, second = mhe.run(ys[:4]), mhe.run(ys[4:])
    found = [other.update([y]).observer_state for y in ys]
    np.testing.assert_array_equal(first.observer_states, [[1.0, -1.0], *found[:4]])
    np.testing.assert_array_equal(second.observer_states, found[3:])
