"""A late measurement: afterwards all is as if it had been there from the start."""

import itertools

import numpy as np
import pytest

import qpmhe

from .plain import spd

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 3)
GAIN = 0.1 * GENERATOR.standard_normal((2, 3))
C = GENERATOR.standard_normal((3, 2))
HORIZON, NAN, WHOLE = 4, np.nan, (slice(None),)
LUENBERGER = qpmhe.Luenberger(GAIN)
KALMAN = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=np.eye(3))
QUADRATIC = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R, discount=0.8)
ROBUST = qpmhe.RobustCost(prior=P, disturbance=qpmhe.Power(Q, 1.5), noise=qpmhe.Huber(R))
OF_OBSERVER = qpmhe.QuadraticCost(prior=qpmhe.ObserverPrior(), disturbance=Q, noise=R)
PAIRS = [(LUENBERGER, ROBUST), (LUENBERGER, QUADRATIC), (KALMAN, OF_OBSERVER)]


def rate(x, u):
    return np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0]) - 0.3 * x[..., 1]], axis=-1)


def seen(x):
    return x @ C.T + 0.1 * x[..., :1] ** 2


def estimator(observer=LUENBERGER, cost=QUADRATIC):
    system = qpmhe.System.from_ode(rate, seen, dt=0.2, n=2, p=3, m=1, method="euler")
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=HORIZON, initial_state=[0.5, 0.0]
    )


def samples(count, missing=0.2, irregular=False, seed=2):
    """Arguments of the updates: some outputs missing, every other step of its own kind."""
    generator, result = np.random.default_rng(seed), []
    for t in range(count):
        y = generator.standard_normal(3)
        y[generator.random(3) < missing] = NAN
        own = {}
        if irregular and t % 2:
            own = {"dt": generator.uniform(0.1, 0.4), "noise_weight": spd(generator, 3)}
        result.append((y, generator.standard_normal(1), own))
    return result


def same(one, other):
    np.testing.assert_array_equal(one.candidate, other.candidate)
    np.testing.assert_array_equal(one.trajectory, other.trajectory)
    assert one.time == other.time
    assert one.cost == pytest.approx(other.cost, rel=1e-12, abs=1e-14)
    assert one.candidate_cost == pytest.approx(other.candidate_cost, rel=1e-12, abs=1e-14)
    np.testing.assert_array_equal(np.isnan(one.noises), np.isnan(other.noises))


def compare(times, after, record=None, first=NAN, parts=WHOLE, **options):
    """Samples of these times come after another one, in this order, in these parts."""
    record = record or samples(after + HORIZON + 2)
    late, prompt = estimator(**options), estimator(**options)
    for t, (of_time, u, own) in enumerate(record):
        y = of_time.copy()
        for part in parts if t in times else ():
            y[part] = first
        one, other = late.update(y, u, **own), prompt.update(of_time, u, **own)
        if t == after:
            for when, part in itertools.product(times, parts):
                y = np.full_like(y, NAN)
                y[part] = record[when][0][part]
                one = late.amend(when, y)
                y[:] = 9.0  # what was given is copied
        if not min(times) <= t < after:
            same(one, other)
            np.testing.assert_array_equal(late.state, prompt.state)


@pytest.mark.parametrize(
    ("observer", "cost"), PAIRS, ids=["robust", "quadratic", "observer prior"]
)
def test_a_late_measurement_of_any_age_counts_bit_for_bit(observer, cost):
    parts = {"observer": observer, "cost": cost}
    for age in range(HORIZON):
        compare([6], 6 + age, **parts)
        compare([6], 6 + age, parts=(2, 1), **parts)
    # A component that is there already is replaced.
    compare([6], 8, samples(14, missing=0.0), first=5.0, **parts)
    for order in ((5, 6), (6, 5)):  # sample 5 is then the oldest of the window
        compare(order, 8, samples(12, irregular=True), **parts)


def test_a_growing_window_and_slides_to_the_front():
    for before in (1, 2, 3):
        for when in range(before):
            compare([when], before - 1, samples(8))
    for when in (63, 65, 67):
        compare([when], when + when % 4, samples(when + 10, missing=0.05), observer=KALMAN)
