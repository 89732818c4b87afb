"""A late measurement: afterwards all is as if it had been there from the start."""

import itertools

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

from .plain import spd

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 3)
GAIN = 0.1 * GENERATOR.standard_normal((2, 3))
C = GENERATOR.standard_normal((3, 2))
START, HORIZON, NAN = [0.5, 0.0], 4, np.nan

OBSERVERS = {
    "luenberger": qpmhe.Luenberger(GAIN),
    "injection": qpmhe.OutputInjection(lambda z, v: np.tanh(GAIN @ v) / (1.0 + z**2)),
    "kalman": qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=np.eye(3)),
}
COSTS = {
    "quadratic": qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R),
    "discounted": qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R, discount=0.8),
    "robust": qpmhe.RobustCost(prior=P, disturbance=qpmhe.Power(Q, 1.5), noise=qpmhe.Huber(R)),
    "prior of the observer": qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior(), disturbance=Q, noise=R
    ),
}


def rate(x, u):
    return np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0]) - 0.3 * x[..., 1]], axis=-1)


def seen(x):
    return x @ C.T + 0.1 * x[..., :1] ** 2


def estimator(observer="luenberger", cost="quadratic", sets=None, **options):
    system = qpmhe.System.from_ode(
        rate, seen, dt=0.2, n=2, p=3, m=1, method="euler", **(sets or {})
    )
    return qpmhe.MovingHorizonEstimator(
        system, OBSERVERS[observer], COSTS[cost],
        **{"horizon": HORIZON, "initial_state": START} | options,
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


def feed(mhe, arguments, y=None):
    of_time, u, own = arguments
    return mhe.update(of_time if y is None else y, u, **own)


def same(one, other, tolerance=0.0):
    np.testing.assert_array_equal(one.candidate, other.candidate)
    np.testing.assert_allclose(
        one.trajectory, other.trajectory, rtol=tolerance, atol=0.1 * tolerance
    )
    assert (one.time, one.dropped) == (other.time, other.dropped)
    assert one.cost == pytest.approx(other.cost, rel=1e-12 + tolerance, abs=1e-14)
    assert one.candidate_cost == pytest.approx(other.candidate_cost, rel=1e-12, abs=1e-14)
    np.testing.assert_array_equal(np.isnan(one.noises), np.isnan(other.noises))


WHOLE = (slice(None),)


def compare(times, after, record=None, first=NAN, parts=WHOLE, tolerance=0.0, **options):
    """Samples of these times come after another one, in this order, in these parts."""
    make, record = options.pop("make", estimator), record or samples(after + HORIZON + 2)
    late, prompt, estimates = make(**options), make(**options), []
    for t, arguments in enumerate(record):
        y = arguments[0].copy()
        for part in parts if t in times else ():
            y[part] = first
        one, other = feed(late, arguments, y), feed(prompt, arguments)
        if t == after:
            for when, part in itertools.product(times, parts):
                y = np.full_like(y, NAN)
                y[part] = record[when][0][part]
                one = late.amend(when, y)
                y[:] = 9.0  # what was given is copied
        if not min(times) <= t < after:
            same(one, other, tolerance)
            np.testing.assert_allclose(late.state, prompt.state, rtol=tolerance, atol=tolerance)
            estimates.append(one)
    return estimates


@pytest.mark.parametrize(("observer", "cost"), [
    (observer, cost) for observer in OBSERVERS for cost in COSTS
    if cost != "prior of the observer" or observer == "kalman"
])
def test_a_late_measurement_of_any_age_counts_bit_for_bit(observer, cost):
    for age in range(HORIZON):
        compare([6], 6 + age, observer=observer, cost=cost)
        compare([6], 6 + age, parts=(2, 1), observer=observer, cost=cost)
    # A component that is there already is replaced.
    compare([6], 8, samples(14, missing=0.0), first=5.0, observer=observer, cost=cost)


def test_a_growing_window_and_slides_to_the_front():
    for before in (1, 2, 3):
        for when in range(before):
            compare([when], before - 1, samples(8))
    for when in (63, 64, 65, 67, 131):
        for age in (0, 3):
            compare([when], when + age, samples(when + 10, missing=0.05), observer="kalman")


@pytest.mark.parametrize("cost", ["quadratic", "robust"])
def test_samples_with_steps_and_weights_of_their_own_in_any_order(cost):
    for order in ((5, 6), (6, 5)):  # sample 5 is then the oldest of the window
        compare(order, 8, samples(12, irregular=True), observer="kalman", cost=cost)


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("sets", [
    {"noises": qpmhe.Box([-1.0] * 3, [1.5] * 3)}, {"states": qpmhe.Box([-0.6] * 2, [0.6] * 2)},
])
def test_late_measurements_with_sets(sets):
    estimates = compare(
        [5], 7, samples(12, seed=5), tolerance=1e-5, sets=sets, project_observer=False
    )
    assert any(Status.CANDIDATE_OUTSIDE in one.status for one in estimates)


@pytest.mark.parametrize("hidden", [(), (0,), (0, 1), (0, 1, 2)], ids=str)
def test_nothing_new_changes_nothing(hidden):
    """Nor does a measurement that is too large to be squared."""
    record, mhe = samples(6, missing=0.0), estimator()
    record[4][0][list(hidden)] = NAN
    for arguments in record:
        before = feed(mhe, arguments)
    for nothing in (None, [None] * 3, np.full(3, NAN), [1e200, None, None]):
        after = mhe.amend(4, nothing)
        same(before, after)
        assert Status.MODEL_FAILED not in after.status
        np.testing.assert_array_equal(mhe.state, before.state)


def test_the_newest_measurement_is_still_missing_where_an_older_one_came():
    mhe = estimator()
    for arguments in samples(5, missing=0.0):
        feed(mhe, arguments)
    assert Status.MISSING in mhe.update(None, [0.0]).status
    assert Status.MISSING in mhe.amend(3, np.ones(3)).status
    assert Status.MISSING in mhe.amend(5, [1.0, None, 1.0]).status
    assert Status.MISSING not in mhe.amend(5, [None, 1.0, None]).status


def test_the_candidate_is_true_where_a_stage_of_the_window_had_failed():
    """A wild measurement leads below zero, where f has no value."""

    def failing():
        system = qpmhe.System(
            lambda x: 0.9 * np.sqrt(x), lambda x: x, n=1, p=1,
            f_jacobian=lambda x: 0.45 / np.sqrt(x)[..., None],
        )
        cost = qpmhe.QuadraticCost(prior=1.0, disturbance=2.0, noise=0.05)
        return qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.8]), cost, horizon=4, initial_state=[1.0], max_qps=2
        )

    record = [(np.array([y]), None, {}) for y in (1.0, 0.9, -3.0, *[0.8, 0.9, 0.85] * 3)]
    for age in (0, 1):
        estimates = compare([5 - age], 5, record, first=0.7, make=failing)
        # The stage that failed is in the window, and older than the newest.
        finite = [np.isfinite(one.candidate_cost) for one in estimates[-7:]]
        assert finite == [False] * 2 + [True] * 5
        assert estimates[-7].improved
