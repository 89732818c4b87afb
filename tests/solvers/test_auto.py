"""The backend "auto": which solvers it takes, and what it leaves to the second one."""

from dataclasses import replace

import numpy as np
import pytest

import qpmhe_solvers.auto
from qpmhe_solvers import RawSolution, Solver, SolverOptions, SolveStatus, available, create
from qpmhe_solvers.native import NATIVE
from qpmhe_solvers.sample_qps import sample

from .problems import CASES, EVERY, make, replace_natives
from .test_backends import check_optimal

UNCONSTRAINED = SolveStatus.UNCONSTRAINED


@pytest.mark.parametrize("case", ["no inequality", "only unused rows"])
def test_it_is_banded_where_no_inequality_binds(case, monkeypatch):
    replace_natives(monkeypatch, lambda options: pytest.fail("a solver was made"))
    qp, dense = make(**CASES[case])
    solution = create("auto").solve(qp)
    assert solution.status is SolveStatus.SOLVED
    np.testing.assert_array_equal(solution.d, create("banded").solve(qp).d)
    np.testing.assert_allclose(solution.d.ravel(), dense.minimiser(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("stages", "cap"), [(30, None), (31, None), (30, 2), (31, 2)])
def test_it_chooses_by_size_and_cap(stages, cap, monkeypatch):
    chosen, make_solver = [], qpmhe_solvers.auto.make_solver
    monkeypatch.setattr(
        qpmhe_solvers.auto, "make_solver",
        lambda backend, options: chosen.append(backend.name) or make_solver(backend, options),
    )
    qp, dense = make(stages, 2, bounds="all")
    solver = create("auto", SolverOptions(cap, absolute_tolerance=1e-9))
    solution = solver.solve(qp)
    solver.solve(qp)
    order = ["daqp", "piqp"] if stages == 30 and cap is None else ["piqp"]
    assert chosen[0] == next(name for name in order if name in EVERY)
    assert len(chosen) <= 2  # the second stands by for a failure
    if cap is None:
        check_optimal("auto", qp, dense, solution)
    else:
        assert solution.status is SolveStatus.STOPPED


@pytest.mark.parametrize("stages", [5, 100])
def test_it_prefers_a_clock_where_there_is_a_limit(stages):
    names = {"daqp", "clarabel", "osqp"} & set(available())
    if len(names) < 2:
        pytest.skip("needs two of daqp, clarabel and osqp")
    solver = create("auto", SolverOptions(time_limit=1.0))
    solver.prepare(2 * stages)
    for others in solver._others.values():
        kinds = {type(other.solver).__name__ for other in others}
        assert kinds <= {"DaqpSolver", "ClarabelSolver", "OsqpSolver"}


class Scene(Solver):
    """Counts what it is asked for, and brings nothing in 0.4 seconds."""

    left, calls, now = [], [], [0.0]

    def _solve(self, qp, start):
        self.left.append(self.time_limit)
        self.now[0] += 0.4
        return RawSolution(None, False)

    def shift(self):
        self.calls.append("shift")

    def forget(self):
        self.calls.append("forget")


@pytest.fixture
def scene(monkeypatch):
    monkeypatch.setattr("qpmhe_solvers.auto.perf_counter", lambda: Scene.now[0])
    replace_natives(monkeypatch, Scene)
    for name, empty in (("left", []), ("calls", []), ("now", [0.0])):
        monkeypatch.setattr(Scene, name, empty)


def test_the_second_solver_has_what_the_first_has_left_of_the_time(scene):
    for limit, left in [(1.0, [1.0, 0.6]), (0.5, [0.5, 0.1]), (0.4, [0.4]), (None, [None, None])]:
        Scene.left.clear()
        Scene.now[0] = 0.0
        solver = create("auto", SolverOptions(time_limit=limit))
        assert solver.solve(sample(6, 2, bounds="all")).status is UNCONSTRAINED
        assert Scene.left == (left if limit is None else pytest.approx(left))


def test_it_passes_on_how_far_the_trajectory_moved(scene):
    solver, qp = create("auto"), make(6, 2, bounds="all")[0]
    solver.solve(qp)
    for shifts, passed_on in ((0, 0), (2, 2), (0, 0), (100, 6)):
        for _ in range(shifts):
            solver.shift()
        assert Scene.calls == []
        solver.solve(qp)
        assert Scene.calls == ["shift"] * 2 * passed_on  # there are two solvers
        Scene.calls.clear()
    solver.shift()
    solver.forget()
    solver.solve(qp)
    assert Scene.calls == ["forget", "forget"]


class Overriding(Scene):
    """Overrides `solve` itself, and breaks it."""

    def solve(self, qp, start=None):
        return 3

    def prepare(self, size):
        raise SystemExit(3)

    shift = forget = prepare


class Raising(Scene):
    def _solve(self, qp, start):
        raise KeyError("broken package")


class Unmakeable(Scene):
    def __init__(self, options):
        raise ImportError("broken package")


@pytest.mark.parametrize("kind", [Overriding, Raising, Unmakeable, None])
def test_it_contains_broken_packages_and_needs_none(kind, monkeypatch):
    if kind is None:
        for name, native in NATIVE.items():
            monkeypatch.setitem(NATIVE, name, replace(native, module="not_installed_here"))
    else:
        replace_natives(monkeypatch, kind)
    solver, qp = create("auto"), make(6, 2, bounds="all")[0]
    solver.prepare(12)
    solver.shift()
    solution = solver.solve(qp)
    assert solution.status is UNCONSTRAINED
    np.testing.assert_array_equal(solution.d, create("banded").solve(qp).d)
    solver.forget()
