"""Models in jax.numpy against the same models in NumPy."""

import math
import pickle
import sys
import threading
from functools import cache

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError

jax = pytest.importorskip("jax")
jnp = jax.numpy

from qpmhe import from_jax  # noqa: E402

NONE = np.zeros(0)


# Models, for NumPy over (..., n) and for JAX at one state: np or jnp comes as the first argument


def reactor_rate(xp, x):
    reaction = 0.16 * x[..., 0] ** 2 - 0.64 * x[..., 1]
    return xp.stack([-2.0 * reaction, reaction], axis=-1)


def reactor_output(xp, x):
    return x[..., :1] + x[..., 1:]


def cart_rate(xp, x, u):
    # Position, velocity, angle from the top, its rate; u is the force.
    angle, spin, force = x[..., 2], x[..., 3], u[..., 0]
    sine, cosine = xp.sin(angle), xp.cos(angle)
    mass = 1.0 + 0.2 * sine**2
    push = (force + 0.2 * sine * (0.5 * spin**2 - 9.81 * cosine)) / mass
    turn = (9.81 * sine * 1.2 - cosine * (force + 0.1 * spin**2 * sine)) / (0.5 * mass)
    return xp.stack([x[..., 1], push, spin, turn], axis=-1)


def cart_output(xp, x, u):
    return xp.stack([x[..., 0] + 0.01 * u[..., 0], xp.sin(x[..., 2])], axis=-1)


def vehicle_rate(xp, x, u):
    # Kinematic bicycle: position, heading, speed; u is steering angle and acceleration.
    slip = xp.arctan(0.5 * xp.tan(u[..., 0]))
    heading, speed = x[..., 2] + slip, x[..., 3]
    return xp.stack(
        [
            speed * xp.cos(heading), speed * xp.sin(heading), speed * xp.sin(slip) / 1.5,
            u[..., 1] - 0.05 * speed * xp.sqrt(1.0 + speed**2),
        ],
        axis=-1,
    )


def vehicle_output(xp, x):
    return xp.stack([x[..., 0], x[..., 1], x[..., 3]], axis=-1)


INWARD = np.random.default_rng(1).standard_normal((24, 7)) / 3.0
ONWARD = np.random.default_rng(2).standard_normal((24, 24)) / 5.0
OUTWARD = np.random.default_rng(3).standard_normal((6, 24)) / 5.0


def network(xp, x, u):
    # Thousands of operations at a state.
    full = xp.concatenate([x, u], axis=-1)
    return 0.9 * x + xp.tanh(xp.tanh(full @ INWARD.T) @ ONWARD.T) @ OUTWARD.T


def network_output(xp, x):
    return x[..., :2] * x[..., 2:4]


def chain(xp, x):
    # Many states, few operations at each.
    return 0.9 * x + 0.1 * x**2 * xp.roll(x, 1, axis=-1)


def chain_output(xp, x):
    return x[..., 1:3]


MODELS = {
    # f, h, sizes, gain of a Luenberger observer, initial state
    "reactor": (reactor_rate, reactor_output, (2, 1, 0), [[0.05], [0.05]], [3.0, 0.0]),
    "cart": (
        cart_rate, cart_output, (4, 2, 1),
        [[0.3, 0.0], [0.5, 0.1], [0.0, 0.4], [0.0, 1.5]], [0.1, 0.0, 0.2, 0.0],
    ),
    "vehicle": (
        vehicle_rate, vehicle_output, (4, 3, 2),
        [[0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.05, 0.0], [0.1, 0.0, 0.3]],
        [0.0, 0.0, 0.1, 2.0],
    ),
    "network": (
        network, network_output, (6, 2, 1), np.full((6, 2), 0.01), [0.5, -0.2, 0.4, 0.9, 0.0, 0.1]
    ),
    "chain": (chain, chain_output, (12, 2, 0), np.full((12, 2), 0.05), np.linspace(-1.0, 1.0, 12)),
}
WAYS = [
    ("reactor", "euler"), ("reactor", "rk4"), ("reactor", None), ("cart", "euler"),
    ("cart", "rk4"), ("vehicle", "rk4"), ("network", None), ("network", "rk4"),
    ("chain", None),
]
DT = 0.05


def at_one_state(function, xp):
    # With as many arguments as the model has; what JAX traces has exactly one dimension.
    if function.__code__.co_argcount == 2:
        return lambda x: function(xp, x)
    return lambda x, u: function(xp, x, u)


@cache
def by_jax(name, method=None):
    f, h, (n, p, m), *_ = MODELS[name]
    timing = {} if method is None else {"dt": DT, "method": method}
    return from_jax(at_one_state(f, jnp), at_one_state(h, jnp), n=n, p=p, m=m, **timing)


@cache
def by_numpy(name, method=None, dt=DT):
    f, h, (n, p, m), *_ = MODELS[name]
    f, h, sizes = at_one_state(f, np), at_one_state(h, np), {"n": n, "p": p, "m": m}
    if method is None:
        return qpmhe.System(f, h, **sizes)
    return qpmhe.System.from_ode(f, h, dt=dt, method=method, **sizes)


FUNCTIONS = ("f", "h", "f_jacobian", "h_jacobian")


def check_functions(found, expected, x, u, tolerance=1e-12):
    assert found.f.mode == found.h.mode == "batched"
    for name in FUNCTIONS:
        one, other = getattr(found, name), getattr(expected, name)
        batch = other.batch(x, u)
        scale = 1.0 + np.abs(batch).max(initial=0.0)
        assert one.batch(x, u).shape == batch.shape
        assert one.batch(x, u).dtype == np.float64
        np.testing.assert_allclose(one.batch(x, u), batch, rtol=0, atol=tolerance * scale)
        for i in range(min(3, len(x))):
            np.testing.assert_allclose(
                one(x[i], u[i]), other(x[i], u[i]), rtol=0, atol=tolerance * scale
            )


# Values and Jacobians


@pytest.mark.parametrize(("name", "method"), WAYS)
def test_functions_and_jacobians_are_those_of_numpy(name, method):
    system, twin = by_jax(name, method), by_numpy(name, method)
    assert twin.f_jacobian.method == "complex step"
    assert (system.f_jacobian.method, system.h_jacobian.method) == ("jax", "jax")
    assert (system.n, system.p, system.m) == (twin.n, twin.p, twin.m)
    generator = np.random.default_rng(4)
    for size in (1, 2, 7, 15, 16, 17, 33):
        x = generator.uniform(-2.0, 2.0, (size, twin.n))
        check_functions(system, twin, x, generator.uniform(-0.5, 0.5, (size, twin.m)))


def test_leading_dimensions_and_empty_batches():
    system, twin = by_jax("cart", "rk4"), by_numpy("cart", "rk4")
    generator = np.random.default_rng(5)
    x, u = generator.standard_normal((2, 3, 4)), generator.standard_normal((2, 3, 1))
    for name in FUNCTIONS:
        expected = getattr(twin, name).batch(x, u)
        found = getattr(system, name).batch(x, u)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
        empty = getattr(system, name).batch(np.empty((0, 4)), np.empty((0, 1)))
        assert empty.shape == (0, *expected.shape[2:])


def test_arrays_of_any_layout_and_integers():
    system = by_jax("cart", "rk4")
    generator = np.random.default_rng(6)
    x, u = generator.integers(-3, 3, (5, 4)), generator.integers(-3, 3, (5, 1))
    for name in FUNCTIONS:
        function = getattr(system, name)
        expected = function.batch(x.astype(float), u.astype(float))
        np.testing.assert_array_equal(function.batch(x, u), expected)
        scattered = np.asfortranarray(x.astype(float)), np.repeat(u, 2, axis=1)[:, ::2] * 1.0
        np.testing.assert_array_equal(function.batch(*scattered), expected)
        np.testing.assert_array_equal(function(x[0], u[0]), function(1.0 * x[0], 1.0 * u[0]))


def test_an_array_that_is_written_to_is_evaluated_anew():
    system, x, nothing = by_jax("reactor", "euler"), np.array([3.0, 1.0]), np.empty((4, 0))
    before = {name: getattr(system, name)(x, NONE) for name in FUNCTIONS}
    kept = {name: value.copy() for name, value in before.items()}
    x[:] = 1.0, 2.0
    for name in FUNCTIONS:
        fresh = getattr(system, name).batch(np.tile(x, (4, 1)), nothing)[2]
        np.testing.assert_allclose(getattr(system, name)(x, NONE), fresh, rtol=1e-15)
        # What was handed out before stays, and cannot be spoilt.
        np.testing.assert_array_equal(before[name], kept[name])
        with pytest.raises(ValueError, match="read-only"):
            before[name][...] = 0.0
    assert (system.f(x, NONE) != kept["f"]).any()


def test_batches_that_differ_in_length_only():
    system, twin = by_jax("reactor", "euler"), by_numpy("reactor", "euler")
    for size in (3, 5, 4, 16, 3):
        x = np.full((size, 2), 1.5)
        np.testing.assert_allclose(
            system.f.batch(x, np.empty((size, 0))), twin.f.batch(x, np.empty((size, 0))),
            rtol=1e-14,
        )


@pytest.mark.parametrize(
    ("f", "h"),
    [
        pytest.param(lambda x: [x[1], -jnp.sin(x[0])], lambda x: x[0], id="list, scalar"),
        pytest.param(
            jax.jit(lambda x: jnp.array([x[1], -jnp.sin(x[0])])), jax.jit(lambda x: x[:1]),
            id="jitted",
        ),
        pytest.param(
            lambda x: jnp.array([x[1], jax.lax.cond(x[0] > 0.0, lambda a: -jnp.sin(a),
                                                    lambda a: -jnp.sin(a), x[0])]),
            lambda x: jax.lax.fori_loop(0, 3, lambda i, s: s + x[:1] / 3.0, jnp.zeros(1)),
            id="control flow",
        ),
    ],
)
def test_ways_of_writing(f, h):
    system = from_jax(f, h, n=2, p=1)
    twin = qpmhe.System(
        lambda x: np.stack([x[..., 1], -np.sin(x[..., 0])], -1), lambda x: x[..., :1], n=2, p=1
    )
    x = np.random.default_rng(7).standard_normal((6, 2))
    check_functions(system, twin, x, np.empty((6, 0)))


def test_functions_that_do_not_see_the_input():
    system = from_jax(lambda x: 0.5 * x, lambda x, u: x + u, n=1, p=1, m=1)
    np.testing.assert_array_equal(system.f(np.array([3.0]), np.array([8.0])), [1.5])
    np.testing.assert_array_equal(system.h(np.array([3.0]), np.array([8.0])), [11.0])


# Whole runs


def estimators(name, method, **options):
    *_, gain, start = MODELS[name]
    pair = []
    for system in (by_jax(name, method), by_numpy(name, method)):
        n, p = system.n, system.p
        cost = qpmhe.QuadraticCost(
            prior=np.eye(n), disturbance=20.0 * np.eye(n), noise=5.0 * np.eye(p)
        )
        pair.append(
            qpmhe.MovingHorizonEstimator(
                system, qpmhe.Luenberger(gain), cost, initial_state=start,
                **{"horizon": 10, **options},
            )
        )
    return pair


def measured(twin, start, steps, seed=8):
    """A noisy record of the twin from a state beside the initial estimate."""
    generator = np.random.default_rng(seed)
    x, ys, us = np.array(start) + 0.1, [], []
    for _ in range(steps):
        u = 0.3 * generator.standard_normal(twin.m)
        ys.append(twin.h(x, u) + 0.05 * generator.standard_normal(twin.p))
        us.append(u)
        x = twin.f(x, u) + 0.02 * generator.standard_normal(twin.n)
    return np.array(ys), np.array(us)


def check_runs(found, expected, ys, us, lengths=None):
    for t, (y, u) in enumerate(zip(ys, us, strict=True)):
        options = {} if lengths is None else {"dt": lengths[t]}
        one, other = (mhe.update(y, u if u.size else None, **options) for mhe in (found, expected))
        scale = 1e-9 * (1.0 + np.abs(other.trajectory).max())
        np.testing.assert_allclose(one.trajectory, other.trajectory, rtol=0, atol=scale)
        np.testing.assert_allclose(one.candidate, other.candidate, rtol=0, atol=scale)
        np.testing.assert_allclose(
            [one.cost, one.candidate_cost], [other.cost, other.candidate_cost], rtol=1e-9, atol=1e-9
        )
        assert one.cost <= one.candidate_cost
        yield one, other


@pytest.mark.parametrize("max_qps", [0, 1, 2])
@pytest.mark.parametrize(("name", "method"), WAYS)
def test_whole_runs(name, method, max_qps):
    # Beyond 16 stages, to another size of batch.
    pair = estimators(name, method, max_qps=max_qps, horizon=20)
    ys, us = measured(by_numpy(name, method), MODELS[name][-1], 30)
    improved = 0
    for one, other in check_runs(*pair, ys, us):
        assert one.status == other.status
        improved += one.improved
    assert improved >= 25 if max_qps else improved == 0


def test_a_run_to_convergence_within_sets():
    name, method = "vehicle", "rk4"
    f, h, (n, p, m), gain, start = MODELS[name]
    sets = {
        "states": qpmhe.Box([-5.0, -5.0, -3.0, 0.0], [5.0, 5.0, 3.0, 2.05]),
        # The heading follows the model without noise.
        "disturbances": qpmhe.Box([-0.1, -0.1, 0.0, -0.1], [0.1, 0.1, 0.0, 0.1]),
    }
    options = {"n": n, "p": p, "m": m, "dt": DT, **sets}
    systems = (
        from_jax(at_one_state(f, jnp), at_one_state(h, jnp), **options),
        qpmhe.System.from_ode(at_one_state(f, np), at_one_state(h, np), **options),
    )
    assert systems[0].states is sets["states"]
    cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=20.0 * np.eye(n), noise=np.eye(p))
    gain = np.array(gain)
    gain[2] = 0.0
    pair = [
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(gain), cost, horizon=6, initial_state=start, max_qps=None,
            solver_tolerance=1e-11,
        )
        for system in systems
    ]
    ys, us = measured(by_numpy(name, method), start, 15)
    # Where bounds bind, the two solvers' paths may part by their tolerance.
    for y, u in zip(ys, us, strict=True):
        one, other = (mhe.update(y, u) for mhe in pair)
        np.testing.assert_allclose(one.trajectory, other.trajectory, rtol=0, atol=1e-5)
        np.testing.assert_allclose(one.cost, other.cost, rtol=1e-6, atol=1e-8)
        assert one.cost <= one.candidate_cost
        assert np.abs(one.disturbances[:, 2]).max() < 1e-8


@pytest.mark.parametrize("kind", ["extended", "unscented"])
def test_observers_that_use_the_model_otherwise(kind):
    make = {"extended": qpmhe.ExtendedKalman, "unscented": qpmhe.UnscentedKalman}[kind]
    ys, us = measured(by_numpy("cart", "rk4"), MODELS["cart"][-1], 15)
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior(), disturbance=20.0 * np.eye(4), noise=5.0 * np.eye(2)
    )
    pair = [
        qpmhe.MovingHorizonEstimator(
            system,
            make(prior=np.eye(4), disturbance=0.05 * np.eye(4), noise=0.2 * np.eye(2)),
            cost, horizon=5, initial_state=MODELS["cart"][-1], max_qps=2,
        )
        for system in (by_jax("cart", "rk4"), by_numpy("cart", "rk4"))
    ]
    for one, _ in check_runs(*pair, ys, us):
        assert one.improved
    np.testing.assert_allclose(*(mhe.covariances() for mhe in pair), rtol=1e-8, atol=1e-10)


def test_a_snapshot_continues_in_a_loaded_system_to_the_last_bit():
    system = pickle.loads(pickle.dumps(pickled()))
    one, other = (
        qpmhe.MovingHorizonEstimator(
            used, qpmhe.Luenberger([0.1, 0.2]),
            qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0),
            horizon=4, initial_state=[0.1, 0.2], max_qps=2,
        )
        for used in (pickled(), system)
    )
    ys = np.random.default_rng(9).standard_normal(12)
    for y in ys[:7]:
        one.update(y, [0.1])
    other.load_state_dict(one.state_dict())
    for y in ys[7:]:
        first, second = one.update(y, [0.1]), other.update(y, [0.1])
        np.testing.assert_array_equal(first.trajectory, second.trajectory)
        assert first.cost == second.cost


# Steps of other lengths


@pytest.mark.parametrize(
    ("name", "method"), [("reactor", "euler"), ("cart", "rk4"), ("vehicle", "rk4")]
)
def test_the_timed_system(name, method):
    system = by_jax(name, method)
    assert system.dt == DT
    timed = system.timed
    assert (timed.n, timed.p, timed.m) == (system.n, system.p, system.m + 1)
    assert timed is system.timed
    generator = np.random.default_rng(10)
    lengths = generator.uniform(0.01, 0.3, 5)
    x, u = generator.uniform(-1.0, 1.0, (5, system.n)), generator.uniform(-0.5, 0.5, (5, system.m))
    extended = np.column_stack([u, lengths])
    check_functions(timed, by_numpy(name, method).timed, x, extended)
    for i, dt in enumerate(lengths):
        check_functions(
            timed, by_numpy(name, method, dt).timed, x[i : i + 1], extended[i : i + 1]
        )
        np.testing.assert_allclose(
            timed.f(x[i], extended[i]), by_numpy(name, method, dt).f(x[i], u[i]), atol=1e-12
        )


@pytest.mark.parametrize("max_qps", [0, 1, 2])
@pytest.mark.parametrize(
    ("name", "method"), [("reactor", "euler"), ("cart", "rk4"), ("vehicle", "rk4")]
)
def test_updates_with_steps_of_other_lengths(name, method, max_qps):
    pair = estimators(name, method, max_qps=max_qps, horizon=5)
    ys, us = measured(by_numpy(name, method), MODELS[name][-1], 25)
    lengths = [None if t % 3 or t > 15 else 0.02 + 0.01 * t for t in range(25)]
    for one, other in check_runs(*pair, ys, us, lengths):
        assert one.status == other.status
    assert max_qps == 0 or one.improved


def test_a_discrete_system_has_steps_of_one_length():
    with pytest.raises(InvalidInputError, match="steps of another length"):
        _ = by_jax("reactor", None).timed
    assert by_jax("reactor", None).dt is None


# Precision


def precision():
    return jax.config.jax_enable_x64, jnp.ones(1).dtype, jnp.zeros(1, int).dtype


AT_FIRST = precision()


def test_the_precision_of_the_process_is_left_alone():
    before = precision()
    assert before == AT_FIRST
    system = from_jax(lambda x: 0.1 * x, lambda x: x, n=1, p=1)
    assert system.f(np.array([1.0]), NONE)[0] == 0.1
    assert precision() == before
    with pytest.raises(ModelError):
        from_jax(lambda x: x[0, 0, 0], lambda x: x, n=1, p=1)
    assert precision() == before
    for y in np.random.default_rng(11).standard_normal((5, 1)):
        estimators("reactor", "euler")[0].update(y)
    assert precision() == before


@pytest.mark.parametrize("double", [False, True])
def test_results_are_double_whatever_the_default(double):
    switch = jax.enable_x64 if hasattr(jax, "enable_x64") else jax.experimental.enable_x64
    third = np.array([1.0 / 3.0])
    with switch(double):
        system = from_jax(lambda x: x + 1e-12, lambda x: jnp.exp(x), n=1, p=1)
        assert system.f(third, NONE)[0] == third[0] + 1e-12
        assert precision()[0] is double
    for _ in range(2):  # made under one default, used under the other
        with switch(not double):
            assert system.f(2.0 * third, NONE)[0] == 2.0 * third[0] + 1e-12
            found = system.h.batch(np.tile(third, (20, 1)), np.empty((20, 0)))
            np.testing.assert_allclose(found, math.exp(1.0 / 3.0), rtol=1e-15)
            assert precision()[0] is not double


def test_other_threads():
    system, twin, wrong = by_jax("cart", "rk4"), by_numpy("cart", "rk4"), []
    before = precision()

    def evaluate(seed):
        generator = np.random.default_rng(seed)
        for _ in range(60):
            x, u = generator.standard_normal((9, 4)), generator.standard_normal((9, 1))
            try:
                check_functions(system, twin, x, u)
            except AssertionError as error:
                wrong.append(error)
        if precision() != before:
            wrong.append(precision())

    threads = [threading.Thread(target=evaluate, args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


# Compilation


def test_lengths_that_share_a_size_are_compiled_once():
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration, **more: compiled.append(event) if "backend_compile" in event else 0
    )
    system = from_jax(lambda x: 0.9 * x, lambda x: x[:1] ** 2, n=2, p=1)
    at_first = len(compiled)
    assert at_first >= 3
    x = np.random.default_rng(12).standard_normal((32, 2))
    for size in range(1, 17):
        for name in FUNCTIONS:
            getattr(system, name).batch(x[:size], np.empty((size, 0)))
            getattr(system, name)(x[size], NONE)
    assert len(compiled) == at_first
    for size in range(17, 33):
        for name in FUNCTIONS:
            getattr(system, name).batch(x[:size], np.empty((size, 0)))
    assert len(compiled) == at_first + 2  # f with h, and both Jacobians


@pytest.fixture
def calls(monkeypatch):
    """Entries of the switch to double precision: one at each call into a program."""
    home = jax if hasattr(jax, "enable_x64") else jax.experimental
    switch, entries = home.enable_x64, []

    def counted(value):
        entries.append(value)
        return switch(value)

    monkeypatch.setattr(home, "enable_x64", counted)
    return entries


def test_one_call_serves_both_functions(calls):
    system = from_jax(lambda x: 0.9 * x, lambda x: x[:1] ** 2, n=2, p=1)
    x = np.random.default_rng(14).standard_normal((2, 5, 2))
    nothing = np.empty((5, 0))
    calls.clear()
    for k, states in enumerate(x):
        for names in (("f", "h", "f"), ("f_jacobian", "h_jacobian", "f_jacobian")):
            for name in names:
                getattr(system, name).batch(states, nothing)
                getattr(system, name)(states[0], NONE)
        assert len(calls) == 4 * (k + 1)


@pytest.mark.parametrize("max_qps", [0, 1])
def test_calls_of_a_step(calls, max_qps):
    system = from_jax(*(at_one_state(g, jnp) for g in MODELS["reactor"][:2]), n=2, p=1, dt=DT)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(MODELS["reactor"][3]),
        qpmhe.QuadraticCost(prior=np.eye(2), disturbance=20.0 * np.eye(2), noise=5.0),
        horizon=5, initial_state=[3.0, 0.0], max_qps=max_qps,
    )
    ys, _ = measured(by_numpy("reactor", "rk4"), [3.0, 0.0], 40)
    for y in ys[:20]:
        mhe.update(y)
    calls.clear()
    improved = sum(mhe.update(y).improved for y in ys[20:])
    assert improved == 20 * max_qps
    # The new stage, the trial, and now and then a batch to see that batches may be trusted.
    assert 20 * (1 + max_qps) <= len(calls) <= 20 * (1 + max_qps) + 2


# What goes wrong


@pytest.mark.parametrize("dt", [None, 0.1])
@pytest.mark.parametrize(
    ("f", "shape"),
    [
        (lambda x: jnp.ones(3) * x[0], r"\(3,\)"),
        (lambda x: x[0], r"\(\)"),
        (lambda x: x[:1], r"\(1,\)"),
        (lambda x: x[None], r"\(1, 2\)"),
        (lambda x: jnp.outer(x, x), r"\(2, 2\)"),
    ],
)
def test_a_function_of_the_wrong_shape_is_refused(f, shape, dt):
    with pytest.raises(ModelError, match=rf"f returned shape {shape}; expected \(2,\)"):
        from_jax(f, lambda x: x[:1], n=2, p=1, dt=dt)


@pytest.mark.parametrize(
    ("h", "p", "shape"),
    [(lambda x: x, 1, r"\(2,\)"), (lambda x: x[0], 2, r"\(\)"), (lambda x: x[:1, None], 1, "(1")],
)
def test_an_output_of_the_wrong_shape_is_refused(h, p, shape):
    with pytest.raises(ModelError, match=rf"h returned shape {shape.replace('(1', '.1, 1')}"):
        from_jax(lambda x: x, h, n=2, p=p)


@pytest.mark.parametrize(
    ("f", "words"),
    [
        (lambda x: x if x[0] > 0 else -x, "JAX cannot trace f: TracerBool"),
        (lambda x: x * math.sin(x[0]), "JAX cannot trace f: .*jnp.where or lax.cond"),
        (lambda x: np.asarray(x) * 2.0, "JAX cannot trace f: TracerArray"),
        (lambda x: x + undefined, "JAX cannot trace f: NameError"),  # noqa: F821
        (lambda x: x.astype(jnp.float32), "f returned float32 where x is float64"),
        (lambda x: x + 1j, "f returned complex128"),
        (lambda x, u: x + u, "f needs 2 arguments, but the system has no inputs"),
        (lambda: 1.0, "f takes no argument; expected"),
        (3.0, "f is 3.0; expected a function"),
        (
            lambda x: jax.pure_callback(
                lambda v: np.asarray(v), jax.ShapeDtypeStruct((2,), np.float64), x
            ),
            "JAX cannot differentiate f and h: ",
        ),
    ],
)
def test_a_function_that_cannot_be_used_is_refused_in_words(f, words):
    with pytest.raises(ModelError, match=words):
        from_jax(f, lambda x: x[:1], n=2, p=1)


def test_a_wrong_derivative_is_refused():
    @jax.custom_jvp
    def squared(x):
        return x**2

    squared.defjvp(lambda x, dx: (x[0] ** 2, 3.0 * x[0] * dx[0]))
    with pytest.raises(ModelError, match=r"f_jacobian\[0, 0\] is .* It is JAX's: look for"):
        from_jax(squared, lambda x: x, n=1, p=1).use_scales([1.0])
    with pytest.raises(ModelError, match=r"h_jacobian.* custom derivative within h"):
        from_jax(lambda x: x, squared, n=1, p=1).use_scales([1.0])


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"n": 0}, OptionError, "n is 0"),
        ({"p": 1.5}, OptionError, "p is 1.5"),
        ({"m": -1}, OptionError, "m is -1"),
        ({"dt": 0.0}, OptionError, "dt is 0.0"),
        ({"dt": 0.1, "method": "heun"}, OptionError, "'heun'; expected one of 'euler', 'rk4'"),
        ({"method": "heun"}, OptionError, "method is 'heun'"),
        ({"states": qpmhe.Box([0.0], [1.0])}, SetError, "states has dimension 1"),
    ],
)
def test_wrong_options_are_refused(options, error, words):
    with pytest.raises(error, match=words):
        from_jax(lambda x: x, lambda x: x[:1], **{"n": 2, "p": 1, **options})


def test_without_jax_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(InvalidInputError, match=r"pip install 'qpmhe\[jax\]'"):
        from_jax(lambda x: x, lambda x: x, n=1, p=1)


def test_without_a_cpu_the_remedy_is_named(monkeypatch):
    def none(backend):
        raise RuntimeError(f"Unknown backend {backend}")

    monkeypatch.setattr(jax, "local_devices", none)
    with pytest.raises(InvalidInputError, match=r"Unknown backend cpu.*JAX_PLATFORMS"):
        from_jax(lambda x: x, lambda x: x, n=1, p=1)


def test_a_model_that_is_not_a_number_far_away_falls_back():
    # A tank: the root of a negative level is not a number.
    def rate(xp, x):
        return 0.2 - 0.5 * xp.sqrt(x)

    pair = [
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.9]),
            qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=100.0),
            horizon=4, initial_state=[0.5], max_qps=2,
        )
        for system in (
            from_jax(lambda x: rate(jnp, x), lambda x: x, n=1, p=1, dt=0.1),
            qpmhe.System.from_ode(lambda x: rate(np, x), lambda x: x, n=1, p=1, dt=0.1),
        )
    ]
    statuses = []
    with np.errstate(invalid="ignore"):
        for y in [0.5, 0.4, -3.0, -3.0, 0.6, 0.5, 0.5, 0.4, 0.5, 0.5, 0.5]:
            one, other = (mhe.update([y]) for mhe in pair)
            np.testing.assert_allclose(one.trajectory, other.trajectory, rtol=1e-9, atol=1e-9)
            assert np.isfinite(one.state).all()
            assert one.status == other.status
            statuses.append(one.status)
    failed = [qpmhe.Status.MODEL_FAILED in status for status in statuses]
    assert any(failed)
    assert not failed[0]
    assert not failed[-1]


@pytest.mark.parametrize("start", [0.0, 1.0])
def test_the_estimation_may_start_at_a_kink(start):
    # Differences across it give the mean of both slopes, JAX one of them.
    system = from_jax(
        lambda x: jnp.where(x > start, 0.9 * x, 0.9 * start + 0.3 * (x - start)),
        lambda x: x, n=1, p=1,
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.3]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0),
        horizon=3, initial_state=[start],
    )
    assert mhe.update([start + 0.5]).improved
    assert system.f_jacobian(np.array([start]), NONE)[0, 0] in (0.3, 0.9)


# Pickling


def swing(x, u):
    return jnp.array([x[1], u[0] - jnp.sin(x[0])])


def angle(x):
    return x[0]


@cache
def pickled():
    return from_jax(
        swing, angle, n=2, p=1, m=1, dt=0.1, method="euler",
        states=qpmhe.Box([-9.0, -9.0], [9.0, 9.0]),
    )


def test_a_system_pickles_where_its_functions_do():
    system, loaded = pickled(), pickle.loads(pickle.dumps(pickled()))
    assert loaded.dt == 0.1
    assert loaded.states == system.states or loaded.states.dimension == 2
    generator = np.random.default_rng(13)
    x, u = generator.standard_normal((5, 2)), generator.standard_normal((5, 1))
    for name in FUNCTIONS:
        expected = getattr(system, name).batch(x, u)
        np.testing.assert_array_equal(getattr(loaded, name).batch(x, u), expected)
    extended = np.column_stack([u, np.full(5, 0.1)])
    np.testing.assert_array_equal(loaded.timed.f.batch(x, extended), system.f.batch(x, u))
    with pytest.raises((pickle.PicklingError, AttributeError)):
        pickle.dumps(by_jax("reactor", "euler"))


# Indices out of range, where JAX reads another entry


TABLE = np.linspace(0.0, 1.0, 8)
ROWS = np.arange(6.0).reshape(3, 2)


@jax.jit
def compiled_by_the_user(x):
    return x * x[5]


def place(x):
    return (8.0 * x[0]).astype(int)


def loop(x, turns):
    return jax.lax.fori_loop(0, turns, lambda i, total: total + x[i], 0.0) * x


OUT_OF_RANGE = {
    "positive": (lambda x, u: x * x[5], "index 5 on axis 0, of size 2, of an array (2,)"),
    "negative": (lambda x, u: x * x[-3], "index -3 on axis 0, of size 2"),
    "input": (lambda x, u: x * u[1], "index 1 on axis 0, of size 1, of an array (1,)"),
    "list": (lambda x, u: x[jnp.array([0, 2])], "index 2 on axis 0, of size 2"),
    "list in NumPy": (lambda x, u: x[np.array([0, -3])], "index -3 on axis 0"),
    "nested constants": (lambda x, u: x * jnp.asarray(ROWS)[1, 2], "index 2 on axis 1, of size 2"),
    "row": (lambda x, u: x + jnp.asarray(ROWS)[3], "index 3 on axis 0, of size 3"),
    "table": (lambda x, u: x * jnp.asarray(TABLE)[place(10.0 * x)], "on axis 0, of size 8"),
    "write": (lambda x, u: x.at[2].set(1.0), "index 2 on axis 0, of size 2"),
    "slice": (lambda x, u: jax.lax.dynamic_slice(x, (1,), (2,)), "index 1 on axis 0, of size 2"),
    "loop": (lambda x, u: loop(x, 3), "index 2 on axis 0, of size 2"),
    "vmap": (lambda x, u: x * jax.vmap(lambda i: x[i])(jnp.arange(3))[2], "index 2 on axis 0"),
    "compiled": (lambda x, u: compiled_by_the_user(x), "index 5 on axis 0, of size 2"),
    "in a branch": (
        lambda x, u: jax.lax.cond(u[0] > 0.0, lambda: x * x[5], lambda: x), "index 5 on axis 0"
    ),
}
IN_RANGE = {
    "last": lambda x, u: x * x[-1] + u[-1],
    "turned": lambda x, u: x[::-1],
    "slice": lambda x, u: x[0:9],
    "write": lambda x, u: x.at[-1].set(1.0).at[:1].add(u),
    "unpacked": lambda x, u: jnp.array([x[1], *u]),
    "clipped": lambda x, u: x * jnp.asarray(TABLE)[jnp.clip(place(x), 0, 7)],
    "clip": lambda x, u: x * jnp.take(jnp.asarray(TABLE), place(x), mode="clip"),
    "clipped rows": lambda x, u: jnp.asarray(ROWS).at[(9.0 * x).astype(int)].get(mode="clip")[0],
    "clip in a loop": lambda x, u: jax.lax.fori_loop(
        0, 4, lambda i, z: 0.5 * z + jnp.take(x, i, mode="clip"), x
    ),
    "wrap": lambda x, u: x * jnp.take(jnp.asarray(TABLE), place(x), mode="wrap"),
    "fill": lambda x, u: x * jnp.take(jnp.asarray(TABLE), place(x), mode="fill", fill_value=0.0),
    "filled": lambda x, u: x * jnp.asarray(TABLE).at[place(x)].get(mode="fill", fill_value=0.5),
    "clipped write": lambda x, u: x.at[place(x)].set(1.0, mode="clip"),
    "interpolation": lambda x, u: x * jnp.interp(x[0], jnp.asarray(TABLE), jnp.asarray(TABLE)),
    "map": lambda x, u: x * jax.scipy.ndimage.map_coordinates(jnp.asarray(TABLE), [10.0 * x], 1),
    "loop": lambda x, u: loop(x, 2),
    "sorted": lambda x, u: x[jnp.argsort(x)] + x[jnp.argmax(x)],
    "solved": lambda x, u: jnp.linalg.solve(jnp.eye(2) + jnp.outer(x, x), x),
    "guarded by a branch": lambda x, u: jax.lax.cond(
        u[0] < 0.0, lambda: x * x[5], lambda: x
    ),
}


@pytest.mark.parametrize("name", OUT_OF_RANGE)
def test_an_index_out_of_range_is_refused(name):
    function, told = OUT_OF_RANGE[name]
    for method in (None, "rk4"):
        timing = {} if method is None else {"dt": 0.1, "method": method}
        with pytest.raises(ModelError) as caught:
            from_jax(function, lambda x: x[0], n=2, p=1, m=1, **timing)
        assert str(caught.value).startswith("f uses index ")
        assert told in str(caught.value)
        assert "jnp.clip" in str(caught.value)
    with pytest.raises(ModelError, match=r"^h uses index "):
        from_jax(lambda x: x, lambda x, u: function(x, u), n=2, p=2, m=1)


@pytest.mark.parametrize("name", IN_RANGE)
def test_indices_in_range_or_with_a_meaning_are_taken(name):
    function = IN_RANGE[name]
    system = from_jax(function, lambda x: x[0], n=2, p=1, m=1)
    x, u = np.array([0.4, 0.7]), np.array([0.2])
    home = jax if hasattr(jax, "enable_x64") else jax.experimental
    with home.enable_x64(True):
        np.testing.assert_allclose(system.f(x, u), np.asarray(jax.jit(function)(x, u)), rtol=1e-12)


def test_indices_are_checked_within_the_set_of_states():
    inside = qpmhe.Box([0.0, 0.0], [0.9, 0.9])

    def lookup(x):
        return x * jnp.asarray(TABLE)[place(x)]

    assert from_jax(lookup, lambda x: x[0], n=2, p=1, states=inside).n == 2
    with pytest.raises(ModelError, match="f uses index"):
        from_jax(lookup, lambda x: x[0], n=2, p=1)


def test_functions_without_such_indices_are_not_compiled_for_the_check(monkeypatch):
    from jax.experimental import checkify

    monkeypatch.setattr(checkify, "checkify", None)
    system = from_jax(lambda x: 0.5 * x[::-1], lambda x: x[1:], n=2, p=1)
    assert system.n == 2


def test_estimators_of_one_system_share_its_programs(monkeypatch):
    system = by_jax("reactor", "euler")
    arguments = (
        qpmhe.Luenberger([[0.05], [0.05]]),
        qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1)),
    )
    options = {"horizon": 4, "initial_state": [3.0, 0.0]}
    expected = qpmhe.MovingHorizonEstimator(system, *arguments, **options).update([2.5])
    compiled = []
    monkeypatch.setattr(
        "qpmhe.adapters.jax_programs.Programs._compiled", lambda *given: compiled.append(given)
    )
    mhe = qpmhe.MovingHorizonEstimator(system, *arguments, **options)
    assert compiled == []
    assert mhe.update([2.5]).cost == expected.cost
