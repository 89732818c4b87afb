"""Weights and their constants, missing outputs, and the prior of an observer."""

import gc
import math
import pickle
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import qpmhe
from qpmhe import ObserverPrior, Power, QuadraticCost, RobustCost
from qpmhe.errors import InvalidInputError, OptionError, WeightError

from .plain import spd
from .spoil import check

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
    cost._kept, expected = 2, [cost._reduced(mask, cost.noise) for mask in masks]

    def work(seed):
        for k in np.random.default_rng(seed).integers(0, 64, 400):
            np.testing.assert_array_equal(cost.partial_weight(masks[k]), expected[k])

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(work, range(6)))


def test_the_bounds_of_the_observer_prior_are_its_constants():
    rule, others = ObserverPrior(0.1, np.int64(10)), {"disturbance": np.eye(3), "noise": 4.0}
    found = rule.weight(np.diag([2.0, 1e9, 0.0]))
    np.testing.assert_allclose(found, np.diag([0.5, 0.1, 10.0]), rtol=1e-9)
    for kind in (QuadraticCost, RobustCost, QuadraticCost.from_covariances):
        assert kind(prior=rule, **others).constants.prior == (0.1, 10.0)
        unbounded = kind(prior=ObserverPrior(), **others)
        assert unbounded.constants is None
        assert not unbounded.least_prior.any()
    # Singular covariances, too, have a weight.
    known = ObserverPrior().weight(np.diag([0.0, 4.0]))
    assert 1e100 < known[0, 0] < np.inf
    assert known[1, 1] == pytest.approx(0.25)
    for bounds in ((0.0, 1.0), (1.0, 1.0), (1.0, np.inf), ("a", 1.0), (1.0, None)):
        text = [f"minimum is {bounds[0]!r} and maximum {bounds[1]!r}", "0 < minimum < maximum"]
        check(OptionError, text, ObserverPrior, *bounds)


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
