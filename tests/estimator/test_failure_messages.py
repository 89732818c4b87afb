"""What a model raises during a step is in the estimate's message."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.estimation.limits import LENGTHS

from .untraced import untraced


class UnprintableError(Exception):
    def __str__(self):
        raise RuntimeError("no text")


def limited(limit, error, sign=1.0):
    """The identity of one state, which raises where sign * x is above the limit."""

    def g(x):
        if sign * float(np.real(x[0])) > limit:
            raise error
        return x * 1.0

    return g


def estimator(f=None, h=None, observer=None, **options):
    system = qpmhe.System(
        f or (lambda x: 0.9 * x), h or (lambda x: x), n=1, p=1,
        h_jacobian=options.pop("h_jacobian", None),
    )
    return qpmhe.MovingHorizonEstimator(
        system,
        observer or qpmhe.Luenberger([0.5]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0),
        **({"horizon": 4, "initial_state": [1.0]} | options),
    )


def last(mhe, *measurements):
    return [mhe.update([y]) for y in measurements][-1]


@pytest.mark.parametrize("name", ["f", "h"])
def test_what_a_function_raises_at_the_newest_stage(name):
    mhe = estimator(**{name: limited(2.0, ValueError("beyond the table"))})
    assert last(mhe, 1.0).message == ""
    estimate = last(mhe, 100.0, 1.0)  # the first takes the observer above the limit
    assert Status.MODEL_FAILED in estimate.status
    assert estimate.message.startswith(f"{name} raised ValueError: beyond the table at x = [")
    assert "at x = [50." in estimate.message


def test_the_message_is_of_its_own_step():
    mhe = estimator(h=limited(2.0, ValueError("beyond the table")), max_qps=0)
    assert last(mhe, 100.0, 1.0).message
    mhe.reset()
    assert [mhe.update([1.0]).message for _ in range(3)] == ["", "", ""]


def test_what_a_jacobian_raises():
    jacobian = limited(2.0, ValueError("no slope"))
    mhe = estimator(
        h=untraced(lambda x: x), h_jacobian=lambda x: np.ones((1, 1)) * (jacobian(x)[0] / x[0])
    )
    estimate = last(mhe, 100.0, 1.0)
    assert Status.MODEL_FAILED in estimate.status
    assert "the Jacobian of h raised ValueError: no slope at x = [50." in estimate.message


def test_what_an_observer_raises():
    def correction(z, v):
        if v[0] > 10.0:
            raise ValueError("no gain")
        return 0.5 * v

    estimate = last(estimator(observer=qpmhe.OutputInjection(correction)), 100.0)
    assert Status.MODEL_FAILED in estimate.status
    assert estimate.message.startswith(
        "the observer's correction raised ValueError: no gain at x = [1.0]"
    )


def test_a_value_that_is_not_finite():
    mhe = estimator(h=lambda x: np.where(x > 2.0, np.nan, x))
    estimate = last(mhe, 100.0, 1.0)
    assert Status.MODEL_FAILED in estimate.status
    assert "not finite at x = [50." in estimate.message


def test_wrong_values_and_exits():
    def wrong(x):
        return x if float(np.real(x[0])) < 20.0 else np.ones(3)

    assert last(estimator(h=wrong), 100.0, 1.0).message.startswith("h returned shape (3,)")
    ends = limited(2.0, SystemExit(3))
    assert last(estimator(h=ends), 100.0, 1.0).message.startswith("h raised SystemExit: 3 at x")


def test_an_exception_without_text_harms_nothing():
    estimate = last(estimator(h=limited(2.0, UnprintableError())), 100.0, 1.0)
    assert estimate.message.startswith("h raised UnprintableError at x = [50.")


def below(limit):
    """x^2 for x >= limit: with a low measurement all steps of the QP go below the limit."""

    def h(x):
        if float(np.real(x[0])) < limit:
            raise ValueError("a negative pressure")
        return x * 1.0

    return h


def test_what_a_trial_raises():
    # The observer stays where it is, at the edge of the domain, and every step leads out of it.
    mhe = estimator(
        lambda x: x, below(1.0), qpmhe.Luenberger([0.0]), h_jacobian=lambda x: np.eye(1)
    )
    estimate = last(mhe, 0.0)
    assert Status.NO_DECREASE in estimate.status
    assert estimate.message.startswith("h raised ValueError: a negative pressure at x = [0.")
    inside = last(mhe, 1.0, 1.0, 1.0, 1.0)
    assert (inside.message, inside.cost) == ("", 0.0)


def test_what_no_second_call_raises():
    raising = []  # one entry for each call to come that raises

    @untraced
    def h(x):
        if raising:
            raise raising.pop()
        return x * 1.0

    def h_jacobian(x):  # the last call before the trials
        if mhe is not None:
            raising.extend([OSError("the table is away")] * (1 + len(LENGTHS)))
        return np.eye(1)

    mhe = None
    mhe = estimator(h=h, h_jacobian=h_jacobian)
    estimate = mhe.update([0.0])
    assert Status.NO_DECREASE in estimate.status
    assert not raising
    assert estimate.message.startswith("the model or the cost raised OSError: the table is away")


def test_what_a_jacobian_raises_on_the_way():
    def h_jacobian(x):
        if x[0] < 0.9:
            raise ValueError("no slope")
        return np.eye(1)

    mhe = estimator(
        lambda x: x, untraced(lambda x: x), qpmhe.Luenberger([0.0]), h_jacobian=h_jacobian,
        max_qps=3,
    )
    estimate = last(mhe, 0.0)
    assert Status.IMPROVED | Status.MODEL_FAILED in estimate.status
    assert estimate.qps == 1
    assert estimate.message.startswith("the Jacobian of h raised ValueError: no slope at x = [0.")
