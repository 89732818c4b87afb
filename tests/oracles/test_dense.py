"""Run to convergence, the estimator finds what plain dense optimisers find on each window."""

import numpy as np
import pytest
from scipy.optimize import least_squares

import qpmhe

REACTOR, OBSERVER, COST, SCENARIO = qpmhe.models.batch_reactor()
BACKENDS = qpmhe.solvers.available()
# banded ignores inequalities: it has no part where they bind.
INEQUALITY_BACKENDS = [b for b in BACKENDS if qpmhe.solvers.backend(b).inequalities]


def euler(x):
    reaction = 0.16 * x[..., 0] ** 2 - 0.64 * x[..., 1]
    return x + 0.1 * np.stack([-2.0 * reaction, reaction], axis=-1)


def residuals(flat, prior, Y):
    """All of J's terms divided by their standard deviations, 1, 0.1 and 0.2, as one vector."""
    x = flat.reshape(-1, 2)
    w, v = x[1:] - euler(x[:-1]), Y[:, 0] - x[:-1].sum(axis=1)
    return np.concatenate([x[0] - prior, w.ravel() / 0.1, v / 0.2])


def dense_minimum(candidate, Y, **options):
    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "jac": "2-point"}
    start = candidate.ravel()
    found = least_squares(residuals, start, args=(candidate[0], Y), **tight, **options)
    return 2.0 * found.cost, found


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("horizon", [1, 3, 10])
def test_convergence_is_the_dense_minimum_of_every_window(horizon, seed):
    Y = SCENARIO.simulate(seed, 22).measurements
    mhe = qpmhe.MovingHorizonEstimator(
        REACTOR, OBSERVER, COST, horizon=horizon, initial_state=[3.0, 0.0], max_qps=None
    )
    for t, y in enumerate(Y):
        estimate = mhe.update(y)
        window = Y[max(0, t + 1 - horizon) : t + 1]
        minimum, found = dense_minimum(estimate.candidate, window, method="lm")
        assert estimate.cost == pytest.approx(minimum, rel=1e-9)
        np.testing.assert_allclose(estimate.trajectory, found.x.reshape(-1, 2), atol=1e-4)
        terms = residuals(estimate.trajectory.ravel(), estimate.candidate[0], window)
        assert estimate.cost == pytest.approx(terms @ terms, rel=1e-11)


@pytest.mark.parametrize("max_qps", [1, 2])
@pytest.mark.parametrize("backend", BACKENDS)
def test_backends_agree_without_sets(backend, max_qps):
    Y = SCENARIO.simulate(4, 22).measurements

    def costs(name):
        return qpmhe.MovingHorizonEstimator(
            REACTOR, OBSERVER, COST, horizon=10, initial_state=[3.0, 0.0], backend=name,
            max_qps=max_qps, solver_tolerance=1e-9,
        ).run(Y).costs

    # ecos gives up before 1e-9; after one QP an error of d is one of the first order in J.
    reach = 1e-4 if backend == "ecos" else 1e-6
    np.testing.assert_allclose(costs(backend), costs("banded"), rtol=reach)


@pytest.fixture(scope="module")
def bounded_minima():
    """The reactor in a state box that binds: record, candidates' minima, how many bind."""
    lower, upper = np.array([0.0, 0.4]), np.array([3.6, 4.0])
    Y = SCENARIO.simulate(1, 22).measurements
    observer = qpmhe.MovingHorizonEstimator(
        REACTOR, OBSERVER, COST, horizon=6, initial_state=[3.0, 0.6], max_qps=0
    )
    minima, binding = [], 0
    for t, y in enumerate(Y):
        candidate = observer.update(y).candidate
        size = len(candidate)
        minimum, found = dense_minimum(
            candidate, Y[max(0, t - 5) : t + 1],
            bounds=(np.tile(lower, size), np.tile(upper, size)),
        )
        minima.append(minimum)
        binding += found.active_mask.any()
    assert binding > 10
    return qpmhe.Box(lower, upper), Y, minima


def in_box(box, **options):
    system = qpmhe.System(euler, lambda x: x[..., :1] + x[..., 1:], n=2, p=1, states=box)
    return qpmhe.MovingHorizonEstimator(
        system, OBSERVER, COST, horizon=6, initial_state=[3.0, 0.6], **options
    )


@pytest.mark.parametrize("backend", INEQUALITY_BACKENDS)
def test_convergence_in_a_state_box_is_the_dense_minimum(backend, bounded_minima):
    box, Y, minima = bounded_minima
    run = in_box(box, backend=backend, max_qps=None, solver_tolerance=1e-9).run(Y)
    assert run.share(qpmhe.Status.OBSERVER_PROJECTED) == 0.0
    np.testing.assert_allclose(run.costs, minima, rtol=1e-6)


@pytest.mark.parametrize("backend", INEQUALITY_BACKENDS)
def test_states_are_on_their_bounds_and_never_beyond(backend, bounded_minima):
    # At a loose tolerance too: iterates that miss the box are clipped into it, then judged.
    box, Y, minima = bounded_minima
    mhe = in_box(box, backend=backend, max_qps=3, solver_tolerance=1e-5)
    on_bound = 0
    for y, minimum in zip(Y, minima, strict=True):
        estimate = mhe.update(y)
        assert (estimate.trajectory >= box.lower).all()
        assert (estimate.trajectory <= box.upper).all()
        on_bound += bool(
            np.isclose(estimate.trajectory, box.lower, atol=1e-4).any()
            or np.isclose(estimate.trajectory, box.upper, atol=1e-4).any()
        )
        assert estimate.cost == pytest.approx(minimum, rel=1e-2)
    assert on_bound >= 8


class Rows:
    """A linear system with boxes on w and v that bind: P_t is itself a convex QP."""

    A = np.array([[1.0, 0.1], [-0.1, 0.95]])
    HORIZON = 6

    def __init__(self):
        rng = np.random.default_rng(0)
        x, Y = np.array([1.0, 0.0]), []
        for _ in range(22):
            Y.append(x[:1] + np.clip(0.2 * rng.standard_normal(1), -0.4, 0.4))
            x = self.A @ x + np.clip(0.1 * rng.standard_normal(2), -0.05, 0.05)
        self.Y = np.array(Y)
        A = self.A
        self.system = qpmhe.System(
            lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1,
            disturbances=qpmhe.Box([-0.05, -0.05], [0.05, 0.05]), noises=qpmhe.Box(-0.4, 0.4),
        )
        self.minima = [self._minimum(e) for e in self.estimates("auto", max_qps=0)]

    def estimates(self, backend, **options):
        cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=100 * np.eye(2), noise=25.0)
        mhe = qpmhe.MovingHorizonEstimator(
            self.system, qpmhe.Luenberger([0.04, 0.02]), cost, horizon=self.HORIZON,
            initial_state=[0.9, 0.0], backend=backend, **options,
        )
        return [mhe.update(y) for y in self.Y]

    def _minimum(self, estimate):
        """By cvxpy; NaN where it is above the cost of a candidate outside of the sets."""
        import cvxpy

        size = len(estimate.candidate) - 1
        Y = self.Y[estimate.time + 1 - size : estimate.time + 1]
        x = cvxpy.Variable((size + 1, 2))
        w, v = x[1:] - x[:-1] @ self.A.T, Y - x[:-1, :1]
        J = (
            cvxpy.sum_squares(x[0] - estimate.candidate[0])
            + 100 * cvxpy.sum_squares(w) + 25 * cvxpy.sum_squares(v)
        )
        problem = cvxpy.Problem(
            cvxpy.Minimize(J), [cvxpy.abs(w) <= 0.05, cvxpy.abs(v) <= 0.4]
        )
        problem.solve(
            solver=cvxpy.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12
        )
        return problem.value if problem.value <= estimate.candidate_cost else np.nan


@pytest.fixture(scope="module")
def rows():
    case = Rows()
    free = np.array([e.cost for e in case.estimates("banded", max_qps=1)])
    known = ~np.isnan(case.minima)
    assert known.sum() > 10
    # Rows bind: the unconstrained minimiser is no estimate, so what banded reaches is worse.
    assert (free[known] > np.array(case.minima)[known] * 1.01).sum() >= 5
    return case


@pytest.mark.parametrize("max_qps", [1, 2])
@pytest.mark.parametrize("backend", INEQUALITY_BACKENDS)
def test_backends_agree_where_rows_bind(backend, max_qps, rows):
    estimates = rows.estimates(backend, max_qps=max_qps, solver_tolerance=1e-10)
    for estimate, minimum in zip(estimates, rows.minima, strict=True):
        if not np.isnan(minimum):
            assert estimate.cost == pytest.approx(minimum, rel=1e-6)


@pytest.mark.parametrize("backend", INEQUALITY_BACKENDS)
def test_the_default_tolerance_is_enough_where_rows_bind(backend, rows):
    # Iterates miss the rows by about the solver's tolerance: that must not cost half a step.
    for estimate, minimum in zip(rows.estimates(backend, max_qps=1), rows.minima, strict=True):
        if not np.isnan(minimum):
            assert estimate.cost == pytest.approx(minimum, rel=1e-3)
