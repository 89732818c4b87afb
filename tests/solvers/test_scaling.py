"""QPs in any unit: what a solver is handed, and what comes back, do not depend on it."""

import pickle
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from qpmhe_solvers import QP, RawSolution, Solver, SolverOptions, SolveStatus, backends, create
from qpmhe_solvers.scaling import Scaling
from qpmhe_solvers.solver import ContainedSolver

from .problems import CASES, EVERY, WITH_INEQUALITIES, make, of_order_one

NATIVE = [
    entry.name for entry in backends()
    if entry.available and entry.keeps_workspace and entry.name not in ("auto", "banded")
]
TIGHT = SolverOptions(absolute_tolerance=1e-9)
# Methods of first order, and those that look at other residuals than ours, are less accurate.
ACCURACY = {"scs": 1e-4, "ecos": 1e-4, "qpsolvers:piqp": 1e-4, "qpsolvers:proxqp": 1e-4}
REPOSITORY = Path(__file__).parents[2]


def in_units(qp, states, cost, rows):
    """The same QP for the unknowns ``states * d``, with a cost and rows of other units."""
    other, n = qp.copy(), qp.n
    row = (np.arange(n)[:, None] + np.arange(2 * n)) % n
    other.band *= cost / (states[:, None] * states[row])
    other.gradient *= cost / states
    other.lower *= states
    other.upper *= states
    for array in (other.row_own, other.row_next):
        array *= rows[:, None] / states
    other.row_lower *= rows
    other.row_upper *= rows
    return other


def decades(rng, size=None, base=10.0):
    return base ** rng.integers(-9, 10, size)


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
@pytest.mark.parametrize("case", CASES)
def test_any_unit_gives_the_same_solution(case, name):
    rng = np.random.default_rng(len(case))
    qp, dense = make(**CASES[case])
    best = dense.minimiser().reshape(qp.stages, qp.n)
    for _ in range(4):
        states, cost, rows = decades(rng, qp.n), decades(rng), decades(rng, qp.rows)
        solution = create(name, TIGHT).solve(in_units(qp, states, cost, rows))
        assert solution.status is SolveStatus.SOLVED or name == "ecos", solution.message
        accuracy = ACCURACY.get(name, 1e-5) * max(1.0, np.abs(best).max())
        np.testing.assert_allclose(solution.d / states, best, rtol=0, atol=accuracy)


@pytest.mark.parametrize("name", [name for name in EVERY if name != "auto"])
@pytest.mark.parametrize("case", ["no inequality", "all kinds", "badly scaled"])
def test_powers_of_two_change_not_a_bit(case, name):
    rng = np.random.default_rng(len(case))
    qp, _ = make(**CASES[case])
    if name == "banded":  # which takes QPs as they are, and pivots where there are equality rows
        qp, _ = make(**{**CASES[case], "sides": "two" if qp.rows else "none"})
    told = create(name).solve(qp)
    for _ in range(3):
        states, cost, rows = (decades(rng, size, 2.0) for size in (qp.n, None, qp.rows))
        solution = create(name).solve(in_units(qp, states, cost, rows))
        assert solution.status is told.status
        assert solution.iterations == told.iterations
        if told.d is None:
            continue
        np.testing.assert_array_equal(solution.d, told.d * states)
        if told.bound_duals is not None and told.row_duals is not None:
            bounds = told.bound_duals.reshape(qp.stages, qp.n) * cost / states
            np.testing.assert_array_equal(solution.bound_duals, bounds.ravel())
            pushes = told.row_duals.reshape(qp.stages, -1) * cost / rows
            np.testing.assert_array_equal(solution.row_duals, pushes.ravel())
        if told.residuals is not None and case != "no inequality":
            assert solution.residuals.gap == told.residuals.gap * cost


def test_auto_without_inequalities_is_equivariant_to_the_bit():
    rng = np.random.default_rng(0)
    qp, _ = make(**CASES["no inequality"])
    best = create("auto").solve(qp).d
    for _ in range(5):
        states, cost = decades(rng, qp.n, 2.0), decades(rng, None, 2.0)
        solution = create("auto").solve(in_units(qp, states, cost, np.ones(0)))
        np.testing.assert_array_equal(solution.d, best * states)


def test_equality_rows_hold_in_any_unit():
    qp, dense = make(**CASES["equality rows"])
    best = dense.minimiser().reshape(qp.stages, qp.n)
    rng = np.random.default_rng(1)
    for _ in range(20):
        states, cost, rows = decades(rng, qp.n), decades(rng), decades(rng, qp.rows)
        other = in_units(qp, states, cost, rows)
        solution = create("banded").solve(other)
        assert solution.status is SolveStatus.SOLVED
        np.testing.assert_allclose(solution.d / states, best, rtol=0, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-12, 1e-6, 1.0, 1e6])
def test_a_bound_that_is_missed_is_missed_in_any_unit(unit):
    # Beside an equality row, whose rounding is allowed for.
    qp, _ = make(4, 2, 1, sides="equal")
    free = create("banded").solve(qp).d
    qp.bounded = True
    qp.upper[2, 1] = free[2, 1] - 0.1
    other = in_units(qp, np.full(2, unit), 1.0, np.ones(1))
    assert create("banded").solve(other).status is SolveStatus.UNCONSTRAINED


class Looking(Solver):
    """Keeps what it is handed, and claims to be done where it stands."""

    def __init__(self, options=SolverOptions()):  # noqa: B008 (frozen)
        super().__init__(options)
        self.seen, self.starts, self.forgotten = [], [], 0

    def _solve(self, qp, start):
        self.seen.append(qp.copy())
        self.starts.append(start)
        pushes = np.ones(qp.stages * qp.rows)
        return RawSolution(np.ones(qp.size), True, 1, np.ones(qp.size), pushes)

    def forget(self):
        self.forgotten += 1


def test_a_solver_is_handed_numbers_of_order_one():
    rng = np.random.default_rng(3)
    qp, _ = make(**CASES["all kinds"])
    for _ in range(10):
        states, cost, rows = decades(rng, qp.n), decades(rng), decades(rng, qp.rows)
        given = in_units(qp, states, cost, rows)
        solver = Looking()
        solution = solver.solve(given, np.tile(states, (qp.stages, 1)))
        (seen,) = solver.seen
        diagonal = seen.band[:, :, 0]
        assert ((diagonal.max(axis=0) >= 0.5) & (diagonal.max(axis=0) < 2.0)).all()
        following = np.abs(seen.row_next[:-1]).max(axis=(0, 2))
        peaks = np.maximum(np.abs(seen.row_own).max(axis=(0, 2)), following)
        assert ((peaks >= 0.5) & (peaks < 1.0)).all()
        slope, step = np.abs(seen.gradient), np.abs(seen.gradient / diagonal)
        assert 0.5 <= min(slope.max(), step.max()) < 1.0
        # All of these are powers of two, and belong together.
        step = given.upper[np.isfinite(given.upper)] / seen.upper[np.isfinite(seen.upper)]
        assert (np.frexp(step)[0] == 0.5).all()
        np.testing.assert_array_equal(solution.d * solver.starts[0], np.tile(states, (7, 1)))
        np.testing.assert_allclose(
            given.objective(solution.d) / seen.objective(np.ones((7, 3))),
            np.vdot(given.gradient, solution.d) / np.vdot(seen.gradient, np.ones((7, 3))),
        )
        force = given.hessian_times(solution.d) + given.gradient
        force += solution.bound_duals.reshape(7, 3)
        force += given.rows_transposed_times(solution.row_duals.reshape(7, 2))
        lower, upper = given.lower > -np.inf, given.upper < np.inf
        if (lower & upper).all():
            assert solution.residuals.dual == pytest.approx(np.abs(force).max())
        assert solution.residuals.primal == pytest.approx(given.violation(solution.d))


def test_what_was_scaled_is_scaled_already():
    qp, _ = make(**CASES["all kinds"])
    once, _ = of_order_one(qp)
    twice, _ = of_order_one(once)
    for name in ("band", "gradient", "row_own", "row_next", "lower", "row_upper"):
        np.testing.assert_array_equal(getattr(once, name), getattr(twice, name))


def scaled(scaling, qp):
    return scaling.scale(qp)


def test_a_scale_is_held_while_it_fits():
    scaling, (qp, _) = Scaling(held=True), make(**CASES["all kinds"])
    first = scaled(scaling, qp)
    gradient, band = qp.gradient.copy(), qp.band.copy()
    for factor in (1.0, 0.1, 0.01, 3.0):
        qp.gradient[...] = factor * gradient
        qp.lower[...], qp.upper[...] = -1.0, 1.0
        qp.row_lower[...] = -1.0
        qp.row_upper[...] = 1.0
        assert scaled(scaling, qp) is first
    qp.gradient[...] = 0.0
    assert scaled(scaling, qp) is first
    qp.band[...] = 1e-4 * band
    second = scaled(scaling, qp)
    assert second is not first
    # Both stay at hand.
    qp.gradient[...] = gradient
    qp.band[...] = band
    assert scaled(scaling, qp) is first
    scaling.forget()
    assert scaled(scaling, qp) is not first
    assert pickle.loads(pickle.dumps(scaling)).qp.sizes == (1, 1, 0)


def test_a_unit_that_nothing_but_zeros_told_is_not_held():
    scaling, qp = Scaling(held=True), QP(3, 2, 1)
    qp.band[:, :, 0] = 1.0
    first = scaled(scaling, qp)
    assert scaled(scaling, qp) is first
    qp.gradient[...] = 1.0
    second = scaled(scaling, qp)
    assert second is not first
    qp.row_own[...] = 1.0
    assert scaled(scaling, qp) is not second


@pytest.mark.parametrize("name", NATIVE)
def test_a_workspace_is_updated_while_the_scale_is_held(name, monkeypatch):
    solver, calls = create(name), []
    for what in ("_set_up", "_update"):
        method = getattr(type(solver), what)
        monkeypatch.setattr(
            type(solver), what,
            lambda self, *given, what=what, method=method: calls.append(what)
            or method(self, *given),
        )
    qp, _ = make(**CASES["all kinds"])
    rng = np.random.default_rng(0)
    gradient = qp.gradient.copy()
    for factor in (1.0, 0.5, 0.1, 2.0, 0.03):
        qp.gradient[...] = factor * gradient
        qp.band *= rng.uniform(0.9, 1.1)
        assert solver.solve(qp).status is SolveStatus.SOLVED
    assert calls == ["_set_up"] + ["_update"] * 4


@pytest.mark.parametrize("name", EVERY)
def test_nothing_is_left_of_other_scales_after_forget(name):
    options = SolverOptions(max_iterations=4)
    qp, _ = make(**CASES["all kinds"])
    other = in_units(qp, np.array([1.0, 3.0, 0.2]), 20.0, np.array([5.0, 0.3]))
    used, fresh = create(name, options), create(name, options)
    used.solve(other)
    used.forget()
    one, two = used.solve(qp), fresh.solve(qp)
    assert one.status is two.status
    if one.d is not None:  # compiled code may round by the place of its arrays in memory
        np.testing.assert_allclose(one.d, two.d, rtol=0, atol=1e-13)


def test_a_stage_that_is_known_least_is_solved_for_beside_others():
    # As the last state, which no measurement tells, beside very accurate ones.
    qp = QP(3, 1)
    qp.bounded = False
    qp.band[:, 0, 0] = 1e8, 1e8, 1e-2
    qp.gradient[:, 0] = 7e13, 7e13, 7e3
    for name in ("piqp", "clarabel", "daqp", "quadprog"):
        if name in EVERY:
            np.testing.assert_allclose(create(name).solve(qp).d, -7e5, rtol=1e-3)


def test_who_writes_a_forget_need_not_call_ours():
    looking, (qp, _) = Looking(), make(**CASES["all kinds"])
    solver = ContainedSolver(looking)
    solver.solve(qp)
    other = qp.copy()
    other.gradient *= 5.0
    other.band *= 5.0
    solver.solve(other)
    solver.forget()
    solver.solve(other)
    fresh = Looking()
    fresh.solve(other)
    assert looking.forgotten == 1
    held, ideal = looking.seen[1:]
    assert np.abs(held.band).max() != np.abs(ideal.band).max()
    np.testing.assert_array_equal(ideal.band, fresh.seen[0].band)


def test_numbers_of_any_size_are_contained():
    qp, _ = make(**CASES["all kinds"])
    for size in (1e-300, 1e-200, 1e200, 1e300):
        for name in EVERY:
            huge = qp.copy()
            huge.band *= size
            huge.gradient *= size
            solution = create(name, SolverOptions(max_iterations=50)).solve(huge)
            assert solution.d is None or np.isfinite(solution.d).all()


def test_a_badly_scaled_qp_does_not_end_the_process():
    # Handed over as it is, highs ends the process at this one.
    pytest.importorskip("highspy")
    program = textwrap.dedent("""
        import numpy as np
        from qpmhe_solvers import SolverOptions, create
        from tests.solvers.problems import make
        from tests.solvers.test_scaling import in_units

        qp, _ = make(2, 3, 2, seed=406, bounds="all", sides="mixed")
        qp = in_units(qp, np.array([1e-8, 1.0, 1e9]), 0.01, np.array([1.0, 1e-8]))
        print(create("highs", SolverOptions(time_limit=10.0)).solve(qp).status.name)
    """)
    ended = subprocess.run(
        [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True,
        timeout=120,
    )
    assert (ended.returncode, ended.stdout) == (0, "SOLVED\n"), ended.stderr
