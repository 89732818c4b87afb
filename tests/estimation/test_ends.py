"""Where a sequence of QPs without a cap ends, and what the status then says."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.estimation.limits import PATIENCE
from qpmhe.solvers import Solution, Solver, SolverOptions, SolveStatus, create

A, C = np.array([[1.0, 0.1, 0], [-0.3, 0.9, 0.05], [0, 0, 1]]), np.array([[1.0, 0, 0], [0, 1, 1]])
COVARIANCES = {
    "prior": np.eye(3), "disturbance": np.diag([0.03**2, 0.03**2, 1e-8]),
    "noise": 0.05**2 * np.eye(2),
}
SUM = qpmhe.Polytope(
    [[1, 1, 1], [-1, 0, 0], [0, 0, 1], [0, 0, -1]], [0.6, 0, 1, 1])


def measured(count=8):
    rng = np.random.default_rng(0)
    x, Y = np.array([0.5, -1.0, 0.2]), []
    for _ in range(count):
        Y.append(C @ x + 0.05 * rng.standard_normal(2))
        x = A @ x + np.array([0.03, 0.03, 0.0]) * rng.standard_normal(3)
        x[0] = max(x[0], 0.0)
    return Y


def estimator(backend, **options):
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=3, p=2, states=SUM)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(**COVARIANCES),
        qpmhe.QuadraticCost.from_covariances(**COVARIANCES), horizon=8,
        initial_state=[0.3, 0, 0], backend=backend, engine="python", **{"max_qps": None, **options},
    )


class Halfway(Solver):
    """A solver at its end: a tenth of the way to the minimiser, never to its tolerance."""

    def __init__(self, options=None):
        super().__init__(options or SolverOptions())
        self.inner = create("daqp")

    def _solve(self, qp, start):
        raise AssertionError

    def solve(self, qp, start=None):
        found = self.inner.solve(qp)
        return Solution(0.1 * found.d, SolveStatus.STOPPED, 1, message="no step is left")


def test_a_backend_at_its_end_is_asked_no_more():
    estimate = estimator(Halfway()).update(measured(1)[0])
    assert estimate.qps == PATIENCE
    assert Status.UNCONVERGED | Status.SOLVER_STOPPED in estimate.status
    assert estimate.cost < estimate.candidate_cost
    assert "'Halfway' did not solve" in estimate.explain()
    assert "no step is left" in estimate.message
    # A cap on the QPs, or on the solver's iterations, asks for such QPs.
    assert estimator(Halfway(), max_qps=7).update(measured(1)[0]).qps == 7
    capped = Halfway(SolverOptions(max_iterations=5))
    estimate = estimator(capped).update(measured(1)[0])
    assert estimate.qps == 100
    assert Status.UNCONVERGED in estimate.status


def test_osqp_at_its_end():
    """Its QPs with these rows do not reach 1e-7 within its 4000 iterations."""
    pytest.importorskip("osqp")
    mhe, right = estimator("osqp"), estimator("daqp")
    ended = []
    for y in measured():
        estimate, best = mhe.update(y), right.update(y)
        assert estimate.qps <= 10
        assert estimate.cost >= best.cost * (1 - 1e-6)
        if Status.UNCONVERGED in estimate.status:
            assert "'osqp'" in estimate.message
            ended.append(estimate)
        assert Status.UNCONVERGED not in best.status
    assert ended


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_a_kink_that_hundred_qps_do_not_resolve_is_told(engine):
    """Losses of power 1: converged, or said not to be; never silent."""
    if engine == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    rng = np.random.default_rng(0)
    model, x, Y = np.array([[1.0, 0.1], [-0.3, 0.9]]), np.array([0.5, -1.0]), []
    for _ in range(30):
        Y.append(x[:1] + 0.05 * rng.standard_t(2, 1))
        x = model @ x + 0.03 * rng.standard_normal(2)
    cost = qpmhe.RobustCost(
        prior=np.eye(2), disturbance=np.eye(2) / 0.03**2, noise=qpmhe.Power([[1 / 0.05**2]], 1.0))
    for cap in (None, 100):
        run = qpmhe.MovingHorizonEstimator(
            qpmhe.System(lambda x: x @ model.T, lambda x: x[..., :1], n=2, p=1),
            qpmhe.Luenberger([0.5, 0.2]), cost, horizon=10, initial_state=[0.3, 0], engine=engine,
            max_qps=cap,
        ).run(Y)
        assert (run.qps == 100).any()
        for status, qps in zip(run.statuses, run.qps, strict=True):
            ended = Status.CONVERGED in status or Status.NO_DECREASE in status
            assert ended == (qps < 100) or ended
            assert (Status.UNCONVERGED in status) == (cap is None and not ended)
    assert "Huber" in Status.UNCONVERGED.explain()
