"""Robust and discounted costs: J and its majorants by their definitions."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, OptionError, ShapeError, WeightError

from . import plain
from .plain import spd
from .spoil import check
from .systems import GAIN, seen, swing

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 2)


TERMS = ("prior", "disturbance", "noise")


def estimator(cost, **options):
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(swing, seen, n=2, p=2), qpmhe.Luenberger(GAIN), cost,
        **{"horizon": 5, "initial_state": [0.5, 0.0], "max_qps": 2} | options,
    )


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
