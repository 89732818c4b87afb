"""The compiled step where samples are missing, late or irregular, and where the model fails."""

import functools

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError, ShapeError, WeightError

from .plain import spd
from .test_compiled import STEPS, both, close, estimator, input_at, made, model_of, system_of

casadi = pytest.importorskip("casadi")
pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]

Status = qpmhe.Status
WAYS = {
    "observer": {"max_qps": 0},
    "2 qps": {"max_qps": 2, "delay": 2},
    "best": {"max_qps": 1, "warm_start": True},
    "reinitialized": {"candidate": "reinitialized", "warm_start": True},
}
ways = pytest.mark.parametrize("way", WAYS)


def spoilt(model, seed, share=0.3):
    """The record with components that are missing in all sorts of ways."""
    generator = np.random.default_rng(seed)
    Y = model.Y.copy()
    for t, j in np.argwhere(generator.random(Y.shape) < share):
        Y[t, j] = generator.choice([np.nan, np.inf, -np.inf, 1e200, -1e160])
    return Y


@ways
@pytest.mark.parametrize("name", ["wide", "n=1", "inputs", "chain"])
def test_missing_samples(name, way):
    model = made(name)
    pair, Y, missing = both(model, **WAYS[way]), spoilt(model, 5), 0
    for t in range(STEPS):
        y = None if t % 11 == 7 else Y[t]
        expected, found = (one.update(y, *input_at(model, t)) for one in pair)
        close(expected, found)
        gone = np.full(model.system.p, True) if y is None else ~(np.abs(y) < 1e150)
        np.testing.assert_array_equal(np.isnan(found.noises[-1]), gone)
        assert (Status.MISSING in found.status) == gone.any()
        missing += gone.any()
    assert 0 < missing < STEPS


def test_measurements_in_other_forms():
    model = made("wide")
    for y in ([1.0, None, 0.5], (None, None, None), np.ma.array([1.0, 2.0, 0.5], mask=[0, 1, 1]),
              [1, 2, 3], np.array([1, 2, 3], np.float32), np.arange(6.0)[::2]):
        pair = both(model)
        close(*(one.update(y) for one in pair))


@ways
@pytest.mark.parametrize("name", ["wide", "n=1"])
def test_noise_weights_of_samples(name, way):
    model, generator = made(name), np.random.default_rng(2)
    pair, Y, p = both(model, **WAYS[way]), spoilt(model, 6), model.system.p
    for t in range(STEPS):
        weight = 10.0 ** generator.uniform(-2, 2) * spd(generator, p) if t % 3 else None
        close(*(one.update(Y[t], noise_weight=weight) for one in pair))


@ways
@pytest.mark.parametrize("name", ["reactor euler", "reactor rk4", "n=3"])
def test_irregular_steps(name, way):
    model, generator = made(name), np.random.default_rng(3)
    pair, usual = both(model, **WAYS[way]), model.system.dt
    for t in range(STEPS):
        dt = usual * generator.uniform(0.2, 2.0) if t % 7 in (0, 1, 4) else None
        weight = np.diag(generator.uniform(0.5, 2.0, model.system.p)) if t % 5 == 0 else None
        close(*(one.update(model.Y[t], dt=dt, noise_weight=weight) for one in pair))


@ways
@pytest.mark.parametrize("name", ["wide", "inputs", "reactor rk4"])
def test_late_measurements(name, way):
    model, generator = made(name), np.random.default_rng(4)
    pair, Y = both(model, **WAYS[way]), spoilt(model, 7, share=0.5)
    horizon, p = model.horizon, model.system.p
    for t in range(STEPS):
        close(*(one.update(Y[t], *input_at(model, t)) for one in pair))
        for _ in range(int(generator.integers(0, 3))):
            # The oldest now and then; whole, in part, not at all, or put right once more.
            late = max(0, t + 1 - horizon) if t % 4 == 0 else int(
                generator.integers(max(0, t + 1 - horizon), t + 1)
            )
            y = model.Y[late] + 0.1 * generator.standard_normal(p)
            y[generator.random(p) < 0.3] = generator.choice([np.nan, np.inf, 1e170])
            close(*(one.amend(late, y) for one in pair))
    np.testing.assert_allclose(pair[1].state, pair[0].state, rtol=1e-9)


def test_late_measurements_of_samples_with_weights_of_their_own():
    model, generator = made("wide"), np.random.default_rng(8)
    pair, Y = both(model), spoilt(model, 8, share=0.6)
    for t in range(12):
        weight = spd(generator, 3) if t % 2 else None
        close(*(one.update(Y[t], noise_weight=weight) for one in pair))
        if t >= 3:
            close(*(one.amend(t - 2, model.Y[t - 2]) for one in pair))
            close(*(one.amend(t - 3, [np.nan, 1.0, np.nan]) for one in pair))


def test_a_full_record_in_any_order():
    """Late measurements that complete a record give the estimate of the complete record."""
    model = made("inputs")
    pair, late = [estimator(model, warm_start=True) for _ in range(2)], []
    for t in range(STEPS):
        one = pair[0].update(model.Y[t], *input_at(model, t))
        other = pair[1].update(None if t % 3 else model.Y[t], *input_at(model, t))
        late += [t] * (t % 3 > 0)
        if t % 3 == 2:
            for time in reversed(late):
                other = pair[1].amend(time, model.Y[time])
            late.clear()
            np.testing.assert_allclose(other.candidate, one.candidate, rtol=1e-12, atol=1e-12)
            assert other.candidate_cost == pytest.approx(one.candidate_cost)


def test_wrong_arguments_change_nothing():
    model = made("inputs")
    spoilt_one, twin = estimator(model), estimator(model)
    calls = [
        (ShapeError, lambda m: m.update([1.0, 2.0], [0.0, 0.0])),
        (ShapeError, lambda m: m.update([1.0], [0.0])),
        (InvalidInputError, lambda m: m.update([1.0])),
        (InvalidInputError, lambda m: m.update([1.0], [0.0, 0.0], dt=0.1)),
        (WeightError, lambda m: m.update([1.0], [0.0, 0.0], noise_weight=[[-1.0]])),
        (InvalidInputError, lambda m: m.amend(99, [1.0])),
        (ShapeError, lambda m: m.run(np.zeros((5, 2)), np.zeros((5, 2)))),
        (ShapeError, lambda m: m.run(np.zeros((5, 1)), np.zeros((4, 2)))),
        (InvalidInputError, lambda m: m.run(np.zeros((5, 1)))),
    ]
    for t in range(7):
        for kind, call in calls:
            with pytest.raises(kind):
                call(spoilt_one)
            assert spoilt_one.time == t
        one, other = (m.update(model.Y[t], *input_at(model, t)) for m in (spoilt_one, twin))
        np.testing.assert_array_equal(one.trajectory, other.trajectory)
        assert one.cost == other.cost


def logarithm():
    system = system_of(
        lambda x: [0.8 * x[0] + 0.2 * casadi.log(x[1] + 1.0), 0.9 * x[1] + 0.1 * x[0]],
        lambda x: x[0], n=2,
    )
    return model_of(system, [[0.1], [0.2]], [1.0, 1.0], 5)


def roots():
    def f(x):
        upper, lower = 0.4 * casadi.sqrt(x[0]), 0.4 * casadi.sqrt(x[1])
        return [x[0] + 0.1 * (0.4 - upper), x[1] + 0.1 * (upper - lower)]

    return model_of(
        system_of(f, lambda x: casadi.sqrt(x[1]), n=2), [[0.1], [0.2]], [1.0, 1.5], 5
    )


def quotient():
    """Not finite in one output alone."""
    system = system_of(
        lambda x, u: [0.9 * x[0] + 0.1 * u[0], 0.8 * x[1] + 0.1],
        lambda x, u: [x[0] + x[1], 1.0 / (x[0] * u[0])], n=2, m=1,
    )
    return model_of(system, [[0.1, 0.0], [0.1, 0.0]], [1.0, 0.5], 3)


FRAGILE = {"logarithm": logarithm, "roots": roots, "quotient": quotient}


@functools.cache
def fragile(name):
    return FRAGILE[name]()


def outliers(model, seed):
    """The record with outliers that drive the observer out of the model's domain."""
    generator = np.random.default_rng(seed)
    Y = model.Y.copy()
    hit = generator.random(len(Y)) < 0.2
    Y[hit] += generator.choice([-40.0, 40.0, 300.0, -2000.0], (hit.sum(), 1))
    Y[generator.random(len(Y)) < 0.1, 0] = np.nan
    return Y


@pytest.mark.parametrize("horizon", [1, 2, 5])
@ways
@pytest.mark.parametrize("name", ["logarithm", "roots"])
def test_a_model_that_is_not_finite_everywhere(name, way, horizon):
    model = fragile(name)
    options = WAYS[way] | {"horizon": horizon, "delay": 1}
    held = 0
    for seed in range(4):
        pair, Y = both(model, **options), outliers(model, seed)
        for t in range(STEPS):
            expected, found = (one.update(Y[t]) for one in pair)
            # Far away from the data rounding grows from step to step.
            close(expected, found, 1e-7)
            assert np.isfinite(found.trajectory).all()
            held += not np.isfinite(found.candidate_cost)
    assert held > 3 or (way, horizon) == ("reinitialized", 1)


@ways
def test_an_input_for_which_the_model_is_not_finite(way):
    model = fragile("quotient")
    pair, flags = both(model, **WAYS[way]), []
    for t in range(STEPS):
        u = {3: 0.0, 4: np.nan, 9: np.inf, 10: 1e-320}.get(t % 12, 1.0)
        y = [0.6, np.nan] if t % 5 == 0 else [0.6, 2.0]
        expected, found = (one.update(y, [u]) for one in pair)
        close(expected, found)
        flags.append(found.status)
    assert sum(Status.MODEL_FAILED in f for f in flags) >= 4
    assert Status.MODEL_FAILED not in flags[1]


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_an_outage_longer_than_the_window(engine):
    """The observer waits where the model last worked, however long that is ago."""
    system = system_of(lambda x, u: x * u[0], lambda x, u: x, n=1, m=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5]), cost, horizon=2, initial_state=[0.0], engine=engine
    )
    for samples in (1, 2, 3, *range(60, 70), 130):
        mhe.reset()
        for _ in range(samples):
            mhe.update([5.0], [1.0])
        held = [mhe.update([5.0], [np.nan]).state[0] for _ in range(5)]
        assert held == [held[0]] * 5, samples
        assert mhe.update([5.0], [1.0]).state[0] == pytest.approx(5.0, abs=3.0)


def test_late_measurements_around_stages_where_the_model_fails():
    for name in ("logarithm", "roots"):
        model = fragile(name)
        for options in ({}, {"warm_start": True}):
            pair, Y = both(model, **options), outliers(model, 1)
            for t in range(STEPS):
                close(*(one.update(Y[t]) for one in pair), 1e-7)
                if t % 3 == 2:
                    close(*(one.amend(t - t % 2, model.Y[t]) for one in pair), 1e-7)
                    close(*(one.amend(t - 1, model.Y[t]) for one in pair), 1e-7)


KINKS = {
    "infinite slope": lambda x: [0.5 * casadi.sqrt(casadi.fabs(x[0])), 0.9 * x[1] + 0.1],
    "no slope": lambda x: [0.9 * casadi.sqrt(x[0] ** 2 + x[1] ** 2), 0.9 * x[1]],
    "absolute value": lambda x: [0.9 * casadi.fabs(x[0]), 0.9 * x[1]],
}


@pytest.mark.parametrize("name", KINKS)
def test_jacobians_that_are_not_finite_at_the_start(name):
    system = system_of(KINKS[name], lambda x: x[0] + x[1], n=2)
    model = model_of(system, [[0.1], [0.1]], [0.0, 0.0], 3)
    for options in ({"max_qps": 0}, {"max_qps": 1}):
        pair, flags = both(model, **options), []
        for t in range(12):
            expected, found = (one.update(model.Y[t]) for one in pair)
            close(expected, found, 1e-7)  # what rounding leaves of 0 has a large root
            flags.append(found.status)
        fails = name != "absolute value" and options != {"max_qps": 0}
        assert (Status.MODEL_FAILED in flags[0]) == fails
        assert Status.MODEL_FAILED not in flags[-1]


def test_a_model_that_fails_in_trials_only():
    """Full steps leave the domain, shorter ones do not."""
    system = system_of(
        lambda x: [0.9 * x[0] + 0.2 * casadi.log(x[0])], lambda x: 5.0 * casadi.log(x[0]), n=1
    )
    model = model_of(system, [[0.0]], [1.0], 2)
    pair, flags = both(model, max_qps=3), Status(0)
    for y in (0.0, -9.0, -12.0, 3.0, -20.0):
        expected, found = (one.update([y]) for one in pair)
        close(expected, found)
        flags |= found.status
    assert Status.IMPROVED in flags
    assert Status.NO_DECREASE not in flags or Status.CANDIDATE in flags
