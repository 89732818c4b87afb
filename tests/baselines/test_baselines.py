"""The baselines against the Kalman filter, a Gauss-Newton search and a Bayes filter on a grid."""

import re
from functools import partial

import numpy as np
import pytest
from scipy.optimize import least_squares

import qpmhe
from qpmhe.baselines import (
    BootstrapParticleFilter,
    EnsembleKalmanFilter,
    ExtendedKalmanFilter,
    Problem,
    UnscentedKalmanFilter,
    follow,
)
from qpmhe.errors import InvalidInputError, OptionError, ShapeError, WeightError

A, B, C = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[0.0], [1.0]]), np.eye(2)
G = np.array([[0.5], [1.0]])
Q, R = np.array([[0.3]]), np.array([[0.2, 0.05], [0.05, 0.4]])
P0, X0 = np.diag([4.0, 0.0]), np.array([1.0, -1.0])
OBSERVER = qpmhe.ExtendedKalman(prior=P0, disturbance=Q, noise=R)
KALMAN = (
    ExtendedKalmanFilter, partial(ExtendedKalmanFilter, iterations=5), UnscentedKalmanFilter,
    partial(UnscentedKalmanFilter, spread=0.1),
)


def linear(scale=1.0):
    """A linear system with an input and few disturbances, the second state in another unit."""
    t = np.diag([1.0, scale])
    inside = np.linalg.inv(t)
    system = qpmhe.System(
        lambda x, u: t @ A @ inside @ x + t @ B @ u, lambda x: C @ inside @ x, n=2, p=2, m=1,
        disturbance_matrix=t @ G,
    )
    return Problem(system, initial_state=t @ X0, prior=t @ P0 @ t, disturbance=Q, noise=R)


def data(steps=25):
    rng = np.random.default_rng(4)
    y, u = rng.normal(size=(steps, 2)), rng.normal(size=(steps, 1))
    y[3, 0] = y[7] = np.nan
    return y, u


def kalman(measurements, inputs):
    """The predictions of the Kalman filter, in information form."""
    x, p = X0, P0 + 1e-13 * np.eye(2)
    states, covariances, filtered = [x], [], []
    for y, u in zip(measurements, inputs, strict=True):
        there = np.isfinite(y)
        c, weight = C[there], np.linalg.inv(R[np.ix_(there, there)])
        if there.any():
            updated = np.linalg.inv(np.linalg.inv(p) + c.T @ weight @ c)
            x, p = x + updated @ c.T @ weight @ (y[there] - c @ x), updated
        filtered.append(x)
        x, p = A @ x + B @ u, A @ p @ A.T + G @ Q @ G.T
        states.append(x)
        covariances.append(p)
    return np.array(states), np.array(covariances), np.array(filtered)


@pytest.mark.parametrize("kind", KALMAN)
@pytest.mark.parametrize("scale", [1.0, 1e7])
def test_on_a_linear_system_it_is_the_kalman_filter(kind, scale):
    y, u = data()
    states, covariances, filtered = kalman(y, u)
    run = kind(linear(scale)).run(y, u)
    t = np.array([1.0, scale])
    np.testing.assert_allclose(run.states / t, states, atol=1e-8)
    np.testing.assert_allclose(run.filtered / t, filtered, atol=1e-8)
    np.testing.assert_allclose(run.covariances / np.outer(t, t), covariances, atol=1e-8)
    assert len(run) == len(y)
    assert np.isnan(run.costs).all()


@pytest.mark.parametrize(("kind", "size"), [
    (partial(EnsembleKalmanFilter, members=20_000), 20_000),
    (partial(BootstrapParticleFilter, particles=20_000), 5_000),  # as many as are effective
])
def test_samples_converge_to_the_kalman_filter(kind, size):
    y, u = data(12)
    y /= 4.0  # likely ones, of which many particles know
    states, covariances, _ = kalman(y, u)
    run = kind(linear()).run(y, u)
    deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    # Five standard errors of a mean, and of a standard deviation.
    assert (np.abs(run.states - states)[1:] < 5.0 * deviations / np.sqrt(size)).all()
    found = np.sqrt(np.diagonal(run.covariances, axis1=1, axis2=2))
    assert (np.abs(found / deviations - 1.0) < 5.0 / np.sqrt(size)).all()
    again = kind(linear())
    np.testing.assert_array_equal(again.run(y, u).states, run.states)
    again.reset()
    np.testing.assert_array_equal(again.run(y, u).states, run.states)


def test_the_iterated_filter_minimises_the_cost_of_its_update():
    system = qpmhe.System(
        lambda x: x, lambda x: np.array([np.sqrt(1.0 + x[0] ** 2 + x[1] ** 2)]), n=2, p=1
    )
    problem = Problem(
        system, initial_state=[2.0, 1.0], prior=np.diag([1.0, 4.0]), disturbance=np.eye(2),
        noise=[[0.01]],
    )
    found = ExtendedKalmanFilter(problem, iterations=60)
    found.update([4.0])

    def residuals(x):
        return np.append((x - [2.0, 1.0]) / [1.0, 2.0], (4.0 - system.h(x)) / 0.1)

    best = least_squares(residuals, [2.0, 1.0], xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    np.testing.assert_allclose(found.filtered, best, rtol=1e-7)
    assert np.abs(ExtendedKalmanFilter(problem).update([4.0]) - best).max() > 0.01


def test_particles_follow_a_density_with_two_peaks():
    """y = x^2 says nothing of the sign; a grid has the density itself."""
    system = qpmhe.System(lambda x: 0.9 * x + 0.1, lambda x: x**2, n=1, p=1)
    problem = Problem(
        system, initial_state=[0.3], prior=[[1.0]], disturbance=[[0.1]], noise=[[0.3]], seed=3
    )
    y, grid = [1.2, 0.9, 1.6, 1.1], np.linspace(-6.0, 6.0, 1201)
    density = np.exp(-0.5 * (grid - 0.3) ** 2)
    kernel = np.exp(-0.5 * (grid[:, None] - 0.9 * grid - 0.1) ** 2 / 0.1)
    run = BootstrapParticleFilter(problem, particles=40_000).run(y)
    for t, value in enumerate(y):
        density = kernel @ (density * np.exp(-0.5 * (value - grid**2) ** 2 / 0.3))
        density /= density.sum()
        mean = grid @ density
        assert run.states[t + 1, 0] == pytest.approx(mean, abs=0.03)
        assert run.covariances[t, 0, 0] == pytest.approx((grid - mean) ** 2 @ density, rel=0.04)


@pytest.mark.parametrize("kind", [*KALMAN, EnsembleKalmanFilter, BootstrapParticleFilter])
def test_angles_make_no_jumps(kind):
    turn = qpmhe.angles([0])
    y = np.random.default_rng(1).normal(scale=0.05, size=(30, 1))

    def run(offset, **residuals):
        system = qpmhe.System(lambda x: x + 0.01, lambda x: x, n=1, p=1, **residuals)
        problem = Problem(system, initial_state=[offset], prior=[[0.01]], disturbance=[[1e-4]],
                          noise=[[0.01]])
        return kind(problem).run(turn(y + offset, np.zeros(1))).states - offset

    plain = run(0.0)
    found = run(np.pi, output_residual=turn, state_residual=turn)
    np.testing.assert_allclose(turn(found, plain), 0.0, atol=1e-9)


def test_steps_of_other_lengths_and_parameters_reach_the_model():
    system = qpmhe.System.from_ode(
        lambda x, u: -u[0] * x, lambda x: x, dt=0.1, method="rk4", n=1, p=1, m=1
    )
    problem = Problem(system, initial_state=[1.0], prior=[[1.0]], disturbance=[[1e-6]],
                      noise=[[1.0]], parameters=[2.0])
    found = ExtendedKalmanFilter(problem)
    np.testing.assert_allclose(found.update([np.nan]), np.exp(-0.2), rtol=1e-5)
    np.testing.assert_allclose(found.update([np.nan], dt=0.2), np.exp(-0.6), rtol=1e-3)
    run = follow(ExtendedKalmanFilter(problem), np.ones(1), np.full((2, 1), np.nan),
                 steps=np.array([0.1, 0.2]))
    np.testing.assert_array_equal(run.states[-1], found.state)


def test_what_fails_at_run_time_does_not_raise():
    problem = Problem(
        qpmhe.System(lambda x: x, lambda x: np.log(x), n=1, p=1), initial_state=[1.0],
        prior=[[1.0]], disturbance=[[1.0]], noise=[[1.0]],
    )
    for kind in (*KALMAN, EnsembleKalmanFilter, BootstrapParticleFilter):
        run = kind(problem).run(np.ones((10, 1)))
        assert run.states.shape == (11, 1)
    # Particles at which the model fails weigh nothing.
    assert np.isfinite(run.states).all()


def test_a_problem_comes_from_the_parts_of_an_estimator():
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    problem = Problem.of(system, observer, cost, scenario.initial_estimate, seed=4)
    for name, weight in (("prior", cost.prior), ("noise", cost.noise)):
        np.testing.assert_allclose(problem.covariances[name] @ weight, np.eye(len(weight)),
                                   atol=1e-12)
    singular = qpmhe.QuadraticCost.from_covariances(disturbance=np.diag([1.0, 0.0]), noise=[[1.0]])
    kalman = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=[[1.0]])
    found = Problem.of(system, kalman, singular, [3.0, 1.0])
    np.testing.assert_allclose(found.disturbance, np.diag([1.0, 0.0]), atol=1e-12)
    np.testing.assert_array_equal(found.prior, np.eye(2))
    with pytest.raises(WeightError, match="give the cost a prior"):
        Problem.of(system, observer, singular, [3.0, 1.0])


class Other:
    """An estimator of somebody else."""

    def __init__(self, value, **attributes):
        self.value = value
        vars(self).update(attributes)

    def update(self, y):
        return self.value


def test_any_object_with_an_update_is_followed():
    y = np.zeros((3, 1))
    run = follow(Other([1.0, 2.0], covariance=np.eye(2)), np.zeros(2), y, covariances=True)
    np.testing.assert_array_equal(run.states, [[0, 0], *[[1, 2]] * 3])
    np.testing.assert_array_equal(run.covariances, [np.eye(2)] * 3)
    assert np.isfinite(run.times).all()
    assert follow(Other([1.0, 2.0]), np.zeros(2), y, covariances=True).covariances is None
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=4, initial_state=scenario.initial_estimate
    )
    _, measured = scenario.simulate(0, 8)
    expected = mhe.run(measured, covariances=True)
    mhe.reset()
    found = follow(mhe, mhe.state, measured, covariances=True)
    for name in ("states", "costs", "flags", "covariances", "filtered"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_estimators_and_records_that_do_not_fit_are_refused():
    y = np.zeros((3, 1))
    for estimator, options, words in (
        (object(), {}, "; expected an object with update(y, u)"),
        (Other, {}, "the estimator is <class"),
        (Other([1.0]), {}, "the estimate of Other is [1.0], of shape (1,); expected an array of "),
        (Other("word"), {}, "the estimate of Other is 'word', which is not an array of real"),
        (Other(None), {}, "the estimate of Other is None"),
        (Other([1.0, 2.0], covariance=np.eye(3)), {}, "of shape (3, 3); expected an array of"),
        (Other([1.0, 2.0], covariance=len), {}, "the covariance of Other is <built-in function"),
        (Other([1.0, 2.0], filtered="word"), {}, "Other.filtered is 'word'"),
        (Other([1.0, 2.0]), {"steps": np.ones(3)}, "called as update(y, u, dt=...)"),
        (Other([1.0, 2.0]), {"inputs": np.ones((3, 1))}, "Other.update cannot be called as"),
        (Other([1.0, 2.0]), {"inputs": np.ones((2, 1))}, "inputs has shape (2, 1); expected 3 "),
        (Other([1.0, 2.0]), {"steps": 0.1}, "steps has shape (); expected 3 rows"),
        (Other([1.0, 2.0]), {"measurements": None}, "measurements has shape (); expected T rows"),
        (Other([1.0, 2.0]), {"start": "word"}, "start is 'word', which is not"),
    ):
        given = {"start": np.zeros(2), "measurements": y} | options
        with pytest.raises(InvalidInputError, match=re.escape(words)):
            follow(estimator, **given, covariances=True)


class Remembering:
    """It overwrites its arrays, and knows a covariance from its second update on."""

    def __init__(self):
        self.filtered, self.covariance = np.zeros(1), None

    def update(self, y, u=None):
        if self.filtered[0] > 0.0:
            self.covariance = np.eye(1)
        self.filtered += 1.0
        return self.filtered


def test_arrays_that_an_estimator_overwrites_are_copied():
    run = follow(Remembering(), [0.0], np.zeros(3), np.zeros(3), covariances=True)
    np.testing.assert_array_equal(run.states[:, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(run.filtered[:, 0], [1, 2, 3])
    np.testing.assert_array_equal(run.covariances[:, 0, 0], [np.nan, 1, 1])


def test_what_does_not_fit_is_refused():
    problem = linear()
    for make, error, words in (
        (lambda: ExtendedKalmanFilter(problem, iterations=0), OptionError, "iterations is 0"),
        (lambda: UnscentedKalmanFilter(problem, spread=-1.0), OptionError, "spread is -1"),
        (lambda: UnscentedKalmanFilter(problem, spread=1e300), OptionError, "from 1e-6 to 1e6"),
        (lambda: ExtendedKalmanFilter(None), InvalidInputError, "problem is None; expected"),
        (lambda: EnsembleKalmanFilter(problem.system), InvalidInputError, "problem is System"),
        (lambda: Problem.of(problem.system, None, None, X0), InvalidInputError, "observer is None"),
        (lambda: Problem.of(problem.system, OBSERVER, "", X0), InvalidInputError, "cost is ''; "),
        (lambda: EnsembleKalmanFilter(problem, members=1), OptionError, "members is 1"),
        (lambda: EnsembleKalmanFilter(problem, inflation=0.0), OptionError, "inflation is 0"),
        (lambda: BootstrapParticleFilter(problem, particles=1), OptionError, "particles is 1"),
        (lambda: ExtendedKalmanFilter(problem).update([1.0, 2.0]), ShapeError, "u has shape"),
        (lambda: ExtendedKalmanFilter(problem).update([1.0], [1.0]), ShapeError, "y has shape"),
        (lambda: ExtendedKalmanFilter(problem).update([1.0, 2.0], [0.0], dt=0.1),
         InvalidInputError, "discrete"),
        (lambda: Problem(problem.system, initial_state=[1.0], prior=P0, disturbance=Q, noise=R),
         ShapeError, "initial_state"),
        (lambda: Problem(problem.system, initial_state=X0, prior=-P0, disturbance=Q, noise=R),
         WeightError, "prior covariance"),
    ):
        with pytest.raises(error, match=words):
            make()
