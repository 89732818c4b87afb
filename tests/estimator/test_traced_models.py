"""Models in NumPy that estimators evaluate as CasADi expressions."""

import pickle
import subprocess
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.codegen.members import CompiledMembers
from qpmhe.errors import EngineWarning, ModelError

ZOO = qpmhe.models.catalogue()
ENGINES = ["python", "compiled"]


def near(example, count=20, seed=0):
    """States and inputs near those of a simulation."""
    record = example.scenario.simulate(seed, count)
    generator = np.random.default_rng(seed)
    spread = np.abs(record.states).max(axis=0) + 0.1
    states = record.states[:count] + 0.02 * spread * generator.standard_normal(
        (count, example.system.n)
    )
    if example.system.states is not None:
        states = np.clip(states, example.system.states.lower, example.system.states.upper)
    inputs = record.inputs if record.inputs is not None else np.zeros((count, 0))
    return states, inputs[:count]


@pytest.mark.parametrize("name", ZOO)
def test_all_models_of_the_zoo_are_traced_and_are_the_same(name):
    example = ZOO[name]()
    system = example.system
    assert system.derivatives == {"f": "traced", "h": "traced"}, system.explain()
    model = system.symbolic
    own = system.copy(traced=True)
    for x, u in zip(*near(example), strict=True):
        for which, found in (
            ("f", np.array(model.step()(x, u, model.dt or 0.0))[:, 0]),
            ("h", np.array(model.h(x, u))[:, 0]), ("f", own.f(x, u)), ("h", own.h(x, u)),
        ):
            expected = getattr(system, which)(x, u)
            size = np.abs(expected).max() if which == "f" else np.abs(expected)
            assert (np.abs(found - expected) <= 1e-12 * size).all()


@pytest.mark.parametrize("name", ZOO)
def test_their_jacobians_are_those_of_the_complex_step(name):
    example = ZOO[name]()
    system, own = example.system, example.system.copy(traced=True)
    n, step = system.n, 2.0**-100
    for x, u in zip(*near(example, 5), strict=True):
        for which in ("f", "h"):
            function = getattr(system, which)
            moved = x + 1j * step * np.eye(n)
            if name == "vehicle" and which == "h":  # arctan2 takes no complex numbers
                complex_step = system.h_jacobian(x, u)
            else:
                complex_step = function.batch(moved, np.tile(u, (n, 1))).imag.T / step
            found = getattr(own, f"{which}_jacobian")(x, u)
            row = np.abs(complex_step).max(axis=1, keepdims=True)
            assert (np.abs(found - complex_step) <= 1e-12 * row).all()


@pytest.mark.parametrize("name", ZOO)
def test_estimates_are_those_of_the_functions(name):
    example = ZOO[name]()
    record = example.scenario.simulate(1, 30)
    inputs = record.inputs if example.system.m else None
    runs = []
    for traced in (True, False):
        mhe = qpmhe.MovingHorizonEstimator(
            *example[:3], horizon=8, initial_state=example.scenario.initial_estimate,
            engine="python",
        )
        assert mhe._own_system.is_traced
        if not traced:
            mhe._engine.leave_trace()
        assert (mhe._own_system.kernel is not None) == traced
        runs.append(mhe.run(record.measurements, inputs))
    for what in ("states", "costs", "candidate_costs"):
        one, two = (getattr(run, what) for run in runs)
        np.testing.assert_allclose(one, two, rtol=1e-7, atol=1e-8 * np.abs(one).max())


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", ZOO)
def test_all_models_of_the_zoo_run_in_c(name):
    """The quadrotor tumbles in the records of the check, so that rounding decides its states."""
    system, observer, cost, scenario = ZOO[name]()
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=scenario.horizon,
        initial_state=scenario.initial_estimate, engine="compiled",
    )
    assert mhe.engine == "compiled"


A = np.array([[0.9, 0.2], [-0.1, 0.8]])


class Plant:
    """A model whose parameter can be changed behind the estimator's back."""

    def __init__(self, gain=0.1):
        self.gain = gain

    def f(self, x):
        return x @ A.T + self.gain * np.sin(x)

    def h(self, x):
        return x[..., :1]

    def system(self, **options):
        return qpmhe.System(self.f, self.h, n=2, p=1, **options)


def estimator(system, engine="python", kalman=False, **options):
    options = {"horizon": 5, "initial_state": [1.0, -1.0], "max_qps": 2} | options
    observer, prior = qpmhe.Luenberger([0.4, 0.1]), np.eye(2)
    if kalman:
        observer, prior = qpmhe.ExtendedKalman(
            prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=0.25
        ), qpmhe.ObserverPrior()
    return qpmhe.MovingHorizonEstimator(
        system, observer,
        qpmhe.QuadraticCost(prior=prior, disturbance=10.0 * np.eye(2), noise=4.0),
        engine=engine, **options,
    )


def update_all(mhe, ys):
    for y in ys:
        mhe.update(y)


def cost_by_hand(plant, estimate, measured, prior):
    x = estimate.trajectory
    w = x[1:] - plant.f(x[:-1])
    v = np.array(measured)[:, None] - plant.h(x[:-1])
    return ((x[0] - prior) ** 2).sum() + 10.0 * (w**2).sum() + 4.0 * (v**2).sum()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("when", [2, 6, 40])
def test_a_closure_that_changes_is_found_and_no_sample_is_lost(engine, when):
    plant, ys = Plant(), np.random.default_rng(0).normal(size=200)
    mhe = estimator(plant.system(), engine)
    for y in ys[:when]:
        mhe.update(y)
    plant.gain = 0.3
    with pytest.warns(EngineWarning, match="f has changed since it was traced"):
        update_all(mhe, ys[when:80])
    assert (mhe.engine, mhe.time) == ("python", 80)
    assert not mhe._own_system.is_traced
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for t in range(80, 100):
            estimate = mhe.update(ys[t])
            by_hand = cost_by_hand(plant, estimate, ys[t - 4 : t + 1], estimate.candidate[0])
            assert estimate.cost == pytest.approx(by_hand, rel=1e-12)
            assert estimate.cost <= estimate.candidate_cost
    # From now on as an estimator that has always had this model.
    late = estimator(plant.system(), "python")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = late.run(ys)
    assert np.abs(run.states[-1] - mhe.run(ys[100:]).states[-1]).max() < 1e-6


@pytest.mark.parametrize("engine", ENGINES)
def test_a_record_goes_on_where_a_closure_has_changed(engine):
    plant, ys = Plant(), np.random.default_rng(0).normal(size=600)
    mhe = estimator(plant.system(), engine)
    mhe.run(ys[:300])
    plant.gain = 0.3
    with pytest.warns(EngineWarning, match="has changed"):
        run = mhe.run(ys[300:])
    assert run.states.shape == (301, 2)
    assert mhe.time == 600
    assert not mhe._own_system.is_traced


@pytest.mark.parametrize("engine", ENGINES)
def test_a_warning_as_an_error_takes_no_sample(engine):
    plant = Plant()
    mhe = estimator(plant.system(), engine)
    mhe.update(0.5)
    plant.gain = 0.3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(EngineWarning):
            mhe.update(0.4)
        assert mhe.time == 1
        estimate = mhe.update(0.4)
    assert mhe.time == 2
    by_hand = cost_by_hand(plant, estimate, [0.5, 0.4], estimate.candidate[0])
    assert estimate.cost == pytest.approx(by_hand, rel=1e-12)


HANDED_OVER = {
    "plain": {}, "reinitialized": {"candidate": "reinitialized"}, "delay": {"delay": 2},
    "warm start": {"warm_start": True}, "smoothed": {"arrival": "smoothed"},
    "EKF": {"kalman": True}, "smoothed EKF": {"kalman": True, "arrival": "smoothed"},
}


@pytest.mark.parametrize("when", [3, 20])
@pytest.mark.parametrize("case", HANDED_OVER)
def test_what_a_compiled_estimator_hands_over_is_all_it_knew(case, when):
    plant, generator = Plant(), np.random.default_rng(3)
    system = plant.system(
        disturbances=qpmhe.Box([-3.0, -3.0], [3.0, 3.0]), noises=qpmhe.Box([-9.0], [9.0])
    )
    pair = [estimator(system, engine, **HANDED_OVER[case]) for engine in ENGINES]
    for t, y in enumerate(generator.normal(size=30)):
        own = {}
        if t % 5 == 2:
            own["noise_weight"] = [[7.0]]
        if t % 7 == 3:
            own["bounds"] = {"disturbances": qpmhe.Box([-2.0, -2.5], [2.0, 2.5])}
        y = None if t % 11 == 5 else y
        if t == when:
            # As if its trace had failed, without any difference.
            compiled = pair[1]._engine
            compiled._system.trace_fault = lambda x, u: "no difference"
            compiled._next_check = 0
            with pytest.warns(EngineWarning, match="no difference"):
                pair[1].update(y, **own)
            pair[0].update(y, **own)
        else:
            found = [mhe.update(y, **own) for mhe in pair]
            np.testing.assert_allclose(found[1].trajectory, found[0].trajectory, atol=1e-8)
            assert found[1].cost == pytest.approx(found[0].cost, rel=1e-8)
            if "delay" in case and t > 3:
                np.testing.assert_allclose(found[1].delayed, found[0].delayed, atol=1e-8)
    assert pair[1].engine == "python"


def test_a_new_estimator_traces_a_changed_model_again():
    plant = Plant()
    system = plant.system()
    assert estimator(system)._own_system.is_traced
    plant.gain = 0.3
    ys = np.random.default_rng(0).normal(size=30)
    mhe = estimator(system)
    assert mhe._own_system.is_traced
    found, expected = mhe.run(ys), estimator(plant.system()).run(ys)
    np.testing.assert_array_equal(found.states, expected.states)
    x = np.array([0.5, 0.0])
    assert float(system.symbolic.f(x, [])[0]) == pytest.approx(plant.f(x)[0])


def test_a_running_estimator_compares_its_own_trace():
    plant = Plant()
    system = plant.system()
    first = estimator(system)
    first.update(0.1)
    plant.gain = 0.3
    estimator(system)  # traces anew, for itself
    with pytest.warns(EngineWarning, match="has changed"):
        first.update(0.2)


def random_model(x):
    return 0.5 * x + np.random.default_rng().normal(size=2)


def test_what_cannot_be_traced_is_used_as_it_is_written():
    with pytest.warns(EngineWarning, match="f cannot be traced: it returns other values"):
        mhe = estimator(qpmhe.System(random_model, lambda x: x[..., :1], n=2, p=1))
    assert not mhe._own_system.is_traced or mhe._own_system.kernel is None
    mhe.update(1.0)


def branching(x):
    return x if x[0] > 12.0 else 0.5 * x


def test_a_model_with_one_function_traced_has_its_jacobian():
    system = qpmhe.System(branching, lambda x: np.sin(x[..., :1]), n=2, p=1)
    assert system.derivatives == {"f": "complex step", "h": "traced"}
    assert system.symbolic is None
    line = branching.__code__.co_firstlineno + 1
    text = system.explain()
    assert f"f: not traced: {__file__}:{line} asks for the truth of a comparison" in text
    assert "h: traced" in text
    for y in np.random.default_rng(0).normal(size=20):
        estimate = estimator(system).update(y)
    assert estimate.cost <= estimate.candidate_cost
    with pytest.raises(qpmhe.errors.OptionError, match="asks for the truth"):
        estimator(system, "compiled")


def test_a_model_that_fails_far_away_falls_back():
    def root(x):
        return 0.9 * np.sqrt(x)

    def guarded(x):
        if np.any(np.isnan(np.sqrt(x))):
            raise ValueError("negative")
        return root(x)

    statuses = []
    for f in (root, guarded):
        system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
        mhe = estimator(system, initial_state=[1.0, 1.0])
        assert mhe._own_system.f_jacobian.method == ("traced" if f is root else "complex step")
        statuses.append([bool(mhe.update(y).status & qpmhe.Status.MODEL_FAILED)
                         for y in [1.0, 0.9, -50.0, 0.8, 0.9, 1.0]])
    assert statuses[0] == statuses[1]
    assert any(statuses[0])


def jacobian(x):
    return A + 0.1 * np.cos(x)[..., None] * np.eye(2)


def test_given_jacobians():
    plant = Plant()
    right = plant.system(f_jacobian=jacobian)
    assert right.f_jacobian.method == "given"
    assert right.derivatives == {"f": "traced", "h": "traced"}
    rough = plant.system(f_jacobian=lambda x: (1.0 + 1e-7) * jacobian(x))
    assert rough.derivatives == {"f": "given", "h": "traced"}
    own = estimator(rough)._own_system
    x = np.array([0.3, 0.4])
    np.testing.assert_array_equal(own.f_jacobian(x, np.zeros(0)), (1.0 + 1e-7) * jacobian(x))
    wrong = plant.system(f_jacobian=lambda x: 1.01 * jacobian(x))
    with pytest.raises(ModelError, match="f_jacobian"):
        estimator(wrong)


def rate(x, u):
    return np.array([x[1], u[0] - np.sin(x[0]) - 0.1 * x[1]])


def position(x):
    return x[0]


def test_irregular_steps_use_the_traced_rate():
    kept = []
    for traced in (True, False):
        system = qpmhe.System.from_ode(rate, position, dt=0.1, n=2, p=1, m=1)
        mhe = estimator(system)
        if not traced:
            mhe._engine.leave_trace()
        generator = np.random.default_rng(0)
        for t in range(20):
            dt = 0.17 if t % 3 == 1 else None
            estimate = mhe.update(generator.normal(), generator.normal(size=1), dt=dt)
        assert (mhe._own_system.timed.kernel is not None) == traced
        kept.append(estimate.trajectory)
    np.testing.assert_allclose(kept[0], kept[1], rtol=1e-9, atol=1e-11)


def test_steps_of_other_lengths_that_the_trace_does_not_know_stay_as_written():
    system = qpmhe.noisy_inputs(qpmhe.System.from_ode(rate, position, dt=0.1, n=2, p=1, m=1))
    assert system.symbolic is None
    own = system.copy(traced=True)
    z, u = np.array([0.3, 0.2, 0.1]), np.array([0.5])
    for dt in (0.1, 0.25):
        np.testing.assert_allclose(
            own.timed.f(z, np.append(u, dt)), system.timed.f(z, np.append(u, dt)), rtol=1e-13
        )


def test_parameters_are_traced():
    system = qpmhe.augment_parameters(
        lambda x, u, theta: np.array([x[1], u[0] - theta[0] * np.sin(x[0])]),
        lambda x, u, theta: x[0] + theta[1], n=2, p=1, m=1, nominal=[1.0, 0.2],
        estimated=[0], dt=0.1, drifting=True,
    )
    assert system.derivatives == {"f": "traced", "h": "traced"}
    assert (system.symbolic.n, system.symbolic.dt) == (3, 0.1)


def test_a_traced_system_pickles():
    system = qpmhe.System.from_ode(rate, position, dt=0.1, n=2, p=1, m=1)
    mhe = estimator(system)
    mhe.update(0.3, [0.1])
    twin = pickle.loads(pickle.dumps(mhe))
    assert twin._own_system.is_traced
    np.testing.assert_array_equal(
        twin.update(0.2, [0.3]).trajectory, mhe.update(0.2, [0.3]).trajectory
    )


def test_threads_may_share_a_system():
    plant, ys = Plant(), np.random.default_rng(0).normal(size=40)
    system = plant.system()
    expected = estimator(plant.system()).run(ys).states
    with ThreadPoolExecutor(4) as pool:
        for states in pool.map(lambda _: estimator(system).run(ys).states, range(12)):
            np.testing.assert_array_equal(states, expected)


def test_threads_make_the_expressions_of_a_system_at_once():
    ys = np.random.default_rng(0).normal(size=4)
    expected = estimator(Plant().system()).run(ys).states

    def begin(system):
        together.wait()
        return estimator(system).run(ys).states

    together, interval = threading.Barrier(6), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads take turns in the midst of everything
    try:
        with ThreadPoolExecutor(6) as pool:
            for _ in range(15):
                for states in pool.map(begin, [Plant().system()] * 6):
                    np.testing.assert_array_equal(states, expected)
    finally:
        sys.setswitchinterval(interval)


def test_a_system_alone_imports_no_casadi():
    code = (
        "import sys, qpmhe; s = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=1, p=1); "
        "print('casadi' in sys.modules, s.derivatives['f'], 'casadi' in sys.modules)"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.split() == ["False", "traced", "True"]


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("call", ["update", "run", "during a run"])
def test_a_batch_goes_on_in_python_where_a_closure_has_changed(call, monkeypatch):
    """Each member as a single estimator, and no sample is lost."""
    plant, ys = Plant(), np.random.default_rng(0).normal(size=(6, 60))
    start = np.array([[1.0, -1.0]]) + 0.1 * np.arange(6)[:, None]
    singles = [estimator(plant.system(), "compiled", initial_state=one) for one in start]
    batch = qpmhe.BatchEstimator(
        plant.system(), singles[0].observer, singles[0].cost, members=6, initial_states=start,
        horizon=5, max_qps=2, engine="compiled",
    )

    def go_on(mhe, records):
        if call != "update":
            return mhe.run(records)
        for t in range(40):
            found = mhe.update(records[..., t])
        return found

    update_all(batch, ys[:, :20].T)  # compared at the same times as single estimators
    for one, own in zip(singles, ys, strict=True):
        update_all(one, own[:20])
    assert batch.engine == "compiled"
    if call == "during a run":
        plain = CompiledMembers._share

        def share(self, work):
            plain(self, work)
            plant.gain = 0.3

        monkeypatch.setattr(CompiledMembers, "_share", share)
    else:
        plant.gain = 0.3
    with pytest.warns(EngineWarning, match="f has changed since it was traced"):
        found = go_on(batch, ys[:, 20:])
    assert (found.engine, batch.engine, batch.mode) == ("python", "python", "looped")
    assert batch.time == 60
    np.testing.assert_array_equal(
        found.states if call == "update" else found.states[:, -1], batch.states
    )
    for k, one in enumerate(singles):
        with pytest.warns(EngineWarning, match="f has changed since it was traced"):
            go_on(one, ys[k, 20:])
        np.testing.assert_allclose(batch.states[k], one.state, rtol=1e-9, atol=1e-12)
    found = batch.update(ys[:, 0])
    assert (found.costs <= found.candidate_costs).all()
    batch.reset()
    assert batch.time == 0


class Changing:
    """A correction, a residual function and a loss with a number that can be changed."""

    def __init__(self):
        self.share = 0.4

    def correction(self, z, v):
        return self.share * np.array([v[0], 0.5 * np.tanh(v[0])])

    def turn(self, a, b):
        return a - b - 6.0 * self.share * np.round((a - b) / (6.0 * self.share))


@pytest.mark.parametrize("what", ["correction", "output_residual"])
def test_other_traced_functions_of_a_compiled_step_may_change_too(what):
    plant, changing = Plant(), Changing()
    residual = {"output_residual": changing.turn} if what == "output_residual" else {}
    options = {"horizon": 5, "initial_state": [1.0, -1.0], "max_qps": 1}
    observer = qpmhe.Luenberger([0.4, 0.1])
    if what == "correction":
        observer = qpmhe.OutputInjection(changing.correction)
    mhe = qpmhe.MovingHorizonEstimator(
        plant.system(**residual), observer,
        qpmhe.QuadraticCost(prior=np.eye(2), disturbance=10.0 * np.eye(2), noise=4.0),
        engine="compiled", **options,
    )
    ys = np.random.default_rng(0).normal(size=60)
    update_all(mhe, ys[:3])
    assert mhe.engine == "compiled"
    changing.share = 0.3
    with pytest.warns(EngineWarning, match=f"{what} has changed since it was traced"):
        update_all(mhe, ys[3:])
    assert (mhe.engine, mhe.time) == ("python", 60)


def test_comparisons_begin_anew_after_a_reset():
    plant = Plant()
    for engine in ENGINES:
        mhe = estimator(plant.system(), engine)
        update_all(mhe, np.zeros(40))
        mhe.reset()
        mhe.update(0.1)
        plant.gain += 0.1
        with pytest.warns(EngineWarning, match="has changed"):
            mhe.update(0.2)
