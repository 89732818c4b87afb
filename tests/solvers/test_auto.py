"""The backend "auto": which solvers it takes, and what it leaves to the second one."""

from dataclasses import replace

import numpy as np
import pytest

import qpmhe_solvers.auto
from qpmhe_solvers import Backend, RawSolution, Solver, SolverOptions, SolveStatus, create
from qpmhe_solvers.native import NATIVE

from .problems import CASES, EVERY, TIGHT, make
from .test_backends import check_optimal

UNCONSTRAINED = SolveStatus.UNCONSTRAINED
BOXED = make(6, 2, bounds="all")[0]


def replace_natives(monkeypatch, factory):
    """Have "auto" choose among backends that this makes."""
    for name in NATIVE:
        monkeypatch.setitem(NATIVE, name, Backend(name, factory, "-", iterate_at_cap=True))


def test_it_is_banded_where_no_inequality_binds(monkeypatch):
    replace_natives(monkeypatch, lambda options: pytest.fail("a solver was made"))
    for case in ("no inequality", "only unused rows"):
        qp, _ = make(**CASES[case])
        solution = create("auto").solve(qp)
        assert solution.status is SolveStatus.SOLVED
        np.testing.assert_array_equal(solution.d, create("banded").solve(qp).d)


def test_it_chooses_by_size_cap_and_clock(monkeypatch):
    monkeypatch.setattr(qpmhe_solvers.auto, "_EXCHANGES", 0)
    chosen, make_solver = [], qpmhe_solvers.auto.make_solver
    monkeypatch.setattr(
        qpmhe_solvers.auto, "make_solver",
        lambda backend, options: chosen.append(backend.name) or make_solver(backend, options),
    )
    for stages, cap, order in (
        (30, None, ["daqp", "piqp"]), (31, None, ["piqp"]), (30, 2, ["piqp"]), (31, 2, ["piqp"]),
    ):
        chosen.clear()
        qp, dense = make(stages, 2, bounds="all")
        solver = create("auto", replace(TIGHT, max_iterations=cap))
        solution = solver.solve(qp)
        solver.solve(qp)
        assert chosen[0] == next(name for name in order if name in EVERY)
        assert len(chosen) <= 2  # the second stands by for a failure
        if cap is None:
            check_optimal("auto", qp, dense, solution)
        else:
            assert solution.status is SolveStatus.STOPPED
    clocked = {"daqp", "clarabel", "osqp"}
    for size in (10, 200) if len(clocked & set(EVERY)) >= 2 else ():
        chosen.clear()
        create("auto", SolverOptions(time_limit=1.0)).prepare(size)
        assert set(chosen) <= clocked


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


def test_the_second_solver_has_what_the_first_left_of_the_time_and_knows_the_shifts(monkeypatch):
    monkeypatch.setattr("qpmhe_solvers.auto.perf_counter", lambda: Scene.now[0])
    replace_natives(monkeypatch, Scene)
    for limit, left in [(1.0, [1.0, 0.6]), (0.4, [0.4]), (None, [None, None])]:
        Scene.left.clear()
        Scene.now[0] = 0.0
        solver = create("auto", SolverOptions(time_limit=limit))
        assert solver.solve(BOXED).status is UNCONSTRAINED
        assert Scene.left == (left if limit is None else pytest.approx(left))
    for shifts, passed_on in ((0, 0), (2, 2), (100, 6)):
        for _ in range(shifts):
            solver.shift()
        assert Scene.calls == []
        solver.solve(BOXED)
        assert Scene.calls == ["shift"] * 2 * passed_on  # there are two solvers
        Scene.calls.clear()
    solver.shift()
    solver.forget()
    solver.solve(BOXED)
    assert Scene.calls == ["forget", "forget"]


def unmakeable(options):
    raise ImportError("broken package")


def test_it_contains_broken_packages_and_needs_none(monkeypatch):
    natives = dict(NATIVE)
    for broken in (True, False):
        replace_natives(monkeypatch, unmakeable)
        if not broken:
            for name, native in natives.items():
                monkeypatch.setitem(NATIVE, name, replace(native, module="not_installed_here"))
        solver = create("auto")
        solver.prepare(12)
        solver.shift()
        solution = solver.solve(BOXED)
        assert solution.status is UNCONSTRAINED
        np.testing.assert_array_equal(solution.d, create("banded").solve(BOXED).d)
        solver.forget()
