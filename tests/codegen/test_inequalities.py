"""The solver of QPs with inequalities in C, against PIQP on random QPs."""

import functools

import numpy as np
import pytest

from qpmhe.codegen.compiler import find_compiler
from tests.oracles.window_qps import SOLVED, CSolver, random_qp

piqp = pytest.importorskip("piqp")
pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

# States, outputs, samples; for W, V and X: no set, or its number of general inequalities.
SHAPES = {
    "all": (2, 1, 6, (2, 1, 2)), "V": (2, 2, 5, (None, 1, None)), "X": (2, 2, 5, (None, None, 3)),
    "boxes": (4, 2, 8, (0, 0, 0)),
    "eight": (8, 4, 10, (0, None, None)),  # where GCC 12.2 dropped stores of eight doubles
}
shapes = pytest.mark.parametrize("shape", SHAPES)
solver_of = functools.cache(lambda shape: CSolver(*SHAPES[shape], "double"))


def drawn(shape, seed, tight, *shares, count=10):
    """Random QPs of a shape."""
    rng = np.random.default_rng([seed, int(1000 * tight)])
    return [random_qp(rng, *SHAPES[shape], tight, *shares) for _ in range(count)]


def reference(qp):
    """The objective of the solution by another solver, in rows of deviations."""
    H, g, rows, low, high, scale = qp.dense()
    rows, low, high = rows / scale[:, None], low / scale, high / scale
    solver, equal = piqp.DenseSolver(), low == high
    for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
        setattr(solver.settings, name, 1e-12)
    solver.setup(H, g, rows[equal], low[equal], rows[~equal], low[~equal], high[~equal], None, None)
    assert solver.solve() == piqp.Status.PIQP_SOLVED
    return objective(qp, np.array(solver.result.x))


def objective(qp, d):
    H, g, *_ = qp.dense()
    return d @ H @ d / 2 + g @ d


def is_best(qp, status, d, row=1e-9):
    """Check a solution against the reference; a row is missed by so much in its scale."""
    assert status == SOLVED
    _, _, rows, low, high, scale = qp.dense()
    assert np.max(np.maximum(low - rows @ d, rows @ d - high) / scale, initial=0.0) < row
    assert objective(qp, d) == pytest.approx(reference(qp), rel=1e-7, abs=1e-7)


@shapes
def test_random_qps_with_and_without_a_first_guess(shape):
    """The active set of another QP, or nonsense, is no worse than none but for its iterations."""
    solver, rng = solver_of(shape), np.random.default_rng(7)
    for tight in (3.0, 1.0, 0.3, 0.03, 0.001):
        for k, qp in enumerate(drawn(shape, 7, tight, 0.3)):
            is_best(qp, *solver(qp)[:2])
            share = (0.02, 0.1, 0.5)[k % 3]
            places = rng.choice([-1, 0, 1], solver.layout.rows, p=[share / 2, 1 - share, share / 2])
            is_best(qp, *solver(qp, limit=100, places=places.astype(np.int8))[:2])
        # Rows without width, many of them combinations of others, with and without limits.
        for shares in ((0.0, 0.5), (0.5, 0.0), (0.5, 0.9)):
            for qp in drawn(shape, 11, max(tight, 0.03), 0.3, *shares, count=3):
                is_best(qp, *solver(qp)[:2])


@shapes
def test_iterations_are_capped_and_counted(shape):
    solver = solver_of(shape)
    for qp in drawn(shape, 13, 0.1, 0.3, count=5):
        needed, best = solver(qp)[2], reference(qp)
        for limit in range(needed):
            status, d, iterations = solver(qp, limit=limit)
            assert iterations <= limit
            assert np.isfinite(d).all()
            assert limit or status != SOLVED
            # The iterations behind a solution only take its rounding off.
            if status == SOLVED:
                assert objective(qp, d) == pytest.approx(best, rel=1e-6, abs=1e-6)
        assert solver(qp, limit=needed)[::2] == (SOLVED, needed)
    (qp,) = drawn(shape, 14, 1e3, count=1)  # inactive rows cost no iteration
    assert solver(qp)[::2] == (SOLVED, 0)


@pytest.mark.parametrize(
    ("shape", "name"), [("all", "disturbances"), ("V", "noises"), ("X", "states")]
)
def test_rows_that_exclude_each_other(shape, name):
    """They end the iterations early, at a finite point."""
    for qp in drawn(shape, 15, 0.5, 0.0) + drawn(shape, 15, 0.5, 0.3):
        matrix, low, high = qp.sets[name]
        first = matrix.shape[1]
        matrix[first] = matrix[0]
        low[0], high[0], low[first], high[first] = -np.inf, 5.0, 10.0, np.inf
        status, d, iterations = solver_of(shape)(qp, limit=200)
        assert status != SOLVED
        assert np.isfinite(d).all()
        assert iterations <= 60


@shapes
@pytest.mark.parametrize("far", [1e12, 1e20, 1e150])
def test_a_far_side_is_none(shape, far):
    """Sides that are far away change nothing, as deviations count."""
    solver, rng = solver_of(shape), np.random.default_rng(8)
    for tight in (1.0, 0.03, 0.001):
        for qp in drawn(shape, 21, tight, 0.0) + drawn(shape, 22, tight, 0.0, 0.6):
            places = rng.choice([-1, 0, 1], solver.layout.rows).astype(np.int8)
            best = reference(qp)
            for name, (matrix, low, high) in qp.sets.items():
                sides = np.maximum(low, -far), np.minimum(high, far)
                qp.sets[name] = matrix, *sides
            for status, d, _ in (solver(qp), solver(qp, limit=100, places=places)):
                assert status == SOLVED
                assert objective(qp, d) == pytest.approx(best, rel=1e-7, abs=1e-7)
