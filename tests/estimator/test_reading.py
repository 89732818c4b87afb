"""Reading an estimator never changes what follows, and every estimator takes its own snapshot."""

import copy
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe_solvers import available

from .same import assert_same

COMPILED = pytest.param("compiled", marks=pytest.mark.skipif(
    find_compiler() is None, reason="there is no C compiler"
))
WEIGHTS = {"prior": np.diag([1.0, 4.0]), "disturbance": 50.0 * np.eye(2), "noise": 20.0 * np.eye(2)}


def tanks(x, u):
    outflow = 0.2 * np.sqrt(x)
    return np.stack([x[..., 0] + u[..., 0] - outflow[..., 0],
                     x[..., 1] + outflow[..., 0] - outflow[..., 1]], -1)


def level(x):
    return np.stack([x[..., 1], np.sqrt(x[..., 0])], -1)


def covariances():
    return {name: np.linalg.inv(weight) for name, weight in WEIGHTS.items()}


OBSERVERS = {
    "constant": lambda: qpmhe.Luenberger([[0.1, 0.2], [0.2, 0.1]]),
    "ekf": lambda: qpmhe.ExtendedKalman(**covariances()),
    "gated": lambda: qpmhe.ExtendedKalman(**covariances(), innovation=qpmhe.Gate(0.9)),
}
COSTS = {
    "quadratic": lambda: qpmhe.QuadraticCost(**WEIGHTS),
    "huber": lambda: qpmhe.RobustCost(**WEIGHTS | {"noise": qpmhe.Huber(WEIGHTS["noise"], 1.0)}),
    "cauchy": lambda: qpmhe.RobustCost(**WEIGHTS | {"noise": qpmhe.Cauchy(WEIGHTS["noise"], 1.0)}),
}
PYTHON = [name for name in ("daqp", "osqp", "piqp", "clarabel") if name in available()]
WAYS = [
    *[(observer, cost, "python", {}) for observer in OBSERVERS for cost in COSTS],
    *[("ekf", "quadratic", "python", {"backend": name, "max_qps": 3}) for name in PYTHON],
    ("ekf", "huber", "python", {"candidate": "reinitialized", "max_qps": None}),
    ("constant", "quadratic", "python", {"arrival": "smoothed", "warm_start": True}),
]


def estimator(observer, cost, engine, options):
    system = qpmhe.System(tanks, level, n=2, p=2, m=1, states=qpmhe.Box([0, 0], [np.inf, np.inf]))
    return qpmhe.MovingHorizonEstimator(
        system, OBSERVERS[observer](), COSTS[cost](), horizon=3, initial_state=[1.0, 1.0],
        engine=engine, **options,
    )


def read_everything(mhe, estimate):
    """All that a user can read between two samples."""
    mhe.state_dict()
    copy.deepcopy(mhe)
    pickle.dumps(mhe)
    repr(mhe)
    for read in (mhe.covariances, mhe.sensitivity):
        try:
            read()
        except qpmhe.errors.InvalidInputError:  # along a stage that failed
            continue
    estimate.status.explain()
    for name in dir(estimate):
        if not name.startswith("_"):
            getattr(estimate, name)


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize(
    ("observer", "cost", "engine", "options"),
    [*WAYS, *[pytest.param(one, two, "compiled", {}, marks=COMPILED.marks) for one, two in (
        ("ekf", "quadratic"), ("gated", "cauchy"))]],
)
def test_an_estimator_that_is_read_goes_on_as_its_twin(observer, cost, engine, options):
    read, twin = (estimator(observer, cost, engine, options) for _ in range(2))
    assert read.engine == engine
    generator = np.random.default_rng(0)
    for t in range(40):
        y = 0.8 * generator.normal(size=2) + 0.3  # below 0 often, where the model fails
        estimate = read.update(y, [0.1])
        assert_same(estimate, twin.update(y, [0.1]))
        read_everything(read, estimate)
        if t % 10 == 7:  # and both go on as a third that takes over from them
            for one in (read, twin):
                one.forget_warm_start()
            other = estimator(observer, cost, engine, options)
            other.load_state_dict(read.state_dict())
            read = other


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("engine", ["python", COMPILED])
@pytest.mark.parametrize("still", [False, True])
@pytest.mark.parametrize("robust", [False, True])
def test_few_disturbances_and_robust_costs_take_their_own_snapshots(robust, still, engine):
    """The correction of the observer has a part in directions without disturbances."""
    def model(x):
        return np.stack([0.9 * x[..., 0] + 0.1 * x[..., 1],
                         0.8 * x[..., 1] + 0.1 * np.sin(x[..., 0])], -1)

    system = qpmhe.System(
        model, lambda x: x[..., :1], n=2, p=1, disturbance_matrix=[[1.0], [0.02]],
        disturbances=qpmhe.Box([0.0], [0.0]) if still else None,
    )
    observer = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=[[0.002]], noise=[[0.1]])
    weights = {"prior": np.diag([1.0, 1e4]), "disturbance": [[500.0]]}
    cost = (
        qpmhe.RobustCost(**weights, noise=qpmhe.Cauchy([[10.0]])) if robust
        else qpmhe.QuadraticCost(**weights, noise=[[10.0]])
    )

    def fresh():
        return qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=4, initial_state=[1.0, 0.0], engine=engine,
        )

    for change in (None, "set", "own"):
        one, restored = fresh(), fresh()
        assert one.engine == engine
        for t in range(12):
            own = {"disturbance_weight": [[20.0]]} if change == "own" and t == 9 else {}
            one.update([np.sin(0.3 * t)], **own)
        if change == "set":
            one.set(disturbance_weight=[[50.0]])
        one.forget_warm_start()
        restored.load_state_dict(one.state_dict())
        copied = copy.deepcopy(one)
        expected = one.update([0.5])
        assert_same(restored.update([0.5]), expected)
        assert_same(copied.update([0.5]), expected)
