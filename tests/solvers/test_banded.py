"""The banded factorisation: exact without inequalities, and honest where one is violated."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qpmhe_solvers import SolveStatus, create
from qpmhe_solvers.qp import ARRAYS

from .problems import make

SOLVED = SolveStatus.SOLVED
SOLVER = create("banded")


@given(
    stages=st.integers(1, 11), n=st.integers(1, 5), decades=st.sampled_from([0.0, 2.0, 4.0]),
    seed=st.integers(0, 10**6),
)
@settings(max_examples=80, derandomize=True, deadline=None)
def test_one_solver_minimises_any_unconstrained_qp(stages, n, decades, seed):
    qp, dense = make(stages, n, decades=decades, seed=seed)
    solution = SOLVER.solve(qp)
    assert (solution.status, solution.d.shape) == (SOLVED, (stages, n))
    force = dense.hessian @ solution.d.ravel() + dense.gradient
    scale = np.abs(dense.hessian).max() * np.abs(solution.d).max() + np.abs(dense.gradient).max()
    assert np.abs(force).max() <= 1e-12 * scale
    np.testing.assert_array_equal(solution.d, create("banded").solve(qp).d)


def test_unconstrained_where_one_inequality_is_violated():
    for side in ("lower", "upper", "row_lower", "row_upper"):
        qp, dense = make(5, 2, 1)
        x = dense.minimiser()
        wide, qp.bounded = 10.0 + 100.0 * np.abs(x).max(), True
        qp.lower[...] = qp.row_lower[...] = -wide
        qp.upper[...] = qp.row_upper[...] = wide
        solution = SOLVER.solve(qp)
        assert solution.status is SOLVED
        assert not np.append(solution.bound_duals, solution.row_duals).any()
        qp.lower[...] = qp.upper[...] = solution.d  # on the edge
        assert SOLVER.solve(qp).status is SOLVED
        qp.lower[...], qp.upper[...] = -wide, wide
        value = dense.matrix @ x if side.startswith("row") else x
        sign = 1.0 if side.endswith("lower") else -1.0
        getattr(qp, side).flat[3] = value[3] + 0.5 * sign
        solution = SOLVER.solve(qp)
        assert (solution.status, solution.status.usable) == (SolveStatus.UNCONSTRAINED, True)
        np.testing.assert_allclose(solution.d.ravel(), x, rtol=1e-9, atol=1e-9)
        assert solution.residuals.primal == pytest.approx(0.5, abs=1e-9)
        assert max(solution.residuals.dual, solution.residuals.gap) < 1e-9


@pytest.mark.parametrize("stage", [0, 2, 4])
def test_fails_where_the_hessian_is_not_positive_definite_and_recovers(stage):
    for place, value in (((1, 0), -1.0), ((1, 0), 0.0), ((0, 1), 2.0), ((0, 0), np.inf)):
        qp, _ = make(5, 2)
        qp.band[...] = 0.0
        qp.band[:, :, 0] = 1.0
        usual = qp.band[stage][place]
        qp.band[stage][place] = value
        solution = SOLVER.solve(qp)
        assert (solution.status, solution.d) == (SolveStatus.FAILED, None)
        assert np.isinf(value) or "H is not positive definite" in solution.message
        qp.band[stage][place] = usual
        np.testing.assert_array_equal(SOLVER.solve(qp).d, -qp.gradient)


@pytest.mark.parametrize("backend", ["banded", "auto"])
def test_nan_does_not_hide_a_violation(backend):
    for name in ARRAYS[2:]:
        qp, dense = make(5, 2, 1)
        qp.bounded = True
        side = {"row_own": "row_upper", "row_next": "row_lower"}.get(name, name)
        rows = dense.matrix if side.startswith("row") else np.eye(10)
        sign = 1.0 if side.endswith("lower") else -1.0
        getattr(qp, side).flat[0] = rows[0] @ dense.minimiser() + sign
        getattr(qp, name)[3].flat[0] = np.nan
        assert create(backend).solve(qp).status is not SOLVED, name
