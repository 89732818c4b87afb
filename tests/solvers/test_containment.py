"""Whatever a solver does, nothing but KeyboardInterrupt gets out, and no claim is believed."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qpmhe_solvers import (
    Backend,
    InvalidInputError,
    RawSolution,
    Recording,
    Residuals,
    Solution,
    Solver,
    SolverOptions,
    SolveStatus,
    create,
)
from qpmhe_solvers.dispatch import DispatchSolver
from qpmhe_solvers.qp import ARRAYS
from qpmhe_solvers.solver import ContainedSolver

from .problems import CASES, EVERY, TIGHT, make, numbers, of_order_one, registered

pytest.importorskip("quadprog")
FAILED, SOLVED = SolveStatus.FAILED, SolveStatus.SOLVED
STOPPED, INACCURATE = SolveStatus.STOPPED, SolveStatus.INACCURATE
QP, DENSE = of_order_one(make(**CASES["all kinds"], seed=3)[0])
BEST = create("quadprog", TIGHT).solve(QP)


class Scripted(Solver):
    """Does what it is told, and remembers what it was given."""

    def __init__(self, behaviour, options=SolverOptions()):  # noqa: B008 (frozen)
        super().__init__(options)
        self.behaviour, self.starts = behaviour, []

    def _solve(self, qp, start):
        self.starts.append(start)
        return self.behaviour(qp)


class Overriding(Scripted):
    """Overrides all of the contract."""

    def solve(self, qp, start=None):
        return self.behaviour(qp)

    def shift(self, *_):
        self.behaviour(None)

    forget = prepare = shift


def ask(behaviour, qp=QP, options=None):
    """Register a backend that behaves so, solve by its name, and check what always holds."""
    entry = Backend("scripted", lambda given: Scripted(behaviour, given), "theatre")
    before = numbers(qp)
    with registered(entry):
        solution = create("scripted", options).solve(qp)
    assert isinstance(solution, Solution)
    assert (solution.d is None) == (solution.status is FAILED)
    if solution.d is not None:
        assert (solution.d.shape, solution.d.dtype) == ((qp.stages, qp.n), np.float64)
        assert np.isfinite(solution.d).all()
    for array, values in before.items():
        np.testing.assert_array_equal(getattr(qp, array), values)
    return solution


def contained(behaviour, qp=QP):
    """What a solver's own `solve` is made of."""
    return ContainedSolver(Overriding(behaviour)).solve(qp)


def raw(**changes):
    """The true solution and multipliers, but for the changes."""
    honest = {"d": BEST.d, "bound_duals": BEST.bound_duals, "row_duals": BEST.row_duals}
    return RawSolution(**{"claimed": True, "iterations": 7, **honest, **changes})


def giving(found):
    return lambda qp: found


def answer(**changes):
    return giving(raw(**changes))


def raising(error):
    def behaviour(qp):
        raise error

    return behaviour


def test_the_honest_are_believed():
    solution = ask(answer(message="well done"))
    assert (solution.status, solution.iterations, solution.message) == (SOLVED, 7, "well done")
    assert DENSE.violation(solution.d) < 1e-9
    assert max(solution.residuals.primal, solution.residuals.dual, solution.residuals.gap) < 1e-9
    assert repr(solution).startswith("Solution(SOLVED, iterations=7, Residuals(primal=")
    for claimed in (False, np.array([True, False]), np.array([]), "yes", None, 1j):
        assert ask(answer(claimed=claimed)).status is STOPPED
    assert [status for status in SolveStatus if not status.usable] == [FAILED]
    assert all(":" in status.value for status in SolveStatus)


class Panic(BaseException):
    """As compiled code raises it."""


class SpeechlessError(Exception):
    def __str__(self):
        raise RuntimeError("no words")


@pytest.mark.parametrize(
    "error",
    [
        KeyError("all of it"), MemoryError("all of it"), StopIteration("all of it"),
        Warning("all of it"), Panic("all of it"), SpeechlessError(),
        # To leave is to fail: an estimator must not end with the solver that it tried.
        SystemExit("all of it"), GeneratorExit("all of it"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_exception_is_a_failure_with_its_words(error):
    for solution in (ask(raising(error)), contained(raising(error))):
        assert (solution.status, solution.d) == (FAILED, None)
        assert solution.message.startswith(type(error).__name__)
        assert "all of it" in solution.message or isinstance(error, SpeechlessError)
    solver = ContainedSolver(Overriding(raising(error)))
    solver.shift()
    solver.forget()
    solver.prepare(3)


def test_the_user_can_still_interrupt():
    stop = raising(KeyboardInterrupt())
    solver = ContainedSolver(Overriding(stop))
    for method, *arguments in (
        (ask, stop), (solver.solve, QP), (solver.shift,), (solver.forget,), (solver.prepare, 3),
    ):
        with pytest.raises(KeyboardInterrupt):
            method(*arguments)


def test_a_claim_is_not_judged_by_what_the_solver_left_of_the_problem():
    for name in ARRAYS:
        def scale(lent, name=name):
            getattr(lent, name)[...] *= 1e-12
            lent.gradient *= 1e-12  # at zero, without multipliers, there is now nothing left to do
            return RawSolution(np.zeros(21), True, 1, np.zeros(21), np.zeros(14))

        solution = ask(scale)
        assert solution.status is INACCURATE
        assert solution.residuals.dual == np.abs(QP.gradient).max()
        assert solution.message.startswith("it wrote into ")
        assert name in solution.message
        assert "read-only" in solution.message


def test_who_scribbles_is_named_unless_right():
    for changes, expected in [
        ({}, (SOLVED, "")),  # who is right all the same is believed
        ({"claimed": False, "message": "gave up"},
         (STOPPED, "gave up; it wrote into band, gradient, ")),
    ]:
        def scribble(lent, changes=changes):
            for name in ARRAYS:
                getattr(lent, name)[...] = 1e-12
            lent.bounded = False
            return raw(**changes)

        solution = ask(scribble)
        assert solution.status is expected[0]
        assert solution.message.startswith(expected[1])
        assert QP.bounded
        assert ask(answer(claimed=False)).message == ""  # who only reads is not accused

        class Derived(DispatchSolver):  # of one of ours: lent copies as well
            def _solve(self, qp, start):
                return scribble(qp)

        assert Derived("quadprog", SolverOptions()).solve(QP).status is expected[0]
        assert QP.gradient.all()


def test_an_overridden_solve_is_lent_a_copy_and_its_buffer_is_not_kept():
    work = np.zeros((7, 3))

    def behaviour(qp):
        for name in ARRAYS:
            getattr(qp, name)[...] = 1e-12
        warnings.warn("ill-conditioned", UserWarning, stacklevel=1)
        return Solution(work, SOLVED)

    before = numbers(QP)
    solution = contained(behaviour)  # here, a warning that leaks is an error
    work[...] = np.nan
    assert not solution.d.any()
    for array, values in before.items():
        np.testing.assert_array_equal(getattr(QP, array), values)


@pytest.mark.parametrize("name", EVERY)
def test_what_is_no_qp_is_refused(name):
    for solver in (create(name), Scripted(answer())):
        for thing in (None, 3, "a QP", np.zeros(3)):
            with pytest.raises(InvalidInputError, match=r"qp is .*; expected a qpmhe.solvers.QP"):
                solver.solve(thing)


def test_something_else_than_a_solution():
    for thing in [None, 3, "solved", {}, np.zeros(21), (None, True)]:
        kind = type(thing).__name__
        assert ask(giving(thing)).message == f"the backend returned {kind}, not a RawSolution"
        expected = f"the backend's solve returned {kind}, not a Solution"
        assert contained(giving(thing)).message == expected


NOT_FINITE = "the solver returned an iterate that is not finite"


def test_an_unusable_iterate():
    for d, message in [
        (None, "the solver returned no iterate"),
        (np.zeros(20), "the solver returned 20 numbers for 21 unknowns"),
        (np.zeros((7, 4)), "the solver returned 28 numbers for 21 unknowns"),
        ([], "the solver returned 0 numbers for 21 unknowns"),
        (1.5, "the solver returned 1 numbers for 21 unknowns"),
        (np.append(np.zeros(20), np.nan), NOT_FINITE),
        (np.append(np.zeros(20), -np.inf), NOT_FINITE),
        ("solved", "ValueError: could not convert string to float"),
        ([[0.0] * 20, [0.0]], "ValueError: "),
        ({}, "TypeError: "),
        ([1j] * 21, "the solver returned complex numbers"),
    ]:
        for claimed in (True, False):
            solution = ask(answer(d=d, claimed=claimed))
            assert (solution.status, solution.residuals) == (FAILED, None)
            assert solution.message.startswith(message)
        solution = contained(giving(Solution(d, SOLVED)))
        assert (solution.d, solution.status) == (None, FAILED)
        assert solution.message.startswith(message)


class Touchy(Solution):
    """Has no step to show."""

    __slots__ = ()
    d = property(raising(RuntimeError("do not touch")), lambda self, value: None)


def test_solutions_that_are_none():
    for found, message in [
        (raw(), "the backend's solve returned RawSolution"),
        (Solution(np.zeros((7, 3)), "solved"), "the status of the backend's Solution is str"),
        (Solution(np.zeros((7, 3)), FAILED, message="gave up"), "gave up"),
        (Touchy(None, SOLVED), "RuntimeError: do not touch"),
    ]:
        solution = contained(giving(found))
        assert (solution.d, solution.status) == (None, FAILED)
        assert solution.message.startswith(message)


def test_the_words_of_a_solver_without_iterate_are_kept():
    solution = ask(answer(d=None, claimed=False, message="gave up"))
    assert (solution.status, solution.message, solution.iterations) == (FAILED, "gave up", 7)


def test_the_form_of_an_iterate_is_free():
    for shape in [(21,), (7, 3), (21, 1), (1, 21)]:
        d = BEST.d.reshape(shape)
        for given_as in (d, d.tolist(), np.asfortranarray(d), d.astype(object)):
            for solution in (
                ask(answer(d=given_as)), contained(giving(Solution(given_as, SOLVED, 5))),
            ):
                assert solution.status is SOLVED
                np.testing.assert_array_equal(solution.d, BEST.d)


def interior(where):
    """A QP, a point, and the gradient there."""
    qp, dense = of_order_one(make(6, 2, bounds="all", seed=3)[0])
    d = {"inside": (qp.lower + qp.upper) / 2, "far": np.full((6, 2), 100.0)}[where]
    return qp, d, dense.hessian @ d.ravel() + dense.gradient


def test_success_that_is_none():
    for options in [
        SolverOptions(), SolverOptions(absolute_tolerance=1e-3),
        SolverOptions(relative_tolerance=1e-3),
    ]:
        d = BEST.d.copy()
        d[0] += 1.0
        for duals in ({}, {"bound_duals": None, "row_duals": None}):
            solution = ask(answer(d=d, **duals), options=options)
            assert (solution.status, solution.status.usable) == (INACCURATE, True)
            assert solution.residuals.primal == pytest.approx(DENSE.violation(d))
            np.testing.assert_array_equal(solution.d, d)
        zeros, none = np.zeros(12), np.zeros(0)
        qp, d, gradient = interior("inside")
        solution = ask(answer(d=d, bound_duals=zeros, row_duals=none), qp, options)
        assert (solution.status, solution.residuals.primal) == (INACCURATE, 0.0)
        assert solution.residuals.dual == pytest.approx(np.abs(gradient).max())
        # Every point is stationary with these; that they push from no bound shows in the gap.
        solution = ask(answer(d=d, bound_duals=-gradient, row_duals=none), qp, options)
        assert solution.status is INACCURATE
        assert solution.residuals.gap > 0.01
        # At zero, with multipliers zero, there is no gap and no violation, only a gradient.
        qp.lower[...], qp.upper[...] = -0.1, 0.1
        solution = ask(answer(d=zeros, bound_duals=zeros, row_duals=none), qp, options)
        assert (solution.residuals.primal, solution.residuals.gap) == (0.0, 0.0)
        assert (solution.status, solution.residuals.dual) == (INACCURATE, np.abs(qp.gradient).max())
        qp, d, gradient = interior("far")
        solution = ask(answer(d=d, bound_duals=-gradient, row_duals=none), qp, options)
        assert solution.status is INACCURATE


@pytest.mark.parametrize(
    "duals",
    [
        np.zeros(20), np.zeros(22), 0.0, np.full(21, np.nan), np.full(21, np.inf), "none",
        ["a"] * 21, [[0.0], [0.0, 1.0]], {}, object(), [1j] * 21,
    ],
    ids=lambda one: type(one).__name__,
)
@pytest.mark.parametrize("which", ["bound_duals", "row_duals"])
def test_unusable_multipliers_are_dropped(which, duals):
    solution = ask(answer(**{which: duals}))
    # The iterate is there and feasible; only its optimality is unknown.
    assert solution.status in (SOLVED, INACCURATE)
    assert getattr(solution, which) is None
    assert solution.residuals.primal < 1e-9
    assert np.isnan([solution.residuals.dual, solution.residuals.gap]).all()
    assert ask(answer(d=BEST.d + 1.0, **{which: duals})).status is INACCURATE
    assert getattr(contained(lambda qp: Solution(BEST.d, SOLVED, **{which: duals})), which) is None


def test_what_comes_with_a_step_is_kept_where_it_can_be_used():
    kept = Residuals(0.0, 0.0, 0.0)
    solution = contained(lambda qp: Solution(BEST.d, SOLVED, 2, kept, np.ones(21), np.ones(14)))
    assert solution.residuals is kept
    assert (solution.bound_duals.sum(), solution.row_duals.sum()) == (21.0, 14.0)
    solution = contained(lambda qp: Solution(BEST.d, SOLVED, 2.5, "small", message=7))
    assert (solution.status, solution.iterations, solution.residuals) == (SOLVED, None, None)
    assert isinstance(solution.message, str)


def test_huge_finite_numbers_are_judged():
    for changes in [
        {"d": 1e308 * (-1.0) ** np.arange(21)}, {"d": np.full(21, 1e308)},
        {"bound_duals": np.full(21, 1e308)}, {"row_duals": np.full(14, 1e308)},
    ]:
        assert ask(answer(**changes)).status is INACCURATE


def test_warnings_stay_inside():
    def behaviour(qp):
        warnings.warn("ill-conditioned", UserWarning, stacklevel=1)
        np.float64(1.0) / np.float64(0.0)
        return raw()

    filters = list(warnings.filters)
    assert ask(behaviour).status is SOLVED  # pytest's filters turn what leaks into an error
    assert warnings.filters == filters


def test_what_reaches_a_solver():
    spoilt, ones = QP.copy(), np.ones((7, 3))
    spoilt.row_own[1, 0, 0] = np.nan
    solver = Scripted(answer())
    assert solver.solve(spoilt).message == "the QP's data are not finite"
    assert solver.starts == []
    # osqp reads as many numbers as there are unknowns, whatever the length of the start.
    for start in (None, np.zeros(3), np.zeros((7, 4)), np.nan * ones, np.inf * ones):
        solver.solve(QP, start)
        assert solver.starts.pop() is None
    assert solver.solve(QP, ones).status is SOLVED
    lent = solver.starts.pop()
    assert (lent == 1.0).all()
    assert lent is not ones
    cold = Scripted(answer(), SolverOptions(warm_start=False))
    cold.solve(QP, ones)
    assert cold.starts == [None]


def test_reused_buffers_do_not_reach_the_caller():
    buffers = {name: getattr(BEST, name).copy() for name in ("d", "bound_duals", "row_duals")}
    solution = ask(answer(**buffers))
    for name, buffer in buffers.items():
        buffer[...] = np.nan
        assert np.isfinite(getattr(solution, name)).all()


def test_a_failure_is_forgotten():
    solver = Scripted(raising(KeyError("first")))
    assert solver.solve(QP).status is FAILED
    solver.behaviour = answer()
    assert solver.solve(QP).status is SOLVED


def test_only_our_own_solve_is_trusted(tmp_path):
    solver = create("banded")
    qp = make(6, 2)[0]
    assert np.shares_memory(ContainedSolver(solver).solve(qp).d, solver._work[2])
    solver.solve = lambda qp, start=None: "no Solution"
    assert ContainedSolver(solver).solve(qp).status is FAILED
    entry = Backend("hostile", lambda options: Overriding(lambda qp: "no Solution"), "-")
    with registered(entry), Recording(tmp_path, "hostile") as recording:
        solution = ContainedSolver(create(recording.backend)).solve(QP)
    assert solution.message == "the backend's solve returned str, not a Solution"


def test_the_time_limit_is_set_and_may_be_refused():
    class Stubborn(Overriding):
        @property
        def time_limit(self):
            return None

        @time_limit.setter
        def time_limit(self, value):
            if value is not None:
                raise AttributeError("no clock")

    usual = ContainedSolver(create("banded"))
    usual.solve(QP, None, 0.25)
    assert usual.solver.time_limit == 0.25
    stubborn = ContainedSolver(Stubborn(lambda qp: Solution(BEST.d, SOLVED)))
    assert stubborn.solve(QP).status is SOLVED
    assert stubborn.solve(QP, None, 0.25).message == "AttributeError: no clock"


rubbish = st.one_of(
    st.none(), st.booleans(), st.floats(), st.text(max_size=3), st.complex_numbers(),
    st.lists(st.floats(), max_size=5), st.dictionaries(st.text(max_size=1), st.none()),
    st.lists(st.floats(), min_size=4, max_size=4),
    st.lists(st.one_of(st.none(), st.text(max_size=2), st.floats()), min_size=4, max_size=4),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).map(np.array),
)
iterates = st.one_of(rubbish, st.lists(st.floats(-1e6, 1e6), min_size=4, max_size=4))


@given(d=iterates, claimed=st.booleans(), bound_duals=rubbish, row_duals=rubbish)
@settings(max_examples=100, derandomize=True, deadline=None)
def test_any_answer_is_contained(d, claimed, bound_duals, row_duals):
    qp, dense = make(2, 2, 2, bounds="part", sides="two")
    for found in (d, RawSolution(d, claimed, None, bound_duals, row_duals)):
        solution = ask(giving(found), qp)
        assert solution.status is not SOLVED or dense.violation(solution.d) <= 1e-3


@pytest.mark.parametrize("case", CASES)
def test_residuals_equal_those_of_full_matrices(case):
    qp, dense = make(**CASES[case], seed=5)
    rng = np.random.default_rng(6)
    d, duals = rng.standard_normal((qp.stages, qp.n)), rng.standard_normal(dense.low.size)
    duals[np.isinf(np.where(duals > 0, dense.high, dense.low))] = 0.0  # of sides that are there
    bounds, rows = np.split(duals, [qp.size])
    residuals = Residuals.of(qp, d, bounds, rows)
    assert residuals.primal == pytest.approx(dense.violation(d))
    assert residuals.dual == pytest.approx(dense.stationarity(d, duals))
    assert residuals.gap == pytest.approx(dense.gap(d, duals))
    assert Residuals.of(qp, d, None, rows).primal == residuals.primal
    assert np.isnan(Residuals.of(qp, d, None, rows).gap)
    assert np.isnan(Residuals.of(qp, d, bounds, None).dual)


def test_a_multiplier_without_a_bound_does_not_count():
    qp, _ = make(2, 2, bounds="all")
    qp.upper[0, 0] = np.inf
    solution = create("quadprog").solve(qp)
    found = []
    for multiplier in (0.0, 1e-16, 1e-3):
        duals = solution.bound_duals.copy()
        duals[0] = multiplier
        found.append(Residuals.of(qp, solution.d, duals, np.zeros(0)))
    assert found[0] == found[1] == found[2]
    assert found[0].gap < 1e-6
