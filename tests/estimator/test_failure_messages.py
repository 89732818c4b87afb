"""What a model raises during a step is in the estimate's message."""

import numpy as np

import qpmhe
from qpmhe import Status
from qpmhe.estimation.limits import LENGTHS

from .untraced import untraced


class UnprintableError(Exception):
    def __str__(self):
        raise RuntimeError("no text")


def raising(error, above=2.0):
    def g(x):
        if float(np.real(x[0])) > above:
            raise error
        return x * 1.0

    return g


def estimator(f=lambda x: 0.9 * x, h=lambda x: x, observer=None, h_jacobian=None, **options):
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, h, n=1, p=1, h_jacobian=h_jacobian),
        observer or qpmhe.Luenberger([0.5]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0),
        **({"horizon": 4, "initial_state": [1.0]} | options),
    )


def staying(h, h_jacobian=lambda x: np.eye(1), **options):
    """The observer stays at 1, and a measurement of 0 leads every step below it."""
    return estimator(lambda x: x, h, qpmhe.Luenberger([0.0]), h_jacobian, **options)


def correction(z, v):
    if v[0] > 10.0:
        raise ValueError("no gain")
    return 0.5 * v


def wrong(x):
    return x if float(np.real(x[0])) < 20.0 else np.ones(3)


beyond, no_slope = (raising(ValueError(text)) for text in ("beyond the table", "no slope"))
# The observer is at 50 after a measurement of 100.
CASES = [
    ({"f": beyond}, "f raised ValueError: beyond the table at x = [50."),
    ({"h": beyond}, "h raised ValueError: beyond the table at x = [50."),
    ({"h": raising(SystemExit(3))}, "h raised SystemExit: 3 at x = [50."),
    ({"h": raising(UnprintableError())}, "h raised UnprintableError at x = [50."),
    ({"h": wrong}, "h returned shape (3,)"),
    ({"h": lambda x: np.where(x > 2.0, np.nan, x)}, "not finite at x = [50."),
    (
        {"h": untraced(lambda x: x), "h_jacobian": lambda x: no_slope(x).reshape(1, 1) / x},
        "the Jacobian of h raised ValueError: no slope at x = [50.",
    ),
    (
        {"observer": qpmhe.OutputInjection(correction)},
        "the observer's correction raised ValueError: no gain at x = [0.9]",
    ),
]


def test_what_fails_at_the_newest_stage():
    for parts, text in CASES:
        mhe = estimator(**parts)
        assert mhe.update(1.0).message == ""
        estimate = mhe.update(100.0)
        if "observer" not in parts:
            estimate = mhe.update(1.0)
        assert Status.MODEL_FAILED in estimate.status
        assert text in estimate.message
    mhe.reset()  # a message is of its own step
    assert [mhe.update(1.0).message for _ in range(3)] == ["", "", ""]


def test_what_a_trial_raises():
    def below(x):
        if float(np.real(x[0])) < 1.0:
            raise ValueError("a negative pressure")
        return x * 1.0

    mhe = staying(below)
    estimate = mhe.update(0.0)
    assert Status.NO_DECREASE in estimate.status
    assert estimate.message.startswith("h raised ValueError: a negative pressure at x = [0.")
    inside = mhe.run(np.ones(4))
    assert inside.costs[-1] == 0.0
    assert mhe.update(1.0).message == ""


def test_what_no_second_call_raises():
    left = []  # one error for each call to come that raises

    @untraced
    def h(x):
        if left:
            raise left.pop()
        return x * 1.0

    def h_jacobian(x):  # the last call before the trials
        if armed:
            left.extend([OSError("the table is away")] * (1 + len(LENGTHS)))
        return np.eye(1)

    armed = False
    mhe = staying(h, h_jacobian)
    armed = True
    estimate = mhe.update(0.0)
    assert Status.NO_DECREASE in estimate.status
    assert not left
    assert estimate.message.startswith("the model or the cost raised OSError: the table is away")


def test_where_a_jacobian_fails_on_the_way():
    for fails, text in (
        (raising(ValueError("no slope"), -np.inf), "the Jacobian of h raised ValueError: no slope"),
        (lambda x: x * np.nan, "the Jacobian of f or h is not finite along the trajectory"),
    ):
        def h_jacobian(x, fails=fails):
            return fails(x).reshape(1, 1) if x[0] < 0.9 else np.eye(1)

        estimate = staying(untraced(lambda x: x), h_jacobian, max_qps=3).update(0.0)
        assert Status.IMPROVED | Status.MODEL_FAILED in estimate.status
        assert estimate.qps == 1
        assert estimate.message.startswith(text)
