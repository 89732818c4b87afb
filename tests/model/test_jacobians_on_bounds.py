"""A Jacobian that is not finite on a bound of X is taken a small step inside."""

import casadi
import numpy as np
import pytest

import qpmhe
from qpmhe.model.derivatives import Jacobian

DRAIN = 0.1


def level(x):
    return x - DRAIN * np.sqrt(x)


def slope(x):
    return np.array([[1.0 - 0.5 * DRAIN / np.sqrt(x[0])]])


def raising(x):
    if x[0] == 0.0:
        raise ZeroDivisionError
    return slope(x)


def identity(x):
    return x


def system(kind):
    options = {"n": 1, "p": 1, "states": qpmhe.Box([0.0], [np.inf])}
    if kind == "casadi":
        return qpmhe.from_casadi(lambda x: x - DRAIN * casadi.sqrt(x), identity, **options)
    given = {"given": slope, "raising": raising}.get(kind)
    return qpmhe.System(level, identity, f_jacobian=given, **options)


def run(kind, engine):
    mhe = qpmhe.MovingHorizonEstimator(
        system(kind), qpmhe.Luenberger([[0.3]]), engine=engine, horizon=4, initial_state=[0.0],
        cost=qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0),
    )
    return [mhe.update([y]) for y in (0.0, -0.1, 0.2, 0.1, 0.0, -0.2, -0.3, 0.4)]


@pytest.mark.parametrize(
    ("kind", "engine"),
    [("traced", "python"), ("traced", "compiled"), ("casadi", "python"), ("casadi", "compiled"),
     ("given", "python"), ("raising", "python")],
)
@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning")
def test_the_step_goes_on_where_the_exact_jacobian_is_infinite(kind, engine):
    estimates = run(kind, engine)
    assert not any(qpmhe.Status.MODEL_FAILED in one.status for one in estimates)
    assert sum(qpmhe.Status.IMPROVED in one.status for one in estimates) > 4
    reference = run("traced", "python")
    np.testing.assert_allclose(
        [one.cost for one in estimates], [one.cost for one in reference], rtol=1e-6, atol=1e-12
    )


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e4])
def test_the_step_inside_is_of_the_magnitude_of_the_states(unit):
    def given(x):
        return np.array([[0.5 / np.sqrt(x[0])]])

    box = qpmhe.Box([0.0], [np.inf])
    one = qpmhe.System(np.sqrt, identity, n=1, p=1, f_jacobian=given, states=box, scales=[unit])
    assert isinstance(one.f_jacobian, Jacobian)
    with np.errstate(divide="ignore"):
        found = one.f_jacobian.batch(np.array([[0.0], [4.0 * unit]]), np.zeros((2, 0)))
    inside = 0.25 / found[0, 0, 0] ** 2
    assert 1e-4 * unit < inside < 1e-2 * unit
    assert found[1, 0, 0] == 0.25 / np.sqrt(unit)


BEACONS = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])


def ranges(x):
    return np.stack([np.hypot(x[..., 0] - a, x[..., 1] - b) for a, b in BEACONS], -1)


def radar(x):
    return np.stack([np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], -1)


def speed(x):
    return np.stack([x[..., 0], x[..., 1], np.sqrt(x[..., 2] ** 2 + x[..., 3] ** 2)], -1)


def drift(x):
    return np.stack(
        [x[..., 0] + 0.1 * x[..., 2], x[..., 1] + 0.1 * x[..., 3], x[..., 2], x[..., 3]], -1)


def friction(x):
    v = x[..., 1]
    return np.stack([x[..., 0] + 0.1 * v, v + 0.1 - 0.02 * np.sign(v) * np.sqrt(np.abs(v))], -1)


# Functions, noise, a path that starts beside the point without derivative.
SINGULAR = {
    "at a beacon": (lambda x: x, ranges, 0.05, [0.3, 0.2], [0.1, 0.05]),
    "radar at its origin": (lambda x: x, radar, 0.02, [0.3, 0.2], [0.1, 0.05]),
    "speed at rest": (drift, speed, 0.05, [0.0, 0.0, 0.5, 0.3], None),
    "friction at rest": (friction, lambda x: x[..., :1], 0.02, [0.0, 0.05], None),
}


@pytest.mark.parametrize("engine", ["python", "compiled"])
@pytest.mark.parametrize("name", SINGULAR)
def test_a_start_without_derivative_ends_as_one_beside_it(name, engine):
    f, h, sigma, start, move = SINGULAR[name]
    n, rng, path = len(start), np.random.default_rng(1), [np.array(start)]
    for _ in range(40):
        path.append(path[-1] + np.array(move) if move else f(path[-1]))
    path = np.array(path)
    clean = h(path[:-1])
    ys, p = clean + sigma * rng.normal(size=clean.shape), clean.shape[1]
    system = qpmhe.System(f, h, n=n, p=p)
    given = {"disturbance": 0.05 * np.eye(n), "noise": sigma**2 * np.eye(p)}
    found, flag = [], qpmhe.Status.DERIVATIVE_NEARBY
    for begin in (np.zeros(n), 1e-9 * np.arange(1, n + 1)):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.ExtendedKalman(prior=np.eye(n), **given),
            qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **given),
            horizon=10, initial_state=begin, max_qps=None, engine=engine,
        )
        run = mhe.run(ys)
        assert mhe.engine == engine
        assert not any(qpmhe.Status.MODEL_FAILED in one for one in run.statuses)
        assert (run.costs >= 0.0).all()
        # Only the first step asks for a derivative where there is none, and says so.
        assert [flag in one for one in run.statuses] == [not begin.any()] + 39 * [False]
        found.append(run.filtered)
    assert "nearby" in flag.explain()
    assert np.abs(found[0][35:] - found[1][35:]).max() < 0.1
    assert np.abs(found[0][20:, :2] - path[20:-1, :2]).max() < 0.6


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_covariances_of_observers_stay_semidefinite_whatever_the_model_does(engine):
    """Near an empty tank a derivative is 1e8; its square costs all digits of a covariance."""
    def tanks(x):
        outflow = 0.2 * np.sqrt(np.abs(x) + 1e-18)
        return np.stack([x[..., 0] - outflow[..., 0],
                         x[..., 1] + outflow[..., 0] - outflow[..., 1],
                         x[..., 2] + outflow[..., 1] - outflow[..., 2]], -1)

    system = qpmhe.System(tanks, lambda x: x[..., 2:], n=3, p=1)
    given = {"disturbance": 1e-4 * np.eye(3), "noise": [[1e-2]]}
    lost = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.ExtendedKalman(prior=np.eye(3), **given),
            qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **given),
            horizon=4, initial_state=np.zeros(3), engine=engine,
        )
        assert mhe.engine == engine
        for _ in range(40):
            estimate = mhe.update(rng.choice([0.0, 1e-9, 1.0]) * rng.normal(size=1))
            assert 0.0 <= estimate.cost <= estimate.candidate_cost
            lost += qpmhe.Status.MODEL_FAILED in estimate.status
    assert lost < 240
