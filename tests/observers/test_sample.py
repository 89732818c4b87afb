"""What a sample may say, and what of it an observer of the user's own is shown."""

import dataclasses

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError
from tests.estimation.spoil import check, cost_of

A, B = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[0.0], [1.0]])
C, START = np.array([[1.0, 0.5], [0.0, 2.0]]), np.array([1.0, -1.0])
RATE = (A - np.eye(2)) / 0.1


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
    lambda x, u: x @ RATE.T + u @ B.T / 0.1, lambda x: x @ C.T, dt=0.1, n=2, p=2, m=1,
    method="euler",
)


def estimator(observer, max_qps=0):
    return qpmhe.MovingHorizonEstimator(
        SYSTEM, observer, cost_of(2, 2), horizon=3, initial_state=START, max_qps=max_qps
    )


def test_an_observer_is_checked_with_the_system_and_the_initial_state():
    observer = Listener()
    mhe = estimator(observer)
    mhe.reset([2.0, 3.0])
    # A copy: a system is never changed by an estimator.
    own = mhe._own_system.evaluation.trace
    assert [system.evaluation.trace is own for system, _ in observer.checked] == [True, True]
    np.testing.assert_array_equal([start for _, start in observer.checked], [START, [2.0, 3.0]])
    check(InvalidInputError, ["starts below 100"], mhe.reset, [200.0, 3.0])
    np.testing.assert_array_equal(mhe.state, [2.0, 3.0])
    wrong = qpmhe.OutputInjection(lambda z, v: np.ones(3) * v[0])
    check(InvalidInputError, ["(3,)"], wrong.check, SYSTEM, START)


@pytest.mark.parametrize("max_qps", [0, 1])
def test_what_a_sample_shows(max_qps):
    observer, z, generator = Listener(), START, np.random.default_rng(1)
    mhe = estimator(observer, max_qps)
    for t in range(12):
        y, u, own = generator.standard_normal(2), generator.standard_normal(1), {}
        seen = np.array([[True, True], [True, False], [False, False], [True, True]][t % 4])
        if t % 3 == 1:
            own["dt"] = 0.03
        if t % 5 == 2:
            own["noise_weight"] = np.diag([2.0, 3.0 + t])
        mhe.update(np.where(seen, y, np.nan), u, **own)
        at, error, model, kept = observer.heard[-1]
        dt = own.get("dt", 0.1)
        a, b = np.eye(2) + dt * RATE, dt / 0.1 * B
        np.testing.assert_allclose(at, z, rtol=1e-12)
        np.testing.assert_allclose(error, (y - C @ z) * seen, rtol=1e-10, atol=1e-12)
        np.testing.assert_array_equal(kept["u"], [*u, 0.03] if "dt" in own else u)
        used = mhe._engine.system
        assert model is (used.timed if "dt" in own else used)
        np.testing.assert_array_equal(kept["observed"], None if seen.all() else seen)
        np.testing.assert_array_equal(kept["noise_weight"], own.get("noise_weight"))
        np.testing.assert_array_equal(kept["covariance"], 2.0**t * np.eye(2))
        np.testing.assert_allclose(kept["f_jacobian"], a, rtol=1e-10)
        np.testing.assert_allclose(kept["h_jacobian"], C, rtol=1e-10)
        z = a @ z + b @ u + 0.1 * error
    first = observer.heard[-2:]
    mhe.amend(10, [5.0, 0.0])  # What is redone is heard again.
    for age, (old, new) in enumerate(zip(first, observer.heard[12:], strict=True)):
        for name in ("u", "covariance"):
            np.testing.assert_array_equal(new[3][name], old[3][name])
        assert np.array_equal(new[0], old[0]) is (age == 0)
        assert not np.array_equal(new[1], old[1])
