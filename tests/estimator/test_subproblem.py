import numpy as np
import pytest

import qpmhe

from .plain import assembled, spd

NONE = np.zeros(0)
SIZES = [(1, 1, 0), (2, 1, 0), (3, 2, 1), (2, 3, 2)]
STEP = 1e-30  # of the complex differences, which are exact for any tiny step


def nonlinear(n, p, m, **options):
    generator = np.random.default_rng(n + p + m)
    a, b = 0.6 * generator.standard_normal((n, n)), generator.standard_normal((n, max(m, 1)))
    c = generator.standard_normal((p, n))
    if m:
        return qpmhe.System(
            lambda x, u: np.sin(x @ a.T) + u @ b.T,
            lambda x, u: x @ c.T + u[..., :1] * x[..., :1], n=n, p=p, m=m, **options,
        )
    return qpmhe.System(
        lambda x: np.sin(x @ a.T), lambda x: x @ c.T + x[..., :1] ** 2, n=n, p=p, **options
    )


class Case:
    """A system with window, problem and subproblem, and the dense QP by plain loops."""

    def __init__(self, sizes, *, horizon=4, missing=0.0, observer=None, prior=None, **sets):
        self.n, self.p, self.m = sizes
        self.generator = generator = np.random.default_rng(1)
        self.missing = missing
        self.system = nonlinear(*sizes, **sets)
        self.cost = qpmhe.QuadraticCost(
            prior=spd(generator, self.n) if prior is None else prior,
            disturbance=spd(generator, self.n), noise=spd(generator, self.p),
        )
        observer = observer or qpmhe.Luenberger(0.1 * np.ones((self.n, self.p)))
        start = generator.standard_normal(self.n)
        self.window, self.formulation, self.subproblem = assembled(
            self.system, observer, self.cost, horizon, start
        )

    def push(self, y=None):
        generator = self.generator
        if y is None:
            y = generator.standard_normal(self.p)
            y[generator.random(self.p) < self.missing] = np.nan
        self.window.push(np.array(y, dtype=float), generator.standard_normal(self.m))
        self.problem = self.formulation.problem(self.window)

    def trajectory(self):
        shape = self.window.candidate.shape
        return self.window.candidate + 0.7 * self.generator.standard_normal(shape)

    def residuals(self, trajectory):
        """(w_i, v_i) for all i, with zeros where y is missing; complex numbers pass."""
        system, window, stages = self.system, self.window, []
        for i, (x, u) in enumerate(zip(trajectory[:-1], window.inputs, strict=True)):
            w = trajectory[i + 1] - system.f(x, u)
            v = (window.measurements[i] - system.h(x, u)) * window.observed[i]
            stages.append(np.concatenate([w, v]))
        return np.array(stages)

    def half_cost(self, trajectory, prior_weight):
        offset = trajectory[0] - self.window.candidate[0]
        total = offset @ prior_weight @ offset
        for residual, there in zip(
            self.residuals(trajectory), self.window.observed, strict=True
        ):
            total = total + residual @ self.cost.partial_weight(there) @ residual
        return 0.5 * total

    def derivatives(self, function, trajectory):
        """Complex differences of a function of the trajectory, one column a component."""
        columns = []
        for k in np.ndindex(trajectory.shape):
            moved = trajectory.astype(complex)
            moved[k] += 1j * STEP
            columns.append(np.imag(function(moved)) / STEP)
        return np.stack(columns, axis=-1)

    def gradient(self, trajectory, prior_weight):
        return self.derivatives(lambda x: self.half_cost(x, prior_weight), trajectory)

    def hessian(self, trajectory, prior_weight):
        """Gauss-Newton: the residuals' Jacobians between their weights, and the prior's."""
        n, total = self.n, np.zeros((trajectory.size, trajectory.size))
        total[:n, :n] = prior_weight
        slopes = self.derivatives(self.residuals, trajectory)
        for slope, there in zip(slopes, self.window.observed, strict=True):
            total += slope.T @ self.cost.partial_weight(there) @ slope
        return total

    def check(self, qp, trajectory, prior_weight=None):
        weight = self.cost.prior if prior_weight is None else prior_weight
        assert (qp.stages, qp.n) == trajectory.shape
        gradient = self.gradient(trajectory, weight)
        scale = np.abs(gradient).max() + 1.0
        np.testing.assert_allclose(qp.gradient.ravel(), gradient, rtol=1e-10, atol=1e-12 * scale)
        hessian = self.hessian(trajectory, weight)
        scale = np.abs(hessian).max()
        np.testing.assert_allclose(qp.dense(), hessian, rtol=1e-10, atol=1e-12 * scale)
        assert np.linalg.eigvalsh(qp.dense())[0] > 0.0


@pytest.mark.parametrize("missing", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("horizon", [1, 2, 4])
@pytest.mark.parametrize("sizes", SIZES)
def test_the_qp_of_growing_and_sliding_windows(sizes, horizon, missing):
    case = Case(sizes, horizon=horizon, missing=missing)
    for t in range(1, horizon + 4):
        case.push()
        assert case.window.length == min(t, horizon)
        case.check(case.subproblem.at(case.problem, case.problem.candidate), case.window.candidate)
        trajectory = case.trajectory()
        case.check(case.subproblem.at(case.problem, case.problem.evaluate(trajectory)), trajectory)


def test_the_qp_after_slides_to_the_front():
    case = Case((2, 1, 0), horizon=3, missing=0.05)
    for t in range(1, 220):
        case.push()
        if t % 64 in (1, 2, 3, 4, 5) or case.window.has_special_weights:
            qp = case.subproblem.at(case.problem, case.problem.candidate)
            case.check(qp, case.window.candidate)


@pytest.mark.parametrize("sizes", SIZES)
def test_the_gradient_is_that_of_the_true_cost_by_differences(sizes):
    case = Case(sizes)
    for _ in range(6):
        case.push()
    trajectory = case.trajectory()
    qp = case.subproblem.at(case.problem, case.problem.evaluate(trajectory))
    for k in np.ndindex(trajectory.shape):
        step = np.zeros_like(trajectory)
        step[k] = 1e-5
        ahead = case.problem.evaluate(trajectory + step).cost
        behind = case.problem.evaluate(trajectory - step).cost
        slope = 0.5 * (ahead - behind) / 2e-5
        assert qp.gradient[k] == pytest.approx(slope, rel=1e-6, abs=1e-6)


def test_on_a_linear_system_the_qp_is_the_problem():
    a, c = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[1.0, 0.5]])
    system = qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=2, p=1)
    generator = np.random.default_rng(2)
    cost = qpmhe.QuadraticCost(prior=spd(generator, 2), disturbance=spd(generator, 2), noise=3.0)
    window, formulation, subproblem = assembled(
        system, qpmhe.Luenberger([0.3, 0.1]), cost, 5, np.zeros(2)
    )
    for _ in range(8):
        window.push(generator.standard_normal(1), NONE)
        problem = formulation.problem(window)
        qp, base = subproblem.at(problem, problem.candidate), problem.candidate.cost
        for _ in range(5):
            d = generator.standard_normal(window.candidate.shape)
            true = problem.evaluate(window.candidate + d).cost
            assert 2.0 * qp.objective(d) + base == pytest.approx(true, rel=1e-11)


@pytest.mark.parametrize("missing", [0.0, 0.4])
def test_the_candidate_by_either_way(missing):
    case = Case((3, 2, 1), missing=missing, **sets(3, 2))
    for _ in range(9):
        case.push()
        qp = case.subproblem.at(case.problem, case.problem.candidate)
        kept = {name: getattr(qp, name).copy() for name in QP_ARRAYS}
        trial = case.problem.evaluate(case.window.candidate.copy())
        qp = case.subproblem.at(case.problem, trial)
        for name, value in kept.items():
            np.testing.assert_allclose(
                getattr(qp, name), value, rtol=1e-11, atol=1e-11, err_msg=name
            )


@pytest.mark.parametrize("missing", [0.0, 0.4])
def test_the_prior_weight_of_an_observer(missing):
    observer = qpmhe.ExtendedKalman(prior=np.eye(3), disturbance=0.1 * np.eye(3), noise=np.eye(2))
    case = Case((3, 2, 0), missing=missing, observer=observer, prior=qpmhe.ObserverPrior())
    for _ in range(8):
        case.push()
        weight = np.linalg.inv(case.window.prior_covariance)
        qp = case.subproblem.at(case.problem, case.problem.candidate)
        case.check(qp, case.window.candidate, weight)
        trajectory = case.trajectory()
        qp = case.subproblem.at(case.problem, case.problem.evaluate(trajectory))
        case.check(qp, trajectory, weight)


QP_ARRAYS = (
    "band", "gradient", "lower", "upper", "row_own", "row_next", "row_lower", "row_upper"
)


# Sets


def sets(n, p):
    """Sets that no candidate here leaves; a component without bounds, others with one."""
    return {
        "states": qpmhe.Box([-20.0] * n, [30.0] * (n - 1) + [np.inf]),
        "disturbances": qpmhe.Box([-15.0] * (n - 1) + [-np.inf], [np.inf] * (n - 1) + [18.0]),
        "noises": qpmhe.Box([-np.inf] * (p - 1) + [-20.0], [np.inf] * (p - 1) + [25.0]),
    }


def plain_rows(case, trajectory, w_set, v_set):
    """Linearised rows as a list of (coefficients of d, lower, upper), stage by stage.

    There is no noise, and so no bound on it, where y is missing.
    """
    n, residuals = case.n, case.residuals(trajectory)
    slopes = case.derivatives(case.residuals, trajectory)
    rows = []
    for i in range(len(residuals)):
        for box, start in ((w_set, 0), (v_set, n)):
            for j in range(box.dimension if box else 0):
                low, high = box.lower[j], box.upper[j]
                if not (np.isfinite(low) or np.isfinite(high)):
                    continue
                if start == n and not case.window.observed[i, j]:
                    rows.append((None, -np.inf, np.inf))
                    continue
                value = residuals[i, start + j]
                rows.append((slopes[i, start + j], low - value, high - value))
    return rows


def check_rows(case, qp, trajectory, w_set, v_set):
    matrix, count = qp.dense_rows(), len(trajectory) - 1
    assert np.isinf(qp.row_lower[-1]).all()
    assert np.isinf(qp.row_upper[-1]).all()
    rows = plain_rows(case, trajectory, w_set, v_set)
    assert len(rows) == count * qp.rows
    for k, (slope, low, high) in enumerate(rows):
        if slope is not None:
            np.testing.assert_allclose(matrix[k], slope, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(qp.row_lower.ravel()[k], low, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(qp.row_upper.ravel()[k], high, rtol=1e-10, atol=1e-11)


def check_sets(case, qp, trajectory, chosen):
    case.check(qp, trajectory)
    check_rows(case, qp, trajectory, chosen.get("disturbances"), chosen.get("noises"))
    box = chosen.get("states")
    assert qp.bounded is (box is not None)
    for k, j in np.ndindex(trajectory.shape):
        low, high = -np.inf, np.inf
        if box:
            low, high = box.lower[j] - trajectory[k, j], box.upper[j] - trajectory[k, j]
        assert (qp.lower[k, j], qp.upper[k, j]) == (low, high)


@pytest.mark.parametrize(
    "names",
    [("states",), ("disturbances",), ("noises",), ("disturbances", "noises"),
     ("states", "disturbances", "noises")],
    ids="-".join,
)
@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("sizes", SIZES)
def test_bounds_and_rows_are_the_linearised_sets(sizes, missing, names):
    n, p, _ = sizes
    chosen = {name: box for name, box in sets(n, p).items() if name in names}
    case = Case(sizes, missing=missing, **chosen)
    for _ in range(6):
        case.push()
        assert case.problem.candidate.violation == 0.0
        qp = case.subproblem.at(case.problem, case.problem.candidate)
        check_sets(case, qp, case.window.candidate, chosen)
        trajectory = case.trajectory()
        qp = case.subproblem.at(case.problem, case.problem.evaluate(trajectory))
        check_sets(case, qp, trajectory, chosen)


def test_linearised_rows_bound_the_true_residuals_to_second_order():
    case = Case((2, 1, 0), **sets(2, 1))
    for _ in range(5):
        case.push()
    qp = case.subproblem.at(case.problem, case.problem.candidate)
    direction = case.generator.standard_normal(case.window.candidate.shape)
    errors = []
    for length in (1e-2, 1e-3):
        d = length * direction
        true = case.residuals(case.window.candidate + d) - case.window.residuals
        errors.append(np.abs(qp.rows_times(d)[:-1] - true).max())
    assert errors[0] / errors[1] == pytest.approx(100.0, rel=0.1)


def test_rows_that_the_candidate_violates_lose_that_side_and_come_back():
    box = qpmhe.Box([-2.0], [2.0])
    system = qpmhe.System(
        lambda x: 0.8 * x, lambda x: x, n=1, p=1, states=box, disturbances=box, noises=box
    )
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    window, formulation, subproblem = assembled(
        system, qpmhe.Luenberger([0.8]), cost, 2, np.zeros(1), project=False
    )
    missing = []
    for y in (0.5, 0.5, 9.0, 0.0, 0.0, -9.0, 0.0, 0.0, 0.0, 0.0, 0.0):
        window.push(np.array([y]), NONE)
        problem = formulation.problem(window).without_violated()
        qp = subproblem.at(problem, problem.candidate)
        sides = (
            (window.candidate, qp.lower, qp.upper),
            (window.residuals, qp.row_lower[:-1], qp.row_upper[:-1]),
        )
        for points, lower, upper in sides:
            np.testing.assert_array_equal(lower, np.where(points < -2.0, -np.inf, -2.0 - points))
            np.testing.assert_array_equal(upper, np.where(points > 2.0, np.inf, 2.0 - points))
        missing.append([int(np.isinf(side).sum()) for _, *both in sides for side in both])
    assert np.max(missing, axis=0).min() > 0
    assert missing[0] == missing[-1] == [0, 0, 0, 0]


@pytest.mark.parametrize(
    "jacobian",
    [
        pytest.param(lambda x: np.array([[0.5 / np.sqrt(x[0])]]), id="infinite"),
        pytest.param(lambda x: [[x[0] / (x[0] * abs(x[0]) ** 0.5) / 2]], id="NaN"),
        pytest.param(lambda x: [[0.5 / float(x[0]) ** 0.5]], id="raises"),
    ],
)
@pytest.mark.parametrize("stage", [0, 1, 2])
def test_there_is_no_qp_where_there_is_no_jacobian(jacobian, stage):
    with np.errstate(all="ignore"):
        system = qpmhe.System(lambda x: np.sqrt(x), lambda x: x, n=1, p=1, f_jacobian=jacobian)
        cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
        window, formulation, subproblem = assembled(
            system, qpmhe.Luenberger([0.1]), cost, 3, np.ones(1)
        )
        for _ in range(3):
            window.push(np.ones(1), NONE)
        problem = formulation.problem(window)
        trajectory = np.ones((4, 1))
        assert subproblem.at(problem, problem.evaluate(trajectory)) is not None
        trajectory[stage] = 0.0
        trial = problem.evaluate(trajectory)
        assert np.isfinite(trial.cost)
        assert subproblem.at(problem, trial) is None
