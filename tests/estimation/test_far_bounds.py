"""Bounds that a user writes for "none", and states that bounds fix, in every backend and engine."""

import functools

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.solvers import available
from tests.covering import covering

A, C = np.array([[1.0, 0.1], [-0.3, 0.9]]), np.array([[1.0, 0.0]])
COVARIANCES = {"prior": np.eye(2), "disturbance": 0.03**2 * np.eye(2), "noise": [[0.05**2]]}
BACKENDS = [name for name in available() if name != "banded"]
ENGINES = [f"python {name}" for name in BACKENDS] + ["compiled"]
FAR = [1e10, 1e20, 1.7e308]


def f(x):
    return x @ A.T


def h(x):
    return x @ C.T


@functools.cache
def measured():
    rng = np.random.default_rng(0)
    x, Y = np.array([0.5, -1.0]), []
    for _ in range(16):
        Y.append(C @ x + 0.05 * rng.standard_normal(1))
        x = A @ x + 0.03 * rng.standard_normal(2)
        x[0] = max(x[0], 0.0)
    return np.array(Y)


def run(kind, far, where="states"):
    """The first state is not negative, which is active in half of the samples."""
    engine, _, backend = kind.partition(" ")
    if engine == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    sets = {"states": qpmhe.Box([0.0, -np.inf], [np.inf, np.inf])}
    if where == "states":
        sets["states"] = qpmhe.Box([0.0, -far], [far, far])
    elif where == "rows":
        side = [0.0, far, far, far]
        sets["states"] = qpmhe.Polytope([[-1, 0], [1, 0], [0, 1], [-1, -1]], side)
    else:
        d = {"disturbances": 2, "noises": 1}[where]
        sets[where] = qpmhe.Box(np.full(d, -far), np.full(d, far))
    system = qpmhe.System(f, h, n=2, p=1, **sets)
    cost = qpmhe.QuadraticCost.from_covariances(**COVARIANCES)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(**COVARIANCES), cost, horizon=10, initial_state=[0.3, 0.0],
        engine=engine, max_qps=3, backend=backend or "auto",
    ).run(measured())


@functools.cache
def right():
    found = run("python auto", np.inf)
    assert (np.abs(found.states[:, 0]) < 1e-9).sum() > 4
    return found.states


@covering(far=FAR, where=["states", "disturbances", "noises", "rows"], kind=ENGINES)
def test_a_bound_that_means_none_changes_nothing(kind, where, far):
    found = run(kind, far, where)
    assert found.share(qpmhe.Status.IMPROVED) == 1.0
    np.testing.assert_allclose(found.states, right(), rtol=0, atol=1e-4)


def test_a_box_beyond_what_squares_can_hold_is_open():
    box = qpmhe.Box([-1.7e308, 0.0], [1.0, 1e200])
    assert box.lower[0] == -np.inf
    assert box.upper[1] == np.inf
    np.testing.assert_array_equal((box & box).upper, box.upper)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_state_that_bounds_fix_is_a_constant(backend):
    """The third state is 0.2: the estimates are those of the system without it."""
    drift, known = np.array([0.0, 0.05]), 0.2
    cov = {
        "prior": np.eye(3), "disturbance": np.diag([0.03**2, 0.03**2, 1e-8]), "noise": [[0.05**2]]
    }

    def three(x):
        own = x[..., :2] @ A.T + x[..., 2:] * drift
        return np.concatenate((own, x[..., 2:]), axis=-1)

    def two(x):
        return x @ A.T + known * drift

    part = {name: np.array(given)[:2, :2] for name, given in cov.items()}
    found = []
    for model, n, covariances in ((three, 3, cov), (two, 2, part)):
        bounds = np.full(n, -np.inf), np.full(n, np.inf)
        if n == 3:
            bounds[0][2] = bounds[1][2] = known
        bounds[0][0] = 0.0
        system = qpmhe.System(model, lambda x: x[..., :1], n=n, p=1, states=qpmhe.Box(*bounds))
        start = [0.3, 0.0, known][:n]
        found.append(qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(np.array([[0.5], [0.2], [0.0]])[:n]),
            qpmhe.QuadraticCost.from_covariances(**covariances), horizon=8, initial_state=start,
            max_qps=3, engine="python", backend=backend if n == 3 else "daqp",
        ).run(measured()))
    np.testing.assert_allclose(found[0].states[:, :2], found[1].states, rtol=0, atol=1e-4)
    assert not any(qpmhe.Status.SOLVER_FAILED in one for one in found[0].statuses)
