import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import qpmhe_solvers.auto
import qpmhe_solvers.dispatch
import qpmhe_solvers.native
from qpmhe_solvers import QP, SolverOptions, SolveStatus, backend, create
from qpmhe_solvers.qp import band_of

from .problems import (
    ARRAYS,
    CASES,
    EVERY,
    WITH_INEQUALITIES,
    make,
    numbers,
    of_order_one,
    overwrite,
)

TIGHT = SolverOptions(absolute_tolerance=1e-9)
CAPPED = [name for name in WITH_INEQUALITIES if backend(name).iteration_cap]
UNCAPPED = [name for name in WITH_INEQUALITIES if not backend(name).iteration_cap]
# ecos solves the QP as a second-order cone program, and reaches its tolerances there: the
# multipliers that come back satisfy the QP's own stationarity only roughly. highs adds 1e-7
# to the Hessian's diagonal. proxqp as it comes looks at the residuals, not at the gap.
STATIONARITY = {"ecos": 1e-3, "highs": 1e-5}
GAP = {"qpsolvers:proxqp": 1e-4}
ALL_KINDS = CASES["all kinds"]


def contradiction():
    """Two rows of one stage that want the same sum above 5 and below -5."""
    qp, _ = make(6, 2, 2, sides="two")
    qp.row_own[3], qp.row_next[3] = 1.0, 0.0
    qp.row_lower[3], qp.row_upper[3] = [5.0, -6.0], [6.0, -5.0]
    return qp


def check_optimal(name, qp, dense, solution, best):
    assert solution.status is SolveStatus.SOLVED or (
        name == "ecos" and solution.status is SolveStatus.INACCURATE
    ), f"{solution} {solution.message}"
    assert solution.d.shape == (qp.stages, qp.n)
    scale = 1.0 + abs(dense.objective(best))
    gap = GAP.get(name, 1e-6) * scale
    assert abs(dense.objective(solution.d) - dense.objective(best)) <= gap
    assert dense.violation(solution.d) <= 1e-7
    if solution.bound_duals is None:
        assert name in ("auto", "banded")
        assert not qp.bounded
        assert not qp.rows
        return
    answer = solution.d, solution.bound_duals, solution.row_duals
    force = 1.0 + np.abs(dense.gradient).max()
    assert dense.stationarity(*answer) <= STATIONARITY.get(name, 1e-7) * force
    assert dense.complementarity(*answer) <= gap
    if solution.residuals is not None:
        assert solution.residuals.primal == pytest.approx(dense.violation(solution.d), abs=1e-12)
        stationarity = dense.stationarity(*answer)
        assert solution.residuals.dual == pytest.approx(stationarity, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
@pytest.mark.parametrize("case", CASES)
def test_solves_to_optimality(case, name):
    for seed in range(2):
        qp, dense = make(**CASES[case], seed=seed)
        before = numbers(qp)
        solution = create(name, TIGHT).solve(qp)
        check_optimal(name, qp, dense, solution, dense.minimiser())
        for array, values in before.items():
            np.testing.assert_array_equal(getattr(qp, array), values)


@pytest.mark.parametrize("cap", [None, 1])
@pytest.mark.parametrize("name", EVERY)
def test_every_backend_only_reads(name, cap):
    # These are lent the caller's arrays; all others are lent copies.
    solver = create(name, SolverOptions(cap, absolute_tolerance=1e-9))
    qps = [make(**case)[0] for case in CASES.values()]
    crossed, spoilt = make(**ALL_KINDS)[0], make(**ALL_KINDS)[0]
    crossed.lower[2, 0] = crossed.upper[2, 0] = 0.0
    crossed.lower[2, 0] += 1.0
    spoilt.gradient[1, 1] = np.nan
    if cap is not None:  # without a cap, some take minutes to give up
        qps.append(contradiction())
    for qp in (*qps, crossed, spoilt):
        start = np.full((qp.stages, qp.n), 0.1)
        before = {array: values.tobytes() for array, values in numbers(qp).items()}
        for array in ARRAYS:  # what NumPy sees written raises; compiled code may write unseen
            getattr(qp, array).flags.writeable = False
        start.flags.writeable = False
        solution = solver.solve(qp, start)
        assert "read-only" not in solution.message
        assert (start == 0.1).all()
        for array, values in before.items():
            assert getattr(qp, array).tobytes() == values, array


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
@pytest.mark.parametrize("case", CASES)
def test_the_recomputed_gap_closes_at_a_solution(case, name):
    qp, dense = make(**CASES[case], seed=0)
    solution = create(name, TIGHT).solve(qp)
    if solution.residuals is not None:
        scale = 1.0 + abs(dense.objective(dense.minimiser()))
        assert solution.residuals.gap <= 1e-4 * scale


@pytest.mark.parametrize("case", CASES)
def test_the_cases_are_not_idle(case):
    qp, _ = make(**CASES[case])
    status = create("banded").solve(qp).status
    idle = case in ("no inequality", "only unused rows", "equality rows")
    assert status is (SolveStatus.SOLVED if idle else SolveStatus.UNCONSTRAINED)


FAST = [name for name in ("auto", "clarabel", "daqp", "piqp", "quadprog") if name in EVERY]


@given(
    stages=st.integers(1, 6), n=st.integers(2, 3), rows=st.integers(0, 2),
    bounds=st.sampled_from(["none", "all", "part"]),
    sides=st.sampled_from(["none", "two", "one", "mixed"]),
    decades=st.sampled_from([0.0, 2.0, 4.0]), seed=st.integers(0, 10**6),
)
@settings(max_examples=100, derandomize=True, deadline=None)
def test_backends_agree_on_any_feasible_qp(stages, n, rows, bounds, sides, decades, seed):
    qp, dense = make(stages, n, rows, bounds=bounds, sides=sides, decades=decades, seed=seed)
    best = dense.minimiser()
    for name in FAST:
        check_optimal(name, qp, dense, create(name, TIGHT).solve(qp), best)


@pytest.mark.parametrize("cap", [1, 2, 5])
@pytest.mark.parametrize("name", CAPPED)
def test_the_cap_is_kept(name, cap):
    qp, _ = make(**ALL_KINDS)
    solution = create(name, SolverOptions(cap, absolute_tolerance=1e-9)).solve(qp)
    assert solution.status in (SolveStatus.STOPPED, SolveStatus.FAILED, SolveStatus.SOLVED)
    assert solution.iterations is None or solution.iterations <= cap


@pytest.mark.parametrize("name", CAPPED)
def test_one_iteration_does_not_solve(name):
    qp, _ = make(**ALL_KINDS)
    solution = create(name, SolverOptions(max_iterations=1, absolute_tolerance=1e-9)).solve(qp)
    if backend(name).iterate_at_cap:
        assert solution.status is SolveStatus.STOPPED
        assert solution.d.shape == (qp.stages, qp.n)
        assert np.isfinite(solution.d).all()
        assert solution.residuals.primal == pytest.approx(qp.violation(solution.d))
    else:
        assert solution.status is SolveStatus.FAILED
        assert solution.d is None


@pytest.mark.parametrize("name", CAPPED)
def test_a_generous_cap_does_not_matter(name):
    qp, dense = make(**ALL_KINDS)
    options = SolverOptions(max_iterations=5000, absolute_tolerance=1e-9)
    check_optimal(name, qp, dense, create(name, options).solve(qp), dense.minimiser())


@pytest.mark.parametrize("name", UNCAPPED)
def test_without_a_cap_it_solves_fully(name):
    qp, dense = make(**ALL_KINDS)
    solution = create(name, SolverOptions(max_iterations=1)).solve(qp)
    check_optimal(name, qp, dense, solution, dense.minimiser())


@pytest.mark.parametrize("name", sorted({"osqp", "qpsolvers:osqp", "scs"} & set(EVERY)))
def test_tolerances_reach_the_solver(name):
    qp, _ = make(**ALL_KINDS)
    counts = [
        create(name, SolverOptions(absolute_tolerance=absolute, relative_tolerance=relative))
        .solve(qp).iterations
        for absolute, relative in ((1e-10, 0.0), (1e-2, 0.0), (1e-10, 1e-2))
    ]
    assert counts[1] < counts[0]
    assert counts[2] < counts[0]


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
def test_every_option_is_taken(name):
    qp, dense = make(**ALL_KINDS)
    options = SolverOptions(
        max_iterations=5000, absolute_tolerance=1e-9, relative_tolerance=1e-9, time_limit=60.0
    )
    check_optimal(name, qp, dense, create(name, options).solve(qp), dense.minimiser())


@pytest.mark.parametrize("cap", [None, 3])
@pytest.mark.parametrize("name", EVERY)
def test_update_equals_rebuild(name, cap):
    options = SolverOptions(max_iterations=cap)
    qp, _ = of_order_one(make(**ALL_KINDS, seed=1)[0])
    solver = create(name, options)
    solver.solve(qp)
    # New numbers, and other sides that are infinite or equal; then another size, and back.
    for seed, sizes in ((2, ALL_KINDS), (3, CASES["two-sided rows"]), (4, ALL_KINDS)):
        other, _ = of_order_one(make(**sizes, seed=seed)[0])
        if sizes is ALL_KINDS:
            overwrite(qp, other)
        updated = solver.solve(qp if sizes is ALL_KINDS else other)
        rebuilt = create(name, options).solve(other)
        assert updated.status is rebuilt.status
        if rebuilt.d is not None:
            np.testing.assert_allclose(updated.d, rebuilt.d, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
def test_recovers_from_an_infeasible_qp(name):
    solver = create(name, TIGHT)
    solution = solver.solve(contradiction())
    assert solution.status in (SolveStatus.STOPPED, SolveStatus.FAILED, SolveStatus.INACCURATE)
    if solution.d is not None:
        assert solution.residuals.primal >= 5.0 * (1 - 1e-9)
    qp, dense = make(6, 2, 2, sides="two", seed=9)
    check_optimal(name, qp, dense, solver.solve(qp), dense.minimiser())


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
def test_crossed_bounds_are_never_solved(name):
    qp, dense = make(6, 2, bounds="all")
    good = qp.lower.copy()
    qp.lower[2, 0] = qp.upper[2, 0] + 1.0
    # Without a cap proxqp takes its 10000 outer iterations here, most of a minute.
    solver = create(name, SolverOptions(max_iterations=200, absolute_tolerance=1e-9))
    assert solver.solve(qp).status is not SolveStatus.SOLVED
    qp.lower[...] = good
    check_optimal(name, qp, dense, solver.solve(qp), dense.minimiser())


@pytest.fixture
def no_solver_call(monkeypatch):
    def called(*arguments):
        pytest.fail("data that are not finite reached a solver")  # not an Exception: no wall

    monkeypatch.setattr(qpmhe_solvers.dispatch.DispatchSolver, "_solve", called)
    monkeypatch.setattr(qpmhe_solvers.native.NativeSolver, "_solve", called)


@pytest.mark.parametrize("name", EVERY)
def test_nan_in_the_gradient_never_reaches_a_solver(name, no_solver_call):
    qp, _ = make(**ALL_KINDS)
    qp.gradient[3, 1] = np.nan
    solution = create(name).solve(qp)
    assert solution.status is SolveStatus.FAILED
    assert solution.d is None
    assert solution.message


@pytest.mark.parametrize("array", ARRAYS)
@pytest.mark.parametrize("name", [name for name in WITH_INEQUALITIES if name != "auto"])
def test_nan_in_any_array_never_reaches_a_solver(name, array, no_solver_call):
    qp, _ = make(**ALL_KINDS)
    getattr(qp, array)[2].flat[1] = np.nan
    solution = create(name).solve(qp)
    assert solution.status is SolveStatus.FAILED
    assert "not finite" in solution.message


def test_recovers_from_nan():
    qp, dense = make(**ALL_KINDS)
    for name in WITH_INEQUALITIES:
        solver = create(name, TIGHT)
        gradient = qp.gradient.copy()
        qp.gradient[0, 0] = np.nan
        assert solver.solve(qp).status is SolveStatus.FAILED
        qp.gradient[...] = gradient
        check_optimal(name, qp, dense, solver.solve(qp), dense.minimiser())


STARTED = [name for name in WITH_INEQUALITIES if backend(name).warm_start and name != "auto"]
UNSTARTED = [name for name in WITH_INEQUALITIES if not backend(name).warm_start]


@pytest.mark.parametrize("name", STARTED)
def test_the_start_is_used(name):
    qp, dense = make(**ALL_KINDS)
    best = dense.minimiser().reshape(qp.stages, qp.n)

    def solve(cap, start, warm=True):
        return create(name, SolverOptions(max_iterations=cap, warm_start=warm)).solve(qp, start)

    if backend(name).iterate_at_cap:
        assert np.abs(solve(1, best).d - solve(1, None).d).max() > 1e-3
        np.testing.assert_array_equal(solve(1, best, warm=False).d, solve(1, None).d)
    else:
        # With the right active set there is nothing left to do.
        assert solve(2, best).status is SolveStatus.SOLVED
        assert solve(2, None).status is SolveStatus.FAILED
        assert solve(2, best, warm=False).status is SolveStatus.FAILED


@pytest.mark.parametrize("name", UNSTARTED)
def test_the_start_is_not_used(name):
    qp, _ = make(**ALL_KINDS)
    start = np.random.default_rng(0).standard_normal((qp.stages, qp.n))
    options = SolverOptions(max_iterations=2)
    started, plain = (create(name, options).solve(qp, point) for point in (start, None))
    assert started.status is plain.status
    np.testing.assert_allclose(started.d, plain.d, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
def test_nothing_is_printed(name, capfd):
    solver = create(name)
    solver.solve(make(**ALL_KINDS)[0])
    solver.solve(contradiction())
    assert capfd.readouterr() == ("", "")


def test_auto_is_banded_where_no_inequality_binds(no_solver_call):
    for case in ("no inequality", "only unused rows"):
        qp, dense = make(**CASES[case])
        solution = create("auto").solve(qp)
        assert solution.status is SolveStatus.SOLVED
        np.testing.assert_array_equal(solution.d, create("banded").solve(qp).d)
        np.testing.assert_allclose(solution.d.ravel(), dense.minimiser(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("cap", [None, 2])
@pytest.mark.parametrize(("stages", "n"), [(6, 2), (30, 2), (31, 2)])
def test_auto_chooses_by_size_and_cap(stages, n, cap, monkeypatch):
    chosen = []
    make_solver = qpmhe_solvers.auto.make_solver
    monkeypatch.setattr(
        qpmhe_solvers.auto, "make_solver",
        lambda backend, options: chosen.append(backend.name) or make_solver(backend, options),
    )
    qp, dense = make(stages, n, bounds="all")
    options = SolverOptions(max_iterations=cap, absolute_tolerance=1e-9)
    solver = qpmhe_solvers.auto.AutoSolver(options)
    solution = solver.solve(qp)
    solver.solve(qp)
    order = ["daqp", "piqp"] if stages * n <= 60 and cap is None else ["piqp"]
    assert chosen[0] == next(name for name in order if name in EVERY)
    assert len(chosen) <= 2  # the second stands by for a failure
    if cap is None:
        check_optimal("auto", qp, dense, solution, dense.minimiser())
    else:
        assert solution.status is SolveStatus.STOPPED
        assert np.isfinite(solution.d).all()


def test_auto_without_any_solver_is_banded(monkeypatch):
    for name, native in qpmhe_solvers.native.NATIVE.items():
        missing = dataclasses.replace(native, module="not_installed_here")
        monkeypatch.setitem(qpmhe_solvers.native.NATIVE, name, missing)
    qp, _ = make(6, 2, bounds="all")
    solution = create("auto").solve(qp)
    assert solution.status is SolveStatus.UNCONSTRAINED
    np.testing.assert_array_equal(solution.d, create("banded").solve(qp).d)


@pytest.mark.parametrize(
    "name", [name for name in EVERY if name.endswith(("osqp", "piqp", "proxqp"))]
)
def test_a_long_step_along_a_weak_direction_is_not_called_unbounded(name):
    qp, weak = QP(1, 2), 3e-5
    qp.band[0] = band_of(np.array([[1.0, 1.0 - weak], [1.0 - weak, 1.0]]))
    qp.gradient[0] = weak, -weak
    solution = create(name, SolverOptions(absolute_tolerance=1e-9)).solve(qp)
    assert "infeasible" not in solution.message.lower()
    np.testing.assert_allclose(solution.d, [[-1.0, 1.0]], rtol=1e-6)
