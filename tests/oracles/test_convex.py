"""Robust costs and sets of a linear system, and where reweighted QPs end: the convex problem.

The problem of one window, linearised about the estimate, is stated for cvxpy.
"""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler

cp = pytest.importorskip("cvxpy")
A, C = np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([[1.0, 0.2], [0.1, -1.0]])
P, Q, R = np.diag([1.0, 2.0]), np.diag([4.0, 9.0]), np.diag([2.0, 5.0])
WIDE = qpmhe.Box([-0.4, -0.3], [0.3, 0.4])


def loss_of(loss, rows):
    """The loss of each row of whitened residuals; quadratic without one."""
    if loss is None:
        return cp.sum(cp.square(rows), axis=1)
    size = cp.abs(rows) if loss.per_component else cp.norm(rows, 2, axis=1)
    if isinstance(loss, qpmhe.Huber):
        each = cp.huber(size, loss.threshold)
    else:
        each = cp.power(size, loss.exponent)
    return cp.sum(each, axis=1) if loss.per_component else each


def minimum(estimate, slopes, weights, loss, discount=1.0, sets=None, hold=None):
    """The least cost of the linearised residuals about an estimate, and where it is.

    slopes are the Jacobians (A, C) at all states but the last; ``hold`` adds what the estimator
    states of it.
    """
    x, w, v = estimate.trajectory, estimate.disturbances, estimate.noises
    (count, n), (a, c) = w.shape, slopes
    d = cp.Variable((count + 1, n))
    w = cp.vstack([w[i] + d[i + 1] - a[i] @ d[i] for i in range(count)])
    there = np.isfinite(v)
    v = cp.vstack([np.nan_to_num(v[i]) - c[i] @ d[i] for i in range(count)])
    factors = discount ** np.arange(count - 1, -1, -1.0)
    roots = [np.linalg.cholesky(one) for one in weights]
    start = cp.reshape(x[0] + d[0] - estimate.candidate[0], (1, n), order="C")
    cost = (
        discount**count * cp.sum_squares(start @ roots[0]) + factors @ loss_of(None, w @ roots[1])
        + factors @ loss_of(loss, cp.multiply(there * 1.0, v) @ roots[2])
    )
    if hold is not None:
        away = x[0][hold.components] + d[0][hold.components] - hold.target
        cost += discount**count * cp.quad_form(away, cp.psd_wrap(hold.weight))
    rows = {"disturbances": w, "noises": v}
    constraints = []
    for name, box in (sets or {}).items():
        constraints += [rows[name] >= np.tile(box.lower, (count, 1)),
                        rows[name] <= np.tile(box.upper, (count, 1))]
    problem = cp.Problem(cp.Minimize(cost), constraints)
    problem.solve(
        solver=cp.CLARABEL, **dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-9)
    )
    return problem.value, x + d.value


REACTOR, OBSERVER, QUADRATIC, SCENARIO = qpmhe.models.batch_reactor()


@pytest.mark.parametrize(("noise", "tolerance"), [
    (qpmhe.Huber([[25.0]]), 1e-6), (qpmhe.Power([[25.0]], 1.5), 1e-6),
    # Near a kink reweighted forms creep: they agree less closely.
    (qpmhe.Power([[25.0]], 1.0), 1e-3),
], ids=["huber", "power 1.5", "euclidean"])
def test_reweighted_qps_converge_to_where_the_convex_problem_has_nothing_better(noise, tolerance):
    Y, rng = SCENARIO.simulate(0, 25).measurements, np.random.default_rng(5)
    cost = qpmhe.RobustCost(prior=np.eye(2), disturbance=100.0 * np.eye(2), noise=noise)
    mhe = qpmhe.MovingHorizonEstimator(
        REACTOR, OBSERVER, cost, horizon=8, initial_state=SCENARIO.initial_estimate, max_qps=None
    )
    for t, y in enumerate(Y + 3.0 * (rng.random(Y.shape) < 0.1)):
        estimate = mhe.update(y)
        if t % 4:
            continue
        moved = [x + 1e-30j * np.eye(2) for x in estimate.trajectory[:-1]]
        slopes = [
            np.array([np.transpose([g(z, np.zeros(0)) for z in one]).imag / 1e-30 for one in moved])
            for g in (REACTOR.f, REACTOR.h)
        ]
        found, _ = minimum(
            estimate, slopes, (np.eye(2), 100.0 * np.eye(2), np.array([[25.0]])), noise
        )
        assert estimate.cost <= estimate.candidate_cost
        assert found == pytest.approx(estimate.cost, rel=tolerance)


LOSSES = {
    "huber": (qpmhe.Huber(R, 1.5), 1e-6),
    "huber per component": (qpmhe.Huber(R, 1.5, per_component=True), 1e-6),
    "power 1.5": (qpmhe.Power(R, 1.5), 1e-5),
    "quadratic": (None, 1e-6),
}


def linear(loss, discount=1.0, sets=None, engine="python", **options):
    """Estimates of a linear system from a record with outliers and a gap."""
    sets = sets or {}
    if engine == "python":
        system = qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=2, p=2, **sets)
    else:
        ca = pytest.importorskip("casadi")
        if find_compiler() is None:
            pytest.skip("there is no C compiler")
        system = qpmhe.from_casadi(
            lambda x: ca.DM(A) @ x, lambda x: ca.DM(C) @ x, n=2, compiled=False, **sets
        )
    kind, noise = (qpmhe.QuadraticCost, R) if loss is None else (qpmhe.RobustCost, loss)
    cost = kind(prior=P, disturbance=Q, noise=noise, discount=discount)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.zeros((2, 2))), cost, horizon=5, initial_state=[0.5, -0.5],
        engine=engine, **options,
    )
    generator = np.random.default_rng(3)
    for t in range(9):
        y = generator.standard_normal(2) + (6.0 if t % 4 == 2 else 0.0)
        if t == 5:
            y[1] = np.nan
        yield mhe.update(y)


def of_linear(estimate, loss, discount=1.0, sets=None):
    count = len(estimate.noises)
    return minimum(estimate, ([A] * count, [C] * count), (P, Q, R), loss, discount, sets)


@pytest.mark.parametrize("engine", ["python", "compiled"])
@pytest.mark.parametrize("boxed", [False, True], ids=["free", "boxed"])
@pytest.mark.parametrize("discount", [1.0, 0.8])
@pytest.mark.parametrize("name", LOSSES)
def test_on_a_linear_system_the_minimum_is_that_of_the_convex_problem(
    name, discount, boxed, engine
):
    loss, tolerance = LOSSES[name]
    sets = {"disturbances": WIDE} if boxed else {}
    for estimate in linear(loss, discount, sets, engine, max_qps=None):
        found, best = of_linear(estimate, loss, discount, sets)
        assert estimate.cost == pytest.approx(found, rel=tolerance)
        np.testing.assert_allclose(estimate.trajectory, best, atol=1e-2)


@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_held_states_are_weighed_in(discount):
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=2, p=2)
    system = system.with_origin(held={0: 0.5, 1: 0.3})  # as `augment_parameters` does
    cost = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=0.02 * R, discount=discount)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.zeros((2, 2))), cost, horizon=5, initial_state=[2.5, -3.5]
    )
    generator, weights = np.random.default_rng(3), (P, Q, 0.02 * R)
    for _ in range(9):
        estimate = mhe.update(generator.standard_normal(2))
        slopes = [[one] * len(estimate.noises) for one in (A, C)]
        found, best = minimum(estimate, slopes, weights, None, discount, hold=mhe.hold)
        free, _ = minimum(estimate, slopes, weights, None, discount)
        assert free < 0.99 * found  # the hold is felt
        assert estimate.cost == pytest.approx(found, rel=1e-6)
        np.testing.assert_allclose(estimate.trajectory, best, atol=1e-3)


def test_with_gross_outliers_hubers_rmse_is_at_most_half_the_quadratics():
    huber = qpmhe.RobustCost(
        prior=QUADRATIC.prior, disturbance=QUADRATIC.disturbance,
        noise=qpmhe.Huber(QUADRATIC.noise),
    )
    squares = dict.fromkeys((QUADRATIC, huber), 0.0)
    for seed in range(2):
        states, Y = SCENARIO.simulate(seed)
        rng = np.random.default_rng([seed, 1])
        wrong = Y + (rng.random(Y.shape) < 0.05) * rng.choice([-8.0, 8.0], Y.shape)
        for cost in squares:
            mhe = qpmhe.MovingHorizonEstimator(
                REACTOR, OBSERVER, cost, horizon=10,
                initial_state=SCENARIO.initial_estimate, max_qps=3,
            )
            squares[cost] += np.sum((mhe.run(wrong).states - states) ** 2)
    assert squares[huber] <= 0.25 * squares[QUADRATIC]
