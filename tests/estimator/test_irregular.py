"""Steps of another length, and noises of another weight, sample by sample."""

import math

import numpy as np
import pytest

import qpmhe

from . import plain
from .plain import Record, is_minimum, spd

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 2)
GAIN = np.array([[0.3, 0.05], [0.1, 0.2]])
DT = 0.1
LENGTHS = np.array([0.02, 0.1, 0.35, 1.0])


def free_rate(x):
    return np.stack([x[..., 1], (1.0 - x[..., 0] ** 2) * x[..., 1] - x[..., 0]], axis=-1)


def driven_rate(x, u):
    push = np.stack([0.0 * u[..., 0], u[..., 0] - u[..., 1] * x[..., 0]], axis=-1)
    return free_rate(x) + push


def rate_jacobian(x, u=None):
    value = np.zeros((*x.shape, 2), dtype=x.dtype)
    value[..., 0, 1] = 1.0
    value[..., 1, 0] = -2.0 * x[..., 0] * x[..., 1] - 1.0 - (0.0 if u is None else u[..., 1])
    value[..., 1, 1] = 1.0 - x[..., 0] ** 2
    return value


def driven_looped(x, u):
    return [x[1], (1.0 - math.pow(x[0], 2)) * x[1] - x[0] + u[0] - u[1] * x[0]]


def seen(x):
    return np.stack([x[..., 0] + 0.1 * x[..., 1] ** 2, x[..., 1]], axis=-1)


RATES = {
    "free": (free_rate, 0, {}),
    "free, given": (free_rate, 0, {"rate_jacobian": rate_jacobian}),
    "driven": (driven_rate, 2, {}),
    "driven, given": (driven_rate, 2, {"rate_jacobian": rate_jacobian}),
    "driven, looped": (driven_looped, 2, {}),
    "driven, looped, given": (driven_looped, 2, {"rate_jacobian": rate_jacobian}),
}


def system_of(way="free", method="rk4", dt=DT, h=seen, **options):
    rate, m, given = RATES[way]
    return qpmhe.System.from_ode(
        rate, h, dt=dt, n=2, p=2, m=m, method=method, **given, **options
    )


# The model


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("way", RATES)
def test_the_timed_system_is_the_one_of_that_step(way, method):
    timed = system_of(way, method).timed
    m = RATES[way][1]
    assert (timed.n, timed.p, timed.m) == (2, 2, m + 1)
    generator = np.random.default_rng(2)
    x, u = generator.uniform(-1.0, 1.0, (len(LENGTHS), 2)), generator.standard_normal((4, m))
    extended = np.column_stack([u, LENGTHS])
    rtol = 1e-6 if "looped" in way and "given" not in way else 1e-12
    together = {
        name: np.asarray(getattr(timed, name).batch(x, extended))
        for name in ("f", "h", "f_jacobian", "h_jacobian")
    }
    for i, dt in enumerate(LENGTHS):
        single = system_of(way, method, dt=dt)
        for name, values in together.items():
            expected = np.asarray(getattr(single, name)(x[i], u[i]))
            found = np.asarray(getattr(timed, name)(x[i], extended[i]))
            tolerance = rtol if "jacobian" in name else 1e-12
            np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)
            np.testing.assert_allclose(values[i], expected, rtol=tolerance, atol=tolerance)


def test_the_timed_system_is_made_once_and_keeps_the_sets():
    box = qpmhe.Box([-9.0, -9.0], [9.0, 9.0])
    system = system_of(states=box, disturbances=box, noises=box)
    assert system.dt == DT
    assert system.timed is system.timed
    timed = system.timed
    assert timed.states is timed.disturbances is timed.noises is box


@pytest.mark.parametrize(
    "h",
    [
        pytest.param(lambda x, u: seen(x) * u[..., :1], id="batched"),
        pytest.param(lambda x, u: [u[0] * s for s in seen(x)], id="list"),
        pytest.param(
            lambda x, u: [float(u[0]) * (x[0] + 0.1 * math.pow(x[1], 2)), u[0] * x[1]], id="math"
        ),
    ],
)
def test_outputs_of_the_timed_system_do_not_see_the_step(h):
    system = system_of("driven", h=h)
    x, u = np.array([0.5, -0.3]), np.array([2.0, 7.0])
    for dt in LENGTHS:
        extended = np.append(u, dt)
        np.testing.assert_allclose(system.timed.h(x, extended), 2.0 * seen(x), rtol=1e-13)
        found = system.timed.h.batch(np.tile(x, (3, 1)), np.tile(extended, (3, 1)))
        np.testing.assert_allclose(found, [2.0 * seen(x)] * 3, rtol=1e-13)
        np.testing.assert_allclose(
            system.timed.h_jacobian(x, extended), [[2.0, -0.12], [0.0, 2.0]], rtol=1e-6
        )


# The estimator


def step_of(way, method, u, dt):
    m = RATES[way][1]
    written = driven_rate if m else free_rate
    one = plain.euler if method == "euler" else plain.rk4
    step = one(lambda x, u: written(x, u) if m else written(x))
    return lambda x: step(x, u, dt)


def estimator(system, **options):
    cost = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost,
        **{"horizon": 4, "initial_state": [0.5, 0.0]} | options,
    )


def check_estimate(estimate, kept):
    """The window's numbers are those of the plain loops."""
    np.testing.assert_allclose(estimate.candidate, kept.candidate, rtol=1e-10, atol=1e-11)
    assert estimate.candidate_cost == pytest.approx(kept.cost(kept.candidate), rel=1e-9)
    assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-9)
    assert estimate.cost <= estimate.candidate_cost


@pytest.mark.parametrize("share", [0.3, 1.0])
@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("way", RATES)
def test_steps_of_any_length(way, method, share):
    mhe = estimator(system_of(way, method), max_qps=None)
    kept = Record(seen, GAIN, [0.5, 0.0], (P, Q, R), 4)
    generator = np.random.default_rng(3)
    m, irregular = RATES[way][1], 0
    for t in range(12):
        y, u = 0.7 * generator.standard_normal(2), 0.3 * generator.standard_normal(m)
        y[generator.random(2) < 0.1] = np.nan
        dt = generator.uniform(0.01, 0.3) if generator.random() < share else None
        irregular += dt is not None
        estimate = mhe.update(y, u if m else None, dt=dt)
        kept.push(step_of(way, method, u, DT if dt is None else dt), y)
        check_estimate(estimate, kept)
        if t in (2, 11):
            assert is_minimum(kept, estimate.trajectory, 1e-4)
    assert irregular > 0


def test_a_step_of_the_usual_length_may_be_named():
    ys = np.random.default_rng(4).standard_normal((12, 2))
    plainly, named = estimator(system_of()), estimator(system_of())
    for t, y in enumerate(ys):
        one, other = plainly.update(y), named.update(y, dt=DT if t % 3 else None)
        np.testing.assert_allclose(one.trajectory, other.trajectory, rtol=1e-9, atol=1e-10)
        assert one.cost == pytest.approx(other.cost, rel=1e-9)


@pytest.mark.parametrize("horizon", [1, 3, 70])
def test_an_irregular_step_is_forgotten_with_its_stage(horizon):
    # Across the place where the window's arrays move back to their front, too.
    mhe = estimator(system_of(), horizon=horizon)
    kept = Record(seen, GAIN, [0.5, 0.0], (P, Q, R), horizon)
    generator = np.random.default_rng(5)
    for t in range(150):
        y = 0.7 * generator.standard_normal(2)
        dt = 0.25 if t in (2, 61, 64, 66, 130) else None
        estimate = mhe.update(y, dt=dt)
        kept.push(step_of("free", "rk4", None, dt or DT), y)
        if t % 20 == 0 or 60 <= t <= 72 or 128 <= t <= 135:
            check_estimate(estimate, kept)


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_steps_of_any_length_with_every_backend(backend):
    mhe = estimator(system_of(), backend=backend, max_qps=2)
    kept = Record(seen, GAIN, [0.5, 0.0], (P, Q, R), 4)
    for t, y in enumerate(0.7 * np.random.default_rng(6).standard_normal((6, 2))):
        estimate = mhe.update(y, dt=0.05 * (t + 1))
        kept.push(step_of("free", "rk4", None, 0.05 * (t + 1)), y)
        check_estimate(estimate, kept)
        assert estimate.improved


def kalman_step(step, z, covariance, y, q, r):
    """The extended predictor, linearised by complex differences."""
    there = np.isfinite(y)
    a = plain.differences(step, z)
    c, r = plain.differences(seen, z)[there], r[np.ix_(there, there)]
    gain = a @ covariance @ c.T @ np.linalg.inv(c @ covariance @ c.T + r)
    following = a @ covariance @ a.T + q - gain @ c @ covariance @ a.T
    return step(z) + gain @ (y - seen(z))[there], following


def test_an_extended_kalman_observer_sees_both():
    observer = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=np.eye(2))
    cost = qpmhe.QuadraticCost(prior=qpmhe.ObserverPrior(), disturbance=Q, noise=R)
    mhe = qpmhe.MovingHorizonEstimator(
        system_of(), observer, cost, horizon=3, initial_state=[0.5, 0.0], max_qps=0
    )
    generator = np.random.default_rng(7)
    z, covariance = np.array([0.5, 0.0]), np.eye(2)
    for t in range(12):
        y = 0.7 * generator.standard_normal(2)
        y[generator.random(2) < 0.2] = np.nan
        dt = generator.uniform(0.05, 0.3) if t % 2 else None
        weight = spd(generator, 2) if t % 3 else None
        estimate = mhe.update(y, dt=dt, noise_weight=weight)
        r = np.eye(2) if weight is None else np.linalg.inv(weight)
        step = step_of("free", "rk4", None, dt or DT)
        z, covariance = kalman_step(step, z, covariance, y, 0.1 * np.eye(2), r)
        np.testing.assert_allclose(estimate.state, z, rtol=1e-9, atol=1e-10)


# Noises of their own


@pytest.mark.parametrize(("missing", "discount"), [(0.0, 1.0), (0.4, 1.0), (0.4, 0.8)])
@pytest.mark.parametrize("horizon", [1, 4, 70])
def test_noise_weights_of_single_samples(horizon, discount, missing):
    system = system_of()
    cost = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R, discount=discount)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost, horizon=horizon, initial_state=[0.5, 0.0],
        max_qps=2,
    )
    kept = Record(seen, GAIN, [0.5, 0.0], (P, Q, R), horizon, discount=discount)
    generator = np.random.default_rng(8)
    for t in range(145):
        y = 0.7 * generator.standard_normal(2)
        y[generator.random(2) < missing] = np.nan
        weight = 5.0 * spd(generator, 2) if t % 7 in (0, 3) else None
        estimate = mhe.update(y, noise_weight=weight)
        kept.push(step_of("free", "rk4", None, DT), y, weight)
        if t < 12 or t % 35 == 0 or 63 <= t <= 72:
            check_estimate(estimate, kept)


def test_the_estimate_follows_the_weight_of_the_sample():
    system = qpmhe.System(lambda x: x, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1e9, noise=1.0)
    for weight in (1e-3, 1.0, 50.0):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.0]), cost, horizon=3, initial_state=[0.0]
        )
        mhe.update([1.0])
        found = mhe.update([4.0], noise_weight=weight).state[0]
        assert found == pytest.approx((1.0 + 4.0 * weight) / (2.0 + weight), rel=1e-6)


@pytest.mark.parametrize("kind", ["vector", "scalar", "list"])
def test_a_noise_weight_of_one_output_may_be_a_scalar(kind):
    weight = {"vector": np.array([[3.0]]), "scalar": 3.0, "list": [[3.0]]}[kind]
    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.0]), cost, horizon=3, initial_state=[0.0], max_qps=0
    )
    assert mhe.update([2.0], noise_weight=weight).cost == pytest.approx(12.0)


def test_the_noise_weight_is_copied():
    weight = 2.0 * np.eye(2)
    mhe = estimator(system_of(), max_qps=0)
    first = mhe.update([1.0, 1.0], noise_weight=weight).cost
    weight[:] = 1e6 * np.eye(2)
    again = estimator(system_of(), max_qps=0)
    assert again.update([1.0, 1.0], noise_weight=2.0 * np.eye(2)).cost == first
    assert mhe.update([np.nan, np.nan]).cost == again.update([np.nan, np.nan]).cost


def test_a_robust_loss_takes_the_weight_of_the_sample():
    cost = qpmhe.RobustCost(prior=P, disturbance=Q, noise=qpmhe.Huber(R, 0.5))
    mhe = qpmhe.MovingHorizonEstimator(
        system_of(), qpmhe.Luenberger(GAIN), cost, horizon=4, initial_state=[0.5, 0.0], max_qps=3
    )
    kept = Record(
        seen, GAIN, [0.5, 0.0], (P, Q, R), 4,
        losses=(plain.quadratic, plain.quadratic, plain.huber(0.5)),
    )
    generator = np.random.default_rng(9)
    for t in range(12):
        y, weight = generator.standard_normal(2), spd(generator, 2) if t % 2 else None
        y[generator.random(2) < 0.2] = np.nan
        estimate = mhe.update(y, noise_weight=weight)
        kept.push(step_of("free", "rk4", None, DT), y, weight)
        check_estimate(estimate, kept)
        assert estimate.improved
