"""Observers that run side by side give the same re-initialised candidate as a full replay."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.estimation.running import RunningObservers
from qpmhe.observers import Sample

from .plain import spd
from .test_interrupts import Interruption
from .untraced import untraced

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
DT = 0.1
ROUNDING = 1e-12


def random_system(generator, way, sets):
    """A contracting system: an ODE, or the same step as a discrete one."""
    n, p, m = (int(generator.integers(low, 4)) for low in (1, 1, 0))
    a, b = 0.2 * generator.standard_normal((n, n)), generator.standard_normal((n, m))
    c = generator.standard_normal((p, n))

    def rate(x, *u):
        value = np.tanh(x @ a.T) - 0.8 * x
        return value + u[0] @ b.T if m else value

    def step(x, *u):
        return x + DT * rate(x, *u)

    def looped(x, *u):
        return [float(entry) + 0.01 * math.sin(x[0]) for entry in rate(x, *u)]

    def columns(x, *u):
        value = np.tanh(np.dot(a, x)) - 0.8 * x
        return value + np.dot(b, u[0]) if m else value

    def taking(function):
        return (lambda x, u: function(x, u)) if m else (lambda x: function(x))

    def h(x):
        return x @ c.T + 0.3 * np.sin(x @ c.T)

    box = qpmhe.Box(-generator.uniform(0.02, 0.3, n), generator.uniform(0.02, 0.3, n))
    rows = np.vstack((generator.standard_normal((2, n)), np.eye(n), -np.eye(n)))
    polytope = qpmhe.Polytope(rows, generator.uniform(0.02, 0.3, len(rows)))
    states = {"free": None, "box": box, "polytope": polytope}[sets]
    if way == "discrete":
        return qpmhe.System(taking(step), h, n=n, p=p, m=m, states=states)
    return qpmhe.System.from_ode(
        taking({"rows": rate, "columns": columns, "looped": looped}[way]), h,
        dt=DT, n=n, p=p, m=m, states=states,
    )


def random_cost(generator, system, robust, discount):
    prior, disturbance = spd(generator, system.n), 9.0 * spd(generator, system.n)
    noise = spd(generator, system.p)
    if robust:
        return qpmhe.RobustCost(
            prior=prior, disturbance=disturbance, noise=qpmhe.Huber(noise), discount=discount
        )
    return qpmhe.QuadraticCost(
        prior=prior, disturbance=disturbance, noise=noise, discount=discount
    )


def random_sample(generator, system, wild=0.25):
    y = generator.standard_normal(system.p) * (8.0 if generator.random() < wild else 0.5)
    y[generator.random(system.p) < 0.15] = np.nan
    own = {}
    if generator.random() < 0.2:
        own["noise_weight"] = spd(generator, system.p)
    if system.make_timed is not None and generator.random() < 0.2:
        own["dt"] = generator.uniform(0.02, 0.2)
    return [y, generator.standard_normal(system.m)] if system.m else [y], own


def estimator(system, gain, cost, horizon, **options):
    metric = options.pop("metric", None)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(gain, metric=metric), cost, candidate="reinitialized",
        horizon=horizon, initial_state=np.zeros(system.n), **options,
    )


def load(mhe, state, replays=False):
    """Load a state, from which observers are restarted; or leave all to `Window.replay`."""
    mhe.load_state_dict(state)
    if replays:
        mhe._engine._window._observers = None
    return mhe


def watched(mhe):
    """Whether each step's candidate came from running observers: filled as it goes on."""
    window, found = mhe._engine._window, []
    follow, replay = window._follow, window.replay
    window._follow = lambda estimates: found.append(True) or follow(estimates)
    window.replay = lambda steps, state=None: (
        found.append(False) if state is not None else None
    ) or replay(steps, state)
    return found


def data(mhe):
    """All numbers of a window that a step may use."""
    window = mhe._engine._window
    arrays = window._copies()
    if not mhe._engine._with_terms:
        arrays = {k: v for k, v in arrays.items() if k not in window.terms.names}
        arrays["residuals"] = window.residuals.copy()
    return list(arrays.values())


def results(estimate):
    names = ("trajectory", "candidate", "filtered", "disturbances", "noises", "cost")
    return [np.array(getattr(estimate, name)) for name in names] + [
        estimate.candidate_cost, estimate.status.value, estimate.qps
    ]


def assert_same(mhe, estimate, other, expected):
    for one, two in zip(results(estimate), results(expected), strict=True):
        np.testing.assert_array_equal(one, two)
    for one, two in zip(data(mhe), data(other), strict=True):
        np.testing.assert_array_equal(one, two)
    assert estimate.message == expected.message


def assert_same_failures(mhe, other):
    """Of all observers, once there are N."""
    one, two = mhe._engine._window, other._engine._window
    if one.length == one.horizon:
        np.testing.assert_array_equal(one._observers.failed, two._observers.failed)


def assert_close(mhe, estimate, other, expected):
    """Equal up to the rounding of sums, as a share of the terms in them."""
    differences = "finite differences" in mhe._own_system.derivatives.values()
    rounding = 1e-9 if differences else ROUNDING
    size = 1.0 + np.abs(expected.candidate).max() ** 2
    for one, two in zip(data(mhe), data(other), strict=True):
        scale = np.abs(two).max(initial=0.0) if two.dtype == np.float64 else 0.0
        np.testing.assert_allclose(one, two, rtol=rounding, atol=rounding * (size + scale))
    assert mhe._engine._window.events == other._engine._window.events
    assert estimate.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-11, abs=1e-11)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("sets", ["free", "box", "polytope"])
@pytest.mark.parametrize("way", ["rows", "columns", "looped", "discrete"])
def test_the_candidate_is_that_of_a_replay(way, sets, seed):
    generator = np.random.default_rng(seed)
    system = random_system(generator, way, sets)
    robust = generator.random() < 0.3
    cost = random_cost(generator, system, robust, generator.choice([1.0, 0.9]))
    gain = 0.3 * np.linalg.pinv(system.h_jacobian(np.zeros(system.n), np.zeros(system.m)))
    options = {
        "horizon": int(generator.choice([1, 2, 4, 7])),
        "max_qps": [0, 1, None][seed % 3], "warm_start": bool(seed % 2),
        "metric": spd(generator, system.n) if generator.random() < 0.5 else None,
    }
    mhe, full, resumed = (estimator(system, gain, cost, **options) for _ in range(3))
    came, projected = watched(mhe), False
    for t in range(24):
        state = mhe.state_dict()
        load(full, state, replays=True)
        resumed.state_dict()  # in which solvers forget
        if generator.random() < 0.4:
            load(resumed, state)
        arguments, own = random_sample(generator, system)
        estimate, again, expected = (
            one.update(*arguments, **own) for one in (mhe, resumed, full)
        )
        assert_same(mhe, estimate, resumed, again)
        assert_close(mhe, estimate, full, expected)
        projected = projected or Status.OBSERVER_PROJECTED in estimate.status
        if generator.random() < 0.2:
            time = t - int(generator.integers(0, mhe._engine.length))
            late = generator.standard_normal(system.p)
            assert_same(mhe, mhe.amend(time, late), resumed, resumed.amend(time, late))
    assert all(came[1:])
    assert len(came) == 24 + (not came[0])
    assert projected or sets == "free"


def test_one_call_of_the_model_advances_all_observers():
    calls = []

    def f(x):
        calls.append(x.shape)
        return 0.9 * x

    system = qpmhe.System(
        untraced(f), lambda x: np.sin(x), n=2, p=2,
        f_jacobian=lambda x: np.broadcast_to(0.9 * np.eye(2), (*x.shape[:-1], 2, 2)),
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(2))
    mhe = estimator(system, 0.2 * np.eye(2), cost, 20, max_qps=0)
    for t in range(50):
        calls.clear()
        mhe.update([0.1 * t, 1.0])
        assert calls == [(20, 2)]


@pytest.mark.parametrize("sets", ["free", "box"])
def test_another_sample_after_an_interrupt(sets):
    generator = np.random.default_rng(1)
    system = random_system(generator, "discrete", sets)
    cost = random_cost(generator, system, False, 1.0)
    gain = 0.3 * np.linalg.pinv(system.h_jacobian(np.zeros(system.n), np.zeros(system.m)))
    mhe, twin = (estimator(system, gain, cost, 3, max_qps=0) for _ in range(2))
    interrupts = 0
    for _ in range(15):
        for after in generator.integers(1, 250, 8):
            arguments, own = random_sample(generator, system)
            with Interruption(after) as interruption:
                try:
                    mhe.update(*arguments, **own)
                except KeyboardInterrupt:
                    interrupts += 1
                else:  # it was done before
                    assert interruption.count < after
                    twin.update(*arguments, **own)
        arguments, own = random_sample(generator, system)
        assert_same(mhe, mhe.update(*arguments, **own), twin, twin.update(*arguments, **own))
    assert interrupts > 40


# Where the model, an observer or the cost fails


def root_or_nan(x):
    return 0.9 * np.sqrt(x) + 0.1


def root_or_raise(x):
    return [0.9 * math.sqrt(x[0]) + 0.1]


def root_jacobian(x):
    return 0.45 / np.sqrt(np.asarray(x))[..., None]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("function", [root_or_nan, root_or_raise])
@pytest.mark.parametrize("where", ["f", "h"])
def test_failures_are_those_of_a_replay(where, function, seed):
    generator = np.random.default_rng(seed)
    plain, slope = (lambda x: 0.9 * x), (lambda x: np.full((*np.shape(x), 1), 0.9))
    functions = {"f": plain, "h": plain, "f_jacobian": slope, "h_jacobian": slope}
    functions |= {where: function, f"{where}_jacobian": root_jacobian}
    system = qpmhe.System(**functions, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=2.0, noise=0.3)
    mhe, full, resumed = (
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.5]), cost, horizon=4, initial_state=[1.0], max_qps=seed % 3,
            candidate="reinitialized",
        )
        for _ in range(3)
    )
    came, failures = watched(mhe), 0
    for t in range(40):
        state = mhe.state_dict()
        load(full, state, replays=True)
        load(resumed, state)
        y = generator.normal(1.0, 0.2, 1) - 3.0 * (generator.random() < 0.15)
        if generator.random() < 0.2:
            y[0] = generator.choice([np.nan, 1e160, -np.inf])
        estimate, again, expected = (one.update(y) for one in (mhe, resumed, full))
        assert_same(mhe, estimate, resumed, again)
        assert_same_failures(mhe, resumed)
        if came[-1]:
            assert_close(mhe, estimate, full, expected)
        else:
            assert_same(mhe, estimate, full, expected)
            failures += 1
        if generator.random() < 0.2:
            time = t - int(generator.integers(0, mhe._engine.length))
            late = generator.normal(1.0, 0.2, 1)
            assert_same(mhe, mhe.amend(time, late), resumed, resumed.amend(time, late))
    assert 3 < failures < 37


def test_an_observer_that_failed_calls_the_model_where_it_works():
    calls = []

    def f(x):
        calls.append(math.sqrt(x[0]))
        return [calls[-1]]

    system = qpmhe.System(f, lambda x: x, n=1, p=1, f_jacobian=root_jacobian)
    observers = RunningObservers(np.array([[0.5]]), 3, None, None)
    counts = []
    for time, y in enumerate([-5.0, 1.0, 1.0]):
        calls.clear()
        observers.advance(time, np.ones(1), np.array([y]), Sample(system, np.zeros(0)))
        counts.append(len(calls))
    assert counts == [3, 2, 3]  # one of three raises at the second sample
    np.testing.assert_array_equal(observers.failed, [True, False, False])


def test_all_observers_forget_a_measurement_that_is_huge():
    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1e3)
    mhe, twin = (estimator(system, [0.3], cost, 3) for _ in range(2))
    came = watched(mhe)
    for t in range(8):
        y = 1e154 if t == 4 else 0.1 * t
        estimate, expected = mhe.update([y]), twin.update([y if t != 4 else None])
        np.testing.assert_allclose(estimate.candidate, expected.candidate, rtol=1e-12)
        assert estimate.status == expected.status
    assert came == [True] * 5 + [False] + [True] * 3


def test_a_metric_that_is_found_late():
    """As long as the observer's error is unstable, each window is replayed."""
    system = qpmhe.System(
        lambda x: x + 0.5 * x * (np.abs(x) < 0.5), lambda x: x, n=1, p=1,
        states=qpmhe.Box([-1.0], [1.0]), f_jacobian=lambda x: (1.0 + 0.5 * (np.abs(x) < 0.5))[
            ..., None
        ],
    )
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    mhe, full = (estimator(system, [0.2], cost, 3) for _ in range(2))
    full._engine._window._observers, came = None, watched(mhe)
    for t in range(12):
        y = np.array([0.3 + 0.1 * t])
        estimate, expected = mhe.update(y), full.update(y)
        np.testing.assert_allclose(estimate.candidate, expected.candidate, rtol=1e-12)
    assert not came[0]
    assert all(came[-3:])


def test_other_observers_are_replayed():
    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    covariances = {"prior": [[1.0]], "disturbance": [[1.0]], "noise": [[1.0]]}
    for observer in (
        qpmhe.ExtendedKalman(**covariances), qpmhe.OutputInjection(lambda z, v: 0.3 * v),
        qpmhe.SteadyStateKalman(system, [0.0], disturbance=[[1.0]], noise=[[1.0]]),
    ):
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=3, initial_state=[0.0], candidate="reinitialized"
        )
        assert mhe._engine._window._observers is None
    huge = estimator(system, [0.3], cost, 2000)
    assert huge._engine._window._observers is None
