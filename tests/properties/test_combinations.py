"""Every combination of sets, inputs, data, cost and start keeps the promise at every step."""

import itertools

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

NAN = np.nan
N, P, STEPS, HORIZON = 3, 2, 8, 4
START = np.array([0.6, -0.2, 0.4])
GAIN = np.array([[0.08, 0.0], [0.06, 0.0], [0.0, 0.05]])
PRIOR, DISTURBANCE = np.diag([1.0, 2.0, 1.0]), np.diag([40.0, 60.0, 50.0])
NOISE = np.array([[20.0, 6.0], [6.0, 12.0]])
WEIGHTS = {"prior": PRIOR, "disturbance": DISTURBANCE, "noise": NOISE}


def f(x, u=None):
    one, two, three = x[..., 0], x[..., 1], x[..., 2]
    push = 0.0 if u is None else 0.2 * u[..., 0]
    return np.stack(
        [one + 0.2 * two, two - 0.2 * np.sin(one) * three + push, 0.98 * three], axis=-1
    )


def h(x, u=None):
    shift = 0.0 if u is None else u[..., 1]
    return np.stack([x[..., 0] + shift, x[..., 1] * x[..., 2] + x[..., 2]], axis=-1)


X_BOX = qpmhe.Box([-0.15, -0.7, 0.2], [0.65, 0.4, 0.6])
W_BOX = qpmhe.Box([-0.05] * 3, [0.03] * 3)
V_BOX = qpmhe.Box([-0.7, -0.25], [0.16, np.inf])
SETS = {
    "no sets": {},
    "X": {"states": X_BOX},
    "W": {"disturbances": W_BOX},
    "V": {"noises": V_BOX},
    "polytopes": {
        "states": X_BOX & qpmhe.Polytope([[1.0, 1.0, 1.0]], [0.9]),
        "disturbances": qpmhe.Polytope([[1, 1, 0], [-1, -1, 0], [1, -1, 0]], [0.04, 0.08, 0.03]),
        "noises": qpmhe.Polytope([[1.0, 0.1], [-1.0, 0.2], [0.0, -1.0]], [0.16, 0.8, 0.25]),
    },
    "noise-free": {
        "states": X_BOX, "disturbances": qpmhe.Box([-0.06, -0.05, 0.0], [0.03, 0.03, 0.0])
    },
}
COSTS = {
    "quadratic": lambda: qpmhe.QuadraticCost(**WEIGHTS),
    "huber": lambda: qpmhe.RobustCost(
        prior=PRIOR, disturbance=qpmhe.Huber(DISTURBANCE, 1.0), noise=qpmhe.Huber(NOISE)
    ),
    "norm": lambda: qpmhe.RobustCost(
        **{name: qpmhe.Power(weight, 1.0) for name, weight in WEIGHTS.items()}
    ),
    "discount": lambda: qpmhe.QuadraticCost(**WEIGHTS, discount=0.9),
}
# For each cost rho_p, rho_w and rho_v of the quadratic form q, and the discount.
LOSSES = {
    "quadratic": (lambda q: q, lambda q: q, lambda q: q, 1.0),
    "huber": (lambda q: q, lambda q: _huber(q, 1.0), lambda q: _huber(q, 1.345), 1.0),
    "norm": (np.sqrt, np.sqrt, np.sqrt, 1.0),
    "discount": (lambda q: q, lambda q: q, lambda q: q, 0.9),
}


def _huber(q, k):
    return q if q <= k * k else 2.0 * k * np.sqrt(q) - k * k


def plain_cost(name, trajectory, prior, Y, U):
    """J by a loop, of what is there of Y."""
    prior_loss, w_loss, v_loss, discount = LOSSES[name]
    offset, J = trajectory[0] - prior, 0.0
    for x, following, y, u in zip(trajectory[:-1], trajectory[1:], Y, U, strict=True):
        w, there = following - f(x, u), np.isfinite(y)
        J = discount * J + w_loss(w @ DISTURBANCE @ w)
        if there.any():
            v = (y - h(x, u))[there]
            weight = np.linalg.inv(np.linalg.inv(NOISE)[there][:, there])
            J += v_loss(v @ weight @ v)
    return J + discount ** len(Y) * prior_loss(offset @ PRIOR @ offset)


def missed(one, points):
    """The most by which points leave a set, where all that an inequality needs is known."""
    worst = 0.0
    for point in points:
        gaps = [*(one.lower - point), *(point - one.upper)]
        for row, low, high in zip(one.matrix, one.row_lower, one.row_upper, strict=True):
            value = np.dot(row[row != 0.0], point[row != 0.0])
            gaps += [low - value, value - high]
        worst = max(worst, np.nanmax([0.0, *gaps]))
    return worst


class Case:
    """A record, an estimator for it, and the order in which the data come."""

    def __init__(self, sets, inputs, data, cost):
        rng = np.random.default_rng(21)
        self.sets, self.cost_name = SETS[sets], cost
        self.U = rng.uniform(-0.5, 0.5, (STEPS, 2)) if inputs else [None] * STEPS
        self.Y, x = np.empty((STEPS, P)), START - np.array([0.15, 0.1, -0.05])
        for t, u in enumerate(self.U):
            self.Y[t] = h(x, u) + rng.uniform(-0.3, 0.3, P)
            x = f(x, u) + rng.uniform(-0.1, 0.1, N) * [1, 1, sets != "noise-free"]
        self.Y[5, 0] -= 0.3  # an outlier
        self.in_time = self.Y.copy()
        if data != "complete":
            self.in_time[[2, 4], [0, 1]] = NAN
            self.in_time[3] = NAN
        # What a sample lacks comes two samples later, if it does at all.
        self.late = 2 if data == "late" else STEPS
        self.gain = GAIN.copy()
        if sets == "noise-free":
            self.gain[2] = 0.0
        m = 2 if inputs else 0
        self.system = qpmhe.System(f, h, n=N, p=P, m=m, **self.sets)

    def known(self, now):
        known = self.in_time[: now + 1].copy()
        arrived = max(0, now + 1 - self.late)
        known[:arrived] = self.Y[:arrived]
        return known

    def estimator(self, **options):
        options = {"horizon": HORIZON, "initial_state": START, "max_qps": 2} | options
        return qpmhe.MovingHorizonEstimator(
            self.system, qpmhe.Luenberger(self.gain), COSTS[self.cost_name](), **options
        )

    def estimates(self, **options):
        """Every estimate, those after late measurements too."""
        mhe = self.estimator(**options)
        for t in range(STEPS):
            # What is late comes after the newest sample.
            before = self.known(t - 1) if t else np.empty((0, P))
            yield mhe.update(self.in_time[t], self.U[t]), np.vstack((before, self.in_time[t]))
            sample = t - self.late
            if sample >= 0 and np.isnan(self.in_time[sample]).any():
                yield mhe.amend(sample, self.Y[sample]), self.known(t)

    def check(self, estimate, known):
        """Hold one estimate to the promise."""
        length = len(estimate.noises)
        Y, U = known[-length:], self.U[len(known) - length : len(known)]
        assert np.isfinite(estimate.trajectory).all()
        assert np.isfinite(estimate.cost)
        assert estimate.cost <= estimate.candidate_cost
        prior = estimate.candidate[0]
        for J, trajectory in (
            (estimate.cost, estimate.trajectory), (estimate.candidate_cost, estimate.candidate)
        ):
            assert plain_cost(self.cost_name, trajectory, prior, Y, U) == pytest.approx(
                J, rel=1e-9, abs=1e-12
            )
        improved = Status.IMPROVED in estimate.status
        assert improved == (estimate.cost < estimate.candidate_cost)
        assert improved != (Status.CANDIDATE in estimate.status)
        # Noises and disturbances are those of the trajectory, NaN where y is missing.
        x = estimate.trajectory
        predicted = [f(state, u) for state, u in zip(x[:-1], U, strict=True)]
        np.testing.assert_allclose(estimate.disturbances, x[1:] - predicted, rtol=0, atol=1e-12)
        fitted = [h(state, u) for state, u in zip(x[:-1], U, strict=True)]
        np.testing.assert_allclose(estimate.noises, Y - fitted, rtol=0, atol=1e-12)
        outside = self.outside(estimate.candidate, Y, U)
        if Status.PROJECTED not in estimate.status:
            assert estimate.dropped == outside
        assert bool(estimate.dropped) == (Status.SETS_DROPPED in estimate.status)
        assert set(self.outside(x, Y, U)) <= set(estimate.dropped)

    def outside(self, trajectory, Y, U):
        """Names of the sets that a trajectory is outside of."""
        pairs = list(zip(trajectory[:-1], U, strict=True))
        points = {
            "states": trajectory,
            "disturbances": trajectory[1:] - [f(x, u) for x, u in pairs],
            "noises": Y - [h(x, u) for x, u in pairs],
        }
        return tuple(
            name for name in points
            if name in self.sets and missed(self.sets[name], points[name]) > 1e-8
        )


DATA, STARTS = ("complete", "missing", "late"), ("candidate", "best")
COMBINATIONS = list(itertools.product(SETS, (False, True), DATA, COSTS, STARTS))


@pytest.mark.parametrize(("sets", "inputs", "data", "cost", "start"), COMBINATIONS)
def test_every_combination_keeps_the_promise(sets, inputs, data, cost, start):
    case = Case(sets, inputs, data, cost)
    kept = []
    for estimate, known in case.estimates(start=start):
        case.check(estimate, known)
        kept.append(not estimate.dropped)
        assert estimate.improved
    assert len(kept) == STEPS + (3 if data == "late" else 0)
    assert sum(kept) >= 3


@pytest.mark.parametrize("sets", list(SETS)[1:])
def test_the_sets_bind(sets):
    """Otherwise the combinations above would show little."""
    case = Case(sets, True, "complete", "quadratic")
    free = Case("no sets", True, "complete", "quadratic")
    crossed = set()
    for (bound, _), (unbound, Y) in zip(case.estimates(), free.estimates(), strict=True):
        if not bound.dropped:
            length = len(unbound.noises)
            U = case.U[len(Y) - length : len(Y)]
            crossed |= set(case.outside(unbound.trajectory, Y[-length:], U))
    assert crossed == set(case.sets)
