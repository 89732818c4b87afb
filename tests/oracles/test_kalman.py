"""On linear-Gaussian systems the estimator with a Kalman-type prior is the Kalman filter."""

import copy

import numpy as np
import pytest

import qpmhe

STEPS = 80  # beyond the length at which the window of the shorter horizons is moved back


class Plant:
    """A random observable linear system x+ = A x + B u + G w, y = C x + D u + v, and a record.

    With ``drifting`` covariances each sample has its own; with fewer ``directions`` than states
    the disturbance has so many components.
    """

    def __init__(
        self, seed, n, p, radius, m=0, missing=False, steps=STEPS, directions=None, drifting=False
    ):
        rng = np.random.default_rng(seed)
        a = rng.standard_normal((n, n))
        self.A = a * (radius / np.abs(np.linalg.eigvals(a)).max())
        self.B, self.C = rng.standard_normal((n, m)), rng.standard_normal((p, n))
        self.D = rng.standard_normal((p, m))
        self.G = np.eye(n) if directions is None else rng.standard_normal((n, directions))
        self.low = directions is not None
        self.P, self.Q, self.R = (spd(rng, k) for k in (n, self.G.shape[1], p))
        self.Qs, self.Rs = [self.Q] * steps, [self.R] * steps
        if drifting:
            self.Qs, self.Rs = (
                [spd(rng, len(one)) for _ in range(steps)] for one in (self.Q, self.R)
            )
        self.z0 = rng.standard_normal(n)
        self.U = rng.standard_normal((steps, m))
        self.Y = np.empty((steps, p))
        x = self.z0 + _draw(rng, self.P)
        for t, u in enumerate(self.U):
            self.Y[t] = self.C @ x + self.D @ u + _draw(rng, self.R)
            x = self.A @ x + self.B @ u + self.G @ _draw(rng, self.Q)
        if missing:
            self.Y[rng.random(self.Y.shape) < 0.3] = np.nan
            self.Y[[0, 7, 8]] = np.nan

    def system(self, how="matrix"):
        A, B, C, D = self.A, self.B, self.C, self.D
        given = {"disturbance_matrix": self.G} if self.low and how == "matrix" else {}
        sizes = {"n": len(A), "p": len(C), "m": B.shape[1]}
        if not sizes["m"]:
            return qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, **sizes, **given)
        return qpmhe.System(
            lambda x, u: x @ A.T + u @ B.T, lambda x, u: x @ C.T + u @ D.T, **sizes, **given
        )

    def estimator(self, horizon, how="matrix", observer=qpmhe.ExtendedKalman, **options):
        """With G itself or, for a ``how`` of "covariance", with the covariance G Q G'."""
        usual = {"disturbance": self.Q, "noise": self.R}
        if how == "covariance":
            usual["disturbance"] = self.G @ self.Q @ self.G.T
        return qpmhe.MovingHorizonEstimator(
            self.system(how), observer(prior=self.P, **usual),
            qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **usual),
            horizon=horizon, initial_state=self.z0, **options,
        )

    def inputs(self):
        return self.U if self.U.shape[1] else None


def spd(rng, size):
    factor = rng.standard_normal((size, size))
    return factor @ factor.T + 0.3 * np.eye(size)


def _draw(rng, covariance):
    return np.linalg.cholesky(covariance) @ rng.standard_normal(covariance.shape[0])


def kalman(plant):
    """Predicted (T + 1) and filtered (T) means and covariances, and the normalised innovations."""
    x, P = plant.z0, plant.P
    predicted, filtered, squares = [(x, P)], [], []
    for y, u, Q, R in zip(plant.Y, plant.U, plant.Qs, plant.Rs, strict=True):
        seen = np.isfinite(y)
        C, R = plant.C[seen], R[np.ix_(seen, seen)]
        innovation = y[seen] - C @ x - plant.D[seen] @ u
        S = C @ P @ C.T + R
        K = P @ C.T @ np.linalg.inv(S)
        squares.append(innovation @ np.linalg.inv(S) @ innovation)
        x = x + K @ innovation
        joseph = np.eye(x.size) - K @ C
        P = joseph @ P @ joseph.T + K @ R @ K.T
        filtered.append((x, P))
        x = plant.A @ x + plant.B @ u
        P = plant.A @ P @ plant.A.T + plant.G @ Q @ plant.G.T
        predicted.append((x, P))
    return predicted, filtered, np.array(squares)


def rts(plant, predicted, filtered, steps):
    """Smoothed x(0), ..., x(steps) given y(0), ..., y(steps - 1)."""
    smoothed = [predicted[steps][0]]
    for k in reversed(range(steps)):
        gain = filtered[k][1] @ plant.A.T @ np.linalg.inv(predicted[k + 1][1])
        smoothed.insert(0, filtered[k][0] + gain @ (smoothed[0] - predicted[k + 1][0]))
    return np.array(smoothed)


def distance(found, expected):
    """Largest row-wise distance, relative to the size of the row."""
    found, expected = np.atleast_2d(found), np.atleast_2d(expected)
    assert found.shape == expected.shape
    size = np.maximum(1.0, np.linalg.norm(expected, axis=1))
    return (np.linalg.norm(found - expected, axis=1) / size).max()


def off(run, plant):
    """How far the states of a run are from the filter's predictions."""
    return distance(run.states, np.array([x for x, _ in kalman(plant)[0]]))


@pytest.mark.parametrize("horizon", [1, 2, 10, 50])
@pytest.mark.parametrize("missing", [False, True], ids=["complete", "missing"])
@pytest.mark.parametrize("radius", [0.8, 1.15], ids=["stable", "unstable"])
def test_every_horizon_gives_the_kalman_predictor_and_filter(radius, missing, horizon):
    for n, p in ((1, 1), (1, 2), (2, 2), (3, 1), (4, 1), (4, 2)):
        plant = Plant(100 * n + p, n, p, radius, m=n % 3, missing=missing)
        run = plant.estimator(horizon).run(plant.Y, plant.inputs())
        assert off(run, plant) < 1e-8
        assert distance(run.filtered, np.array([x for x, _ in kalman(plant)[1]])) < 1e-8


@pytest.mark.parametrize("horizon", [1, 5, 30], ids=["one", "moving", "growing"])
@pytest.mark.parametrize("radius", [0.8, 1.15], ids=["stable", "unstable"])
@pytest.mark.parametrize("n", [1, 2, 4])
def test_a_window_is_the_rts_smoother_of_a_filter_that_starts_there(n, radius, horizon):
    plant = Plant(n, n, 1 + n % 2, radius, m=1 + n % 2, missing=True, steps=25)
    predicted, _, _ = kalman(plant)
    mhe = plant.estimator(horizon)
    for t in range(25):
        estimate = mhe.update(plant.Y[t], plant.U[t])
        start = max(0, t + 1 - horizon)
        tail = copy.copy(plant)
        tail.Qs, tail.Rs = plant.Qs[start : t + 1], plant.Rs[start : t + 1]
        tail.z0, tail.P = predicted[start]
        tail.Y, tail.U = plant.Y[start : t + 1], plant.U[start : t + 1]
        *filters, squares = kalman(tail)
        assert distance(estimate.trajectory, rts(tail, *filters, t + 1 - start)) < 1e-8
        # The minimum of J is the sum of the normalised squared innovations.
        assert estimate.cost == pytest.approx(squares.sum(), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_a_growing_window_is_a_full_one_of_its_length(backend):
    # Remark rem:emtpyN: until N samples are there, the horizon is t.
    plant = Plant(6, 3, 2, 0.9, m=1, missing=True, steps=9)
    growing = plant.estimator(9, backend=backend, max_qps=3).run(plant.Y, plant.U)
    for length in (1, 2, 5):
        run = plant.estimator(length, backend=backend, max_qps=3).run(
            plant.Y[:length], plant.U[:length]
        )
        assert run.candidate_costs[-1] == growing.candidate_costs[length - 1]
        assert run.statuses[-1] == growing.statuses[length - 1]
        # Not every solver gives the same bits twice: some depend on how memory is aligned.
        np.testing.assert_allclose(run.states[-1], growing.states[length], rtol=1e-9)
        assert run.costs[-1] == pytest.approx(growing.costs[length - 1], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_one_qp_of_every_backend_gives_the_kalman_predictor(backend):
    plant = Plant(7, 2, 1, 1.05, m=1, missing=True, steps=14)
    mhe = plant.estimator(4, backend=backend, max_qps=1, solver_tolerance=1e-9)
    assert off(mhe.run(plant.Y, plant.U), plant) < 1e-6


@pytest.mark.parametrize("how", ["matrix", "covariance"])
@pytest.mark.parametrize("observer", [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
@pytest.mark.parametrize("horizon", [1, 4, 50])
@pytest.mark.parametrize(
    ("n", "r", "p"), [(2, 1, 1), (3, 1, 2), (5, 3, 2), (4, 4, 1)]
)
def test_disturbances_of_lower_dimension(n, r, p, horizon, observer, how):
    plant = Plant(100 * n + 10 * r + p, n, p, 1.0, steps=40, directions=r)
    options = {"max_qps": None, "solver_tolerance": 1e-10}
    mhe = plant.estimator(horizon, how, observer, **options)
    means, covariances = (np.array(one) for one in zip(*kalman(plant)[0], strict=True))
    run = mhe.run(plant.Y, covariances=True)
    assert np.abs(run.states - means).max() <= 1e-9 * (1.0 + np.abs(means).max())
    assert np.abs(run.covariances - covariances[1:]).max() <= 1e-9 * np.abs(covariances).max()


@pytest.mark.parametrize("horizon", [1, 4])
@pytest.mark.parametrize("without_disturbance", [False, True])
def test_singular_covariances_of_the_state_cost_few_digits(without_disturbance, horizon):
    """Of a model that forgets all but one direction, or decays with no disturbance at all."""
    for seed in range(4):
        plant, rng = Plant(seed, 3, 2, 1.0, steps=40, directions=1), np.random.default_rng(seed + 5)
        if without_disturbance:  # small eigenvalues, but not rounding yet
            plant.A = 0.95 * plant.A
            plant.Q = np.zeros((1, 1))
            plant.Qs = [plant.Q] * 40
        else:
            plant.A = np.outer(rng.standard_normal(3), rng.standard_normal(3))
            plant.A /= np.abs(np.linalg.eigvals(plant.A)).max()
            assert np.linalg.cond(kalman(plant)[0][-1][1]) > 1e15
        run = plant.estimator(horizon, max_qps=None, solver_tolerance=1e-10).run(plant.Y)
        means = np.array([x for x, _ in kalman(plant)[0]])
        assert np.abs(run.states - means).max() <= 2e-7 * (1.0 + np.abs(means).max())


@pytest.mark.parametrize("candidate", ["observer", "reinitialized"])
@pytest.mark.parametrize("missing", [False, True], ids=["complete", "missing"])
@pytest.mark.parametrize("observer", [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
@pytest.mark.parametrize("directions", [None, 2, 1])
def test_covariances_of_their_own_for_each_sample(directions, observer, missing, candidate):
    plant = Plant(4, 3, 2, 0.9, missing=missing, steps=50, directions=directions, drifting=True)
    predicted, filtered, _ = kalman(plant)
    mhe = plant.estimator(4, observer=observer, candidate=candidate)
    for t, y in enumerate(plant.Y):
        estimate = mhe.update(
            y, noise_weight=np.linalg.inv(plant.Rs[t]),
            disturbance_weight=np.linalg.inv(plant.Qs[t]),
        )
        np.testing.assert_allclose(estimate.filtered, filtered[t][0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.state, predicted[t + 1][0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(mhe.covariances()[-1], predicted[t + 1][1], rtol=0, atol=1e-9)
