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
    "batch_reactor": (2, 1, 0), "van_der_pol": (2, 1, 0), "cstr": (2, 1, 1), "pendulum": (2, 1, 0),
    "vehicle": (3, 4, 2), "quadrotor": (12, 6, 4), "chain_of_masses": (12, 6, 0),
    "battery_cell": (3, 1, 1),
}
EXAMPLES = {name: function() for name, function in MODELS.items()}

each_model = pytest.mark.parametrize("name", SIZES)


def inputs_of(record):
    count = len(record.measurements)
    return np.zeros((count, 0)) if record.inputs is None else record.inputs


def minus(residual, one, other):
    return one - other if residual is None else residual(one, other)


def observe(system, observer, start, record):
    """The observer alone, z+ = f(z, u) + L(z, y - h(z, u)), and its errors."""
    states = [start]
    assert not observer.needs_jacobians
    for y, u in zip(record.measurements, inputs_of(record), strict=True):
        z = states[-1]
        innovation = minus(system.output_residual, y, system.h(z, u))
        states.append(system.f(z, u) + observer.correct(z, innovation, qpmhe.Sample(system, u))[0])
    return minus(system.state_residual, np.array(states), record.states)


@each_model
def test_parts(name):
    system, observer, cost, scenario = EXAMPLES[name]
    assert (system.n, system.p, system.m) == SIZES[name]
    assert list(MODELS) == list(SIZES)
    assert getattr(models, name) is MODELS[name]
    assert name in models.__all__
    assert isinstance(observer, qpmhe.Observer)
    assert scenario.system is system
    assert len(set(scenario.labels)) == len(scenario.labels) == system.n
    assert scenario.dt == system.dt
    assert 0.0 < scenario.settling_time <= 0.5 * scenario.steps * scenario.dt
    for weight, covariance in (
        (cost.disturbance, scenario.disturbance_covariance),
        (cost.noise, scenario.noise_covariance),
    ):
        np.testing.assert_allclose(weight @ covariance, np.eye(len(weight)), atol=1e-12)
    text = inspect.getdoc(MODELS[name])
    assert all(part in text for part in (".. math::", "References", "N = ", "sampling time"))
    with pytest.raises(qpmhe.errors.OptionError, match="method is 'heun'; expected one of 'euler'"):
        MODELS[name](method="heun")


def derivative(function, x, u):
    ends = [
        [function(row + 1e-5 * e, v) - function(row - 1e-5 * e, v) for e in np.eye(len(row))]
        for row, v in zip(x, u, strict=True)
    ]
    return np.swapaxes(ends, 1, 2) / 2e-5


@each_model
def test_functions_are_batched_and_their_jacobians_exact(name):
    system, _, _, scenario = EXAMPLES[name]
    own = system.model().functions
    assert own.f.mode == own.h.mode == "batched"
    assert system.evaluation.methods == ("given", "given")
    assert system.model().methods == ("traced", "traced")
    record = scenario.simulate(1)
    x, u = record.states[:-1:9][:12], inputs_of(record)[::9][:12]
    made = {
        key: one if len(inspect.signature(one).parameters) == 2 else lambda x, u, g=one: g(x)
        for key, one in system.__reduce__()[1][1].items()
        if key in ("rate", "rate_jacobian", "h", "h_jacobian")
    }
    pairs = [(derivative(made[key], x, u), made[f"{key}_jacobian"](x, u)) for key in ("rate", "h")]
    pairs.append((derivative(system.f.batch, x, u), system.f_jacobian.batch(x, u)))
    for expected, found in pairs:
        scale = 1.0 + np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8 * scale)
    for function in made.values():
        row = [function(one, v) for one, v in zip(x, u, strict=True)]
        for lead in [(12,), (1, 12), (2, 3, 2)]:
            found = function(x.reshape(*lead, -1), u.reshape(*lead, system.m))
            expected = np.reshape(row, (*lead, *row[0].shape))
            assert found.shape == expected.shape
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


@each_model
@pytest.mark.parametrize("method", ["rk4", "euler"])
def test_records_stay_in_the_sets_and_have_the_noise_of_the_covariances(name, method):
    system, _, _, scenario = MODELS[name](method=method)
    pairs = []
    for seed in range(5):
        record = scenario.simulate(seed)
        x, u, y = record.states, inputs_of(record), record.measurements
        assert x.shape == (scenario.steps + 1, system.n)
        assert y.shape == (scenario.steps, system.p)
        assert len(list(record)) == (3 if system.m else 2)
        assert all(np.isfinite(part).all() for part in record)
        if system.states is not None:
            assert system.states.violation(np.vstack((x, scenario.initial_estimate))) == 0.0
        pairs.append((
            minus(system.state_residual, x[1:], system.f.batch(x[:-1], u)),
            minus(system.output_residual, y, system.h.batch(x[:-1], u)),
        ))
    covariances = scenario.disturbance_covariance, scenario.noise_covariance
    for draws, covariance in zip(zip(*pairs, strict=True), covariances, strict=True):
        samples, deviations = np.vstack(draws), np.sqrt(np.diag(covariance))
        found = samples.T @ samples / len(samples) / np.outer(deviations, deviations)
        # Five standard deviations of a sample variance, and of a mean.
        tolerance = 5.0 * np.sqrt(2.0 / len(samples))
        np.testing.assert_allclose(found, np.eye(len(deviations)), rtol=0.0, atol=tolerance)
        assert np.all(np.abs(samples.mean(axis=0)) < 5.0 * deviations / np.sqrt(len(samples)))


@each_model
def test_the_observers_error_stays_bounded_and_decays_without_noise(name):
    system, observer, _, scenario = EXAMPLES[name]
    start, settled = scenario.initial_estimate, round(scenario.settling_time / scenario.dt)
    for seed in range(3):
        sizes = np.linalg.norm(
            observe(system, observer, start, scenario.simulate(seed)), axis=1)
        rest = sizes[settled:]
        assert rest.max() < 0.8 * sizes[0]
        assert np.sqrt(np.mean(rest**2)) < 0.4 * sizes[0]
    quiet = dataclasses.replace(
        scenario, disturbance_covariance=1e-24 * scenario.disturbance_covariance,
        noise_covariance=1e-24 * scenario.noise_covariance, resolution=None,
    )
    errors = observe(system, observer, start, quiet.simulate(0, 2 * scenario.steps))
    late = np.abs(errors[-scenario.steps // 2 :])
    assert late.max() < 1e-3 * np.abs(scenario.initial_state - start).max()


@each_model
def test_two_qps_a_sample_make_sense(name):
    system, observer, cost, scenario = EXAMPLES[name]
    record = scenario.simulate(0)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=scenario.horizon,
        initial_state=scenario.initial_estimate, max_qps=2,
    )
    run = mhe.run(record.measurements, record.inputs)
    assert run.share(qpmhe.Status.IMPROVED) > 0.95
    assert run.share(qpmhe.Status.ROWS_DROPPED) == 0.0
    assert np.all(run.costs <= run.candidate_costs)
    if system.states is not None:
        assert system.states.violation(run.states) < 1e-6
    late = slice(round(scenario.settling_time / scenario.dt), None)
    ours = minus(system.state_residual, run.states, record.states)
    alone = observe(system, observer, scenario.initial_estimate, record)
    assert np.linalg.norm(ours[late]) < np.linalg.norm(alone[late])


@each_model
def test_a_seed_makes_one_record_in_copies_too(name):
    first, other = (EXAMPLES[name].scenario.simulate(seed, 10) for seed in (5, 6))
    assert not np.array_equal(first.measurements, other.measurements)
    estimates = []
    for example in (EXAMPLES[name], MODELS[name](), pickle.loads(pickle.dumps(EXAMPLES[name]))):
        assert isinstance(example, models.Example)
        for one, two in zip(first, example.scenario.simulate(5, 10), strict=True):
            assert np.array_equal(one, two)
        mhe = qpmhe.MovingHorizonEstimator(
            example.system, example.observer, example.cost, horizon=5,
            initial_state=example.scenario.initial_estimate,
        )
        estimates.append(mhe.run(first.measurements, first.inputs).states)
    assert np.array_equal(estimates[0], estimates[1])
    assert np.array_equal(estimates[0], estimates[2])
