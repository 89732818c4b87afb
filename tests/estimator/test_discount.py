"""A stage's cost shrinks with each step of its age, the prior's with the window's length."""

import numpy as np
import pytest

import qpmhe

from . import plain
from .plain import Record, assembled, is_minimum, spd

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 2)
GAIN = np.array([[0.3, 0.05], [0.1, 0.2]])
START = np.array([0.5, 0.0])
NONE = np.zeros(0)

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


def swing(x):
    return np.stack(
        [x[..., 0] + 0.2 * x[..., 1], 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])], axis=-1
    )


def seen(x):
    return np.stack([x[..., 0] + 0.1 * x[..., 1] ** 2, x[..., 1]], axis=-1)


def system_of(**sets):
    return qpmhe.System(swing, seen, n=2, p=2, **sets)


def cost_of(losses, discount):
    given = dict(zip(("prior", "disturbance", "noise"), LOSSES[losses][0], strict=True))
    kind = qpmhe.QuadraticCost if losses == "quadratic" else qpmhe.RobustCost
    return kind(**given, discount=discount)


class Case:
    """Window, problem and subproblem beside the plain record."""

    def __init__(self, losses, discount, horizon, missing=0.0):
        self.generator, self.missing = np.random.default_rng(2), missing
        system, self.cost = system_of(), cost_of(losses, discount)
        self.window, self.formulation, self.subproblem = assembled(
            system, qpmhe.Luenberger(GAIN), self.cost, horizon, START
        )
        self.kept = Record(
            seen, GAIN, START, (P, Q, R), horizon, discount=discount, losses=LOSSES[losses][1]
        )

    def push(self):
        y = self.generator.standard_normal(2)
        y[self.generator.random(2) < self.missing] = np.nan
        self.window.push(y, NONE)
        self.problem = self.formulation.problem(self.window)
        self.kept.push(swing, y)


@pytest.mark.parametrize("horizon", [1, 4, 70])
@pytest.mark.parametrize(("discount", "missing"), [(0.3, 0.3), (0.95, 0.0), (1.0, 0.3)])
@pytest.mark.parametrize("losses", LOSSES)
def test_the_cost_and_that_of_the_candidate(losses, discount, horizon, missing):
    case = Case(losses, discount, horizon, missing)
    assert case.window.candidate_cost == 0.0
    for t in range(145):
        case.push()
        if not (t < 6 or t % 45 == 0 or t in (64, 65, 135)):
            continue
        kept, candidate = case.kept, case.window.candidate
        assert case.window.candidate_cost == pytest.approx(kept.cost(candidate), rel=1e-10)
        assert case.problem.candidate.cost == case.window.candidate_cost
        trajectory = candidate + case.generator.standard_normal(candidate.shape)
        found = case.problem.evaluate(trajectory).cost
        assert found == pytest.approx(kept.cost(trajectory), rel=1e-10)


@pytest.mark.parametrize("discount", [0.5, 0.9])
@pytest.mark.parametrize("samples", [1, 3, 4, 9])
def test_the_factors_are_powers_of_the_discount(samples, discount):
    case = Case("quadratic", discount, 4)
    for _ in range(samples):
        case.push()
    count = min(samples, 4)
    powers = [discount**count] + [discount ** (count - 1 - i) for i in range(count)]
    np.testing.assert_allclose(case.window.discounts, powers, rtol=1e-13)
    np.testing.assert_allclose(
        case.problem.prior_weight_at(np.ones(2)), discount**count * P, rtol=1e-12
    )
    np.testing.assert_array_equal(Case("quadratic", 1.0, 4).window.discounts, [1.0])


@pytest.mark.parametrize(("discount", "missing"), [(0.3, 0.3), (0.9, 0.0), (0.9, 1.0)])
@pytest.mark.parametrize("losses", LOSSES)
def test_the_gradient_of_the_qp_is_that_of_half_the_cost(losses, discount, missing):
    case = Case(losses, discount, 3, missing)
    for t in range(70):
        case.push()
        if 5 <= t < 64:
            continue
        candidate = case.window.candidate
        if losses != "power":  # whose prior term has no derivative at zero
            qp = case.subproblem.at(case.problem, case.problem.candidate)
            check_qp(qp, case.kept, candidate.copy(), losses)
        trajectory = candidate + 0.7 * case.generator.standard_normal(candidate.shape)
        qp = case.subproblem.at(case.problem, case.problem.evaluate(trajectory))
        check_qp(qp, case.kept, trajectory, losses)


def check_qp(qp, kept, trajectory, losses):
    gradient = 0.5 * kept.gradient(trajectory)
    scale = np.abs(gradient).max() + 1.0
    np.testing.assert_allclose(qp.gradient, gradient, rtol=1e-9, atol=1e-10 * scale)
    assert np.linalg.eigvalsh(qp.dense())[0] > 0.0
    if losses == "quadratic":
        hessian = kept.hessian(trajectory)
        scale = np.abs(hessian).max()
        np.testing.assert_allclose(qp.dense(), hessian, rtol=1e-9, atol=1e-11 * scale)


@pytest.mark.parametrize("discount", [0.5, 0.9])
@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_the_estimate_minimises_the_discounted_cost(backend, discount):
    mhe = qpmhe.MovingHorizonEstimator(
        system_of(), qpmhe.Luenberger(GAIN), cost_of("quadratic", discount), horizon=4,
        initial_state=START, max_qps=6, backend=backend, solver_tolerance=1e-9,
    )
    kept = Record(seen, GAIN, START, (P, Q, R), 4, discount=discount)
    for y in np.random.default_rng(3).standard_normal((6, 2)):
        estimate = mhe.update(y)
        kept.push(swing, y)
        assert estimate.candidate_cost == pytest.approx(kept.cost(kept.candidate), rel=1e-10)
        assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-10)
    assert is_minimum(kept, estimate.trajectory, 1e-3)


def test_the_prior_weight_of_an_observer_is_discounted():
    observer = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=np.eye(2))
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior(), disturbance=Q, noise=R, discount=0.7
    )
    system = system_of()
    window, formulation, _ = assembled(system, observer, cost, 3, START)
    for t, y in enumerate(np.random.default_rng(4).standard_normal((6, 2))):
        window.push(y, NONE)
        problem = formulation.problem(window)
        weight = 0.7 ** min(t + 1, 3) * np.linalg.inv(window.prior_covariance)
        np.testing.assert_allclose(problem.prior_weight_at(np.ones(2)), weight, rtol=1e-9)


def test_a_discount_forgets_an_old_outlier():
    ys = np.zeros((8, 2))
    ys[1] = 40.0
    states = {}
    for discount in (1.0, 0.4):
        mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(lambda x: x, lambda x: x, n=2, p=2), qpmhe.Luenberger(np.zeros((2, 2))),
            qpmhe.QuadraticCost(
                prior=np.eye(2), disturbance=1e6 * np.eye(2), noise=np.eye(2), discount=discount
            ),
            horizon=8, initial_state=np.zeros(2),
        )
        states[discount] = mhe.run(ys).states[-1]
        # All states are nearly one: the weighted mean of the prior and the measurements.
        weights = [discount**8] + [discount ** (7 - i) for i in range(8)]
        mean = weights[2] * 40.0 / sum(weights)
        np.testing.assert_allclose(states[discount], [mean, mean], rtol=1e-3)
    assert states[0.4][0] < 0.1 * states[1.0][0]


def test_sets_hold_whatever_the_discount():
    box = qpmhe.Box([-0.4, -0.4], [0.6, 0.6])
    mhe = qpmhe.MovingHorizonEstimator(
        system_of(states=box), qpmhe.Luenberger(0.1 * GAIN), cost_of("quadratic", 0.6),
        horizon=4, initial_state=START, max_qps=3,
    )
    bound = 0
    for y in 0.2 + 0.7 * np.random.default_rng(5).standard_normal((20, 2)):
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost
        assert not estimate.dropped
        assert box.violation(estimate.trajectory) <= 1e-8
        near = np.minimum(estimate.trajectory - box.lower, box.upper - estimate.trajectory)
        bound += bool((near < 1e-6).any())
    assert bound > 8


@pytest.mark.parametrize("batch", [False, True])
def test_a_factor_that_underflows_at_a_failed_stage_leaves_the_cost_infinite(batch):
    system = qpmhe.System(lambda x: 0.9 * x, np.sqrt, n=1, p=1)
    parts = (
        system, qpmhe.Luenberger([0.3]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0, discount=0.01),
    )
    ys = np.ones((230, 1))
    ys[5] = -30.0  # the observer's next state is negative, where the root is not defined
    if batch:
        made = qpmhe.BatchEstimator(*parts, horizon=200, members=2, initial_states=[1.0])
        found = [made.update(np.array([y, y])) for y in ys]
    else:
        made = qpmhe.MovingHorizonEstimator(*parts, horizon=200, initial_state=[1.0])
        found = [made.update(y) for y in ys]
    costs = np.array([one.costs if batch else one.cost for one in found])
    candidates = np.array([one.candidate_costs if batch else one.candidate_cost for one in found])
    assert np.isinf(candidates).any()
    assert np.all(costs <= candidates)  # as no NaN is
