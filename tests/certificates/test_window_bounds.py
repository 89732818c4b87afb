"""The bounds beyond the paper, against loops, against each other and against the truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

import qpmhe
from qpmhe.certificates.theorem import TheoremConstants
from qpmhe.certificates.window_bounds import largest, summed_bound, weighted_bound
from qpmhe.errors import OptionError

from .helpers import linear
from .test_theorem import drawn

SLACK = 1 + 1e-9
NAMES = "prior", "disturbance", "noise"


def drawn_constants(seed, exponent=2.0):
    arguments = drawn(seed)
    cost = replace(arguments["cost"], exponent=exponent)
    return TheoremConstants(**arguments | {"cost": cost, "horizon": 1 + seed % 8})


def record(rng, steps=25):
    w, v = rng.exponential(size=(2, steps)) * (rng.random((2, steps)) < 0.5)
    return rng.exponential(), w, v


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("seed", range(4))
def test_summed_bound_against_loops_and_below_the_papers(exponent, seed):
    rng, c = np.random.default_rng(seed), drawn_constants(seed, exponent)
    e, w, v = record(rng)
    found = summed_bound(c).bound(e, w, v)
    assert (found <= SLACK * c.result.bound(e, w, v)).all()
    eta, (c_p, c_w, c_v) = c.detectability.rate, c.detectability.constants
    a, cost, observer = exponent, c.cost, c.observer.bound(e, w, v)
    observer[0] = c.observer.initial * e
    upper = cost.disturbance[1] * c.kappa**a + cost.noise[1]
    paid = [each[0] ** (-1 / a) for each in (cost.prior, cost.disturbance, cost.noise)]
    for t in range(26):
        k = min(t, c.horizon)
        root = sum(
            upper * (c.lipschitz * observer[i] + v[i]) ** a for i in range(t - k, t)
        ) ** (1 / a)
        # A cost of 1, split in the worst way over prior, disturbances and noises.
        gains = [c_p * eta**k * paid[0]]
        for tau in range(1, k + 1):
            gains += [c_w * eta**tau * paid[1], c_v * eta**tau * paid[2]]
        if a == 1.0:
            alpha = max(gains)
        else:
            shares = np.array(gains) ** (1 / (a - 1))
            alpha = float(shares @ gains) / np.sum(shares**a) ** (1 / a)
        own = sum(eta**tau * (c_w * w[t - tau] + c_v * v[t - tau]) for tau in range(1, k + 1))
        first = e if t <= c.horizon else observer[t - k]
        assert found[t] == pytest.approx(
            alpha * root + own + c_p * eta**k * first, rel=1e-10, abs=1e-12
        )


A, C, K = np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([[1.0, 0.4]]), np.array([[0.5], [0.1]])
WEIGHTS = {
    "prior": np.diag([2.0, 0.5]), "disturbance": np.array([[4.0, 1.0], [1.0, 2.0]]),
    "noise": np.array([[3.0]]),
}
LINEAR_COST, N = qpmhe.QuadraticCost(**WEIGHTS), 4


def two_bounds():
    """Of the linear system, from one norm in which A - K C contracts, with two rates eta."""
    closed = A - K @ C
    slow = 0.5 * (1.0 + np.abs(np.linalg.eigvals(closed)).max())
    P = solve_discrete_lyapunov(closed.T / slow, np.eye(2))
    rho = largest(closed.T @ P @ closed, P) ** 0.5
    fit = K.T @ WEIGHTS["disturbance"] @ K + WEIGHTS["noise"]
    # |(A - K C) dx + K dh|^2 <= eta^2 |dx|^2 + |K dh|^2 / (1 - rho^2 / eta^2), by Young's.
    return [
        weighted_bound(
            LINEAR_COST, N, eta=eta, P=P, V=K.T @ P @ K / (1.0 - rho**2 / eta**2), rho=rho, O=P,
            K=K, slope=largest(C.T @ fit @ C, P) ** 0.5,
        )
        for eta in (rho**0.5, 0.5 * (1.0 + rho))
    ]


def simulated(e, w, v):
    """States from e on, those of the observer from 0 on, and measurements."""
    x, z, y = np.zeros((len(w) + 1, 2)), np.zeros((len(w) + 1, 2)), np.zeros((len(w), 1))
    x[0] = e
    for t in range(len(w)):
        y[t] = C @ x[t] + v[t]
        x[t + 1] = A @ x[t] + w[t]
        z[t + 1] = A @ z[t] + K @ (y[t] - C @ z[t])
    return x, z, y


def worst_admissible(x, z, y, t):
    """The largest |x(t) - X_k| over all X with J(X) <= J(candidate)."""
    k = min(t, N)
    roots = {name: np.linalg.cholesky(weight).T for name, weight in WEIGHTS.items()}
    rows, sides = [np.eye(2, 2 * k + 2)], [roots["prior"] @ z[t - k]]
    rows[0] = roots["prior"] @ rows[0]
    for i in range(k):
        here, ahead = (np.eye(2, 2 * k + 2, 2 * j) for j in (i, i + 1))
        rows += [roots["disturbance"] @ (ahead - A @ here), roots["noise"] @ C @ here]
        sides += [np.zeros(2), roots["noise"] @ y[t - k + i]]
    F, b = np.vstack(rows), np.concatenate(sides)
    best = np.linalg.lstsq(F, b, rcond=None)[0]
    room = np.sum((F @ z[t - k : t + 1].ravel() - b) ** 2) - np.sum((F @ best - b) ** 2)
    spread = max(room, 0.0) * np.linalg.inv(F.T @ F)[-2:, -2:]
    angles = np.linspace(0.0, 2 * np.pi, 361)
    rays = np.stack((np.cos(angles), np.sin(angles)), 1)
    reach = np.sqrt(np.einsum("di,ij,dj->d", rays, spread, rays))
    return float((np.abs(rays @ (x[t] - best[-2:])) + reach).max())


@pytest.mark.parametrize("seed", range(6))
def test_no_admissible_estimate_is_beyond_the_bounds(seed):
    rng = np.random.default_rng(seed)
    e = rng.standard_normal(2)
    w = rng.standard_normal((14, 2)) * rng.choice([0.0, 1.0], (14, 1))
    v = rng.standard_normal((14, 1)) * rng.choice([0.0, 1.0])
    x, z, y = simulated(e, w, v)
    worst = np.array([worst_admissible(x, z, y, t) for t in range(15)])
    for bound in two_bounds():
        along = bound.bound(e, w, v)
        assert (worst <= SLACK * along).all()
        # Lengths tell less than vectors.
        lengths = np.linalg.norm(e), np.linalg.norm(w, axis=1), np.linalg.norm(v, axis=1)
        assert (along <= SLACK * bound.bound(*lengths)).all()
        late = bound.bound(0.0, np.full(800, 0.3), np.full(800, 0.7))[-1]
        assert bound.limit(0.3, 0.7) == pytest.approx(late, rel=1e-9)
        most = bound.bound(lengths[0], *(np.full(14, each.max()) for each in lengths[1:]))
        assert (along <= SLACK * most).all()


def test_known_costs_take_the_place_of_their_bound():
    rng, bound = np.random.default_rng(3), two_bounds()[0]
    e, w, v = rng.standard_normal(2), rng.standard_normal((10, 2)), rng.standard_normal((10, 1))
    without, cheap = bound.bound(e, w, v), bound.bound(e, w, v, costs=np.zeros(10))
    assert cheap[0] == without[0]
    assert (cheap[1:] < without[1:]).all()
    for useless in (np.full(10, np.inf), np.full(10, np.nan)):
        np.testing.assert_array_equal(bound.bound(e, w, v, costs=useless), without)
    x, _, y = simulated(e, w, v)
    run = qpmhe.MovingHorizonEstimator(
        linear(A, C), qpmhe.Luenberger(K), LINEAR_COST, horizon=N, initial_state=np.zeros(2),
        max_qps=None,
    ).run(y)
    known = bound.bound(e, w, v, costs=run.costs)
    assert (known <= without).all()
    assert (np.linalg.norm(run.states - x, axis=1) <= SLACK * known).all()


def test_an_exponent_below_one_has_no_sums():
    with pytest.raises(OptionError, match="exponent"):
        summed_bound(drawn_constants(0, 0.5))
