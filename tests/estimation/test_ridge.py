"""The ridge of a QP whose Hessian is singular up to rounding."""

from time import perf_counter

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.estimation import optimizer, outcome
from qpmhe.estimation.subproblem import Subproblem
from qpmhe_solvers import Solution, SolveStatus
from tests.oracles.nist import regression


@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_the_ridge_is_the_formula(discount):
    """Losses that vanish leave the second state no weight but the ridge's."""
    rng, weights = np.random.default_rng(1), [np.diag([2.0, 3.0]), np.diag([5.0, 7.0])]
    prior, disturbance = (qpmhe.Barron(one, -np.inf, threshold=1.0) for one in weights)
    cost = qpmhe.RobustCost(
        prior=prior, disturbance=disturbance, noise=qpmhe.Quadratic([[11.0]]), discount=discount,
    )
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: x, lambda x: x[..., :1], n=2, p=1),
        qpmhe.Luenberger(np.zeros((2, 1))), cost, horizon=4, initial_state=[0.0, 0.0], max_qps=0,
        engine="python",
    )
    for _ in range(4):
        mhe.update([0.0])
    problem, subproblem = mhe._engine.solved().problem, mhe._engine._tools.subproblem
    trial = problem.evaluate(1e9 * rng.standard_normal((5, 2)))
    qp = subproblem.at(problem, trial)
    before = qp.band.copy()
    assert subproblem.give_ridge(qp)
    assert not subproblem.give_ridge(qp)  # once
    gamma = discount ** np.array([4, 3, 2, 1, 0])
    added = np.array([weights[0].diagonal(), *[weights[1].diagonal()] * 4])
    expected = (1.0 + 1e-10) * before[:, :, 0] + np.finfo(float).eps * gamma[:, None] * added
    np.testing.assert_allclose(qp.band[:, :, 0], expected, rtol=1e-12)
    np.testing.assert_array_equal(qp.band[:, :, 1:], before[:, :, 1:])
    subproblem.damp(qp, problem, trial, 0.0)  # which begins without
    np.testing.assert_array_equal(qp.band, before)


def test_a_regular_hessian_gets_none():
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=3, initial_state=scenario.initial_estimate,
        engine="python",
    )
    mhe.update([3.0])
    problem, subproblem = mhe._engine.solved().problem, mhe._engine._tools.subproblem
    assert not subproblem.give_ridge(subproblem.at(problem, problem.candidate))


@pytest.mark.parametrize("name", ["auto", "banded", "daqp", "quadprog"])
def test_backends_go_on_where_a_hessian_has_no_factor(name):
    """The Hessian of the second QP has none: without a ridge, backends fail or stop there."""
    if name not in qpmhe.solvers.available():
        pytest.skip("it is not installed")
    data = regression("Rat43")
    first, second = (data.fit(data.start, "small", cap, "python", name) for cap in (1, 2))
    assert not second.status & (Status.SOLVER_FAILED | Status.SOLVER_STOPPED)
    assert second.cost < 0.5 * first.cost


def test_no_time_for_a_ridge_is_no_failure_of_the_solver(monkeypatch):
    """The QP without it has failed, and then a clock says that nothing is left."""
    ahead = [0.0]

    def give_ridge(self, qp):
        ahead[0] = 1e6
        return True

    for module in (optimizer, outcome):
        monkeypatch.setattr(module, "perf_counter", lambda: perf_counter() + ahead[0])
    monkeypatch.setattr(Subproblem, "give_ridge", give_ridge)
    monkeypatch.setattr(
        Subproblem, "solve", lambda *_: Solution(None, SolveStatus.FAILED, 0, message="no factor")
    )
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=3, initial_state=scenario.initial_estimate,
        engine="python", time_budget=1.0,
    )
    estimate = mhe.update([3.0])
    assert Status.TIME_UP in estimate.status
    assert Status.SOLVER_FAILED not in estimate.status
