"""Models in NumPy that estimators evaluate as CasADi expressions."""

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
from qpmhe.errors import EngineWarning, ModelError, OptionError

ZOO = qpmhe.models.catalogue()
ENGINES = ["python", "compiled"] if find_compiler() else ["python"]
compiled = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


@pytest.mark.parametrize("name", ZOO)
def test_models_of_the_zoo_are_traced_and_are_the_same(name):
    """States near those of a simulation; the complex step for the Jacobians."""
    example = ZOO[name]()
    system, scenario = example.system, example.scenario
    assert system.derivatives == {"f": "traced", "h": "traced"}, system.explain()
    record, generator = scenario.simulate(1, 20), np.random.default_rng(0)
    inputs = record.inputs if system.m else None
    spread = np.abs(record.states).max(axis=0) + 0.1
    states = record.states[:20] + 0.02 * spread * generator.standard_normal((20, system.n))
    if system.states is not None:
        states = np.clip(states, system.states.lower, system.states.upper)
    model, own, n, step = system.symbolic, system.copy(traced=True), system.n, 2.0**-100
    for k, x in enumerate(states):
        u = np.zeros(0) if inputs is None else inputs[k]
        for which, found in (
            ("f", np.array(model.step()(x, u, model.dt or 0.0))[:, 0]), ("f", own.f(x, u)),
            ("h", np.array(model.h(x, u))[:, 0]), ("h", own.h(x, u)),
        ):
            expected = getattr(system, which)(x, u)
            size = np.abs(expected).max() if which == "f" else np.abs(expected)
            assert (np.abs(found - expected) <= 1e-12 * size).all()
        for which in ("f", "h") if k < 5 else ():
            function, moved = getattr(system, which), x + 1j * step * np.eye(n)
            if name == "vehicle" and which == "h":  # arctan2 takes no complex numbers
                expected = system.h_jacobian(x, u)
            else:
                expected = function.batch(moved, np.tile(u, (n, 1))).imag.T / step
            found = getattr(own, f"{which}_jacobian")(x, u)
            row = np.abs(expected).max(axis=1, keepdims=True)
            assert (np.abs(found - expected) <= 1e-12 * row).all()


A = np.array([[0.9, 0.2], [-0.1, 0.8]])
YS = np.random.default_rng(0).normal(size=200)


class Plant:
    """A model, a correction and a residual whose parameters can change behind one's back."""

    def __init__(self):
        self.gain, self.share = 0.1, 0.4

    def f(self, x):
        return x @ A.T + self.gain * np.sin(x)

    def h(self, x):
        return x[..., :1]

    def correction(self, z, v):
        return self.share * np.array([v[0], 0.5 * np.tanh(v[0])])

    def turn(self, a, b):
        return a - b - 6.0 * self.share * np.round((a - b) / (6.0 * self.share))

    def system(self, **options):
        return qpmhe.System(self.f, self.h, n=2, p=1, **options)


def estimator(system, engine="python", kalman=False, observer=None, **options):
    options = {"horizon": 5, "initial_state": [1.0, -1.0], "max_qps": 2} | options
    observer, prior = observer or qpmhe.Luenberger([0.4, 0.1]), np.eye(2)
    if kalman:
        observer, prior = qpmhe.ExtendedKalman(
            prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=0.25
        ), qpmhe.ObserverPrior()
    cost = qpmhe.QuadraticCost(prior=prior, disturbance=10.0 * np.eye(2), noise=4.0)
    return qpmhe.MovingHorizonEstimator(system, observer, cost, engine=engine, **options)


def update_all(mhe, ys):
    for y in ys:
        estimate = mhe.update(y)
    return estimate


def cost_by_hand(plant, estimate, measured):
    x = estimate.trajectory
    w = x[1:] - plant.f(x[:-1])
    v = np.array(measured)[:, None] - plant.h(x[:-1])
    prior = ((x[0] - estimate.candidate[0]) ** 2).sum()
    return prior + 10.0 * (w**2).sum() + 4.0 * (v**2).sum()


# Models that change


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("call", ["update", "run", "reset"])
def test_a_closure_that_changes_is_found_and_no_sample_is_lost(call, engine):
    plant = Plant()
    mhe = estimator(plant.system(), engine)
    update_all(mhe, YS[:40])
    if call == "reset":  # comparisons begin anew
        mhe.reset()
        update_all(mhe, YS[38:40])
    plant.gain = 0.3
    go_on = mhe.run if call == "run" else lambda ys: update_all(mhe, ys)
    with pytest.warns(EngineWarning, match="f has changed since it was traced"):
        go_on(YS[40 : 41 if call == "reset" else 120])
    assert (mhe.engine, mhe.time) == ("python", 3 if call == "reset" else 120)
    assert not mhe._own_system.is_traced
    for t in range(120, 140):
        estimate = mhe.update(YS[t])
        if t >= 125:
            by_hand = cost_by_hand(plant, estimate, YS[t - 4 : t + 1])
            assert estimate.cost == pytest.approx(by_hand, rel=1e-12)
        assert estimate.cost <= estimate.candidate_cost


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
    assert estimate.cost == pytest.approx(cost_by_hand(plant, estimate, [0.5, 0.4]), rel=1e-12)


HANDED_OVER = {
    "plain": {}, "reinitialized": {"candidate": "reinitialized"}, "delay": {"delay": 2},
    "warm start": {"warm_start": True}, "smoothed": {"arrival": "smoothed"},
    "smoothed EKF": {"kalman": True, "arrival": "smoothed"},
}


@compiled
@pytest.mark.parametrize("when", [3, 20])
@pytest.mark.parametrize("case", HANDED_OVER)
def test_what_a_compiled_estimator_hands_over_is_all_it_knew(case, when):
    system = Plant().system(
        disturbances=qpmhe.Box([-3.0, -3.0], [3.0, 3.0]), noises=qpmhe.Box([-9.0], [9.0])
    )
    one, two = (estimator(system, engine, **HANDED_OVER[case]) for engine in ENGINES)
    for t, y in enumerate(YS[:30]):
        own = {"noise_weight": [[7.0]]} if t % 5 == 2 else {}
        if t % 7 == 3:
            own["bounds"] = {"disturbances": qpmhe.Box([-2.0, -2.5], [2.0, 2.5])}
        y = None if t % 11 == 5 else y
        expected = one.update(y, **own)
        if t == when:
            # As if its trace had failed, without any difference.
            two._engine._system.trace_fault = lambda x, u: "no difference"
            two._engine._next_check = 0
            with pytest.warns(EngineWarning, match="no difference"):
                found = two.update(y, **own)
        else:
            found = two.update(y, **own)
        np.testing.assert_allclose(found.trajectory, expected.trajectory, atol=1e-8)
        assert found.cost == pytest.approx(expected.cost, rel=1e-8)
        if "delay" in case and t > 3:
            np.testing.assert_allclose(found.delayed, expected.delayed, atol=1e-8)
    assert two.engine == "python"


def test_each_estimator_compares_its_own_trace():
    plant = Plant()
    system = plant.system()
    first = estimator(system)
    first.update(0.1)
    plant.gain = 0.3
    mhe = estimator(system)  # traces anew, for itself
    assert mhe._own_system.is_traced
    np.testing.assert_array_equal(mhe.run(YS).states, estimator(plant.system()).run(YS).states)
    x = np.array([0.5, 0.0])
    assert float(system.symbolic.f(x, [])[0]) == pytest.approx(plant.f(x)[0])
    with pytest.warns(EngineWarning, match="has changed"):
        first.update(0.2)


@compiled
@pytest.mark.parametrize("what", ["correction", "output_residual"])
def test_other_traced_functions_of_a_compiled_step_may_change_too(what):
    plant, changing = Plant(), Plant()
    residual = {"output_residual": changing.turn} if what == "output_residual" else {}
    observer = qpmhe.OutputInjection(changing.correction) if what == "correction" else None
    mhe = estimator(plant.system(**residual), "compiled", observer=observer)
    update_all(mhe, YS[:3])
    assert mhe.engine == "compiled"
    changing.share = 0.3
    with pytest.warns(EngineWarning, match=f"{what} has changed since it was traced"):
        update_all(mhe, YS[3:60])
    assert (mhe.engine, mhe.time) == ("python", 60)


@compiled
@pytest.mark.parametrize("call", ["update", "run", "during a run"])
def test_a_batch_goes_on_in_python_where_a_closure_has_changed(call, monkeypatch):
    """Each member as a single estimator, and no sample is lost."""
    plant, ys = Plant(), YS[:180].reshape(3, 60)
    start = np.array([[1.0, -1.0]]) + 0.1 * np.arange(3)[:, None]
    singles = [estimator(plant.system(), "compiled", initial_state=one) for one in start]
    batch = qpmhe.BatchEstimator(
        plant.system(), singles[0].observer, singles[0].cost, members=3, initial_states=start,
        horizon=5, max_qps=2, engine="compiled",
    )

    def go_on(mhe, records):
        return mhe.run(records) if call != "update" else update_all(mhe, records.T)

    update_all(batch, ys[:, :20].T)  # compared at the same times as single estimators
    for one, own in zip(singles, ys, strict=True):
        update_all(one, own[:20])
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
    last = found.states if call == "update" else found.states[:, -1]
    np.testing.assert_array_equal(last, batch.states)
    for k, one in enumerate(singles):
        with pytest.warns(EngineWarning, match="f has changed since it was traced"):
            go_on(one, ys[k, 20:])
        np.testing.assert_allclose(batch.states[k], one.state, rtol=1e-9, atol=1e-12)
    found = batch.update(ys[:, 0])
    assert (found.costs <= found.candidate_costs).all()


# Models that are not traced, or in part


def branching(x):
    return x if x[0] > 12.0 else 0.5 * x


def test_what_cannot_be_traced_is_used_as_it_is_written():
    def random_model(x):
        return 0.5 * x + np.random.default_rng().normal(size=2)

    with pytest.warns(EngineWarning, match="f cannot be traced: it returns other values"):
        mhe = estimator(qpmhe.System(random_model, lambda x: x[..., :1], n=2, p=1))
    assert mhe._own_system.kernel is None
    mhe.update(1.0)
    system = qpmhe.System(branching, lambda x: np.sin(x[..., :1]), n=2, p=1)
    assert system.derivatives == {"f": "complex step", "h": "traced"}
    assert system.symbolic is None
    line, text = branching.__code__.co_firstlineno + 1, system.explain()
    assert f"f: not traced: {__file__}:{line} asks for the truth of a comparison" in text
    assert "h: traced" in text
    estimate = update_all(estimator(system), YS[:20])
    assert estimate.cost <= estimate.candidate_cost
    with pytest.raises(OptionError, match="asks for the truth"):
        estimator(system, "compiled")


def test_given_jacobians():
    plant = Plant()

    def system(factor):
        return plant.system(
            f_jacobian=lambda x: factor * (A + 0.1 * np.cos(x)[..., None] * np.eye(2))
        )

    assert system(1.0).derivatives == {"f": "traced", "h": "traced"}
    rough = system(1.0 + 1e-7)
    assert rough.derivatives == {"f": "given", "h": "traced"}
    x = np.array([0.3, 0.4])
    np.testing.assert_array_equal(
        estimator(rough)._own_system.f_jacobian(x, np.zeros(0)), rough.f_jacobian(x, np.zeros(0))
    )
    with pytest.raises(ModelError, match="f_jacobian"):
        estimator(system(1.01))


def test_threads_make_the_expressions_of_a_system_at_once():
    expected = estimator(Plant().system()).run(YS[:4]).states

    def begin(system):
        together.wait()
        return estimator(system).run(YS[:4]).states

    together, interval = threading.Barrier(6), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads take turns in the midst of everything
    try:
        with ThreadPoolExecutor(6) as pool:
            for _ in range(2):
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
