"""The observer is projected onto X in its own metric, and keeps what is proved of it."""

import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

import qpmhe
from qpmhe import Status
from qpmhe.errors import ShapeError, WeightError
from qpmhe.observers.projection import NearestPoint
from tests.estimation.spoil import observer_alone
from tests.estimation.systems import linear

INF = math.inf


def random_case(rng, rank):
    """A set, a point, and a factor S of the covariance S S'."""
    n = int(rng.integers(1, 5))
    inside, matrix = rng.standard_normal(n), rng.standard_normal((rng.integers(1, 2 * n + 2), n))
    lower, upper = inside - rng.exponential(size=n), inside + rng.exponential(size=n)
    lower[rng.random(n) < 0.3], upper[rng.random(n) < 0.3] = -INF, INF
    rows = qpmhe.Polytope(matrix, matrix @ inside + rng.exponential(size=len(matrix)))
    factor = rng.standard_normal((n, n if rank is None else min(rank, n)))
    return qpmhe.Box(lower, upper) & rows, 3.0 * rng.standard_normal(n), factor


@pytest.mark.parametrize(("rank", "diagonal"), [
    (None, False), (None, True), (1, False), (2, False), (3, False),
])
def test_projections_are_those_of_cvxpy(rank, diagonal):
    cvxpy = pytest.importorskip("cvxpy")
    rng, reached, moved = np.random.default_rng(5), 0, 0
    for _ in range(60):
        convex_set, point, factor = random_case(rng, rank)
        found = NearestPoint(convex_set, diagonal)(point, factor @ factor.T)
        if diagonal:
            factor = np.diag(np.sqrt(np.sum(factor * factor, axis=1)))
        assert convex_set.violation(found.point) <= 1e-9
        step = cvxpy.Variable(factor.shape[1])
        target, inside = point + factor @ step, []
        for rows, low, high in (
            (np.eye(point.size), convex_set.lower, convex_set.upper),
            (convex_set.matrix, convex_set.row_lower, convex_set.row_upper),
        ):
            below, above = np.isfinite(low), np.isfinite(high)
            inside += [rows[below] @ target >= low[below]] if below.any() else []
            inside += [rows[above] @ target <= high[above]] if above.any() else []
        program = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(step)), inside)
        program.solve(solver="CLARABEL")
        assert found.reached == (program.status in ("optimal", "optimal_inaccurate"))
        if found.reached:
            size = 1 + abs(point).max()
            np.testing.assert_allclose(found.point, target.value, atol=1e-5 * size)
            moved += not np.array_equal(found.point, point)
        reached += found.reached
    assert reached == 60 if rank is None else 15 < reached < 60
    assert moved > 9


# What is proved


def worst_excess(rng, steps, is_own):
    """The largest excess over the one-step bound that an adversary finds.

    The observer F = A - K C contracts by rho in a metric M. The adversary knows the observer's
    next state before the true one goes on: to the corner of X that violates the bound most, if
    any does.
    """
    n = int(rng.integers(2, 4))
    closed = rng.standard_normal((n, n))
    closed *= rng.uniform(0.3, 0.95) / np.abs(np.linalg.eigvals(closed)).max()
    gain, c = rng.standard_normal((n, 1)), rng.standard_normal((1, n))
    rho = 0.5 * (1.0 + np.abs(np.linalg.eigvals(closed)).max())
    metric = solve_discrete_lyapunov(closed.T / rho, np.eye(n))
    a = closed + gain @ c
    lower, upper = -rng.exponential(size=n), rng.exponential(size=n)
    lower[0] = 0.0
    corners = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(n, -1).T
    observer = qpmhe.Luenberger(gain, metric=metric if is_own else np.eye(n))
    mhe = observer_alone(
        linear(a, c, states=qpmhe.Box(lower, upper)), observer,
        corners[rng.integers(len(corners))],
    )
    root = np.linalg.cholesky(metric).T
    x, z, worst, projected = corners[rng.integers(len(corners))], mhe.state, -INF, 0

    def size(e):
        return np.linalg.norm(root @ np.asarray(e).T, axis=0)

    for _ in range(steps):
        v = rng.standard_normal(1) * rng.choice([0.0, 0.01, 1.0])
        estimate = mhe.update(c @ x + v)
        projected += Status.OBSERVER_PROJECTED in estimate.status
        following = estimate.candidate[-1]
        nexts = np.vstack((corners, rng.uniform(lower, upper, (4, n))))
        allowed = rho * size(x - z) + size(nexts - a @ x) + size(gain @ v)
        excesses = (size(nexts - following) - allowed) / (1e-12 + allowed)
        worst = max(worst, excesses.max())
        x, z = nexts[excesses.argmax()], following
    return worst, projected


@pytest.mark.slow
def test_projection_keeps_the_contraction_in_the_observers_metric():
    runs, steps = 30, 10
    for is_own in (True, False):  # the adversary beats another metric
        rng = np.random.default_rng(1)
        found = [worst_excess(rng, steps, is_own) for _ in range(runs)]
        worst = max(worst for worst, _ in found)
        assert worst < 1e-9 if is_own else worst > 1e-2
        assert sum(projected for _, projected in found) > 0.09 * runs * steps


CLOSED = np.array([[1.2, 1.0], [-1.0, -0.5]])
K, C = np.array([[1.0], [0.0]]), np.array([[1.0, 0.0]])


def test_a_stable_observer_that_a_projection_in_the_euclidean_metric_destabilises():
    def sizes(metric):
        system = linear(CLOSED + K @ C, C, states=qpmhe.Box([0.0, 0.0], [INF, INF]))
        mhe = observer_alone(system, qpmhe.Luenberger(K, metric=metric), [1.0, 0.0])
        return np.linalg.norm(mhe.run(np.zeros((60, 1))).states, axis=1)

    np.testing.assert_allclose(sizes(np.eye(2)), 1.2 ** np.arange(61), rtol=1e-9)
    own, lyapunov = sizes(None), sizes(solve_discrete_lyapunov(CLOSED.T, np.eye(2)))
    assert own[-1] < 1e-12
    np.testing.assert_allclose(own, lyapunov, rtol=1e-6, atol=1e-30)
    with pytest.raises(WeightError, match="metric"):
        sizes([[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(ShapeError, match="metric has shape"):
        sizes(np.eye(3))


def test_active_bounds_hold_exactly():
    """Not up to rounding: a model may have no derivative on a bound, and a huge one beside it."""
    generator, active = np.random.default_rng(3), 0
    for _ in range(100):
        lower = generator.normal(size=3) * generator.choice([0.0, 1.0, 1e-3], size=3)
        upper = lower + generator.uniform(0.5, 2.0, 3)
        root = generator.normal(size=(3, 3))
        covariance = root @ root.T * 10.0 ** generator.uniform(-3.0, 3.0)
        nearest = NearestPoint(qpmhe.Box(lower, upper))
        point = nearest(lower + 3.0 * generator.normal(size=3), covariance).point
        away = np.minimum(point - lower, upper - point)
        assert (away[away < 1e-9] == 0.0).all()
        active += (away == 0.0).sum()
    assert active > 200


def test_the_metric_is_that_of_exact_jacobians_also_where_no_qp_needs_them():
    # Differences take steps in the scale of the prior: here out of the domain of f.
    def f(x):
        return np.array([0.9 * x[0] + 0.1 * np.sqrt(x[0] - 0.4), 0.95 * x[1] + 0.05 * x[0]])

    system = qpmhe.System(
        f, lambda x: np.array([np.log(x[0]) + 0.1 * x[1], x[1]]), n=2, p=2,
        states=qpmhe.Box([1.0, -0.5], [1.0, 0.5]),
    )
    observer = qpmhe.Luenberger([[0.15, -0.02], [0.03, 0.18]])
    cost = qpmhe.QuadraticCost(
        prior=1e-18 * np.eye(2), disturbance=100.0 * np.eye(2), noise=100.0 * np.eye(2)
    )
    paths = []
    for qps in (0, 1):
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=3, initial_state=[1.0, 0.1], max_qps=qps,
            engine="python",
        )
        paths.append([mhe.update([0.1 * t, 0.2]).observer_state for t in range(6)])
        assert mhe._engine._window.metric.settled
    np.testing.assert_allclose(*paths, rtol=1e-12)
    assert 0.01 < abs(paths[0][-1][1]) < 0.49
