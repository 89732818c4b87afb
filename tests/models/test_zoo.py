"""Every model of the zoo: derivatives, records, sets, noise, observer, and what MHE gains."""

import dataclasses
import inspect
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe import models

MODELS = models.catalogue()
SIZES = {
    "batch_reactor": (2, 1, 0),
    "van_der_pol": (2, 1, 0),
    "cstr": (2, 1, 1),
    "pendulum": (2, 1, 0),
    "vehicle": (3, 4, 2),
    "quadrotor": (12, 6, 4),
    "chain_of_masses": (12, 6, 0),
    "battery_cell": (3, 1, 1),
}
EXAMPLES = {name: function() for name, function in MODELS.items()}

each_model = pytest.mark.parametrize("name", SIZES)


def inputs_of(record):
    count = len(record.measurements)
    return np.zeros((count, 0)) if record.inputs is None else record.inputs


def minus(residual, one, other):
    return one - other if residual is None else residual(one, other)


def residuals(system, record):
    """Disturbance and noise of a record, by its definition."""
    x, u = record.states, inputs_of(record)
    w = np.array([minus(system.state_residual, x[t + 1], system.f(x[t], u[t]))
                  for t in range(len(u))])
    v = np.array([minus(system.output_residual, record.measurements[t], system.h(x[t], u[t]))
                  for t in range(len(u))])
    return w, v


def observe(system, observer, start, record):
    """The observer alone, z+ = f(z, u) + L(z, y - h(z, u))."""
    states, covariance = [start], observer.initial_covariance()
    for y, u in zip(record.measurements, inputs_of(record), strict=True):
        z = states[-1]
        sample = qpmhe.Sample(system, u, covariance=covariance)
        assert not observer.needs_jacobians
        correction, covariance = observer.correct(
            z, minus(system.output_residual, y, system.h(z, u)), sample)
        states.append(system.f(z, u) + correction)
    return np.array(states)


def settled(scenario, errors):
    """Root mean square of |x - estimate| once the initial error counts as decayed."""
    late = errors[round(scenario.settling_time / scenario.dt) :]
    return np.sqrt(np.mean(np.sum(late**2, axis=1)))


def test_the_catalogue():
    assert list(MODELS) == list(SIZES)
    for name, function in MODELS.items():
        assert getattr(models, name) is function
        assert name in models.__all__


@each_model
def test_parts(name):
    example = EXAMPLES[name]
    assert isinstance(example, models.Example)
    system, observer, cost, scenario = example
    assert (system.n, system.p, system.m) == SIZES[name]
    assert isinstance(observer, qpmhe.Observer)
    assert scenario.system is system
    assert len(set(scenario.labels)) == len(scenario.labels) == system.n
    assert scenario.title
    assert scenario.dt == system.dt
    assert 0.0 < scenario.settling_time <= 0.5 * scenario.steps * scenario.dt
    for weight, covariance in (
        (cost.disturbance, scenario.disturbance_covariance),
        (cost.noise, scenario.noise_covariance),
    ):
        np.testing.assert_allclose(weight @ covariance, np.eye(len(weight)), atol=1e-12)
    text = inspect.getdoc(MODELS[name])
    assert all(part in text for part in (".. math::", "References", "N = ", "sampling time"))


def derivative(function, x, u):
    """By the complex step, or by central differences where there is no complex arctan2."""
    n = x.shape[-1]
    try:
        moved = x[:, None] + 1e-30j * np.eye(n)
        values = function(moved, np.repeat(u[:, None], n, axis=1)).imag / 1e-30
        return np.swapaxes(values, 1, 2), 1e-11
    except TypeError:
        values = [
            [function(row + 1e-5 * e, v) - function(row - 1e-5 * e, v) for e in np.eye(n)]
            for row, v in zip(x, u, strict=True)
        ]
        return np.swapaxes(values, 1, 2) / 2e-5, 1e-8


@each_model
def test_jacobians_are_those_of_the_complex_step(name):
    system, _, _, scenario = EXAMPLES[name]
    assert (system.f_jacobian.method, system.h_jacobian.method) == ("given", "given")
    made = system.__reduce__()[1][1]
    record = scenario.simulate(1)
    x, u = record.states[:-1:9], inputs_of(record)[::9]
    for key in ("rate", "h"):
        takes_input = len(inspect.signature(made[key]).parameters) == 2
        plain = made[key] if takes_input else lambda x, u, g=made[key]: g(x)
        expected, tolerance = derivative(plain, x, u)
        given = made[f"{key}_jacobian"]
        found = given(x, u) if len(inspect.signature(given).parameters) == 2 else given(x)
        scale = 1.0 + np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=tolerance * scale)
    expected, _ = derivative(system.f.batch, x, u)
    found = system.f_jacobian.batch(x, u)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


@each_model
def test_functions_take_any_leading_dimensions(name):
    system, _, _, scenario = EXAMPLES[name]
    assert system.f.mode == system.h.mode == "batched"
    made = system.__reduce__()[1][1]
    record = scenario.simulate(2, 12)
    x, u = record.states[:-1], inputs_of(record)
    for key in ("rate", "rate_jacobian", "h", "h_jacobian"):
        function = made[key]
        takes_input = len(inspect.signature(function).parameters) == 2
        row = [function(x[i], u[i]) if takes_input else function(x[i]) for i in range(12)]
        for lead in [(12,), (1, 12), (3, 4), (2, 3, 2)]:
            xs, us = x.reshape(*lead, -1), u.reshape(*lead, system.m)
            found = function(xs, us) if takes_input else function(xs)
            expected = np.reshape(row, (*lead, *row[0].shape))
            assert found.shape == expected.shape
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


@each_model
def test_the_same_seed_gives_the_same_record(name):
    system, _, _, scenario = EXAMPLES[name]
    first, again, other = (scenario.simulate(seed, 30) for seed in (3, 3, 4))
    fresh = MODELS[name]().scenario.simulate(3, 30)
    assert len(list(first)) == (3 if system.m else 2)
    for one, two, three in zip(first, again, fresh, strict=True):
        assert np.array_equal(one, two)
        assert np.array_equal(one, three)
        assert np.isfinite(one).all()
    assert not np.array_equal(first.measurements, other.measurements)
    assert first.states.shape == (31, system.n)
    assert first.measurements.shape == (30, system.p)
    assert (first.inputs is None) == (system.m == 0)
    assert scenario.simulate(0).measurements.shape[0] == scenario.steps


@pytest.mark.parametrize(
    "example",
    [
        models.batch_reactor(), models.batch_reactor("rk4"), models.chain_of_masses(),
        models.chain_of_masses(3, 2, "euler"), EXAMPLES["van_der_pol"],
    ],
)
def test_without_sets_and_inputs_the_record_is_one_draw(example):
    system, scenario, nothing = example.system, example.scenario, np.zeros(0)
    for seed in range(3):
        generator = np.random.default_rng(seed)
        noises = [
            generator.standard_normal((scenario.steps, len(covariance)))
            @ np.linalg.cholesky(covariance).T
            for covariance in (scenario.disturbance_covariance, scenario.noise_covariance)
        ]
        states, measurements = [scenario.initial_state], []
        for w, v in zip(*noises, strict=True):
            measurements.append(system.h(states[-1], nothing) + v)
            states.append(system.f(states[-1], nothing) + w)
        found = scenario.simulate(seed)
        assert np.array_equal(found.states, states)
        assert np.array_equal(found.measurements, measurements)


@each_model
def test_covariances_of_the_simulated_noise(name):
    system, _, _, scenario = EXAMPLES[name]
    pairs = [residuals(system, scenario.simulate(seed)) for seed in range(3)]
    for samples, covariance in (
        (np.vstack([w for w, _ in pairs]), scenario.disturbance_covariance),
        (np.vstack([v for _, v in pairs]), scenario.noise_covariance),
    ):
        deviations = np.sqrt(np.diag(covariance))
        found = samples.T @ samples / len(samples) / np.outer(deviations, deviations)
        # Five standard deviations of a sample variance, and of a mean.
        tolerance = 5.0 * np.sqrt(2.0 / len(samples))
        np.testing.assert_allclose(found, np.eye(len(deviations)), rtol=0.0, atol=tolerance)
        assert np.all(np.abs(samples.mean(axis=0)) < 5.0 * deviations / np.sqrt(len(samples)))


@each_model
@pytest.mark.parametrize("method", ["rk4", "euler"])
def test_records_stay_in_the_sets(name, method):
    system, _, _, scenario = MODELS[name](method=method)
    for seed in range(5):
        record = scenario.simulate(seed)
        assert all(np.isfinite(part).all() for part in record)
        if system.states is not None:
            assert system.states.violation(record.states) == 0.0
            assert system.states.violation(scenario.initial_estimate) == 0.0


@each_model
def test_the_observers_error_decays_without_noise(name):
    system, observer, _, scenario = EXAMPLES[name]
    quiet = dataclasses.replace(
        scenario,
        disturbance_covariance=1e-24 * scenario.disturbance_covariance,
        noise_covariance=1e-24 * scenario.noise_covariance,
        resolution=None,
    )
    record = quiet.simulate(0, 2 * scenario.steps)
    scale = np.abs(scenario.initial_state - scenario.initial_estimate).max()
    estimates = observe(system, observer, scenario.initial_estimate, record)
    errors = minus(system.state_residual, estimates, record.states)
    late = np.abs(errors[-scenario.steps // 2 :])
    assert late.max() < 1e-3 * scale


@each_model
def test_the_observers_error_stays_bounded(name):
    system, observer, _, scenario = EXAMPLES[name]
    for seed in range(5):
        record = scenario.simulate(seed)
        estimates = observe(system, observer, scenario.initial_estimate, record)
        errors = minus(system.state_residual, estimates, record.states)
        sizes = np.linalg.norm(errors, axis=1)
        rest = sizes[round(scenario.settling_time / scenario.dt) :]
        assert rest.max() < 0.8 * sizes[0]
        assert np.sqrt(np.mean(rest**2)) < 0.4 * sizes[0]
        assert np.sqrt(np.mean(sizes[-scenario.steps // 4 :] ** 2)) < 0.4 * sizes[0]


@each_model
def test_two_qps_a_sample_make_sense(name):
    system, observer, cost, scenario = EXAMPLES[name]
    record = scenario.simulate(0)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=scenario.horizon,
        initial_state=scenario.initial_estimate, max_qps=2,
    )
    run = mhe.run(record.measurements, record.inputs)
    alone = observe(system, observer, scenario.initial_estimate, record)
    assert run.share(qpmhe.Status.IMPROVED) > 0.95
    assert run.share(qpmhe.Status.ROWS_DROPPED) == 0.0
    assert np.all(run.costs <= run.candidate_costs)
    if system.states is not None:
        assert system.states.violation(run.states) < 1e-6
    ours, theirs = (
        settled(scenario, minus(system.state_residual, states, record.states))
        for states in (run.states, alone)
    )
    assert ours < theirs


@each_model
def test_a_pickled_example_is_the_same(name):
    again = pickle.loads(pickle.dumps(EXAMPLES[name]))
    assert isinstance(again, models.Example)
    example = EXAMPLES[name]
    for one, two in zip(
        example.scenario.simulate(5, 10), again.scenario.simulate(5, 10), strict=True
    ):
        assert np.array_equal(one, two)
    record, estimates = example.scenario.simulate(5, 10), []
    for system, observer, cost, scenario in (example, again):
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=5, initial_state=scenario.initial_estimate
        )
        estimates.append(mhe.run(record.measurements, record.inputs).states)
    assert np.array_equal(*estimates)


@each_model
def test_an_unknown_method(name):
    with pytest.raises(qpmhe.errors.OptionError, match="method is 'heun'; expected one of 'euler'"):
        MODELS[name](method="heun")
