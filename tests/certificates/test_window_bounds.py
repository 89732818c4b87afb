"""The bounds beyond the paper, against loops, against each other and against the truth."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.theorem import DecayingSums, TheoremConstants
from qpmhe.certificates.window_bounds import largest, summed_bound, weighted_bound
from qpmhe.costs import CostConstants
from qpmhe.errors import OptionError

SLACK = 1 + 1e-9


def drawn(rng, exponent=2.0):
    def pair():
        low = rng.uniform(0.1, 5.0)
        return low, low * rng.uniform(1.0, 4.0)

    return TheoremConstants(
        DecayingSums(rng.uniform(0.3, 0.97), *rng.uniform(1.0, 3.0, 3)),
        DecayingSums(rng.uniform(0.3, 0.97), *rng.uniform(1.0, 2.0, 3)),
        CostConstants(exponent, pair(), pair(), pair()),
        kappa=rng.uniform(0.1, 1.0), lipschitz=rng.uniform(0.1, 2.0),
        horizon=int(rng.integers(1, 9)),
    )


def record(rng, steps=25):
    w, v = rng.exponential(size=(2, steps)) * (rng.random((2, steps)) < 0.5)
    return rng.exponential(), w, v


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("seed", range(5))
def test_summed_bound_against_loops(exponent, seed):
    rng = np.random.default_rng(seed)
    c = drawn(rng, exponent)
    e, w, v = record(rng)
    found = summed_bound(c).bound(e, w, v)
    eta, (c_p, c_w, c_v) = c.detectability.rate, c.detectability.constants
    a, cost, observer = exponent, c.cost, c.observer.bound(e, w, v)
    observer[0] = c.observer.initial * e
    for t in range(26):
        k = min(t, c.horizon)
        misfits = [c.lipschitz * observer[i] + v[i] for i in range(t - k, t)]
        upper = cost.disturbance[1] * c.kappa**a + cost.noise[1]
        root = sum(upper * m**a for m in misfits) ** (1 / a)
        # A cost of 1, split in the worst way over prior, disturbances and noises.
        gains = [c_p * eta**k / cost.prior[0] ** (1 / a)]
        for tau in range(1, k + 1):
            gains += [
                c_w * eta**tau / cost.disturbance[0] ** (1 / a),
                c_v * eta**tau / cost.noise[0] ** (1 / a),
            ]
        if a == 1.0:
            alpha = max(gains)
        else:
            shares = np.array(gains) ** (1 / (a - 1))
            shares /= np.sum(shares**a) ** (1 / a)
            alpha = float(shares @ gains)
        own = sum(
            eta**tau * (c_w * w[t - tau] + c_v * v[t - tau]) for tau in range(1, k + 1)
        )
        first = e if t <= c.horizon else observer[t - k]
        assert found[t] == pytest.approx(
            alpha * root + own + c_p * eta**k * first, rel=1e-10, abs=1e-12
        )


@pytest.mark.parametrize("exponent", [1.0, 2.0, 2.5])
@pytest.mark.parametrize("seed", range(10))
def test_summed_bound_is_never_above_the_papers(exponent, seed):
    rng = np.random.default_rng(seed)
    constants = drawn(rng, exponent)
    bound = summed_bound(constants)
    for _ in range(5):
        e, w, v = record(rng)
        assert (bound.bound(e, w, v) <= SLACK * constants.result.bound(e, w, v)).all()


def weighted(**changes):
    """The weighted bound of a contraction with these norms; of one dimension, if left out."""
    given = {
        "cost": qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0), "horizon": 3,
        "P": 1.0, "eta": 0.9, "noise_weight": 1.0, "observer_norm": 1.0, "rho": 0.8, "gain": 0.2,
        "slope": 1.0,
    } | changes
    P, V, O, K = (  # noqa: E741
        np.atleast_2d(given[name]) for name in ("P", "noise_weight", "observer_norm", "gain")
    )
    return weighted_bound(
        given["cost"], given["horizon"], eta=given["eta"], P=P, V=V, rho=given["rho"], O=O, K=K,
        slope=given["slope"],
    )


def scalar(slope, output, gain, injected, weights, horizon, P=1.7, O=0.3):  # noqa: E741
    """Summed and weighted bound of a scalar system, whose constants are exact."""
    rho, eta = abs(slope - gain * output), abs(slope - injected * output)
    prior, disturbance, noise = weights
    constants = TheoremConstants(
        DecayingSums(eta, 1.0, 1.0 / eta, abs(injected) / eta),
        DecayingSums(rho, 1.0, 1.0 / rho, abs(gain) / rho),
        CostConstants(2.0, *((weight, weight) for weight in weights)),
        kappa=abs(gain), lipschitz=abs(output), horizon=horizon,
    )
    fit = gain**2 * disturbance + noise
    sharper = weighted(
        cost=qpmhe.QuadraticCost(prior=prior, disturbance=disturbance, noise=noise),
        horizon=horizon, P=P, eta=eta, noise_weight=[[injected * P * injected]],
        observer_norm=O, rho=rho, gain=[[gain]], slope=abs(output) * (fit / O) ** 0.5,
    )
    return summed_bound(constants), sharper


@pytest.mark.parametrize("seed", range(10))
def test_without_output_weight_weighted_and_summed_bound_agree_in_one_dimension(seed):
    rng = np.random.default_rng(seed)
    rho, eta = rng.uniform(0.3, 0.95, 2)
    slope, output = eta * rng.choice([-1, 1]), rng.uniform(0.3, 2.0)
    summed, sharper = scalar(
        slope, output, (slope - rho) / output, 0.0, rng.uniform(0.2, 4, 3),
        int(rng.integers(1, 8)),
    )
    e, w, v = record(rng)
    expected = summed.bound(e, w, v)
    np.testing.assert_allclose(sharper.bound(e, w, v), expected, rtol=1e-10)
    np.testing.assert_allclose(sharper.alphas[1:], summed.alphas[1:] * 1.7**0.5, rtol=1e-10)
    vectors = np.array([-e]), -w[:, None], v[:, None]
    with_signs = sharper.bound(*vectors)
    assert (with_signs <= SLACK * expected).all()
    silent = np.array([-e]), -w[:, None], 0.0 * v[:, None]
    np.testing.assert_allclose(
        sharper.bound(*silent), summed.bound(e, w, np.zeros_like(v)), rtol=1e-10
    )


@pytest.mark.parametrize("seed", range(10))
def test_in_one_dimension_the_weighted_bound_is_the_sharper_one(seed):
    rng = np.random.default_rng(seed)
    rho, eta = rng.uniform(0.3, 0.95, 2)
    slope, output = rng.uniform(-1.2, 1.2), rng.uniform(0.3, 2.0)
    summed, sharper = scalar(
        slope, output, (slope - rho) / output, (slope + eta) / output, rng.uniform(0.2, 4, 3),
        int(rng.integers(1, 8)),
    )
    e, w, v = record(rng)
    assert (sharper.bound(e, w, v) <= SLACK * summed.bound(e, w, v)).all()


@pytest.mark.parametrize("seed", range(10))
def test_a_cost_of_one_pays_for_alpha_and_no_more(seed):
    rng = np.random.default_rng(seed)
    eta, injected, weights = rng.uniform(0.3, 0.95), rng.uniform(0.1, 2.0), rng.uniform(0.2, 4, 3)
    N = int(rng.integers(1, 5))
    bound = weighted(
        cost=qpmhe.QuadraticCost(**dict(zip(("prior", "disturbance", "noise"), weights,
                                            strict=True))),
        horizon=N, eta=eta, noise_weight=[[injected**2]],
    )

    def reached(split):
        norm = split[0] / weights[0] ** 0.5
        for w, v in zip(split[1 : N + 1], split[N + 1 :], strict=True):
            disturbance, noise = w / weights[1] ** 0.5, injected * v / weights[2] ** 0.5
            norm = math.hypot(eta * norm, noise) + disturbance
        return norm

    from scipy.optimize import minimize

    best = 0.0
    for _ in range(8):
        start = rng.random(2 * N + 1)
        answer = minimize(
            lambda s: -reached(np.abs(s) / np.linalg.norm(s)), start, method="BFGS",
            options={"gtol": 1e-9},
        )
        best = max(best, -answer.fun)
    assert best <= bound.alphas[N] * SLACK
    assert best == pytest.approx(bound.alphas[N], rel=1e-3)


class Linear:
    """A linear system, an observer and a cost, with the exact worst admissible estimate."""

    def __init__(self, A, C, K, weights, horizon):
        self.A, self.C, self.K, self.weights, self.N = A, C, K, weights, horizon
        self.n, self.p = A.shape[0], C.shape[0]

    def simulate(self, e, w, v):
        x = np.zeros((len(w) + 1, self.n))
        z, y = x.copy(), np.zeros((len(w), self.p))
        x[0] = e
        for t in range(len(w)):
            y[t] = self.C @ x[t] + v[t]
            x[t + 1] = self.A @ x[t] + w[t]
            z[t + 1] = self.A @ z[t] + self.K @ (y[t] - self.C @ z[t])
        return x, z, y

    def worst(self, x, z, y, t):
        """The largest |x(t) - X_k| over all X with J(X) <= J(candidate)."""
        k, n = min(t, self.N), self.n
        roots = [np.linalg.cholesky(weight).T for weight in self.weights]
        rows, sides = [np.eye(n, (k + 1) * n)], [z[t - k]]
        rows[0], sides[0] = roots[0] @ rows[0], roots[0] @ sides[0]
        for i in range(k):
            step = np.zeros((n, (k + 1) * n))
            step[:, (i + 1) * n : (i + 2) * n] = np.eye(n)
            step[:, i * n : (i + 1) * n] = -self.A
            seen = np.zeros((self.p, (k + 1) * n))
            seen[:, i * n : (i + 1) * n] = self.C
            rows += [roots[1] @ step, roots[2] @ seen]
            sides += [np.zeros(n), roots[2] @ y[t - k + i]]
        F, b = np.vstack(rows), np.concatenate(sides)
        best = np.linalg.lstsq(F, b, rcond=None)[0]
        room = np.sum((F @ z[t - k : t + 1].ravel() - b) ** 2) - np.sum((F @ best - b) ** 2)
        spread = np.linalg.inv(F.T @ F)[-n:, -n:]
        away = x[t] - best[-n:]
        angles = np.linspace(0.0, 2 * np.pi, 361)
        directions = np.ones((1, 1)) if n == 1 else np.stack((np.cos(angles), np.sin(angles)), 1)
        reach = np.sqrt(max(room, 0.0) * np.einsum("di,ij,dj->d", directions, spread, directions))
        return float((np.abs(directions @ away) + reach).max())


def two_states():
    A = np.array([[0.9, 0.3], [-0.2, 0.8]])
    C = np.array([[1.0, 0.4]])
    K = np.array([[0.5], [0.1]])
    weights = np.diag([2.0, 0.5]), np.array([[4.0, 1.0], [1.0, 2.0]]), np.array([[3.0]])
    system = Linear(A, C, K, weights, 4)
    from scipy.linalg import solve_discrete_lyapunov

    # |A - K C| in the norm of this P has the rate r, for each r above the spectral radius.
    closed = A - K @ C
    rate = 0.5 * (1.0 + np.abs(np.linalg.eigvals(closed)).max())
    P = solve_discrete_lyapunov(closed.T / rate, np.eye(2))
    rho = np.sqrt(np.linalg.eigvals(np.linalg.solve(P, closed.T @ P @ closed)).real.max())
    cost = qpmhe.QuadraticCost(prior=weights[0], disturbance=weights[1], noise=weights[2])
    fit = K.T @ weights[1] @ K + weights[2]
    shared = {
        "horizon": 4, "P": P, "observer_norm": P, "rho": rho, "gain": K,
        "slope": largest(C.T @ fit @ C, P) ** 0.5,
    }
    # |(A - K C) dx + K dh| <= sqrt(rho |dx|^2 + c |dh|^2), by Young's inequality.
    more = 1.0 / (1.0 - rho)
    one = weighted(cost=cost, eta=rho**0.5, noise_weight=more * K.T @ P @ K, **shared)
    rate = 0.5 * (1.0 + rho)
    more = 1.0 / (1.0 - rho**2 / rate**2)
    two = weighted(cost=cost, eta=rate, noise_weight=more * K.T @ P @ K, **shared)
    return system, one, two


@pytest.mark.parametrize("seed", range(6))
def test_no_admissible_estimate_is_beyond_the_bounds(seed):
    system, *bounds = two_states()
    rng = np.random.default_rng(seed)
    e = rng.standard_normal(2)
    w = rng.standard_normal((14, 2)) * rng.choice([0.0, 1.0], (14, 1))
    v = rng.standard_normal((14, 1)) * rng.choice([0.0, 1.0])
    x, z, y = system.simulate(e, w, v)
    worst = np.array([system.worst(x, z, y, t) for t in range(15)])
    for bound in bounds:
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
    system, bound, _ = two_states()
    rng = np.random.default_rng(3)
    e, w, v = rng.standard_normal(2), rng.standard_normal((10, 2)), rng.standard_normal((10, 1))
    without = bound.bound(e, w, v)
    cheap = bound.bound(e, w, v, costs=np.zeros(10))
    assert cheap[0] == without[0]
    assert (cheap[1:] < without[1:]).all()
    for useless in (np.full(10, np.inf), np.full(10, np.nan)):
        np.testing.assert_array_equal(bound.bound(e, w, v, costs=useless), without)
    x, _, y = system.simulate(e, w, v)
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda s: s @ system.A.T, lambda s: s @ system.C.T, n=2, p=1),
        qpmhe.Luenberger(system.K),
        qpmhe.QuadraticCost(**dict(zip(("prior", "disturbance", "noise"), system.weights,
                                       strict=True))),
        horizon=4, initial_state=np.zeros(2), max_qps=None,
    )
    run = mhe.run(y)
    known = bound.bound(e, w, v, costs=run.costs)
    assert (known <= without).all()
    assert (np.linalg.norm(run.states - x, axis=1) <= SLACK * known).all()


def test_an_exponent_below_one_has_no_sums():
    with pytest.raises(OptionError, match="exponent"):
        summed_bound(drawn(np.random.default_rng(0), 0.5))
    assert math.isfinite(weighted().bound(1.0, np.ones(0), np.ones(0))[0])
