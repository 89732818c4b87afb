"""Whatever class a solver is of: nothing but KeyboardInterrupt gets out of `ContainedSolver`."""

import warnings

import numpy as np
import pytest

import qpmhe_solvers.native
from qpmhe_solvers import (
    Backend,
    RawSolution,
    Recording,
    Residuals,
    Solution,
    Solver,
    SolverOptions,
    SolveStatus,
    create,
)
from qpmhe_solvers.solver import ContainedSolver

from .problems import ARRAYS, CASES, make, numbers, registered

FAILED, SOLVED = SolveStatus.FAILED, SolveStatus.SOLVED


class Panic(BaseException):
    """As compiled code raises it."""


class SpeechlessError(Exception):
    def __str__(self):
        raise RuntimeError("no words")


class Hostile(Solver):
    """Overrides all of the contract."""

    def __init__(self, behaviour):
        super().__init__(SolverOptions())
        self.behaviour = behaviour

    def _solve(self, qp, start):
        raise NotImplementedError

    def solve(self, qp, start=None):
        return self.behaviour(qp)

    def shift(self):
        self.behaviour(None)

    def forget(self):
        self.behaviour(None)

    def prepare(self, size):
        self.behaviour(None)


def problem():
    return make(**CASES["all kinds"], seed=3)[0]


def ask(behaviour, qp=None):
    return ContainedSolver(Hostile(behaviour)).solve(problem() if qp is None else qp)


def raising(error):
    def behaviour(qp):
        raise error

    return behaviour


ERRORS = [KeyError("it"), SystemExit(3), GeneratorExit("it"), Panic("it"), SpeechlessError()]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_whatever_is_raised_stays_inside(error):
    solution = ask(raising(error))
    assert solution.status is FAILED
    assert solution.message.startswith(type(error).__name__)
    solver = ContainedSolver(Hostile(raising(error)))
    solver.shift()
    solver.forget()
    solver.prepare(3)


def test_the_user_can_still_interrupt():
    solver = ContainedSolver(Hostile(raising(KeyboardInterrupt())))
    for method, *arguments in (
        (solver.solve, problem()), (solver.shift,), (solver.forget,), (solver.prepare, 3),
    ):
        with pytest.raises(KeyboardInterrupt):
            method(*arguments)


class Touchy(Solution):
    """Has no step to show."""

    __slots__ = ()

    @property
    def d(self):
        raise RuntimeError("do not touch")

    @d.setter
    def d(self, value):
        pass


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (None, "the backend's solve returned NoneType, not a Solution"),
        ("solved", "the backend's solve returned str, not a Solution"),
        (RawSolution(np.zeros(21), True), "the backend's solve returned RawSolution"),
        (Solution(np.zeros(3), SOLVED), "the solver returned 3 numbers for 21 unknowns"),
        (Solution(np.zeros((7, 4)), SOLVED), "the solver returned 28 numbers for 21 unknowns"),
        (Solution(None, SOLVED), "the solver returned no iterate"),
        (Solution(np.full((7, 3), np.nan), SOLVED), "the solver returned an iterate that is not"),
        (Solution(np.full((7, 3), np.inf), SOLVED), "the solver returned an iterate that is not"),
        (Solution(np.zeros((7, 3), complex), SOLVED), "the solver returned complex numbers"),
        (Solution("solved", SOLVED), "ValueError"),
        (Solution({}, SOLVED), "TypeError"),
        (Solution(np.zeros((7, 3)), "solved"), "the status of the backend's Solution is str"),
        (Solution(np.zeros((7, 3)), None), "the status of the backend's Solution is NoneType"),
        (Solution(np.zeros((7, 3)), FAILED, message="gave up"), "gave up"),
        (Touchy(None, SOLVED), "RuntimeError: do not touch"),
    ],
)
def test_what_is_no_solution_is_a_failure(found, message):
    solution = ask(lambda qp: found)
    assert (solution.d, solution.status) == (None, FAILED)
    assert solution.message.startswith(message)


@pytest.mark.parametrize("given_as", [np.copy, np.ravel, np.ndarray.tolist, np.asfortranarray])
def test_a_step_is_read_as_numbers(given_as):
    d = np.arange(21.0).reshape(7, 3)
    solution = ask(lambda qp: Solution(given_as(d), SOLVED, 5, message="done"))
    assert (solution.status, solution.iterations, solution.message) == (SOLVED, 5, "done")
    assert solution.d.dtype == np.float64
    np.testing.assert_array_equal(solution.d, d)


def test_what_comes_with_a_step_is_dropped_where_it_cannot_be_used():
    solution = ask(
        lambda qp: Solution(np.zeros((7, 3)), SOLVED, 2.5, "small", np.zeros(4), {}, 7)
    )
    assert (solution.status, solution.iterations, solution.residuals) == (SOLVED, None, None)
    assert (solution.bound_duals, solution.row_duals) == (None, None)
    assert isinstance(solution.message, str)
    kept = Residuals(0.0, 0.0, 0.0)
    solution = ask(
        lambda qp: Solution(np.zeros((7, 3)), SOLVED, 2, kept, np.ones(21), np.ones(14))
    )
    assert solution.residuals is kept
    assert (solution.bound_duals.sum(), solution.row_duals.sum()) == (21.0, 14.0)


def test_an_overridden_solve_is_lent_a_copy_and_its_buffer_is_not_kept():
    work = np.zeros((7, 3))

    def behaviour(qp):
        for name in ARRAYS:
            getattr(qp, name)[...] = 1e-12
        return Solution(work, SOLVED)

    qp = problem()
    before = numbers(qp)
    solution = ask(behaviour, qp)
    work[...] = np.nan
    assert not solution.d.any()
    for array, values in before.items():
        np.testing.assert_array_equal(getattr(qp, array), values)


def test_warnings_of_an_overridden_solve_stay_inside():
    def behaviour(qp):
        warnings.warn("ill-conditioned", UserWarning, stacklevel=1)
        return Solution(np.zeros((7, 3)), SOLVED)

    assert ask(behaviour).status is SOLVED  # here, a warning that leaks is an error


def test_a_solve_that_was_put_on_the_object_is_contained_too():
    solver = create("banded")
    solver.solve = lambda qp, start=None: "no Solution"
    assert ContainedSolver(solver).solve(problem()).status is FAILED


def test_an_answer_of_our_own_solvers_is_handed_on_as_it_is():
    solver = create("banded")
    solution = ContainedSolver(solver).solve(make(6, 2)[0])
    assert np.shares_memory(solution.d, solver._work[2])


def test_the_time_limit_is_set_and_may_be_refused():
    class Stubborn(Hostile):
        @property
        def time_limit(self):
            return None

        @time_limit.setter
        def time_limit(self, value):
            if value is not None:
                raise AttributeError("no clock")

    contained = ContainedSolver(create("banded"))
    contained.solve(problem(), None, 0.25)
    assert contained.solver.time_limit == 0.25
    contained = ContainedSolver(Stubborn(lambda qp: Solution(np.zeros((7, 3)), SOLVED)))
    assert contained.solve(problem()).status is SOLVED
    assert contained.solve(problem(), None, 0.25).message == "AttributeError: no clock"


@pytest.mark.parametrize("behaviour", [raising(Panic()), lambda qp: 3], ids=["raises", "returns"])
def test_auto_contains_solvers_that_override_solve(monkeypatch, behaviour):
    for name in ("clarabel", "daqp", "osqp", "piqp", "proxqp"):
        entry = Backend(name, lambda options: Hostile(behaviour), "-", iterate_at_cap=True)
        monkeypatch.setitem(qpmhe_solvers.native.NATIVE, name, entry)
    solver = create("auto")
    solver.prepare(12)
    solver.shift()
    assert solver.solve(make(6, 2, bounds="all")[0]).status is SolveStatus.UNCONSTRAINED
    solver.forget()


def test_auto_passes_on_how_far_the_trajectory_moved(monkeypatch):
    calls = []

    class Counting(Hostile):
        def shift(self):
            calls.append("shift")

        def forget(self):
            calls.append("forget")

    for name in ("clarabel", "daqp", "osqp", "piqp", "proxqp"):
        entry = Backend(name, lambda options: Counting(lambda qp: None), "-", iterate_at_cap=True)
        monkeypatch.setitem(qpmhe_solvers.native.NATIVE, name, entry)
    solver, qp = create("auto"), make(6, 2, bounds="all")[0]
    solver.solve(qp)
    for shifts, told in ((0, 0), (2, 2), (0, 0), (100, 6)):
        for _ in range(shifts):
            solver.shift()
        assert calls == []
        solver.solve(qp)
        assert calls == ["shift"] * 2 * told  # there are two solvers
        calls.clear()
    solver.shift()
    solver.forget()
    solver.solve(qp)
    assert calls == ["forget", "forget"]


def test_a_recorded_solver_is_trusted_no_more_than_without_recording(tmp_path):
    entry = Backend("hostile", lambda options: Hostile(lambda qp: "no Solution"), "-")
    with registered(entry), Recording(tmp_path, "hostile") as recording:
        solution = ContainedSolver(create(recording.backend)).solve(problem())
    assert solution.message == "the backend's solve returned str, not a Solution"
