"""A late measurement: afterwards all is as if it had been there from the start."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

from .plain import Record, spd

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 3)
GAIN = 0.1 * GENERATOR.standard_normal((2, 3))
C = GENERATOR.standard_normal((3, 2))
START = [0.5, 0.0]
HORIZON = 4


def rate(x, u):
    return np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0]) - 0.3 * x[..., 1]], axis=-1)


def step(x, u, dt):
    return x + dt * rate(x, u)


def seen(x):
    return x @ C.T + 0.1 * x[..., :1] ** 2


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
CASES = [
    (observer, cost)
    for observer in OBSERVERS
    for cost in COSTS
    if cost != "prior of the observer" or observer == "kalman"
]


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
        y[generator.random(3) < missing] = np.nan
        own = {}
        if irregular and t % 2:
            own = {"dt": generator.uniform(0.1, 0.4), "noise_weight": spd(generator, 3)}
        result.append((y, generator.standard_normal(1), own))
    return result


def feed(mhe, arguments, y=None):
    of_time, u, own = arguments
    return mhe.update(of_time if y is None else y, u, **own)


# What is known of y at first, where True stands for a component that comes late.
HIDDEN = {"all": [True, True, True], "some": [False, True, True]}


def same(one, other):
    np.testing.assert_array_equal(one.candidate, other.candidate)
    np.testing.assert_array_equal(one.trajectory, other.trajectory)
    assert one.time == other.time
    assert one.cost == pytest.approx(other.cost, rel=1e-12, abs=1e-14)
    assert one.candidate_cost == pytest.approx(other.candidate_cost, rel=1e-12, abs=1e-14)
    np.testing.assert_array_equal(np.isnan(one.noises), np.isnan(other.noises))


@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("age", range(HORIZON))
@pytest.mark.parametrize(("observer", "cost"), CASES)
def test_a_late_measurement_of_any_age_counts_bit_for_bit(observer, cost, age, hidden):
    late, prompt = estimator(observer, cost), estimator(observer, cost)
    record = samples(10 + HORIZON)
    when = 6
    for t, arguments in enumerate(record):
        y = arguments[0].copy()
        if t == when:
            y[HIDDEN[hidden]] = np.nan
        first, second = feed(late, arguments, y), feed(prompt, arguments)
        if t == when + age:
            first = late.amend(when, record[when][0])
        if not when <= t < when + age:
            same(first, second)
            np.testing.assert_array_equal(late.state, prompt.state)


@pytest.mark.parametrize("samples_before", [1, 2, 3])
def test_a_growing_window(samples_before):
    record = samples(8)
    for when in range(samples_before):
        late, prompt = estimator(), estimator()
        for t, arguments in enumerate(record):
            y = np.full(3, np.nan) if t == when else None
            first, second = feed(late, arguments, y), feed(prompt, arguments)
            if t == samples_before - 1:
                first = late.amend(when, record[when][0])
            if t >= samples_before - 1:
                same(first, second)


@pytest.mark.parametrize("when", [61, 63, 64, 65, 67, 68, 131])
@pytest.mark.parametrize("age", [0, 3])
def test_late_measurements_around_the_slides_to_the_front(when, age):
    record = samples(when + HORIZON + 6, missing=0.05)
    late, prompt = estimator("kalman"), estimator("kalman")
    for t, arguments in enumerate(record):
        first = feed(late, arguments, np.full(3, np.nan) if t == when else None)
        second = feed(prompt, arguments)
        if t == when + age:
            first = late.amend(when, record[when][0])
        if t >= when + age:
            same(first, second)


@pytest.mark.parametrize("order", [(5, 6), (6, 5)])
@pytest.mark.parametrize("cost", ["quadratic", "robust"])
def test_samples_with_steps_and_weights_of_their_own(cost, order):
    late, prompt = estimator("kalman", cost), estimator("kalman", cost)
    record = samples(12, irregular=True)
    for t, arguments in enumerate(record):
        first = feed(late, arguments, np.full(3, np.nan) if t in order else None)
        second = feed(prompt, arguments)
        if t == 8:  # sample 5 is the oldest of the window
            for when in order:
                first = late.amend(when, record[when][0])
        if t >= 8:
            same(first, second)


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("sets", ["noises", "states"])
def test_late_measurements_with_sets(sets):
    given = {
        "noises": {"noises": qpmhe.Box([-1.0] * 3, [1.5] * 3)},
        "states": {"states": qpmhe.Box([-0.6, -0.6], [0.6, 0.6])},
    }[sets]
    late, prompt = (estimator(sets=given, project_observer=False) for _ in range(2))
    outside = False
    for t, arguments in enumerate(samples(12, seed=5)):
        first = feed(late, arguments, np.full(3, np.nan) if t == 5 else None)
        second = feed(prompt, arguments)
        if t == 7:
            first = late.amend(5, samples(12, seed=5)[5][0])
        if t >= 7:
            np.testing.assert_array_equal(first.candidate, second.candidate)
            np.testing.assert_allclose(first.trajectory, second.trajectory, rtol=1e-6, atol=1e-6)
            assert first.dropped == second.dropped
            outside |= qpmhe.Status.CANDIDATE_OUTSIDE in first.status
    assert outside


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_late_measurements_with_every_backend(backend):
    late, prompt = estimator(backend=backend), estimator(backend=backend)
    for t, arguments in enumerate(samples(7)):
        first = feed(late, arguments, np.full(3, np.nan) if t == 4 else None)
        second = feed(prompt, arguments)
        if t == 5:
            first = late.amend(4, samples(7)[4][0])
        if t >= 5:
            np.testing.assert_array_equal(first.candidate, second.candidate)
            np.testing.assert_allclose(first.trajectory, second.trajectory, rtol=1e-7, atol=1e-8)


def test_the_numbers_are_those_of_plain_loops():
    mhe = estimator()
    kept = Record(seen, GAIN, START, (P, Q, R), HORIZON)
    for t, arguments in enumerate(samples(9)):
        feed(mhe, arguments)
        kept.push(lambda x, u=arguments[1]: step(x, u, 0.2), arguments[0])
        if t < 3:
            continue
        for age in (0, 2, 3):
            # A component that is there already is replaced; one that is not finite stays.
            late = np.array([1.0 + age, np.nan, -0.5])
            estimate = mhe.amend(t - age, late)
            kept.amend(t - age, late)
            np.testing.assert_allclose(estimate.candidate, kept.candidate, rtol=1e-11)
            assert estimate.candidate_cost == pytest.approx(kept.cost(kept.candidate), rel=1e-10)
            assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-10)
            assert estimate.time == t
            assert mhe.time == t + 1


@pytest.mark.parametrize("nothing", [None, [None] * 3, np.full(3, np.nan)], ids=["a", "b", "c"])
def test_nothing_new_changes_nothing(nothing):
    mhe = estimator()
    for arguments in samples(6):
        before = feed(mhe, arguments)
    for when in range(2, 6):
        after = mhe.amend(when, nothing)
        same(before, after)
        np.testing.assert_array_equal(mhe.state, before.state)


@pytest.mark.parametrize("known", ["all", "two", "one", "none"])
def test_a_late_measurement_too_large_to_square_is_nothing_new(known):
    hidden = {"all": [], "two": [0], "one": [0, 1], "none": [0, 1, 2]}[known]
    record = samples(6, missing=0.0)
    record[4][0][hidden] = np.nan
    mhe = estimator()
    for arguments in record:
        before = feed(mhe, arguments)
    after = mhe.amend(4, [1e200, None, None])
    assert Status.MODEL_FAILED not in after.status
    same(before, after)


def test_components_that_come_one_by_one():
    record = samples(8, missing=0.0)
    late, prompt = estimator(), estimator()
    for t, arguments in enumerate(record):
        first = feed(late, arguments, np.full(3, np.nan) if t == 5 else None)
        second = feed(prompt, arguments)
        if t == 6:
            for j in (2, 0, 1):
                part = np.full(3, np.nan)
                part[j] = record[5][0][j]
                first = late.amend(5, part)
        if t >= 6:
            same(first, second)


def test_the_late_measurement_is_copied():
    late, prompt = estimator(), estimator()
    for t, arguments in enumerate(samples(8)):
        first = feed(late, arguments, np.full(3, np.nan) if t == 5 else None)
        second = feed(prompt, arguments)
        if t == 6:
            y = samples(8)[5][0]
            first = late.amend(5, y)
            y[:] = 9.0
        if t >= 6:
            same(first, second)


@pytest.mark.parametrize("options", [{"warm_start": True}, {"candidate": "reinitialized"}], ids=str)
def test_amended_estimators_go_on(options):
    mhe = estimator(**options)
    for t, arguments in enumerate(samples(12)):
        estimate = feed(mhe, arguments)
        if t in (3, 7):
            estimate = mhe.amend(t - 2, np.ones(3))
        assert estimate.cost <= estimate.candidate_cost
        np.testing.assert_array_equal(mhe.state, estimate.state)


# Status


def test_the_newest_measurement_is_still_missing_where_an_older_one_came():
    mhe = estimator()
    for arguments in samples(5, missing=0.0):
        feed(mhe, arguments)
    assert Status.MISSING in mhe.update(None, [0.0]).status
    assert Status.MISSING in mhe.amend(3, np.ones(3)).status
    assert Status.MISSING in mhe.amend(5, [1.0, None, 1.0]).status
    assert Status.MISSING not in mhe.amend(5, [None, 1.0, None]).status


# A stage at which the model failed


def failing():
    """An estimator whose f has no value below zero, where a wild measurement leads."""
    system = qpmhe.System(
        lambda x: 0.9 * np.sqrt(x), lambda x: x, n=1, p=1,
        f_jacobian=lambda x: 0.45 / np.sqrt(x)[..., None],
    )
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=2.0, noise=0.05)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.8]), cost, horizon=4, initial_state=[1.0], max_qps=2
    )


def check_candidate(estimate, ys):
    """Its cost, while finite, is that of the residuals along it."""
    z = estimate.candidate[:, 0]
    total = 0.0
    with np.errstate(invalid="ignore"):
        for i, y in enumerate(ys[estimate.time + 1 - len(z[1:]) : estimate.time + 1]):
            total += 2.0 * (z[i + 1] - 0.9 * np.sqrt(z[i])) ** 2 + 0.05 * (y - z[i]) ** 2
    if np.isfinite(estimate.candidate_cost):
        assert estimate.candidate_cost == pytest.approx(total, rel=1e-10)
    return np.isfinite(estimate.candidate_cost)


@pytest.mark.parametrize("age", [0, 1])
def test_the_candidate_is_true_where_a_stage_of_the_window_had_failed(age):
    mhe = failing()
    ys = [1.0, 0.9, -3.0, 0.8, 0.9, 0.8, 0.85, 0.9, 0.8, 0.9, 0.95, 0.9]
    finite, failed = [], []
    for t, y in enumerate(ys):
        estimate = mhe.update([y])
        finite.append(check_candidate(estimate, ys))
        failed.append(Status.MODEL_FAILED in estimate.status)
        if t == 5:
            # The stage that failed is in the window, and older than the newest.
            assert failed == [False, False, False, True, False, False]
            ys[t - age] += 0.02
            late = mhe.amend(t - age, [ys[t - age]])
            assert late.improved
            check_candidate(late, ys)
    assert finite == [True] * 3 + [False] * 4 + [True] * 5
