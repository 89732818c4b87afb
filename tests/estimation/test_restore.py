"""A candidate that is restored into the sets, against dense problems solved in other variables."""

import math
import pickle

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import lsq_linear, minimize

import qpmhe
from qpmhe import Box, Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.estimation.limits import RESTORING
from qpmhe.estimation.problem import Problem

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


ENGINES = pytest.mark.parametrize("engine", ["python", pytest.param(
    "compiled", marks=pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
)])


class Linear:
    """x+ = A x + w, y = C x + v, and the window's problem in x(0) and w(0), ..., w(K-1)."""

    def __init__(self, a, c, prior=1.0, disturbance=1.0, noise=1.0):
        self.a, self.c = np.atleast_2d(a), np.atleast_2d(c)
        self.n, self.p = self.a.shape[0], self.c.shape[0]
        self.weights = prior * np.eye(self.n), disturbance * np.eye(self.n), noise * np.eye(self.p)

    def estimator(self, sets, gain, start, **options):
        prior, disturbance, noise = self.weights
        system = qpmhe.System(
            lambda x: x @ self.a.T, lambda x: x @ self.c.T, n=self.n, p=self.p, **sets
        )
        cost = qpmhe.QuadraticCost(prior=prior, disturbance=disturbance, noise=noise)
        return qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(gain), cost, initial_state=start,
            **{"infeasible": "restore", "max_qps": None} | options,
        )

    def states(self, K):
        """The matrix from (x(0), w(0), ...) to the trajectory."""
        n = self.n
        path, block = np.zeros((K + 1, n, (K + 1) * n)), np.eye((K + 1) * n).reshape(K + 1, n, -1)
        path[0] = block[0]
        for i in range(K):
            path[i + 1] = self.a @ path[i] + block[i + 1]
        return path

    def squares(self, K, prior, Y):
        """T and b, with J = |T s - b|^2 in s = (x(0), w(0), ...)."""
        path, (P, Q, R), n = self.states(K), map(np.linalg.cholesky, self.weights), self.n
        rows = [P.T @ path[0]] + [Q.T @ np.eye((K + 1) * n)[(i + 1) * n : (i + 2) * n]
                                  for i in range(K)] + [R.T @ self.c @ path[i] for i in range(K)]
        right = [P.T @ prior, np.zeros(K * n), *(R.T @ y for y in Y)]
        return np.vstack(rows), np.concatenate(right)

    def variables(self, trajectory):
        w = trajectory[1:] - trajectory[:-1] @ self.a.T
        return np.concatenate([trajectory[0], w.ravel()])


def records(K, rng, p=1):
    return rng.normal(size=(K, p)) + 3.0


@ENGINES
@pytest.mark.parametrize("low", [10.0, -30.0, [2.0, -4.0]], ids=str)
def test_the_nearest_and_the_best_trajectory_are_those_of_a_dense_solver(low, engine):
    rng = np.random.default_rng(3)
    n = np.size(low)
    model = Linear(0.9 * np.eye(n) + 0.1 * np.eye(n, k=1), np.eye(1, n), 1.0, 2.0, 5.0)
    side = np.broadcast_to(low, n).astype(float)
    sets = {"disturbances": Box(side, side + 20.0)}
    mhe = model.estimator(sets, 0.2 * np.ones((n, 1)), np.ones(n), horizon=4, engine=engine)
    Y, restored = records(7, rng), 0
    for t, y in enumerate(Y):
        estimate = mhe.update(y)
        if Status.RESTORED not in estimate.status:
            continue
        restored += 1
        K = len(estimate.disturbances)
        T, b = model.squares(K, estimate.candidate[0], Y[t + 1 - K : t + 1])
        bounds = tuple(
            np.concatenate([np.full(n, end), np.tile(one, K)])
            for end, one in ((-np.inf, side), (np.inf, side + 20.0))
        )
        raw = model.variables(estimate.candidate)
        nearest = lsq_linear(T, T @ raw, bounds, method="bvls", tol=1e-14).x
        best = lsq_linear(T, b, bounds, method="bvls", tol=1e-14)
        assert estimate.candidate_cost == pytest.approx(np.sum((T @ raw - b) ** 2), rel=1e-9)
        assert estimate.restored_cost == pytest.approx(np.sum((T @ nearest - b) ** 2), rel=1e-6)
        assert estimate.cost == pytest.approx(2.0 * best.cost, rel=1e-6)
        assert estimate.cost > estimate.candidate_cost
        assert np.all(estimate.disturbances >= side - 1e-7)
        assert np.all(estimate.disturbances <= side + 20.0 + 1e-7)
        assert not estimate.dropped
    assert restored >= 4


@pytest.mark.slow
@pytest.mark.parametrize("max_qps", [1, 3, None])
def test_the_inequality_of_the_restored_cost(max_qps):
    """sqrt(J(restored)) <= 2 sqrt(J(raw)) + sqrt(J(truth)), sets around the truth."""
    shares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        n, K = int(rng.integers(1, 4)), int(rng.integers(1, 6))
        a = rng.normal(size=(n, n))
        a *= rng.uniform(0.3, 1.0) / np.abs(np.linalg.eigvals(a)).max()
        model = Linear(a, rng.normal(size=(1, n)), *10.0 ** rng.uniform(-2, 2, 3))
        w, v = rng.normal(size=(K, n)) * 10.0 ** rng.uniform(-2, 1), rng.normal(size=(K, 1))
        w += 3.0 * rng.normal(size=n)
        x = [rng.normal(size=n)]
        for one in w:
            x.append(a @ x[-1] + one)
        X = np.array(x)
        Y = X[:-1] @ model.c.T + v
        room = 10.0 ** rng.uniform(-3, 0)
        sets = {"disturbances": Box(w.min(0) - room, w.max(0) + room)}
        if seed % 3 == 0:
            sets["noises"] = Box(v.min(0) - room, v.max(0) + room)
        gain, error = 0.1 * rng.normal(size=(n, 1)), 10.0 ** rng.uniform(-2, 1)
        start = X[0] + error * rng.normal(size=n)
        mhe = model.estimator(sets, gain, start, horizon=K, max_qps=max_qps)
        for y in Y:
            estimate = mhe.update(y)
        if Status.RESTORED in estimate.status:
            T, b = model.squares(K, estimate.candidate[0], Y)
            truth = math.sqrt(np.sum((T @ model.variables(X) - b) ** 2))
            most = 2.0 * math.sqrt(estimate.candidate_cost) + truth
            shares.append(math.sqrt(estimate.restored_cost) / most)
            assert estimate.cost <= estimate.restored_cost
    assert len(shares) >= 20
    assert max(shares) <= 1.0 + 1e-6
    assert max(shares) > 0.5  # the inequality says something


def test_both_policies_agree_where_a_better_trajectory_is_in_the_sets():
    model, rng = Linear(0.8, 1.0), np.random.default_rng(0)
    one, other = (
        model.estimator(
            {"noises": Box([-1.0], [1.0])}, [0.1], [0.0], horizon=5, infeasible=name, max_qps=2
        ) for name in ("drop_rows", "restore")
    )
    outside = 0
    for y in rng.normal(size=(30, 1)):
        first, second = one.update(y), other.update(y)
        if first.dropped or Status.RESTORED in second.status:
            continue
        outside += Status.CANDIDATE_OUTSIDE in first.status
        assert first.status == second.status
        assert first.trajectory.tolist() == second.trajectory.tolist()
        assert math.isnan(second.restored_cost)
    assert outside > 3


@ENGINES
def test_observer_and_prior_are_not_touched(engine):
    model, rng = Linear([[0.9, 0.2], [0.0, 0.7]], [[1.0, 0.0]]), np.random.default_rng(1)
    sets = {"disturbances": Box([5.0, 5.0], [100.0, 100.0])}
    arguments = sets, [[0.3], [0.1]], [1.0, 1.0]
    mhe = model.estimator(*arguments, horizon=3, max_qps=2, engine=engine)
    plain = model.estimator({}, [[0.3], [0.1]], [1.0, 1.0], horizon=3)
    for y in records(8, rng):
        estimate, observer = mhe.update(y), plain.update(y)
        assert Status.RESTORED in estimate.status
        assert Status.IMPROVED not in estimate.status
        assert not estimate.improved
        np.testing.assert_allclose(estimate.candidate, observer.candidate, rtol=1e-14)
        assert estimate.candidate_cost == pytest.approx(observer.candidate_cost, rel=1e-13)
        assert "restored_cost" in estimate.explain()
        assert "The estimate satisfies all sets." in estimate.explain()
    state = mhe.state_dict()
    again = model.estimator(*arguments, horizon=3, max_qps=2, engine=engine)
    again.load_state_dict(state)
    mhe.forget_warm_start()
    y = np.array([2.0])
    assert mhe.update(y).trajectory.tolist() == again.update(y).trajectory.tolist()


@pytest.mark.parametrize("name", ["states", "disturbances", "noises"])
@pytest.mark.parametrize("side", [1.0, -1.0])
@ENGINES
def test_one_stage_whose_set_excludes_the_measured_rest(name, side, engine):
    """A plant at rest, as measured, and a set that excludes it, as in MPC.jl's tests of sets."""
    model = Linear(np.diag([0.8, 0.61]), np.diag([1.0, 1.2]), 1.0, 1.0, 10.0)
    bounds = sorted([side, 100.0 * side])
    sets = {name: Box([bounds[0]] * 2, [bounds[1]] * 2)}
    start = np.full(2, side) if name == "states" else np.zeros(2)
    mhe = model.estimator(sets, 0.1 * np.eye(2), start, horizon=1, max_qps=2, engine=engine)
    for _ in range(4):
        estimate = mhe.update(np.zeros(2))
        assert Status.CANDIDATE not in estimate.status or name == "states"
        assert not estimate.dropped
        points = {
            "states": estimate.trajectory, "disturbances": estimate.disturbances,
            "noises": estimate.noises,
        }[name]
        np.testing.assert_allclose(points[-1], side, atol=1e-6)


@pytest.mark.parametrize("excluded", ["disturbances", "noises"])
@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
def test_sets_that_exclude_each_other_are_named(excluded):
    """Both steps name the same rows and stages, and go on within their caps."""
    sets = {"states": Box([0.0], [1.0]), excluded: Box([5.0], [9.0])}
    made = [
        Linear(0.8, 1.0).estimator(sets, [0.1], [0.5], horizon=3, max_qps=3, engine=engine)
        for engine in ("python", "compiled")
    ]
    for t, y in enumerate([0.5, 0.7, 0.3, 0.2]):
        one, other = (mhe.update([y]) for mhe in made)
        times = range(max(0, t - 2), t + 1)
        rows = [f"the lower bound of {excluded}, row 0, at time {i}" for i in times]
        assert one.message == other.message == (
            "no trajectory that satisfies all sets was found; the nearest to one misses "
            f"{', '.join(rows)}."
        )
        for found in (one, other, pickle.loads(pickle.dumps(other))):
            assert Status.CANDIDATE_OUTSIDE in found.status
            assert found.message in found.explain()
            assert found.cost <= found.candidate_cost
            assert found.qps <= 3
            assert found.nearest_points <= 2 * RESTORING + 5 * (3 + 1)
    made[1].reset([0.5])
    if excluded == "noises":  # from here on they do not exclude each other
        assert made[1].update([6.0]).message == ""


@ENGINES
def test_a_range_of_the_disturbance_that_excludes_none(engine):
    """A chain of four states driven by one disturbance in [0.5, 1], as python-control tests it."""
    rate = np.diag([-0.5, -1.0, -2.0, -3.0]) + np.eye(4, k=1)
    whole = expm(0.2 * np.block([[rate, np.column_stack(([0, 0, 0, 1], [0.1] * 4))],
                                 [np.zeros((2, 6))]]))
    a, b, g = whole[:4, :4], whole[:4, 4], whole[:4, 5:]
    c = np.eye(4)[[0, 2]]
    system = qpmhe.System(
        lambda x, u: a @ x + b * u[0], lambda x: c @ x, n=4, p=2, m=1, disturbance_matrix=g,
        disturbances=Box([0.5], [1.0]),
    )
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.eye(4), disturbance=[[0.01]], noise=1e-6 * np.eye(2)
    )
    gain = np.zeros((4, 2))
    gain[0, 0] = gain[2, 1] = 0.3
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(gain), cost, horizon=12, initial_state=np.zeros(4),
        max_qps=3, infeasible="restore", engine=engine,
    )
    x, restored = np.zeros(4), 0
    for t in range(12):
        v = 1e-4 * np.array([np.sin(2.0 * t), np.cos(3.0 * t)])
        estimate = mhe.update(c @ x + v, [np.sin(0.2 * t)])
        x = a @ x + b * np.sin(0.2 * t) + g[:, 0] * 0.5
        assert Status.CANDIDATE not in estimate.status
        assert not estimate.dropped
        assert np.all(np.abs(estimate.disturbances - 0.75) <= 0.25 + 1e-8)
        np.testing.assert_allclose(estimate.state, x, atol=2e-3, rtol=2e-3)
        restored += Status.RESTORED in estimate.status
    assert restored > 0


def test_a_hard_constraint_that_the_candidate_violates():
    """x must stay outside of a disc, in which the observer is: nearest point by SLSQP."""
    outside = qpmhe.Constraint(lambda x: 4.0 - x[0] ** 2 - x[1] ** 2)
    system = qpmhe.System(lambda x: 0.95 * x, lambda x: x, n=2, p=2, constraints=[outside])
    weights = {"prior": np.eye(2), "disturbance": 10.0 * np.eye(2), "noise": np.eye(2)}
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.3 * np.eye(2)), qpmhe.QuadraticCost(**weights), horizon=3,
        initial_state=[0.5, 1.0], max_qps=None, infeasible="restore",
    )
    y = np.array([0.8, 1.5])

    def cost(s, z):
        x = s.reshape(-1, 2)
        w, v = x[1:] - 0.95 * x[:-1], y - x[:-1]
        return np.sum((x[0] - z) ** 2) + 10.0 * np.sum(w**2) + np.sum(v**2)

    rows = {"type": "ineq", "fun": lambda s: np.sum(s.reshape(-1, 2) ** 2, axis=1) - 4.0}
    for t in range(5):
        estimate = mhe.update(y)
        assert Status.RESTORED in estimate.status
        assert np.all(np.sum(estimate.trajectory**2, axis=1) >= 4.0 - 1e-6)
        lengths = np.linalg.norm(estimate.candidate, axis=1, keepdims=True)
        found = minimize(
            cost, (2.5 * estimate.candidate / lengths).ravel(), (estimate.candidate[0],),
            method="SLSQP", constraints=[rows], options={"ftol": 1e-14, "maxiter": 500},
        )
        assert estimate.cost <= found.fun * (1.0 + 1e-5)
        assert len(estimate.disturbances) == min(t + 1, 3)


def test_a_model_that_is_not_finite_on_the_way_shortens_the_step(monkeypatch):
    """The full step leads to a level below zero, where the outflow has no value."""
    judge, seen = Problem.evaluate, []

    def judged(self, *arguments, **options):
        seen.append(judge(self, *arguments, **options))
        return seen[-1]

    monkeypatch.setattr(Problem, "evaluate", judged)
    system = qpmhe.System(
        lambda x: x - 0.5 * np.sqrt(x), lambda x: 10.0 * np.sqrt(x), n=1, p=1,
        noises=Box([0.5], [np.inf]),
    )
    restored = 0
    for y in (2.0, 3.0, 4.0):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.0001]),
            qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1e-4), horizon=2,
            initial_state=[3.0], infeasible="restore", max_qps=2,
        )
        for _ in range(2):
            seen.clear()
            estimate = mhe.update([y])
            assert np.isfinite(estimate.trajectory).all()
            if Status.RESTORED in estimate.status:
                restored += any(one.violation == math.inf for one in seen)
                assert np.all(estimate.noises >= 0.5 - 1e-7)
                assert estimate.cost <= estimate.restored_cost < math.inf
    assert restored >= 3


def test_no_way_that_is_finite_leaves_the_candidate():
    """The model has no value along the sets' trajectories: a few QPs, and a reason."""
    def f(x):
        return np.where(np.abs(x) < 2.0, 0.9 * x, np.nan)

    system = qpmhe.System(f, lambda x: x, n=1, p=1, disturbances=Box([10.0], [20.0]))
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.1]), qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0),
        horizon=3, initial_state=[0.5], infeasible="restore", max_qps=2,
    )
    for _ in range(4):
        estimate = mhe.update([0.5])
        assert np.isfinite(estimate.trajectory).all()
        assert estimate.nearest_points <= 5 * (1 + estimate.qps) + 40
        assert Status.CANDIDATE_OUTSIDE in estimate.status
    # Two steps of w >= 10 cannot be evaluated, one can.
    assert Status.RESTORED not in estimate.status
    assert "no trajectory that satisfies all sets was found" in estimate.message
    assert "lower bound of disturbances, row 0, at time" in estimate.message


