"""Observers, losses and costs of the user's own: what they return is checked at construction."""

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import ModelError

A, GAIN = np.array([[0.95, 0.1], [0.0, 0.9]]), np.array([0.3, 0.2])
SYSTEM = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
PRIOR, DISTURBANCE, NOISE = np.eye(2), 1e2 * np.eye(2), np.array([[100.0]])
QUADRATIC = qpmhe.QuadraticCost(prior=PRIOR, disturbance=DISTURBANCE, noise=NOISE)


class Own(qpmhe.Observer):
    """Answers what a test says."""

    def __init__(self, answer, filtered=None, covariance=None):
        self.answer, self.filtered, self.covariance = answer, filtered, covariance

    def check(self, system, initial_state):
        pass

    def initial_covariance(self):
        return self.covariance

    def correct(self, z, v, sample):
        return self.answer(v)

    def filter(self, z, v, sample):
        return self.filtered


def estimator(observer, cost=QUADRATIC):
    return qpmhe.MovingHorizonEstimator(
        SYSTEM, observer, cost, horizon=5, initial_state=[0.0, 0.0], engine="python"
    )


def moved(v):
    return GAIN * v[0]


@pytest.mark.parametrize(
    ("answer", "found"),
    [
        (moved, r"ndarray of shape \(2,\)"),  # is unpacked as if it were the pair
        (lambda v: (0.1 * v[0], None), r"shape \(\); expected \(2,\)"),
        (lambda v: (0.1 * v, None), r"shape \(1,\); expected \(2,\)"),
        (lambda v: (moved(v)[:, None], None), r"shape \(2, 1\); expected \(2,\)"),
        (lambda v: (np.zeros(3), None), r"shape \(3,\); expected \(2,\)"),
        (lambda v: None, "NoneType"),
        (lambda v: (None, None), "NoneType without real numbers"),
        (lambda v: (moved(v) * 1j, None), "without real numbers"),
        (lambda v: (moved(v), np.eye(2)), "initial_covariance is None"),
        (lambda v: (moved(v) + 1.0, None), r"v = 0; expected zero"),
        (lambda v: np.ones((3, 3)) @ v, "raised ValueError"),
    ],
)
def test_a_wrong_correction_is_refused_by_name(answer, found):
    with pytest.raises(ModelError, match=rf"Own\.correct.*{found}"):
        estimator(Own(answer))


@pytest.mark.parametrize("covariance", [None, 1.0, np.ones(2), np.eye(3)])
def test_a_wrong_covariance_is_refused_by_name(covariance):
    with pytest.raises(ModelError, match=r"Own\.correct, as its covariance,.*\(2, 2\)"):
        estimator(
            Own(lambda v: (moved(v), covariance), covariance=np.eye(2)),
            qpmhe.QuadraticCost(disturbance=DISTURBANCE, noise=NOISE),
        )


@pytest.mark.parametrize("filtered", [np.zeros(2), (np.zeros(3), np.eye(2)), (np.zeros(2), 1.0)])
def test_a_wrong_measurement_update_is_refused_by_name(filtered):
    with pytest.raises(ModelError, match=r"Own\.filter"):
        estimator(Own(lambda v: (moved(v), None), filtered))


def test_a_right_observer_equals_the_same_constant_gain():
    outputs = np.random.default_rng(3).normal(size=(30, 1))
    own = estimator(Own(lambda v: (moved(v), None))).run(outputs)
    same = estimator(qpmhe.Luenberger(GAIN[:, None])).run(outputs)
    assert np.abs(own.states - same.states).max() <= 1e-9 * np.abs(same.states).max()


def test_an_attribute_of_the_name_of_the_metric():
    observer = Own(lambda v: (moved(v), None))
    observer.metric = "euclidean"
    with pytest.raises(ModelError, match=r"Own\.metric .* another name"):
        estimator(observer)
    observer.metric = np.eye(2)
    estimator(observer).update([1.0])


def test_the_check_leaves_no_trace_in_the_observer():
    class Counting(Own):
        count = 0

        def correct(self, z, v, sample):
            self.count += 1
            return super().correct(z, v, sample)

    observer = Counting(lambda v: (moved(v), None))
    estimator(observer)
    assert observer.count == 0


class OwnLoss(qpmhe.Loss):
    """rho and its slope, as a test says."""

    def __init__(self, value, slope, **options):
        super().__init__(NOISE, **options)
        self.value, self.slope = value, slope

    def value(self, q):
        return self.value(q)

    def slope(self, q):
        return self.slope(q)


def robust(loss):
    return qpmhe.RobustCost(prior=PRIOR, disturbance=DISTURBANCE, noise=loss)


@pytest.mark.parametrize("per_component", [False, True])
@pytest.mark.parametrize(
    ("value", "slope", "found"),
    [
        (lambda q: q, lambda q: -np.ones_like(q), r"slope returned -1 .* at least 0"),
        (lambda q: -q, np.ones_like, r"value returned -10000 .* at least 0"),
        (lambda q: 1.0, np.ones_like, r"value returned shape \(\)"),
        (lambda q: q, lambda q: 1.0, r"slope returned shape \(\)"),
        (lambda q: np.sum(q), np.ones_like, r"value returned shape \(\)"),
        (lambda q: q * np.nan, np.ones_like, "value returned nan"),
        (lambda q: q.nothing, np.ones_like, "value raised AttributeError"),
    ],
)
def test_a_wrong_loss_is_refused_by_name(value, slope, found, per_component):
    with pytest.raises(ModelError, match=rf"OwnLoss\.{found}"):
        robust(OwnLoss(value, slope, per_component=per_component))


def test_a_right_loss_equals_the_quadratic_one():
    outputs = np.random.default_rng(4).normal(size=(30, 1))
    gain = qpmhe.Luenberger(GAIN[:, None])
    own = estimator(gain, robust(OwnLoss(lambda q: q, np.ones_like))).run(outputs)
    same = estimator(gain, robust(NOISE)).run(outputs)
    assert np.abs(own.states - same.states).max() <= 1e-9 * np.abs(same.states).max()


@pytest.mark.parametrize(
    ("method", "answer", "found"),
    [
        ("stage_costs", 1.0, r"returned shape \(\)"),
        ("stage_costs", -np.ones(4), "at least 0"),
        ("majorise", np.eye(2), r"returned shape \(2, 2\); expected \(3, 3\)"),
        ("prior_cost", np.ones(2), r"returned shape \(2,\)"),
        ("majorise_prior", 1.0, r"returned shape \(\)"),
    ],
)
def test_a_wrong_cost_is_refused_by_name(method, answer, found):
    kind = type("OwnCost", (qpmhe.QuadraticCost,), {method: lambda self, *given: answer})
    cost = kind(prior=PRIOR, disturbance=DISTURBANCE, noise=NOISE)
    with pytest.raises(ModelError, match=rf"OwnCost\.{method} .*{found}"):
        estimator(qpmhe.Luenberger(GAIN[:, None]), cost)
