"""What an observer of the user's own is shown, and what is asked of it."""

import dataclasses

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError

A = np.array([[0.9, 0.2], [-0.1, 0.8]])
C = np.array([[1.0, 0.5], [0.0, 2.0]])
B = np.array([[0.0], [1.0]])
START = np.array([1.0, -1.0])


class Listener(qpmhe.Observer):
    """A constant gain that writes down what it hears."""

    needs_jacobians = True

    def __init__(self):
        self.checked, self.heard = [], []

    def check(self, system, initial_state):
        self.checked.append((system, initial_state.copy()))
        if initial_state[0] > 100.0:
            raise InvalidInputError("the listener starts below 100.")

    def initial_covariance(self):
        return np.eye(2)

    def correct(self, z, v, sample):
        kept = {
            field.name: None if value is None else np.array(value)
            for field in dataclasses.fields(sample)
            if (value := getattr(sample, field.name)) is not sample.system
        }
        self.heard.append((z.copy(), v.copy(), sample.system, kept))
        return 0.1 * v, 2.0 * sample.covariance


SYSTEM = qpmhe.System.from_ode(
    lambda x, u: (x @ (A - np.eye(2)).T + u @ B.T) / 0.1, lambda x: x @ C.T,
    dt=0.1, n=2, p=2, m=1, method="euler",
)


def estimator(observer, **options):
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(2))
    return qpmhe.MovingHorizonEstimator(
        SYSTEM, observer, cost, **{"horizon": 3, "initial_state": START, "max_qps": 0} | options
    )


def test_an_observer_is_checked_with_the_system_and_the_initial_state():
    observer = Listener()
    mhe = estimator(observer)
    mhe.reset([2.0, 3.0])
    # A copy: a system is never changed by an estimator.
    assert [system is mhe._own_system for system, _ in observer.checked] == [True, True]
    np.testing.assert_array_equal([start for _, start in observer.checked], [START, [2.0, 3.0]])
    mhe.update([1.0, 1.0], [0.0])
    before = mhe.state
    with pytest.raises(InvalidInputError, match="starts below 100"):
        mhe.reset([200.0, 3.0])
    np.testing.assert_array_equal(mhe.state, before)
    for wrong in (
        qpmhe.Luenberger(np.ones((3, 2))), qpmhe.OutputInjection(lambda z, v: np.ones(3) * v[0]),
        qpmhe.ExtendedKalman(prior=np.eye(3), disturbance=np.eye(2), noise=np.eye(2)),
    ):
        with pytest.raises(InvalidInputError, match=r"\(3, 2\)|\(3,\)|\(3, 3\)"):
            wrong.check(SYSTEM, START)


@pytest.mark.parametrize("max_qps", [0, 1])
def test_what_a_sample_shows(max_qps):
    observer, z, generator = Listener(), START, np.random.default_rng(1)
    mhe = estimator(observer, max_qps=max_qps)
    for t in range(12):
        y, u, own = generator.standard_normal(2), generator.standard_normal(1), {}
        seen = np.array([[True, True], [True, False], [False, False], [True, True]][t % 4])
        if t % 3 == 1:
            own["dt"] = 0.03
        if t % 5 == 2:
            own["noise_weight"] = np.diag([2.0, 3.0 + t])
        mhe.update(np.where(seen, y, np.nan), u, **own)
        at, error, model, kept = observer.heard[-1]
        rate = (A - np.eye(2)) / 0.1
        a, b = np.eye(2) + own.get("dt", 0.1) * rate, own.get("dt", 0.1) / 0.1 * B
        np.testing.assert_allclose(at, z, rtol=1e-12)
        np.testing.assert_allclose(error, (y - C @ z) * seen, rtol=1e-10, atol=1e-12)
        np.testing.assert_array_equal(kept["u"], [*u, 0.03] if "dt" in own else u)
        assert model is (mhe._own_system.timed if "dt" in own else mhe._own_system)
        np.testing.assert_array_equal(kept["observed"], None if seen.all() else seen)
        np.testing.assert_array_equal(kept["noise_weight"], own.get("noise_weight"))
        np.testing.assert_array_equal(kept["covariance"], 2.0**t * np.eye(2))
        np.testing.assert_allclose(kept["f_jacobian"], a, rtol=1e-10)
        np.testing.assert_allclose(kept["h_jacobian"], C, rtol=1e-10)
        z = a @ z + b @ u + 0.1 * error


def test_what_is_redone_is_heard_again():
    observer = Listener()
    mhe = estimator(observer)
    for t in range(6):
        mhe.update([0.1 * t, 1.0], [0.01 * t])
    first = list(observer.heard)
    mhe.amend(4, [5.0, None])
    for age, (old, new) in enumerate(zip(first[4:], observer.heard[6:], strict=True)):
        for name in ("u", "covariance"):
            np.testing.assert_array_equal(new[3][name], old[3][name])
        assert new[1][0] != old[1][0]
        assert np.array_equal(new[0], old[0]) is (age == 0)
