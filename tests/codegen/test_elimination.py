"""The compiled step with directions that have no disturbance, by a Kalman filter in 60 digits."""

import mpmath
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import qpmhe
from qpmhe.codegen import compiler

pytestmark = pytest.mark.skipif(
    compiler.find_compiler() is None, reason="there is no C compiler"
)
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


def estimator(model, P, form="matrix", W=None, **options):
    A, C, G, q = model
    n, system, Q = len(A), {}, np.diag(q)
    if form == "matrix":
        system = {"disturbance_matrix": G}
    elif form == "covariance":
        Q = G @ Q @ G.T
    if W is not None:
        system["disturbances"] = W
    options = {"horizon": SAMPLES, "max_qps": 2, "engine": "compiled"} | options
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=n, p=len(C), **system),
        qpmhe.Luenberger(np.zeros((n, len(C)))),
        qpmhe.QuadraticCost.from_covariances(prior=P, disturbance=Q, noise=np.eye(len(C))),
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


@pytest.mark.parametrize("form", ["matrix", "covariance"])
@pytest.mark.parametrize("name", MODELS)
def test_a_prior_may_be_as_vague_as_it_likes(name, form):
    model, Y = MODELS[name], measured()
    for spread in (1.0, 1e3, 1e6, 1e10):
        P, scale = prior(model, spread)
        run = estimator(model, P, form).run(Y)
        error = np.abs(run.filtered - filtered(model, P, Y)) / scale
        assert error.max() <= 1e-11, spread
        assert all("IMPROVED" in reason for reason in run.reasons())


def test_a_window_that_moves_is_a_smoother_with_a_new_prior_each_time():
    """Python takes another factorisation; where the prior is not vague, both are exact."""
    model, Y = MODELS["seasonal"], measured()
    P, _ = prior(model, 10.0)
    runs = [estimator(model, P, horizon=7, engine=one).run(Y) for one in ("python", "compiled")]
    np.testing.assert_allclose(runs[1].filtered, runs[0].filtered, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(runs[1].costs, runs[0].costs, rtol=1e-9)


@pytest.mark.parametrize("spread", [1.0, 1e3, 1e6])
def test_active_bounds_of_disturbances_and_a_vague_prior(spread):
    """Bounded least squares in the initial state and the disturbances is another form of it."""
    A, C, G, q = model = MODELS["position"]
    Y, limit, count = measured(3), 0.003, SAMPLES
    run = estimator(
        model, spread**2 * np.eye(2), W=qpmhe.Box([-limit], [limit]), max_qps=5
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


@pytest.mark.parametrize("spread", [1.0, 1e3, 1e5])
def test_a_component_of_w_without_width_is_eliminated(spread):
    """It is one more way to have no disturbance there; the weight that it has does not matter."""
    A, Y = np.array([[1.0, 1.0], [0.0, 1.0]]), measured(5)
    same = A, np.array([[1.0, 0.0]]), np.array([[1.0], [0.0]]), [0.01]
    W = qpmhe.Box([-np.inf, 0.0], [np.inf, 0.0])
    boxed = A, same[1], np.eye(2), [0.01, 1.0]
    run = estimator(boxed, spread**2 * np.eye(2), form="box", W=W).run(Y)
    wanted = filtered(same, spread**2 * np.eye(2), Y)
    np.testing.assert_allclose(run.filtered, wanted, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("spread", [1.0, 1e3, 1e5])
def test_active_bounds_of_states_and_a_vague_prior(spread):
    """Python solves the optimality conditions with the equality rows in them."""
    A, C, G, q = MODELS["position"]
    runs = []
    for engine in ("python", "compiled"):
        mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(
                lambda x: x @ A.T, lambda x: x @ C.T, n=2, p=1, disturbance_matrix=G,
                states=qpmhe.Box([-np.inf, 0.2], [14.0, 0.3]),
            ),
            qpmhe.Luenberger(np.zeros((2, 1))),
            qpmhe.QuadraticCost.from_covariances(
                prior=spread**2 * np.eye(2), disturbance=[q], noise=np.eye(1)
            ),
            horizon=9, initial_state=[0.0, 0.25], engine=engine, max_qps=5,
        )
        runs.append(mhe.run(measured()))
    assert np.isclose(runs[0].filtered[:, 1], 0.3).any()
    np.testing.assert_allclose(runs[1].filtered, runs[0].filtered, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(runs[1].costs, runs[0].costs, rtol=1e-9)
