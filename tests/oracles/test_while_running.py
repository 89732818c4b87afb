"""Weights, bounds, parameters and sensors that change from sample to sample, against Ipopt."""

from functools import cache

import numpy as np
import pytest

import qpmhe

ca = pytest.importorskip("casadi")

HORIZON, STEPS = 5, 14
START = np.array([0.9, -0.2])
GAIN = np.array([[0.3, 0.05], [0.05, 0.3]])
P, Q, R = np.diag([4.0, 2.0]), np.array([[60.0, 10.0], [10.0, 40.0]]), np.diag([25.0, 16.0])
WIDE = {name: qpmhe.Box([-9.0, -9.0], [9.0, 9.0]) for name in ("states", "disturbances", "noises")}


def step(x, u, sin):
    """A pendulum with a push u[0], and damping u[1] and stiffness u[2] as parameters."""
    return [x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - u[1] * x[1] - u[2] * sin(x[0]))]


def f(x, u):
    parts = [x[..., 0], x[..., 1]], [u[..., 0], u[..., 1], u[..., 2]]
    return np.stack(step(*parts, np.sin), axis=-1)


def h(x, u):
    return np.stack([x[..., 0] + 0.1 * x[..., 1] ** 2, x[..., 1] * u[..., 2]], axis=-1)


def weight(rng, size, scale):
    factor = rng.standard_normal((size, size))
    return scale * (factor @ factor.T + 0.3 * np.eye(size))


class Record:
    """A simulated record, and what each sample is taken with, all sets around the truth."""

    def __init__(self, kind, seed):
        rng = np.random.default_rng(seed)
        x, self.samples = START + rng.normal(0.0, 0.3, 2), []
        changing = set(kind.split("+"))
        for _ in range(STEPS):
            own, parameters = {}, np.array([0.3, 2.0])
            if "weights" in changing and rng.random() < 0.7:
                own["noise_weight"] = weight(rng, 2, 20.0)
            if "weights" in changing and rng.random() < 0.7:
                own["disturbance_weight"] = weight(rng, 2, 50.0)
            if "parameters" in changing and rng.random() < 0.7:
                own["parameters"] = parameters = parameters * rng.uniform(0.5, 2.0, 2)
            u = np.append(rng.normal(0.0, 1.0, 1), parameters)
            w, v = rng.uniform(-0.1, 0.1, 2), rng.uniform(-0.2, 0.2, 2)
            following = f(x, u) + w
            if "bounds" in changing and rng.random() < 0.8:
                own["bounds"] = {
                    "states": _around(np.array([x, following]), rng.uniform(0.02, 0.3, 2)),
                    "disturbances": _around(w[None], rng.uniform(0.02, 0.2, 2)),
                    "noises": _around(v[None], rng.uniform(0.02, 0.3, 2)),
                }
            y, there = h(x, u) + v, np.ones(2, np.bool_)
            if "sensors" in changing and rng.random() < 0.6:
                there[rng.integers(2)] = False
                own["sensors"] = np.flatnonzero(there)
            self.samples.append((y[there], u, there, own))
            x = following

    def feed(self, mhe):
        for y, u, _, own in self.samples:
            yield mhe.update(y, u[:1], **own)

    def minimum(self, estimate):
        """Ipopt's J and trajectory of the window of an estimate, started at the candidate."""
        first, opti = estimate.time + 1 - len(estimate.disturbances), ca.Opti()
        X = opti.variable(2, len(estimate.trajectory))
        offset = X[:, 0] - estimate.candidate[0]
        J = ca.bilin(P, offset, offset)
        for k in range(X.shape[1] - 1):
            y, u, there, own = self.samples[first + k]
            bounds, x = WIDE | own.get("bounds", {}), X[:, k]
            w = X[:, k + 1] - ca.vertcat(*step([x[0], x[1]], u, ca.sin))
            v = (y if there.all() else np.where(there, y.sum(), 0.0)) - ca.vertcat(
                x[0] + 0.1 * x[1] ** 2, x[1] * u[2]
            )
            index = np.flatnonzero(there).tolist()
            covariance = np.linalg.inv(own.get("noise_weight", R))[np.ix_(index, index)]
            J += ca.bilin(own.get("disturbance_weight", Q), w, w)
            J += ca.bilin(np.linalg.inv(covariance), v[index], v[index])
            points = [("states", x, [0, 1]), ("disturbances", w, [0, 1]), ("noises", v, index)]
            if k == X.shape[1] - 2:
                points.append(("states", X[:, k + 1], [0, 1]))
            for name, point, rows in points:
                box = bounds[name]
                opti.subject_to(opti.bounded(box.lower[rows], point[rows], box.upper[rows]))
        opti.minimize(J)
        opti.set_initial(X, estimate.candidate.T)
        quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
        opti.solver("ipopt", quiet | {"ipopt.tol": 1e-11, "ipopt.bound_relax_factor": 0.0})
        solution = opti.solve()
        return float(solution.value(J)), solution.value(X).T


def _around(points, half):
    return qpmhe.Box(points.min(axis=0) - half, points.max(axis=0) + half)


KINDS = [
    "weights", "parameters", "sensors", "bounds", "weights+parameters+sensors",
    "weights+parameters+sensors+bounds",
]


@cache
def record(kind, seed):
    return Record(kind, seed)


def estimator(kind, symbolic=False, **options):
    sets = WIDE if "bounds" in kind else {}
    if symbolic:
        system = qpmhe.from_casadi(
            lambda x, u: ca.vertcat(*step([x[0], x[1]], [u[0], u[1], u[2]], ca.sin)),
            lambda x, u: ca.vertcat(x[0] + 0.1 * x[1] ** 2, x[1] * u[2]), n=2, m=3, **sets,
        )
    else:
        system = qpmhe.System(f, h, n=2, p=2, m=3, **sets)
    cost = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost,
        **{
            "horizon": HORIZON, "initial_state": START, "parameters": [0.3, 2.0], "max_qps": None,
            "solver_tolerance": 1e-10, "tolerance": 1e-11,
        } | options,
    )


@pytest.mark.parametrize("symbolic", [False, True], ids=["numpy", "casadi"])
@pytest.mark.parametrize("kind", KINDS)
def test_convergence_is_ipopts_minimum_with_the_same_data(kind, symbolic):
    compared = 0
    for seed in range(3):
        one = record(kind, seed)
        for t, estimate in enumerate(one.feed(estimator(kind, symbolic))):
            if t % 3 != 1 and t < STEPS - 1:
                continue
            if not estimate.improved:  # there may be no way below an infeasible candidate's cost
                continue
            assert estimate.dropped == ()
            J, trajectory = one.minimum(estimate)
            assert estimate.cost == pytest.approx(J, rel=1e-6)
            np.testing.assert_allclose(estimate.trajectory, trajectory, rtol=0, atol=2e-4)
            compared += 1
    assert compared >= (8 if "bounds" in kind else 15)


def test_the_observer_is_in_the_set_of_each_sample():
    """Also where that came only with the next sample, and after a late measurement."""
    moved = 0
    for seed in range(6):
        one = record("bounds", seed)
        mhe = estimator("bounds", max_qps=0)
        boxes = []
        for t, estimate in enumerate(one.feed(mhe)):
            boxes.append((WIDE | one.samples[t][3].get("bounds", {}))["states"])
            if t in (5, 9):
                estimate = mhe.amend(t - 2, one.samples[t - 2][0] + 0.1)
            first = t + 1 - len(estimate.disturbances)
            for x, box in zip(estimate.candidate, [*boxes[first:], boxes[-1]], strict=True):
                assert box.violation(x) == 0.0
                moved += np.any((x == box.lower) | (x == box.upper))
    assert moved > 50


class Drifting:
    """A linear system whose covariances drift, and its Kalman filter."""

    def __init__(self, seed, missing, directions):
        rng = np.random.default_rng(seed)
        self.A, self.C = rng.standard_normal((3, 3)) / 2.0, rng.standard_normal((2, 3))
        self.P = weight(rng, 3, 1.0)
        self.G = rng.standard_normal((3, directions)) if directions < 3 else np.eye(3)
        self.Q = [weight(rng, directions, 0.2) for _ in range(50)]
        self.R = [weight(rng, 2, 0.3) for _ in range(50)]
        self.Y = rng.standard_normal((50, 2))
        self.Y[rng.random((50, 2)) < missing] = np.nan

    def filter(self):
        z, P, A = np.zeros(3), self.P, self.A
        for y, Q, R in zip(self.Y, self.Q, self.R, strict=True):
            there = np.isfinite(y)
            C = self.C[there]
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R[there][:, there])
            filtered, P = z + K @ (y[there] - C @ z), P - K @ C @ P
            z, P = A @ filtered, A @ P @ A.T + self.G @ Q @ self.G.T
            yield filtered, z, P


@pytest.mark.parametrize("candidate", ["observer", "reinitialized"])
@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("observer", ["ExtendedKalman", "UnscentedKalman"])
@pytest.mark.parametrize("directions", [3, 2, 1])
def test_drifting_covariances_give_the_kalman_filter(directions, observer, missing, candidate):
    one = Drifting(4, missing, directions)
    A, C, usual = one.A, one.C, {"disturbance": 0.1 * np.eye(directions), "noise": np.eye(2)}
    given = {} if directions == 3 else {"disturbance_matrix": one.G}
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=3, p=2, **given),
        getattr(qpmhe, observer)(prior=one.P, **usual),
        qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **usual),
        horizon=4, initial_state=np.zeros(3), candidate=candidate,
    )
    for y, Q, R, (filtered, z, P) in zip(one.Y, one.Q, one.R, one.filter(), strict=True):
        estimate = mhe.update(
            y, noise_weight=np.linalg.inv(R), disturbance_weight=np.linalg.inv(Q)
        )
        np.testing.assert_allclose(estimate.filtered, filtered, rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.state, z, rtol=0, atol=1e-9)
        np.testing.assert_allclose(mhe.covariances()[-1], P, rtol=0, atol=1e-9)
