"""Weights, the constants of their costs, missing outputs, and the prior of an observer."""

import gc
import itertools
import pickle
import threading
import weakref

import numpy as np
import pytest

import qpmhe
from qpmhe import ObserverPrior, QuadraticCost
from qpmhe.errors import OptionError, ShapeError, WeightError

from .plain import spd

TERMS = ("prior", "disturbance", "noise")


def random_cost(n, p, seed=0):
    generator = np.random.default_rng(seed)
    return QuadraticCost(
        prior=spd(generator, n), disturbance=spd(generator, n), noise=spd(generator, p)
    )


@pytest.mark.parametrize(("n", "p"), [(1, 1), (3, 4)])
def test_constants_bound_the_cost_and_are_attained(n, p):
    cost, generator = random_cost(n, p), np.random.default_rng(1)
    assert ((cost.n, cost.p), cost.constants.exponent) == ((n, p), 2.0)
    for term in TERMS:
        weight, (low, high) = getattr(cost, term), getattr(cost.constants, term)
        s = generator.standard_normal((500, len(weight))) * 10.0 ** generator.uniform(-3, 3)
        ratios = np.einsum("ki,ij,kj->k", s, weight, s) / (s**2).sum(axis=1)
        assert low * (1 - 1e-9) <= ratios.min()
        assert ratios.max() <= high * (1 + 1e-9)
        vectors = np.linalg.eigh(weight)[1]
        assert vectors[:, 0] @ weight @ vectors[:, 0] == pytest.approx(low)
        assert vectors[:, -1] @ weight @ vectors[:, -1] == pytest.approx(high)
    w, v = generator.standard_normal(n), generator.standard_normal(p)
    joint = np.concatenate([w, v])
    assert joint @ cost.stage_weight @ joint == pytest.approx(
        w @ cost.disturbance @ w + v @ cost.noise @ v
    )


def test_weights_are_inverse_covariances_and_copies():
    generator = np.random.default_rng(2)
    given = {"prior": spd(generator, 3), "disturbance": spd(generator, 3),
             "noise": spd(generator, 2)}
    by_weight, by_covariance = QuadraticCost(**given), QuadraticCost.from_covariances(**given)
    for term, matrix in given.items():
        before, weight = matrix.copy(), getattr(by_covariance, term)
        np.testing.assert_allclose(weight @ matrix, np.eye(len(matrix)), atol=1e-12)
        np.testing.assert_array_equal(weight, weight.T)
        matrix[0, 0] = 9.0
        np.testing.assert_allclose(getattr(by_weight, term), before)
    scalar = QuadraticCost(prior=1, disturbance=2.0, noise=np.float64(3.0))
    np.testing.assert_array_equal(scalar.stage_weight, np.diag([2.0, 3.0]))


def masks(p):
    return [np.array(mask) for mask in itertools.product([True, False], repeat=p)]


def reduced(noise, mask):
    """The inverse of the covariance of the outputs that there are."""
    weight, observed = np.zeros_like(noise), np.ix_(mask, mask)
    weight[observed] = np.linalg.inv(np.linalg.inv(noise)[observed])
    return weight


def test_the_partial_weight_is_the_inverse_of_the_observed_covariance():
    cost = random_cost(2, 3)
    before = cost.stage_weight.copy()
    for mask in masks(3) + masks(3)[::-1]:
        weight = cost.partial_weight(mask)
        np.testing.assert_array_equal(weight[:2], before[:2])
        np.testing.assert_array_equal(weight[:, :2], before[:, :2])
        block = weight[2:, 2:]
        assert not block[~mask].any()
        assert not block[:, ~mask].any()
        np.testing.assert_allclose(block, reduced(cost.noise, mask), rtol=1e-10, atol=1e-12)
    np.testing.assert_array_equal(cost.stage_weight, before)


def test_few_patterns_of_missing_components_are_kept():
    n, p, kept = 10, 30, 2**22
    cost = random_cost(n, p)
    observed = np.random.default_rng(8).random((1500, p)) < 0.7
    matrices, usual = [], cost.partial_weight(observed[0])
    for mask in observed[1:]:
        weight = cost.partial_weight(mask)
        assert cost.partial_weight(observed[0]) is usual  # used all the time
        matrices.append(weakref.ref(weight))
    np.testing.assert_allclose(weight[n:, n:], reduced(cost.noise, mask), rtol=1e-9, atol=1e-9)
    del weight
    gc.collect()
    alive = sum(one() is not None for one in matrices)
    assert 100 < alive <= kept / cost.stage_weight.nbytes
    assert all(one() is not None for one in matrices[-100:])  # the last ones
    assert len(pickle.dumps(cost)) < 1.5 * kept


def test_threads_may_share_a_cost_whose_patterns_are_dropped():
    cost, failures, patterns = random_cost(1, 12), [], masks(12)[:64]
    cost._kept = 2
    expected = [random_cost(1, 12).partial_weight(mask) for mask in patterns]

    def work(seed):
        try:
            for k in np.random.default_rng(seed).integers(0, 64, 400):
                np.testing.assert_array_equal(cost.partial_weight(patterns[k]), expected[k])
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(6)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert failures == []


# The prior weight from an observer's covariance


def test_the_observer_prior_is_the_inverse_covariance_in_any_unit():
    generator = np.random.default_rng(10)
    for n in (1, 2, 5):
        covariance = spd(generator, n)
        weight = ObserverPrior().weight(covariance)
        np.testing.assert_allclose(weight @ covariance, np.eye(n), atol=1e-10)
        units = 2.0 ** generator.integers(-40, 41, n)
        found = ObserverPrior().weight(covariance * np.outer(units, units))
        np.testing.assert_array_equal(found * np.outer(units, units), weight)
        for unit in (1e-9, 1e9):
            units = unit ** np.linspace(-1.0, 1.0, n)
            found = ObserverPrior().weight(covariance * np.outer(units, units))
            np.testing.assert_allclose(found * np.outer(units, units), weight, rtol=1e-8)
    # Singular ones, too.
    flat = np.outer([1.0, 1e6], [1.0, 1e6])
    weight = ObserverPrior().weight(flat)
    assert np.isfinite(weight).all()
    assert np.linalg.eigvalsh(weight * flat)[-1] > 1e11
    known = ObserverPrior().weight(np.diag([0.0, 4.0]))
    assert np.isfinite(known).all()
    assert known[0, 0] > 1e100
    assert known[1, 1] == pytest.approx(0.25)


def test_the_observer_prior_clips_eigenvalues_and_keeps_directions():
    rule = ObserverPrior(minimum=0.1, maximum=10.0)
    vectors = np.linalg.qr(np.random.default_rng(6).standard_normal((3, 3)))[0]
    for eigenvalues, clipped in (
        ([0.5, 2.0, 1.0], [2.0, 0.5, 1.0]), ([1e-9, 1e9, 1.0], [10.0, 0.1, 1.0]),
        ([0.0, 2.0, 1.0], [10.0, 0.5, 1.0]), ([-1e-3, 2.0, 1.0], [10.0, 0.5, 1.0]),
    ):
        weight = rule.weight((vectors * np.array(eigenvalues)) @ vectors.T)
        expected = (vectors * np.array(clipped)) @ vectors.T
        np.testing.assert_allclose(weight, expected, rtol=1e-6, atol=1e-6)


def test_the_bounds_of_the_observer_prior_are_its_constants():
    weights = {"disturbance": 2.0 * np.eye(3), "noise": 4.0}
    rule = ObserverPrior(minimum=np.float32(0.125), maximum=np.int64(8))
    assert (rule.minimum, rule.maximum) == (0.125, 8.0)
    assert QuadraticCost(prior=rule, **weights).constants.prior == (0.125, 8.0)
    cost = QuadraticCost.from_covariances(prior=rule, **weights)
    assert cost.prior is rule
    np.testing.assert_allclose(cost.stage_weight, np.diag([0.5, 0.5, 0.5, 0.25]))
    for kind in (QuadraticCost, qpmhe.RobustCost):
        unbounded = kind(prior=ObserverPrior(), **weights)
        assert unbounded.constants is None
        assert not unbounded.least_prior.any()


def test_bounds_of_the_observer_prior_out_of_range():
    for minimum, maximum in (
        (0.0, 1.0), (-1.0, 1.0), (2.0, 1.0), (1.0, 1.0), (np.nan, 1.0), (1.0, np.inf),
        (1.0, np.nan), ("a", 1.0), (1.0, None),
    ):
        with pytest.raises(OptionError, match="0 < minimum < maximum") as caught:
            ObserverPrior(minimum=minimum, maximum=maximum)
        assert f"minimum is {minimum!r} and maximum {maximum!r}" in str(caught.value)


# Units and errors of weights


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_weights_of_rows_in_any_unit_are_weights(unit):
    matrix = spd(np.random.default_rng(12), 3)
    scale = np.outer([1.0, unit, unit**2], [1.0, unit, unit**2])
    prior = QuadraticCost.from_covariances(
        prior=matrix * scale, disturbance=matrix * scale, noise=1
    ).prior
    np.testing.assert_allclose(prior * scale, np.linalg.inv(matrix), rtol=1e-9)
    skew, negative = matrix * scale, matrix.copy()
    skew[0, 1] *= 1.001
    negative[0] = negative[:, 0] = 3.0 * negative[:, 1]
    for wrong, text in ((skew, "not symmetric"), (negative * scale, "positive definite")):
        with pytest.raises(WeightError, match=text):
            QuadraticCost.from_covariances(prior=wrong, disturbance=matrix, noise=1.0)


def test_the_remedy_for_a_singular_weight_and_a_vector_is_one_for_this_weight():
    for name in TERMS:
        remedy = "disturbance_matrix" if name == "disturbance" else "every direction"
        with pytest.raises(WeightError, match=f"{name} has the eigenvalue 0.*{remedy}"):
            QuadraticCost(**dict.fromkeys(TERMS, 1.0) | {name: 0.0})
        for make in (QuadraticCost, QuadraticCost.from_covariances, qpmhe.ExtendedKalman,
                     qpmhe.UnscentedKalman):
            with pytest.raises(ShapeError, match=rf"{name}.* has shape \(2,\).*np\.diag"):
                make(**dict.fromkeys(TERMS, np.eye(2)) | {name: [1.0, 2.0]})
