"""What an observer of the user's own is told, and what is asked of it."""

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

    def __init__(self, jacobians=False, covariance=False):
        self.needs_jacobians = jacobians
        self.covariance = covariance
        self.checked, self.heard = [], []

    def check(self, system, initial_state):
        self.checked.append((system, initial_state.copy()))
        if initial_state[0] > 100.0:
            raise InvalidInputError("the listener starts below 100.")

    def initial_covariance(self):
        return np.eye(2) if self.covariance else None

    def correct(self, z, v, sample):
        kept = {
            field.name: None
            if getattr(sample, field.name) is None
            else np.array(getattr(sample, field.name))
            for field in dataclasses.fields(sample)
            if field.name != "system"
        }
        self.heard.append((z.copy(), v.copy(), sample.system, kept))
        return 0.1 * v, None if sample.covariance is None else 2.0 * sample.covariance


def system_of():
    return qpmhe.System.from_ode(
        lambda x, u: (x @ (A - np.eye(2)).T + u @ B.T) / 0.1, lambda x: x @ C.T,
        dt=0.1, n=2, p=2, m=1, method="euler",
    )


def estimator(observer, system=None, **options):
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(2))
    return qpmhe.MovingHorizonEstimator(
        system or system_of(), observer, cost,
        **{"horizon": 3, "initial_state": START, "max_qps": 0} | options,
    )


def test_an_observer_is_checked_with_the_system_and_the_initial_state():
    observer, system = Listener(), system_of()
    mhe = estimator(observer, system)
    assert len(observer.checked) == 1
    # A copy: a system is never changed by an estimator.
    assert observer.checked[0][0] is mhe._own_system
    assert mhe.system is system
    np.testing.assert_array_equal(observer.checked[0][1], START)
    mhe.reset([2.0, 3.0])
    np.testing.assert_array_equal(observer.checked[1][1], [2.0, 3.0])
    mhe.update([1.0, 1.0], [0.0])
    before = mhe.state.copy()
    with pytest.raises(InvalidInputError, match="starts below 100"):
        mhe.reset([200.0, 3.0])
    np.testing.assert_array_equal(mhe.state, before)
    with pytest.raises(InvalidInputError, match="starts below 100"):
        estimator(Listener(), initial_state=[200.0, 0.0])


@pytest.mark.parametrize(
    "observer",
    [
        qpmhe.Luenberger(np.ones((3, 2))),
        qpmhe.OutputInjection(lambda z, v: np.ones(3) * v[0]),
        qpmhe.ExtendedKalman(prior=np.eye(3), disturbance=np.eye(2), noise=np.eye(2)),
    ],
    ids=lambda observer: type(observer).__name__,
)
def test_an_observer_can_be_checked_by_itself(observer):
    with pytest.raises(InvalidInputError, match=r"\(3, 2\)|\(3,\)|\(3, 3\)"):
        observer.check(system_of(), START)


@pytest.mark.parametrize("max_qps", [0, 1])
@pytest.mark.parametrize("jacobians", [False, True])
def test_a_sample_tells_the_state_the_error_and_the_input(jacobians, max_qps):
    observer, system = Listener(jacobians), system_of()
    mhe = estimator(observer, system, max_qps=max_qps)
    z, generator = START, np.random.default_rng(1)
    for _ in range(6):
        y, u = generator.standard_normal(2), generator.standard_normal(1)
        mhe.update(y, u)
        at, error, model, kept = observer.heard[-1]
        np.testing.assert_allclose(at, z, rtol=1e-12)
        np.testing.assert_allclose(error, y - C @ z, rtol=1e-10, atol=1e-12)
        np.testing.assert_array_equal(kept["u"], u)
        assert model is mhe._own_system
        assert kept["observed"] is kept["noise_weight"] is kept["covariance"] is None
        if jacobians:
            np.testing.assert_allclose(kept["f_jacobian"], A, rtol=1e-12)
            np.testing.assert_allclose(kept["h_jacobian"], C, rtol=1e-12)
        z = A @ z + B @ u + 0.1 * (y - C @ z)


def test_a_sample_tells_which_outputs_are_there():
    observer = Listener()
    mhe = estimator(observer)
    for mask in ([True, False], [False, False], [True, True], [False, True]):
        mhe.update(np.where(mask, 1.0, np.nan), [0.0])
        _, error, _, kept = observer.heard[-1]
        assert not error[~np.array(mask)].any()
        if all(mask):
            assert kept["observed"] is None
        else:
            np.testing.assert_array_equal(kept["observed"], mask)


def test_a_sample_tells_the_model_of_its_step():
    observer, system = Listener(jacobians=True), system_of()
    mhe = estimator(observer, system)
    for dt in (None, 0.03, None, 0.2):
        mhe.update([1.0, 1.0], [0.5], dt=dt)
        _, _, model, kept = observer.heard[-1]
        expected = np.eye(2) + (0.1 if dt is None else dt) * (A - np.eye(2)) / 0.1
        np.testing.assert_allclose(kept["f_jacobian"], expected, rtol=1e-10)
        assert model is (mhe._own_system if dt is None else mhe._own_system.timed)
        np.testing.assert_array_equal(kept["u"], [0.5] if dt is None else [0.5, dt])


@pytest.mark.parametrize("covariance", [False, True])
def test_a_sample_tells_the_weight_of_its_noise(covariance):
    observer = Listener(covariance=covariance)
    mhe = estimator(observer)
    for weight in (None, np.diag([2.0, 3.0]), None, np.diag([5.0, 6.0])):
        mhe.update([1.0, 1.0], [0.0], noise_weight=weight)
        found = observer.heard[-1][3]["noise_weight"]
        if weight is None:
            assert found is None
        else:
            np.testing.assert_array_equal(found, weight)


def test_a_covariance_travels_from_sample_to_sample():
    observer = Listener(covariance=True)
    mhe = estimator(observer)
    for t in range(8):
        mhe.update([1.0, 1.0] if t != 4 else None, [0.0])
        np.testing.assert_array_equal(observer.heard[-1][3]["covariance"], 2.0**t * np.eye(2))


def test_what_is_redone_is_heard_again():
    observer = Listener(covariance=True)
    mhe = estimator(observer)
    for t in range(6):
        mhe.update([0.1 * t, 1.0], [0.01 * t])
    first = list(observer.heard)
    mhe.amend(4, [5.0, None])
    again = observer.heard[6:]
    assert len(again) == 2
    for age, (old, new) in enumerate(zip(first[4:], again, strict=True)):
        for name in ("u", "covariance"):
            np.testing.assert_array_equal(new[3][name], old[3][name])
        assert new[1][0] != old[1][0]
        assert np.array_equal(new[0], old[0]) is (age == 0)


def test_an_observer_without_its_methods_cannot_be_made():
    class Silent(qpmhe.Observer):
        def check(self, system, initial_state):
            pass

    with pytest.raises(TypeError, match="correct"):
        Silent()
