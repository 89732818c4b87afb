"""A stage's cost shrinks with each step of its age, the prior's with the window's length."""

import numpy as np
import pytest

import qpmhe

from . import plain
from .plain import Record, assembled, spd
from .systems import GAIN, seen, swing

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 2)
START, NONE = np.array([0.5, 0.0]), np.zeros(0)

# As they are given, and their definitions.
LOSSES = {
    "quadratic": ((P, Q, R), (plain.quadratic,) * 3),
    "huber": (
        (P, Q, qpmhe.Huber(R, 0.5)), (plain.quadratic, plain.quadratic, plain.huber(0.5))
    ),
    "power": (
        (qpmhe.Power(P, 1.5), qpmhe.Power(Q, 1.5), qpmhe.Power(R, 1.5)), (plain.power(1.5),) * 3
    ),
}


SYSTEM = qpmhe.System(swing, seen, n=2, p=2)


@pytest.mark.parametrize("horizon", [1, 4, 70])
@pytest.mark.parametrize(("discount", "missing"), [(0.3, 0.3), (0.95, 0.0)])
@pytest.mark.parametrize("losses", LOSSES)
def test_costs_gradients_and_hessians(losses, discount, missing, horizon):
    generator = np.random.default_rng(2)
    given = dict(zip(("prior", "disturbance", "noise"), LOSSES[losses][0], strict=True))
    kind = qpmhe.QuadraticCost if losses == "quadratic" else qpmhe.RobustCost
    window, formulation, subproblem = assembled(
        SYSTEM, qpmhe.Luenberger(GAIN), kind(**given, discount=discount), horizon, START
    )
    kept = Record(
        seen, GAIN, START, (P, Q, R), horizon, discount=discount, losses=LOSSES[losses][1]
    )
    assert window.candidate_cost == 0.0
    for t in range(145):
        y = generator.standard_normal(2)
        y[generator.random(2) < missing] = np.nan
        window.push(y, NONE)
        kept.push(swing, y)
        if not (t < 6 or t in (45, 64, 65, 135)):
            continue
        problem, candidate, count = formulation.problem(window), window.candidate, kept.count
        assert window.candidate_cost == pytest.approx(kept.cost(candidate), rel=1e-10)
        assert problem.candidate.cost == window.candidate_cost
        powers = [discount**count] + [discount ** (count - 1 - i) for i in range(count)]
        np.testing.assert_allclose(window.discounts, powers, rtol=1e-12)
        trajectory = candidate + 0.7 * generator.standard_normal(candidate.shape)
        trials = [(trajectory, problem.evaluate(trajectory))]
        assert trials[0][1].cost == pytest.approx(kept.cost(trajectory), rel=1e-10)
        if losses != "power":  # whose prior term has no derivative at zero
            trials.append((candidate.copy(), problem.candidate))
        for at, trial in trials if count < 20 else ():
            qp, gradient = subproblem.at(problem, trial), 0.5 * kept.gradient(at)
            scale = np.abs(gradient).max() + 1.0
            np.testing.assert_allclose(qp.gradient, gradient, rtol=1e-9, atol=1e-10 * scale)
            assert np.linalg.eigvalsh(qp.dense())[0] > 0.0
            if losses == "quadratic":
                hessian = kept.hessian(at)
                scale = np.abs(hessian).max()
                np.testing.assert_allclose(qp.dense(), hessian, rtol=1e-9, atol=1e-11 * scale)


@pytest.mark.parametrize("batch", [False, True])
def test_a_factor_that_underflows_at_a_failed_stage_leaves_the_cost_infinite(batch):
    parts = (
        qpmhe.System(lambda x: 0.9 * x, np.sqrt, n=1, p=1), qpmhe.Luenberger([0.3]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0, discount=0.01),
    )
    ys = np.ones((1, 230))
    ys[0, 5] = -30.0  # the observer's next state is negative, where the root is not defined
    if batch:
        made = qpmhe.BatchEstimator(*parts, horizon=200, members=1, initial_states=[1.0])
    else:
        made = qpmhe.MovingHorizonEstimator(*parts, horizon=200, initial_state=[1.0])
    run = made.run(ys if batch else ys[0])
    assert np.isinf(run.candidate_costs).any()
    assert np.all(run.costs <= run.candidate_costs)  # as no NaN is
