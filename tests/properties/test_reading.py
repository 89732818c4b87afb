"""Reading changes nothing that follows: an estimator read at every sample equals its twin."""

import contextlib
import copy
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import QpmheError
from qpmhe.solvers import available
from tests.codegen.cases import FEATURES, Case, case
from tests.estimation.same import assert_same
from tests.estimation.systems import Pendulum

# Without inequalities, and ProxQP's dense solver: even of two equal QPs in a row, solved by two new
# solvers, its last digit depends on where memory happens to lie.
NO_BITS = "banded", "proxqp"

# Of an observer that is far from the estimates: both estimators warn alike.
pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")

# One case of each feature is compiled, and those in which a window or a cost is unusual.
COMPILED = [next(iter(table)) for table in FEATURES.values()] + [
    "held, graduated", "fewer disturbances extended", "own losses", "extended failing",
]
RUNS = [("python", name) for table in FEATURES.values() for name in list(table)[::3]
        if name != "tank in time"]
RUNS += [("compiled", name) for name in dict.fromkeys(COMPILED) if find_compiler() is not None]
# What needs a form that a user's function lacks, or a state of the window that is not there.
refused = contextlib.suppress(QpmheError)


def read(mhe, estimate):
    """Read everything that an estimator and its estimate can be asked for."""
    for ask in (
        mhe.state_dict, mhe.covariances, mhe.sensitivity, mhe.__repr__, mhe.settings.__repr__,
        mhe.system.explain, estimate.explain, estimate.__repr__, lambda: copy.deepcopy(mhe),
    ):
        with refused:
            ask()
    for one in (mhe, estimate):
        for name in dir(one):
            if not name.startswith("_"):
                getattr(one, name)


def follow(one, engine, samples, restored_at=(2, 11), **options):
    """Two estimators of a case, of which one is read, and others that continue from its states."""
    mhe, twin, *others = one.estimator(engine, **options), one.estimator(engine, **options)
    for t, sample in enumerate(one.samples[:samples]):
        if t in one.changes:
            for each in (mhe, twin, *others):
                each.set(**one.changes[t])
        expected, found = twin.update(**sample), mhe.update(**sample)
        assert_same(found, expected)
        for other in others:
            assert_same(other.update(**sample), expected)
        read(mhe, found)
        if t in restored_at:
            # What a QP solver keeps is in no snapshot.
            for each in (mhe, twin, *others):
                each.forget_warm_start()
            others.append(one.estimator(engine, **options))
            others[-1].load_state_dict(mhe.state_dict())
    assert mhe.engine == twin.engine == engine


@pytest.mark.parametrize(("engine", "name"), RUNS)
def test_of_every_feature(engine, name):
    follow(case(name), engine, 14)


def tanks(x, u):
    out = 0.2 * np.sqrt(x)
    return np.array([x[0] + u[0] - out[0], x[1] + out[0] - out[1]])


def levels(x):
    return np.array([x[1], np.sqrt(x[0])])


@pytest.mark.slow
@pytest.mark.parametrize("options", [
    {"max_qps": None}, {"max_qps": 5, "warm_start": True}, {"infeasible": "restore"},
    *({"backend": name} for name in available() if ":" not in name and name not in NO_BITS),
], ids=str)
def test_of_every_backend(options):
    """Solvers keep factors, multipliers and step sizes, of which a snapshot knows nothing."""
    generator = np.random.default_rng(0)
    terms = {"disturbance": 0.01 * np.eye(2), "noise": 0.05 * np.eye(2)}
    tank = Case(
        qpmhe.System(tanks, levels, n=2, p=2, m=1, states=qpmhe.Box([0.0] * 2, [np.inf] * 2)),
        qpmhe.ExtendedKalman(prior=np.eye(2), **terms),
        qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **terms), [1.0, 1.0],
        tuple({"y": 0.8 * generator.normal(size=2) + 0.3, "u": [0.1]} for _ in range(24)),
        {"horizon": 3},
    )
    follow(tank, "python", 24, (2, 17), **options)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["traced", "untraced", "state by state"])
def test_however_the_model_is_called(how):
    """Which way to call a model works is found while it is called, by readers as well."""
    pendulum = Pendulum(1.0, 0.1, how != "traced")

    def rate(x, u):
        if how == "state by state" and x.ndim > 1:
            raise ValueError("one state at a time")
        return pendulum.rate(x, u)

    system = qpmhe.System.from_ode(rate, pendulum.h, n=2, p=1, m=1, dt=0.1, method="euler")
    inputs = case("inputs")
    for observer in (qpmhe.Luenberger([0.3, 0.4]), qpmhe.UnscentedKalman(
        prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=np.eye(1)
    )):
        cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=10.0 * np.eye(2), noise=np.eye(1))
        samples = tuple({"y": one["y"][:1], "u": one["u"][:1]} for one in inputs.samples)
        one = replace(inputs, system=system, observer=observer, cost=cost, start=[0.5, 0.0],
                      samples=samples)
        for options in ({}, {"max_qps": 0}):
            follow(one, "python", 16, **options)


def turning(x):
    return np.array([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + 0.1 * np.sin(x[0])])


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize("loss", [qpmhe.Cauchy, lambda weight: qpmhe.Huber(weight, 0.1)])
def test_of_a_disturbance_of_lower_dimension_beside_a_robust_cost(loss):
    """The observer's corrections have a part in directions without disturbances."""
    terms = {"disturbance": [[0.002]], "noise": [[0.1]]}
    for fixed in (False, True):
        sets = {"disturbances": qpmhe.Box([0.0], [0.0])} if fixed else {}
        one = Case(
            qpmhe.System(
                turning, lambda x: x[:1], n=2, p=1, disturbance_matrix=[[1.0], [0.02]], **sets
            ),
            qpmhe.ExtendedKalman(prior=np.eye(2), **terms),
            qpmhe.RobustCost(
                prior=np.diag([1.0, 1e4]), disturbance=[[500.0]], noise=loss([[10.0]]),
                discount=0.95,
            ),
            [1.0, 0.0],
            tuple(
                {"y": [np.sin(0.3 * t) + 3.0 * (t == 6)]}
                | ({"disturbance_weight": [[20.0]]} if t == 9 else {})
                for t in range(14)
            ),
            {"horizon": 4}, changes={7: {"disturbance_weight": [[50.0]]}},
        )
        for engine in ("python", "compiled"):
            follow(one, engine, 14, (2, 6, 8, 10))
