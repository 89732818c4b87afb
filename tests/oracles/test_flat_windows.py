"""Active rows beside directions that hardly count in J, against a dense active-set method."""

import functools

import mpmath as mp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from tests.oracles.window_qps import SOLVED, CSolver, random_qp

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
compiled = pytest.param("compiled", marks=needs_compiler)

A, C, NOISE = np.array([[1.0, 0.1], [0.0, 0.98]]), np.array([[1.0, 0.0]]), 0.1
LOW, DISTURBANCE, HORIZON = np.array([0.0, -0.2]), np.array([0.05, 0.1]), 10


def estimator(engine, ratio, units, kind, penalties=None, **options):
    """A linear model in units, which stays at its bounds; the prior has ``ratio`` noises."""
    of_A, of_C = units[:, None] * A / units, C / units
    low, open_end = LOW * units, np.full(2, np.inf)
    states = qpmhe.Box(low, open_end)
    if kind == "polytope":
        states = qpmhe.Polytope(-np.diag(1.0 / units), -LOW)
    if penalties is not None:
        linear, quadratic = penalties
        states = states.soften(linear=linear / units, quadratic=quadratic / units**2)
    system = qpmhe.System(
        lambda x: of_A @ x, lambda x: of_C @ x, n=2, p=1, states=states,
        disturbance_matrix=np.diag(units)[:, 1:] if kind == "matrix" else None,
    )
    kept = slice(1, 2) if kind == "matrix" else slice(None)
    scale = DISTURBANCE[kept] * (1.0 if kind == "matrix" else units)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.diag((ratio * NOISE * units) ** 2), disturbance=np.diag(scale**2),
        noise=[[NOISE**2]],
    )
    observer = qpmhe.Luenberger(np.array([[0.3], [0.1]]) * units[:, None])
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=HORIZON, initial_state=np.array([1.0, 0.0]) * units,
        engine=engine, **options,
    )


def terms_of(ratio, mean, Y):
    """The rows M and sides b of J = |M x - b|^2, without units."""
    count = len(Y)
    rows, sides = [], []

    def add(parts, side, deviation):
        row = np.zeros((count + 1, 2))
        for i, part in parts:
            row[i] += part
        rows.append(row.ravel() / deviation)
        sides.append(side / deviation)

    for j in range(2):
        add([(0, np.eye(2)[j])], mean[j], ratio * NOISE)
    for i, y in enumerate(Y):
        for j in range(2):
            add([(i + 1, np.eye(2)[j]), (i, -A[j])], 0.0, DISTURBANCE[j])
        add([(i, C[0])], y[0], NOISE)
    return np.array(rows), np.array(sides)


def best(ratio, mean, Y):
    """The least J of a window, without units, and where it is."""
    rows, sides = terms_of(ratio, mean, Y)
    scale = np.linalg.norm(rows, axis=0)
    found = lsq_linear(rows / scale, sides, (np.tile(LOW, len(Y) + 1) * scale, np.inf),
                       method="bvls", tol=1e-15, max_iter=1000)
    return 2.0 * found.cost, (found.x / scale).reshape(-1, 2)


@pytest.mark.parametrize("ratio", [1e10, 1.0, 1e6])
@pytest.mark.parametrize(("kind", "units", "limit"), [
    ("box", (1.0, 1.0), 1), ("polytope", (1e6, 1e-3), None), ("box", (1e-9, 1e4), None),
    ("polytope", (1.0, 1.0), 1),
])
@pytest.mark.parametrize("engine", [compiled, "python"])
def test_bounds_beside_a_vague_prior(engine, kind, units, limit, ratio):
    units, active = np.array(units), 0
    mhe = estimator(engine, ratio, units, kind, max_qps=limit)
    Y = 0.05 * np.random.default_rng(1).normal(size=(20, 1))
    for t, y in enumerate(Y):
        estimate = mhe.update(y)
        J, x = best(ratio, estimate.candidate[0] / units,
                    Y[t + 2 - len(estimate.trajectory) : t + 1])
        assert estimate.cost == pytest.approx(J, rel=1e-8, abs=1e-9)
        active += (np.abs(x - LOW) < 1e-9).any()
    assert active > 10


@needs_compiler
@pytest.mark.parametrize("ratio", [1e10, 1e4])
def test_bounds_beside_a_vague_prior_with_a_disturbance_matrix(ratio):
    Y, iterations = 0.05 * np.random.default_rng(1).normal(size=(20, 1)), 0
    one, other = (estimator(engine, ratio, np.ones(2), "matrix", max_qps=None)
                  for engine in ("python", "compiled"))
    for y in Y:
        expected, estimate = one.update(y), other.update(y)
        assert estimate.cost == pytest.approx(expected.cost, rel=1e-9, abs=1e-9)
        assert (estimate.trajectory > LOW - 1e-9).all()
        iterations += estimate.solver_iterations
    assert iterations > 10


def exact(qp, d):
    """The solution with the active rows of d, and its objective, to 50 digits."""
    _, _, rows, low, high, scale = qp.dense()
    sides = np.stack((low, high), axis=1)
    near = np.abs((rows @ d)[:, None] - sides) < 1e-6 * scale[:, None]
    active = [(rows[i], sides[i, side], 2 * side - 1) for i, side in np.argwhere(near)]
    size, matrix = len(d), lambda array: mp.matrix(np.atleast_2d(array).tolist())
    H, g = mp.zeros(size), mp.zeros(size, 1)
    w, v, x = qp.residual_matrix()
    terms = [(x[0], qp.P, qp.x[0] - qp.prior), *zip(w, [qp.Q] * len(w), qp.w, strict=True),
             *zip(v, [qp.R] * len(v), qp.v, strict=True)]
    for slope, weight, value in terms:
        weighed = matrix(slope).T * matrix(weight)
        H, g = H + weighed * matrix(slope), g + weighed * matrix(value).T
    while True:
        count = size + len(active)
        K, side = mp.zeros(count), mp.zeros(count, 1)
        K[:size, :size], side[:size, 0] = H, -g
        for at, (row, limit, _) in enumerate(active, size):
            K[at, :size], side[at] = matrix(row), mp.mpf(limit)
            K[:size, at] = matrix(row).T
        found = mp.lu_solve(K, side)
        forces = [found[size + a] * sign for a, (_, _, sign) in enumerate(active)]
        if not forces or min(forces) >= 0:
            return np.array([float(one) for one in found[:size]]), len(active)
        active.pop(int(np.argmin([float(one) for one in forces])))


solver_of = functools.cache(lambda *shape: CSolver(*shape))


@needs_compiler
@pytest.mark.parametrize("flat", [1e10, 1.0, 1e6, 1e8])
def test_active_rows_cost_no_digits(flat):
    """A direction that counts little: it is as exact as a dense factorisation leaves it."""
    shape, rng, active = (2, 2, 6, (0, 0, None)), np.random.default_rng(5), 0
    for _ in range(12):
        qp = random_qp(rng, *shape, 0.3, 0.0, 0.3, 0.0)
        axis = np.linalg.qr(rng.normal(size=(2, 2)))[0][0]
        qp.P /= flat
        qp.A[:] = np.eye(2) + 0.05 * rng.normal(size=(2, 2)) @ (np.eye(2) - np.outer(axis, axis))
        qp.C[:] = qp.C @ (np.eye(2) - np.outer(axis, axis))
        status, d, _ = solver_of(*shape)(qp)
        if status != SOLVED:
            continue
        with mp.workdps(50):
            x, count = exact(qp, d)
        active += count > 0
        H = qp.dense()[0]
        lost = np.finfo(float).eps * np.linalg.cond(H / np.sqrt(np.outer(*[np.diag(H)] * 2)))
        assert np.abs(d - x).max() < (1e-10 + 10.0 * lost) * np.abs(x).max()
    assert active > 5


@pytest.mark.parametrize("engine", ["python", "compiled"])
@pytest.mark.parametrize("ratio", [1e10, 1e6, 1e3])
@pytest.mark.parametrize(("linear", "quadratic"), [(50.0, 0.0), (0.5, 0.0), (5.0, 2.0)])
@pytest.mark.parametrize("units", [(1.0, 1.0), (1e6, 1e-3)])
def test_soft_bounds_beside_a_vague_prior(units, linear, quadratic, ratio, engine):
    piqp = pytest.importorskip("piqp")
    units, missed = np.array(units), 0
    mhe = estimator(engine, ratio, units, "box", max_qps=None, penalties=(linear, quadratic))
    Y = 0.05 * np.random.default_rng(1).normal(size=(20, 1)) - 0.05
    for t, y in enumerate(Y):
        estimate = mhe.update(y)
        rows, sides = terms_of(ratio, estimate.candidate[0] / units,
                               Y[t + 2 - len(estimate.trajectory) : t + 1])
        size, solver = rows.shape[1], piqp.DenseSolver()
        for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
            setattr(solver.settings, name, 1e-12)
        # In x and in its misses, which are not negative.
        H = np.diag(np.repeat([0.0, 2.0 * quadratic], size))
        H[:size, :size] = 2.0 * rows.T @ rows
        low, eye = np.tile(LOW, size // 2), np.eye(size)
        solver.setup(
            H, np.append(-2.0 * rows.T @ sides, np.full(size, linear)), None, None,
            np.hstack((eye, eye)), low, np.full(size, np.inf),
            np.append(np.full(size, -np.inf), np.zeros(size)), np.full(2 * size, np.inf),
        )
        assert solver.solve() == piqp.Status.PIQP_SOLVED
        x = solver.result.x[:size]
        misses = np.maximum(low - x, 0.0)
        J = np.sum((rows @ x - sides) ** 2) + misses @ (linear + quadratic * misses)
        assert estimate.cost <= J * (1.0 + 1e-9)
        # The interior point of C stops short of its tolerance once, at this J.
        ended = qpmhe.Status.NO_DECREASE if engine == "compiled" else qpmhe.Status.CONVERGED
        assert estimate.status & (qpmhe.Status.CONVERGED | ended)
        missed += misses.max() > 1e-6
    assert missed > (5 if linear < 50.0 else -1)
