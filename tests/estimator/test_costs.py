import gc
import itertools
import pickle
import threading
import weakref

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import OptionError


def spd(generator, n):
    root = generator.standard_normal((n, n))
    return root @ root.T + 0.1 * np.eye(n)


def random_cost(n, p, seed=0):
    generator = np.random.default_rng(seed)
    return qpmhe.QuadraticCost(
        prior=spd(generator, n), disturbance=spd(generator, n), noise=spd(generator, p)
    )


@pytest.mark.parametrize("term", ["prior", "disturbance", "noise"])
@pytest.mark.parametrize(("n", "p"), [(1, 1), (2, 1), (3, 4)])
def test_constants_bound_the_cost_and_are_attained(n, p, term):
    cost = random_cost(n, p)
    weight, (low, high) = getattr(cost, term), getattr(cost.constants, term)
    exponent = cost.constants.exponent
    generator = np.random.default_rng(1)
    ratios = []
    for _ in range(2000):
        s = generator.standard_normal(len(weight)) * 10.0 ** generator.uniform(-3, 3)
        value = sum(s[i] * weight[i, j] * s[j] for i in range(len(s)) for j in range(len(s)))
        ratios.append(value / np.linalg.norm(s) ** exponent)
    assert low * (1 - 1e-9) <= min(ratios)
    assert max(ratios) <= high * (1 + 1e-9)
    vectors = np.linalg.eigh(weight)[1]
    assert vectors[:, 0] @ weight @ vectors[:, 0] == pytest.approx(low)
    assert vectors[:, -1] @ weight @ vectors[:, -1] == pytest.approx(high)


def test_the_constants_of_a_known_cost():
    constants = qpmhe.QuadraticCost(
        prior=np.diag([4.0, 1.0]), disturbance=np.diag([100.0, 25.0]), noise=[[25.0]]
    ).constants
    assert constants.exponent == 2.0
    np.testing.assert_allclose(constants.prior, (1.0, 4.0))
    np.testing.assert_allclose(constants.disturbance, (25.0, 100.0))
    np.testing.assert_allclose(constants.noise, (25.0, 25.0))


def test_weights_are_inverse_covariances():
    generator = np.random.default_rng(2)
    prior, disturbance, noise = spd(generator, 3), spd(generator, 3), spd(generator, 2)
    by_covariance = qpmhe.QuadraticCost.from_covariances(
        prior=prior, disturbance=disturbance, noise=noise
    )
    for weight, covariance in (
        (by_covariance.prior, prior),
        (by_covariance.disturbance, disturbance),
        (by_covariance.noise, noise),
    ):
        np.testing.assert_allclose(weight @ covariance, np.eye(len(covariance)), atol=1e-12)
        np.testing.assert_array_equal(weight, weight.T)
    by_weight = qpmhe.QuadraticCost(prior=prior, disturbance=disturbance, noise=noise)
    np.testing.assert_allclose(by_weight.prior, prior)
    np.testing.assert_allclose(by_weight.disturbance, disturbance)
    np.testing.assert_allclose(by_weight.noise, noise)


def test_the_paper_weighs_a_small_noise_heavily():
    cost = qpmhe.QuadraticCost.from_covariances(prior=1.0, disturbance=0.1**2, noise=0.2**2)
    np.testing.assert_allclose([cost.disturbance[0, 0], cost.noise[0, 0]], [100.0, 25.0])


@pytest.mark.parametrize(("n", "p"), [(1, 1), (2, 3)])
def test_the_stage_weight_is_that_of_both_residuals(n, p):
    cost = random_cost(n, p)
    w, v = np.random.default_rng(3).standard_normal((2, n + p))[:, : max(n, p)]
    w, v = w[:n], v[:p]
    joint = np.concatenate([w, v])
    assert joint @ cost.stage_weight @ joint == pytest.approx(
        w @ cost.disturbance @ w + v @ cost.noise @ v
    )
    assert (cost.n, cost.p) == (n, p)


def test_scalars_will_do_for_one_state_and_one_output():
    cost = qpmhe.QuadraticCost(prior=1, disturbance=2.0, noise=np.float64(3.0))
    np.testing.assert_array_equal(cost.prior, [[1.0]])
    np.testing.assert_array_equal(cost.stage_weight, np.diag([2.0, 3.0]))


def test_weights_are_copies():
    given = np.eye(2)
    cost = qpmhe.QuadraticCost(prior=given, disturbance=given, noise=given)
    given[0, 0] = 9.0
    for weight in (cost.prior, cost.disturbance, cost.noise, cost.stage_weight):
        assert weight[0, 0] == 1.0


def masks(p):
    return [np.array(mask) for mask in itertools.product([True, False], repeat=p)]


@pytest.mark.parametrize("mask", masks(3), ids=lambda mask: "".join("xo"[int(b)] for b in mask))
def test_the_partial_weight_is_the_inverse_of_the_observed_covariance(mask):
    n, p = 2, 3
    cost = random_cost(n, p)
    covariance = np.linalg.inv(cost.noise)
    weight = cost.partial_weight(mask)
    np.testing.assert_array_equal(weight[:n], cost.stage_weight[:n])
    np.testing.assert_array_equal(weight[:, :n], cost.stage_weight[:, :n])
    block = weight[n:, n:]
    assert not block[~mask].any()
    assert not block[:, ~mask].any()
    observed = np.ix_(mask, mask)
    np.testing.assert_allclose(
        block[observed] @ covariance[observed], np.eye(mask.sum()), atol=1e-12
    )


@pytest.mark.parametrize("mask", masks(3)[1:-1], ids=str)
def test_a_missing_output_is_one_that_may_take_its_best_value(mask):
    # Minimising |v|_R^2 over the components that are not seen leaves the Schur complement.
    cost = random_cost(2, 3, seed=4)
    v = np.zeros(3)
    v[mask] = np.random.default_rng(5).standard_normal(mask.sum())
    r = cost.noise
    v_best = v.copy()
    v_best[~mask] = -np.linalg.solve(r[np.ix_(~mask, ~mask)], r[np.ix_(~mask, mask)] @ v[mask])
    residual = np.concatenate([np.zeros(2), v])
    assert residual @ cost.partial_weight(mask) @ residual == pytest.approx(v_best @ r @ v_best)


def test_partial_weights_leave_the_full_one_alone():
    cost = random_cost(2, 3)
    before = cost.stage_weight.copy()
    for mask in masks(3) + masks(3)[::-1]:
        cost.partial_weight(mask)
    np.testing.assert_array_equal(cost.stage_weight, before)
    np.testing.assert_allclose(cost.partial_weight(masks(3)[0]), before, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(
        cost.partial_weight(masks(3)[2]), random_cost(2, 3).partial_weight(masks(3)[2])
    )


def reduced(noise, mask):
    weight = np.zeros_like(noise)
    weight[np.ix_(mask, mask)] = np.linalg.inv(np.linalg.inv(noise)[np.ix_(mask, mask)])
    return weight


def test_few_patterns_of_missing_components_are_kept():
    n, p, kept = 10, 30, 2**22
    cost = random_cost(n, p)
    assert len(pickle.dumps(cost)) < kept
    observed = np.random.default_rng(8).random((2000, p)) < 0.7
    matrices, usual = [], cost.partial_weight(observed[0])
    for mask in observed[1:]:
        weight = cost.partial_weight(mask)
        np.testing.assert_allclose(weight[n:, n:], reduced(cost.noise, mask), rtol=1e-9, atol=1e-9)
        assert cost.partial_weight(observed[0]) is usual  # used all the time
        matrices.append(weakref.ref(weight))
    del weight
    gc.collect()
    alive = sum(one() is not None for one in matrices)
    assert 100 < alive <= kept / cost.stage_weight.nbytes
    assert all(one() is not None for one in matrices[-100:])  # the last ones
    assert len(pickle.dumps(cost)) < 1.5 * kept


def test_a_few_patterns_are_kept_of_large_weights():
    cost = random_cost(1, 800)
    first = cost.partial_weight(np.arange(800) != 0)
    for k in range(1, 4):
        cost.partial_weight(np.arange(800) != k)
    assert cost.partial_weight(np.arange(800) != 0) is first


def test_threads_may_share_a_cost_whose_patterns_are_dropped():
    cost, failures = random_cost(1, 12), []
    cost._kept = 2
    expected = {mask.tobytes(): random_cost(1, 12).partial_weight(mask) for mask in masks(12)[:64]}

    def work(seed):
        generator = np.random.default_rng(seed)
        try:
            for _ in range(400):
                mask = masks_of_twelve[generator.integers(64)]
                np.testing.assert_array_equal(cost.partial_weight(mask), expected[mask.tobytes()])
        except BaseException as error:
            failures.append(error)

    masks_of_twelve = masks(12)[:64]
    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(6)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert failures == []


# The prior weight from an observer's covariance


def rotated(eigenvalues, seed=6):
    generator = np.random.default_rng(seed)
    vectors = np.linalg.qr(generator.standard_normal((len(eigenvalues), len(eigenvalues))))[0]
    return vectors, (vectors * np.array(eigenvalues)) @ vectors.T


def test_the_observer_prior_is_the_inverse_covariance_within_its_bounds():
    covariance = spd(np.random.default_rng(7), 4)
    weight = qpmhe.ObserverPrior().weight(covariance)
    np.testing.assert_allclose(weight @ covariance, np.eye(4), atol=1e-11)


@pytest.mark.parametrize(
    ("eigenvalues", "clipped"),
    [
        ([0.5, 2.0, 1.0], [2.0, 0.5, 1.0]),
        ([1e-9, 2.0, 1.0], [10.0, 0.5, 1.0]),
        ([0.5, 2.0, 1e9], [2.0, 0.5, 0.1]),
        ([1e-9, 1e9, 1.0], [10.0, 0.1, 1.0]),
        ([0.0, 2.0, 1.0], [10.0, 0.5, 1.0]),
        ([-1e-3, 2.0, 1.0], [10.0, 0.5, 1.0]),
    ],
    ids=str,
)
def test_the_observer_prior_clips_eigenvalues_and_keeps_directions(eigenvalues, clipped):
    rule = qpmhe.ObserverPrior(minimum=0.1, maximum=10.0)
    vectors, covariance = rotated(eigenvalues)
    expected = (vectors * np.array(clipped)) @ vectors.T
    np.testing.assert_allclose(rule.weight(covariance), expected, rtol=1e-6, atol=1e-6)


def test_the_bounds_of_the_observer_prior_are_its_constants():
    rule = qpmhe.ObserverPrior(minimum=0.1, maximum=10.0)
    cost = qpmhe.QuadraticCost(prior=rule, disturbance=np.eye(3), noise=np.eye(1))
    low, high = cost.constants.prior
    assert (low, high) == (0.1, 10.0)
    generator = np.random.default_rng(8)
    for _ in range(100):
        _, covariance = rotated(10.0 ** generator.uniform(-4, 4, 3), seed=9)
        eigenvalues = np.linalg.eigvalsh(rule.weight(covariance))
        assert eigenvalues[0] >= low * (1 - 1e-9)
        assert eigenvalues[-1] <= high * (1 + 1e-9)


def test_from_covariances_hands_an_observer_prior_on():
    rule = qpmhe.ObserverPrior()
    cost = qpmhe.QuadraticCost.from_covariances(prior=rule, disturbance=2.0, noise=4.0)
    assert cost.prior is rule
    np.testing.assert_allclose(cost.stage_weight, np.diag([0.5, 0.25]))


@pytest.mark.parametrize(
    ("minimum", "maximum"),
    [
        (0.0, 1.0), (-1.0, 1.0), (2.0, 1.0), (1.0, 1.0), (np.nan, 1.0), (1.0, np.inf),
        (1.0, np.nan), ("a", 1.0), (1.0, None),
    ],
)
def test_bounds_of_the_observer_prior_out_of_range(minimum, maximum):
    with pytest.raises(OptionError) as caught:
        qpmhe.ObserverPrior(minimum=minimum, maximum=maximum)
    assert f"minimum is {minimum!r} and maximum {maximum!r}" in str(caught.value)
    assert "0 < minimum < maximum" in str(caught.value)


@pytest.mark.parametrize("kind", [int, np.int64, np.float32, np.float64])
def test_bounds_of_the_observer_prior_may_be_any_number(kind):
    rule = qpmhe.ObserverPrior(minimum=kind(1), maximum=kind(8))
    assert (rule.minimum, rule.maximum) == (1.0, 8.0)


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1e6, 1e9])
def test_an_observer_prior_without_bounds_is_the_inverse_in_any_unit(unit):
    generator = np.random.default_rng(10)
    units = unit ** np.array([1.0, 0.0, -1.0])
    covariance = spd(generator, 3)
    weight = qpmhe.ObserverPrior().weight(covariance * np.outer(units, units))
    np.testing.assert_allclose(
        weight * np.outer(units, units), np.linalg.inv(covariance), rtol=1e-9
    )


def test_an_observer_prior_without_bounds_is_equivariant_to_the_bit():
    generator = np.random.default_rng(11)
    for n in (1, 2, 5):
        covariance = spd(generator, n)
        units = 2.0 ** generator.integers(-40, 41, n)
        found = qpmhe.ObserverPrior().weight(covariance * np.outer(units, units))
        np.testing.assert_array_equal(
            found * np.outer(units, units), qpmhe.ObserverPrior().weight(covariance)
        )


def test_an_observer_prior_without_bounds_bears_singular_covariances():
    flat = np.outer([1.0, 1e6], [1.0, 1e6])
    weight = qpmhe.ObserverPrior().weight(flat)
    assert np.isfinite(weight).all()
    assert np.linalg.eigvalsh(weight * np.outer([1.0, 1e6], [1.0, 1e6]))[-1] > 1e11
    known = qpmhe.ObserverPrior().weight(np.diag([0.0, 4.0]))
    assert np.isfinite(known).all()
    assert known[0, 0] > 1e100
    assert known[1, 1] == pytest.approx(0.25)


def test_an_observer_prior_without_bounds_has_no_constants():
    for cost in (qpmhe.QuadraticCost, qpmhe.RobustCost):
        made = cost(prior=qpmhe.ObserverPrior(), disturbance=np.eye(2), noise=1.0)
        assert made.constants is None
        assert not made.least_prior.any()


@pytest.mark.parametrize("size", [1, 2, 4])
def test_inverses_and_solutions_are_equivariant_to_the_bit(size):
    from qpmhe._linalg import inverse, solve

    generator = np.random.default_rng(size)
    for _ in range(20):
        matrix, side = spd(generator, size), generator.standard_normal((size, 3))
        units = 2.0 ** generator.integers(-40, 41, size)
        columns, whole = 2.0 ** generator.integers(-40, 41, 3), 2.0 ** generator.integers(-9, 9)
        other = whole * matrix * np.outer(units, units)
        np.testing.assert_allclose(inverse(matrix) @ matrix, np.eye(size), atol=1e-9)
        np.testing.assert_array_equal(
            inverse(other) * np.outer(units, units) * whole, inverse(matrix)
        )
        np.testing.assert_array_equal(
            solve(other, side * np.outer(units, columns)) * whole,
            solve(matrix, side) * np.outer(1.0 / units, columns),
        )


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_weights_of_rows_in_any_unit_are_weights(unit):
    matrix = spd(np.random.default_rng(12), 3)
    units = np.array([1.0, unit, unit**2])
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=matrix * np.outer(units, units), disturbance=matrix * np.outer(units, units), noise=1
    )
    np.testing.assert_allclose(
        cost.prior * np.outer(units, units), np.linalg.inv(matrix), rtol=1e-9
    )
    wrong = matrix * np.outer(units, units)
    wrong[0, 1] *= 1.001
    with pytest.raises(qpmhe.errors.WeightError, match="not symmetric"):
        qpmhe.QuadraticCost.from_covariances(prior=wrong, disturbance=matrix, noise=1.0)
    negative = matrix * np.outer(units, units)
    negative[0] = negative[:, 0] = 3.0 * negative[:, 1] * units[0] / units[1]
    with pytest.raises(qpmhe.errors.WeightError, match="positive definite"):
        qpmhe.QuadraticCost.from_covariances(prior=negative, disturbance=matrix, noise=1.0)


@pytest.mark.parametrize(("name", "remedy"), [
    ("prior", "every direction"), ("disturbance", "disturbance_matrix"),
    ("noise", "every direction"),
])
def test_the_remedy_for_a_singular_weight_is_one_for_this_weight(name, remedy):
    weights = {"prior": 1.0, "disturbance": 1.0, "noise": 1.0, name: 0.0}
    with pytest.raises(qpmhe.errors.WeightError, match=f"{name} has the eigenvalue 0.*{remedy}"):
        qpmhe.QuadraticCost(**weights)


@pytest.mark.parametrize("name", ["prior", "disturbance", "noise"])
@pytest.mark.parametrize(
    "make",
    [
        qpmhe.QuadraticCost, qpmhe.QuadraticCost.from_covariances, qpmhe.ExtendedKalman,
        qpmhe.UnscentedKalman,
    ],
)
def test_a_vector_in_place_of_a_matrix_suggests_a_diagonal(make, name):
    matrices = dict.fromkeys(("prior", "disturbance", "noise"), np.eye(2)) | {name: [1.0, 2.0]}
    with pytest.raises(qpmhe.errors.ShapeError, match=rf"{name}.* has shape \(2,\).*np\.diag"):
        make(**matrices)
