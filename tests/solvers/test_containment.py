import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import qpmhe_solvers.native
from qpmhe_solvers import (
    Backend,
    InvalidInputError,
    RawSolution,
    Residuals,
    Solution,
    Solver,
    SolverOptions,
    SolveStatus,
    create,
)
from qpmhe_solvers.dispatch import DispatchSolver

from .problems import ARRAYS, CASES, EVERY, make, numbers, of_order_one, registered

FAILED, SOLVED = SolveStatus.FAILED, SolveStatus.SOLVED
STOPPED, INACCURATE = SolveStatus.STOPPED, SolveStatus.INACCURATE


class Scripted(Solver):
    """Does what it is told, and remembers what it was given."""

    def __init__(self, behaviour, options=SolverOptions()):  # noqa: B008 (frozen)
        super().__init__(options)
        self.behaviour, self.starts = behaviour, []

    def _solve(self, qp, start):
        self.starts.append(start)
        return self.behaviour(qp)


def ask(behaviour, qp, options=None):
    """Register a backend that behaves so, solve by its name, and check what always holds."""
    entry = Backend("scripted", lambda given: Scripted(behaviour, given), "theatre")
    with registered(entry):
        solution = create("scripted", options).solve(qp)
    assert isinstance(solution, Solution)
    assert (solution.d is None) == (solution.status is FAILED)
    if solution.d is not None:
        assert solution.d.shape == (qp.stages, qp.n)
        assert solution.d.dtype == np.float64
        assert np.isfinite(solution.d).all()
    return solution


def answer(**changes):
    """A behaviour that answers with the true solution and multipliers, but for the changes."""

    def behaviour(qp):
        honest = dict(zip(("d", "bound_duals", "row_duals"), optimum(), strict=True))
        return RawSolution(**{"claimed": True, "iterations": 7, **honest, **changes})

    return behaviour


def problem():
    return of_order_one(make(**CASES["all kinds"], seed=3)[0])


def optimum():
    qp, _ = problem()
    solution = create("quadprog", SolverOptions(absolute_tolerance=1e-9)).solve(qp)
    return solution.d, solution.bound_duals, solution.row_duals


def raising(error):
    def behaviour(qp):
        raise error

    return behaviour


def test_the_honest_are_believed():
    qp, dense = problem()
    solution = ask(answer(message="well done"), qp)
    assert solution.status is SOLVED
    assert solution.iterations == 7
    assert solution.message == "well done"
    assert dense.violation(solution.d) < 1e-9
    assert max(solution.residuals.primal, solution.residuals.dual, solution.residuals.gap) < 1e-9


def test_stopped_where_no_success_is_claimed():
    qp, _ = problem()
    solution = ask(answer(claimed=False, message="cap"), qp)
    assert (solution.status, solution.message) == (STOPPED, "cap")
    assert solution.status.usable


@pytest.mark.parametrize(
    "error",
    [
        Exception("all of it"), KeyError("all of it"), ValueError("all of it"),
        MemoryError("all of it"), RecursionError("all of it"), StopIteration("all of it"),
        FloatingPointError("all of it"), ImportError("all of it"), Warning("all of it"),
        # To leave is to fail: an estimator must not end with the solver that it tried.
        SystemExit("all of it"), GeneratorExit("all of it"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_exception_is_a_failure_with_its_words(error):
    solution = ask(raising(error), problem()[0])
    assert solution.status is FAILED
    assert not solution.status.usable
    assert solution.message.startswith(f"{type(error).__name__}: ")
    assert "all of it" in solution.message


def test_the_user_can_still_interrupt():
    with pytest.raises(KeyboardInterrupt):
        ask(raising(KeyboardInterrupt()), problem()[0])


def scribbling(answer):
    """A behaviour that overwrites all that it was lent, then answers."""

    def behaviour(qp):
        for name in ARRAYS:
            getattr(qp, name)[...] = 1e-12
        qp.bounded = False
        return answer(qp)

    return behaviour


@pytest.mark.parametrize("name", ARRAYS)
def test_a_claim_is_not_judged_by_what_the_solver_left_of_the_problem(name):
    qp, _ = problem()
    before = numbers(qp)

    def scale(lent):
        getattr(lent, name)[...] *= 1e-12
        lent.gradient *= 1e-12  # at zero, without multipliers, there is now nothing left to do
        return RawSolution(np.zeros(21), True, 1, np.zeros(21), np.zeros(14))

    solution = ask(scale, qp)
    assert solution.status is INACCURATE
    assert solution.residuals.dual == np.abs(qp.gradient).max()
    assert solution.message.startswith("it wrote into ")
    assert name in solution.message
    assert "read only" in solution.message
    for array, values in before.items():
        np.testing.assert_array_equal(getattr(qp, array), values)


def test_who_scribbles_and_is_right_all_the_same_is_believed():
    qp, _ = problem()
    before = numbers(qp)
    solution = ask(scribbling(answer()), qp)
    assert (solution.status, solution.message) == (SOLVED, "")
    for array, values in before.items():
        np.testing.assert_array_equal(getattr(qp, array), values)
    assert qp.bounded


def test_the_words_of_a_solver_that_scribbles_are_kept():
    solution = ask(scribbling(answer(claimed=False, message="gave up")), problem()[0])
    assert solution.status is STOPPED
    assert solution.message.startswith("gave up; it wrote into band, gradient, ")


def test_the_start_is_lent_as_a_copy():
    class Greedy(Scripted):
        def _solve(self, qp, start):
            start[...] = 7.0
            return super()._solve(qp, start)

    qp, _ = problem()
    start = np.ones((7, 3))
    assert Greedy(answer()).solve(qp, start).status is SOLVED
    assert (start == 1.0).all()


def test_who_only_reads_is_not_accused():
    solver = Scripted(answer(claimed=False))
    assert solver.solve(problem()[0]).message == ""
    assert solver._wrote == ()


def test_a_solver_derived_from_one_of_ours_is_lent_copies():
    pytest.importorskip("quadprog")

    class Derived(DispatchSolver):
        def _solve(self, qp, start):
            qp.gradient[...] = 0.0
            return RawSolution(np.zeros(qp.size), True, 1, np.zeros(qp.size), np.zeros(14))

    qp, _ = problem()
    solution = Derived("quadprog", SolverOptions()).solve(qp)
    assert solution.status is INACCURATE
    assert qp.gradient.all()


@pytest.mark.parametrize("thing", [None, 3, "a QP", np.zeros(3)], ids=repr)
@pytest.mark.parametrize("name", EVERY)
def test_what_is_no_qp_is_refused(name, thing):
    with pytest.raises(InvalidInputError, match=r"qp is .*; expected a qpmhe.solvers.QP"):
        create(name).solve(thing)
    with pytest.raises(InvalidInputError, match=r"qp is .*; expected a qpmhe.solvers.QP"):
        Scripted(answer()).solve(thing)


@pytest.mark.parametrize(
    "thing", [None, 3, "solved", {}, np.zeros(21), (None, True)],
    ids=lambda thing: type(thing).__name__,
)
def test_something_else_than_a_raw_solution(thing):
    solution = ask(lambda qp: thing, problem()[0])
    assert solution.status is FAILED
    expected = f"the backend returned {type(thing).__name__}, not a RawSolution"
    assert solution.message == expected


@pytest.mark.parametrize("claimed", [True, False])
@pytest.mark.parametrize(
    ("d", "message"),
    [
        (None, "the solver returned no iterate"),
        (np.zeros(20), "the solver returned 20 numbers for 21 unknowns"),
        (np.zeros((7, 4)), "the solver returned 28 numbers for 21 unknowns"),
        ([], "the solver returned 0 numbers for 21 unknowns"),
        (1.5, "the solver returned 1 numbers for 21 unknowns"),
        (np.full(21, np.nan), "the solver returned an iterate that is not finite"),
        (np.append(np.zeros(20), np.nan), "the solver returned an iterate that is not finite"),
        (np.append(np.zeros(20), np.inf), "the solver returned an iterate that is not finite"),
        (np.append(np.zeros(20), -np.inf), "the solver returned an iterate that is not finite"),
        ("solved", "ValueError: could not convert string to float"),
        (["a"] * 21, "ValueError: could not convert string to float"),
        ([[0.0] * 20, [0.0]], "ValueError: "),
        ({}, "TypeError: "),
        (object(), "TypeError: "),
        ([1j] * 21, ""),
        (np.full(21, 1j), ""),
    ],
    ids=[
        "none", "short", "long", "empty", "scalar", "all nan", "one nan", "inf", "minus inf",
        "text", "texts", "ragged", "dict", "object", "complex list", "complex array",
    ],
)
def test_an_unusable_iterate(d, message, claimed):
    solution = ask(answer(d=d, claimed=claimed), problem()[0])
    assert solution.status is FAILED
    assert solution.message.startswith(message)
    assert solution.message
    assert solution.residuals is None


def test_the_words_of_a_solver_without_iterate_are_kept():
    solution = ask(answer(d=None, claimed=False, message="gave up"), problem()[0])
    assert (solution.status, solution.message, solution.iterations) == (FAILED, "gave up", 7)


@pytest.mark.parametrize("shape", [(21,), (7, 3), (21, 1), (1, 21)])
def test_the_shape_of_an_iterate_is_free(shape):
    d = optimum()[0].reshape(shape)
    for given_as in (d, d.tolist(), np.asfortranarray(d), d.astype(object)):
        solution = ask(answer(d=given_as), problem()[0])
        assert solution.status is SOLVED
        np.testing.assert_array_equal(solution.d, optimum()[0])


def test_success_at_an_infeasible_point():
    qp, dense = problem()
    d = optimum()[0].copy()
    d[0] += 1.0
    for duals in ({}, {"bound_duals": None, "row_duals": None}):
        solution = ask(answer(d=d, **duals), qp)
        assert solution.status is INACCURATE
        assert solution.status.usable
        assert solution.residuals.primal == pytest.approx(dense.violation(d))
        np.testing.assert_array_equal(solution.d, d)


def interior():
    """A QP, a point well inside, and its gradient there, which is not zero."""
    qp, dense = of_order_one(make(6, 2, bounds="all", seed=3)[0])
    d = (qp.lower + qp.upper) / 2
    return qp, d, dense.hessian @ d.ravel() + dense.gradient


def test_success_at_a_point_that_is_not_optimal():
    qp, d, gradient = interior()
    solution = ask(answer(d=d, bound_duals=np.zeros(12), row_duals=np.zeros(0)), qp)
    assert solution.status is INACCURATE
    assert solution.residuals.primal == 0.0
    assert solution.residuals.dual == pytest.approx(np.abs(gradient).max())


def test_success_where_nothing_was_done():
    # At zero, with multipliers zero, there is no gap and no violation, only a gradient.
    qp, _ = of_order_one(make(6, 2)[0])
    qp.bounded = True
    qp.lower[...], qp.upper[...] = -0.1, 0.1
    solution = ask(answer(d=np.zeros(12), bound_duals=np.zeros(12), row_duals=np.zeros(0)), qp)
    assert solution.status is INACCURATE
    assert (solution.residuals.primal, solution.residuals.gap) == (0.0, 0.0)
    assert solution.residuals.dual == np.abs(qp.gradient).max()


def test_success_with_made_up_multipliers():
    # Every point is stationary with these; that they push from no bound shows in the gap.
    qp, d, gradient = interior()
    solution = ask(answer(d=d, bound_duals=-gradient, row_duals=np.zeros(0)), qp)
    assert solution.residuals.gap > 0.01
    assert solution.status is INACCURATE


@pytest.mark.parametrize("option", ["absolute_tolerance", "relative_tolerance"])
@pytest.mark.parametrize("lie", ["nothing done", "far outside"])
def test_success_is_doubted_at_loose_tolerances_too(lie, option):
    qp, _, _ = interior()
    d = np.full((6, 2), 0.0 if lie == "nothing done" else 100.0)
    assert qp.violation(d) > 0.01
    gradient = (qp.hessian_times(d) + qp.gradient).ravel()
    bound_duals = np.zeros(12) if lie == "nothing done" else -gradient
    behaviour = answer(d=d, bound_duals=bound_duals, row_duals=np.zeros(0))
    assert ask(behaviour, qp, SolverOptions(**{option: 1e-3})).status is INACCURATE


@pytest.mark.parametrize(
    "duals",
    [
        np.zeros(20), np.zeros(22), np.zeros(0), 0.0, np.full(21, np.nan), np.full(21, np.inf),
        "none", ["a"] * 21, [[0.0], [0.0, 1.0]], {}, object(), np.full(21, 1j), [1j] * 21,
    ],
    ids=[
        "short", "long", "empty", "scalar", "nan", "inf", "text", "texts", "ragged", "dict",
        "object", "complex array", "complex list",
    ],
)
@pytest.mark.parametrize("which", ["bound_duals", "row_duals"])
def test_unusable_multipliers_are_dropped(which, duals):
    qp, _ = problem()
    solution = ask(answer(**{which: duals}), qp)
    # The iterate is there and feasible; only its optimality cannot be told.
    assert solution.status in (SOLVED, INACCURATE)
    assert getattr(solution, which) is None
    assert solution.residuals.primal < 1e-9
    assert np.isnan(solution.residuals.dual)
    assert np.isnan(solution.residuals.gap)


def test_unusable_multipliers_do_not_hide_an_infeasible_point():
    qp, _ = problem()
    d = optimum()[0] + 1.0
    assert ask(answer(d=d, bound_duals=np.full(21, np.nan)), qp).status is INACCURATE


@pytest.mark.parametrize(
    "claimed", [np.array([True, False]), np.array([]), "yes", None, 1j],
    ids=["array", "empty array", "text", "none", "complex"],
)
def test_a_claim_that_is_no_bool(claimed):
    assert ask(answer(d=np.zeros(21), claimed=claimed), problem()[0]).status is not SOLVED


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_huge_finite_iterate_is_judged(sign):
    d = 1e308 * sign ** np.arange(21)
    assert ask(answer(d=d), problem()[0]).status is INACCURATE


@pytest.mark.parametrize("which", ["bound_duals", "row_duals"])
def test_huge_finite_multipliers_are_judged(which):
    qp, _ = problem()
    size = {"bound_duals": 21, "row_duals": 14}[which]
    assert ask(answer(**{which: np.full(size, 1e308)}), qp).status is INACCURATE


def test_warnings_stay_inside():
    def behaviour(qp):
        warnings.warn("ill-conditioned", UserWarning, stacklevel=1)
        np.float64(1.0) / np.float64(0.0)
        return answer()(qp)

    filters = list(warnings.filters)
    solution = ask(behaviour, problem()[0])  # pytest's filters turn what leaks into an error
    assert solution.status is SOLVED
    assert warnings.filters == filters


@pytest.mark.parametrize("array", ["gradient", "band", "upper", "row_own"])
def test_data_that_are_not_finite_reach_no_solver(array):
    qp, _ = problem()
    getattr(qp, array)[1].flat[0] = np.nan
    solver = Scripted(answer())
    solution = solver.solve(qp)
    assert solution.status is FAILED
    assert solution.message == "the QP's data are not finite"
    assert solver.starts == []


def test_the_start_is_handed_on_unless_forbidden():
    qp, _ = problem()
    start = np.ones((qp.stages, qp.n))
    for warm, expected in ((True, start), (False, None)):
        solver = Scripted(answer(), SolverOptions(warm_start=warm))
        assert solver.solve(qp, start).status is SOLVED
        assert solver.starts[0] is None if expected is None else (solver.starts[0] == start).all()
    solver = Scripted(answer())
    solver.solve(qp)
    assert solver.starts == [None]


@pytest.mark.parametrize(
    "start",
    [np.zeros(3), np.zeros((7, 4)), np.full((7, 3), np.nan), np.full((7, 3), np.inf)],
    ids=["short", "wide", "nan", "inf"],
)
def test_an_unusable_start_reaches_no_solver(start):
    # osqp reads as many numbers as there are unknowns, whatever the length of the start.
    qp, _ = problem()
    solver = Scripted(answer())
    solver.solve(qp, start)
    for given_start in solver.starts:
        assert given_start is None or given_start.shape == (qp.stages, qp.n)
        assert given_start is None or np.isfinite(given_start).all()


def test_reused_buffers_do_not_reach_the_caller():
    qp, _ = problem()
    d, bound_duals, row_duals = (values.copy() for values in optimum())
    behaviour = answer(d=d, bound_duals=bound_duals, row_duals=row_duals)
    solution = ask(behaviour, qp)
    d[...] = bound_duals[...] = row_duals[...] = np.nan
    for kept in (solution.d, solution.bound_duals, solution.row_duals):
        assert np.isfinite(kept).all()


def test_a_failure_is_forgotten():
    qp, _ = problem()
    solver = Scripted(raising(KeyError("first")))
    assert solver.solve(qp).status is FAILED
    solver.behaviour = answer()
    assert solver.solve(qp).status is SOLVED


@pytest.mark.parametrize("when", ["making", "solving"])
def test_auto_contains_a_broken_package(monkeypatch, when):
    def factory(options):
        if when == "making":
            raise ImportError("broken package")
        return Scripted(raising(KeyError("broken package")), options)

    for name in ("clarabel", "daqp", "osqp", "piqp", "proxqp"):
        broken = Backend(name, factory, "broken", iterate_at_cap=True)
        monkeypatch.setitem(qpmhe_solvers.native.NATIVE, name, broken)
    solution = create("auto").solve(make(6, 2, bounds="all")[0])
    # Either word is true: nothing solved it, and the unconstrained minimiser is at hand.
    assert solution.status in (FAILED, SolveStatus.UNCONSTRAINED)


rubbish = st.one_of(
    st.none(), st.booleans(), st.floats(), st.text(max_size=3), st.complex_numbers(),
    st.lists(st.floats(), max_size=5), st.dictionaries(st.text(max_size=1), st.none()),
    st.lists(st.floats(), min_size=4, max_size=4),
    st.lists(st.one_of(st.none(), st.text(max_size=2), st.floats()), min_size=4, max_size=4),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).map(np.array),
)


def check_rubbish(raw):
    qp, dense = make(2, 2, 2, bounds="part", sides="two")
    solution = ask(lambda _: raw, qp)
    if solution.status is SOLVED:
        assert dense.violation(solution.d) <= 1e-3


@given(d=rubbish, claimed=st.booleans())
@settings(max_examples=200, derandomize=True, deadline=None)
def test_any_iterate_is_contained(d, claimed):
    check_rubbish(RawSolution(d, claimed))


@given(
    bound_duals=rubbish, row_duals=rubbish, claimed=st.booleans(),
    d=st.lists(st.floats(-1e6, 1e6), min_size=4, max_size=4),
)
@settings(max_examples=100, derandomize=True, deadline=None)
def test_any_multipliers_are_contained(d, bound_duals, row_duals, claimed):
    check_rubbish(RawSolution(d, claimed, None, bound_duals, row_duals))


@given(raw=rubbish)
@settings(max_examples=50, derandomize=True, deadline=None)
def test_any_answer_is_contained(raw):
    check_rubbish(raw)


@pytest.mark.parametrize("case", CASES)
def test_residuals_equal_plain_loops(case):
    qp, dense = make(**CASES[case], seed=5)
    rng = np.random.default_rng(6)
    d = rng.standard_normal((qp.stages, qp.n))

    def pushing(lower, upper):
        # Multipliers of sides that are there.
        multipliers = rng.standard_normal(lower.size)
        absent = np.isinf(np.where(multipliers > 0, upper, lower))
        return np.where(absent, 0.0, multipliers)

    bound_duals = pushing(dense.lower, dense.upper)
    row_duals = pushing(dense.row_lower, dense.row_upper)
    residuals = Residuals.of(qp, d, bound_duals, row_duals)
    assert residuals.primal == pytest.approx(dense.violation(d))
    assert residuals.dual == pytest.approx(dense.stationarity(d, bound_duals, row_duals))
    assert residuals.gap == pytest.approx(dense.gap(d, bound_duals, row_duals))
    assert Residuals.of(qp, d, None, row_duals).primal == residuals.primal
    assert np.isnan(Residuals.of(qp, d, None, row_duals).gap)
    assert np.isnan(Residuals.of(qp, d, bound_duals, None).dual)


def absent_side(multiplier):
    """Residuals at the solution, with a multiplier on a bound that there is not."""
    qp, _ = make(2, 2, bounds="all")
    qp.upper[0, 0] = np.inf
    solution = create("quadprog").solve(qp)
    bound_duals = solution.bound_duals.copy()
    bound_duals[0] = multiplier
    return solution, Residuals.of(qp, solution.d, bound_duals, np.zeros(0))


@pytest.mark.parametrize("multiplier", [1e-16, 1e-3])
def test_a_multiplier_without_a_bound_does_not_count(multiplier):
    _, residuals = absent_side(multiplier)
    _, expected = absent_side(0.0)
    assert residuals == expected
    assert residuals.gap < 1e-6


def test_statuses_tell_what_to_do():
    assert [status for status in SolveStatus if not status.usable] == [FAILED]
    for status in SolveStatus:
        assert ":" in status.value


def test_a_solution_prints_its_verdict():
    text = repr(ask(answer(), problem()[0]))
    assert text.startswith("Solution(SOLVED, iterations=7, Residuals(primal=")
