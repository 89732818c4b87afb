"""Run to convergence, the estimator finds what dense least squares finds on each window.

Measurements are missing, late, at several rates or unevenly sampled; the references are plain
loops over one sample after another, which leave out a term that is not known.
"""

from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares

import qpmhe
from qpmhe import Status

BACKENDS = qpmhe.solvers.available()
INEQUALITY_BACKENDS = [b for b in BACKENDS if qpmhe.solvers.backend(b).inequalities]
TIGHT = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
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
    lengths, weights : int, optional
        Seeds by which about half of the samples get a step length or noise weight of their own.
    """

    def __init__(self, known, late=None, lengths=None, weights=None):
        rng = np.random.default_rng(3)
        self.known, self.late = known, late or {}
        self.lengths = self._some(lengths, lambda draw: float(draw.uniform(0.02, 0.4)))
        self.weights = self._some(weights, _weight)
        self.U = 0.5 * rng.standard_normal((STEPS, 1))
        self.Y, x = np.empty((STEPS, 3)), START + 0.35
        for t, u in enumerate(self.U):
            self.Y[t] = h(x, u) + np.linalg.cholesky(COVARIANCE) @ rng.standard_normal(3)
            x = f(x, u, self.lengths[t] or DT) + 0.05 * rng.standard_normal(2)

    @staticmethod
    def _some(seed, drawn):
        draw = np.random.default_rng(seed)
        if seed is None:
            return [None] * STEPS
        return [drawn(draw) if draw.random() < 0.5 else None for _ in range(STEPS)]

    def at(self, now):
        """The measurements up to a time, NaN where they have not come by then."""
        known = self.known[: now + 1].copy()
        for arrival, items in self.late.items():
            for time, mask in items:
                if arrival <= now:
                    known[time] |= mask
        return np.where(known, self.Y[: now + 1], NAN)

    def estimates(self, **options):
        mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System.from_ode(rate, h, dt=DT, n=2, p=3, m=1, method="rk4"),
            qpmhe.Luenberger(GAIN), qpmhe.QuadraticCost(
                prior=PRIOR, disturbance=DISTURBANCE, noise=np.linalg.inv(COVARIANCE)
            ), horizon=HORIZON, initial_state=START, max_qps=None, solver_tolerance=1e-9, **options,
        )
        for t in range(STEPS):
            estimate = mhe.update(
                np.where(self.known[t], self.Y[t], NAN), self.U[t],
                dt=self.lengths[t], noise_weight=self.weights[t],
            )
            for time, mask in self.late.get(t, ()):
                estimate = mhe.amend(time, np.where(mask, self.Y[time], NAN))
            yield estimate

    def terms(self, flat, prior, first, Y):
        """All terms of J as one vector whose square is J."""
        trajectory = flat.reshape(-1, 2)
        parts = [_root(PRIOR) @ (trajectory[0] - prior)]
        for k, y in enumerate(Y):
            t, x = first + k, trajectory[k]
            w = trajectory[k + 1] - f(x, self.U[t], self.lengths[t] or DT)
            parts.append(_root(DISTURBANCE) @ w)
            there = np.isfinite(y)
            if there.any():
                own = self.weights[t]
                covariance = COVARIANCE if own is None else np.linalg.inv(own)
                weight = np.linalg.inv(covariance[there][:, there])
                parts.append(_root(weight) @ (y - h(x, self.U[t]))[there])
        return np.concatenate(parts)

    def minimum(self, now):
        """Candidate, its cost, and the minimum of the window that ends with a sample."""
        Y, path = self.at(now), [START]
        for t, y in enumerate(Y):
            v = np.where(np.isfinite(y), y - h(path[-1], self.U[t]), 0.0)
            path.append(f(path[-1], self.U[t], self.lengths[t] or DT) + GAIN @ v)
        first = max(0, now + 1 - HORIZON)
        candidate = np.array(path[first:])
        known = candidate[0], first, Y[first:]
        found = least_squares(self.terms, candidate.ravel(), args=known, method="lm", **TIGHT)
        cost = np.sum(self.terms(candidate, *known) ** 2)
        return candidate, cost, 2.0 * found.cost, found.x.reshape(-1, 2)


def _root(weight):
    return np.linalg.cholesky(weight).T


def _weight(rng):
    factor = rng.standard_normal((3, 3))
    return 5.0 * (factor @ factor.T + 0.3 * np.eye(3))


def _all():
    return np.ones((STEPS, 3), dtype=bool)


def _some(seed):
    known = np.random.default_rng(seed).random((STEPS, 3)) < 0.6
    known[[4, 5]] = False
    return known


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


RECORDS = {
    "complete": lambda: Record(_all()),
    "multi-rate": lambda: Record(np.arange(STEPS)[:, None] % np.array([1, 2, 3]) == 0),
    "as late as the window": lambda: Record(*_delayed(HORIZON - 1)),
    "late in disorder": lambda: Record(*_disordered()),
    "own weights, missing": lambda: Record(_some(5), weights=6),
    "uneven": lambda: Record(_all(), lengths=7),
    "all at once": lambda: Record(*_disordered(), lengths=8, weights=9),
}


@cache
def minima(name):
    record = RECORDS[name]()
    return record, [record.minimum(now) for now in range(STEPS)]


@pytest.mark.parametrize(
    ("name", "backend"),
    [*((name, "auto") for name in RECORDS), *(("all at once", one) for one in BACKENDS)],
)
def test_unknown_terms_are_left_out(name, backend):
    record, expected = minima(name)
    # ecos gives up before 1e-9.
    reach = 1e-4 if backend == "ecos" else 1e-7
    for now, estimate in enumerate(record.estimates(backend=backend)):
        candidate, candidate_cost, minimum, trajectory = expected[now]
        np.testing.assert_allclose(estimate.candidate, candidate, rtol=0, atol=1e-12)
        assert estimate.candidate_cost == pytest.approx(candidate_cost, rel=1e-10)
        assert estimate.cost == pytest.approx(minimum, rel=reach)
        np.testing.assert_allclose(estimate.trajectory, trajectory, rtol=0, atol=30 * reach**0.5)
        unknown = np.isnan(record.at(now))[-len(estimate.noises) :]
        np.testing.assert_array_equal(np.isnan(estimate.noises), unknown)
        if now not in record.late:
            assert (Status.MISSING in estimate.status) == (not record.known[now].all())


def reactor(**options):
    """The paper's reactor, with 1, 0.1 and 0.2 as standard deviations, and a record."""
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    if "states" in options:
        system = qpmhe.System(euler, lambda x: x[..., :1] + x[..., 1:], n=2, p=1,
                              states=options.pop("states"))
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=6, initial_state=[3.0, 0.6], **options
    ), scenario.simulate(1, 22).measurements


def euler(x):
    reaction = 0.16 * x[..., 0] ** 2 - 0.64 * x[..., 1]
    return x + 0.1 * np.stack([-2.0 * reaction, reaction], axis=-1)


def residuals(flat, prior, Y):
    x = flat.reshape(-1, 2)
    w, v = x[1:] - euler(x[:-1]), Y[:, 0] - x[:-1].sum(axis=1)
    return np.concatenate([x[0] - prior, w.ravel() / 0.1, v / 0.2])


@cache
def bounded_minima():
    """The reactor in a state box that binds, and the minimum of each of its windows."""
    lower, upper = np.array([0.0, 0.4]), np.array([3.6, 4.0])
    observer, Y = reactor(max_qps=0)
    minima, binding = [], 0
    for t, y in enumerate(Y):
        candidate = observer.update(y).candidate
        bounds = (np.tile(lower, len(candidate)), np.tile(upper, len(candidate)))
        found = least_squares(
            residuals, candidate.ravel(), args=(candidate[0], Y[max(0, t - 5) : t + 1]),
            bounds=bounds, **TIGHT,
        )
        minima.append(2.0 * found.cost)
        binding += found.active_mask.any()
    assert binding > 10
    return qpmhe.Box(lower, upper), minima


@pytest.mark.parametrize(("backend", "tolerance", "reach"), [
    *((name, 1e-9, 1e-6) for name in INEQUALITY_BACKENDS),
    *((name, 1e-5, 1e-2) for name in INEQUALITY_BACKENDS if ":" not in name),
])
def test_convergence_in_a_state_box_is_the_dense_minimum(backend, tolerance, reach):
    """And no state is beyond: iterates that miss the box are clipped into it, then judged."""
    box, minima = bounded_minima()
    mhe, Y = reactor(states=box, backend=backend, max_qps=None, solver_tolerance=tolerance)
    on_bound = 0
    for y, minimum in zip(Y, minima, strict=True):
        estimate = mhe.update(y)
        x = estimate.trajectory
        assert ((x >= box.lower) & (x <= box.upper)).all()
        on_bound += bool(np.isclose(x, box.lower, atol=1e-4).any()
                         or np.isclose(x, box.upper, atol=1e-4).any())
        assert Status.OBSERVER_PROJECTED not in estimate.status
        assert estimate.cost == pytest.approx(minimum, rel=reach)
    assert on_bound >= 8
