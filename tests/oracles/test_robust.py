"""Robust costs: reweighted QPs reach the minimum of the convex problem, as cvxpy states it."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler

from .convex import minimum

LOSSES = {
    "huber": (qpmhe.Huber([[25.0]]), 1e-6),
    "power 1.5": (qpmhe.Power([[25.0]], 1.5), 1e-6),
    # Near a kink reweighted forms creep: they agree less closely.
    "euclidean": (qpmhe.Power([[25.0]], 1.0), 1e-3),
}


def estimates(noise, **options):
    system, observer, _, scenario = qpmhe.models.batch_reactor()
    rng = np.random.default_rng(5)
    _, measurements = scenario.simulate(0, 25)
    measurements = measurements + 3.0 * (rng.random(measurements.shape) < 0.1)
    cost = qpmhe.RobustCost(prior=np.eye(2), disturbance=100.0 * np.eye(2), noise=noise)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=8, initial_state=scenario.initial_estimate, **options
    )
    return [mhe.update(y) for y in measurements]


def slopes(system, states):
    """Jacobians by complex differences of the user's functions."""
    n, nothing = system.n, np.zeros(0)
    moved = [x + 1e-30j * np.eye(n) for x in states]
    return tuple(
        np.array([[np.asarray(g(z, nothing)).imag / 1e-30 for z in rows] for rows in moved])
        .transpose(0, 2, 1)
        for g in (system.f, system.h)
    )


@pytest.mark.parametrize("name", LOSSES)
def test_reweighted_qps_converge_to_where_the_convex_problem_has_nothing_better(name):
    noise, tolerance = LOSSES[name]
    system = qpmhe.models.batch_reactor()[0]
    kind = {"huber": ("huber", 1.345, False), "power 1.5": ("power", 1.5, False),
            "euclidean": ("power", 1.0, False)}[name]
    quadratic = ("quadratic", None, False)
    for estimate in estimates(noise, max_qps=None)[::4]:
        w, v = estimate.disturbances, estimate.noises
        weights = (np.eye(2), 100.0 * np.eye(2), np.full((len(v), 1, 1), 25.0))
        found, _ = minimum(
            estimate.trajectory, w, v, slopes(system, estimate.trajectory[:-1]),
            estimate.candidate[0], weights, (quadratic, quadratic, kind),
        )
        assert estimate.cost <= estimate.candidate_cost
        assert found == pytest.approx(estimate.cost, rel=tolerance)


A, C = np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([[1.0, 0.2], [0.1, -1.0]])
WIDE = (np.array([-0.4, -0.3]), np.array([0.3, 0.4]))
KINDS = {
    "huber": (qpmhe.Huber, ("huber", 1.5, False), 1e-6),
    "huber per component": (qpmhe.Huber, ("huber", 1.5, True), 1e-6),
    "power 1.5": (qpmhe.Power, ("power", 1.5, False), 1e-5),
}


def linear_system(engine, sets):
    if engine == "python":
        return qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=2, p=2, **sets)
    ca = pytest.importorskip("casadi")
    if find_compiler() is None:
        pytest.skip("there is no C compiler")
    return qpmhe.from_casadi(
        lambda x: ca.DM(A) @ x, lambda x: ca.DM(C) @ x, n=2, compiled=False, **sets
    )


@pytest.mark.parametrize("engine", ["python", "compiled"])
@pytest.mark.parametrize("boxed", [False, True])
@pytest.mark.parametrize("discount", [1.0, 0.8])
@pytest.mark.parametrize("name", KINDS)
def test_on_a_linear_system_the_minimum_is_that_of_the_convex_problem(
    name, discount, boxed, engine
):
    kind, stated, tolerance = KINDS[name]
    disturbance, noise = np.diag([4.0, 9.0]), np.diag([2.0, 5.0])
    cost = qpmhe.RobustCost(
        prior=np.diag([1.0, 2.0]), disturbance=disturbance, discount=discount,
        noise=kind(noise, stated[1], per_component=stated[2]),
    )
    box = {"disturbances": qpmhe.Box(*WIDE)} if boxed else {}
    mhe = qpmhe.MovingHorizonEstimator(
        linear_system(engine, box), qpmhe.Luenberger(np.zeros((2, 2))), cost, horizon=5,
        initial_state=[0.5, -0.5], max_qps=None, engine=engine,
    )
    generator, measured = np.random.default_rng(3), []
    for t in range(9):
        y = generator.standard_normal(2) + (6.0 if t % 4 == 2 else 0.0)
        if t == 5:
            y[1] = np.nan
        measured.append(y)
        estimate = mhe.update(y)
        count = len(estimate.noises)
        weights = np.repeat(noise[None], count, axis=0)
        there = np.isfinite(np.array(measured[-count:]))
        weights *= there[:, :, None] * there[:, None, :]
        found, best = minimum(
            estimate.trajectory, estimate.disturbances, np.nan_to_num(estimate.noises),
            (np.repeat(A[None], count, axis=0), np.repeat(C[None], count, axis=0)),
            estimate.candidate[0], (np.diag([1.0, 2.0]), disturbance, weights),
            (("quadratic", None, False),) * 2 + (stated,), discount,
            (None, WIDE if boxed else None, None),
        )
        assert estimate.cost == pytest.approx(found, rel=tolerance)
        np.testing.assert_allclose(estimate.trajectory, best, atol=1e-2)


def test_with_gross_outliers_hubers_rmse_is_at_most_half_the_quadratics():
    system, observer, quadratic, scenario = qpmhe.models.batch_reactor()
    huber = qpmhe.RobustCost(
        prior=quadratic.prior, disturbance=quadratic.disturbance,
        noise=qpmhe.Huber(quadratic.noise),
    )
    squares = {"quadratic": [], "huber": []}
    for seed in range(4):
        states, measurements = scenario.simulate(seed)
        rng = np.random.default_rng([seed, 1])
        hit = rng.random(measurements.shape) < 0.05
        wrong = measurements + hit * rng.choice([-8.0, 8.0], measurements.shape)
        for name, cost in (("quadratic", quadratic), ("huber", huber)):
            mhe = qpmhe.MovingHorizonEstimator(
                system, observer, cost, horizon=10,
                initial_state=scenario.initial_estimate, max_qps=5,
            )
            squares[name].append(np.sum((mhe.run(wrong).states - states) ** 2, axis=1))
    rmse = {name: np.sqrt(np.mean(values)) for name, values in squares.items()}
    assert rmse["huber"] <= 0.5 * rmse["quadratic"]
