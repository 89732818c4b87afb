"""The solver of QPs with inequalities in C, against PIQP on random QPs."""

import functools

import numpy as np
import pytest
from oracles.window_qps import SOLVED, CSolver, random_qp

from qpmhe.codegen.compiler import find_compiler

piqp = pytest.importorskip("piqp")
pytest.importorskip("casadi")
pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

# States, outputs, samples; for W, V and X: no set, or its number of general inequalities.
SHAPES = {
    "all": (2, 1, 6, (2, 1, 2)), "W": (3, 2, 8, (0, None, None)), "V": (2, 2, 5, (None, 1, None)),
    "X": (2, 2, 5, (None, None, 3)), "boxes": (4, 2, 8, (0, 0, 0)),
    "eight": (8, 4, 10, (0, None, None)),  # where GCC 12.2 dropped stores of eight doubles
}
shapes = pytest.mark.parametrize("shape", SHAPES)
solver_of = functools.cache(lambda shape, real="double": CSolver(*SHAPES[shape], real))


def reference(qp, nearest=False):
    """The solution by another solver, in rows of deviations."""
    H, g, rows, low, high, scale = qp.dense()
    g = np.zeros_like(g) if nearest else g
    rows, low, high = rows / scale[:, None], low / scale, high / scale
    solver, equal = piqp.DenseSolver(), low == high
    for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
        setattr(solver.settings, name, 1e-12)
    solver.setup(H, g, rows[equal], low[equal], rows[~equal], low[~equal], high[~equal], None, None)
    assert solver.solve() == piqp.Status.PIQP_SOLVED
    return np.array(solver.result.x)


def objective(qp, d):
    H, g, *_ = qp.dense()
    return d @ H @ d / 2 + g @ d


def missed(qp, d):
    """The largest miss of a row in its scale."""
    _, _, rows, low, high, scale = qp.dense()
    return np.max(np.maximum(low - rows @ d, rows @ d - high) / scale, initial=0.0)


def is_best(qp, status, d, row=1e-9):
    """Check a solution against the reference."""
    assert status == SOLVED
    assert missed(qp, d) < row
    assert objective(qp, d) == pytest.approx(objective(qp, reference(qp)), rel=1e-7, abs=1e-7)


@shapes
def test_random_qps_with_and_without_a_first_guess(shape):
    """The active set of another QP, or nonsense, is no worse than none but for its iterations."""
    solver = solver_of(shape)
    for tight in (3.0, 1.0, 0.3, 0.03, 0.001):
        rng = np.random.default_rng([7, int(1000 * tight)])
        for k in range(10):
            qp = random_qp(rng, *SHAPES[shape], tight, 0.3 * (k % 3 == 0))
            is_best(qp, *solver(qp)[:2])
            share = (0.02, 0.1, 0.5)[k % 3]
            places = rng.choice([-1, 0, 1], solver.layout.rows, p=[share / 2, 1 - share, share / 2])
            is_best(qp, *solver(qp, limit=100, places=places.astype(np.int8))[:2])


@shapes
def test_equations_and_repeated_rows(shape):
    """Rows without width, many of them combinations of others, with and without limits."""
    rng, solver = np.random.default_rng(11), solver_of(shape)
    for tight in (1.0, 0.3, 0.03):
        for _ in range(10):
            shares = rng.choice([0.0, 0.5]), rng.choice([0.0, 0.5, 0.9])
            qp = random_qp(rng, *SHAPES[shape], tight, 0.3, *shares)
            is_best(qp, *solver(qp)[:2])


@shapes
def test_no_unit_matters(shape):
    rng, (n, p, *_) = np.random.default_rng(12), SHAPES[shape]
    for equal in (0.0, 0.3):
        for _ in range(10):
            qp = random_qp(rng, *SHAPES[shape], 10 ** rng.uniform(-2, 0.5), equal)
            of_x, of_y = (10.0 ** rng.integers(-9, 10, size) for size in (n, p))
            status, d, _ = solver_of(shape)(qp.in_units(of_x, of_y))
            is_best(qp, status, (d.reshape(-1, n) / of_x).ravel(), 1e-8)


@shapes
def test_iterations_are_capped_and_counted(shape):
    rng, solver = np.random.default_rng(13), solver_of(shape)
    for _ in range(10):
        qp = random_qp(rng, *SHAPES[shape], 0.1, 0.3)
        needed, best = solver(qp)[2], objective(qp, reference(qp))
        for limit in range(needed):
            status, d, iterations = solver(qp, limit=limit)
            assert iterations <= limit
            assert np.isfinite(d).all()
            assert limit or status != SOLVED
            # The iterations behind a solution only take its rounding off.
            if status == SOLVED:
                assert objective(qp, d) == pytest.approx(best, rel=1e-6, abs=1e-6)
        assert solver(qp, limit=needed)[::2] == (SOLVED, needed)


def test_inactive_rows_cost_no_iteration():
    qp = random_qp(np.random.default_rng(14), *SHAPES["boxes"], 1e3)
    status, d, iterations = solver_of("boxes")(qp)
    assert (status, iterations) == (SOLVED, 0)
    H, g, *_ = qp.dense()
    np.testing.assert_allclose(H @ d, -g, atol=1e-9)


@pytest.mark.parametrize(
    ("shape", "name"), [("all", "disturbances"), ("V", "noises"), ("X", "states")]
)
@pytest.mark.parametrize("equal", [0.0, 0.3])
def test_rows_that_exclude_each_other(shape, name, equal):
    """They end the iterations early, at a finite point."""
    rng, solver = np.random.default_rng(15), solver_of(shape)
    for _ in range(20):
        qp = random_qp(rng, *SHAPES[shape], 0.5, equal)
        matrix, low, high = qp.sets[name]
        first = matrix.shape[1]
        matrix[first] = matrix[0]
        low[0], high[0], low[first], high[first] = -np.inf, 5.0, 10.0, np.inf
        status, d, iterations = solver(qp, limit=200)
        assert status != SOLVED
        assert np.isfinite(d).all()
        assert iterations <= 60


@shapes
def test_the_nearest_point_in_the_rows(shape):
    """Its metric is the Hessian: the same QP without a gradient."""
    rng, solver = np.random.default_rng(16), solver_of(shape)
    for _ in range(10):
        qp = random_qp(rng, *SHAPES[shape], 0.1)
        status, d, _ = solver(qp, nearest=True)
        assert status == SOLVED
        assert missed(qp, d) < 1e-8
        H, best = qp.dense()[0], reference(qp, nearest=True)
        assert d @ H @ d == pytest.approx(best @ H @ best, rel=1e-7, abs=1e-9)


@shapes
def test_single_precision(shape):
    rng, solver = np.random.default_rng(17), solver_of(shape, "float")
    for _ in range(10):
        qp = random_qp(rng, *SHAPES[shape], 0.3)
        status, d, _ = solver(qp, tolerance=1e-4)
        H, best = qp.dense()[0], reference(qp)
        assert status == SOLVED
        assert missed(qp, d) < 1e-4
        assert objective(qp, d) <= objective(qp, best) + 1e-2 * (1.0 + best @ H @ best)
