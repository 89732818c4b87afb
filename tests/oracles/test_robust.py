"""Two ways to the minimum of a robust cost: reweighted QPs, and the convex problem itself."""

import numpy as np
import pytest

import qpmhe

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


@pytest.mark.parametrize("name", LOSSES)
def test_reweighted_qps_and_the_exact_subproblem_converge_to_the_same(name):
    noise, tolerance = LOSSES[name]
    reweighted = estimates(noise, max_qps=None)
    exact = estimates(noise, max_qps=None, subproblem="exact")
    for ours, theirs in zip(reweighted, exact, strict=True):
        assert ours.candidate_cost == pytest.approx(theirs.candidate_cost, rel=1e-13)
        assert ours.cost == pytest.approx(theirs.cost, rel=tolerance)
        assert max(ours.cost, theirs.cost) <= ours.candidate_cost


def test_one_exact_step_is_better_than_one_reweighted():
    noise = LOSSES["huber"][0]
    reweighted = sum(e.cost for e in estimates(noise, max_qps=1))
    exact = sum(e.cost for e in estimates(noise, max_qps=1, subproblem="exact"))
    assert exact < reweighted


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
