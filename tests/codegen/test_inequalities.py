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


def reference(qp):
    """The solution by another solver, in rows of deviations."""
    H, g, rows, low, high, scale = qp.dense()
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


def solves(solver, qp, **options):
    """Check a solution against the reference."""
    status, d, _ = solver(qp, **options)
    best = objective(qp, reference(qp))
    assert status == SOLVED
    assert missed(qp, d) < 1e-8
    assert objective(qp, d) == pytest.approx(best, rel=1e-7, abs=1e-7)


@shapes
@pytest.mark.parametrize("tight", [3.0, 1.0, 0.3, 0.03])
def test_random_qps(shape, tight):
    rng, solver = np.random.default_rng([7, int(100 * tight)]), solver_of(shape)
    for _ in range(20):
        solves(solver, random_qp(rng, *SHAPES[shape], tight))
