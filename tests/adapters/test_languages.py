"""What all adapters promise: the twins.same model in every language is the twins.same system."""

import pickle
import sys
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError
from tests.adapters import twins
from tests.adapters.twins import LANGUAGES, STEPS, THETA, M, N, P, made, plain, points

# Those that evaluate by code of another package, and those whose functions pickle.
FOREIGN = ["casadi", "interpreted", "jax"]
LASTING = [one for one in LANGUAGES if one != "control"]
METHODS = {"casadi": "casadi", "interpreted": "casadi", "jax": "jax"}


@pytest.mark.parametrize("way", STEPS)
@pytest.mark.parametrize("language", LANGUAGES)
def test_values_jacobians_and_expressions(language, way):
    system = made(language, way)
    assert (system.n, system.p, system.m) == (N, P, M)
    assert system.dt == (None if way == "discrete" else 0.1)
    assert system.derivatives == dict.fromkeys("fh", METHODS.get(language, "traced"))
    assert system.symbolic is not None
    twins.check(system, lambda x, u: plain(way, x, u), *points())
    # The expression, from which the step in C is made, is the user's function as well.
    step, output = system.symbolic.step(), system.symbolic.h
    for x, u in zip(*points(), strict=True):
        ahead, seen = plain(way, x, u)
        np.testing.assert_allclose(step(x, u, system.dt or 0.0).full()[:, 0], ahead, rtol=1e-12)
        np.testing.assert_allclose(output(x, u).full()[:, 0], seen, rtol=1e-12)
    if way == "discrete":
        with pytest.raises(InvalidInputError, match="steps of another length"):
            _ = system.timed
        return
    xs, us = points(8)
    lengths = np.linspace(0.01, 0.3, 8)[:, None]
    assert system.timed.m == M + 1
    twins.check(
        system.timed, lambda x, v: plain(way, x, v[:-1], v[-1].real), xs, np.hstack((us, lengths))
    )


@pytest.mark.skipif(find_compiler() is None, reason="no compiler")
@pytest.mark.parametrize("language", LANGUAGES)
def test_the_compiled_step_of_a_discrete_model_is_that_of_the_users_function(language):
    system, gain = made(language, "discrete"), 0.05 * np.ones((N, P))
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(gain),
        qpmhe.QuadraticCost(prior=np.eye(N), disturbance=2.0 * np.eye(N), noise=3.0 * np.eye(P)),
        horizon=3, initial_state=0.1 * np.ones(N), engine="compiled",
    )
    z, rng = [0.1 * np.ones(N)], np.random.default_rng(0)
    ys, us = 0.1 * rng.normal(size=(5, P)), np.hstack((0.1 * rng.normal(size=(5, 1)), 5 * [THETA]))
    for y, u in zip(ys, us, strict=True):
        found = mhe.update(y, u)
        ahead, seen = plain("discrete", z[-1], u)
        z.append(ahead + gain @ (y - seen))
    assert mhe.engine == "compiled"
    np.testing.assert_allclose(found.candidate, z[2:], rtol=1e-12)
    along, cost = found.trajectory, ((found.trajectory[0] - z[2]) ** 2).sum()
    for k in range(3):
        ahead, seen = plain("discrete", along[k], us[2 + k])
        cost += 2.0 * ((along[k + 1] - ahead) ** 2).sum() + 3.0 * ((ys[2 + k] - seen) ** 2).sum()
    assert found.cost == pytest.approx(cost, rel=1e-10)


@pytest.mark.parametrize("way", ["discrete", "rk4"])
@pytest.mark.parametrize("kind", ["parameters", "noisy inputs"])
@pytest.mark.parametrize("language", LANGUAGES)
def test_parameters_and_noisy_inputs_as_states(language, kind, way):
    model = made(language, way)
    xs, us = points()
    if kind == "parameters":
        system = qpmhe.augment_parameters(model, nominal=THETA, estimated=[2, 0])
        us, ends = us[:, :1], THETA[[2, 0]]
    else:
        system, ends = qpmhe.noisy_inputs(model, [0, 3]), np.zeros(2)

    def values(z, u, dt=0.1):
        if kind == "parameters":
            v, behind = np.array([*u, z[N + 1], THETA[1], z[N]]), z[N:]
        else:
            v, behind = u + z[N] * np.eye(M)[0] + z[N + 1] * np.eye(M)[3], np.zeros(2)
        ahead, seen = plain(way, z[:N], v, dt)
        return np.concatenate((ahead, behind)), seen

    assert (system.n, system.m, system.dt) == (N + 2, us.shape[1], model.dt)
    zs = np.hstack((xs, ends + 0.3 * np.random.default_rng(1).standard_normal((len(xs), 2))))
    if language in LASTING:
        system = pickle.loads(pickle.dumps(system))
    twins.check(system, values, zs, us)
    if way != "discrete":
        longer = np.hstack((us, np.full((len(us), 1), 0.25)))
        twins.check(system.timed, lambda z, v: values(z, v[:-1], v[-1].real), zs, longer)


@pytest.mark.parametrize("language", LANGUAGES)
def test_angles_go_along(language):
    turn, estimates = 2.0 * np.pi, []
    angles = {"state_residual": qpmhe.angles([2]), "output_residual": qpmhe.angles([1])}
    system = LANGUAGES[language](**twins.TIMING["rk4"], **angles)
    assert {name: getattr(system, name) for name in angles} == angles
    for turns in (0, 3):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(np.full((N, P), 0.05)),
            qpmhe.QuadraticCost(prior=np.eye(N), disturbance=np.eye(N), noise=np.eye(P)),
            horizon=4, initial_state=[0.0, 0.1, 0.3, 0.2], max_qps=2,
        )
        for k, u in enumerate(points(8)[1]):
            estimate = mhe.update([0.1 * k, 0.2 + turns * turn * (k % 2)], u)
        estimates.append(estimate)
    assert Status.IMPROVED in estimates[0].status
    np.testing.assert_allclose(estimates[1].state, estimates[0].state, 0.0, 1e-9)


@pytest.mark.parametrize("language", FOREIGN)
def test_arrays_of_any_layout_type_and_length(language):
    system, (xs, us) = made(language, "rk4"), points(12)
    layouts = [np.asfortranarray(xs), np.repeat(xs, 3, axis=1)[:, ::3], xs[::-1].copy()[::-1]]
    whole, few = np.arange(12).reshape(3, 4) - 5, np.array([[1, 2, 3, 4]] * 3)
    for one in (getattr(system, name) for name in twins.FUNCTIONS):
        expected = one.batch(xs, us)
        for form in layouts:
            np.testing.assert_allclose(one.batch(form, us), expected, 1e-14, 1e-14)
            np.testing.assert_allclose(one(form[3], us[3]), expected[3], 1e-13, 1e-13)
        for lead in [(3, 4), (2, 3, 2), (12, 1)]:
            found = one.batch(xs.reshape(*lead, N), us.reshape(*lead, M))
            np.testing.assert_allclose(found, expected.reshape(*lead, *expected.shape[1:]), 1e-14)
        assert one.batch(xs[:0], us[:0]).shape == (0, *expected.shape[1:])
        np.testing.assert_array_equal(one.batch(whole, few), one.batch(1.0 * whole, 1.0 * few))
    # More lengths than are kept ready, and back.
    xs, us = points(200)
    expected = made("numpy", "rk4").f.batch(xs, us)
    for count in [*range(200, 0, -21), *range(1, 40, 3)]:
        found = system.f.batch(xs[:count], us[:count])
        np.testing.assert_allclose(found, expected[:count], 1e-13, 1e-13)


@pytest.mark.parametrize("language", FOREIGN)
def test_what_was_handed_out_stays(language):
    system, ((x, y), (u, v)) = made(language, "rk4"), points(2)
    for one in (getattr(system, name) for name in twins.FUNCTIONS):
        changed = x.copy()
        first = one(changed, u)
        kept = first.copy()
        changed[:] = y  # the very array of the last call, with other numbers
        second = one(changed, v)
        np.testing.assert_array_equal(first, kept)
        many = one.batch(np.array([x, y]), np.array([u, v]))
        again = one.batch(np.array([y, x]), np.array([v, u]))
        for found in (many, again[::-1]):
            np.testing.assert_allclose(found, [first, second], rtol=1e-14)


@pytest.mark.parametrize("language", FOREIGN)
def test_threads(language):
    """A fresh system used by threads at once: buffers must be made for each of them."""
    system, count = LANGUAGES[language](dt=0.1), 4
    twin, wrong, gate = made("numpy", "rk4"), [], threading.Barrier(count)

    def work(seed):
        xs, us = points(30, seed)
        try:
            gate.wait(10)
            for turn in range(20):
                rows, i = 1 + (turn + seed) % 30, turn % 30
                twins.same(system, twin, xs[:rows], us[:rows])
                np.testing.assert_allclose(system.f(xs[i], us[i]), twin.f(xs[i], us[i]), 1e-12)
        except BaseException as error:
            wrong.append(error)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(count)]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
    finally:
        sys.setswitchinterval(before)
    assert not wrong


def estimator(system, kind=None, **options):
    observer = qpmhe.Luenberger(np.random.default_rng(3).uniform(0, 0.1, (N, P)))
    if kind is not None:
        observer = kind(prior=np.eye(N), disturbance=0.1 * np.eye(N), noise=0.1 * np.eye(P))
    cost = qpmhe.QuadraticCost(prior=np.eye(N), disturbance=30 * np.eye(N), noise=10 * np.eye(P))
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=5, initial_state=0.1 * np.ones(N), **options
    )


CASES = [
    ("casadi", "rk4", {"max_qps": None}), ("casadi", "discrete", {"kind": qpmhe.ExtendedKalman}),
    ("interpreted", "rk4", {"max_qps": 2, "warm_start": True}),
    ("interpreted", "rk4", {"engine": "compiled"}),
    ("jax", "rk4", {"kind": qpmhe.UnscentedKalman}), ("jax", "discrete", {"max_qps": None}),
    ("jax", "euler", {"candidate": "reinitialized"}), ("jax", "rk4", {"engine": "compiled"}),
    ("sympy", "rk4", {"engine": "compiled"}), ("control", "rk4", {"kind": qpmhe.ExtendedKalman}),
    ("casadi", "rk4", {"engine": "compiled"}), ("numpy", "rk4", {"engine": "compiled"}),
]


@pytest.mark.parametrize(("language", "way", "options"), CASES)
def test_estimates_are_those_of_the_numpy_model(language, way, options):
    one, two = (
        estimator(made(language, way), **options),
        estimator(made("numpy", way), **options | {"engine": "python"}),
    )
    generator, x = np.random.default_rng(1), 0.3 * np.ones(N)
    for t in range(20):
        u = np.append(generator.uniform(-0.3, 0.3), THETA)
        y = twins.numpy_output(x, u) + 0.05 * generator.standard_normal(P)
        if t % 5 == 3:
            y[t % P] = np.nan
        x = 0.5 * made("numpy", way).f(x, u) + 0.02 * generator.standard_normal(N)
        given = {} if way == "discrete" or t % 4 != 2 else {"dt": 0.08}
        found, expected = (mhe.update(y, u, **given) for mhe in (one, two))
        for label in ("trajectory", "candidate", "disturbances"):
            np.testing.assert_allclose(
                getattr(found, label), getattr(expected, label), rtol=1e-8, atol=1e-9
            )
        assert found.cost == pytest.approx(expected.cost, rel=1e-8, abs=1e-12)
        assert found.status == expected.status


def value_of(data):
    system, x, u = pickle.loads(data)
    return system.f(x, u), system.f_jacobian(x, u), system.timed.f(x, np.append(u, 0.2))


@pytest.mark.parametrize("language", LASTING)
def test_pickled_here_and_in_a_spawned_process(language, monkeypatch):
    box = qpmhe.Box([-9.0] * N, [9.0] * N)
    system = LANGUAGES[language](dt=0.1, states=box)
    assert system.states is box
    (x,), (u,) = points(1)
    data = pickle.dumps((system, x, u))
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        there = pool.submit(value_of, data).result(timeout=100)
    for found in (value_of(data), there):
        np.testing.assert_allclose(found[0], system.f(x, u), rtol=1e-14)
        # The order of SymPy's sums depends on the process.
        np.testing.assert_allclose(found[1], system.f_jacobian(x, u), rtol=1e-14)
        np.testing.assert_allclose(found[2], plain("rk4", x, u, 0.2)[0], rtol=1e-12)
    again = pickle.loads(data)[0]
    assert (again.n, again.p, again.m, again.dt) == (N, P, M, 0.1)
    np.testing.assert_array_equal(again.states.lower, box.lower)


PACKAGES = {
    "jax": lambda: qpmhe.from_jax(lambda x: x, lambda x: x, n=1, p=1),
    "sympy": lambda: qpmhe.from_sympy([1], [1], ["x"]),
    "control": lambda: qpmhe.from_control(object()),
}


@pytest.mark.parametrize("package", PACKAGES)
def test_without_the_package_the_remedy_is_named(package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InvalidInputError, match=rf"pip install 'qpmhe\[{package}\]'"):
        PACKAGES[package]()
