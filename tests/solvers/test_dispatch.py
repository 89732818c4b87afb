import copy
import gc
import sys
import tracemalloc

import numpy as np
import pytest
import scipy.sparse

from qpmhe_solvers import SolverOptions, backends, create
from qpmhe_solvers.dispatch import DispatchSolver
from qpmhe_solvers.translations import TRANSLATIONS

from .problems import ARRAYS, CASES, make
from .test_matrices import LETTERS, parts

NAMES = [
    entry.name for entry in backends()
    if getattr(entry.factory, "func", None) is DispatchSolver and entry.available
]
# One of each way to take matrices and bounds.
WAYS = [
    name for name in ("qpsolvers:clarabel", "qpsolvers:daqp", "qpsolvers:piqp", "quadprog")
    if name in NAMES
]
ALL_KINDS = CASES["all kinds"]


def around_the_call(solver, before, after):
    """Have something done before and after each call of the solver's own function."""
    call = solver._solve_problem

    def surrounded(problem, *arguments, **keywords):
        before(problem)
        try:
            return call(problem, *arguments, **keywords)
        finally:
            after(problem)

    solver._solve_problem = surrounded


def contents(problem):
    return dict(parts([getattr(problem, letter) for letter in LETTERS]))


class Intact:
    """Looks whether anything that a solver was handed has changed by its solve."""

    def __init__(self, solver):
        self.solves = 0
        around_the_call(solver, self.remember, self.compare)

    def remember(self, problem):
        self.arrays = contents(problem)
        self.copies = {name: array.copy() for name, array in self.arrays.items()}

    def compare(self, problem):
        self.solves += 1
        for name, array in contents(problem).items():
            assert array is self.arrays[name], name
            np.testing.assert_array_equal(array, self.copies[name], err_msg=name)


def test_every_solver_of_the_table_can_be_named():
    assert {name.removeprefix("qpsolvers:") for name in NAMES} <= set(TRANSLATIONS)
    names = {entry.name for entry in backends()}
    for name in TRANSLATIONS:
        assert (f"qpsolvers:{name}" in names) == (name not in NAMES and name in names)


@pytest.mark.parametrize("options", [SolverOptions(), SolverOptions(max_iterations=2)])
@pytest.mark.parametrize("name", NAMES)
def test_no_solver_writes_into_what_it_is_handed(name, options):
    # Only because of this may matrices be kept: indices and zeros are never written again.
    for case in CASES.values():
        solver = create(name, options)
        intact = Intact(solver)
        for seed in range(2):
            qp, _ = make(**case, seed=seed)
            solver.solve(qp, np.full((qp.stages, qp.n), 0.1))
        assert intact.solves == 2


@pytest.mark.parametrize("name", NAMES)
def test_nor_where_it_finds_no_solution(name):
    qp, _ = make(6, 2, 2, sides="two")
    qp.row_own[3], qp.row_next[3] = 1.0, 0.0
    qp.row_lower[3], qp.row_upper[3] = [5.0, -6.0], [6.0, -5.0]
    solver = create(name, SolverOptions(max_iterations=200))
    intact = Intact(solver)
    solver.solve(qp)
    assert intact.solves == 1


@pytest.mark.parametrize("name", NAMES)
def test_no_solver_holds_on_to_what_it_is_handed(name):
    solver, (qp, _) = create(name), make(**ALL_KINDS)
    solver.solve(qp)
    (workspace,) = solver._workspaces.values()
    arrays = list(contents(workspace.handle).values())
    before = [sys.getrefcount(array) for array in arrays]
    solver.solve(qp)
    gc.collect()
    assert [sys.getrefcount(array) for array in arrays] == before


class SparseCount:
    """Counts the sparse matrices that are made, outside of the solvers' own functions."""

    def __init__(self, monkeypatch):
        self.made, self.outside = 0, True
        kinds = (getattr(scipy.sparse, f"{kind}_matrix") for kind in ("csc", "csr", "coo", "dia"))
        classes = {one for kind in kinds for one in kind.__mro__ if "__init__" in vars(one)}
        for one in classes - {object}:
            monkeypatch.setattr(one, "__init__", self.counting(one.__init__))

    def counting(self, construct):
        def counted(*arguments, **keywords):
            self.made += self.outside
            construct(*arguments, **keywords)

        return counted

    def watch(self, solver):
        around_the_call(
            solver, lambda _: setattr(self, "outside", False),
            lambda _: setattr(self, "outside", True),
        )


@pytest.mark.parametrize("case", ["all kinds", "boxes", "no inequality"])
@pytest.mark.parametrize("name", NAMES)
def test_sparse_matrices_are_made_once_for_a_pattern(name, case, monkeypatch):
    solver, count = create(name), SparseCount(monkeypatch)
    count.watch(solver)
    qp, _ = make(**CASES[case])
    solver.solve(qp)
    (workspace,) = solver._workspaces.values()
    assert scipy.sparse.issparse(workspace.handle.P) == (solver.style.matrices == "csc")
    count.made = 0
    for _ in range(3):
        qp.gradient[...] += 0.1
        solver.solve(qp)
    assert count.made == 0
    scipy.sparse.csc_matrix((1, 1))
    assert count.made > 0


def patterns(count):
    """QPs of one size that differ in which bounds are finite."""
    qps = [make(**ALL_KINDS)[0] for _ in range(count)]
    for k, qp in enumerate(qps):
        qp.lower.flat[: k + 1], qp.upper.flat[: k + 1] = -10.0 - k, np.inf
        qp.upper.flat[k] = 10.0
    return qps


@pytest.mark.parametrize("name", NAMES)
def test_patterns_that_come_and_go_leave_no_trace(name):
    solver = create(name, SolverOptions(max_iterations=50))
    qps = patterns(12)
    for qp in [*qps, *qps[::-1], *qps[::2], make(**CASES["boxes"])[0]]:
        kept = solver.solve(qp)
        anew = create(name, SolverOptions(max_iterations=50)).solve(qp)
        assert kept.status is anew.status
        np.testing.assert_allclose(kept.d, anew.d, rtol=0, atol=1e-9)


def growth(solver, qps, solves=1000):
    """Bytes that solves of these QPs in turn leave behind, after some of the kind."""

    def held_after(solves):
        for k in range(solves):
            assert solver.solve(qps[k % len(qps)]).d is not None
        gc.collect()  # empties Python's lists of freed objects as well
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = held_after(60)
        return held_after(solves) - before
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize("name", WAYS)
def test_our_part_of_a_solve_leaves_no_memory_behind(name):
    solver, qps, answers = create(name), patterns(12), []
    call = solver._solve_problem
    solver._solve_problem = lambda *one, **two: answers.append(call(*one, **two)) or answers[0]
    solver.solve(qps[0])
    answers[0].z = answers[0].y = answers[0].z_box = np.zeros(200)
    answers[0].extras = {}
    solver._solve_problem = lambda *one, **two: answers[0]
    # Eight bytes a solve: no object is as small. NumPy and Python keep some freed ones at first.
    growth(solver, qps[:5])
    assert growth(solver, qps[:5]) < 8000
    # Never a pattern that is kept. NumPy keeps some freed arrays; 240 forms take megabytes.
    assert growth(solver, qps, 240) < 100_000
    assert len(solver._workspaces) < len(qps)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ("qpsolvers:daqp", "quadprog") if name in NAMES])
def test_a_whole_solve_leaves_no_memory_behind(name):
    assert growth(create(name), [make(**CASES["boxes"])[0]]) < 20_000  # no array a solve


@pytest.mark.parametrize("name", WAYS)
def test_a_copy_of_a_used_solver_works(name):
    qp, _ = make(**ALL_KINDS)
    solver = create(name)
    solver.solve(qp)
    copied = copy.deepcopy(solver)
    for _ in range(2):  # other numbers, the same pattern
        qp.gradient[...] *= -1.5
        wanted = create(name).solve(qp).d
        np.testing.assert_allclose(copied.solve(qp).d, wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", WAYS)
def test_arrays_of_any_layout_are_read(name):
    qp, _ = make(**ALL_KINDS)
    wanted = create(name).solve(qp).d
    solver = create(name)
    for layout in (np.asfortranarray, lambda a: np.repeat(a, 2, axis=-1)[..., ::2]):
        for array in ARRAYS:
            setattr(qp, array, layout(getattr(qp, array)))
        np.testing.assert_allclose(solver.solve(qp).d, wanted, rtol=0, atol=1e-9)
