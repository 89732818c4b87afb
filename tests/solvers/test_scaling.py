"""QPs in any unit: what a solver is handed, and what comes back, do not depend on it."""

import itertools
import pickle
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from qpmhe_solvers import QP, RawSolution, Solver, SolverOptions, SolveStatus, create
from qpmhe_solvers.qp import ARRAYS
from qpmhe_solvers.scaling import Scaling
from qpmhe_solvers.solver import ContainedSolver

from .problems import (
    CASES,
    EVERY,
    NATIVE,
    TIGHT,
    WITH_INEQUALITIES,
    in_units,
    make,
    of_order_one,
)
from .test_native import watched

# Methods of first order, and those that look at other residuals than ours, are less accurate.
ACCURACY = {"scs": 1e-4, "ecos": 1e-4, "qpsolvers:piqp": 1e-4, "qpsolvers:proxqp": 1e-4}
SOLVED = SolveStatus.SOLVED


def units(rng, qp, base=10.0):
    """Units of the unknowns, the cost and the rows, decades apart."""
    return [base ** rng.integers(-9, 10, size) for size in (qp.n, None, qp.rows)]


@pytest.mark.parametrize(
    ("case", "name"),
    [*itertools.product(CASES, WITH_INEQUALITIES), ("equality rows", "banded")],
)
def test_any_unit_gives_the_same_solution(case, name):
    rng = np.random.default_rng(len(case))
    qp, dense = make(**CASES[case])
    best = dense.minimiser().reshape(qp.stages, qp.n)
    for _ in range(4):
        states, cost, rows = units(rng, qp)
        solution = create(name, TIGHT).solve(in_units(qp, states, cost, rows))
        assert solution.status is SOLVED or name == "ecos", solution.message
        accuracy = ACCURACY.get(name, 1e-5) * max(1.0, np.abs(best).max())
        np.testing.assert_allclose(solution.d / states, best, rtol=0, atol=accuracy)


@pytest.mark.parametrize(
    ("case", "name"),
    [
        (case, name)
        for case in ("no inequality", "all kinds", "badly scaled") for name in EVERY
        if name != "auto" or case == "no inequality"  # else it may ask banded first
    ],
)
def test_powers_of_two_change_not_a_bit(case, name):
    rng = np.random.default_rng(len(case))
    qp, _ = make(**CASES[case])
    if name == "banded":  # which takes QPs as they are, and pivots where there are equality rows
        qp, _ = make(**{**CASES[case], "sides": "two" if qp.rows else "none"})
    plain = create(name).solve(qp)
    for _ in range(3):
        states, cost, rows = units(rng, qp, 2.0)
        solution = create(name).solve(in_units(qp, states, cost, rows))
        assert (solution.status, solution.iterations) == (plain.status, plain.iterations)
        if plain.d is None:
            continue
        np.testing.assert_array_equal(solution.d, plain.d * states)
        if plain.bound_duals is not None and plain.row_duals is not None:
            bounds = plain.bound_duals.reshape(qp.stages, qp.n) * cost / states
            np.testing.assert_array_equal(solution.bound_duals, bounds.ravel())
            pushes = plain.row_duals.reshape(qp.stages, -1) * cost / rows
            np.testing.assert_array_equal(solution.row_duals, pushes.ravel())
        if plain.residuals is not None and case != "no inequality":
            assert solution.residuals.gap == plain.residuals.gap * cost


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
        states, cost, rows = units(rng, qp)
        given, solver = in_units(qp, states, cost, rows), Looking()
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
        assert solution.residuals.primal == pytest.approx(given.violation(solution.d))
    once, _ = of_order_one(qp)
    twice, _ = of_order_one(once)
    for name in ARRAYS:  # what was scaled is scaled already
        np.testing.assert_array_equal(getattr(once, name), getattr(twice, name))


def test_a_scale_is_held_while_it_fits():
    scaling, (qp, _) = Scaling(held=True), make(**CASES["all kinds"])
    first = scaling.scale(qp)
    gradient, band = qp.gradient.copy(), qp.band.copy()
    for factor in (1.0, 0.1, 0.01, 3.0, 0.0):
        qp.gradient[...] = factor * gradient
        qp.lower[...] = qp.row_lower[...] = -1.0
        qp.upper[...] = qp.row_upper[...] = 1.0
        assert scaling.scale(qp) is first
    qp.band[...] = 1e-4 * band
    assert scaling.scale(qp) is not first
    # Both stay at hand.
    qp.gradient[...], qp.band[...] = gradient, band
    assert scaling.scale(qp) is first
    scaling.forget()
    assert scaling.scale(qp) is not first
    assert pickle.loads(pickle.dumps(scaling)).qp.sizes == (1, 1, 0)


def test_a_unit_that_only_zeros_set_is_not_held():
    scaling, qp, scales = Scaling(held=True), QP(3, 2, 1), []
    qp.band[:, :, 0] = 1.0
    for array in (None, qp.gradient, qp.row_own):
        if array is not None:
            array[...] = 1.0
        scales.append(scaling.scale(qp))
        assert scaling.scale(qp) is scales[-1]
    assert len({id(one) for one in scales}) == 3


@pytest.mark.parametrize("name", NATIVE)
def test_a_workspace_is_updated_while_the_scale_is_held(name, monkeypatch):
    solver, calls = watched(name, monkeypatch)
    qp, _ = make(**CASES["all kinds"])
    rng, gradient = np.random.default_rng(0), qp.gradient.copy()
    for factor in (1.0, 0.5, 0.1, 2.0, 0.03):
        qp.gradient[...] = factor * gradient
        qp.band *= rng.uniform(0.9, 1.1)
        assert solver.solve(qp).status is SOLVED
    assert calls == ["_set_up"] + ["_update"] * 4


@pytest.mark.parametrize("name", EVERY)
def test_nothing_is_left_of_other_scales_after_forget(name):
    qp, _ = make(**CASES["all kinds"])
    other = in_units(qp, np.array([1.0, 3.0, 0.2]), 20.0, np.array([5.0, 0.3]))
    used, fresh = (create(name, SolverOptions(max_iterations=4)) for _ in range(2))
    used.solve(other)
    used.forget()
    one, two = used.solve(qp), fresh.solve(qp)
    assert one.status is two.status
    if one.d is not None:  # compiled code may round by the place of its arrays in memory
        np.testing.assert_allclose(one.d, two.d, rtol=0, atol=1e-13)


def test_a_stage_that_is_known_least_is_solved_for_beside_others():
    # As the last state, which no measurement sees, beside very accurate ones.
    qp = QP(3, 1)
    qp.bounded = False
    qp.band[:, 0, 0] = 1e8, 1e8, 1e-2
    qp.gradient[:, 0] = 7e13, 7e13, 7e3
    for name in {"piqp", "clarabel", "daqp", "quadprog"} & set(EVERY):
        np.testing.assert_allclose(create(name).solve(qp).d, -7e5, rtol=1e-3)


def test_who_writes_a_forget_need_not_call_ours():
    looking, (qp, _) = Looking(), make(**CASES["all kinds"])
    solver, other = ContainedSolver(looking), qp.copy()
    other.gradient *= 5.0
    other.band *= 5.0
    solver.solve(qp)
    solver.solve(other)
    solver.forget()
    solver.solve(other)
    fresh = Looking()
    fresh.solve(other)
    assert looking.forgotten == 1
    held, ideal = looking.seen[1:]
    assert np.abs(held.band).max() != np.abs(ideal.band).max()
    np.testing.assert_array_equal(ideal.band, fresh.seen[0].band)


@pytest.mark.parametrize("size", [1e-300, 1e-200, 1e200, 1e300])
def test_numbers_of_any_size_are_contained(size):
    qp, _ = make(**CASES["all kinds"])
    qp.band *= size
    qp.gradient *= size
    for name in EVERY:
        solution = create(name, SolverOptions(max_iterations=50)).solve(qp)
        assert solution.d is None or np.isfinite(solution.d).all()


def test_a_badly_scaled_qp_does_not_end_the_process():
    # Handed over as it is, highs ends the process at this one.
    pytest.importorskip("highspy")
    program = textwrap.dedent("""
        import numpy as np
        from qpmhe_solvers import SolverOptions, create
        from tests.solvers.problems import in_units, make

        qp, _ = make(2, 3, 2, seed=406, bounds="all", sides="mixed")
        qp = in_units(qp, np.array([1e-8, 1.0, 1e9]), 0.01, np.array([1.0, 1e-8]))
        print(create("highs", SolverOptions(time_limit=10.0)).solve(qp).status.name)
    """)
    ended = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parents[2], capture_output=True,
        text=True, timeout=120,
    )
    assert (ended.returncode, ended.stdout) == (0, "SOLVED\n"), ended.stderr
