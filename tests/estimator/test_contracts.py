"""Shapes and signs of a user's own parts are checked at construction, by name."""

import numpy as np
import pytest

import qpmhe
from qpmhe.costs import Loss
from qpmhe.errors import InvalidInputError

GAIN = np.array([[0.3], [0.2]])
A = np.array([[0.95, 0.0], [0.1, 0.9]])


def made(observer=None, noise=None):
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
    cost = qpmhe.RobustCost(
        prior=np.eye(2), disturbance=100.0 * np.eye(2), noise=[[100.0]] if noise is None else noise
    )
    return qpmhe.MovingHorizonEstimator(
        system, observer or qpmhe.Luenberger(GAIN), cost, horizon=4, initial_state=[0.0, 0.0],
        engine="python",
    )


class Own(qpmhe.Observer):
    """An observer whose parts return whatever they are given."""

    def __init__(self, correct, filtered=lambda z, v: None, prior=None):
        self.made, self.filtered, self.prior = correct, filtered, prior

    def check(self, system, state):
        """Any system."""

    def initial_covariance(self):
        return self.prior

    def correct(self, z, v, sample):
        return self.made(z, v)

    def filter(self, z, v, sample):
        return self.filtered(z, v)


def right(z, v):
    return GAIN @ v, None


def test_right_observers_are_taken():
    for observer in (
        Own(right), Own(right, lambda z, v: (z, None)),
        Own(lambda z, v: (GAIN @ v, np.eye(2)), lambda z, v: (z, np.eye(2)), np.eye(2)),
        Own(lambda z, v: [GAIN[:, 0] * v[0], None]),
    ):
        run = made(observer).run(np.ones((6, 1)))
        assert not any(qpmhe.Status.MODEL_FAILED in one for one in run.statuses)


def failing(z, v):
    raise ZeroDivisionError


def test_what_fails_at_the_first_state_is_bad_luck():
    assert qpmhe.Status.MODEL_FAILED in made(Own(failing)).update([1.0]).status


@pytest.mark.parametrize(("observer", "words"), [
    (Own(lambda z, v: GAIN[:, 0] * v[0]), "Own.correct returned .* expected a pair"),
    (Own(lambda z, v: None), "Own.correct returned None; expected a pair"),
    (Own(lambda z, v: (1.0, None)), r"first value of shape \(\); expected a pair: a vector \(2,\)"),
    (Own(lambda z, v: (v, None)), r"Own.correct returned a first value of shape \(1,\)"),
    (Own(lambda z, v: (GAIN * v[0], None)), r"first value of shape \(2, 1\)"),
    (Own(lambda z, v: (GAIN @ v, np.ones(2))), r"second value of shape \(2,\)"),
    (Own(right, prior=np.eye(2)), r"second value of shape \(\); expected .* covariance \(2, 2\)$"),
    (Own(right, lambda z, v: z), "Own.filter returned .* expected a pair"),
    (Own(right, lambda z, v: (z[:1], None)), r"Own.filter returned a first value of shape \(1,\)"),
])
def test_wrong_shapes_of_an_observer_are_named(observer, words):
    with pytest.raises(InvalidInputError, match=words.rstrip("$")):
        made(observer)


def test_an_attribute_called_metric_is_named_unless_it_is_one():
    class Named(Own):
        metric = "euclidean"

    with pytest.raises(InvalidInputError, match=r"Named.metric is 'euclidean'; .* something else"):
        made(Named(right))
    Named.metric = np.eye(2)
    assert np.isfinite(made(Named(right)).update([1.0]).cost)


class OwnLoss(Loss):
    def __init__(self, value, slope):
        super().__init__([[100.0]])
        self.value, self.slope = value, slope

    def _value(self, q):
        return self.value(q)

    def _slope(self, q):
        return self.slope(q)


def test_losses_are_checked():
    assert np.isfinite(made(noise=OwnLoss(np.log1p, lambda q: 1 / (1 + q))).update([1.0]).cost)
    for value, slope, words in (
        (lambda q: q, lambda q: -np.ones_like(q), r"OwnLoss._slope\(0\) is -1; expected rho'\(q\)"),
        (lambda q: -q, np.ones_like, r"OwnLoss._value\(1e-06\) is -1e-06"),
        (lambda q: 1 + q, np.ones_like, r"OwnLoss._value\(0\) is 1; .* a loss rises from 0"),
        (lambda q: 1.0, np.ones_like, r"OwnLoss._value returned shape \(\) for forms q of shape"),
        (lambda q: q, lambda q: 1.0, r"OwnLoss._slope returned shape \(\)"),
        (lambda q: q.sum(), np.ones_like, r"OwnLoss._value returned shape \(\)"),
        (lambda q: np.log(q), np.ones_like, r"OwnLoss._value\(0\) is -inf"),
        (lambda q: 1 / 0, np.ones_like, "OwnLoss._value raised ZeroDivisionError"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            made(noise=OwnLoss(value, slope))
