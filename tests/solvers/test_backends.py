"""Every backend on QPs whose solution is known: what comes back, and what reaches the solver."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qpmhe_solvers import QP, SolverOptions, SolveStatus, backend, create
from qpmhe_solvers.qp import band_of
from qpmhe_solvers.sample_qps import sample

from .problems import CASES, EVERY, TIGHT, WITH_INEQUALITIES, make

FULL = SolverOptions(5000, absolute_tolerance=1e-9, relative_tolerance=1e-9, time_limit=60.0)
# ecos solves the QP as a second-order cone program, and reaches its tolerances there: the
# multipliers that come back satisfy the QP's own stationarity only roughly. highs adds 1e-7
# to the Hessian's diagonal. proxqp as it comes looks at the residuals, not at the gap.
STATIONARITY = {"ecos": 1e-3, "highs": 1e-5}
GAP = {"qpsolvers:proxqp": 1e-4}


def check_optimal(name, qp, dense, solution):
    assert solution.status is SolveStatus.SOLVED or (
        name == "ecos" and solution.status is SolveStatus.INACCURATE
    ), f"{solution} {solution.message}"
    assert solution.d.shape == (qp.stages, qp.n)
    best = dense.objective(dense.minimiser())
    gap = GAP.get(name, 1e-6) * (1.0 + abs(best))
    assert abs(dense.objective(solution.d) - best) <= gap
    assert dense.violation(solution.d) <= 1e-7
    if solution.bound_duals is None:
        assert (name in ("auto", "banded"), qp.bounded, qp.rows) == (True, False, 0)
        return
    answer = solution.d, np.append(solution.bound_duals, solution.row_duals)
    stationarity = dense.stationarity(*answer)
    assert stationarity <= STATIONARITY.get(name, 1e-7) * (1.0 + np.abs(dense.gradient).max())
    assert dense.complementarity(*answer) <= gap
    assert solution.residuals is None or solution.residuals.gap <= 1e-4 * (1.0 + abs(best))


def test_every_backend_solves_to_optimality():
    for seed, (case, sizes) in enumerate(CASES.items()):
        qp, dense = make(**sizes, seed=seed)
        for name in WITH_INEQUALITIES:
            check_optimal(name, qp, dense, create(name, (TIGHT, FULL)[seed % 2]).solve(qp))
        idle = case in ("no inequality", "only unused rows", "equality rows")
        expected = SolveStatus.SOLVED if idle else SolveStatus.UNCONSTRAINED
        assert create("banded").solve(qp).status is expected


@given(
    stages=st.integers(1, 6), n=st.integers(2, 3), rows=st.integers(0, 2),
    bounds=st.sampled_from(["none", "all", "part"]),
    sides=st.sampled_from(["none", "two", "one", "mixed"]),
    decades=st.sampled_from([0.0, 2.0, 4.0]), seed=st.integers(0, 10**6),
)
@settings(max_examples=40, derandomize=True, deadline=None)
def test_backends_agree_on_any_feasible_qp(stages, n, rows, bounds, sides, decades, seed):
    qp, dense = make(stages, n, rows, bounds=bounds, sides=sides, decades=decades, seed=seed)
    for name in {"auto", "clarabel", "daqp", "piqp", "quadprog"} & set(EVERY):
        check_optimal(name, qp, dense, create(name, TIGHT).solve(qp))


@pytest.mark.parametrize(
    "name", [name for name in EVERY if name.endswith(("osqp", "piqp", "proxqp"))]
)
def test_a_long_step_along_a_weak_direction_is_not_called_unbounded(name):
    qp, weak = QP(1, 2), 3e-5
    qp.band[0] = band_of(np.array([[1.0, 1.0 - weak], [1.0 - weak, 1.0]]))
    qp.gradient[0] = weak, -weak
    solution = create(name, TIGHT).solve(qp)
    assert "infeasible" not in solution.message.lower()
    np.testing.assert_allclose(solution.d, [[-1.0, 1.0]], rtol=1e-6)


@pytest.mark.parametrize("name", [name for name in EVERY if backend(name).iteration_cap])
def test_tolerances_reach_the_solver(name):
    qp = sample(40, 3, 2, bounds="part", sides="mixed")
    tight, loose, relative = (
        create(name, SolverOptions(absolute_tolerance=one, relative_tolerance=other))
        .solve(qp).iterations
        for one, other in ((1e-10, 0.0), (1e-2, 0.0), (1e-10, 1e-2))
    )
    # Active sets are exact, some count nothing, and piqp is at once as accurate as it gets.
    if tight is not None and not name.endswith(("auto", "active_set", "daqp", "qpsolvers:piqp")):
        assert loose < tight
        assert relative < tight or name == "ecos"
