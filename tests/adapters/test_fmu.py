"""FMUs for model exchange against the same model in NumPy; the tests compile them."""

import copy
import os
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.errors import InvalidInputError, ModelError, OptionError, UnknownOptionError

from . import fmus, twins

VERSIONS = pytest.mark.parametrize("fmi", [2, 3])


@VERSIONS
@pytest.mark.whole
@pytest.mark.parametrize("directional", [True, False])
@pytest.mark.parametrize("how", [
    {}, {"method": "euler", "steps": 2}, {"method": "radau"},
])
def test_values_and_derivatives(fmi, directional, how):
    system = qpmhe.from_fmu(fmus.fmu(fmi, directional), dt=0.1, **how)
    other, (xs, us) = fmus.twin(dt=0.1, **how), fmus.points()
    assert (system.n, system.p, system.m, system.dt) == (2, 2, 2, 0.1)
    assert (system.method, system.steps) == (other.method, other.steps)
    word = "fmu" if directional else "finite differences"
    assert system.derivatives == {"f": word, "h": word}
    for name in twins.FUNCTIONS:
        exact = directional or not name.endswith("jacobian")
        np.testing.assert_allclose(
            getattr(system, name).batch(xs, us), getattr(other, name).batch(xs, us),
            rtol=1e-11 if exact else 1e-7, atol=1e-12 if exact else 1e-7, err_msg=name,
        )
    twins.check_batches(system, xs, us)
    timed = np.hstack((us, np.linspace(0.02, 0.3, len(us))[:, None]))
    np.testing.assert_allclose(
        system.timed.f.batch(xs, timed), other.timed.f.batch(xs, timed), rtol=1e-12
    )
    assert "it is an FMU" in system.explain()


def test_a_chosen_method():
    system = qpmhe.from_fmu(fmus.fmu(), dt=0.1, method="auto", tolerance=1e-2)
    xs, us = fmus.points()
    other = fmus.twin(dt=0.1, method=system.method, steps=system.steps)
    np.testing.assert_allclose(system.f.batch(xs, us), other.f.batch(xs, us), rtol=1e-12)
    assert system.origin.choice is not None


def estimator(system, **options):
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(
            prior=0.1 * np.eye(2), disturbance=1e-4 * np.eye(2), noise=1e-3 * np.eye(system.p)
        ),
        qpmhe.QuadraticCost.from_covariances(
            prior=0.1 * np.eye(2), disturbance=1e-4 * np.eye(2), noise=1e-3 * np.eye(system.p)
        ),
        horizon=5, initial_state=[1.2, 0.4], max_qps=2, **options,
    )


def record(count=15, seed=0):
    generator, system = np.random.default_rng(seed), fmus.twin(dt=0.1)
    x, ys, us = np.array([1.0, 0.5]), [], generator.uniform(0.2, 1.0, (count, 2)) * [1.0, 0.1]
    for u in us:
        ys.append(system.h(x, u) + 0.03 * generator.standard_normal(2))
        x = system.f(x, u)
    return np.array(ys), us


@VERSIONS
def test_an_estimator_is_that_of_the_same_model_in_numpy(fmi):
    ys, us = record()
    box = qpmhe.Box([0.01, 0.01], [5.0, 5.0])
    system = qpmhe.from_fmu(fmus.fmu(fmi), dt=0.1, states=box)
    mhe, other = estimator(system), estimator(fmus.twin(dt=0.1, states=box), engine="python")
    with pytest.raises(OptionError, match="f is not traced: it is an FMU"):
        estimator(system, engine="compiled")
    run = mhe.run(ys[:8], us[:8])
    saved = mhe.state_dict()
    expected = other.run(ys, us)
    np.testing.assert_allclose(run.states, expected.states[:9], rtol=1e-9)
    for one in (mhe, pickle.loads(pickle.dumps(mhe)), estimator(copy.deepcopy(system))):
        one.load_state_dict(saved)
        found = one.run(ys[8:], us[8:])
        np.testing.assert_allclose(found.states, expected.states[8:], rtol=1e-9)
        np.testing.assert_allclose(found.costs, expected.costs[8:], rtol=1e-8)
        assert (found.costs <= found.candidate_costs).all()


@VERSIONS
def test_chosen_variables_and_parameters(fmi):
    path = fmus.fmu(fmi)
    chosen = {
        "outputs": ["loss", "lower", "flow"], "inputs": ["leak"],
        "parameters": {"area": 3.0, "pump": 0.4, "pipes": 2, "label": "plant", "schedules": False},
    }
    system, (xs, us) = qpmhe.from_fmu(path, dt=0.1, **chosen), fmus.points()
    other = qpmhe.System.from_ode(
        lambda x, u: fmus.rate(x, [0.4, u[0]], 3.0, 2.0),
        lambda x: np.stack([0.1 * x[0] ** 2, x[1], 2.0 * np.sqrt(x[1])]), n=2, p=3, m=1, dt=0.1,
    )
    assert system.derivatives == {"f": "fmu", "h": "finite differences"}  # none of loss
    us = us[:, :1]
    np.testing.assert_allclose(system.f.batch(xs, us), other.f.batch(xs, us), rtol=1e-12)
    np.testing.assert_allclose(system.h.batch(xs, us), other.h.batch(xs, us), rtol=1e-12)
    slopes = system.h_jacobian.batch(xs, us)
    np.testing.assert_allclose(slopes, other.h_jacobian.batch(xs, us), rtol=1e-6, atol=1e-8)
    states, inputs, outputs, parameters = system.signals
    assert [(one.name, one.unit, one.value) for one in states] == [
        ("upper", "m", 1.0), ("lower", "m", 0.5)
    ]
    assert [str(one) for one in inputs] == ["leak [m3/s]"]
    assert [str(one) for one in outputs] == ["loss", "lower [m]", "flow [m3/s]"]
    assert {one.name: one.value for one in parameters} == {
        "area": 3.0, "outlet": 1.0, "drift": 0.0, "schedules": False, "pipes": 2, "label": "plant"
    }
    with pytest.raises(ModelError, match=r"not those of its output .*no derivative of this"):
        qpmhe.from_fmu(path, dt=0.1, derivatives="directional", **chosen)
    # States alone need no derivatives from the FMU; others may be taken by differences.
    alone = qpmhe.from_fmu(path, dt=0.1, outputs=["lower"], derivatives="directional")
    np.testing.assert_array_equal(alone.h_jacobian(xs[0], np.zeros(2)), [[0.0, 1.0]])
    by_differences = qpmhe.from_fmu(path, dt=0.1, derivatives="differences")
    assert set(by_differences.derivatives.values()) == {"finite differences"}


@VERSIONS
def test_nominal_values_are_the_scales(fmi):
    system = qpmhe.from_fmu(fmus.fmu(fmi, nominal=50), dt=0.1)
    assert system.scales.tolist() == [50.0, 1.0]
    assert [one.nominal for one in system.signals.states] == [50.0, 1.0]
    assert qpmhe.from_fmu(fmus.fmu(fmi), dt=0.1).scales is None
    given = qpmhe.from_fmu(fmus.fmu(fmi, nominal=50), dt=0.1, scales=[2.0, 3.0])
    assert given.scales.tolist() == [2.0, 3.0]


def test_an_unknown_input_among_the_states():
    system = qpmhe.noisy_inputs(qpmhe.from_fmu(fmus.fmu(), dt=0.1), [1])
    other, (xs, us) = qpmhe.noisy_inputs(fmus.twin(dt=0.1), [1]), fmus.points()
    zs = np.hstack((xs, 0.1 * np.ones((len(xs), 1))))
    for name in ("f", "h"):
        found, expected = getattr(system, name), getattr(other, name)
        np.testing.assert_allclose(found.batch(zs, us), expected.batch(zs, us), rtol=1e-12)


def test_an_unknown_input_among_the_parameters_keeps_its_name():
    system = qpmhe.augment_parameters(qpmhe.from_fmu(fmus.fmu(), dt=0.1), nominal=[0.0])
    assert system.derivatives == {"f": "finite differences", "h": "finite differences"}
    for one in (system, pickle.loads(pickle.dumps(system))):
        states, inputs, _, _ = one.signals
        assert [signal.name for signal in states] == ["upper", "lower", "leak"]
        assert [str(signal) for signal in inputs] == ["pump [m3/s]"]


def values(system):
    xs, us = fmus.points(40)
    return [system.f.batch(xs, us), system.f_jacobian.batch(xs, us), system.h.batch(xs, us)]


def test_copies_threads_and_processes():
    path = fmus.fmu()
    system = qpmhe.from_fmu(path, dt=0.1)
    others = [
        copy.deepcopy(system), pickle.loads(pickle.dumps(system)), system.discretized("rk4", 1),
        qpmhe.from_fmu(path, dt=0.1, parameters={"area": 5.0}),
    ]
    expected = values(system)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(values, [system, *others] * 3))
    for k, one in enumerate(found):
        if k % 5 < 4:
            np.testing.assert_array_equal(one[0], expected[0])
            np.testing.assert_array_equal(one[1], expected[1])
        else:  # other parameters, at the same time
            np.testing.assert_array_equal(one[0], found[4][0])
            assert not np.array_equal(one[0], expected[0])
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        np.testing.assert_array_equal(pool.submit(values, system).result()[0], expected[0])
    text = pickle.dumps(system)
    path.write_bytes(fmus.fmu(directional=False).read_bytes())
    with pytest.raises(InvalidInputError, match="has changed since the system was made"):
        pickle.loads(text)
    path.unlink()
    with pytest.raises(InvalidInputError, match="no FMU that can be read"):
        pickle.loads(text)
    np.testing.assert_array_equal(values(system)[0], expected[0])


def test_an_fmu_that_a_process_may_have_once():
    path = fmus.fmu(changes=[(
        'modelIdentifier="tanks"',
        'modelIdentifier="tanks" canBeInstantiatedOnlyOncePerProcess="true"',
    )])
    system = qpmhe.from_fmu(path, dt=0.1)
    np.testing.assert_array_equal(values(copy.deepcopy(system))[0], values(system)[0])
    with pytest.raises(ModelError, match="a process may have one instance of it"):
        qpmhe.from_fmu(path, dt=0.1, parameters={"area": 5.0})


@VERSIONS
def test_where_the_fmu_fails_the_step_falls_back(fmi):
    mhe = estimator(qpmhe.from_fmu(fmus.fmu(fmi), dt=0.1))
    other = estimator(fmus.twin(dt=0.1), engine="python")
    ys, us = record()
    for y, u in zip(ys[:5], us[:5], strict=True):
        mhe.update(y, u), other.update(y, u)
    with pytest.raises(Exception, match="a level is negative"):
        mhe.system.f(np.array([-1.0, 1.0]), us[0])
    with pytest.raises(Exception, match="a tank overflows"):  # it must start again
        mhe.system.f(np.array([2e5, 1.0]), us[0])
    for y, u in zip(ys[5:], us[5:], strict=True):
        found, expected = mhe.update(y, u), other.update(y, u)
        np.testing.assert_allclose(found.state, expected.state, rtol=1e-9)
    mhe.update([-50.0, -300.0], us[0])
    assert Status.MODEL_FAILED in mhe.update(ys[0], us[0]).status
    with pytest.raises(Exception, match="the plant is lost"):
        mhe.system.f(np.array([2e4, 1.0]), us[0])
    with pytest.raises(Exception, match=r"fatal error .* make the system again in a new process"):
        mhe.system.f(np.array([1.0, 1.0]), us[0])
    assert Status.MODEL_FAILED in mhe.update(ys[0], us[0]).status


CHANGED = {
    "co-simulation": ([("ModelExchange", "CoSimulation")], "only for co-simulation"),
    "version": ([('"2.0"', '"1.0"')], "it is of FMI 1.0"),
    "indicators": ([('Indicators="0"', 'Indicators="3"')], "3 event indicators.*noEvent"),
    "token": ([('guid="tanks"', 'guid="other"')], "cannot be instantiated"),
    "library": ([('modelIdentifier="tanks"', 'modelIdentifier="ponds"')], "no library for this"),
    "rates": ([('<Derivatives><Unknown index="3"/><Unknown index="4"/></Derivatives>', "")],
              "no continuous states"),
    "state": ([(' derivative="1"', "")], r"der\(upper\) are not those of a Real state"),
    "garbage": ([('index="3"', 'index="300"')], "FMPy cannot read its description"),
    "start": ([('<Real start="1"', '<Real start="full"')], "start value of pump is 'full'; expec"),
    "integer": ([('<Integer start="1"', '<Integer start="1.5"')], "start value of pipes is '1.5'"),
    "nominal": ([('start="0" unit', 'nominal="big" start="0" unit')], "nominal value of leak is"),
    "time": ([("<UnitD", '<DefaultExperiment startTime="noon"/><UnitD')], "start time is 'noon'"),
    "reference": ([('valueReference="4"', 'valueReference="-4"')], "reference of pump is -4"),
}


@pytest.mark.whole
@pytest.mark.parametrize("name", CHANGED)
def test_fmus_that_are_refused(name):
    changes, text = CHANGED[name]
    with pytest.raises(ModelError, match=text):
        qpmhe.from_fmu(fmus.fmu(changes=changes), dt=0.1)


@VERSIONS
def test_more_fmus_that_are_refused(fmi):
    discrete = (
        '<ScalarVariable name="valve" valueReference="12" causality="local" '
        'variability="discrete"><Boolean/></ScalarVariable>' if fmi == 2
        else '<Boolean name="valve" valueReference="12" variability="discrete"/>'
    )
    for given, text in (
        ({"extra": discrete}, "discrete states or values that only events change, valve"),
        ({"name": "binaries/toaster64/tanks.so"}, r"binaries/.*, but for toaster64; expected one"),
        ({"name": "binaries/toaster64/tanks.so", "others": ["sources/tanks.c"]}, "or compile its"),
    ):
        with pytest.raises(ModelError, match=text):
            qpmhe.from_fmu(fmus.fmu(fmi, **given), dt=0.1)
    path = fmus.fmu(fmi, directional=False)
    here = os.getcwd()
    for given, text in (
        ({"parameters": {"drift": 0.1}}, "does not depend on time"),
        ({"parameters": {"schedules": True}}, "an event at time 3"),
        ({"parameters": {"label": "other"}}, "fails in its initialisation"),
        ({"derivatives": "directional"}, "offers no directional derivatives"),
    ):
        with pytest.raises(ModelError, match=text):
            qpmhe.from_fmu(path, dt=0.1, **given)
    for given, text in (
        ({"outputs": ["folw"]}, "did you mean flow"), ({"outputs": "flow"}, "a sequence of names"),
        ({"outputs": ["area"]}, "a fixed parameter"), ({"outputs": ["flow", "flow"]}, "twice"),
        ({"inputs": ["flow"]}, "expected a continuous input"), ({"inputs": [3]}, "sequence of nam"),
        ({"inputs": ["zzz"]}, "its variables are upper, lower"), ({"parameters": 3}, "dictionary"),
        ({"parameters": {"pump": 1.0}}, "that is among the inputs u"),
        ({"parameters": {"upper": 1.0}}, "a local; expected a parameter"),
        ({"parameters": {"area": "wide"}}, "expected a value of type (Real|Float64)"),
        ({"parameters": {"area": True}}, "expected a value of type (Real|Float64)"),
        ({"parameters": {"area": np.nan}}, "expected a value of type (Real|Float64)"),
        ({"parameters": {"pipes": 1.5}}, "expected a value of type Int"),
        ({"parameters": {"pipes": 2**31}}, "expected a value of type Int"),
        ({"parameters": {"schedules": 1}}, "expected a value of type Boolean"),
    ):
        with pytest.raises(InvalidInputError, match=text):
            qpmhe.from_fmu(path, dt=0.1, **given)
    for error, given in (
        (OptionError, {"dt": 0.0}), (OptionError, {"method": "rk5"}), (OptionError, {"steps": 0}),
        (OptionError, {"derivatives": "exact"}), (OptionError, {"tolerance": 1e-3}),
        (UnknownOptionError, {"colour": "red"}),
    ):
        with pytest.raises(error):
            qpmhe.from_fmu(path, **{"dt": 0.1, **given})
    assert os.getcwd() == here


def test_files_that_are_none_and_no_fmpy(tmp_path, monkeypatch):
    for path in (tmp_path / "none.fmu", tmp_path, 3, "a\0b"):
        with pytest.raises(InvalidInputError, match="path is"):
            qpmhe.from_fmu(path, dt=0.1)
    bad = fmus.fmu()
    bad.write_bytes(b"PK")
    with pytest.raises(InvalidInputError, match="no FMU that can be read"):
        qpmhe.from_fmu(bad, dt=0.1)
    here, broken = os.getcwd(), fmus.fmu(others=["resources/"])
    monkeypatch.setattr(fmus, "library", lambda fmi, nominal: b"no library")
    with pytest.raises(ModelError, match="its library cannot be loaded here"):
        qpmhe.from_fmu(fmus.fmu(), dt=0.1)
    assert os.getcwd() == here
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(InvalidInputError, match=r"from_fmu needs fmpy.*qpmhe\[fmu\]"):
        qpmhe.from_fmu(broken, dt=0.1)


OSCILLATOR = '''
from pythonfmu3 import Fmi3Causality, Fmi3Initial, Fmi3SlaveBase, Fmi3Variability, Float64
from pythonfmu3 import ModelExchange


class Oscillator(Fmi3SlaveBase, ModelExchange):
    def __init__(self, **options):
        super().__init__(**options)
        self.time, self.x, self.v, self.dx, self.dv, self.mu = 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
        moving = {"variability": Fmi3Variability.continuous}
        exact = {"initial": Fmi3Initial.exact, **moving}
        rate = {"causality": Fmi3Causality.local, **moving}
        for one in (
            Float64("time", causality=Fmi3Causality.independent, **moving),
            Float64("x", causality=Fmi3Causality.output, start=1.0, **exact),
            Float64("v", causality=Fmi3Causality.local, start=0.0, **exact),
            Float64("dx", derivative=1, **rate), Float64("dv", derivative=2, **rate),
            Float64("mu", causality=Fmi3Causality.parameter, start=1.0,
                    variability=Fmi3Variability.fixed),
        ):
            self.register_variable(one)

    def get_continuous_state_derivatives(self):
        self.dx, self.dv = self.v, self.mu * (1.0 - self.x**2) * self.v - self.x
        return [self.dx, self.dv]
'''


@pytest.mark.slow
def test_an_fmu_of_another_tool(tmp_path):
    """Van der Pol's oscillator by pythonfmu3, which runs it in this interpreter."""
    pytest.importorskip("pythonfmu3")
    (tmp_path / "oscillator.py").write_text(OSCILLATOR)
    subprocess.run(
        [sys.executable, "-m", "pythonfmu3", "build", "-f", "oscillator.py"], cwd=tmp_path,
        check=True, capture_output=True,
    )
    system = qpmhe.from_fmu(tmp_path / "Oscillator.fmu", dt=0.1, parameters={"mu": 0.7})
    other = qpmhe.System.from_ode(
        lambda x: np.stack([x[1], 0.7 * (1.0 - x[0] ** 2) * x[1] - x[0]]), lambda x: x[:1],
        n=2, p=1, dt=0.1,
    )
    assert [one.name for one in system.signals.states] == ["x", "v"]
    xs, us = fmus.points()[0], np.zeros((6, 0))
    np.testing.assert_allclose(system.f.batch(xs, us), other.f.batch(xs, us), rtol=1e-12)
    slopes = system.f_jacobian.batch(xs, us)
    np.testing.assert_allclose(slopes, other.f_jacobian.batch(xs, us), rtol=1e-6, atol=1e-8)
