"""The observer is projected onto X in its own metric, and keeps what is proved of it."""

import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import nnls

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import SetError, ShapeError, WeightError
from qpmhe.estimation.snapshot import read
from qpmhe.observers.projection import NearestPoint

INF = math.inf


def estimator(system, observer, *, start, max_qps=0, horizon=4, cost=None, **options):
    if cost is None:
        cost = qpmhe.QuadraticCost(
            prior=np.eye(system.n), disturbance=np.eye(system.n), noise=np.eye(system.p)
        )
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=horizon, initial_state=start, max_qps=max_qps, **options
    )


def linear(a, c, states, **sets):
    return qpmhe.System(
        lambda x: x @ a.T, lambda x: x @ c.T, n=len(a), p=len(c), states=states, **sets
    )


# The projection


def random_box(rng, n):
    lower = rng.standard_normal(n)
    upper = lower + rng.exponential(size=n)
    lower[rng.random(n) < 0.3] = -INF
    upper[1:][rng.random(n - 1) < 0.3] = INF
    return qpmhe.Box(lower, upper)


def random_polytope(rng, n):
    matrix = rng.standard_normal((rng.integers(1, 2 * n + 2), n))
    inside = rng.standard_normal(n)
    return qpmhe.Polytope(matrix, matrix @ inside + rng.exponential(size=len(matrix)))


def random_case(rng, rank=None):
    """A set, a point, and a factor S of the covariance S S'."""
    n = int(rng.integers(1, 5))
    kinds = [random_box, random_polytope, lambda rng, n: random_box(rng, n) & random_box(rng, n)]
    while True:
        try:
            convex_set = kinds[rng.integers(3)](rng, n)
        except SetError:
            continue
        break
    factor = rng.standard_normal((n, n if rank is None else min(rank, n)))
    return convex_set, 3.0 * rng.standard_normal(n), factor


def rows_of(convex_set):
    """A and b of A x <= b."""
    eye = np.eye(convex_set.dimension)
    rows = np.vstack((eye, -eye, convex_set.matrix, -convex_set.matrix))
    sides = np.concatenate((
        convex_set.upper, -convex_set.lower, convex_set.row_upper, -convex_set.row_lower
    ))
    return rows[np.isfinite(sides)], sides[np.isfinite(sides)]


def optimality_gap(convex_set, point, factor, found):
    """How far the found point is from z - P A' lambda with lambda >= 0 on active rows only."""
    rows, sides = rows_of(convex_set)
    assert convex_set.violation(found) <= 1e-9
    active = rows[rows @ found > sides - 1e-8]
    spread = factor @ factor.T @ active.T
    moved = point - found
    if not active.size:
        return np.linalg.norm(moved)
    return nnls(spread, moved)[1] / max(1.0, np.linalg.norm(moved))


def test_projections_satisfy_the_conditions_of_optimality():
    rng = np.random.default_rng(1)
    moved = 0
    for _ in range(1000):
        convex_set, point, factor = random_case(rng)
        found = NearestPoint(convex_set)(point, factor @ factor.T)
        assert found.reached
        assert optimality_gap(convex_set, point, factor, found.point) < 1e-7
        moved += not np.array_equal(found.point, point)
    assert moved > 500


@pytest.mark.parametrize("rank", [1, 2, 3])
def test_projections_in_singular_covariances_stay_in_their_range(rank):
    rng = np.random.default_rng(rank)
    reached = 0
    for _ in range(300):
        convex_set, point, factor = random_case(rng, rank)
        found = NearestPoint(convex_set)(point, factor @ factor.T)
        assert convex_set.violation(found.point) <= 1e-9
        if found.reached:
            assert optimality_gap(convex_set, point, factor, found.point) < 1e-7
            reached += 1
    assert reached > 100


@pytest.mark.parametrize("rank", [None, 1, 2])
def test_projections_are_those_of_cvxpy(rank):
    cvxpy = pytest.importorskip("cvxpy")
    rng = np.random.default_rng(5)
    unreachable = 0
    for _ in range(25):
        convex_set, point, factor = random_case(rng, rank)
        rows, sides = rows_of(convex_set)
        step = cvxpy.Variable(factor.shape[1])
        inside = [rows @ (point + factor @ step) <= sides] if sides.size else []
        program = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(step)), inside)
        program.solve(solver="CLARABEL")
        found = NearestPoint(convex_set)(point, factor @ factor.T)
        assert found.reached == (program.status in ("optimal", "optimal_inaccurate"))
        if found.reached:
            expected = point + factor @ step.value
            np.testing.assert_allclose(found.point, expected, atol=1e-5 * (1 + abs(point).max()))
        unreachable += not found.reached
    assert (unreachable > 0) == (rank is not None)


def test_a_point_of_the_set_stays():
    rng = np.random.default_rng(2)
    for _ in range(100):
        convex_set, point, factor = random_case(rng)
        inside = NearestPoint(convex_set)(point, np.eye(point.size)).point
        again = NearestPoint(convex_set)(inside, factor @ factor.T)
        np.testing.assert_allclose(again.point, inside, rtol=1e-12, atol=1e-12)


# What is proved


def certified(rng, n):
    """A stable observer F = A - K C with C, K, and a metric M in which it contracts by rho."""
    closed = rng.standard_normal((n, n))
    closed *= rng.uniform(0.3, 0.95) / np.abs(np.linalg.eigvals(closed)).max()
    gain, c = rng.standard_normal((n, 1)), rng.standard_normal((1, n))
    rho = 0.5 * (1.0 + np.abs(np.linalg.eigvals(closed)).max())
    metric = solve_discrete_lyapunov(closed.T / rho, np.eye(n))
    return closed, gain, c, metric, rho


def worst_excess(rng, steps, make, of_step):
    """The largest excess over the one-step bound that an adversary finds.

    The adversary knows the observer's next state before the true one goes on: to the corner of X
    that violates the bound most, if any does.
    """
    n = int(rng.integers(2, 4))
    closed, gain, c, metric, rho = certified(rng, n)
    a = closed + gain @ c
    lower, upper = -rng.exponential(size=n), rng.exponential(size=n)
    lower[0] = 0.0
    corners = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(n, -1).T
    system = linear(a, c, qpmhe.Box(lower, upper))
    mhe = make(system, gain, metric, corners[rng.integers(len(corners))])
    x, z, worst, projected = corners[rng.integers(len(corners))], mhe.state, -INF, 0
    bound = of_step(mhe, closed, metric, rho, gain)
    for _ in range(steps):
        v = rng.standard_normal(1) * rng.choice([0.0, 0.01, 1.0])
        estimate = mhe.update(c @ x + v)
        projected += Status.OBSERVER_PROJECTED in estimate.status
        following = estimate.candidate[-1]
        candidates = np.vstack((corners, rng.uniform(lower, upper, (4, n))))
        excesses = bound(x, z, candidates, candidates - a @ x, v, following)
        worst = max(worst, excesses.max())
        x, z = candidates[excesses.argmax()], following
    return worst, projected


def lyapunov_bound(mhe, closed, metric, rho, gain):
    root = np.linalg.cholesky(metric).T

    def size(e):
        return np.linalg.norm(root @ np.asarray(e).T, axis=0)

    def excess(x, z, candidates, w, v, following):
        allowed = rho * size(x - z) + size(w) + size(gain @ v)
        return (size(candidates - following) - allowed) / (1e-12 + allowed)

    return excess


def adversarial(seed, runs, steps, make=None, of_step=lyapunov_bound):
    rng = np.random.default_rng(seed)
    if make is None:
        def make(system, gain, metric, start):
            return estimator(system, qpmhe.Luenberger(gain, metric=metric), start=start)

    found = [worst_excess(rng, steps, make, of_step) for _ in range(runs)]
    return max(worst for worst, _ in found), sum(projected for _, projected in found)


def test_projection_keeps_the_contraction_in_the_observers_metric():
    worst, projected = adversarial(1, runs=100, steps=20)
    assert worst < 1e-9
    assert projected > 400


@pytest.mark.slow
def test_projection_keeps_the_contraction_in_ten_thousand_runs():
    worst, projected = adversarial(2, runs=10_000, steps=5)
    assert worst < 1e-9
    assert projected > 5_000


def test_the_adversary_beats_a_projection_in_another_metric():
    def make(system, gain, metric, start):
        return estimator(system, qpmhe.Luenberger(gain, metric=np.eye(system.n)), start=start)

    worst, _ = adversarial(1, runs=50, steps=20, make=make)
    assert worst > 1e-2


Q, R = 0.3, 0.5


def test_projection_keeps_the_contraction_of_a_kalman_filter():
    """In P(t)^-1, with rho^2 = 1 - q / p and noise terms in Q^-1 and R^-1."""

    def make(system, gain, metric, start):
        eye = np.eye(system.n)
        kalman = qpmhe.ExtendedKalman(prior=eye, disturbance=Q * eye, noise=[[R]])
        return estimator(system, kalman, start=start)

    def of_step(mhe, closed, metric, rho, gain):
        a, c = mhe.system.f_jacobian(mhe.state, np.zeros(0)), mhe.system.h_jacobian(
            mhe.state, np.zeros(0)
        )
        covariance = [np.eye(len(a))]

        def size(e, p):
            return np.sqrt(np.einsum("...i,ij,...j->...", e, np.linalg.inv(p), e))

        def excess(x, z, candidates, w, v, following):
            p = covariance[0]
            k = a @ p @ c.T / (c @ p @ c.T + R)
            f = a - k @ c
            after = f @ p @ f.T + Q * np.eye(len(a)) + R * k @ k.T
            covariance[0] = after
            contraction = np.sqrt(1.0 - Q / np.linalg.eigvalsh(after)[-1])
            allowed = contraction * size(x - z, p)
            allowed = allowed + np.linalg.norm(w, axis=1) / np.sqrt(Q) + abs(v) / np.sqrt(R)
            return (size(candidates - following, after) - allowed) / (1e-12 + allowed)

        return excess

    worst, projected = adversarial(3, runs=60, steps=20, make=make, of_step=of_step)
    assert worst < 1e-9
    assert projected > 150


def test_the_candidates_disturbance_is_bounded_where_kappa_does_not_bound_it():
    """|L(t)| <= |e(t+1)| + L_f |e(t)| + |w(t)|; and the plain one's |L|_M where f(z) is in X."""
    rng = np.random.default_rng(4)
    inside = outside = 0
    for _ in range(100):
        closed, gain, c, metric, _ = certified(rng, 2)
        a = closed + gain @ c
        box = qpmhe.Box([0.0, -1.0], [2.0, 1.0])
        mhe = estimator(
            linear(a, c, box), qpmhe.Luenberger(gain, metric=metric), start=[1.0, 0.0]
        )
        x, z = np.array([1.0, 0.5]), mhe.state
        for _ in range(20):
            v = 0.3 * rng.standard_normal(1)
            following = rng.uniform(box.lower, box.upper)
            fitting_error = c @ x + v - c @ z
            estimate = mhe.update(c @ x + v)
            applied = estimate.disturbances[-1]
            e, e_next, w = x - z, following - estimate.state, following - a @ x
            bound = np.linalg.norm(e_next) + np.linalg.norm(a, 2) * np.linalg.norm(e)
            assert np.linalg.norm(applied) <= (bound + np.linalg.norm(w)) * (1 + 1e-9)
            if Status.OBSERVER_PROJECTED in estimate.status:
                plain = gain @ fitting_error
                outside += Status.PREDICTION_OUTSIDE in estimate.status
                stays = box.violation(a @ z) == 0.0
                if stays:
                    inside += 1
                    assert applied @ metric @ applied <= plain @ metric @ plain * (1 + 1e-9)
                assert (Status.PREDICTION_OUTSIDE in estimate.status) is not stays
            x, z = following, estimate.state
    assert inside > 30
    assert outside > 30


# The counterexample: a stable observer that a projection in the Euclidean metric destabilises

CLOSED = np.array([[1.2, 1.0], [-1.0, -0.5]])
K, C = np.array([[1.0], [0.0]]), np.array([[1.0, 0.0]])


def counterexample(metric, steps=60):
    system = linear(CLOSED + K @ C, C, qpmhe.Box([0.0, 0.0], [INF, INF]))
    mhe = estimator(system, qpmhe.Luenberger(K, metric=metric), start=[1.0, 0.0])
    return np.linalg.norm(mhe.run(np.zeros((steps, 1))).states, axis=1)


def test_projection_in_the_euclidean_metric_may_destabilise():
    np.testing.assert_allclose(counterexample(np.eye(2)), 1.2 ** np.arange(61), rtol=1e-9)


@pytest.mark.parametrize("given", [False, True])
def test_projection_in_the_lyapunov_metric_does_not(given):
    metric = solve_discrete_lyapunov(CLOSED.T, np.eye(2))
    sizes = counterexample(metric if given else None)
    assert sizes[-1] < 1e-12
    np.testing.assert_allclose(sizes, counterexample(metric), rtol=1e-6, atol=1e-30)


@pytest.mark.parametrize("kind", [qpmhe.Luenberger, lambda k, metric: qpmhe.OutputInjection(
    lambda z, v: k @ v, metric=metric
)])
def test_metrics_are_checked(kind):
    with pytest.raises(WeightError, match="metric"):
        kind(K, metric=[[1.0, 2.0], [2.0, 1.0]])
    system = linear(CLOSED, C, qpmhe.Box([0.0, 0.0], [INF, INF]))
    with pytest.raises(ShapeError, match="metric has shape"):
        estimator(system, kind(K, metric=np.eye(3)), start=[0.0, 0.0])


# The paper's observer


def reaction(x):
    """2A -> B; runs away from negative pressures."""
    rate = 0.016 * x[..., 0] ** 2
    return np.stack([x[..., 0] - 2.0 * rate, x[..., 1] + rate], axis=-1)


def reactor(bounded=True):
    return qpmhe.System(
        reaction, lambda x: x.sum(axis=-1), n=2, p=1,
        states=qpmhe.Box([0.0, 0.0], [INF, INF]) if bounded else None,
    )


def pressures(steps=60):
    rng, x, found = np.random.default_rng(3), np.array([3.0, 1.0]), []
    for _ in range(steps):
        found.append([x.sum() + 0.1 * rng.standard_normal()])
        x = reaction(x)
    return np.array(found)


def test_without_projection_the_observer_is_the_papers():
    gain, ys = np.array([[0.8], [-0.3]]), pressures(8)
    z, expected = np.array([0.1, 4.5]), [np.array([0.1, 4.5])]
    for y in ys:
        z = reaction(z) + gain @ (y - z.sum())
        expected.append(z)
    plain = estimator(
        reactor(), qpmhe.Luenberger(gain), start=[0.1, 4.5], project_observer=False
    ).run(ys)
    np.testing.assert_allclose(plain.states, expected, rtol=1e-12)
    assert (plain.states < 0.0).any()
    assert plain.share(Status.OBSERVER_PROJECTED) == 0.0
    projected = estimator(reactor(), qpmhe.Luenberger(gain), start=[0.1, 4.5]).run(ys)
    assert (projected.states >= 0.0).all()
    assert projected.share(Status.OBSERVER_PROJECTED) > 0.0


@pytest.mark.parametrize("observer", [
    qpmhe.Luenberger([0.8, -0.3]), qpmhe.OutputInjection(lambda z, v: np.array([0.8, -0.3]) * v[0]),
    qpmhe.ExtendedKalman(prior=36.0 * np.eye(2), disturbance=1e-6 * np.eye(2), noise=[[0.01]]),
    qpmhe.UnscentedKalman(prior=np.eye(2), disturbance=1e-4 * np.eye(2), noise=[[0.01]]),
], ids=["constant", "injection", "extended", "unscented"])
@pytest.mark.parametrize("max_qps", [0, 1, 3])
def test_no_estimate_leaves_the_set(observer, max_qps):
    mhe = estimator(reactor(), observer, start=[0.1, 4.5], max_qps=max_qps, horizon=8)
    moved = False
    for y in pressures():
        estimate = mhe.update(y)
        for states in (estimate.candidate, estimate.trajectory, estimate.filtered):
            assert (states >= 0.0).all()
        assert estimate.dropped == ()
        assert estimate.cost <= estimate.candidate_cost
        moved |= Status.OBSERVER_PROJECTED in estimate.status
        # The candidate follows the model with the corrections that were made.
        if estimate.status & Status.CANDIDATE:
            steps = estimate.trajectory[1:] - reaction(estimate.trajectory[:-1])
            np.testing.assert_allclose(estimate.disturbances, steps, atol=1e-12)
    assert moved


def test_inside_of_the_set_nothing_changes():
    gain, ys = qpmhe.Luenberger([0.05, 0.05]), pressures()
    bounded, free = (
        estimator(reactor(known), gain, start=[3.0, 1.0], max_qps=2).run(ys)
        for known in (True, False)
    )
    np.testing.assert_array_equal(bounded.states, free.states)


# First guesses, noise-free components, degenerate sets


@pytest.mark.parametrize("observer", [
    qpmhe.Luenberger([0.1, 0.1], metric=[[2.0, 1.0], [1.0, 1.0]]),
    qpmhe.ExtendedKalman(
        prior=np.linalg.inv([[2.0, 1.0], [1.0, 1.0]]), disturbance=np.eye(2), noise=[[1.0]]
    ),
    qpmhe.Luenberger([0.1, 0.1]),
])
def test_a_first_guess_outside_is_projected_with_a_warning(observer):
    metric = np.array([[2.0, 1.0], [1.0, 1.0]])
    prior = qpmhe.ObserverPrior() if isinstance(observer, qpmhe.ExtendedKalman) else metric
    cost = qpmhe.QuadraticCost(prior=prior, disturbance=np.eye(2), noise=[[1.0]])
    with pytest.warns(qpmhe.ObserverWarning, match=r"initial_state is \[-1\.0, 1\.0\]"):
        mhe = estimator(reactor(), observer, start=[-1.0, 1.0], cost=cost)
    # min 2 + 2 s + s^2 over xi = (0, 1 + s) is at s = -1.
    np.testing.assert_allclose(mhe.initial_state, [0.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(mhe.state, mhe.initial_state)


def test_a_reset_outside_is_projected_with_a_warning():
    mhe = estimator(reactor(), qpmhe.Luenberger([0.1, 0.1]), start=[1.0, 1.0])
    with pytest.warns(qpmhe.ObserverWarning, match="outside of the state set"):
        mhe.reset([1.0, -2.0])
    np.testing.assert_array_equal(mhe.state, [1.0, 0.0])


def noise_free(max_qps):
    """The level of a tank falls with an outflow; it has no noise, and cannot fall below 0."""

    def f(x):
        return np.stack([x[..., 0] - 0.1 * x[..., 1], 0.9 * x[..., 1]], axis=-1)

    system = qpmhe.System(
        f, lambda x: x[..., 0], n=2, p=1, states=qpmhe.Box([0.0, -1.0], [5.0, 1.0]),
        disturbances=qpmhe.Box([0.0, -INF], [0.0, INF]),
    )
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=[[0.01]]
    )
    mhe = estimator(system, qpmhe.Luenberger([0.0, -0.3]), start=[0.2, 1.0], cost=cost,
                    max_qps=max_qps)
    return [mhe.update([0.1]) for _ in range(6)]


def test_a_moved_noise_free_component_is_outside_of_the_disturbances():
    late = noise_free(0)[3:]
    for estimate in late:
        assert Status.OBSERVER_PROJECTED | Status.CANDIDATE_OUTSIDE in estimate.status
        assert np.abs(estimate.disturbances[:, 0]).max() > 0.01
        assert (estimate.candidate[:, 0] >= 0.0).all()


@pytest.mark.parametrize("max_qps", [1, 5])
def test_the_roll_out_restores_a_moved_noise_free_component(max_qps):
    for estimate in noise_free(max_qps):
        assert np.abs(estimate.disturbances[:, 0]).max() < 1e-15
        assert Status.IMPROVED in estimate.status
        assert estimate.dropped == ()


def test_a_flat_set_holds_its_component():
    system = linear(np.array([[0.9, 0.3], [0.2, 0.8]]), C, qpmhe.Box([0.0, 0.5], [5.0, 0.5]))
    kalman = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=[[1.0]])
    for observer in (qpmhe.Luenberger([0.5, 0.1]), kalman):
        for max_qps in (0, 2):
            mhe = estimator(system, observer, start=[1.0, 0.5], max_qps=max_qps)
            run = mhe.run(np.ones((20, 1)))
            np.testing.assert_array_equal(run.states[:, 1], 0.5)


def test_sets_without_a_point_are_refused():
    with pytest.raises(SetError, match="empty"):
        qpmhe.Box([0.0], [INF]) & qpmhe.Box([-INF], [-1.0])
    with pytest.raises(SetError, match="empty"):
        qpmhe.Polytope([[1.0], [-1.0]], [0.0, -1.0])


def test_derivatives_at_a_bound_do_not_leave_the_set():
    def f(x):
        if x[0] < 0.0:
            raise ValueError("square root of a negative level")
        return np.array([x[0] - 0.1 * math.sqrt(x[0])])

    system = qpmhe.System(f, lambda x: x, n=1, p=1, states=qpmhe.Box([0.0], [INF]))
    mhe = estimator(system, qpmhe.Luenberger([0.5]), start=[0.0], max_qps=2)
    for y in (0.0, -0.5, 0.2, -0.1, 0.0):
        assert Status.MODEL_FAILED not in mhe.update([y]).status


# A prediction that says nothing


@pytest.mark.parametrize("distance", [3.0, 5.0])
def test_the_exothermic_reactor_settles_from_far_away_as_from_near(distance):
    system, observer, cost, scenario = qpmhe.models.cstr()
    error = scenario.initial_estimate - scenario.initial_state
    for seed in range(3):
        states, measurements, inputs = scenario.simulate(seed)
        settled = []
        for factor in (1.0, distance):
            start = np.clip(
                scenario.initial_state + factor * error, system.states.lower, system.states.upper
            )
            run = estimator(system, observer, start=start, cost=cost, horizon=20).run(
                measurements, inputs
            )
            assert system.states.violation(run.states) == 0.0
            late = ((run.states - states) / [0.3, 5.0])[100:]
            settled.append(np.sqrt(np.mean(late**2)))
        assert settled[1] == pytest.approx(settled[0], rel=1e-3)
        assert settled[1] < 0.12


def test_a_prediction_beyond_the_sets_width_does_not_drown_the_correction():
    """f blows up on a part of X; where it does, the output shows the way back."""

    def f(x):
        return np.where(x > 2.0, 1e30, 0.9 * x)

    system = qpmhe.System(f, lambda x: x, n=1, p=1, states=qpmhe.Box([0.0], [3.0]))
    mhe = estimator(system, qpmhe.Luenberger([0.5]), start=[2.5])
    estimate = mhe.update([0.5])
    assert Status.PREDICTION_OUTSIDE in estimate.status
    np.testing.assert_allclose(estimate.state, [2.0])  # 3, the nearest to 1e30, and K v
    assert mhe.update([0.5]).state < 2.0


@pytest.mark.parametrize("far", [1e3, 1e17, 1e30, 1e45])
def test_projections_of_far_points_are_on_their_bounds(far):
    nearest = NearestPoint(qpmhe.Box([1.0, 1.0], [3.0, 4.0]))
    metric = np.array([[1.0, 0.5], [0.5, 1.0]])
    # Down the second component as far as up the first.
    np.testing.assert_array_equal(nearest(np.array([far, 2.0]), metric).point, [3.0, 1.0])
    np.testing.assert_array_equal(nearest(np.array([2.0, -far]), metric).point, [3.0, 1.0])
    np.testing.assert_array_equal(nearest(np.array([far, far]), metric).point, [3.0, 4.0])


def test_a_prediction_outside_but_near_is_projected_once():
    """There the contraction is worth something, and nothing but the projection keeps it."""
    system = linear(np.array([[2.0]]), np.eye(1), qpmhe.Box([0.0], [3.0]))
    mhe = estimator(system, qpmhe.Luenberger([1.5]), start=[2.5])
    # f(z) = 5 is outside; 5 - 3 is inside, and stays.
    np.testing.assert_allclose(mhe.update([0.5]).state, [2.0])


def test_a_snapshot_is_read_while_states_of_another_metric_are_in_the_window():
    """The error is not stable at first: the metric settles while the observer is projected."""

    def f(x):
        own = 0.9 * x[..., 0] + 0.3
        return np.stack([own, (1.5 - 0.5 * x[..., 0]) * x[..., 1] + 0.3 * x[..., 0]], axis=-1)

    def made(engine):
        box = qpmhe.Box([0.0, 0.0], [INF, 1.0])
        if engine == "python":
            system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1, states=box)
        else:
            pytest.importorskip("casadi")
            system = qpmhe.from_casadi(
                lambda x: [0.9 * x[0] + 0.3, (1.5 - 0.5 * x[0]) * x[1] + 0.3 * x[0]],
                lambda x: [x[0]], n=2, compiled=False, states=box,
            )
        cost = qpmhe.QuadraticCost(
            prior=[[2.0, 0.9], [0.9, 1.0]], disturbance=np.eye(2), noise=np.eye(1)
        )
        return estimator(
            system, qpmhe.Luenberger([0.2, 0.5]), start=[0.2, 0.9], max_qps=1, horizon=8, cost=cost,
            engine=engine,
        )

    rng, x, ys = np.random.default_rng(0), np.array([0.3, 0.9]), []
    for _ in range(12):
        ys.append(x[:1] + 0.3 * rng.standard_normal(1))
        x = f(x)
    found = {}
    for engine in ("python", "compiled") if find_compiler() else ("python",):
        mhe = made(engine)
        for y in ys:
            expected = mhe.update(y)
            again = made(engine)
            again.load_state_dict(mhe.state_dict())
            np.testing.assert_array_equal(again.state, mhe.state)
            assert Status.OBSERVER_PROJECTED in expected.status
        if engine == "python":
            assert read(mhe.state_dict())["window"]["metric"][1]
        found[engine] = expected.candidate
    np.testing.assert_allclose(found.get("compiled", found["python"]), found["python"], atol=1e-9)
