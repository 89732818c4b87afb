"""On linear-Gaussian systems the estimator with a Kalman-type prior is the Kalman filter."""

import numpy as np
import pytest

import qpmhe

STEPS = 80  # beyond the length at which the window of the shorter horizons is moved back


class Plant:
    """A random observable linear system with dense covariances, an input and a record."""

    def __init__(self, seed, n, p, radius, m=0, missing=False, steps=STEPS):
        rng = np.random.default_rng(seed)
        a = rng.standard_normal((n, n))
        self.A = a * (radius / np.abs(np.linalg.eigvals(a)).max())
        self.B, self.C = rng.standard_normal((n, m)), rng.standard_normal((p, n))
        self.D = rng.standard_normal((p, m))
        self.P, self.Q, self.R = (_covariance(rng, k) for k in (n, n, p))
        self.z0 = rng.standard_normal(n)
        self.U = rng.standard_normal((steps, m))
        self.Y = np.empty((steps, p))
        x = self.z0 + np.linalg.cholesky(self.P) @ rng.standard_normal(n)
        for t, u in enumerate(self.U):
            self.Y[t] = self.C @ x + self.D @ u + _draw(rng, self.R)
            x = self.A @ x + self.B @ u + _draw(rng, self.Q)
        if missing:
            self.Y[rng.random(self.Y.shape) < 0.3] = np.nan
            self.Y[[0, 7, 8]] = np.nan

    def estimator(self, horizon, **options):
        A, B, C, D = self.A, self.B, self.C, self.D
        n, p, m = A.shape[0], C.shape[0], B.shape[1]
        if m:
            system = qpmhe.System(
                lambda x, u: x @ A.T + u @ B.T, lambda x, u: x @ C.T + u @ D.T, n=n, p=p, m=m
            )
        else:
            system = qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=n, p=p)
        observer = qpmhe.ExtendedKalman(prior=self.P, disturbance=self.Q, noise=self.R)
        cost = qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), disturbance=self.Q, noise=self.R
        )
        return qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=horizon, initial_state=self.z0, **options
        )

    def inputs(self):
        return self.U if self.U.shape[1] else None


def _covariance(rng, size):
    factor = rng.standard_normal((size, size))
    return factor @ factor.T + 0.3 * np.eye(size)


def _draw(rng, covariance):
    return np.linalg.cholesky(covariance) @ rng.standard_normal(covariance.shape[0])


def kalman(plant):
    """Predicted (T + 1) and filtered (T) means and covariances, and the normalised innovations."""
    x, P = plant.z0, plant.P
    predicted, filtered, squares = [(x, P)], [], []
    for y, u in zip(plant.Y, plant.U, strict=True):
        seen = np.isfinite(y)
        C, R = plant.C[seen], plant.R[np.ix_(seen, seen)]
        innovation = y[seen] - C @ x - plant.D[seen] @ u
        S = C @ P @ C.T + R
        K = P @ C.T @ np.linalg.inv(S)
        squares.append(innovation @ np.linalg.inv(S) @ innovation)
        x = x + K @ innovation
        joseph = np.eye(x.size) - K @ C
        P = joseph @ P @ joseph.T + K @ R @ K.T
        filtered.append((x, P))
        x, P = plant.A @ x + plant.B @ u, plant.A @ P @ plant.A.T + plant.Q
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


@pytest.mark.parametrize("horizon", [1, 2, 5, 10, 50])
@pytest.mark.parametrize("missing", [False, True], ids=["complete", "missing"])
@pytest.mark.parametrize("radius", [0.8, 1.15], ids=["stable", "unstable"])
def test_every_horizon_gives_the_kalman_predictor_and_filter(radius, missing, horizon):
    for n, p in ((1, 1), (1, 2), (2, 2), (3, 1), (4, 1), (4, 2)):
        plant = Plant(100 * n + p, n, p, radius, m=n % 3, missing=missing)
        predicted, filtered, _ = kalman(plant)
        run = plant.estimator(horizon).run(plant.Y, plant.inputs())
        assert distance(run.states, np.array([x for x, _ in predicted])) < 1e-8
        assert distance(run.filtered, np.array([x for x, _ in filtered])) < 1e-8


@pytest.mark.parametrize("missing", [False, True], ids=["complete", "missing"])
@pytest.mark.parametrize("radius", [0.8, 1.15], ids=["stable", "unstable"])
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_a_growing_window_is_the_rts_smoother(n, radius, missing):
    plant = Plant(n, n, 1 + n % 2, radius, m=(n + 1) % 3, missing=missing, steps=30)
    predicted, filtered, squares = kalman(plant)
    mhe = plant.estimator(30)
    for t, (y, u) in enumerate(zip(plant.Y, plant.U, strict=True)):
        estimate = mhe.update(y, u if u.size else None)
        assert distance(estimate.trajectory, rts(plant, predicted, filtered, t + 1)) < 1e-8
        # The minimum of J is the sum of the normalised squared innovations.
        assert estimate.cost == pytest.approx(squares[: t + 1].sum(), rel=1e-9)
        # What the trajectory says about w and v, plainly.
        x = estimate.trajectory
        w = x[1:] - x[:-1] @ plant.A.T - plant.U[: t + 1] @ plant.B.T
        v = plant.Y[: t + 1] - x[:-1] @ plant.C.T - plant.U[: t + 1] @ plant.D.T
        np.testing.assert_allclose(estimate.disturbances, w, atol=1e-9)
        np.testing.assert_allclose(estimate.noises, v, atol=1e-9)  # NaN where y is missing


@pytest.mark.parametrize("horizon", [1, 5])
def test_a_smoother_on_the_full_window_has_the_kalman_prior(horizon):
    # A window that starts at s is the RTS smoother of a filter that starts there, from the
    # predicted mean and covariance at s.
    plant = Plant(3, 3, 2, 0.9, m=1, missing=True, steps=25)
    predicted, _, _ = kalman(plant)
    mhe = plant.estimator(horizon)
    for t in range(25):
        trajectory = mhe.update(plant.Y[t], plant.U[t]).trajectory
        start = max(0, t + 1 - horizon)
        tail = Plant(3, 3, 2, 0.9, m=1, missing=True, steps=25)
        tail.z0, tail.P = predicted[start]
        tail.Y, tail.U = plant.Y[start : t + 1], plant.U[start : t + 1]
        expected = rts(tail, *kalman(tail)[:2], t + 1 - start)
        assert distance(trajectory, expected) < 1e-8


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_every_backend_gives_the_kalman_predictor(backend):
    plant = Plant(7, 2, 1, 1.05, m=1, missing=True, steps=14)
    predicted, _, _ = kalman(plant)
    run = plant.estimator(4, backend=backend, solver_tolerance=1e-9).run(plant.Y, plant.U)
    assert distance(run.states, np.array([x for x, _ in predicted])) < 1e-6
