"""Sparse products of a stage beside dense ones."""

import numpy as np
import pytest

import qpmhe
from qpmhe.terms.linearization import Stage, StageTerms

N, P = 160, 16


def both(linear, weight):
    """Cost and terms by sparse products, and by dense ones."""
    found = []
    for sparse in (True, False):
        terms = StageTerms(1, N, P)
        assert terms._sparse is not None
        if not sparse:
            terms._sparse = None
        terms.panel.fill(7.0)
        terms.linear[0] = linear
        with np.errstate(all="raise" if sparse else "ignore"):
            cost = terms.set_stage(Stage(terms, 0), weight)
        found.append((cost, terms.panel[0], terms.gradient[0], terms.next_gradient[0]))
    return found


def stage(seed=0):
    """A tridiagonal A and a C that reads every tenth state; weights with blocks."""
    generator = np.random.default_rng(seed)
    linear, weight = np.zeros((N + P, 1 + N)), np.diag(generator.uniform(0.1, 9.0, N + P))
    linear[:, 0] = generator.normal(size=N + P)
    for k in (-1, 0, 1):
        linear[:N, 1:] += np.diag(generator.normal(size=N - abs(k)), k)
    linear[N + np.arange(P), 1 + 10 * np.arange(P)] = -1.0
    weight[3, 4] = weight[4, 3] = 0.05
    return linear, weight


def test_they_are_those_of_dense_products():
    for seed in range(3):
        linear, weight = stage(seed)
        linear[5 * seed, 40] = 3.0  # another pattern each time
        for found, expected in zip(*both(linear, weight), strict=True):
            assert np.allclose(found, expected, rtol=1e-13, atol=1e-12)


def test_one_copy_follows_patterns_that_change():
    terms, dense = StageTerms(1, N, P), StageTerms(1, N, P)
    dense._sparse = None
    for seed in (0, 1, 1, 2):
        linear, weight = stage(seed)
        linear[seed, 100 + seed], weight[N:, N:] = 1.0, weight[N:, N:] * (seed != 1)
        costs = []
        for one in (terms, dense):
            one.linear[0] = linear
            costs.append(one.set_stage(Stage(one, 0), weight))
        assert costs[0] == pytest.approx(costs[1], rel=1e-12)
        assert np.allclose(terms.panel, dense.panel, rtol=1e-13, atol=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
@pytest.mark.parametrize("place", [(2, 0), (2, 3), (N + 1, 11), (N + 1, 0)])
@pytest.mark.parametrize("weightless", [False, True])
def test_what_is_not_finite_has_no_cost(weightless, place, value):
    """As dense products: where a weight is 0, too."""
    linear, weight = stage()
    linear[place] = value
    if weightless:
        weight[place[0]] = weight[:, place[0]] = 0.0
    costs = [one[0] for one in both(linear, weight)]
    assert np.isfinite(costs[0]) == np.isfinite(costs[1])


def test_dense_ones_stay_dense():
    linear, weight = stage()
    linear[:, 1:] += 0.1
    sparse, dense = both(linear, weight)
    for found, expected in zip(sparse, dense, strict=True):
        assert np.array_equal(found, expected)


def test_estimates_are_the_same(monkeypatch):
    """Diffusion with a reaction on a line, with gaps."""
    def f(x):
        left, right = np.append(x[:1], x[:-1]), np.append(x[1:], x[-1:])
        return x + 0.1 * (left - 2.0 * x + right) + 0.01 * x * (1.0 - x)

    def jacobian(x):
        A = 0.1 * (np.eye(N, k=1) + np.eye(N, k=-1)) + np.diag(0.81 - 0.02 * x)
        A[0, 0] += 0.1
        A[-1, -1] += 0.1
        return A

    C = np.eye(N)[::10]
    system = qpmhe.System(
        f=f, h=lambda x: C @ x, n=N, p=P, f_jacobian=jacobian, h_jacobian=lambda x: C
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(N), disturbance=5.0 * np.eye(N), noise=9.0 * np.eye(P))
    Y = 0.5 + 0.1 * np.random.default_rng(0).normal(size=(12, P))
    Y[5, 3] = np.nan
    runs = []
    for _ in range(2):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(0.3 * C.T), cost, horizon=4, initial_state=np.full(N, 0.4),
            engine="python",
        )
        runs.append([mhe.update(y) for y in Y])
        monkeypatch.setattr("qpmhe.terms.entries._LEAST_STATES", 10 * N)
    for sparse, dense in zip(*runs, strict=True):
        assert sparse.cost == pytest.approx(dense.cost, rel=1e-12)
        assert sparse.trajectory == pytest.approx(dense.trajectory, rel=1e-11)
        assert sparse.status == dense.status
