"""The compiled step with a set of states, on problems where that set is what keeps it stable."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler

casadi = pytest.importorskip("casadi")
pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")


def runs(system, observer, cost, ys, us=None, **options):
    """The runs of both engines."""
    return [
        qpmhe.MovingHorizonEstimator(system, observer, cost, engine=engine, **options).run(ys, us)
        for engine in ("python", "compiled")
    ]


def same(expected, found, **tolerance):
    for name in ("states", "filtered", "costs", "candidate_costs"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), err_msg=name, **tolerance
        )
    np.testing.assert_array_equal(found.flags, expected.flags)


def test_a_wrong_metric_destabilises_and_the_lyapunov_metric_does_not():
    closed, gain = np.array([[1.2, 1.0], [-1.0, -0.5]]), np.array([[1.0], [0.0]])
    a = casadi.DM(closed + gain @ np.array([[1.0, 0.0]]))
    system = qpmhe.from_casadi(
        lambda x: a @ x, lambda x: x[0], n=2, compiled=False,
        states=qpmhe.Box([0.0, 0.0], [np.inf, np.inf]),
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1))
    for metric, growth in ((np.eye(2), 1.2), (None, 0.0)):
        _, found = runs(
            system, qpmhe.Luenberger(gain, metric=metric), cost, np.zeros((60, 1)), horizon=4,
            initial_state=[1.0, 0.0], max_qps=0,
        )
        sizes = np.linalg.norm(found.states, axis=1)
        np.testing.assert_allclose(sizes[-1], growth**60, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("times", [1.0, 3.0, 5.0])
@pytest.mark.parametrize("max_qps", [0, 1])
def test_a_reactor_that_only_the_projection_brings_back(times, max_qps):
    """The stirred tank: the observer runs away from too much concentration."""
    example = qpmhe.models.cstr()

    def rate(x, u):
        reaction = 7.2e10 * casadi.exp(-8750.0 / x[1]) * x[0]
        return [
            1.0 - x[0] - reaction,
            350.0 - x[1] + 5e4 / 239.0 * reaction + 5e4 / 23900.0 * (u[0] - x[1]),
        ]

    system = qpmhe.from_casadi(
        rate, lambda x: [x[1]], n=2, m=1, dt=0.05, method="rk4", compiled=False,
        states=example.system.states,
    )
    scenario = example.scenario
    record = scenario.simulate(2, 80)
    truth = np.array(scenario.initial_state)
    start = truth + times * (np.array(scenario.initial_estimate) - truth)
    start = np.clip(start, system.states.lower, system.states.upper)
    expected, found = runs(
        system, example.observer, example.cost, record.measurements, record.inputs, horizon=10,
        initial_state=start, max_qps=max_qps, solver_tolerance=1e-12,
    )
    if max_qps == 0 or times == 1.0:
        same(expected, found, rtol=1e-7, atol=1e-9)
    else:
        # The model explodes at first, with costs of 1e46: there, solvers of QPs do not agree.
        np.testing.assert_allclose(found.candidate_costs, expected.candidate_costs, rtol=1e-6)
        np.testing.assert_allclose(found.states[40:], expected.states[40:], rtol=1e-9)
        assert (found.costs <= found.candidate_costs).all()
    error = np.abs(found.states - record.states)[-20:].mean(axis=0)
    assert (error < [0.02, 1.0]).all()


def textbook_reactor(seed=1):
    """A <-> B + C, 2B <-> C, of which the total pressure is measured, with a record."""

    def rate(x):
        first, second = 0.5 * x[0] - 0.05 * x[1] * x[2], 0.2 * x[1] * x[1] - 0.01 * x[2]
        return [-first, first - 2.0 * second, first + second]

    system = qpmhe.from_casadi(
        rate, lambda x: [32.84 * (x[0] + x[1] + x[2])], n=3, dt=0.25, method="rk4",
        compiled=False, states=qpmhe.Box([0.0] * 3, [np.inf] * 3),
    )
    rng, x, ys, truth = np.random.default_rng(seed), np.array([0.5, 0.05, 0.0]), [], []
    for _ in range(80):
        truth.append(x)
        ys.append([32.84 * x.sum() + 0.25 * rng.standard_normal()])
        x = np.maximum(system.f(x, np.zeros(0)) + 1e-3 * rng.standard_normal(3), 0.0)
    return system, np.array(ys), np.array(truth)


KALMAN = qpmhe.ExtendedKalman(
    prior=0.25 * np.eye(3), disturbance=1e-6 * np.eye(3), noise=[[0.0625]]
)
LEAVING = [qpmhe.Luenberger([gain] * 3) for gain in (0.001, 0.003, 0.01)]


@pytest.mark.parametrize(
    ("observer", "project", "errors"),
    # Without the projection the filter settles at negative pressures.
    [(one, True, (2.0, 0.5)) for one in LEAVING] + [(KALMAN, True, (0.02, 0.02)),
                                                    (KALMAN, False, (np.inf, np.inf))],
)
def test_a_textbook_reactor_whose_observer_leaves_for_negative_concentrations(
    observer, project, errors
):
    system, ys, truth = textbook_reactor()
    prior = np.eye(3) / 0.25 if observer is not KALMAN else qpmhe.ObserverPrior()
    cost = qpmhe.QuadraticCost(prior=prior, disturbance=np.eye(3) * 1e6, noise=[[1.0 / 0.0625]])
    for max_qps, limit in zip((0, 2) if project else (0,), errors, strict=False):
        expected, found = runs(
            system, observer, cost, ys, max_qps=max_qps, project_observer=project, horizon=10,
            initial_state=[1.0, 0.0, 4.0], solver_tolerance=1e-12,
        )
        if max_qps == 0:
            same(expected, found, rtol=1e-7, atol=1e-8)
        assert (found.costs <= found.candidate_costs).all()
        np.testing.assert_allclose(found.states, expected.states, atol=1e-4)
        error = np.abs(found.states[60:80] - truth[60:]).max()
        assert error < limit if project else error > 0.5
        assert (found.states >= 0.0).all() or not project
