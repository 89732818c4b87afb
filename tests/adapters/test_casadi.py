"""Models given to CasADi against the same models in NumPy."""

import math
import pickle
import sys
import threading
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe import from_casadi
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import (
    CompilationError,
    InvalidInputError,
    ModelError,
    OptionError,
    QpmheError,
    SetError,
    ShapeError,
)

ca = pytest.importorskip("casadi")

NONE = np.zeros(0)
BOTH = [
    False,
    pytest.param(True, marks=pytest.mark.skipif(find_compiler() is None, reason="no compiler")),
]


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("QPMHE_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


# Entries of models, written once for NumPy over (..., n) and for CasADi: its column's entries
# come first, and where sin and exp are from last.


def crane(x, u, xp):
    place, speed, angle, spin = x
    push = u[0] - 0.2 * speed
    sine, cosine = xp.sin(angle), xp.cos(angle)
    return [speed, push, spin, -9.81 * sine / (1.0 + 0.1 * place**2) - cosine * push - 0.1 * u[1]]


def crane_output(x, u, xp):
    return [x[0] + 0.3 * xp.sin(x[2]) + 0.01 * u[1], x[3] * x[2]]


def pond(x, u, xp):
    fish, food = x
    return [0.9 * fish + 0.1 * food * fish, food + 0.2 * xp.exp(-fish) - 0.1 * fish * food]


def pond_output(x, u, xp):
    return [x[0] * x[1]]


MODELS = {"crane": (crane, crane_output, 4, 2, 2), "pond": (pond, pond_output, 2, 1, 0)}


def entries(column, size):
    return [column[i] for i in range(size)]


def symbolic(name, way):
    """f and h of a model in one of the ways in which CasADi's users write them."""
    f, h, n, _, m = MODELS[name]
    if way in ("SX", "MX", "row", "sparse", "one argument", "matrix argument"):
        kind = ca.MX if way == "MX" else ca.SX
        x, u = kind.sym("x", n), kind.sym("u", m)
        if way == "row":
            x = kind.sym("x", 1, n)
        made = []
        for function, label in ((f, "f"), (h, "h")):
            value = ca.vertcat(*function(entries(x, n), entries(u, m), ca))
            if way == "row":
                value = value.T
            if way == "sparse":
                value = ca.sparsify(ca.vertcat(value, 0))[: value.numel()]
            made.append(ca.Function(label, [x, u] if m else [x], [value]))
        return made

    def written(function):
        def call(x, u=NONE):
            values = function(entries(x, n), entries(u, m), ca)
            if way == "list":
                return values
            if way == "tuple":
                return tuple(values)
            return ca.vertcat(*values) if len(values) > 1 else values[0]

        return call if m else lambda x: call(x)

    return written(f), written(h)


def numeric(name, which):
    """The same in NumPy, over leading dimensions."""
    f, h, n, _, m = MODELS[name]
    function = f if which == "f" else h

    def call(x, u=NONE):
        x, u = np.asarray(x), np.asarray(u)
        values = function(
            [x[..., i] for i in range(n)], [u[..., i] for i in range(m)], np
        )
        return np.stack(np.broadcast_arrays(*values), axis=-1)

    return call


def slopes(function, x, u):
    """The Jacobian at one state by the complex step: exact to rounding."""
    columns = [function(x + 1e-30j * one, u).imag / 1e-30 for one in np.eye(x.size)]
    return np.stack(columns, axis=-1)


@cache
def made(name, compiled, way="SX", **options):
    _, _, n, _, m = MODELS[name]
    f, h = symbolic(name, way)
    return from_casadi(f, h, n=n, m=m, compiled=compiled, **options)


@cache
def twin(name, dt=None, method="rk4"):
    _, _, n, p, m = MODELS[name]
    f, h = numeric(name, "f"), numeric(name, "h")
    if not m:
        f, h = (lambda x, f=f: f(x)), (lambda x, h=h: h(x))
    if dt is None:
        return qpmhe.System(f, h, n=n, p=p, m=m)
    return qpmhe.System.from_ode(f, h, dt=dt, method=method, n=n, p=p, m=m)


def points(name, count=6, seed=0):
    _, _, n, _, m = MODELS[name]
    generator = np.random.default_rng(seed)
    return generator.uniform(-1.0, 1.5, (count, n)), generator.uniform(-1.0, 1.0, (count, m))


def plain_step(name, dt, method):
    rate = numeric(name, "f")
    if dt is None:
        return rate

    def step(x, u, dt=dt):
        k1 = rate(x, u)
        if method == "euler":
            return x + dt * k1
        k2 = rate(x + 0.5 * dt * k1, u)
        k3 = rate(x + 0.5 * dt * k2, u)
        k4 = rate(x + dt * k3, u)
        return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    return step


def check(system, f, h, xs, us):
    """Values and Jacobians, state by state and all at once, to 1e-13."""
    tolerance = {"rtol": 1e-13, "atol": 1e-13}
    for function, jacobian, plain in (
        (system.f, system.f_jacobian, f), (system.h, system.h_jacobian, h)
    ):
        values = np.array([plain(x, u) for x, u in zip(xs, us, strict=True)])
        matrices = np.array([slopes(plain, x, u) for x, u in zip(xs, us, strict=True)])
        for x, u, value, matrix in zip(xs, us, values, matrices, strict=True):
            np.testing.assert_allclose(function(x, u), value, **tolerance)
            np.testing.assert_allclose(jacobian(x, u), matrix, **tolerance)
        np.testing.assert_allclose(function.batch(xs, us), values, **tolerance)
        np.testing.assert_allclose(jacobian.batch(xs, us), matrices, **tolerance)


@pytest.mark.parametrize("compiled", BOTH)
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(
    ("dt", "method"), [(None, "rk4"), (0.05, "euler"), (0.05, "rk4"), (1, "rk4")]
)
def test_values_and_jacobians(name, compiled, dt, method):
    system = made(name, compiled, dt=dt, method=method)
    _, _, n, p, m = MODELS[name]
    assert (system.n, system.p, system.m, system.dt) == (n, p, m, dt)
    assert system.derivatives == {"f": "casadi", "h": "casadi"}
    assert system.symbolic is not None
    check(system, plain_step(name, dt, method), numeric(name, "h"), *points(name))


WAYS = ["SX", "MX", "row", "sparse", "column", "list", "tuple"]


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("way", WAYS)
def test_ways_of_writing(name, way):
    system = made(name, False, way, dt=0.1)
    check(system, plain_step(name, 0.1, "rk4"), numeric(name, "h"), *points(name))
    if way in WAYS[:4]:  # the functions tell their sizes
        f, h = symbolic(name, way)
        told = from_casadi(f, h, compiled=False)
        assert (told.n, told.p, told.m) == MODELS[name][2:]


@pytest.mark.parametrize("compiled", BOTH)
def test_matrix_functions_that_cannot_be_expanded(compiled):
    x, u = ca.MX.sym("x", 3), ca.MX.sym("u", 1)
    table = ca.interpolant("table", "bspline", [np.linspace(-4, 4, 12)], np.linspace(-4, 4, 12)**2)
    f = ca.Function("f", [x, u], [0.3 * x + ca.logsumexp(x) + u * table(x[1])])
    h = ca.Function("h", [x], [ca.vertcat(ca.logsumexp(2.0 * x), x[0])])
    system = from_casadi(f, h, compiled=compiled)
    assert system.symbolic.f.is_a("MXFunction")
    generator = np.random.default_rng(4)
    xs, us = generator.uniform(-1.0, 1.0, (5, 3)), generator.uniform(-1.0, 1.0, (5, 1))

    def plain(x, u):
        return 0.3 * x + np.log(np.exp(x).sum()) + u[0] * x[1] ** 2

    def output(x, u):
        return np.array([np.log(np.exp(2.0 * x).sum()), x[0]])

    check(system, plain, output, xs, us)


@pytest.mark.parametrize("compiled", BOTH)
@pytest.mark.parametrize("dt", [None, 0.1])
def test_arrays_of_all_sorts(compiled, dt):
    system = made("crane", compiled, dt=dt)
    xs, us = points("crane", 12)
    expected = {
        "f": plain_step("crane", dt, "rk4")(xs, us), "h": numeric("crane", "h")(xs, us)
    }
    wide = np.repeat(np.repeat(xs, 2, axis=0), 3, axis=1)
    forms = {
        "as it is": xs, "Fortran": np.asfortranarray(xs), "strided": wide[::2, ::3],
        "backwards": xs[::-1].copy()[::-1], "read only": xs.copy(), "masked": np.ma.array(xs),
    }
    forms["read only"].flags.writeable = False
    for which, value in expected.items():
        function, jacobian = getattr(system, which), getattr(system, f"{which}_jacobian")
        rows = value.shape[-1]
        for label, form in forms.items():
            assert np.allclose(function.batch(form, us), value, 1e-13, 1e-13), label
            assert np.allclose(function(form[3], us[3]), value[3], 1e-13, 1e-13), label
        for lead in [(12,), (3, 4), (2, 3, 2), (1, 12), (12, 1), (1, 1, 12)]:
            x, u = xs.reshape(*lead, 4), us.reshape(*lead, 2)
            assert np.allclose(function.batch(x, u), value.reshape(*lead, rows), 1e-13, 1e-13)
            assert jacobian.batch(x, u).shape == (*lead, rows, 4)
        assert function.batch(xs[:1], us[:1]).shape == (1, rows)
        assert function.batch(xs, us).dtype == np.float64
        single = xs.astype(np.float32)
        exact = (plain_step("crane", dt, "rk4") if which == "f" else numeric("crane", "h"))
        np.testing.assert_allclose(
            function.batch(single, us), exact(single.astype(float), us), 1e-13, 1e-13
        )
        whole = np.arange(4) - 1
        np.testing.assert_allclose(
            function(whole, np.array([1, -2])), exact(whole.astype(float), [1.0, -2.0]), 1e-13
        )


@pytest.mark.parametrize("compiled", BOTH)
def test_no_states_at_all(compiled):
    system, x, u = made("crane", compiled), np.zeros((0, 4)), np.zeros((0, 2))
    assert system.f.batch(x, u).shape == (0, 4)
    assert system.h.batch(x, u).shape == (0, 2)
    assert system.f_jacobian.batch(x, u).shape == (0, 4, 4)


@pytest.mark.parametrize("compiled", BOTH)
def test_batches_of_all_lengths_and_back(compiled):
    """More lengths than buffers are kept of."""
    system, f = made("pond", compiled), numeric("pond", "f")
    xs, _ = points("pond", 200)
    for count in [*range(200, 0, -7), *range(1, 90)]:
        found = system.f.batch(xs[:count], np.zeros((count, 0)))
        np.testing.assert_allclose(found, f(xs[:count]), rtol=1e-13, atol=1e-13)
    assert system.f(xs[0], NONE) == pytest.approx(f(xs[0]), rel=1e-13)


@pytest.mark.parametrize("compiled", BOTH)
def test_results_are_fresh(compiled):
    system = made("crane", compiled, dt=0.1)
    (x, y), (u, w) = points("crane", 2)
    for function in (system.f, system.h, system.f_jacobian, system.h_jacobian):
        one = function(x, u)
        kept = one.copy()
        two = function(y, w)
        assert not np.shares_memory(one, two)
        assert np.array_equal(one, kept)
        one[...] = np.nan
        assert np.array_equal(function(x, u), kept)
        many = function.batch(np.array([x, y]), np.array([u, w]))
        again = function.batch(np.array([y, x]), np.array([w, u]))
        assert not np.shares_memory(many, again)
        np.testing.assert_allclose(many[0], again[1], rtol=1e-15)
    assert np.array_equal(x, points("crane", 2)[0][0])


@pytest.mark.parametrize("compiled", BOTH)
def test_threads(compiled):
    """A fresh system used by threads at once: buffers must be made for each of them."""
    system, count = from_casadi(*symbolic("crane", "SX"), dt=0.1, compiled=compiled), 4
    step, wrong, gate = plain_step("crane", 0.1, "rk4"), [], threading.Barrier(count)

    def work(seed):
        xs, us = points("crane", 30, seed)
        expected = step(xs, us)
        try:
            gate.wait(10)
            for turn in range(40):
                rows = 1 + (turn + seed) % 30
                batch = system.f.batch(xs[:rows], us[:rows])
                i = turn % 30
                if not (
                    np.allclose(batch, expected[:rows], 1e-12, 1e-12)
                    and np.allclose(system.f(xs[i], us[i]), expected[i], 1e-12, 1e-12)
                    and system.f_jacobian(xs[i], us[i]).shape == (4, 4)
                ):
                    wrong.append((seed, turn))
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


def estimator(system, **options):
    n, p = system.n, system.p
    generator = np.random.default_rng(3)
    cost = qpmhe.QuadraticCost(
        prior=np.eye(n), disturbance=30.0 * np.eye(n), noise=10.0 * np.eye(p)
    )
    observer = options.pop("observer", None) or qpmhe.Luenberger(
        generator.uniform(0.0, 0.1, (n, p))
    )
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=5, initial_state=0.1 * np.ones(n), **options
    )


RUNS = {
    "converged": {"max_qps": None}, "best": {"max_qps": 2, "warm_start": True},
    "observer": {"max_qps": 0}, "reinitialized": {"candidate": "reinitialized"},
    "Kalman": {"max_qps": 1},
}


@pytest.mark.parametrize("compiled", BOTH)
@pytest.mark.parametrize("case", RUNS)
@pytest.mark.parametrize(("name", "dt"), [("crane", 0.05), ("pond", None)])
def test_estimates_are_those_of_a_plain_system(name, dt, case, compiled):
    systems = made(name, compiled, dt=dt), twin(name, dt)
    step, h = plain_step(name, dt, "rk4"), numeric(name, "h")
    n, p, m = MODELS[name][2:]
    both = []
    for system in systems:
        options = dict(RUNS[case])
        if case == "Kalman":
            options["observer"] = qpmhe.ExtendedKalman(
                prior=np.eye(n), disturbance=0.1 * np.eye(n), noise=0.1 * np.eye(p)
            )
        both.append(estimator(system, **options))
    generator = np.random.default_rng(1)
    x = 0.3 * np.ones(n)
    for t in range(15):
        u = generator.uniform(-0.3, 0.3, m)
        y = h(x, u) + 0.05 * generator.standard_normal(p)
        if t % 5 == 3:
            y[t % p] = np.nan
        x = step(x, u) + 0.02 * generator.standard_normal(n)
        given = {} if dt is None or t % 4 != 2 else {"dt": 0.08}
        one, two = (mhe.update(y, u if m else None, **given) for mhe in both)
        for label in ("trajectory", "candidate", "disturbances"):
            np.testing.assert_allclose(
                getattr(one, label), getattr(two, label), rtol=1e-10, atol=1e-10
            )
        assert one.cost == pytest.approx(two.cost, rel=1e-9, abs=1e-12)
        assert one.status == two.status
    np.testing.assert_allclose(both[0].covariances(), both[1].covariances(), 1e-8, 1e-10)


@pytest.mark.parametrize("compiled", BOTH)
@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("name", MODELS)
def test_irregular_steps(name, method, compiled):
    system, other = made(name, compiled, dt=0.1, method=method), twin(name, 0.1, method)
    xs, us = points(name, 8)
    lengths = np.linspace(0.01, 0.3, 8)[:, None]
    timed = np.hstack((us, lengths))
    found, expected = system.timed, other.timed
    assert (found.n, found.p, found.m) == (expected.n, expected.p, expected.m)
    step = plain_step(name, 0.1, method)
    for x, u, dt in zip(xs, us, lengths[:, 0], strict=True):
        given = np.append(u, dt)
        np.testing.assert_allclose(found.f(x, given), step(x, u, dt), 1e-13, 1e-13)
        matrix = slopes(lambda z, u, dt=dt: step(z, u, dt), x, u)
        np.testing.assert_allclose(found.f_jacobian(x, given), matrix, 1e-12, 1e-12)
    for one, two in (
        (found.f, expected.f), (found.h, expected.h), (found.h_jacobian, expected.h_jacobian)
    ):
        np.testing.assert_allclose(one.batch(xs, timed), two.batch(xs, timed), 1e-12, 1e-12)
    assert found is system.timed


def test_a_map_has_no_other_steps():
    with pytest.raises(InvalidInputError, match="discrete"):
        _ = made("pond", False).timed


def value_of(data):
    system, x, u = pickle.loads(data)
    return system.f(x, u), system.f_jacobian(x, u), system.timed.f(x, np.append(u, 0.2))


@pytest.mark.parametrize("compiled", BOTH)
def test_pickled_here_and_in_a_spawned_process(compiled, monkeypatch):
    box = qpmhe.Box([-9.0] * 4, [9.0] * 4)
    system = from_casadi(*symbolic("crane", "SX"), dt=0.1, compiled=compiled, states=box)
    xs, us = points("crane", 1)
    data = pickle.dumps((system, xs[0], us[0]))
    expected = value_of(pickle.dumps((made("crane", compiled, dt=0.1), xs[0], us[0])))
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        there = pool.submit(value_of, data).result(timeout=60)
    for found in (value_of(data), there):
        for one, two in zip(found, expected, strict=True):
            assert np.array_equal(one, two)
    again = pickle.loads(data)[0]
    assert (again.n, again.p, again.m, again.dt) == (4, 2, 2, 0.1)
    assert np.array_equal(again.states.lower, box.lower)


def test_estimators_are_pickled_with_it():
    mhe = estimator(made("pond", False))
    for y in (0.1, 0.2, 0.3):
        mhe.update([y])
    other = pickle.loads(pickle.dumps(mhe))
    assert np.array_equal(other.update([0.2]).trajectory, mhe.update([0.2]).trajectory)


@pytest.mark.parametrize("compiled", BOTH)
def test_observer_designs_and_parameters(compiled):
    system, other = made("pond", compiled), twin("pond")
    for options in ({"poles": [0.3, 0.4]}, {"disturbance": np.eye(2), "noise": [[0.1]]}):
        gains = [
            qpmhe.design_luenberger(one, [0.5, 0.8], **options).gain for one in (system, other)
        ]
        np.testing.assert_allclose(*gains, rtol=1e-7, atol=1e-9)
    # A parameter as an input of CasADi's function, and as a part of the state.
    x, theta = ca.SX.sym("x", 2), ca.SX.sym("theta", 1)
    f = ca.Function("f", [x, theta], [ca.vertcat(theta * x[0], 0.5 * x[1] + ca.sin(x[0]))])
    h = ca.Function("h", [x, theta], [x[1]])
    inner = from_casadi(f, h, compiled=compiled)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        joint = qpmhe.augment_parameters(inner.f, inner.h, n=2, p=1, nominal=[0.7])
    z = np.array([0.4, -0.2, 0.6])
    np.testing.assert_allclose(
        joint.f(z, NONE), [0.24, -0.1 + np.sin(0.4), 0.6], rtol=1e-14
    )
    matrix = [[0.6, 0.0, 0.4], [np.cos(0.4), 0.5, 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(joint.f_jacobian(z, NONE), matrix, atol=1e-8)
    batch = np.array([z, 2.0 * z, -z])
    np.testing.assert_allclose(
        joint.f.batch(batch, np.zeros((3, 0)))[1], joint.f(2.0 * z, NONE), rtol=1e-14
    )


def test_without_a_compiler_the_virtual_machine_evaluates(monkeypatch):
    monkeypatch.setenv("CC", "/nowhere/cc")
    f, h = symbolic("pond", "SX")
    system = from_casadi(f, h)
    x = np.array([0.3, 0.4])
    np.testing.assert_allclose(system.f(x, NONE), numeric("pond", "f")(x), rtol=1e-14)
    with pytest.raises(CompilationError, match="compiler"):
        from_casadi(f, h, compiled=True)


X, U = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
F, H = ca.Function("f", [X], [0.9 * X]), ca.Function("h", [X], [X[0]])
FU = ca.Function("f", [X, U], [0.9 * X + U])
WRONG = {
    "n": ((F, H), {"n": 3}, ModelError, "n is 2.*expected 3"),
    "p": ((F, H), {"p": 2}, ModelError, "p is 1.*expected 2"),
    "m": ((FU, H), {"m": 2}, ModelError, "m is 1.*expected 2"),
    "no n": ((lambda x: x, H), {}, InvalidInputError, "n is missing"),
    "n = 0": ((lambda x: x, H), {"n": 0}, OptionError, "n is 0"),
    "m < 0": ((lambda x: x, H), {"n": 2, "m": -1}, OptionError, "m is -1"),
    "size of f": ((lambda x: x[0], H), {"n": 2}, ModelError, "f is 1.*expected 2"),
    "size of x": (
        (F, ca.Function("h", [ca.SX.sym("x", 3)], [1.0])), {}, ModelError, "h takes.*n = 2"
    ),
    "matrix": (
        (ca.Function("f", [ca.SX.sym("x", 2, 2)], [1.0]), H), {}, ModelError, "f "
    ),
    "two outputs": ((ca.Function("f", [X], [X, X]), H), {}, ModelError, "2 outputs"),
    "three inputs": (
        (ca.Function("f", [X, U, ca.SX.sym("q")], [X]), H), {}, ModelError, "3 inputs"
    ),
    "no output": ((lambda x: x, lambda x: []), {"n": 2}, QpmheError, "p is 0"),
    "None": ((None, H), {"n": 2}, ModelError, "f is None.*casadi"),
    "expression": ((X, H), {"n": 2}, ModelError, "f is SX"),
    "text": ((F, "h"), {}, ModelError, "h is 'h'"),
    "returns text": ((lambda x: "x", H), {"n": 2}, ModelError, "(?s)f cannot be evaluated.*System"),
    "raises": ((F, lambda x: 1 / 0), {}, ModelError, "h cannot.*ZeroDivisionError"),
    "branches": (
        (lambda x: x if x[0] > 0 else -x, H), {"n": 2}, ModelError, "f cannot.*casadi"
    ),
    "arguments": ((lambda x, u: x, H), {"n": 2}, ModelError, "f "),
    "method": ((F, H), {"dt": 0.1, "method": "heun"}, OptionError, "method is 'heun'.*rk4"),
    "dt = 0": ((F, H), {"dt": 0.0}, OptionError, "dt is 0.0"),
    "dt < 0": ((F, H), {"dt": -0.1}, OptionError, "dt is -0.1"),
    "dt": ((F, H), {"dt": "0.1"}, OptionError, "dt is '0.1'"),
    "dt = nan": ((F, H), {"dt": np.nan}, OptionError, "dt is nan"),
    "X": ((F, H), {"states": qpmhe.Box([0.0], [1.0])}, SetError, "states has dimension 1"),
    "V": ((F, H), {"noises": [0.0, 1.0]}, SetError, "noises is"),
    "compiled": ((F, H), {"compiled": "no"}, OptionError, "compiled is 'no'"),
    "type of n": ((F, H), {"n": "2"}, QpmheError, "n is '2'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_fails_at_construction(case):
    functions, options, error, text = WRONG[case]
    with pytest.raises(error, match=text):
        from_casadi(*functions, **{"compiled": False, **options})


@pytest.mark.parametrize("compiled", BOTH)
def test_states_of_a_wrong_size_are_not_broadcast(compiled):
    system = made("crane", compiled)
    with pytest.raises((ValueError, ShapeError)):
        system.f(np.zeros(3), np.zeros(2))
    with pytest.raises((ValueError, ShapeError)):
        system.f.batch(np.zeros((5, 4)), np.zeros((3, 2)))


def test_constants_of_nan_are_told():
    """math.sin turns a symbol into NaN without a word; the estimator must not start so."""
    system = from_casadi(
        lambda x: [math.sin(x[0]), x[1]], lambda x: x[0], n=2, compiled=False
    )
    with pytest.raises(ModelError, match=r"f is .*nan"):
        estimator(system)


@pytest.mark.parametrize("compiled", [None, *BOTH])
def test_functions_without_code(compiled):
    """What CasADi cannot write as C is evaluated by it, or refused where C was asked for."""
    z, q, x = ca.SX.sym("z"), ca.SX.sym("q"), ca.MX.sym("x", 2)
    root = ca.rootfinder("root", "newton", {"x": z, "p": q, "g": z + 0.1 * ca.sin(z) - q})
    f = ca.Function("f", [x], [ca.vertcat(root(0, x[0]), 0.5 * x[1])])
    h = ca.Function("h", [x], [x[0]])
    if compiled:
        with pytest.raises(CompilationError):
            from_casadi(f, h, compiled=True)
        return
    system = from_casadi(f, h, compiled=compiled)
    z = system.f(np.array([0.7, 0.2]), NONE)
    assert z[0] + 0.1 * np.sin(z[0]) == pytest.approx(0.7, abs=1e-7)


def test_an_input_of_the_output_alone():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    system = from_casadi(
        ca.Function("f", [x], [0.5 * x]), ca.Function("h", [x, u], [x[0] * u]), compiled=False
    )
    assert system.m == 1
    assert system.h(np.array([2.0, 1.0]), np.array([3.0])) == [6.0]


def falling(case):
    """Models of two states whose evaluation breaks off for x0 beyond 1: f, h, and h's values."""
    x, z, q = ca.MX.sym("x", 2), ca.SX.sym("z"), ca.SX.sym("q")
    if case == "linear solver":
        matrix = ca.densify(ca.diag(ca.vertcat(ca.fmax(1 - x[0], 0), 1)))
        h, value = ca.solve(matrix, ca.vertcat(1, x[1]))[0], lambda x: 1 / (1 - x[0])
    elif case == "QP":  # x0 <= r <= 1, near x1
        quiet = {"print_iter": False, "print_header": False, "print_info": False}
        dense = {"h": ca.Sparsity.dense(1, 1), "a": ca.Sparsity.dense(2, 1)}
        qp = ca.conic("qp", "qrqp", dense, quiet)
        h = qp(h=1, a=ca.DM([1, 1]), g=-x[1], lba=ca.vertcat(x[0], -ca.inf),
               uba=ca.vertcat(ca.inf, 1))["x"]
        try:
            ca.jacobian(h, x)
        except RuntimeError:
            pytest.skip("this CasADi has no derivatives of QPs")
        value = lambda x: min(max(x[0], x[1]), 1)  # noqa: E731
    else:  # raises
        root = ca.rootfinder(
            "root", "fast_newton", ca.Function("g", [z, q], [z**2 - 1 + q]), {"max_iter": 50}
        )
        h, value = root(1.0, x[0]), lambda x: math.sqrt(1 - x[0])
    f = ca.Function("f", [x], [0.9 * x])
    return f, ca.Function("h", [x], [h + 0 * x[1]]), value


FALLING = ["linear solver", "QP", "root"]


@pytest.mark.parametrize("case", FALLING)
def test_an_evaluation_that_breaks_off_is_no_number(case):
    f, h, value = falling(case)
    system = from_casadi(f, h, compiled=False)
    xs = np.array([[0.5, 0.2], [3.0, 0.1], [0.25, 0.3], [2.0, 0.4], [-0.2, 0.5]])
    us, bad = np.zeros((5, 0)), np.array([False, True, False, True, False])
    expected = np.array([[np.nan if k else value(x)] for x, k in zip(xs, bad, strict=True)])
    for _ in range(2):
        for x, y in zip(xs, expected, strict=True):
            np.testing.assert_allclose(system.h(x, NONE), y, rtol=1e-9)
            assert np.isnan(system.h_jacobian(x, NONE)).any() == np.isnan(y)
            # What can be evaluated is, whatever is asked for beside it.
            ahead, output, slope = system.kernel.stage(x, NONE)
            np.testing.assert_allclose(ahead, 0.9 * x)
            np.testing.assert_allclose(output, y, rtol=1e-9)
            np.testing.assert_allclose(slope[:2], 0.9 * np.eye(2))
        np.testing.assert_allclose(system.h.batch(xs, us), expected, rtol=1e-9)
        np.testing.assert_allclose(system.f.batch(xs, us), 0.9 * xs)
        slopes = system.h_jacobian.batch(xs, us)
        np.testing.assert_array_equal(np.isnan(slopes).any(axis=(1, 2)), bad)
        residuals = system.kernel.residuals(np.vstack((xs, xs[:1])), np.zeros((5, 1)), us)
        np.testing.assert_allclose(residuals[:, 2:], -expected, rtol=1e-9)
        np.testing.assert_allclose(residuals[:, :2], np.roll(xs, -1, axis=0) - 0.9 * xs)


@pytest.mark.skipif(find_compiler() is None, reason="no compiler")
def test_an_evaluation_that_breaks_off_in_compiled_code():
    f, h, value = falling("QP")
    system = from_casadi(f, h, compiled=True)
    xs, us = np.array([[0.5, 0.2], [3.0, 0.1], [-0.2, 0.5]]), np.zeros((3, 0))
    expected = np.array([[value(xs[0])], [np.nan], [value(xs[2])]])
    np.testing.assert_allclose(system.h.batch(xs, us), expected)
    np.testing.assert_array_equal(np.isnan(system.h_jacobian.batch(xs, us)), [
        [[False] * 2], [[True] * 2], [[False] * 2]])


@pytest.mark.skipif(find_compiler() is None, reason="no compiler")
def test_rootfinders_that_do_not_tell_are_not_compiled():
    f, h, value = falling("root")
    with pytest.raises(CompilationError, match="fast_newton"):
        from_casadi(f, h, compiled=True)
    system = from_casadi(f, h)  # evaluated by CasADi
    assert system.h(np.array([0.5, 0.0]), NONE)[0] == pytest.approx(value([0.5, 0.0]))
    assert np.isnan(system.h(np.array([3.0, 0.0]), NONE)[0])


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("case", FALLING)
def test_a_step_in_which_the_evaluation_breaks_off(case):
    f, h, _ = falling(case)
    system = from_casadi(f, h, compiled=False)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=[[5.0]])
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5, 0.1]), cost, horizon=3, initial_state=[0.4, 0.0],
        max_qps=2,
    )
    start = mhe.update([0.5])
    assert qpmhe.Status.IMPROVED in start.status
    mhe.update([60.0])  # throws the observer to where h cannot be evaluated
    failed = mhe.update([0.5])
    assert failed.candidate[-2, 0] > 1
    assert qpmhe.Status.MODEL_FAILED in failed.status
    assert failed.candidate_cost == np.inf
    assert np.isfinite(failed.state).all()
    later = [mhe.update([0.5]) for _ in range(6)]
    assert qpmhe.Status.IMPROVED in later[-1].status
    assert np.isfinite(later[-1].cost)


@pytest.mark.parametrize("compiled", BOTH)
@pytest.mark.parametrize("way", ["function", "inner", "callable", "mapped"])
def test_assertions_hold(way, compiled):
    """A state at which one fails has no value, however the model is evaluated."""
    x = ca.MX.sym("x", 2)
    checked = x.attachAssert(x[0] > -1, "below the sensor")
    inner = ca.Function("inner", [x], [checked[0] + 0.1 * checked[1] ** 2])
    h = {
        "function": inner,
        "inner": ca.Function("h", [x], [ca.if_else(x[1] > 9, 0, inner(x), True)]),
        "callable": lambda x: inner(x),
        "mapped": ca.Function("h", [x], [ca.sum2(inner.map(2)(ca.horzcat(x, x))) / 2]),
    }[way]
    system = from_casadi(ca.Function("f", [x], [0.9 * x]), h, compiled=compiled)
    xs, us = np.array([[0.5, 1.0], [-2.0, 1.0], [2.0, 0.0]]), np.zeros((3, 0))
    expected = np.array([[0.6], [np.nan], [2.0]])
    for x, y in zip(xs, expected, strict=True):
        np.testing.assert_allclose(system.h(x, NONE), y)
    np.testing.assert_allclose(system.h.batch(xs, us), expected)
    np.testing.assert_allclose(system.f.batch(xs, us), 0.9 * xs)
