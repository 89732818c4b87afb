"""Weights and their constants, missing outputs, and the prior of an observer."""

import gc
import math
import pickle
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import qpmhe
from qpmhe import Huber, ObserverPrior, Power, QuadraticCost, RobustCost
from qpmhe.costs.base import reduced
from qpmhe.errors import InvalidInputError, OptionError, WeightError
from tests.estimation.plain import spd
from tests.estimation.spoil import check

TERMS = ("prior", "disturbance", "noise")


def weights(n, p):
    generator = np.random.default_rng(0)
    return {"prior": spd(generator, n), "disturbance": spd(generator, n),
            "noise": spd(generator, p)}


def test_constants_are_those_of_the_terms_with_one_exponent_for_all_or_none():
    given = weights(3, 4)
    powers = {term: Power(weight, 1.5) for term, weight in given.items()}
    for exponent, cost in (
        (2.0, QuadraticCost(**given)), (2.0, RobustCost(**given)), (1.5, RobustCost(**powers)),
    ):
        assert ((cost.n, cost.p), cost.constants.exponent) == ((3, 4), exponent)
        extremes = np.linalg.eigvalsh(given["noise"])[[0, -1]] ** (exponent / 2.0)
        np.testing.assert_allclose(cost.constants.noise, extremes, rtol=1e-9)
    for term in TERMS:
        for other in (qpmhe.Huber(given[term]), powers[term]):
            assert RobustCost(**given | {term: other}).constants is None


def test_few_patterns_of_missing_components_are_kept():
    n, p, kept = 10, 30, 2**22
    cost = QuadraticCost(**weights(n, p))
    observed = np.random.default_rng(8).random((1200, p)) < 0.7
    matrices, usual = [], cost.partial_weight(observed[0])
    for mask in observed[1:]:
        matrices.append(weakref.ref(cost.partial_weight(mask)))
        assert cost.partial_weight(observed[0]) is usual  # used all the time
    gc.collect()
    alive = sum(one() is not None for one in matrices)
    assert 100 < alive <= kept / cost.stage_weight.nbytes
    assert all(one() is not None for one in matrices[-100:])  # the last ones
    assert len(pickle.dumps(cost)) < 1.5 * kept


def test_threads_may_share_a_cost_whose_patterns_are_dropped():
    cost, masks = QuadraticCost(**weights(1, 12)), np.random.default_rng(9).random((64, 12)) < 0.5
    cost._kept, expected = 2, [cost.joint_weight(reduced(cost.noise, mask)) for mask in masks]

    def work(seed):
        for k in np.random.default_rng(seed).integers(0, 64, 400):
            np.testing.assert_array_equal(cost.partial_weight(masks[k]), expected[k])

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(work, range(6)))


def test_the_bounds_of_the_observer_prior_are_its_constants():
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 1e-6]])
    low, *_, high = np.linalg.eigvalsh(np.linalg.inv(covariance))
    rule, others = ObserverPrior(np.int64(10)), {"disturbance": np.eye(3), "noise": 4.0}
    for kind in (QuadraticCost, RobustCost, QuadraticCost.from_covariances):
        cost = kind(prior=rule, **others)
        assert (cost.constants, cost.constants_with(None)) == (None, None)
        found = cost.constants_with(covariance)
        assert found.prior == pytest.approx((low / 10.0, high * 10.0), rel=1e-9)
        np.testing.assert_allclose(
            cost.least_prior(covariance), np.linalg.inv(covariance) / 10.0, rtol=1e-9
        )
        omitted, huge = kind(**others), 1e32
        assert omitted.observer_prior.kappa == huge
        found = omitted.constants_with(covariance)
        assert found.prior == pytest.approx((low / huge, high * huge), rel=1e-9)
        constant = kind(prior=np.diag([1.0, 2.0, 4.0]), **others)
        assert constant.constants_with(covariance) == constant.constants
        for known in (np.diag([1.0, 0.0, 1.0]), np.ones((3, 3))):
            assert omitted.constants_with(known) is None
            assert not omitted.least_prior(known).any()
    assert RobustCost(noise=Huber(4.0), disturbance=np.eye(3)).constants_with(covariance) is None
    # Singular covariances, too, have a weight.
    known = ObserverPrior().weight(np.diag([0.0, 4.0]))
    assert 1e100 < known[0, 0] < np.inf
    assert known[1, 1] == pytest.approx(0.25)
    for kappa in (0.0, 3.9, -1.0, 1.1e32, np.inf, np.nan, "a", None, [5.0]):
        check(OptionError, ["kappa is", "from 4 to 1e+32"], ObserverPrior, kappa)



def test_wrong_costs_are_named():
    given = weights(2, 2)
    for changes, error, words in (
        *(({"discount": value}, OptionError, [f"discount is {value!r}", "expected a "])
          for value in (0, math.nan, True, 1.0001)),
        ({"disturbance": 0.0}, WeightError, ["disturbance has the", "0", "disturbance_matrix"]),
    ):
        for kind in (RobustCost, QuadraticCost):
            check(error, words, kind, **given | changes)
    check(InvalidInputError, ["noise is <", "expected a loss or a weight matrix"], RobustCost,
          **given | {"noise": ObserverPrior()})


def test_the_usual_joint_weight_is_that_of_the_usual_noise():
    """As a cost that overrides `joint_weight` may expect, which multiplies it, say."""
    class Scaled(qpmhe.QuadraticCost):
        def joint_weight(self, noise, disturbance=None):
            return super().joint_weight(3.0 * noise, disturbance)

    cost = Scaled(prior=np.eye(2), disturbance=np.eye(2), noise=2.0 * np.eye(1))
    assert cost.stage_weight[2, 2] == 6.0


def test_a_subclass_may_set_the_joint_weight():
    class Own(qpmhe.QuadraticCost):
        def __init__(self, **weights):
            super().__init__(**weights)
            self.stage_weight = 2.0 * self.stage_weight

    cost = Own(prior=np.eye(2), disturbance=np.eye(2), noise=3.0 * np.eye(1))
    np.testing.assert_array_equal(cost.stage_weight, np.diag([2.0, 2.0, 6.0]))
    other = cost.with_weights(5.0 * np.eye(1), None)
    np.testing.assert_array_equal(other.stage_weight, np.diag([1.0, 1.0, 5.0]))
