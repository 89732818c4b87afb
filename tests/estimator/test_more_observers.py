"""Designed gains, the stationary and the unscented Kalman filter, the high-gain observer."""

import subprocess
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError, OptionError, ShapeError, WeightError
from qpmhe.observers import (
    ExtendedKalman,
    HighGain,
    Sample,
    SteadyStateKalman,
    UnscentedKalman,
    design_luenberger,
)

BACKENDS = qpmhe.solvers.available()
DT = 0.05


class Plant:
    """A random observable linear system with dense covariances, an input and a record."""

    def __init__(self, seed, n=3, p=2, radius=1.05, steps=40, missing=0.0):
        rng = np.random.default_rng(seed)
        a = rng.standard_normal((n, n))
        self.A = a * (radius / np.abs(np.linalg.eigvals(a)).max())
        self.B, self.C = rng.standard_normal((n, 1)), rng.standard_normal((p, n))
        self.Q, self.R, self.P = (covariance(rng, size) for size in (n, p, n))
        A, B, C = self.A, self.B, self.C
        self.system = qpmhe.System(
            lambda x, u: x @ A.T + u @ B.T, lambda x, u: x @ C.T, n=n, p=p, m=1
        )
        self.z0, self.U = rng.standard_normal(n), rng.standard_normal((steps, 1))
        self.Y = np.empty((steps, p))
        x = self.z0 + draw(rng, self.P)
        for t, u in enumerate(self.U):
            self.Y[t] = C @ x + draw(rng, self.R)
            x = A @ x + B @ u + draw(rng, self.Q)
        self.Y[rng.random(self.Y.shape) < missing] = np.nan

    @property
    def covariances(self):
        return {"disturbance": self.Q, "noise": self.R}

    def kalman(self, P, noises=None):
        """Predicted means and covariances from P(0), by the textbook's two steps."""
        x, means, covariances = self.z0, [self.z0], [P]
        for t, (y, u) in enumerate(zip(self.Y, self.U, strict=True)):
            seen = np.isfinite(y)
            R = (self.R if noises is None else noises[t])[np.ix_(seen, seen)]
            C = self.C[seen]
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
            x, P = x + K @ (y[seen] - C @ x), P - K @ C @ P
            x, P = self.A @ x + self.B @ u, self.A @ P @ self.A.T + self.Q
            means.append(x)
            covariances.append(P)
        return np.array(means), np.array(covariances)

    def sample(self, t, P, noise_weight=None):
        seen = np.isfinite(self.Y[t])
        return Sample(
            self.system, self.U[t], self.A, self.C,
            None if seen.all() else seen, noise_weight, P,
        )

    def observe(self, observer, noises=None):
        """States and covariances of an observer, driven by hand."""
        z, P = self.z0, observer.initial_covariance()
        states, covariances = [z], [P]
        for t, (y, u) in enumerate(zip(self.Y, self.U, strict=True)):
            weight = None if noises is None else np.linalg.inv(noises[t])
            v = np.where(np.isfinite(y), y - self.C @ z, 0.0)
            correction, P = observer.correct(z, v, self.sample(t, P, weight))
            z = self.A @ z + self.B @ u + correction
            states.append(z)
            covariances.append(P)
        return np.array(states), np.array(covariances)

    def estimator(self, observer, **options):
        cost = qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), **self.covariances
        )
        return qpmhe.MovingHorizonEstimator(
            self.system, observer, cost, initial_state=self.z0, **options
        )


def covariance(rng, size):
    factor = rng.standard_normal((size, size))
    return factor @ factor.T + 0.3 * np.eye(size)


def draw(rng, matrix):
    return np.linalg.cholesky(matrix) @ rng.standard_normal(len(matrix))


def linear(A, C, **options):
    A, C = np.array(A, dtype=float), np.array(C, dtype=float)
    return qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=len(A), p=len(C), **options)


def van_der_pol(x):
    return np.stack([x[..., 1], (1 - x[..., 0] ** 2) * x[..., 1] - x[..., 0]], axis=-1)


def oscillator(**options):
    return qpmhe.System.from_ode(van_der_pol, lambda x: x[..., :1], dt=DT, n=2, p=1, **options)


def simulate(system, x, seed, steps, w, v):
    rng = np.random.default_rng(seed)
    X, Y = [np.array(x)], []
    for _ in range(steps):
        Y.append(system.h(X[-1], np.zeros(0)) + v * rng.standard_normal(system.p))
        X.append(system.f(X[-1], np.zeros(0)) + w * rng.standard_normal(system.n))
    return np.array(X), np.array(Y)


def poles_of(matrix):
    return np.sort_complex(np.linalg.eigvals(matrix))


# The stationary Kalman predictor


@pytest.mark.parametrize(("n", "p", "radius"), [(1, 1, 1.2), (2, 1, 0.7), (3, 2, 1.05), (4, 3, 1)])
def test_the_steady_gain_is_the_limit_of_the_extended_kalman_observer(n, p, radius):
    plant = Plant(n, n, p, radius)
    steady = SteadyStateKalman(plant.system, plant.z0, [0.3], **plant.covariances)
    moving, P = ExtendedKalman(prior=plant.P, **plant.covariances), plant.P
    for _ in range(400):
        _, P = moving.correct(plant.z0, np.zeros(p), plant.sample(0, P))
    gain = np.column_stack(
        [moving.correct(plant.z0, v, plant.sample(0, P))[0] for v in np.eye(p)]
    )
    np.testing.assert_allclose(steady.gain, gain, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(steady.covariance, P, rtol=1e-8)
    assert steady.kappa == pytest.approx(np.linalg.svd(gain)[1][0])
    assert np.abs(np.linalg.eigvals(plant.A - steady.gain @ plant.C)).max() < 1


@pytest.mark.parametrize("horizon", [1, 4, 11])
def test_an_estimator_that_starts_stationary_is_the_kalman_predictor(horizon):
    for seed in range(4):
        plant = Plant(seed, 2 + seed % 2, 1 + seed // 2)
        steady = SteadyStateKalman(plant.system, plant.z0, [0.0], **plant.covariances)
        means, covariances = plant.kalman(steady.covariance)
        np.testing.assert_allclose(covariances[-1], steady.covariance, rtol=1e-9)
        run = plant.estimator(steady, horizon=horizon).run(plant.Y, plant.U)
        np.testing.assert_allclose(run.states, means, rtol=1e-8, atol=1e-8)


def test_the_steady_covariance_stays_and_comes_back():
    plant = Plant(5, steps=80)
    still = SteadyStateKalman(plant.system, plant.z0, [0.0], **plant.covariances)
    _, covariances = plant.observe(still)
    np.testing.assert_allclose(covariances, covariances[:1].repeat(81, 0), rtol=1e-9)
    wide = SteadyStateKalman(
        plant.system, plant.z0, [0.0], **plant.covariances, prior=100 * plant.P
    )
    assert wide.gain.tolist() == still.gain.tolist()
    _, covariances = plant.observe(wide)
    np.testing.assert_array_equal(covariances[0], 100 * plant.P)
    assert (np.linalg.eigvalsh(covariances[1] - still.covariance) > 0).any()
    np.testing.assert_allclose(covariances[-1], still.covariance, rtol=1e-6)


def test_the_steady_covariance_is_that_of_the_errors_that_are_made():
    # Errors of many runs with the same pattern of missing and of noisier outputs.
    plant = Plant(6, n=2, p=2, steps=14, missing=0.3)
    noises = [plant.R * (9.0 if t % 3 == 0 else 1.0) for t in range(14)]
    observer = SteadyStateKalman(
        plant.system, plant.z0, [0.0], **plant.covariances, prior=plant.P
    )
    _, claimed = plant.observe(observer, noises)
    rng, runs = np.random.default_rng(7), 20000
    x = rng.multivariate_normal(plant.z0, plant.P, runs)
    z = np.tile(plant.z0, (runs, 1))
    for t in range(14):
        y = x @ plant.C.T + rng.multivariate_normal(np.zeros(2), noises[t], runs)
        v = np.where(np.isfinite(plant.Y[t]), y - z @ plant.C.T, 0.0)
        z = z @ plant.A.T + v @ observer.gain.T
        x = x @ plant.A.T + rng.multivariate_normal(np.zeros(2), plant.Q, runs)
        made = np.cov((x - z).T, bias=True)
        assert np.abs(made - claimed[t + 1]).max() < 0.05 * np.abs(claimed[t + 1]).max()
    assert np.linalg.norm(claimed[-1] - observer.covariance) > 0.01


def test_one_observer_serves_several_estimators():
    plant = Plant(8)
    steady = SteadyStateKalman(plant.system, plant.z0, [0.0], **plant.covariances)
    first = plant.estimator(steady, horizon=3, max_qps=0)
    expected = first.run(plant.Y, plant.U).states
    second = plant.estimator(steady, horizon=3, max_qps=0)
    first.reset(plant.z0 + 5.0)
    for y, u in zip(plant.Y, plant.U, strict=True):
        first.update(y, u)
        second.update(y, u)
    np.testing.assert_array_equal(second.state, expected[-1])


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"at": [0.0]}, ShapeError, r"at has shape \(1,\); expected \(3,\)"),
        ({"u": None}, InvalidInputError, "u is missing; the system has 1 inputs"),
        ({"disturbance": np.eye(2)}, ShapeError, r"disturbance covariance .* expected \(3, 3\)"),
        ({"noise": -np.eye(2)}, WeightError, "noise covariance has the eigenvalue -1"),
        ({"prior": np.eye(2)}, ShapeError, r"prior covariance .* expected \(3, 3\)"),
    ],
)
def test_a_steady_observer_that_does_not_fit_is_refused(change, error, text):
    plant = Plant(9)
    given = {"at": plant.z0, "u": [0.0], **plant.covariances, **change}
    with pytest.raises(error, match=text):
        SteadyStateKalman(plant.system, **given)


def test_a_steady_observer_is_for_its_own_dimensions():
    small, large = Plant(10, n=2), Plant(10, n=3)
    observer = SteadyStateKalman(small.system, small.z0, [0.0], **small.covariances)
    with pytest.raises(ShapeError, match="for 2 states and 2 outputs; expected 3 and 2"):
        large.estimator(observer, horizon=3)


# Designed gains


@pytest.mark.parametrize(
    ("n", "p", "poles"),
    [
        (1, 1, [0.3]),
        (1, 2, [0.3]),
        (2, 1, [0.5 + 0.2j, 0.5 - 0.2j]),
        (2, 2, [0.4, 0.4]),
        (3, 1, [0.0, 0.0, 0.0]),
        (3, 1, [0.6, 0.6, -0.2]),
        (4, 1, [0.3 - 0.6j, 0.9, 0.3 + 0.6j, -0.5]),
        (4, 2, [0.3 - 0.6j, 0.9, 0.3 + 0.6j, -0.5]),
        (4, 2, [0.2, 0.3, 0.2, 0.3]),
        (5, 3, [0.1, 0.2, 0.3, 0.4, 0.5]),
        (2, 3, [0.1, 0.2]),
    ],
)
def test_poles_are_placed_as_asked(n, p, poles):
    plant = Plant(20 + n + p, n, p)
    gain = design_luenberger(plant.system, plant.z0, [0.0], poles=poles).gain
    assert gain.shape == (n, p)
    np.testing.assert_allclose(
        np.poly(plant.A - gain @ plant.C), np.poly(poles).real, rtol=0, atol=1e-8
    )


@pytest.mark.parametrize("step", [1.0, 1e-2, 1e-4])
def test_poles_are_placed_for_every_sampling_time(step):
    A, C = np.eye(4) + step * np.eye(4, k=1), np.eye(1, 4)
    poles = np.exp(-step * np.array([1.0, 2.0, 3.0, 4.0]))
    gain = design_luenberger(linear(A, C), np.zeros(4), poles=poles).gain
    rates = (1.0 - np.linalg.eigvals(A - gain @ C)) / step
    np.testing.assert_allclose(np.sort(rates.real), np.sort((1.0 - poles) / step), rtol=1e-4)


def test_outputs_that_say_the_same_are_one():
    A = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]])
    C = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    gain = design_luenberger(linear(A, C), np.zeros(3), poles=[0.3, 0.4, 0.5]).gain
    np.testing.assert_allclose(poles_of(A - gain @ C), [0.3, 0.4, 0.5], atol=1e-8)


def test_a_gain_is_for_the_point_and_the_input():
    def f(x, u):
        return np.array([x[0] + 0.1 * x[1], x[1] - 0.1 * u[0] * np.sin(x[0])])

    system = qpmhe.System(f, lambda x: x[0], n=2, p=1, m=1)
    at, u, poles = np.array([2.0, 0.5]), np.array([3.0]), [0.4, 0.6]
    gain = design_luenberger(system, at, u, poles=poles).gain
    A = np.array([[1.0, 0.1], [-0.1 * u[0] * np.cos(at[0]), 1.0]])
    np.testing.assert_allclose(poles_of(A - gain @ np.eye(1, 2)), poles, atol=1e-9)
    other = design_luenberger(system, at, [0.0], poles=poles).gain
    assert abs(gain - other).max() > 0.1


def test_a_riccati_gain_is_the_steady_kalman_gain():
    plant = Plant(22)
    observer = design_luenberger(plant.system, plant.z0, [0.0], **plant.covariances)
    steady = SteadyStateKalman(plant.system, plant.z0, [0.0], **plant.covariances)
    assert type(observer) is qpmhe.Luenberger
    assert observer.gain.tolist() == steady.gain.tolist()


def test_an_unobservable_mode_that_decays_is_left_alone():
    A = np.array([[1.1, 0.0], [0.3, 0.5]])
    noises = {"disturbance": np.eye(2), "noise": [[1.0]]}
    gain = design_luenberger(linear(A, [[1.0, 0.0]]), [0.0, 0.0], **noises).gain
    poles = poles_of(A - gain @ np.eye(1, 2))
    assert (np.abs(poles) < 1).all()
    assert np.abs(poles - 0.5).min() < 1e-12


# The first state shows the second, and neither shows the others.
HIDDEN = np.array(
    [[0.9, 0.3, 0.0, 0.0], [0.0, 0.8, 0.0, 0.0], [0.2, 0.4, 1.25, 0.0], [0.1, 0.0, 0.5, 0.7]]
)


@pytest.mark.parametrize("seed", range(3))
def test_a_hidden_mode_is_named_in_any_coordinates(seed):
    T = np.random.default_rng(seed).standard_normal((4, 4))
    A, C = T @ HIDDEN @ np.linalg.inv(T), np.eye(1, 4) @ np.linalg.inv(T)
    system = linear(A, C)
    with pytest.raises(ModelError, match=r"not detectable: .* eigenvalue 1\.25, which does not"):
        design_luenberger(system, np.zeros(4), disturbance=np.eye(4), noise=[[1.0]])
    with pytest.raises(ModelError, match=r"not observable: .* (1\.25, 0\.7|0\.7, 1\.25), and"):
        design_luenberger(system, np.zeros(4), poles=[0.1, 0.2, 0.3, 0.4])


def test_what_is_hidden_at_one_point_is_seen_at_another():
    # y = x1 x2: at x2 = 0 the constant x1 is not seen.
    system = qpmhe.System(lambda x: x, lambda x: x[..., :1] * x[..., 1:], n=2, p=1)
    noises = {"disturbance": np.diag([1.0, 2.0]), "noise": [[1.0]]}
    with pytest.raises(ModelError, match=r"at x = \[1\.0, 0\.0\] is not detectable.* 1, which"):
        design_luenberger(system, [1.0, 0.0], **noises)
    moving = qpmhe.System(
        lambda x: x * np.array([1.0, 0.9]), lambda x: x[..., :1] * x[..., 1:], n=2, p=1
    )
    design_luenberger(moving, [1.0, 1.0], **noises)


POLES = r"the poles 1 do not lie inside the unit circle; .* exp\(s dt\)"


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({}, OptionError, "given: none of them; expected either the poles, or"),
        ({"poles": [0.1, 0.2], "noise": [[1.0]]}, OptionError, "given: poles, noise; expected"),
        ({"noise": [[1.0]]}, OptionError, "given: noise; expected either"),
        ({"poles": [0.1]}, ShapeError, r"poles has shape \(1,\); expected \(n,\) = \(2,\)"),
        ({"poles": [0.1, 1.0]}, OptionError, POLES),
        ({"poles": [0.1, np.nan]}, OptionError, "nan do not lie inside the unit circle"),
        ({"poles": [0.5j, 0.5j]}, OptionError, r"poles is .*expected complex poles in conjugate"),
        ({"poles": "slow"}, InvalidInputError, "'slow', not an array of numbers"),
        ({"poles": [0.1, 0.2], "at": [1.0]}, ShapeError, r"at has shape \(1,\); expected \(2,\)"),
        ({"poles": [0.1, 0.2], "u": [1.0]}, ShapeError, r"u has shape \(1,\); expected \(0,\)"),
    ],
)
def test_a_design_that_cannot_be_is_refused(given, error, text):
    system = linear([[1.0, 0.1], [0.0, 1.0]], [[1.0, 0.0]])
    given = {"at": [0.0, 0.0], **given}
    with pytest.raises(error, match=text):
        design_luenberger(system, **given)


def test_a_pole_too_often_is_refused():
    plant = Plant(23, n=3, p=2)
    with pytest.raises(OptionError, match=r"pole 0\.5 is given 3 times; .* rank C = 2 times"):
        design_luenberger(plant.system, plant.z0, [0.0], poles=[0.5, 0.5, 0.5])


def test_poles_out_of_reach_of_the_arithmetic_are_refused():
    A = np.eye(6) + 1e-4 * np.eye(6, k=1)
    with pytest.raises(ModelError, match=r"come out as .* instead of .* too ill-conditioned"):
        design_luenberger(
            linear(A, np.eye(1, 6) + 0.3), np.zeros(6), poles=[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
        )


def test_a_point_where_the_model_breaks_is_refused():
    def h(x):
        if x[0] < -5:
            raise ValueError("too cold")
        return np.sqrt(x[:1])

    system = qpmhe.System(lambda x: 0.9 * x, h, n=1, p=1)
    with pytest.raises(ModelError, match=r"h is \[nan\] at x = \[-1\.0\].*expected finite"):
        design_luenberger(system, [-1.0], poles=[0.5])
    with pytest.raises(ModelError, match=r"h cannot be linearised at .*ValueError: too cold"):
        design_luenberger(system, [-6.0], poles=[0.5])


# The high-gain observer


def chain(n, step, sampling="exact"):
    shift, term = step * np.eye(n, k=1), np.eye(n)
    A = np.eye(n) + shift
    if sampling == "exact":
        A, factor = np.zeros((n, n)), 1.0
        for k in range(n):
            A, term, factor = A + term / factor, term @ shift, factor * (k + 1)
    return A


@pytest.mark.parametrize("sampling", ["exact", "euler"])
@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("epsilon", [0.02, 0.2, 3.0])
def test_high_gain_gives_the_chain_the_sampled_poles(n, epsilon, sampling):
    coefficients = np.poly(-np.arange(1.0, n + 1))[1:]
    observer = HighGain(n, epsilon=epsilon, dt=DT, coefficients=coefficients, sampling=sampling)
    expected = np.exp(-np.arange(n, 0.0, -1) * DT / epsilon)
    found = poles_of(chain(n, DT, sampling) - observer.gain @ np.eye(1, n))
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("sampling", ["exact", "euler"])
def test_high_gain_between_emulation_and_deadbeat(sampling):
    n, epsilon = 3, 1.0
    slow = HighGain(n, epsilon=epsilon, dt=1e-5, sampling=sampling).gain[:, 0]
    np.testing.assert_allclose(slow, 1e-5 * np.array([3.0, 3.0, 1.0]), rtol=1e-4)
    fast = HighGain(n, epsilon=1e-9, dt=DT, sampling=sampling).gain
    error = np.linalg.matrix_power(chain(n, DT, sampling) - fast @ np.eye(1, n), n)
    np.testing.assert_allclose(error, 0.0, atol=1e-9)


@pytest.mark.parametrize("method", ["rk4", "euler"])
def test_high_gain_converges_faster_with_smaller_epsilon(method):
    system = oscillator(method=method)
    X, Y = simulate(system, [1.0, 2.0], 0, 400, 0.0, 0.0)
    sampling = "euler" if method == "euler" else "exact"
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=[[1.0]])
    steps = []
    for epsilon in (0.5, 0.2, 0.1, 0.05, 0.01):
        observer = HighGain(2, epsilon=epsilon, dt=DT, sampling=sampling)
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=5, initial_state=[0.0, 0.0], max_qps=0
        )
        error = np.linalg.norm(mhe.run(Y).states - X, axis=1)
        steps.append(int(np.flatnonzero(error > 1e-3)[-1]))
    assert steps == sorted(steps, reverse=True)
    assert len(set(steps)) == 5
    assert 5 * steps[-1] < steps[0] < 100


def test_high_gain_is_louder_with_smaller_epsilon():
    kappas = [HighGain(3, epsilon=e, dt=DT).kappa for e in (0.5, 0.1, 0.02)]
    assert kappas == sorted(kappas)
    # In coordinates whose unit of time is another, the same observer.
    in_seconds = HighGain(3, epsilon=0.1, dt=DT).gain[:, 0]
    in_milliseconds = HighGain(3, epsilon=100.0, dt=1000 * DT).gain[:, 0]
    np.testing.assert_allclose(in_seconds, in_milliseconds * 1000.0 ** np.arange(3), rtol=1e-9)


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"n": 0}, OptionError, "n is 0; expected an integer >= 1"),
        ({"epsilon": 0.0}, OptionError, "epsilon is 0.0; expected a finite number > 0"),
        ({"dt": -1.0}, OptionError, "dt is -1.0; expected a finite number > 0"),
        ({"sampling": "rk4"}, OptionError, "sampling is 'rk4'; expected one of 'exact', 'euler'"),
        ({"coefficients": [1.0]}, ShapeError, r"coefficients has shape \(1,\); expected \(2,\)"),
        ({"coefficients": [2.0, 0.0]}, OptionError, r"\[2.0, 0.0\].* real part 0; expected all"),
        ({"coefficients": [-2.0, 1.0]}, OptionError, "real part 1; expected all roots in the left"),
    ],
)
def test_a_high_gain_observer_that_makes_no_sense_is_refused(options, error, text):
    with pytest.raises(error, match=text):
        HighGain(**{"n": 2, "epsilon": 0.1, "dt": DT, **options})


@pytest.mark.parametrize(
    ("system", "error", "text"),
    [
        (linear(np.eye(2), np.eye(2)), ShapeError, "the system has 2 outputs; expected 1"),
        (linear(np.eye(3), np.eye(1, 3)), ShapeError, "is for n = 2; expected 3 states"),
        (linear(chain(2, DT), [[0.0, 1.0]]), ModelError, r"radius 2\.\d+ at the initial state"),
        (linear(chain(2, DT), [[-1.0, 0.0]]), ModelError, r"C is \[\[-1.0, 0.0\]\]"),
        (
            qpmhe.System.from_ode(van_der_pol, lambda x: x[..., :1], dt=0.1, n=2, p=1),
            InvalidInputError,
            "dt of the high-gain observer is 0.05; expected 0.1",
        ),
    ],
)
def test_a_high_gain_observer_insists_on_its_structure(system, error, text):
    cost = qpmhe.QuadraticCost(
        prior=np.eye(system.n), disturbance=np.eye(system.n), noise=np.eye(system.p)
    )
    observer = HighGain(2, epsilon=0.1, dt=DT)
    with pytest.raises(error, match=text):
        qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=3, initial_state=np.zeros(system.n)
        )


# The unscented Kalman filter


@pytest.mark.parametrize("missing", [0.0, 0.4], ids=["complete", "missing"])
@pytest.mark.parametrize("spread", [0.01, 3**0.5, 5.0])
@pytest.mark.parametrize(("n", "p"), [(1, 1), (2, 3), (4, 2)])
def test_unscented_is_the_kalman_filter_on_a_linear_system(n, p, spread, missing):
    plant = Plant(30 + n, n, p, missing=missing)
    noises = [plant.R * (1.0 + t % 3) for t in range(len(plant.Y))]
    observer = UnscentedKalman(prior=plant.P, **plant.covariances, spread=spread)
    for own in (None, noises):
        states, covariances = plant.observe(observer, own)
        means, expected = plant.kalman(plant.P, own)
        np.testing.assert_allclose(states, means, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(covariances, expected, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("horizon", [1, 6])
def test_an_estimator_with_the_unscented_prior_is_the_kalman_predictor(horizon):
    plant = Plant(31, missing=0.3)
    observer = UnscentedKalman(prior=plant.P, **plant.covariances)
    run = plant.estimator(observer, horizon=horizon).run(plant.Y, plant.U)
    np.testing.assert_allclose(run.states, plant.kalman(plant.P)[0], rtol=1e-8, atol=1e-8)


def test_without_spread_unscented_is_extended():
    system = oscillator()
    noises = {"prior": np.eye(2), "disturbance": 0.01 * np.eye(2), "noise": [[0.1]]}
    extended, unscented = ExtendedKalman(**noises), UnscentedKalman(**noises, spread=1e-5)
    z, u, P = np.array([1.0, -2.0]), np.zeros(0), np.array([[0.5, 0.2], [0.2, 0.7]])
    sample = Sample(system, u, system.f_jacobian(z, u), system.h_jacobian(z, u), covariance=P)
    for expected, found in zip(
        extended.correct(z, np.array([0.3]), sample),
        unscented.correct(z, np.array([0.3]), sample),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_unscented_moments_are_about_the_model_at_z():
    # f = x^2 about z = 0: the mean square of f(z + d) - f(z) is E d^4 = 3 P^2, its covariance
    # only 2 P^2; the extended Kalman filter sees nothing at all. E f h = E d^3 = 0.
    system = qpmhe.System(lambda x: x**2, lambda x: x + x**3, n=1, p=1)
    observer = UnscentedKalman(prior=[[2.0]], disturbance=[[0.5]], noise=[[1.0]])
    sample = Sample(system, np.zeros(0), covariance=np.array([[2.0]]))
    correction, following = observer.correct(np.zeros(1), np.ones(1), sample)
    np.testing.assert_allclose(following, [[3 * 2.0**2 + 0.5]])
    np.testing.assert_allclose(correction, 0.0, atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_unscented_follows_an_oscillator_that_a_simulation_loses(seed):
    system = oscillator()
    X, Y = simulate(system, [2.0, 0.0], seed, 300, 0.02, 0.1)
    observer = UnscentedKalman(
        prior=4 * np.eye(2), disturbance=0.02**2 * np.eye(2), noise=[[0.1**2]]
    )
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=qpmhe.ObserverPrior(), disturbance=0.02**2 * np.eye(2), noise=[[0.1**2]]
    )

    def error(used, cost):
        mhe = qpmhe.MovingHorizonEstimator(
            system, used, cost, horizon=5, initial_state=[0.5, 1.5], max_qps=0
        )
        return np.sqrt(np.mean((mhe.run(Y).states - X)[50:] ** 2))

    blind = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=[[1.0]])
    assert error(observer, cost) < 0.2 * error(qpmhe.Luenberger([0.0, 0.0]), blind)


def test_unscented_keeps_its_sigma_points_within_the_bounds():
    # A model that ends where the bounds do. Torricelli: the tank's outflow is a root.
    def f(x):
        return x - 0.05 * np.sqrt(x) + 0.04

    bounded = qpmhe.System(f, lambda x: x, n=1, p=1, states=qpmhe.Box([0.0], [np.inf]))
    free = qpmhe.System(f, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=[[1.0]], disturbance=[[1e3]], noise=[[10.0]])
    observer = UnscentedKalman(prior=[[1.0]], disturbance=[[1e-3]], noise=[[0.1]])
    failures = []
    for system in (bounded, free):
        X, Y = simulate(system, [0.3], 1, 60, 0.01, 0.1)
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=4, initial_state=[0.1], max_qps=0
        )
        run = mhe.run(Y)
        failures.append(sum(qpmhe.Status.MODEL_FAILED in status for status in run.statuses))
        if system is bounded:
            assert np.abs(run.states - X)[30:].mean() < 0.1
    assert failures[0] == 0 < failures[1]


def test_bounds_do_not_change_the_unscented_filter_of_a_linear_system():
    plant = Plant(32, n=2, p=1)
    observer = UnscentedKalman(prior=plant.P, **plant.covariances)
    v, P = np.array([0.7]), plant.P
    expected = observer.correct(plant.z0, v, plant.sample(0, P))
    for below in (np.array([10.0, 5.0]), np.array([0.3, 1.0]), np.zeros(2), np.array([-1.0, 2.0])):
        box = qpmhe.Box(plant.z0 - below, plant.z0 + np.array([5.0, np.inf]))
        system = qpmhe.System(plant.system.f, plant.system.h, n=2, p=1, m=1, states=box)
        found = observer.correct(plant.z0, v, Sample(system, plant.U[0], covariance=P))
        np.testing.assert_allclose(found[0], expected[0], rtol=1e-9)
        np.testing.assert_allclose(found[1], expected[1], rtol=1e-9)


def test_unscented_takes_steps_of_any_length():
    def rate(x, u):
        return np.stack([x[..., 1], u[..., 0] - 4.0 * x[..., 0]], axis=-1)

    system = qpmhe.System.from_ode(rate, lambda x: x[..., :1], dt=DT, n=2, p=1, m=1)
    noises = {"prior": np.eye(2), "disturbance": 0.01 * np.eye(2), "noise": [[0.1]]}
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=qpmhe.ObserverPrior(), disturbance=0.01 * np.eye(2), noise=[[0.1]]
    )
    extended, unscented = (
        qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=4, initial_state=[1.0, 0.0], max_qps=0
        )
        for observer in (ExtendedKalman(**noises), UnscentedKalman(**noises))
    )
    rng = np.random.default_rng(33)
    for t in range(20):
        y, u, dt = rng.standard_normal(1), rng.standard_normal(1), 0.3 if t % 4 == 1 else None
        expected = extended.update(y, u, dt=dt).state
        np.testing.assert_allclose(unscented.update(y, u, dt=dt).state, expected, rtol=1e-7)


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"spread": 0.0}, OptionError, "spread is 0.0; expected a finite number > 0"),
        ({"prior": -np.eye(3)}, WeightError, "prior covariance has the eigenvalue -1"),
        ({"noise": np.eye(3)}, ShapeError, r"noise covariance .* \(3, 3\); expected \(2, 2\)"),
        ({"prior": np.eye(2)}, ShapeError, r"prior covariance has .* expected \(3, 3\)"),
    ],
)
def test_an_unscented_observer_that_does_not_fit_is_refused(change, error, text):
    plant = Plant(34)
    given = {"prior": plant.P, **plant.covariances, **change}
    with pytest.raises(error, match=text):
        plant.estimator(UnscentedKalman(**given), horizon=3)


# All of them


def observers(system):
    noises = {"disturbance": 0.02**2 * np.eye(2), "noise": [[0.1**2]]}
    return {
        "steady": SteadyStateKalman(system, [0.5, 0.5], **noises),
        "high gain": HighGain(2, epsilon=0.3, dt=DT),
        "unscented": UnscentedKalman(prior=np.eye(2), **noises),
        "placed": design_luenberger(system, [0.5, 0.5], poles=[0.7, 0.8]),
        "riccati": design_luenberger(system, [0.5, 0.5], **noises),
    }


NAMES = list(observers(oscillator()))


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_corrected_where_the_output_fits(name):
    system = oscillator()
    observer = observers(system)[name]
    rng = np.random.default_rng(40)
    for observed in (None, np.array([True]), np.array([False])):
        for _ in range(20):
            sample = Sample(system, np.zeros(0), observed=observed, covariance=covariance(rng, 2))
            correction, _ = observer.correct(3 * rng.standard_normal(2), np.zeros(1), sample)
            assert (correction == 0.0).all()
    correction, _ = observer.correct(np.ones(2), np.ones(1), Sample(
        system, np.zeros(0), covariance=np.eye(2)
    ))
    assert np.abs(correction).max() > 1e-3


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", NAMES)
def test_the_estimate_is_never_worse_than_the_candidate(name, backend):
    system = oscillator(states=qpmhe.Box([-3.0, -6.0], [3.0, 6.0]))
    X, Y = simulate(system, [2.0, 0.0], 41, 30, 0.02, 0.1)
    Y[[4, 5, 17]] = np.nan
    observer = observers(system)[name]
    known = observer.initial_covariance() is not None
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=qpmhe.ObserverPrior() if known else np.eye(2),
        disturbance=0.02**2 * np.eye(2), noise=[[0.1**2]],
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=6, initial_state=[1.0, 1.0], backend=backend, max_qps=2
    )
    z = np.array([1.0, 1.0])
    improved = 0
    for y in Y:
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost
        assert estimate.candidate[-2].tolist() == z.tolist()
        z = estimate.candidate[-1]
        improved += estimate.improved
        assert qpmhe.Status.MODEL_FAILED not in estimate.status
    assert improved > 20
    assert np.linalg.norm(estimate.state - X[-1]) < 0.5


def test_observers_leave_scipy_for_later():
    code = "import sys, qpmhe.observers; print([m for m in sys.modules if m.startswith('scipy')])"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "[]"
