"""Inputs with white errors: the Kalman filter with B Qu B', and least squares beyond it."""

import pickle

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares

import qpmhe

from .plain import spd


class Plant:
    """A random linear system with inputs, some of them measured with noise, and a record."""

    def __init__(self, seed, n=3, p=2, m=2, noisy=(0, 1), steps=40):
        rng = np.random.default_rng(seed)
        a = rng.standard_normal((n, n))
        self.A = a * (0.95 / np.abs(np.linalg.eigvals(a)).max())
        self.B, self.C = rng.standard_normal((n, m)), rng.standard_normal((p, n))
        self.P, self.Q, self.R = spd(rng, n), 0.1 * spd(rng, n), spd(rng, p)
        self.noisy, self.Qu = list(noisy), spd(rng, len(noisy))
        self.start, self.U = rng.standard_normal(n), rng.standard_normal((steps, m))
        self.Y = 3.0 * rng.standard_normal((steps, p))

    def kalman(self):
        """Predicted and filtered states with the process noise Q + B Qu B'."""
        A, C, b = self.A, self.C, self.B[:, self.noisy]
        z, S, predicted, filtered = self.start, self.P, [], []
        for y, u in zip(self.Y, self.U, strict=True):
            gain = S @ C.T @ np.linalg.inv(C @ S @ C.T + self.R)
            z, S = z + gain @ (y - C @ z), S - gain @ C @ S
            filtered.append(z)
            z, S = A @ z + self.B @ u, A @ S @ A.T + self.Q + b @ self.Qu @ b.T
            predicted.append((z, S))
        return predicted, np.array(filtered)

    def estimator(self, horizon):
        A, B, C, k = self.A, self.B, self.C, len(self.noisy)
        plant = qpmhe.System(
            lambda x, u: x @ A.T + u @ B.T, lambda x: x @ C.T, n=len(A), p=len(C), m=B.shape[1]
        )
        covariances = {"disturbance": block_diag(self.Q, self.Qu), "noise": self.R}
        return qpmhe.MovingHorizonEstimator(
            qpmhe.noisy_inputs(plant, self.noisy),
            qpmhe.ExtendedKalman(prior=block_diag(self.P, self.Qu), **covariances),
            qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **covariances),
            horizon=horizon, initial_state=[*self.start, *np.zeros(k)],
        )


@pytest.mark.parametrize("horizon", [1, 5, 20])
@pytest.mark.parametrize("noisy", [(0, 1), (1,)])
def test_it_is_the_kalman_filter_with_the_inputs_covariance(noisy, horizon):
    plant = Plant(horizon, noisy=noisy)
    predicted, filtered = plant.kalman()
    mhe = plant.estimator(horizon)
    for t, (y, u) in enumerate(zip(plant.Y, plant.U, strict=True)):
        estimate = mhe.update(y, u)
        mean, covariance = predicted[t]
        np.testing.assert_allclose(estimate.state[:3], mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(estimate.filtered[:3], filtered[t], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            mhe.covariances()[-1], block_diag(covariance, plant.Qu), rtol=1e-8, atol=1e-9
        )
        # What the estimate calls e is what it needs besides w to explain the record.
        x, e = estimate.trajectory[:, :3], estimate.trajectory[:, 3:]
        inputs = plant.U[t + 1 - len(estimate.noises) : t + 1].copy()
        inputs[:, plant.noisy] += e[:-1]
        w = x[1:] - x[:-1] @ plant.A.T - inputs @ plant.B.T
        np.testing.assert_allclose(estimate.disturbances, np.hstack((w, e[1:])), atol=1e-11)
        assert np.abs(e[-1]).max() < 1e-9  # no measurement has seen it yet
    assert horizon == 1 or np.abs(e[:-1]).max() > 0.05


def tank(x, u):
    """A level with a pump and a valve, both nonlinear; y sees the valve, too."""
    return x + 0.1 * (np.tanh(u[..., :1]) - u[..., 1:] * np.sqrt(1.0 + x**2))


def gauge(x, u):
    return x + 0.2 * u[..., 1:] ** 2


def test_least_squares_finds_the_same_minimum_on_a_nonlinear_plant():
    """The oracle has the errors themselves as variables, not states: x, e and nothing else."""
    horizon, rng = 6, np.random.default_rng(4)
    P, Q, R, Qu = 0.5, 0.001, 0.002, np.array([[0.05, 0.01], [0.01, 0.04]])
    root = np.linalg.cholesky(Qu)
    system = qpmhe.noisy_inputs(qpmhe.System(tank, gauge, n=1, p=1, m=2))
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=block_diag(P, Qu), disturbance=block_diag(Q, Qu), noise=R
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.2, 0.0, 0.0]), cost, horizon=horizon,
        initial_state=[1.0, 0.0, 0.0], max_qps=None, tolerance=1e-14,
    )
    x, ys, us = np.array([1.5]), [], []
    for t in range(20):
        us.append([np.sin(0.3 * t), 0.5])
        acting = us[-1] + root @ rng.standard_normal(2)
        ys.append(gauge(x, acting) + np.sqrt(R) * rng.standard_normal(1))
        x = tank(x, acting) + np.sqrt(Q) * rng.standard_normal(1)
        estimate = mhe.update(ys[-1], us[-1])
        prior, y, u = estimate.candidate[0], np.array(ys[-horizon:]), np.array(us[-horizon:])

        def residuals(unknown, prior=prior, y=y, u=u):
            x, e = unknown[: len(y) + 1, None], unknown[len(y) + 1 :].reshape(-1, 2)
            off = e - np.vstack((prior[1:], np.zeros((len(y) - 1, 2))))
            return np.concatenate((
                (x[0] - prior[0]) / np.sqrt(P), np.linalg.solve(root, off.T).ravel(),
                (x[1:] - tank(x[:-1], u + e)).ravel() / np.sqrt(Q),
                (y - gauge(x[:-1], u + e)).ravel() / np.sqrt(R),
            ))

        start = np.concatenate((estimate.candidate[:, 0], estimate.candidate[:-1, 1:].ravel()))
        best = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert estimate.cost <= estimate.candidate_cost
        assert estimate.cost == pytest.approx(2.0 * best.cost, rel=1e-8)
        found = np.concatenate((estimate.trajectory[:, 0], estimate.trajectory[:-1, 1:].ravel()))
        np.testing.assert_allclose(found, best.x, atol=1e-6)


def test_a_plant_of_which_only_one_function_takes_inputs():
    for f, h, ahead, output in (
        (lambda x, u: 0.5 * x + u, lambda x: x, [2.25, 0.0], [2.0]),
        (lambda x: 0.5 * x, lambda x, u: x + u, [1.0, 0.0], [3.25]),
    ):
        system = qpmhe.noisy_inputs(qpmhe.System(f, h, n=1, p=1, m=1))
        z, u = np.array([2.0, 0.25]), np.ones(1)
        np.testing.assert_array_equal(system.f(z, u), ahead)
        np.testing.assert_array_equal(system.h(z, u), output)


def spring(x, u):
    return np.stack([x[..., 1], u[..., 0] - u[..., 1] * x[..., 0]], axis=-1)


def position(x):
    return x[..., :1]


@pytest.mark.parametrize("second", ["parameter", "noisy input"])
def test_a_system_with_noisy_inputs_is_augmented_with_its_sampling_time(second):
    plant = qpmhe.System.from_ode(spring, position, dt=0.1, n=2, p=1, m=2)
    noisy = qpmhe.noisy_inputs(plant, [0])
    if second == "parameter":
        system, more, known = qpmhe.augment_parameters(noisy, nominal=[3.0]), 3.0, [0.5]
    else:
        system, more, known = qpmhe.noisy_inputs(noisy, [1]), 0.7, [0.5, 2.3]
    z, restored = np.array([0.3, -0.2, 0.1, more]), pickle.loads(pickle.dumps(system))
    kept = [0.0, more if second == "parameter" else 0.0]
    for one in (system, restored):
        assert one.dt == 0.1
        for step in (0.1, 0.25):
            expected = plant.timed.f(z[:2], np.array([0.6, 3.0, step]))
            found = one.timed.f(z, np.append(known, step))
            np.testing.assert_allclose(found, np.append(expected, kept), rtol=1e-14)
        np.testing.assert_allclose(one.f(z, np.array(known)), one.timed.f(z, np.append(known, 0.1)))
