"""Robust and discounted costs: J and its majorants by their definitions."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, OptionError, ShapeError, WeightError

from . import plain
from .plain import spd
from .spoil import check

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 2)
GAIN = np.array([[0.3, 0.05], [0.1, 0.2]])


def swing(x):
    return np.stack(
        [x[..., 0] + 0.2 * x[..., 1], 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])], axis=-1
    )


def seen(x):
    return np.stack([x[..., 0] + 0.1 * x[..., 1] ** 2, x[..., 1]], axis=-1)


def record(samples, missing=0.0):
    """A noisy record with an outlier every now and then."""
    generator = np.random.default_rng(2)
    x, ys = np.array([1.0, 0.5]), []
    for _ in range(samples):
        y = seen(x) + 0.05 * generator.standard_normal(2)
        y[generator.random(2) < 0.1] += 3.0
        y[generator.random(2) < missing] = np.nan
        ys.append(y)
        x = swing(x) + 0.02 * generator.standard_normal(2)
    return np.array(ys)


TERMS = ("prior", "disturbance", "noise")


def estimator(cost, **options):
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(swing, seen, n=2, p=2), qpmhe.Luenberger(GAIN), cost,
        **{"horizon": 5, "initial_state": [0.5, 0.0], "max_qps": 2} | options,
    )


@pytest.mark.parametrize("prior", [P, qpmhe.ObserverPrior()], ids=["constant", "observer"])
def test_matrices_stand_for_quadratic_losses(prior):
    weights = {"prior": prior, "disturbance": Q, "noise": R, "discount": 0.9}
    losses = weights | {name: qpmhe.Quadratic(weights[name]) for name in TERMS[1:]}
    covariances = {name: 0.3 * np.eye(2) for name in TERMS}
    observer = qpmhe.Luenberger(GAIN) if prior is P else qpmhe.ExtendedKalman(**covariances)
    runs = [
        qpmhe.MovingHorizonEstimator(
            qpmhe.System(swing, seen, n=2, p=2), observer, cost, horizon=4, max_qps=2,
            initial_state=[0.5, 0.0],
        ).run(record(90, 0.1))
        for cost in (
            qpmhe.QuadraticCost(**weights), qpmhe.RobustCost(**weights), qpmhe.RobustCost(**losses)
        )
    ]
    for run in runs[1:]:
        np.testing.assert_allclose(run.states, runs[0].states, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(run.costs, runs[0].costs, rtol=1e-9)


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 3.0])
def test_constants_of_equal_exponents(exponent):
    weights = {"prior": P, "disturbance": np.diag([1.0, 5.0]), "noise": R}
    cost = qpmhe.RobustCost(
        **{k: qpmhe.Power(one, exponent, k == "disturbance") for k, one in weights.items()}
    )
    assert cost.constants.exponent == exponent
    for name, weight in weights.items():
        low, high = getattr(cost.constants, name)
        definition = plain.power(exponent)
        if name == "disturbance":
            definition = plain.each(definition)
        for s in np.random.default_rng(6).standard_normal((200, 2)):
            size, value = np.linalg.norm(s) ** exponent, definition(s, weight)
            assert low * size * (1 - 1e-9) <= value <= high * size * (1 + 1e-9)


def test_constants_need_one_exponent_for_all():
    weights = {"prior": P, "disturbance": Q, "noise": R}
    robust, quadratic = qpmhe.RobustCost(**weights), qpmhe.QuadraticCost(**weights)
    for term in TERMS:
        expected = getattr(quadratic.constants, term)
        np.testing.assert_allclose(getattr(robust.constants, term), expected, rtol=1e-12)
        for other in (qpmhe.Huber(weights[term]), qpmhe.Power(weights[term], 1.5)):
            assert qpmhe.RobustCost(**weights | {term: other}).constants is None
    weights["prior"] = qpmhe.ObserverPrior(minimum=0.1, maximum=10.0)
    assert qpmhe.RobustCost(**weights).constants.prior == (0.1, 10.0)
    powers = {term: qpmhe.Power(weights[term], 1.5) for term in TERMS[1:]}
    assert qpmhe.RobustCost(prior=weights["prior"], **powers).constants is None


def made(kind=qpmhe.RobustCost, **changes):
    return kind(**{"prior": P, "disturbance": Q, "noise": R} | changes)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        *(({"discount": value}, OptionError, [f"discount is {value!r}", "expected a "])
          for value in (0, -0.5, math.nan, True, "0.9", None, 1.0001)),
        ({"prior": np.eye(1)}, ShapeError, ["prior has shape (1, 1)", "expected (2, 2)"]),
        ({"prior": qpmhe.Huber(np.eye(1))}, ShapeError, ["prior has shape (1, 1)"]),
        ({"noise": qpmhe.ObserverPrior()}, InvalidInputError,
         ["noise is <", "ObserverPrior", "expected a loss or a weight matrix"]),
        ({"disturbance": np.diag([1.0, -1.0])}, WeightError,
         ["disturbance has the eigenvalue -1", "positive definite"]),
    ],
)
def test_wrong_costs_are_named(changes, error, words):
    check(error, words, lambda: made(**changes))
    if "discount" in changes:
        check(error, words, lambda: made(qpmhe.QuadraticCost, **changes))
        check(error, words, lambda: made(qpmhe.QuadraticCost.from_covariances, **changes))


def test_a_loss_per_component_refuses_a_correlated_weight_of_one_sample():
    mhe = estimator(made(noise=qpmhe.Huber(np.eye(2), per_component=True)))
    with pytest.raises(WeightError, match="diagonal"):
        mhe.update([1.0, 1.0], noise_weight=[[2.0, 1.0], [1.0, 2.0]])
    assert mhe.time == 0
    mhe.update([1.0, 1.0], noise_weight=[[2.0, 0.0], [0.0, 1.0]])
