"""Disturbances of lower dimension than the state, against independent references."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

STEPS, HORIZON = 10, 5


class Linear:
    """A random observable linear system with x+ = A x + G w, and a record."""

    def __init__(self, seed, n, r, p, steps=40):
        rng = np.random.default_rng(seed)
        a = rng.standard_normal((n, n))
        self.A = a / np.abs(np.linalg.eigvals(a)).max()
        self.G, self.C = rng.standard_normal((n, r)), rng.standard_normal((p, n))
        self.P, self.Q, self.R = (_covariance(rng, k) for k in (n, r, p))
        self.z0 = rng.standard_normal(n)
        x, self.Y = self.z0 + np.linalg.cholesky(self.P) @ rng.standard_normal(n), []
        for _ in range(steps):
            self.Y.append(self.C @ x + np.linalg.cholesky(self.R) @ rng.standard_normal(p))
            x = self.A @ x + self.G @ np.linalg.cholesky(self.Q) @ rng.standard_normal(r)
        self.Y = np.array(self.Y)

    def estimator(self, how, observer, cost, **options):
        """With G itself, or with the singular covariance G Q G'; max_qps=None."""
        A, C, Q = self.A, self.C, self.Q
        given = {"disturbance_matrix": self.G} if how == "matrix" else {}
        if how == "covariance":
            Q = self.G @ Q @ self.G.T
        system = qpmhe.System(
            lambda x: x @ A.T, lambda x: x @ C.T, n=len(A), p=len(C), **given
        )
        return qpmhe.MovingHorizonEstimator(
            system, observer(system, Q), cost(Q), initial_state=self.z0, max_qps=None,
            solver_tolerance=1e-10, **options,
        )

    def kalman(self):
        """Predicted means and covariances of the Kalman filter, T + 1 of each."""
        x, P, Q = self.z0, self.P, self.G @ self.Q @ self.G.T
        found = [(x, P)]
        for y in self.Y:
            S = self.C @ P @ self.C.T + self.R
            K = self.A @ P @ self.C.T @ np.linalg.inv(S)
            x, P = self.A @ x + K @ (y - self.C @ x), self.A @ P @ self.A.T + Q - K @ S @ K.T
            found.append((x, P))
        return [np.array(one) for one in zip(*found, strict=True)]

    def minimum(self, prior, weight, ys):
        """Trajectory and J by least squares in (x_0, w_0, ..., w_{N-1}), without constraints."""
        n, r, N = len(self.A), self.G.shape[1], len(ys)
        maps = [np.hstack((np.eye(n), np.zeros((n, N * r))))]  # x_i as a matrix of the unknowns
        for i in range(N):
            following = self.A @ maps[-1]
            following[:, n + i * r : n + (i + 1) * r] += self.G
            maps.append(following)
        roots = [np.linalg.cholesky(np.linalg.inv(one)).T for one in (self.Q, self.R)]
        first = np.linalg.cholesky(weight).T
        rows, sides = [first @ maps[0]], [first @ prior]
        rows.append(np.hstack((np.zeros((N * r, n)), np.kron(np.eye(N), roots[0]))))
        sides.append(np.zeros(N * r))
        for x, y in zip(maps[:-1], ys, strict=True):
            rows.append(roots[1] @ self.C @ x)
            sides.append(roots[1] @ y)
        rows, sides = np.vstack(rows), np.concatenate(sides)
        unknowns = np.linalg.lstsq(rows, sides, rcond=None)[0]
        return np.array([x @ unknowns for x in maps]), np.sum((rows @ unknowns - sides) ** 2)


def _covariance(rng, size):
    factor = rng.standard_normal((size, size))
    return factor @ factor.T + 0.3 * np.eye(size)


SIZES = [(2, 1, 1), (3, 1, 2), (3, 2, 1), (4, 2, 2), (5, 3, 2), (4, 4, 1)]


@pytest.mark.parametrize("how", ["matrix", "covariance"])
@pytest.mark.parametrize("kalman", [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
@pytest.mark.parametrize("horizon", [1, 4, 50])
@pytest.mark.parametrize(("n", "r", "p"), SIZES)
def test_with_a_kalman_type_prior_it_is_the_kalman_filter(n, r, p, horizon, kalman, how):
    plant = Linear(100 * n + 10 * r + p, n, r, p)
    mhe = plant.estimator(
        how,
        lambda _, Q: kalman(prior=plant.P, disturbance=Q, noise=plant.R),
        lambda Q: qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), disturbance=Q, noise=plant.R
        ),
        horizon=horizon,
    )
    means, covariances = plant.kalman()
    run = mhe.run(plant.Y, covariances=True)
    sizes = 1.0 + np.abs(means).max()
    assert np.abs(run.states - means).max() <= 1e-9 * sizes
    assert np.abs(run.covariances - covariances[1:]).max() <= 1e-9 * np.abs(covariances).max()


@pytest.mark.parametrize("how", ["matrix", "covariance"])
@pytest.mark.parametrize(("n", "r", "p"), SIZES)
def test_with_a_constant_prior_it_is_least_squares_in_the_disturbances(n, r, p, how):
    plant = Linear(7 * n + r, n, r, p, steps=12)
    mhe = plant.estimator(
        how,
        lambda system, Q: qpmhe.design_luenberger(
            system, np.zeros(n), disturbance=Q, noise=plant.R
        ),
        lambda Q: qpmhe.QuadraticCost.from_covariances(
            prior=plant.P, disturbance=Q, noise=plant.R
        ),
        horizon=HORIZON,
    )
    weight = np.linalg.inv(plant.P)
    for t, y in enumerate(plant.Y):
        estimate = mhe.update(y)
        ys = plant.Y[max(0, t + 1 - HORIZON) : t + 1]
        expected, J = plant.minimum(estimate.candidate[0], weight, ys)
        size = 1.0 + np.abs(expected).max()
        assert np.abs(estimate.trajectory - expected).max() <= 1e-9 * size
        assert estimate.cost == pytest.approx(J, rel=1e-9)
        assert Status.CONVERGED in estimate.status
        w = np.linalg.lstsq(plant.G, np.diff(expected, axis=0).T, rcond=None)[0]
        if how == "matrix":
            w = np.linalg.lstsq(
                plant.G, (expected[1:] - expected[:-1] @ plant.A.T).T, rcond=None
            )[0].T
            assert estimate.disturbances.shape == w.shape
            assert np.abs(estimate.disturbances - w).max() <= 1e-8 * (1.0 + np.abs(w).max())


@pytest.mark.parametrize("horizon", [1, 4])
@pytest.mark.parametrize("seed", range(4))
def test_singular_covariances_of_the_state_cost_few_digits(seed, horizon):
    """A model that forgets all but one direction has covariances of rank 2 in 3 dimensions."""
    plant, rng = Linear(seed, 3, 1, 2), np.random.default_rng(seed + 5)
    plant.A = np.outer(rng.standard_normal(3), rng.standard_normal(3))
    plant.A /= np.abs(np.linalg.eigvals(plant.A)).max()
    mhe = plant.estimator(
        "matrix",
        lambda _, Q: qpmhe.ExtendedKalman(prior=plant.P, disturbance=Q, noise=plant.R),
        lambda Q: qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), disturbance=Q, noise=plant.R
        ),
        horizon=horizon,
    )
    means, covariances = plant.kalman()
    assert np.linalg.cond(covariances[-1]) > 1e15
    found = mhe.run(plant.Y).states
    assert np.abs(found - means).max() <= 1e-7 * (1.0 + np.abs(means).max())


@pytest.mark.parametrize("seed", range(4))
def test_a_covariance_on_its_way_to_a_singular_one_costs_few_digits(seed):
    """A decaying model without disturbance: some eigenvalues are small, but not rounding yet."""
    plant = Linear(seed, 3, 1, 2)
    plant.A, plant.Q = 0.95 * plant.A, np.zeros((1, 1))
    mhe = plant.estimator(
        "matrix",
        lambda _, Q: qpmhe.ExtendedKalman(prior=plant.P, disturbance=Q, noise=plant.R),
        lambda Q: qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), disturbance=Q, noise=plant.R
        ),
        horizon=4,
    )
    means, _ = plant.kalman()
    found = mhe.run(plant.Y).states
    assert np.abs(found - means).max() <= 2e-7 * (1.0 + np.abs(means).max())


def test_a_state_that_only_delays_another_has_singular_covariances_throughout():
    """x2+ = x1 and x1 a random walk that starts at a known value."""
    A, Q, R = np.array([[1.0, 0.0], [1.0, 0.0]]), np.diag([0.04, 0.0]), np.eye(2)
    P = np.diag([0.5, 0.0])
    rng = np.random.default_rng(3)
    Y = rng.standard_normal((30, 2))
    for kind in (qpmhe.ExtendedKalman, qpmhe.UnscentedKalman):
        system = qpmhe.System(lambda x: x @ A.T, lambda x: x, n=2, p=2)
        mhe = qpmhe.MovingHorizonEstimator(
            system, kind(prior=P, disturbance=Q, noise=R),
            qpmhe.QuadraticCost.from_covariances(
                prior=qpmhe.ObserverPrior(), disturbance=Q, noise=R
            ),
            horizon=4, initial_state=[0.0, 1.0], max_qps=None,
        )
        x, covariance, expected = np.array([0.0, 1.0]), P, []
        for y in Y:
            S = covariance + R
            K = A @ covariance @ np.linalg.inv(S)
            x = A @ x + K @ (y - x)
            covariance = A @ covariance @ A.T + Q - K @ S @ K.T
            expected.append(x)
        np.testing.assert_allclose(mhe.run(Y).states[1:], expected, atol=1e-9)


class Curved:
    """A random nonlinear system with x+ = f(x) + G w, sets that bind, and a record."""

    def __init__(self, seed, sets):
        rng = np.random.default_rng(seed)
        self.n, self.p = int(rng.integers(2, 5)), int(rng.integers(1, 3))
        n, p = self.n, self.p
        self.r = r = int(rng.integers(1, n))
        a = rng.standard_normal((n, n))
        self.A = 0.8 * a / np.abs(np.linalg.eigvals(a)).max()
        self.bent, self.C = 0.15 * rng.standard_normal((n, n)), rng.standard_normal((p, n))
        self.curve, self.G = 0.03 * rng.standard_normal((p, n)), rng.standard_normal((n, r))
        self.P, self.Q, self.R = (0.3 * _covariance(rng, k) for k in (n, r, p))
        self.start = rng.standard_normal(n)
        x, ys = self.start + 0.5 * rng.standard_normal(n), []
        for _ in range(STEPS):
            ys.append(self.h(x, np) + 0.5 * rng.standard_normal(p))
            x = self.f(x, np) + self.G @ (0.4 * rng.standard_normal(r))
        self.Y = np.array(ys)
        self.sets = {}
        if sets:
            self.sets = {
                "states": _box(rng, n, 1.8), "disturbances": _box(rng, r, 0.3),
                "noises": _box(rng, p, 1.2),
            }

    def f(self, x, m):
        return _times(self.A, x, m) + _times(self.bent, m.sin(x), m)

    def h(self, x, m):
        return _times(self.C, x, m) + _times(self.curve, x * x, m)

    def system(self):
        def f(x):
            return x @ self.A.T + np.sin(x) @ self.bent.T

        def h(x):
            return x @ self.C.T + (x * x) @ self.curve.T

        return qpmhe.System(f, h, n=self.n, p=self.p, disturbance_matrix=self.G, **self.sets)

    def cost(self, **options):
        return qpmhe.QuadraticCost.from_covariances(
            prior=self.P, disturbance=self.Q, noise=self.R, **options
        )

    def minimum(self, candidate, ys):
        """Ipopt's J with (x_0, ..., x_N, w_0, ..., w_{N-1}), from the candidate; its success."""
        ca = pytest.importorskip("casadi")
        n, r, N = self.n, self.r, len(ys)
        P, Q, R = (ca.DM(np.linalg.inv(one)) for one in (self.P, self.Q, self.R))
        x, w = ca.SX.sym("x", n, N + 1), ca.SX.sym("w", r, N)
        offset = x[:, 0] - ca.DM(candidate[0])
        J, rows, v = offset.T @ P @ offset, [], []
        for i in range(N):
            rows.append(x[:, i + 1] - self.f(x[:, i], ca) - ca.DM(self.G) @ w[:, i])
            v.append(ca.DM(ys[i]) - self.h(x[:, i], ca))
            J += w[:, i].T @ Q @ w[:, i] + v[i].T @ R @ v[i]
        free = {name: (np.full(k, -np.inf), np.full(k, np.inf)) for name, k in
                (("states", n), ("disturbances", r), ("noises", self.p))}
        free |= {name: (one.lower, one.upper) for name, one in self.sets.items()}
        solve = ca.nlpsol(
            "mhe", "ipopt",
            {"x": ca.veccat(x, w), "f": J, "g": ca.vertcat(*rows, *v)},
            {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10,
             "ipopt.bound_relax_factor": 0.0},
        )
        model = np.array([np.array(self.f(one, np)) for one in candidate[:-1]])
        first = np.linalg.lstsq(self.G, (candidate[1:] - model).T, rcond=None)[0].T
        answer = solve(
            x0=np.concatenate((candidate.ravel(), first.ravel())),
            lbx=np.concatenate((np.tile(free["states"][0], N + 1),
                                np.tile(free["disturbances"][0], N))),
            ubx=np.concatenate((np.tile(free["states"][1], N + 1),
                                np.tile(free["disturbances"][1], N))),
            lbg=np.concatenate((np.zeros(n * N), np.tile(free["noises"][0], N))),
            ubg=np.concatenate((np.zeros(n * N), np.tile(free["noises"][1], N))),
        )
        return float(answer["f"]), bool(solve.stats()["success"])


def _times(matrix, x, m):
    return matrix @ x if m is np else m.DM(matrix) @ x


def _box(rng, size, half):
    return qpmhe.Box(-half * rng.uniform(0.7, 1.3, size), half * rng.uniform(0.7, 1.3, size))


def judged(case, estimate, ys):
    """J of an estimate by a plain loop, with the least-squares w, and the largest miss of G w."""
    x, J, missed = estimate.trajectory, 0.0, 0.0
    offset = x[0] - estimate.candidate[0]
    J += offset @ np.linalg.solve(case.P, offset)
    for i, y in enumerate(ys):
        d, v = x[i + 1] - case.f(x[i], np), y - case.h(x[i], np)
        w = np.linalg.lstsq(case.G, d, rcond=None)[0]
        missed = max(missed, np.abs(case.G @ w - d).max())
        J += w @ np.linalg.solve(case.Q, w) + v @ np.linalg.solve(case.R, v)
    return J, missed


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("sets", [False, True], ids=["free", "sets"])
@pytest.mark.parametrize("seed", range(12))
def test_convergence_is_ipopts_minimum(seed, sets):
    case = Curved(seed, sets)
    observer = qpmhe.ExtendedKalman(prior=case.P, disturbance=case.Q, noise=case.R)
    mhe = qpmhe.MovingHorizonEstimator(
        case.system(), observer, case.cost(), horizon=HORIZON, initial_state=case.start,
        max_qps=None, solver_tolerance=1e-9,
    )
    reached = 0
    for t, y in enumerate(case.Y):
        estimate, ys = mhe.update(y), case.Y[max(0, t + 1 - HORIZON) : t + 1]
        assert estimate.cost <= estimate.candidate_cost
        J, missed = judged(case, estimate, ys)
        assert missed <= 1e-13 * (1.0 + np.abs(estimate.trajectory).max())
        assert estimate.cost == pytest.approx(J, rel=1e-9)
        minimum, success = case.minimum(estimate.candidate, ys)
        if success and minimum < estimate.candidate_cost:
            assert estimate.dropped == ()
            assert estimate.cost == pytest.approx(minimum, rel=1e-6)
            reached += 1
    assert reached >= (1 if sets else STEPS)


def test_a_disturbance_of_python_control_takes_as_many_lines_as_there():
    """Its optimal estimation problem takes three lines beside the system."""
    ct = pytest.importorskip("control")
    opt = pytest.importorskip("control.optimal")
    A, B = np.array([[0.9, 0.2], [-0.1, 0.95]]), np.array([[0.0, 1.0], [1.0, 0.5]])
    P, Q, R = np.eye(2), [[0.01]], 0.04 * np.eye(2)
    rng, times = np.random.default_rng(0), np.arange(8)
    plant = ct.ss(A, B, np.eye(2), 0, True)  # a control and a disturbance
    U = np.vstack((np.sin(times), 0.1 * rng.standard_normal(8)))
    Y = ct.input_output_response(plant, times, U).outputs + 0.2 * rng.standard_normal((2, 8))

    trajectory_cost = opt.gaussian_likelihood_cost(plant, np.array(Q), R)
    problem = opt.OptimalEstimationProblem(
        plant, times, trajectory_cost, terminal_cost=lambda guess, x: (guess - x) @ (guess - x)
    )
    theirs = problem.compute_estimate(Y, U[:1], X0=np.zeros(2), print_summary=False)

    system = qpmhe.from_control(ct.ss(A, B[:, :1], np.eye(2), 0, True), disturbance_matrix=B[:, 1:])
    observer = qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R)
    cost = qpmhe.QuadraticCost.from_covariances(prior=P, disturbance=Q, noise=R)
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=8, initial_state=[0, 0])

    for y, u in zip(Y.T, U[:1].T, strict=True):
        estimate = mhe.update(y, u)
    np.testing.assert_allclose(estimate.trajectory[:-1], theirs.states.T, atol=1e-4)
    np.testing.assert_allclose(estimate.disturbances[:-1], theirs.inputs.T[:-1], atol=1e-4)


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("seed", [3, 15, 16, 17, 26, 37])
def test_where_no_step_from_the_observer_helps_the_search_goes_on_from_its_roll_out(seed):
    case = Curved(seed, False)
    case.bent *= 6.0
    gain = 0.5 * np.random.default_rng(seed).standard_normal((case.n, case.p))
    mhe = qpmhe.MovingHorizonEstimator(
        case.system(), qpmhe.Luenberger(gain), case.cost(), horizon=8, initial_state=case.start,
        max_qps=None,
    )
    for y in case.Y:
        estimate = mhe.update(y)
        assert estimate.improved
        assert estimate.cost < estimate.candidate_cost
