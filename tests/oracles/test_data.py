"""Missing, late, multi-rate and unevenly sampled data against dense least squares.

The references are plain loops over one sample after another; a term that is not known is
left out of them. They share no code with the library.
"""

from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares

import qpmhe
from qpmhe import Status

BACKENDS = qpmhe.solvers.available()
NAN = np.nan
HORIZON, STEPS, DT = 5, 12, 0.1
START = np.array([0.8, -0.3])
GAIN = np.array([[0.2, 0.05, -0.05], [0.1, 0.2, 0.05]])
PRIOR = np.array([[2.0, 0.5], [0.5, 1.0]])
DISTURBANCE = np.array([[300.0, -80.0], [-80.0, 200.0]])
# The noises are strongly correlated: the weight of some is not a block of the whole weight.
COVARIANCE = 0.04 * np.array([[1.0, 0.8, -0.6], [0.8, 1.2, -0.3], [-0.6, -0.3, 0.9]])


def rate(x, u):
    return np.stack([x[..., 1], -2.0 * np.sin(x[..., 0]) - 0.3 * x[..., 1] + u[..., 0]], axis=-1)


def h(x, u):
    one, two = x[..., 0], x[..., 1]
    return np.stack([one + 0.2 * two**2, two + 0.1 * u[..., 0], np.sin(one) * two], axis=-1)


def f(x, u, length):
    """One step of the classical Runge-Kutta method."""
    a = rate(x, u)
    b = rate(x + 0.5 * length * a, u)
    c = rate(x + 0.5 * length * b, u)
    return x + length / 6.0 * (a + 2.0 * b + 2.0 * c + rate(x + length * c, u))


class Record:
    """Samples, what is known of each at once, and what comes later.

    Parameters
    ----------
    known : (T, p) bool array
        What comes in time.
    late : dict
        For the time of an arrival, pairs of a sample's time and a mask of what arrives.
    lengths : list
        The length of each step, None where it is the usual one.
    weights : list
        The weight of each sample's noise, None where it is the usual one.
    """

    def __init__(self, known, late=None, lengths=None, weights=None):
        rng = np.random.default_rng(3)
        self.known, self.late = known, late or {}
        self.lengths = lengths or [None] * STEPS
        self.weights = weights or [None] * STEPS
        self.U = 0.5 * rng.standard_normal((STEPS, 1))
        self.Y, x = np.empty((STEPS, 3)), START + 0.35
        for t, u in enumerate(self.U):
            self.Y[t] = h(x, u) + np.linalg.cholesky(COVARIANCE) @ rng.standard_normal(3)
            x = f(x, u, self.lengths[t] or DT) + 0.05 * rng.standard_normal(2)

    def at(self, now):
        """The measurements up to a time, NaN where they have not come by then."""
        known = self.known[: now + 1].copy()
        for arrival, items in self.late.items():
            for time, mask in items:
                if arrival <= now:
                    known[time] |= mask
        return np.where(known, self.Y[: now + 1], NAN)

    def estimates(self, **options):
        system = qpmhe.System.from_ode(rate, h, dt=DT, n=2, p=3, m=1, method="rk4")
        cost = qpmhe.QuadraticCost(
            prior=PRIOR, disturbance=DISTURBANCE, noise=np.linalg.inv(COVARIANCE)
        )
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(GAIN), cost, horizon=HORIZON, initial_state=START, **options
        )
        for t in range(STEPS):
            estimate = mhe.update(
                np.where(self.known[t], self.Y[t], NAN), self.U[t],
                dt=self.lengths[t], noise_weight=self.weights[t],
            )
            for time, mask in self.late.get(t, ()):
                estimate = mhe.amend(time, np.where(mask, self.Y[time], NAN))
            yield estimate

    def observer(self, Y):
        path = [START]
        for t, y in enumerate(Y):
            v = np.where(np.isfinite(y), y - h(path[-1], self.U[t]), 0.0)
            path.append(f(path[-1], self.U[t], self.lengths[t] or DT) + GAIN @ v)
        return np.array(path)

    def terms(self, trajectory, prior, first, Y, weigh):
        """All terms of J as one vector whose square is J."""
        parts = [_root(PRIOR) @ (trajectory[0] - prior)]
        for k, y in enumerate(Y):
            t, x = first + k, trajectory[k]
            w = trajectory[k + 1] - f(x, self.U[t], self.lengths[t] or DT)
            parts.append(_root(DISTURBANCE) @ w)
            there = np.isfinite(y)
            if there.any():
                weight = weigh(self.weights[t], there)
                parts.append(_root(weight) @ (y - h(x, self.U[t]))[there])
        return np.concatenate(parts)

    def minimum(self, now, weigh=None):
        """Candidate, its cost, and the minimum of the window that ends with a sample."""
        Y = self.at(now)
        first = max(0, now + 1 - HORIZON)
        candidate = self.observer(Y)[first:]
        known = candidate[0], first, Y[first:], weigh or _weight_of
        found = least_squares(
            lambda flat: self.terms(flat.reshape(-1, 2), *known), candidate.ravel(),
            method="lm", xtol=1e-13, ftol=1e-13, gtol=1e-13,
        )
        cost = np.sum(self.terms(candidate, *known) ** 2)
        return candidate, cost, 2.0 * found.cost, found.x.reshape(-1, 2)


def _root(weight):
    return np.linalg.cholesky(weight).T


def _weight_of(own, there):
    """The inverse of the covariance of the components that are there."""
    covariance = COVARIANCE if own is None else np.linalg.inv(own)
    return np.linalg.inv(covariance[there][:, there])


def _block_of(own, there):
    """What it is not."""
    weight = np.linalg.inv(COVARIANCE) if own is None else own
    return weight[there][:, there]


def _all():
    return np.ones((STEPS, 3), dtype=bool)


def _some(seed):
    known = np.random.default_rng(seed).random((STEPS, 3)) < 0.6
    known[[4, 5]] = False
    return known


def _rates():
    """Outputs with every, every second and every third sample."""
    return np.arange(STEPS)[:, None] % np.array([1, 2, 3]) == 0


def _delayed(delay):
    """The second output comes so many samples late, the others in time."""
    known = _all()
    known[:, 1] = False
    mask = np.array([False, True, False])
    return known, {t: [(t - delay, mask)] for t in range(delay, STEPS)}


def _disordered():
    """Whole samples and single outputs, several at once, older ones after newer ones."""
    known = _some(2)
    second, others = np.array([False, True, False]), np.array([True, False, True])
    return known, {
        6: [(5, second), (4, second)], 7: [(4, others)], 9: [(5, others), (5, second)],
        11: [(11, ~known[11]), (8, ~known[8])],
    }


def _weights(seed):
    """Weights of their own for about half of the samples."""
    rng = np.random.default_rng(seed)
    weights = []
    for _ in range(STEPS):
        factor = rng.standard_normal((3, 3))
        own = 5.0 * (factor @ factor.T + 0.3 * np.eye(3))
        weights.append(own if rng.random() < 0.5 else None)
    return weights


def _lengths(seed):
    rng = np.random.default_rng(seed)
    return [float(rng.uniform(0.02, 0.4)) if rng.random() < 0.5 else None for _ in range(STEPS)]


RECORDS = {
    "missing": lambda: Record(_some(1)),
    "multi-rate": lambda: Record(_rates()),
    "as late as the window": lambda: Record(*_delayed(HORIZON - 1)),
    "late in disorder": lambda: Record(*_disordered()),
    "own weights, missing": lambda: Record(_some(5), weights=_weights(6)),
    "uneven": lambda: Record(_all(), lengths=_lengths(7)),
    "all at once": lambda: Record(*_disordered(), lengths=_lengths(8), weights=_weights(9)),
}


@cache
def record(name):
    return RECORDS[name]()


@cache
def minima(name):
    return [record(name).minimum(now) for now in range(STEPS)]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", RECORDS)
def test_unknown_terms_are_left_out(name, backend):
    one = record(name)
    # ecos gives up before 1e-9.
    reach = 1e-4 if backend == "ecos" else 1e-7
    estimates = one.estimates(backend=backend, max_qps=None, solver_tolerance=1e-9)
    for now, (estimate, expected) in enumerate(zip(estimates, minima(name), strict=True)):
        candidate, candidate_cost, minimum, trajectory = expected
        np.testing.assert_allclose(estimate.candidate, candidate, rtol=0, atol=1e-12)
        assert estimate.candidate_cost == pytest.approx(candidate_cost, rel=1e-10)
        assert estimate.cost == pytest.approx(minimum, rel=reach)
        np.testing.assert_allclose(estimate.trajectory, trajectory, rtol=0, atol=30 * reach**0.5)
        unknown = np.isnan(one.at(now))[-len(estimate.noises) :]
        np.testing.assert_array_equal(np.isnan(estimate.noises), unknown)
        if now not in one.late:
            assert (Status.MISSING in estimate.status) == (not one.known[now].all())


@pytest.mark.parametrize("name", ["missing", "multi-rate", "own weights, missing"])
def test_a_block_of_the_weight_would_be_another_estimate(name):
    """So the records tell the inverse of a covariance's block from a block of the weight."""
    far = 0
    for now, (_, _, minimum, trajectory) in enumerate(minima(name)):
        _, _, other, elsewhere = record(name).minimum(now, _block_of)
        far += abs(other - minimum) > 0.05 * minimum and np.abs(elsewhere - trajectory).max() > 0.01
    assert far > STEPS // 2


class Linear:
    """A linear system with three outputs at three rates: one dense linear problem a window."""

    A = np.array([[1.0, 0.1, 0.0], [-0.1, 0.9, 0.2], [0.05, 0.0, 0.95]])
    C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.5], [0.3, 0.0, 1.0]])
    GAIN = 0.15 * np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.7]])
    Q, START, HORIZON = np.diag([50.0, 200.0, 100.0]), np.array([0.5, 0.0, -0.5]), 6

    def __init__(self):
        rng = np.random.default_rng(11)
        self.Y = np.full((24, 3), NAN)
        x = np.array([1.0, 0.2, 0.0])
        for t in range(len(self.Y)):
            noise = np.linalg.cholesky(COVARIANCE) @ rng.standard_normal(3)
            there = t % np.array([1, 3, 4]) == 0
            self.Y[t, there] = (self.C @ x + noise)[there]
            x = self.A @ x + 0.1 * rng.standard_normal(3)
        self.minima = [self.minimum(t) for t in range(len(self.Y))]

    def minimum(self, now):
        path = [self.START]
        for y in self.Y[: now + 1]:
            v = np.where(np.isfinite(y), y - self.C @ path[-1], 0.0)
            path.append(self.A @ path[-1] + self.GAIN @ v)
        first = max(0, now + 1 - self.HORIZON)
        count = now + 1 - first
        rows, sides = [np.eye(3, 3 * (count + 1))], [path[first]]
        for k in range(count):
            row = np.zeros((3, 3 * (count + 1)))
            row[:, 3 * k : 3 * k + 6] = np.hstack((-self.A, np.eye(3)))
            rows.append(_root(self.Q) @ row)
            sides.append(np.zeros(3))
            there = np.isfinite(self.Y[first + k])
            row = np.zeros((there.sum(), 3 * (count + 1)))
            row[:, 3 * k : 3 * k + 3] = self.C[there]
            root = _root(_weight_of(None, there))
            rows.append(root @ row)
            sides.append(root @ self.Y[first + k, there])
        M, b = np.vstack(rows), np.concatenate(sides)
        x = np.linalg.solve(M.T @ M, M.T @ b)
        return np.sum((M @ x - b) ** 2), x.reshape(-1, 3)


@pytest.fixture(scope="module")
def linear():
    return Linear()


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_qp_solves_the_normal_equations_of_a_multi_rate_record(backend, linear):
    system = qpmhe.System(lambda x: x @ linear.A.T, lambda x: x @ linear.C.T, n=3, p=3)
    cost = qpmhe.QuadraticCost(
        prior=np.eye(3), disturbance=linear.Q, noise=np.linalg.inv(COVARIANCE)
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(linear.GAIN), cost, horizon=linear.HORIZON,
        initial_state=linear.START, backend=backend, max_qps=1, solver_tolerance=1e-9,
    )
    reach = 1e-4 if backend == "ecos" else 1e-7
    for y, (minimum, trajectory) in zip(linear.Y, linear.minima, strict=True):
        estimate = mhe.update(y)
        assert estimate.cost == pytest.approx(minimum, rel=reach)
        np.testing.assert_allclose(estimate.trajectory, trajectory, rtol=0, atol=reach)


def test_a_sample_with_a_weight_of_its_own_is_a_kalman_filters_with_that_covariance(linear):
    """The observer's covariance and the prior from it know that weight, too."""
    rng = np.random.default_rng(12)
    P, Q, z = np.eye(3), np.linalg.inv(linear.Q), linear.START
    system = qpmhe.System(lambda x: x @ linear.A.T, lambda x: x @ linear.C.T, n=3, p=3)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=COVARIANCE),
        qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), disturbance=Q, noise=COVARIANCE
        ),
        horizon=4, initial_state=z,
    )
    for y in linear.Y:
        factor = rng.standard_normal((3, 3))
        R = 0.05 * (factor @ factor.T + 0.2 * np.eye(3))
        there = np.isfinite(y)
        C = linear.C[there]
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R[there][:, there])
        filtered = z + K @ (y[there] - C @ z)
        P = P - K @ C @ P
        z, P = linear.A @ filtered, linear.A @ P @ linear.A.T + Q
        estimate = mhe.update(y, noise_weight=np.linalg.inv(R))
        np.testing.assert_allclose(estimate.filtered, filtered, rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.state, z, rtol=0, atol=1e-9)
        np.testing.assert_allclose(mhe.covariances()[-1], P, rtol=0, atol=1e-9)
