"""Observers that run side by side give the same re-initialised candidate as a full replay."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

from .plain import spd
from .same import assert_same
from .untraced import untraced

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
DT = 0.1


def root_or_raise(x):
    return [0.9 * math.sqrt(x[0]) + 0.1]


def root_jacobian(x):
    return 0.45 / np.sqrt(np.asarray(x))[..., None]


# Of f or of h: where x is negative, they return NaN or raise.
ROOTS = {"nan": lambda x: 0.9 * np.sqrt(x) + 0.1, "raise": root_or_raise}


def failing_system(way):
    where, how = way.split()
    functions = {"f": lambda x: 0.9 * x, "h": lambda x: 0.9 * x}
    slopes = {f"{k}_jacobian": lambda x: np.full((*np.shape(x), 1), 0.9) for k in functions}
    functions |= {where: ROOTS[how]}
    return qpmhe.System(**functions, **slopes | {f"{where}_jacobian": root_jacobian}, n=1, p=1)


def random_system(generator, way, sets):
    """A contracting system: an ODE, or the same step as a discrete one."""
    n, p, m = (int(generator.integers(low, 4)) for low in (1, 1, 1))
    a, b = 0.2 * generator.standard_normal((n, n)), generator.standard_normal((n, m))
    c = generator.standard_normal((p, n))

    def rate(x, u):
        return np.tanh(x @ a.T) - 0.8 * x + u @ b.T

    def h(x):
        return x @ c.T + 0.3 * np.sin(x @ c.T)

    rows = np.vstack((generator.standard_normal((2, n)), np.eye(n), -np.eye(n)))
    options = {"n": n, "p": p, "m": m, "states": {
        "free": None,
        "box": qpmhe.Box(-generator.uniform(0.02, 0.3, n), generator.uniform(0.02, 0.3, n)),
        "polytope": qpmhe.Polytope(rows, generator.uniform(0.02, 0.3, len(rows))),
    }[sets]}
    if way == "discrete":
        return qpmhe.System(lambda x, u: x + DT * rate(x, u), h, **options)
    if way == "looped":
        return qpmhe.System.from_ode(
            lambda x, u: [float(s) + 0.01 * math.sin(x[0]) for s in rate(x, u)], h, dt=DT, **options
        )
    return qpmhe.System.from_ode(rate, h, dt=DT, **options)


def random_cost(generator, system, robust=False):
    weights = {
        "prior": spd(generator, system.n), "disturbance": 9.0 * spd(generator, system.n),
        "noise": spd(generator, system.p), "discount": generator.choice([1.0, 0.9]),
    }
    if robust:
        return qpmhe.RobustCost(**weights | {"noise": qpmhe.Huber(weights["noise"])})
    return qpmhe.QuadraticCost(**weights)


def random_sample(generator, system, failing=False):
    if failing:
        y = generator.normal(1.0, 0.2, 1) - 3.0 * (generator.random() < 0.15)
        if generator.random() < 0.2:
            y[0] = generator.choice([np.nan, 1e160, -np.inf])
        return [y], {}
    y = generator.standard_normal(system.p) * (8.0 if generator.random() < 0.25 else 0.5)
    y[generator.random(system.p) < 0.15] = np.nan
    own = {}
    if generator.random() < 0.2:
        own["noise_weight"] = spd(generator, system.p)
    if system.make_timed is not None and generator.random() < 0.2:
        own["dt"] = generator.uniform(0.02, 0.2)
    return [y, generator.standard_normal(system.m)], own


def estimator(system, gain, cost, horizon, metric=None, **options):
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(gain, metric=metric), cost, candidate="reinitialized",
        horizon=horizon, **{"initial_state": np.zeros(system.n)} | options,
    )


def replaying(mhe):
    """The same estimator, which replays each window."""
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


def assert_close(mhe, estimate, expected):
    """Equal up to the rounding of sums, as a share of the terms in them."""
    differences = "finite differences" in mhe._own_system.derivatives.values()
    size = 1.0 + np.abs(expected.candidate).max() ** 2
    np.testing.assert_allclose(
        estimate.candidate, expected.candidate, rtol=0, atol=(1e-9 if differences else 1e-12) * size
    )
    assert estimate.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-11, abs=1e-11)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("way", "sets"),
    [
        ("rows", "box"), ("rows", "free"), ("looped", "polytope"), ("discrete", "box"),
        ("f nan", "free"), ("f raise", "free"), ("h nan", "free"), ("h raise", "free"),
    ],
)
def test_the_candidate_is_that_of_a_replay(way, sets, seed):
    generator, failing = np.random.default_rng(seed), " " in way
    system = failing_system(way) if failing else random_system(generator, way, sets)
    cost, start = random_cost(generator, system, seed == 1), np.full(system.n, float(failing))
    gain = 0.3 * np.linalg.pinv(system.h_jacobian(start, np.zeros(system.m)))
    if failing:
        gain, cost = [[0.5]], qpmhe.QuadraticCost(prior=1.0, disturbance=2.0, noise=0.3)
    options = {
        "horizon": 4 if failing else int(generator.choice([1, 2, 4, 7])), "initial_state": start,
        "max_qps": [0, 1, None][seed % 3], "warm_start": bool(seed % 2),
        "metric": spd(generator, system.n) if generator.random() < 0.5 else None,
    }
    mhe, full, resumed = (estimator(system, gain, cost, **options) for _ in range(3))
    came, events = watched(mhe), Status(0)
    for t in range(24):
        state = mhe.state_dict()
        full.load_state_dict(state)
        replaying(full)
        resumed.state_dict()  # in which solvers forget
        if failing or generator.random() < 0.4:
            resumed.load_state_dict(state)
        arguments, own = random_sample(generator, system, failing)
        estimate, again, expected = (
            one.update(*arguments, **own) for one in (mhe, resumed, full)
        )
        assert_same(estimate, again)
        if came[-1]:
            assert_close(mhe, estimate, expected)
        else:
            assert_same(estimate, expected)
        assert estimate.message == again.message
        events |= estimate.status
        if generator.random() < 0.2:
            time = t - int(generator.integers(0, mhe._engine.length))
            late = start[:1] + 0.2 * generator.standard_normal(system.p)
            assert_same(mhe.amend(time, late), resumed.amend(time, late))
    if failing:
        assert 0 < came.count(False) < 23
    else:
        assert all(came[1:])
        assert Status.OBSERVER_PROJECTED in events or sets == "free"


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
        states=qpmhe.Box([-1.0], [1.0]),
        f_jacobian=lambda x: (1.0 + 0.5 * (np.abs(x) < 0.5))[..., None],
    )
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    mhe, full = (estimator(system, [0.2], cost, 3) for _ in range(2))
    replaying(full)
    came = watched(mhe)
    for t in range(12):
        y = np.array([0.3 + 0.1 * t])
        estimate, expected = mhe.update(y), full.update(y)
        np.testing.assert_allclose(estimate.candidate, expected.candidate, rtol=1e-12)
    assert not came[0]
    assert all(came[-3:])
