"""Filters of a record in C are those of NumPy, under any hypothesis."""

from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.diagnosis import bank
from qpmhe.diagnosis.bank import FilterBank, Hypothesis
from qpmhe.diagnosis.sensor_memory import MemoryBank


def hypotheses(name, unit=1.0, vague=1.0, steps=80):
    """A system, and a record with gaps under hypotheses of all kinds."""
    system, _, cost, scenario = qpmhe.models.catalogue()[name]()
    record = scenario.simulate(0, steps)
    generator = np.random.default_rng(0)
    y = record.measurements.copy()
    y[generator.random(y.shape) < 0.1] = np.nan
    y[30:45] = np.nan
    y[60, 0] += 20 * np.sqrt(scenario.noise_covariance[0, 0])
    u = np.zeros((steps, 0)) if record.inputs is None else record.inputs
    base = Hypothesis(
        y, u, scenario.noise_covariance, scenario.disturbance_covariance,
        scenario.initial_estimate, vague * np.linalg.inv(cost.prior),
    )
    growing = base.noise * np.linspace(1.0, 3.0, steps)[:, None, None]
    repeats = np.ones(steps, np.intp)
    repeats[[10, 40]], repeats[[20, 21]] = 0, (2, 3)
    gains = np.linspace(0.99, 1.02, y.shape[1])  # 0.9 ignites the reactor
    return system, [
        base, replace(base, outliers=True), replace(base, noise=growing),
        replace(base, repeats=repeats), replace(base, step=1.05),
        replace(base, gains=gains, measurements=y / gains),
        replace(base, disturbance=100 * base.disturbance), replace(base, noise=base.noise / 9),
        replace(base, measurements=np.roll(y, 1, axis=0)),
    ]


def in_c(system, monkeypatch):
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    filters = FilterBank(system, None, filters=10**9)
    monkeypatch.setattr(filters, "_run_in_numpy", lambda *_: pytest.fail("it is not compiled"))
    return filters


def check_same(found, expected, tolerance=1e-9):
    for (name, one), true in zip(vars(found).items(), vars(expected).values(), strict=True):
        np.testing.assert_array_equal(np.isfinite(one), np.isfinite(true), err_msg=name)
        there = np.nan_to_num(true, posinf=0.0, neginf=0.0)
        error = abs(np.nan_to_num(one, posinf=0.0, neginf=0.0) - there)
        assert (error <= tolerance * abs(there).max(axis=0)).all(), name


@pytest.mark.parametrize("name", ["vehicle", "batch_reactor", "cstr", "battery_cell"])
def test_all_that_a_bank_says_is_the_same(name, monkeypatch):
    system, tried = hypotheses(name)
    expected = FilterBank(system, None).run(tried)
    # The check of the library needs the filters of NumPy.
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    FilterBank(system, None, filters=10**9).run(tried[:1])
    filters = in_c(system, monkeypatch)
    check_same(filters.run(tried), expected)
    vague = [replace(one, prior=1e10 * one.prior) for one in tried[:2]]
    check_same(filters.run(vague), FilterBank(system, None).run(vague), 1e-5)


def _with_memory(system, tried, sensors, filters=10**9):
    """The filters with a memory of some sensors, of all and of the last of these alone."""
    memories = MemoryBank(FilterBank(system, None), sensors)
    memories._filters = filters
    return memories, [
        memories.hypothesis(base, part, *memory)
        for base in tried for part in (sensors, sensors[-1:])
        for memory in (((0.9, 0.0, 1.0, 1.0), 0.5, 0.5), ((0.7, 0.3, 0.7, 0.3), 1.0, 0.0))
    ]


@pytest.mark.parametrize("name", [
    "van_der_pol", "pendulum", "vehicle", "batch_reactor", "cstr", "battery_cell",
    pytest.param("quadrotor", marks=pytest.mark.slow),
    pytest.param("chain_of_masses", marks=pytest.mark.slow),
])
def test_sensors_with_memory_are_filtered_as_in_numpy(name, monkeypatch):
    system, tried = hypotheses(name)
    # Beside a prior of 1e10, covariances of a lag keep no digits, in NumPy or in C.
    _, vague = hypotheses(name, vague=1e6)
    usual, p = tried[0], system.p
    for sensors in ([p - 1], list(range(p))):
        memories, some = _with_memory(system, tried, sensors)
        of_vague = _with_memory(system, vague[:2], sensors)[1]
        with np.errstate(all="ignore"):  # as a diagnosis runs them: some of the reactor's fail
            expected = memories._run_in_numpy(some, usual)
            expected_of_vague = memories._run_in_numpy(of_vague, usual)
        monkeypatch.delenv("QPMHE_ENGINE", raising=False)
        memories._run([some[0].first(40)], usual.first(40))  # compiles, and compares with NumPy
        with monkeypatch.context() as patched:
            patched.setattr(memories, "_run_in_numpy", lambda *_: pytest.fail("not compiled"))
            check_same(memories._run(some, usual), expected)
            found = memories._run(of_vague, usual).likelihoods
        np.testing.assert_allclose(found, expected_of_vague.likelihoods, rtol=1e-6)


def test_one_library_serves_a_memory_of_any_sensor(monkeypatch):
    system, tried = hypotheses("vehicle")
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    for sensor in range(system.p):
        memories, some = _with_memory(system, tried[:1], [sensor])
        expected = memories._run_in_numpy(some, tried[0])
        check_same(memories._run(some, tried[0]), expected)
    assert [kind for kind, one in bank._libraries[system].items() if one is not None] == [(-1,)]


def test_a_filter_that_fails_counts_as_in_numpy(monkeypatch):
    system = qpmhe.System(lambda x: x**3, lambda x: x, n=1, p=1)
    one = np.eye(1)
    y = np.full((50, 1), 0.1)
    base = Hypothesis(y, np.zeros((50, 0)), one, one, np.array([0.1]), one)
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    far = replace(base, measurements=np.where(np.arange(50)[:, None] < 10, 0.1, 1e150))
    for tried in ([base, far, base], [far, base, base]):
        with np.errstate(all="ignore"):
            found = FilterBank(system, None, filters=10**9).run(tried)
            expected = FilterBank(system, None).run(tried)
        assert np.isfinite(expected.logs).any()
        assert not np.isfinite(expected.logs).all()
        np.testing.assert_allclose(found.logs, expected.logs, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_a_diagnosis_in_c_says_the_same(monkeypatch):
    system, _, cost, scenario = qpmhe.models.vehicle()
    record = scenario.simulate(1, 300)
    y = record.measurements.copy()
    y[:, 0] += 5.0 * np.sqrt(scenario.noise_covariance[0, 0])
    covariances = {
        "disturbance": scenario.disturbance_covariance, "noise": scenario.noise_covariance,
    }
    observer = qpmhe.ExtendedKalman(prior=np.linalg.inv(cost.prior), **covariances)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, qpmhe.QuadraticCost.from_covariances(**covariances), horizon=5,
        initial_state=scenario.initial_estimate, max_qps=0,
    )
    run = mhe.run(y, record.inputs)
    expected = str(qpmhe.diagnose(run))
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    monkeypatch.setattr(bank, "_PAYS", 0.0)
    assert str(qpmhe.diagnose(run)) == expected
    assert "1." in expected
    assert any(one is not None for some in bank._libraries.values() for one in some.values())


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_samples_are_filtered_as_in_numpy(count, monkeypatch):
    system, tried = hypotheses("vehicle")
    memories, some = _with_memory(system, tried[:1], [0])
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    for filters, one in ((FilterBank(system, None, filters=10**9), tried[0]), (memories, some[0])):
        library, part = filters._compiled(one), one.first(count)
        found, expected = filters._run_in_c(library, [part], part), filters._run([part], part)
        assert found.logs.shape == (count, 1)
        np.testing.assert_allclose(
            found.likelihoods, filters._run_in_numpy([part], part).likelihoods, rtol=1e-9)
        np.testing.assert_array_equal(expected.logs, found.logs)


def test_few_filters_are_not_compiled_nor_those_without_a_form(monkeypatch):
    system, tried = hypotheses("vehicle")
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    monkeypatch.setenv("CC", "/nowhere/cc")
    expected = FilterBank(system, None).run(tried)
    found = FilterBank(system, None, filters=10**9).run(tried)  # no compiler
    np.testing.assert_array_equal(found.logs, expected.logs)
