"""The likelihood of the innovations: what it is, and that its gradient is exact."""

import numpy as np
import pytest
from estimator.untraced import untraced as untraced_function

import qpmhe
from qpmhe.tuning.data import checked_data
from qpmhe.tuning.likelihood import Likelihood
from qpmhe.tuning.structures import Structure
from qpmhe.tuning.weights import KINDS, Weights


def untraced(system):
    """The same system, of whose functions there is no trace."""
    make, arguments = system.recipe
    return make(**{
        name: untraced_function(one) if name in ("rate", "f", "h") else one
        for name, one in arguments.items()
    })


def labels(system):
    names = {"prior": system.n, "disturbance": system.r, "noise": system.p}
    return {kind: [f"{kind[0]}{i}" for i in range(size)] for kind, size in names.items()}


def problem(system, record, prior, disturbance, noise, structure="diagonal", start=None, **others):
    setting = Weights(prior, disturbance, noise, **others)
    plan = Structure(setting, dict.fromkeys(KINDS, structure), labels(system))
    inputs = 0 if record[1] is None else record[1].shape[1]
    data = checked_data([record], system, inputs, start)
    return Likelihood(plan, data, lambda _: system, False), plan, data


def zoo(name, seed=0, steps=60, gaps=True):
    system, _, cost, scenario = qpmhe.models.catalogue()[name]()
    record = scenario.simulate(seed, steps)
    y = record.measurements.copy()
    if gaps:
        y[np.random.default_rng(seed).random(y.shape) < 0.1] = np.nan
    parts = (np.linalg.inv(cost.prior), scenario.disturbance_covariance, scenario.noise_covariance)
    return system, (y, record.inputs), parts, scenario.initial_estimate


def by_hand(system, record, parts, start):
    """The same by `qpmhe.ExtendedKalman`, sample by sample."""
    observer = qpmhe.ExtendedKalman(
        **dict(zip(("prior", "disturbance", "noise"), parts, strict=True))
    )
    own, z, covariance, total = system.copy(traced=True), start.copy(), parts[0], 0.0
    for t, y in enumerate(record[0]):
        u = np.zeros(0) if record[1] is None else record[1][t]
        there = np.isfinite(y)
        C = own.h_jacobian(z, u)[there]
        e = y - own.h(z, u)
        if system.output_residual is not None:
            system.output_residual.wrap(e[None], y[None])
        S = C @ covariance @ C.T + parts[2][np.ix_(there, there)]
        if there.any():
            total += 0.5 * e[there] @ np.linalg.solve(S, e[there])
            total += 0.5 * np.linalg.slogdet(S)[1]
        sample = qpmhe.Sample(
            own, u, own.f_jacobian(z, u), own.h_jacobian(z, u), there, covariance=covariance
        )
        move, covariance = observer.correct(z, np.where(there, e, 0.0), sample)
        z = own.f(z, u) + move
        if system.states is not None:
            z = np.clip(z, system.states.lower, system.states.upper)
    return total


@pytest.mark.parametrize("name", ["batch_reactor", "cstr", "vehicle", "battery_cell"])
def test_it_is_that_of_the_kalman_filter(name):
    system, record, parts, start = zoo(name)
    likelihood, plan, data = problem(system, record, *parts, start=start)
    every = [np.ones(len(one), bool) for one in data]
    expected = by_hand(system, record, parts, start)
    assert likelihood.value(plan.start, every) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("structure", ["diagonal", "full", "scalar"])
@pytest.mark.parametrize("threshold", [None, 2.0])
@pytest.mark.parametrize("name", ["batch_reactor", "cstr", "vehicle", "battery_cell"])
def test_gradient(name, threshold, structure):
    system, record, parts, start = zoo(name, gaps=True)
    likelihood, plan, data = problem(
        system, record, *parts, structure=structure, start=start, threshold=threshold
    )
    generator = np.random.default_rng(1)
    theta = plan.start + 0.1 * generator.standard_normal(len(plan.start))
    chosen = [generator.random(len(one)) < 0.7 for one in data]
    value, slope = likelihood.gradient(theta, chosen)
    assert value == pytest.approx(likelihood.value(theta, chosen), rel=1e-12)
    for _ in range(3):
        way = generator.standard_normal(len(theta))
        way /= np.linalg.norm(way)
        ends = [likelihood.value(theta + s * 1e-5 * way, chosen) for s in (1.0, -1.0)]
        difference = (ends[0] - ends[1]) / 2e-5
        assert slope @ way == pytest.approx(difference, abs=1e-6 * np.linalg.norm(slope))


@pytest.mark.parametrize("name", ["van_der_pol", "cstr", "vehicle"])
def test_untraced_systems_have_the_same(name):
    system, record, parts, start = zoo(name)
    found = [
        problem(one, record, *parts, start=start, threshold=2.5)[0].gradient(
            np.zeros(system.n + system.r + system.p), [np.ones(60, bool)]
        )
        for one in (system, untraced(system))
    ]
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-10)
    np.testing.assert_allclose(
        found[1][1], found[0][1], atol=1e-6 * np.linalg.norm(found[0][1]), rtol=0
    )


def test_steps_of_other_lengths():
    system, _, cost, scenario = qpmhe.models.van_der_pol()
    y = scenario.simulate(0, 40).measurements
    prior = np.linalg.inv(cost.prior)
    parts = prior, scenario.disturbance_covariance, scenario.noise_covariance
    values = []
    for one in (system, untraced(system)):
        for dt in (np.full(40, scenario.dt), np.linspace(0.05, 0.2, 40)):
            record = qpmhe.tuning.TuningRecord(y, dt=dt)
            data = checked_data([record], one, 0, scenario.initial_estimate)
            plan = Structure(Weights(*parts), "diagonal", labels(one))
            likelihood = Likelihood(plan, data, lambda _, one=one: one, False)
            values.append(likelihood.value(plan.start, [np.ones(40, bool)]))
    usual = problem(system, (y, None), *parts, start=scenario.initial_estimate)[0]
    assert values[0] == pytest.approx(usual.value(np.zeros(5), [np.ones(40, bool)]), rel=1e-12)
    assert values[2] == pytest.approx(values[0], rel=1e-10)
    assert values[3] == pytest.approx(values[1], rel=1e-10)
    assert values[1] != pytest.approx(values[0], rel=1e-3)


@pytest.mark.parametrize("remade", [True, False])
def test_parameters_of_the_model(remade):
    def make(k):
        return qpmhe.System(
            lambda x, u: 0.9 * x + k * u, lambda x: x, n=1, p=1, m=1, f_jacobian=None
        )

    both = qpmhe.System(lambda x, u: 0.9 * x + u[..., 1:] * u[..., :1], lambda x: x, n=1, p=1, m=2)
    generator = np.random.default_rng(0)
    u = generator.standard_normal((50, 1))
    y = generator.standard_normal((50, 1))
    one = np.eye(1)
    setting = Weights(one, one, one, parameters={"k": 0.7})
    system = make(0.7) if remade else both
    plan = Structure(setting, "diagonal", labels(system))
    data = checked_data([(y, u)], system, 1, [0.0])
    likelihood = Likelihood(
        plan, data, (lambda at: make(**at)) if remade else (lambda _: both), remade
    )
    chosen, theta = [np.ones(50, bool)], np.array([0.1, -0.2, 0.3])
    _, slope = likelihood.gradient(theta, chosen)
    for k in range(3):
        move = 1e-5 * np.eye(3)[k]
        ends = [likelihood.value(theta + s * move, chosen) for s in (1.0, -1.0)]
        assert slope[k] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6)


def test_a_disturbance_with_fewer_directions():
    system = qpmhe.System(
        lambda x: x @ np.array([[1.0, 0.0], [0.1, 1.0]]), lambda x: x[..., :1], n=2, p=1,
        disturbance_matrix=[[0.005], [0.1]],
    )
    y = np.random.default_rng(0).standard_normal((40, 1))
    likelihood, _, data = problem(system, (y, None), np.eye(2), np.eye(1), np.eye(1),
                                  start=[0.0, 0.0])
    chosen, theta = [np.ones(len(data[0]), bool)], np.array([0.1, 0.0, -0.3, 0.2])
    _, slope = likelihood.gradient(theta, chosen)
    ends = [likelihood.value(theta + s * np.array([0, 0, 1e-5, 0]), chosen) for s in (1.0, -1.0)]
    assert slope[2] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6)
