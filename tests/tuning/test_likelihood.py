"""The likelihood of the innovations: what it is, and that its gradient is exact."""

import dataclasses

import numpy as np
import pytest

import qpmhe
from qpmhe.tuning.data import checked_data
from qpmhe.tuning.likelihood import Likelihood
from qpmhe.tuning.structures import Structure
from qpmhe.tuning.weights import KINDS, Weights
from tests.estimation.untraced import untraced as untraced_function


def untraced(system):
    """The same system, of whose functions there is no trace."""
    make, arguments = system.origin.recipe
    return make(**{
        name: untraced_function(one) if name in ("rate", "f", "h") else one
        for name, one in arguments.items()
    })


def problem(system, record, parts, structure="diagonal", make=None, inputs=None, **others):
    names = {"prior": system.n, "disturbance": system.r, "noise": system.p}
    labels = {kind: [f"{kind[0]}{i}" for i in range(size)] for kind, size in names.items()}
    plan = Structure(Weights(*parts, **others), dict.fromkeys(KINDS, structure), labels)
    data = checked_data([record], system, system.m if inputs is None else inputs, None)
    return Likelihood(plan, data, make or (lambda _: system), make is not None), plan


def zoo(name, seed=0, steps=60):
    system, _, cost, scenario = qpmhe.models.catalogue()[name]()
    record = scenario.simulate(seed, steps)
    y = record.measurements.copy()
    y[np.random.default_rng(seed).random(y.shape) < 0.1] = np.nan
    parts = (np.linalg.inv(cost.prior), scenario.disturbance_covariance, scenario.noise_covariance)
    given = qpmhe.tuning.TuningRecord(y, record.inputs, initial_state=scenario.initial_estimate)
    return system, given, parts


def by_hand(system, record, parts):
    """The same by `qpmhe.ExtendedKalman`, sample by sample."""
    observer = qpmhe.ExtendedKalman(
        **dict(zip(("prior", "disturbance", "noise"), parts, strict=True))
    )
    own = system.evaluated_by(system.model())
    z, covariance, total = record.initial_state, parts[0], 0.0
    for t, y in enumerate(record.measurements):
        u = np.zeros(0) if record.inputs is None else record.inputs[t]
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


def check_slope(likelihood, theta, count, tolerance=1e-6):
    """The gradient along random directions against differences, over some of the samples."""
    generator = np.random.default_rng(1)
    chosen = [generator.random(count) < 0.7]
    value, slope = likelihood.gradient(theta, chosen)
    assert value == pytest.approx(likelihood.value(theta, chosen), rel=1e-12)
    for _ in range(3):
        way = generator.standard_normal(len(theta))
        way /= np.linalg.norm(way)
        ends = [likelihood.value(theta + s * 1e-5 * way, chosen) for s in (1.0, -1.0)]
        error = tolerance * np.linalg.norm(slope)
        assert slope @ way == pytest.approx((ends[0] - ends[1]) / 2e-5, abs=error)


@pytest.mark.parametrize("name", ["batch_reactor", "cstr", "vehicle", "battery_cell"])
def test_it_is_that_of_the_kalman_filter_and_untraced_systems_have_the_same(name):
    system, record, parts = zoo(name)
    likelihood, plan = problem(system, record, parts)
    every = [np.ones(60, bool)]
    expected = by_hand(system, record, parts)
    assert likelihood.value(plan.start, every) == pytest.approx(expected, rel=1e-9)
    found = [
        problem(one, record, parts, threshold=2.5)[0].gradient(0.0 * plan.start, every)
        for one in (system, untraced(system))
    ]
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-10)
    error = 1e-6 * np.linalg.norm(found[0][1])
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=0, atol=error)


@pytest.mark.parametrize(
    ("name", "structure", "threshold"),
    [("batch_reactor", "diagonal", 2.0), ("batch_reactor", "full", None), ("cstr", "scalar", 2.0),
     ("cstr", "diagonal", None), ("vehicle", "full", 2.0), ("battery_cell", "scalar", None)],
)  # fmt: skip
def test_gradient(name, structure, threshold):
    system, record, parts = zoo(name)
    likelihood, plan = problem(system, record, parts, structure, threshold=threshold)
    check_slope(likelihood, plan.start + 0.1 * np.sin(np.arange(1, 1 + len(plan.start))), 60)


def test_gradient_by_parameters_and_with_fewer_directions_of_disturbance():
    generator, one = np.random.default_rng(0), np.eye(1)
    u, y = generator.standard_normal((2, 50, 1))
    record = qpmhe.tuning.TuningRecord(y, u, initial_state=[0.0])

    def make(k):
        return qpmhe.System(lambda x, u: 0.9 * x + k * u, lambda x: x, n=1, p=1, m=1)

    both = qpmhe.System(lambda x, u: 0.9 * x + u[..., 1:] * u[..., :1], lambda x: x, n=1, p=1, m=2)
    for system, remade in ((make(0.7), lambda at: make(**at)), (both, None)):
        likelihood, _ = problem(
            system, record, (one, one, one), make=remade, inputs=1, parameters={"k": 0.7})
        check_slope(likelihood, np.array([0.1, -0.2, 0.3, 0.1]), 50)
    driven = qpmhe.System(
        lambda x: x @ np.array([[1.0, 0.0], [0.1, 1.0]]), lambda x: x[..., :1], n=2, p=1,
        disturbance_matrix=[[0.005], [0.1]],
    )
    record = qpmhe.tuning.TuningRecord(y, initial_state=[0.0, 0.0])
    likelihood, _ = problem(driven, record, (np.eye(2), one, one))
    check_slope(likelihood, np.array([0.1, 0.0, -0.3, 0.2]), 50)


def test_steps_of_other_lengths():
    system, record, parts = zoo("van_der_pol", steps=40)
    values = []
    for one in (system, untraced(system)):
        for dt in (None, np.full(40, system.dt), np.linspace(0.05, 0.2, 40)):
            given = dataclasses.replace(record, dt=dt)
            values.append(problem(one, given, parts)[0].value(np.zeros(5), [np.ones(40, bool)]))
    assert values[3:] == pytest.approx(values[:3], rel=1e-10)
    assert values[1] == pytest.approx(values[0], rel=1e-12)
    assert values[2] != pytest.approx(values[0], rel=1e-3)
