"""What remains of the time reaches every clock, anew for each solve."""

import pytest

import qpmhe_solvers.native
from qpmhe_solvers import (
    Backend,
    RawSolution,
    Solver,
    SolverOptions,
    SolveStatus,
    available,
    backend,
    create,
)
from qpmhe_solvers.dispatch import DispatchSolver
from qpmhe_solvers.sample_qps import sample
from qpmhe_solvers.translations import TRANSLATIONS

from .problems import EVERY

QP = sample(40, 3, 2, bounds="part", sides="mixed")
TIGHT = SolverOptions(absolute_tolerance=1e-9, time_limit=60.0, warm_start=False)
CLOCKED = [name for name in EVERY if backend(name).time_limit]


@pytest.mark.parametrize("name", CLOCKED)
def test_a_limit_holds_for_one_solve(name):
    solver = create(name, TIGHT)
    plenty = solver.solve(QP).status
    assert plenty in (SolveStatus.SOLVED, SolveStatus.INACCURATE)
    for _ in range(2):  # the same solver, with its workspace
        solver.time_limit = 1e-9
        assert solver.solve(QP).status not in (SolveStatus.SOLVED, SolveStatus.INACCURATE)
        solver.time_limit = 60.0
        assert solver.solve(QP).status is plenty


READ = {
    "clarabel": lambda handle: handle.get_settings().time_limit,
    "daqp": lambda handle: handle.settings["time_limit"],
    "osqp": lambda handle: handle.settings.time_limit,
}


@pytest.mark.parametrize("name", READ)
def test_a_workspace_is_told_anew(name):
    pytest.importorskip(name)
    solver = create(name, TIGHT)
    for limit in (60.0, 2.5, 30.0):
        solver.time_limit = limit
        solver.solve(QP)
        (workspace,) = solver._workspaces.values()
        assert READ[name](workspace.handle) == limit


@pytest.mark.parametrize("name", [name for name, how in TRANSLATIONS.items() if how.time_limit])
def test_the_translation_is_told_anew(name):
    pytest.importorskip("qpsolvers")
    solver, given = DispatchSolver(name, TIGHT), []

    def solve_problem(problem, name, **words):
        given.append(words[TRANSLATIONS[name].time_limit])
        raise RuntimeError("that will do")

    solver._solve_problem = solve_problem
    for limit in (60.0, 2.5, 30.0):
        solver.time_limit = limit
        solver.solve(QP)
    assert given == [60.0, 2.5, 30.0]


@pytest.fixture
def slow_solvers(monkeypatch):
    """A clock, and what was left to solvers that bring nothing in 0.4 seconds of it."""
    now, given = [0.0], []
    monkeypatch.setattr("qpmhe_solvers.auto.perf_counter", lambda: now[0])

    class Slow(Solver):
        def _solve(self, qp, start):
            given.append(self.time_limit)
            now[0] += 0.4
            return RawSolution(None, False)

    for name in ("clarabel", "daqp", "osqp", "piqp", "proxqp"):
        entry = Backend(name, Slow, "slow", iterate_at_cap=True)
        monkeypatch.setitem(qpmhe_solvers.native.NATIVE, name, entry)
    return given


@pytest.mark.parametrize(
    ("limit", "left"), [(1.0, [1.0, 0.6]), (0.5, [0.5, 0.1]), (0.4, [0.4]), (None, [None, None])]
)
def test_auto_leaves_to_the_second_solver_what_the_first_has_left(slow_solvers, limit, left):
    solver = create("auto", SolverOptions(time_limit=limit))
    assert solver.solve(sample(6, 2, bounds="all")).status is SolveStatus.UNCONSTRAINED
    assert slow_solvers == (left if limit is None else pytest.approx(left))


@pytest.mark.parametrize("stages", [5, 100])
def test_auto_prefers_a_clock_where_there_is_a_limit(stages):
    names = [name for name in ("daqp", "clarabel", "osqp") if name in available()]
    if len(names) < 2:
        pytest.skip("needs two of daqp, clarabel and osqp")
    solver = create("auto", SolverOptions(time_limit=1.0))
    solver.prepare(2 * stages)
    for others in solver._others.values():
        kinds = {type(other.solver).__name__ for other in others}
        assert kinds <= {"DaqpSolver", "ClarabelSolver", "OsqpSolver"}
