"""The compiled step against the Python one, where no inequality is active."""

import functools
import math
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.models.batch_reactor import batch_reactor
from qpmhe.models.batch_reactor import casadi_output as reactor_output
from qpmhe.models.batch_reactor import casadi_rate as reactor_rate
from qpmhe.models.chain import casadi_output, casadi_rate, chain_of_masses
from tests.codegen.test_agreement import agree

from .plain import spd

casadi = pytest.importorskip("casadi")
pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

STEPS = 30


class Model(NamedTuple):
    """A system with all that an estimator of it needs, and a record."""

    system: qpmhe.System
    observer: Any
    cost: qpmhe.QuadraticCost
    start: np.ndarray
    Y: np.ndarray
    U: np.ndarray | None
    horizon: int


def system_of(f, h, **options):
    # The Python side is evaluated by CasADi's virtual machine: nothing in common but the model.
    return qpmhe.from_casadi(f, h, compiled=False, **options)


def weights_of(seed, n, p):
    generator = np.random.default_rng(seed)
    return {"prior": spd(generator, n), "disturbance": 10 * spd(generator, n),
            "noise": spd(generator, p)}


def model_of(system, gain, start, horizon, seed=3, noise=0.1):
    """A model with weights that are not diagonal, and a record of it."""
    n, p, m = system.n, system.p, system.m
    generator = np.random.default_rng(seed)
    cost = qpmhe.QuadraticCost(**weights_of(seed, n, p))
    start = np.array(start, float)
    x, Y = start + 0.2 * generator.standard_normal(n), []
    U = generator.uniform(-1.0, 1.0, (STEPS, m))
    for u in U:
        Y.append(system.h(x, u) + noise * generator.standard_normal(p))
        x = system.f(x, u) + 0.02 * generator.standard_normal(n)
    return Model(
        system, qpmhe.Luenberger(gain), cost, start, np.array(Y), U if m else None, horizon
    )


def reactor(method):
    _, observer, cost, scenario = batch_reactor(method)
    system = system_of(reactor_rate, reactor_output, n=2, dt=scenario.dt, method=method)
    Y = scenario.simulate(1, STEPS).measurements
    return Model(system, observer, cost, scenario.initial_estimate, Y, None, 10)


def chain():
    _, observer, cost, scenario = chain_of_masses(2, 2)
    system = system_of(casadi_rate(2, 2), casadi_output(2, 2), n=8, dt=scenario.dt)
    Y = scenario.simulate(1, STEPS).measurements
    return Model(system, observer, cost, scenario.initial_estimate, Y, None, 5)


def with_inputs():
    def f(x, u):
        return [0.9 * x[0] + 0.2 * casadi.sin(x[1]) + 0.1 * u[0],
                0.8 * x[1] - 0.1 * x[0] ** 2 + 0.1 * u[0] * u[1]]

    system = system_of(f, lambda x, u: x[0] + 0.3 * u[1] * x[1], n=2, m=2)
    return model_of(system, [[0.2], [0.1]], [0.5, 0.5], 5)


def wide():
    """More outputs than states."""
    system = system_of(
        lambda x: [x[0] + 0.1 * x[1], 0.9 * x[1] - 0.3 * casadi.sin(x[0])],
        lambda x: [x[0], casadi.sin(x[0]) + x[1], x[0] * x[1]], n=2,
    )
    return model_of(system, [[0.1, 0.0, 0.05], [0.0, 0.1, 0.0]], [1.0, 0.5], 4)


def scalar():
    system = system_of(
        lambda x: 0.9 * x + 0.2 * casadi.sin(x), lambda x: [x[0] + 0.1 * x[0] ** 2, -x[0]], n=1
    )
    return model_of(system, [[0.2, -0.1]], [0.7], 3)


def three():
    def rate(x):
        return [4.0 * (x[1] - x[0]), x[0] * (2.0 - x[2]) - x[1], x[0] * x[1] - x[2]]

    system = system_of(rate, lambda x: [x[0] + x[2], x[1]], n=3, dt=0.05, method="euler")
    return model_of(system, [[0.1, 0.0], [0.0, 0.1], [0.05, 0.0]], [1.0, 1.0, 0.5], 4)


def large(n):
    generator = np.random.default_rng(n)
    A = 0.9 * np.eye(n) + 0.1 * generator.standard_normal((n, n)) / math.sqrt(n)
    C = generator.standard_normal((3, n))
    system = system_of(
        lambda x: casadi.mtimes(casadi.DM(A), x) + 0.05 * casadi.sin(x),
        lambda x: casadi.mtimes(casadi.DM(C), x), n=n,
    )
    return model_of(system, 0.02 * C.T, np.ones(n), 2)


MODELS = {
    "reactor euler": lambda: reactor("euler"), "reactor rk4": lambda: reactor("rk4"),
    "chain": chain, "inputs": with_inputs, "wide": wide, "n=1": scalar, "n=3": three,
    # Where the rows of the factorisation's panels change their padding.
    "n=23": lambda: large(23), "n=25": lambda: large(25),
}


@functools.cache
def made(name):
    return MODELS[name]()


def estimator(model, engine="compiled", cost=None, observer=None, **options):
    return qpmhe.MovingHorizonEstimator(
        model.system, observer or model.observer, cost or model.cost,
        **({"horizon": model.horizon, "initial_state": model.start, "engine": engine,
            "max_qps": 2} | options),
    )


def both(model, **options):
    """The Python estimator and the compiled one."""
    pair = estimator(model, "python", **options), estimator(model, **options)
    assert [one.engine for one in pair] == ["python", "compiled"]
    return pair


def input_at(model, t):
    return () if model.U is None else (model.U[t % STEPS],)


def close(expected, found, tolerance=1e-10):
    """Equality up to rounding of all that two estimates of a window say."""
    agree(expected, found, tolerance)


def follow(model, pair, steps=STEPS, tolerance=1e-10):
    """Give both the record, and compare each step; the estimates of the second."""
    estimates = []
    for t in range(steps):
        expected, found = (one.update(model.Y[t], *input_at(model, t)) for one in pair)
        close(expected, found, tolerance)
        estimates.append(found)
    return estimates


OPTIONS = {
    "observer": {"max_qps": 0},
    "1 qp": {"max_qps": 1},
    "3 qps": {"max_qps": 3, "delay": 1},
    "converged": {"max_qps": None, "delay": 2},
    "best": {"max_qps": 1, "warm_start": True},
    "best converged": {"max_qps": None, "warm_start": True},
    "reinitialized": {"candidate": "reinitialized"},
    "reinitialized best": {"candidate": "reinitialized", "warm_start": True},
    "loose": {"max_qps": None, "tolerance": 1e-3},
    "banded": {"backend": "banded"},
}


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("name", MODELS)
def test_the_same_estimates(name, options):
    model = made(name)
    estimates = follow(model, both(model, **OPTIONS[options]))
    improved = sum(e.improved for e in estimates)
    assert improved == 0 if options == "observer" else improved > STEPS / 2


@pytest.mark.parametrize("discount", [0.5, 0.9])
@pytest.mark.parametrize("name", ["reactor euler", "wide", "n=3", "inputs"])
def test_discounts(name, discount):
    model = made(name)
    weights = {name: getattr(model.cost, name) for name in ("prior", "disturbance", "noise")}
    cost = qpmhe.QuadraticCost(**weights, discount=discount)
    for options in ({"max_qps": 0}, {"max_qps": 3}, {"warm_start": True, "max_qps": None}):
        follow(model, both(model, cost=cost, **options))


def test_a_discount_that_underflows_within_the_window():
    """The oldest stages then weigh nothing: no reason for the factorisation to fail."""
    system = system_of(lambda x: 0.9 * x, lambda x: x + 0.1 * x**3, n=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=5.0, noise=5.0, discount=0.01)
    estimates = {}
    ys = 0.3 + 0.1 * np.sin(np.arange(200.0))
    for horizon in (20, 190):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.3]), cost, horizon=horizon, initial_state=[0.5],
            max_qps=3, engine="compiled",
        )
        estimates[horizon] = [mhe.update(y) for y in ys]
    assert 0.01**190 == 0
    for short, long in zip(*estimates.values(), strict=True):
        assert qpmhe.Status.SOLVER_FAILED not in long.status
        # What is 20 samples old weighs 1e-40.
        np.testing.assert_allclose(long.state, short.state, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "horizon"),
    [("reactor rk4", 1), ("reactor rk4", 2), ("inputs", 1), ("inputs", 2), ("inputs", 12)],
)
def test_horizons(name, horizon):
    model = made(name)
    for options in (
        {"delay": 1}, {"delay": horizon, "warm_start": True}, {"candidate": "reinitialized"},
    ):
        estimates = follow(model, both(model, horizon=horizon, **options))
        assert len(estimates[-1].trajectory) == horizon + 1


@pytest.mark.parametrize("name", ["reactor euler", "wide", "n=3"])
def test_steady_state_kalman(name):
    model = made(name)
    n, p = model.system.n, model.system.p
    observer = qpmhe.SteadyStateKalman(
        model.system, model.start, disturbance=0.01 * np.eye(n), noise=0.1 * np.eye(p)
    )
    follow(model, both(model, observer=observer))
    # Where the candidate is kept, the filtered estimate is the filter's own update of it.
    pair, updated = both(model, observer=observer, max_qps=0), False
    Y = model.Y[:12].copy()
    Y[3, 0] = Y[5] = np.nan
    for t, y in enumerate(Y):
        weight = 3.0 * np.eye(p) if t == 7 else None
        expected, found = (one.update(y, noise_weight=weight) for one in pair)
        close(expected, found)
        updated |= not np.array_equal(found.filtered, found.trajectory[-2])
    assert updated
    runs = [one.run(Y) for one in both(model, observer=observer, max_qps=0)]
    np.testing.assert_allclose(runs[1].filtered, runs[0].filtered, rtol=1e-10)


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_high_gain(method):
    system = system_of(
        lambda x: [x[1], -casadi.sin(x[0]) - 0.1 * x[1]], lambda x: x[0], n=2, dt=0.1,
        method=method,
    )
    model = model_of(system, [[0.5], [0.5]], [0.5, 0.0], 4)
    sampling = {"euler": "euler", "rk4": "exact"}[method]
    observer = qpmhe.HighGain(2, epsilon=0.2, dt=0.1, sampling=sampling)
    follow(model, both(model, observer=observer))


def test_jacobians_without_entries():
    """Components that do not depend on the state, and an output that depends on none."""
    system = system_of(lambda x, u: [u[0], 0.5], lambda x, u: 2.0 * u[0], n=2, m=1)
    model = model_of(system, [[0.1], [0.1]], [0.5, 0.5], 3)
    for options in ({"max_qps": 0}, {"max_qps": None}, {"warm_start": True}):
        follow(model, both(model, **options))


NOT_EXPANDED = """
import casadi, numpy as np, qpmhe
x = casadi.MX.sym("x", 2)
A = casadi.MX(np.array([[2.0, 0.3], [0.1, 1.5]])) + 0.1 * casadi.diag(x) ** 2
table = casadi.MX(casadi.DM([0.7, 0.8, 0.9]))[casadi.floor(casadi.fmin(casadi.fmax(x[0], 0), 2))]
f = {expression}
system = qpmhe.from_casadi(
    casadi.Function("f", [x], [f]), lambda x: x[0] + 0.1 * x[1] ** 2, n=2, compiled=False
)
assert not system.symbolic.f.is_a("SXFunction")
cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=10 * np.eye(2), noise=np.eye(1))
Y = np.random.default_rng(0).standard_normal((12, 1))
for options in (
    {{"max_qps": 0}}, {{"max_qps": 2}}, {{"warm_start": True}}, {{"candidate": "reinitialized"}},
):
    one, other = (
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.1, 0.1]), cost, horizon=4, initial_state=[1.1, 1.0],
            engine=engine, **options,
        ).run(Y)
        for engine in ("python", "compiled")
    )
    np.testing.assert_allclose(other.states, one.states, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(other.flags, one.flags)
"""


@pytest.mark.parametrize(
    "expression", ["0.9 * casadi.solve(A, x)", "casadi.vertcat(table * x[0], 0.8 * x[1])"]
)
def test_models_that_have_no_scalar_form(expression):
    # In a process of its own: too little scratch for such a model breaks the stack.
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", NOT_EXPANDED.format(expression=expression)],
        capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stderr[-500:]
