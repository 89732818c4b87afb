"""The compiled step beside the Python one, on data and models that the table of cases lacks."""

import copy
import math
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError
from qpmhe.memory.snapshot import read

from .cases import Case, case, recorded, spd
from .test_agreement import ARRAYS, agree

casadi = pytest.importorskip("casadi")
pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]
ENGINES, STEPS, INF, NAN = ("python", "compiled"), 24, np.inf, np.nan


def system_of(f, h, **options):
    # The Python side is evaluated by CasADi's virtual machine: nothing in common but the model.
    return qpmhe.from_casadi(f, h, compiled=False, **options)


def estimator(system=None, cost=None, gain=0.3, **options):
    return qpmhe.MovingHorizonEstimator(
        system or system_of(lambda x: 0.9 * x, lambda x: x, n=1),
        options.pop("observer", qpmhe.Luenberger([gain])),
        cost or qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0),
        **{"horizon": 2, "initial_state": [0.0], "engine": "compiled"} | options,
    )


def case_of(system, gain, start, horizon=4):
    """A case with weights that are not diagonal, and a record of it."""
    cost = qpmhe.QuadraticCost(
        prior=spd(1, system.n), disturbance=10 * spd(2, system.n), noise=spd(3, system.p)
    )
    return Case(
        system, qpmhe.Luenberger(gain), cost, np.array(start, float), recorded(system, start),
        {"horizon": horizon, "max_qps": 2},
    )


def wide():
    """More outputs than states."""
    return case_of(system_of(
        lambda x: [x[0] + 0.1 * x[1], 0.9 * x[1] - 0.3 * casadi.sin(x[0])],
        lambda x: [x[0], casadi.sin(x[0]) + x[1], x[0] * x[1]], n=2,
    ), [[0.1, 0.0, 0.05], [0.0, 0.1, 0.0]], [1.0, 0.5])


def large(n):
    generator = np.random.default_rng(n)
    A = 0.9 * np.eye(n) + 0.1 * generator.standard_normal((n, n)) / math.sqrt(n)
    C = generator.standard_normal((3, n))
    return case_of(system_of(
        lambda x: casadi.mtimes(casadi.DM(A), x) + 0.05 * casadi.sin(x),
        lambda x: casadi.mtimes(casadi.DM(C), x), n=n,
    ), 0.02 * C.T, np.ones(n), 2)


MODELS = {
    "wide": wide,
    # Where the rows of the factorisation's panels change their padding.
    "n=25": lambda: large(25), "N=1": lambda: case("inputs").with_options(horizon=1),
}


def spoilt(one, generator, share=0.3):
    """The samples with components that are missing in all sorts of ways, weights and steps."""
    samples = []
    for t, sample in enumerate(one.samples):
        y = np.array(sample["y"], float)
        for j in np.flatnonzero(generator.random(y.size) < share):
            y[j] = generator.choice([NAN, INF, -INF, 1e200, -1e160])
        own = {}
        if t % 3 == 1:
            own["noise_weight"] = 10.0 ** generator.uniform(-2, 2) * spd(t, y.size)
        if one.system.dt and t % 7 in (0, 1, 4):
            own["dt"] = one.system.dt * generator.uniform(0.2, 2.0)
        samples.append(sample | {"y": None if t % 11 == 7 else y} | own)
    return samples


def late(one, t, generator):
    """A sample of the window whose measurement comes now: whole, in part, or once more."""
    first = max(0, t + 1 - one.options["horizon"])
    when = first if t % 4 == 0 else int(generator.integers(first, t + 1))
    y = np.array(one.samples[when]["y"]) + 0.1 * generator.standard_normal(one.system.p)
    y[generator.random(y.size) < 0.3] = generator.choice([NAN, INF, 1e170])
    return when, y


def equal(one, other):
    """Equality of two estimates to the last bit."""
    for name in (*ARRAYS, "cost", "candidate_cost"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert (one.status, one.qps, one.solver_iterations, one.dropped, one.time) == (
        other.status, other.qps, other.solver_iterations, other.dropped, other.time
    )


@pytest.mark.parametrize("name", MODELS)
def test_the_same_estimates_whatever_comes(name):
    """And copies of an estimator, however they are made, go on to the last bit."""
    one = MODELS[name]()
    for k, way in enumerate((
        {"max_qps": 3}, {"max_qps": None, "warm_start": True},
        {"max_qps": None, "backend": "banded", "tolerance": 1e-3, "candidate": "reinitialized"},
    )):
        reference, compiled = (one.estimator(engine, **way) for engine in ENGINES)
        generator, copies = np.random.default_rng(k), []
        for t, sample in enumerate(spoilt(one, generator)):
            found = compiled.update(**sample)
            agree(reference.update(**sample), found, 1e-9)
            assert (Status.MISSING in found.status) == np.isnan(found.noises[-1]).any()
            for other in copies:
                equal(other.update(**sample), found)
            for _ in range(int(generator.integers(0, 3))):
                when, y = late(one, t, generator)
                found = compiled.amend(when, y)
                agree(reference.amend(when, y), found, 1e-9)
                for other in copies:
                    equal(other.amend(when, y), found)
            if t == 3 * k + 1:
                fresh = one.estimator("compiled", **way)
                fresh.update(**one.samples[0])
                fresh.load_state_dict(compiled.state_dict())
                copies = [fresh, pickle.loads(pickle.dumps(compiled)), copy.deepcopy(compiled)]
        expected = reference.covariances()
        for mhe in (compiled, *copies):
            np.testing.assert_allclose(
                mhe.covariances(), expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max()
            )
            assert (mhe.engine, mhe.time) == ("compiled", STEPS)


def test_an_outage_longer_than_the_window():
    """The observer waits where the model last worked, however long that is ago."""
    system = system_of(lambda x, u: x * u[0], lambda x, u: x, n=1, m=1)
    for engine in ENGINES:
        mhe = estimator(system, gain=0.5, engine=engine)
        for samples in (1, 2, 64, 65):
            mhe.reset()
            with pytest.raises(InvalidInputError, match="no estimate yet"):
                mhe.covariances()
            for _ in range(samples):
                mhe.update([5.0], [1.0])
            held = [mhe.update([5.0], [NAN]).state[0] for _ in range(5)]
            assert held == [held[0]] * 5, samples
            with pytest.raises(InvalidInputError, match="finite"):
                mhe.covariances()
            assert mhe.update([5.0], [1.0]).state[0] == pytest.approx(5.0, abs=3.0)


def test_damaged_snapshots_are_refused_whole():
    one = case("reactor")
    mhe, twin = (one.estimator("compiled") for _ in range(2))
    for sample in one.samples[:2]:
        mhe.update(**sample)
        twin.update(**sample)
    good = read(mhe.state_dict())
    damaged = [{}, {**good, "problem": (2, 1, 0, 99)}, {**good, "engine": "python"}]
    damaged += [{**good, part: bad} for part in ("window", "compiled") for bad in (None, {}, [])]
    for part, name, value in (
        ("window", "history", NAN), ("window", "z", NAN), ("window", "last_good", INF),
        ("window", "trajectory", NAN), ("window", "u", -1.0), ("window", "cost", -1.0),
        ("window", "watched", (0, -1)), ("window", "time", 3), ("compiled", "w", NAN),
        ("compiled", "noise_weight", INF), ("compiled", "terms", None),
        ("compiled", "places", None),
    ):
        changed = good[part][name]
        if value is None:
            changed = changed[:-1]
        elif isinstance(changed, np.ndarray):
            changed = changed.copy()
            changed.flat[-1] = value
        else:
            changed = value
        damaged.append({**good, part: {**good[part], name: changed}})
    before = mhe._engine._memory.tobytes()
    for state in damaged:
        with pytest.raises(InvalidInputError):
            mhe._engine.load_state_dict(state)
        assert mhe._engine._memory.tobytes() == before
    for sample in one.samples[2:6]:
        equal(mhe.update(**sample), twin.update(**sample))


@pytest.mark.slow
def test_a_record_is_its_samples():
    """Longer than what is handed to C at once, with missing samples, and in several calls."""
    one, options = wide(), {"warm_start": True}
    ys = np.resize([
        np.full(one.system.p, NAN) if sample["y"] is None else sample["y"]
        for sample in spoilt(one, np.random.default_rng(4), share=0.1)
    ], (600, one.system.p))
    single, whole = (one.estimator("compiled", **options) for _ in range(2))
    for first, last in ((0, 550), (550, 550), (550, 600)):
        rows = ys[first:last]
        run = whole.run(np.asfortranarray(rows[::-1][::-1]))
        estimates = [single.update(y) for y in rows]
        np.testing.assert_array_equal(run.states[-1], single.state)
        for field, name in (("costs", "cost"), ("qps", "qps"), ("filtered", "filtered")):
            found, expected = getattr(run, field), [getattr(one, name) for one in estimates]
            np.testing.assert_array_equal(found, np.reshape(expected, found.shape))
        assert (run.times > 0.0).all()
    runs = [mhe.run(ys, covariances=True).covariances for mhe in (single, whole)]
    np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize("engine", ENGINES)
def test_rows_dropped_for_long_are_worth_a_warning(engine):
    """What is measured moves farther than W lets the state follow."""
    system = system_of(lambda x: x, lambda x: x, n=1, disturbances=qpmhe.Box(-0.01, 0.01))
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1e-3, noise=10.0)
    mhe = estimator(system, cost, 0.9, horizon=4, max_qps=3, engine=engine)
    with pytest.warns(qpmhe.ObserverWarning, match="inequalities were dropped in") as caught:
        _ = [mhe.update([3.0 * t]) for t in range(30)]
    assert [w.filename for w in caught] == [__file__]


def test_a_filter_that_explodes_does_not_convict_the_compiler():
    """Its covariance reaches 1e44 before its state is projected: then rounding decides where."""
    def model(x):
        k = np.exp(-2.0 / x[..., 1])
        return np.stack([
            x[..., 0] + 0.05 * (1.0 - x[..., 0] - k * x[..., 0]),
            x[..., 1] + 0.05 * (0.5 - x[..., 1] + k * x[..., 0] * 0.5),
        ], axis=-1)

    system = qpmhe.System(
        model, lambda x: x[..., 1:], n=2, p=1,
        states=qpmhe.Polytope(
            [[-2.176804142227712, -0.8918632912266076], [0.7974960976184672, -0.3447393904184218]],
            [-0.4892079221656913, 1.0818012714094656],
        ),
        disturbances=qpmhe.Box([0.0, -np.inf], [0.0, np.inf]),
        noises=qpmhe.Polytope([[25.57346337740178]], [1.8707530379612545]),
    )
    covariances = {
        "prior": np.diag([4.3589974589489594e-03, 71.335965840248321]),
        "disturbance": np.diag([0.00727411073953611, 0.05153810601125028]),
        "noise": [[0.00152904724371075]],
    }
    weights = {name: np.linalg.inv(one) for name, one in covariances.items()}
    observer = qpmhe.UnscentedKalman(**covariances)
    with warnings.catch_warnings():
        warnings.simplefilter("error", qpmhe.errors.EngineWarning)
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, qpmhe.QuadraticCost(**weights), horizon=5, max_qps=1,
            initial_state=[0.3785754024951795, -9.807693590675465], engine="compiled",
        )
    assert mhe.engine == "compiled"


SMALL_STACK = """
import threading
import numpy as np
import qpmhe

n = 60
system = qpmhe.System.from_ode(
    lambda x: np.tanh(np.roll(x, 1)) - 2.0 * x, lambda x: x[:1], dt=0.1, n=n, p=1, method="radau"
)
cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=np.eye(1))
observer = qpmhe.observers.Luenberger(np.zeros((n, 1)))
mhe = qpmhe.MovingHorizonEstimator(
    system, observer, cost, horizon=3, initial_state=np.ones(n), engine="compiled"
)
threading.stack_size(256 * 1024)
thread = threading.Thread(target=lambda: print(mhe.update([0.5]).status))
thread.start()
thread.join()
"""


@pytest.mark.slow
def test_implicit_steps_of_many_states_need_little_stack():
    """With their matrices on it, 60 states ended a process whose thread has 256 kB."""
    found = subprocess.run(
        [sys.executable, "-c", SMALL_STACK], capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stderr
    assert "IMPROVED" in found.stdout
