"""Directions that have no disturbance, in both engines, by a Kalman filter in 60 digits."""

import mpmath
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import qpmhe
from qpmhe.codegen import compiler

ENGINES = ["python", pytest.param("compiled", marks=pytest.mark.skipif(
    compiler.find_compiler() is None, reason="there is no C compiler"
))]
SAMPLES = 16


def seasonal(period=5):
    """A level and a season whose sum over a period is zero but for noise."""
    n = period
    A, C, G = np.zeros((n, n)), np.zeros((1, n)), np.zeros((n, 2))
    A[0, 0], A[1, 1:], A[2:, 1:-1] = 1.0, -1.0, np.eye(n - 2)
    C[0, :2] = G[0, 0] = G[1, 1] = 1.0
    return A, C, G, [0.1, 0.05]


POSITION = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
UNIT = np.diag([1e6, 1e-7])
MODELS = {
    "position": (POSITION[0], np.array([[1.0, 0.0]]), POSITION[1], [0.01]),
    "odd units": (
        UNIT @ POSITION[0] @ np.linalg.inv(UNIT), np.array([[1e-6, 0.0]]), UNIT @ POSITION[1],
        [0.01],
    ),
    "not along an axis": (
        np.array([[1.0, 0.3], [-0.2, 0.9]]), np.array([[1.0, 2.0]]), POSITION[1], [0.01]
    ),
    "hardly a disturbance": (
        np.array([[1.1, 0.2], [0.0, 0.95]]), np.array([[1.0, 1.0]]), np.ones((2, 1)), [1e-12]
    ),
    "singular A": (
        np.array([[0.9, 0.1, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
        np.array([[0.3, 0.2, 1.0]]), np.array([[1.0], [0.0], [0.0]]), [0.1],
    ),
    "seasonal": seasonal(),
}


def measured(seed=0):
    rng = np.random.default_rng(seed)
    return (10.0 + 0.3 * np.arange(SAMPLES) + rng.standard_normal(SAMPLES))[:, None]


def filtered(model, P, Y):
    """The Kalman filter's estimates after each measurement."""
    A, C, G, q = model
    with mpmath.workdps(60):
        A, C, P = (mpmath.matrix(one.tolist()) for one in (A, C, P))
        directions = mpmath.matrix(G.tolist())
        Q = directions * mpmath.diag(q) * directions.T
        x, found = mpmath.zeros(A.rows, 1), []
        for y in Y:
            gain = P * C.T * (C * P * C.T + mpmath.eye(C.rows)) ** -1
            x += gain * (mpmath.matrix(y.tolist()) - C * x)
            P -= gain * C * P
            found.append([float(value) for value in x])
            x, P = A * x, A * P * A.T + Q
    return np.array(found)


def estimator(model, P, form="matrix", W=None, observed=False, **options):
    """A window of all samples; or, with an EKF's covariance as its prior, any one."""
    A, C, G, q = model
    n, system, Q = len(A), {}, np.diag(q)
    if form == "matrix":
        system = {"disturbance_matrix": G}
    elif form == "covariance":
        Q = G @ Q @ G.T
    if W is not None:
        system["disturbances"] = W
    options = {"horizon": SAMPLES, "max_qps": 2} | options
    given, observer, first = {"disturbance": Q, "noise": np.eye(len(C))}, None, P
    if observed:
        observer = qpmhe.ExtendedKalman(prior=P, **given)
        first = qpmhe.ObserverPrior(kappa=1e30)
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=n, p=len(C), **system),
        observer or qpmhe.Luenberger(np.zeros((n, len(C)))),
        qpmhe.QuadraticCost.from_covariances(prior=first, **given),
        initial_state=np.zeros(n), **options,
    )
    assert mhe.engine == options["engine"]
    return mhe


def prior(model, spread):
    """As vague in the unit of each state, as its share in the measurements shows."""
    scale = np.ones(len(model[0]))
    if model is MODELS["odd units"]:
        scale = UNIT.diagonal()
    return np.diag((spread * scale) ** 2), scale


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("form", ["matrix", "covariance"])
@pytest.mark.parametrize("name", MODELS)
def test_a_prior_may_be_as_vague_as_it_likes(name, form, engine):
    model, Y = MODELS[name], measured()
    for spread in (1.0, 1e3, 1e6, 1e10):
        P, scale = prior(model, spread)
        run = estimator(model, P, form, engine=engine).run(Y)
        error = np.abs(run.filtered - filtered(model, P, Y)) / scale
        assert error.max() <= 1e-11, spread
        assert all("IMPROVED" in reason for reason in run.reasons())


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("horizon", [1, 2, 5])
@pytest.mark.parametrize("name", MODELS)
def test_windows_whose_prior_is_an_ekfs_are_the_kalman_filter(name, horizon, engine):
    """The observer has covariances of up to 2^26, and beyond them roots of its covariance."""
    model, Y = MODELS[name], measured()
    for spread in (1.0, 1e3, 1e6, 1e8, 1e10):
        P, scale = prior(model, spread)
        run = estimator(model, P, observed=True, horizon=horizon, engine=engine).run(Y)
        error = np.abs(run.filtered - filtered(model, P, Y)) / scale
        # The root that the observer has is exact to 5e-6 of the deviations there.
        known = 5e-6 if name == "seasonal" and horizon < 5 else 1e-8
        assert error.max() <= (known if spread > 1e6 else 1e-8), spread


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("horizon", [1, 3, 5])
def test_a_chain_of_integrators_in_the_shortest_windows(horizon, engine):
    """Only its last state is disturbed; with N = 1, J was 9e4 where 0.9 is the least."""
    A = np.eye(4) + np.eye(4, k=1)
    model = A, np.eye(4)[:1], np.eye(4)[:, 3:], [0.01]
    for spread in (1.0, 1e4, 1e8, 1e10):
        P, Y = spread**2 * np.eye(4), measured()
        run = estimator(model, P, observed=True, horizon=horizon, engine=engine).run(Y)
        assert np.abs(run.filtered - filtered(model, P, Y)).max() <= 1e-8, spread
        assert run.costs.max() < 70.0


def test_a_window_that_moves_is_a_smoother_with_a_new_prior_each_time():
    """Both engines find it."""
    if compiler.find_compiler() is None:
        pytest.skip("there is no C compiler")
    model, Y = MODELS["seasonal"], measured()
    P, _ = prior(model, 10.0)
    runs = [estimator(model, P, horizon=7, engine=one).run(Y) for one in ("python", "compiled")]
    np.testing.assert_allclose(runs[1].filtered, runs[0].filtered, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(runs[1].costs, runs[0].costs, rtol=1e-9)


SOLVERS = [
    pytest.param(engine, backend, marks=marks)
    for engine, backend, marks in (
        *(("python", name, ()) for name in qpmhe.solvers.available() if name != "banded"),
        ("compiled", "auto", ENGINES[1].marks),
    )
]


@pytest.mark.parametrize(("engine", "backend"), SOLVERS)
@pytest.mark.parametrize("spread", [1.0, 1e3, 1e6, 1e10])
def test_active_bounds_of_disturbances_and_a_vague_prior(spread, engine, backend):
    """Bounded least squares in the initial state and the disturbances is another form of it."""
    A, C, G, q = model = MODELS["position"]
    Y, limit, count = measured(3), 0.003, SAMPLES
    run = estimator(
        model, spread**2 * np.eye(2), W=qpmhe.Box([-limit], [limit]), max_qps=5, engine=engine,
        backend=backend,
    ).run(Y)
    for t in (3, 8, count - 1):
        size = 2 + t
        states, rows = np.eye(2, size), [np.eye(2, size) / spread]
        for i in range(t + 1):
            rows.append(C @ states)
            if i < t:
                states = A @ states + G @ np.eye(size)[2 + i : 3 + i]
        rows.append(np.eye(size)[2:] / np.sqrt(q[0]))
        free = np.full(2, np.inf)
        box = np.append(-free, np.full(t, -limit)), np.append(free, np.full(t, limit))
        side = np.concatenate((np.zeros(2), Y[: t + 1, 0], np.zeros(t)))
        best = lsq_linear(np.vstack(rows), side, box, method="bvls", tol=1e-14)
        assert best.active_mask.any() or t < count - 1
        np.testing.assert_allclose(run.filtered[t], states @ best.x, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("spread", [1.0, 1e3, 1e5, 1e10])
def test_a_component_of_w_without_width_is_eliminated(spread, engine):
    """It is one more way to have no disturbance there; the weight that it has does not matter."""
    A, Y = np.array([[1.0, 1.0], [0.0, 1.0]]), measured(5)
    same = A, np.array([[1.0, 0.0]]), np.array([[1.0], [0.0]]), [0.01]
    W = qpmhe.Box([-np.inf, 0.0], [np.inf, 0.0])
    boxed = A, same[1], np.eye(2), [0.01, 1.0]
    run = estimator(boxed, spread**2 * np.eye(2), form="box", W=W, engine=engine).run(Y)
    wanted = filtered(same, spread**2 * np.eye(2), Y)
    np.testing.assert_allclose(run.filtered, wanted, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("spread", [1.0, 1e3, 1e5, 1e10])
def test_active_bounds_of_states_and_a_vague_prior(spread):
    """With three backends and in C, each by its own method."""
    A, C, G, q = MODELS["position"]
    runs = []
    for engine, backend in (("python", "daqp"), ("python", "clarabel"), ("python", "quadprog"),
                            ("compiled", "auto")):
        if engine == "compiled" and compiler.find_compiler() is None:
            continue
        mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(
                lambda x: x @ A.T, lambda x: x @ C.T, n=2, p=1, disturbance_matrix=G,
                states=qpmhe.Box([-np.inf, 0.2], [14.0, 0.3]),
            ),
            qpmhe.Luenberger(np.zeros((2, 1))),
            qpmhe.QuadraticCost.from_covariances(
                prior=spread**2 * np.eye(2), disturbance=[q], noise=np.eye(1)
            ),
            horizon=9, initial_state=[0.0, 0.25], engine=engine, backend=backend, max_qps=5,
        )
        runs.append(mhe.run(measured()))
    assert np.isclose(runs[0].filtered[:, 1], 0.3).any()
    for run in runs[1:]:
        np.testing.assert_allclose(run.filtered, runs[0].filtered, rtol=0.0, atol=1e-4)
        np.testing.assert_allclose(run.costs, runs[0].costs, rtol=1e-6)
    np.testing.assert_allclose(runs[-1].filtered, runs[0].filtered, rtol=0.0, atol=1e-9)


SOFT = {
    "states": {"states": qpmhe.Box([-np.inf, 0.2], [14.0, 0.3]).soften(linear=0.1, quadratic=5.0)},
    "disturbances": {"disturbances": qpmhe.Box([-0.003], [0.003]).soften(linear=50.0)},
    "constraint": {"constraints": [
        qpmhe.Constraint(lambda x: 0.05 * (x[0] - 10.0) ** 2 + 4.0 * x[1] ** 2 - 0.6, linear=5.0)
    ]},
    "hard constraint": {"constraints": [
        qpmhe.Constraint(lambda x: 0.05 * (x[0] - 10.0) ** 2 + 4.0 * x[1] ** 2 - 0.6)
    ]},
}


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("rows", SOFT)
@pytest.mark.parametrize("spread", [1.0, 1e3, 1e10])
def test_soft_rows_and_curved_constraints_beside_a_vague_prior(spread, rows):
    """Slack variables and the curvature of constraints join the QP without these directions.

    In C, rows that are missed pull with a constant force, and the curvature is more rows of it.
    """
    A, C, G, q = MODELS["position"]
    runs, free = [], None
    for engine, backend in (("python", "daqp"), ("python", "quadprog"), ("python", "clarabel"),
                            ("compiled", "auto")):
        if engine == "compiled" and compiler.find_compiler() is None:
            continue
        for sets in (SOFT[rows], {}) if free is None else (SOFT[rows],):
            mhe = qpmhe.MovingHorizonEstimator(
                qpmhe.System(
                    lambda x: x @ A.T, lambda x: x @ C.T, n=2, p=1, disturbance_matrix=G, **sets
                ),
                qpmhe.Luenberger(np.zeros((2, 1))),
                qpmhe.QuadraticCost.from_covariances(
                    prior=spread**2 * np.eye(2), disturbance=[q], noise=np.eye(1)
                ),
                horizon=9, initial_state=[0.0, 0.25], backend=backend, max_qps=6, engine=engine,
            )
            run = mhe.run(measured())
            if sets:
                runs.append(run)
            else:
                free = run
    assert np.abs(runs[0].filtered - free.filtered).max() > 1e-2
    for run in runs[1:]:
        np.testing.assert_allclose(run.costs, runs[0].costs, rtol=1e-5)
        np.testing.assert_allclose(run.filtered, runs[0].filtered, rtol=0.0, atol=1e-3)


# Of the first state and the first disturbance: sides, linear and quadratic penalties.
PENALTIES = {
    "states": ([(10.0, 0.4, 0.0)], []),
    "both penalties": ([(11.0, 0.4, 2.0)], [(0.004, 20.0, 3e3)]),
    "squares": ([(11.0, 0.0, 30.0)], [(0.004, 0.0, 3e4)]),
    "disturbances": ([], [(0.004, 30.0, 0.0)]),
    "equations": ([(11.0, 0.4, 0.0)], [(0.0, 30.0, 0.0)]),
}


def soft_sets(name, model, scale):
    states, disturbances = PENALTIES[name]
    n, r = model[2].shape
    sets = {}
    if states:
        upper, linear, quadratic = states[0]
        side = np.full(n, np.inf)
        side[0] = upper * scale[0]
        sets["states"] = qpmhe.Box(-np.inf * np.ones(n), side).soften(
            linear=linear / scale[0], quadratic=quadratic / scale[0] ** 2
        )
    if disturbances:
        limit, linear, quadratic = disturbances[0]
        side = np.full(r, np.inf)
        side[0] = limit
        sets["disturbances"] = qpmhe.Box(-side, side).soften(linear=linear, quadratic=quadratic)
    return sets


def unbalanced(name, model, P, scale, Y, trajectory):
    """The force on the first state and the disturbances that no subgradient of J balances.

    Dense, in these unknowns alone, as a share of the largest force.
    """
    A, C, G, q = model
    n, r = G.shape
    count, size = len(trajectory) - 1, n + (len(trajectory) - 1) * r
    at, moves, rows = np.eye(n, size), [np.eye(n, size)], []
    for i in range(count):
        at = A @ at + G @ np.eye(size)[n + r * i : n + r * (i + 1)]
        moves.append(at)
    noises = np.array(Y[:count]) - trajectory[:-1] @ C.T
    d = np.linalg.lstsq(G, (trajectory[1:] - trajectory[:-1] @ A.T).T, rcond=None)[0].T
    z = np.append(trajectory[0], d)
    units = np.append(np.sqrt(P.diagonal()), np.tile(np.sqrt(q), count))
    force = z / units**2 + sum(-moves[i].T @ C.T @ noises[i] for i in range(count))
    sizes = np.abs(noises) + 1e-6 * np.abs(Y[:count])  # rounding is a share of these
    largest = np.abs(z / units**2) + sum(np.abs(moves[i].T @ C.T) @ sizes[i] for i in range(count))
    states, disturbances = PENALTIES[name]
    for upper, linear, quadratic in states:
        for i in range(count + 1):
            value = trajectory[i, 0] / scale[0]
            rows.append((moves[i][0] / scale[0], value - upper, linear, quadratic, 1.0))
    for limit, linear, quadratic in disturbances:
        for i in range(count):
            for sign in (1.0, -1.0):
                row = sign * np.eye(size)[n + r * i]
                rows.append((row, sign * d[i, 0] - limit, linear, quadratic, q[0] ** 0.5))
    held, most, violated = [], [], 0
    for row, missed, linear, quadratic, unit in rows:
        if abs(missed) <= 1e-9 * unit * (1.0 + 1e3 * (unit == 1.0)):
            if linear:
                held.append(row)
                most.append(linear / 2.0)
        elif missed > 0.0:
            violated += 1
            force = force + row * (linear / 2.0 + quadratic * missed)
    # In the units of what data and prior say about each unknown.
    seen = sum((C @ moves[i]).T @ (C @ moves[i]) for i in range(count)).diagonal()
    spread = 1.0 / np.sqrt(1.0 / units**2 + seen)
    left = force * spread
    if held:
        matrix = (np.array(held) * spread).T
        left = matrix @ lsq_linear(matrix, -left, (0.0, np.array(most)), tol=1e-14).x + left
    return np.abs(left).max() / (largest * spread).max(), violated, len(held)


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", PENALTIES)
@pytest.mark.parametrize("of", ["position", "odd units", "seasonal"])
def test_a_subgradient_of_soft_rows_balances_a_vague_prior(of, name, engine):
    """The conditions of a minimum, dense, in the first state and the disturbances alone."""
    model, Y, times = MODELS[of], measured(3), (4, 8)
    A, C, G, q = model
    for spread in (1.0, 1e3, 1e6, 1e10):
        P, scale = prior(model, spread)
        mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(
                lambda x: x @ A.T, lambda x: x @ C.T, n=len(A), p=1, disturbance_matrix=G,
                **soft_sets(name, model, scale),
            ),
            qpmhe.Luenberger(np.zeros((len(A), 1))),
            qpmhe.QuadraticCost.from_covariances(
                prior=P, disturbance=np.diag(q), noise=np.eye(1)
            ),
            horizon=9, initial_state=np.zeros(len(A)), engine=engine, max_qps=5,
        )
        rows = [0, 0]
        for t in range(max(times) + 1):
            estimate = mhe.update(Y[t])
            if t not in times:
                continue
            left, *counts = unbalanced(name, model, P, scale, Y, estimate.trajectory)
            assert left <= 1e-9, (spread, t)
            rows = np.add(rows, counts)
        assert sum(rows) > 0
