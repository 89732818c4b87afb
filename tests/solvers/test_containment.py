"""Whatever a solver does, nothing but KeyboardInterrupt gets out, and no claim is believed."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qpmhe_solvers import Backend, InvalidInputError, Solver, SolverOptions, create
from qpmhe_solvers.dispatch import DispatchSolver
from qpmhe_solvers.qp import ARRAYS
from qpmhe_solvers.solution import RawSolution, Residuals, Solution, SolveStatus
from qpmhe_solvers.solver import ContainedSolver

from .problems import CASES, EVERY, TIGHT, make, of_order_one, registered

pytest.importorskip("quadprog")
FAILED, SOLVED = SolveStatus.FAILED, SolveStatus.SOLVED
STOPPED, INACCURATE = SolveStatus.STOPPED, SolveStatus.INACCURATE
QP, DENSE = of_order_one(make(**CASES["all kinds"], seed=3)[0])
BEST = create("quadprog", TIGHT).solve(QP)


USUAL_OPTIONS = SolverOptions()


class Scripted(Solver):
    """Returns what it is given, called if it can be, and remembers its starts."""

    def __init__(self, found, options=USUAL_OPTIONS):
        super().__init__(options)
        self.found, self.starts = found, []

    def _solve(self, qp, start):
        self.starts.append(start)
        if isinstance(self.found, BaseException):
            raise self.found
        return self.found(qp) if callable(self.found) else self.found


class Overriding(Scripted):
    """Overrides all of the contract."""

    def solve(self, qp, start=None):
        return self._solve(qp, start)

    def shift(self, *_):
        self._solve(None, None)

    forget = prepare = shift


def ask(found, qp=QP, **options):
    """Solve by a backend that returns this, and check what always holds."""
    entry = Backend("scripted", lambda given: Scripted(found, given), "theatre")
    before = qp.numbers.copy()
    with registered(entry):
        solution = create("scripted", SolverOptions(**options)).solve(qp)
    assert (solution.d is None) == (solution.status is FAILED)
    if solution.d is not None:
        assert (solution.d.shape, solution.d.dtype) == ((qp.stages, qp.n), np.float64)
        assert np.isfinite(solution.d).all()
    np.testing.assert_array_equal(qp.numbers, before)
    return solution


def contained(found):
    """What becomes of the answer of a solver's own `solve`."""
    return ContainedSolver(Overriding(found)).solve(QP)


def raw(**changes):
    """The true solution and multipliers, but for the changes."""
    honest = {"d": BEST.d, "bound_duals": BEST.bound_duals, "row_duals": BEST.row_duals}
    return RawSolution(**{"claimed": True, "iterations": 7, **honest, **changes})


def test_the_honest_are_believed_in_any_form():
    solution = ask(raw(message="well done"))
    assert (solution.status, solution.iterations, solution.message) == (SOLVED, 7, "well done")
    assert DENSE.violation(solution.d) < 1e-9
    assert max(solution.residuals.primal, solution.residuals.dual, solution.residuals.gap) < 1e-9
    for claimed in (False, np.array([True, False]), "yes", None):
        assert ask(raw(claimed=claimed)).status is STOPPED
    for d in (BEST.d.ravel(), BEST.d.tolist(), np.asfortranarray(BEST.d), BEST.d.astype(object)):
        for solution in (ask(raw(d=d)), contained(Solution(d, SOLVED, 5))):
            assert solution.status is SOLVED
            np.testing.assert_array_equal(solution.d, BEST.d)
            assert not np.shares_memory(solution.d, np.asarray(d))  # solvers reuse their buffers


class Panic(BaseException):
    """As compiled code raises it."""


class SpeechlessError(Exception):
    def __str__(self):
        raise RuntimeError("no words")


def test_an_exception_is_a_failure_with_its_words_and_only_the_user_interrupts():
    # To leave is to fail: an estimator must not end with the solver that it tried.
    for kind in (KeyError, StopIteration, Warning, Panic, SystemExit, SpeechlessError):
        error = kind("all of it")
        for solution in (ask(error), contained(error)):
            assert (solution.status, solution.d) == (FAILED, None)
            assert solution.message.startswith(kind.__name__)
            assert "all of it" in solution.message or kind is SpeechlessError
        solver = ContainedSolver(Overriding(error))
        solver.shift()
        solver.forget()
        solver.prepare(3)
    stop = KeyboardInterrupt()
    solver = ContainedSolver(Overriding(stop))
    for method, *arguments in (
        (ask, stop), (solver.solve, QP), (solver.shift,), (solver.forget,), (solver.prepare, 3),
    ):
        with pytest.raises(KeyboardInterrupt):
            method(*arguments)


def test_whoever_writes_has_a_copy_and_is_named_unless_right():
    def scribbling(found):
        def scribble(lent):
            for name in ARRAYS:
                getattr(lent, name)[...] *= 1e-12
            lent.bounded = False
            warnings.warn("ill-conditioned", UserWarning, stacklevel=1)  # an error if it leaks
            np.float64(1.0) / np.float64(0.0)
            return found

        return scribble

    class Derived(DispatchSolver):  # of one of ours: lent copies as well
        def _solve(self, qp, start):
            return scribbling(raw())(qp)

    before, filters = QP.numbers.copy(), list(warnings.filters)
    assert ask(scribbling(raw())).status is SOLVED
    assert Derived("quadprog", SolverOptions()).solve(QP).status is SOLVED
    assert contained(scribbling(Solution(BEST.d, SOLVED))).status is SOLVED
    stopped = ask(scribbling(raw(claimed=False, message="gave up")))
    assert stopped.status is STOPPED
    assert stopped.message.startswith("gave up; it wrote into band, gradient, ")
    assert ask(raw(claimed=False)).message == ""  # who only reads is not accused
    # At zero, without multipliers, nothing is left to do in what it made of the QP.
    idle = ask(scribbling(RawSolution(np.zeros(21), True, 1, np.zeros(21), np.zeros(14))))
    assert (idle.status, idle.residuals.dual) == (INACCURATE, np.abs(QP.gradient).max())
    assert QP.bounded
    assert warnings.filters == filters
    np.testing.assert_array_equal(QP.numbers, before)


def test_what_is_no_answer():
    for thing in [None, np.zeros(21), (None, True)]:
        name = type(thing).__name__
        assert ask(thing).message == f"the backend returned {name}, not a RawSolution"
        assert f"solve returned {name}, not a Solution" in contained(thing).message
    for d, message in [
        (None, "the solver returned no iterate"),
        (np.zeros((7, 4)), "the solver returned 28 numbers for 21 unknowns"),
        (np.append(np.zeros(20), -np.inf), "the solver returned an iterate that is not finite"),
        ("solved", "ValueError: could not convert string to float"),
        ([1j] * 21, "the solver returned complex numbers"),
    ]:
        for solution in (ask(raw(d=d, claimed=False)), contained(Solution(d, SOLVED))):
            assert (solution.d, solution.status, solution.residuals) == (None, FAILED, None)
            assert solution.message.startswith(message)
    assert ask(raw(d=None, claimed=False, message="gave up")).message == "gave up"
    assert "status of the backend's Solution is str" in contained(Solution(BEST.d, "yes")).message
    # The iterate is there and feasible; only its optimality is unknown.
    for which in ("bound_duals", "row_duals"):
        for duals in (np.zeros(20), np.full(21, np.nan), "none", [1j] * 21):
            solution = ask(raw(**{which: duals}))
            assert (solution.status.usable, getattr(solution, which)) == (True, None)
            assert np.isnan([solution.residuals.dual, solution.residuals.gap]).all()
            assert ask(raw(d=BEST.d + 1.0, **{which: duals})).status is INACCURATE
            assert getattr(contained(Solution(BEST.d, SOLVED, **{which: duals})), which) is None


@pytest.mark.parametrize(
    "options", [{}, {"absolute_tolerance": 1e-3}, {"relative_tolerance": 1e-3}], ids=str
)
def test_success_that_is_none(options):
    def asked(d, bound_duals):
        found = RawSolution(d, True, 1, bound_duals, np.zeros(0))
        solution = ask(found, qp, **options)
        assert (solution.status, solution.status.usable) == (INACCURATE, True)
        return solution.residuals

    qp, dense = of_order_one(make(6, 2, bounds="all", seed=3)[0])
    d, zeros = (qp.lower + qp.upper) / 2, np.zeros(12)
    gradient = dense.hessian @ d.ravel() + dense.gradient
    assert asked(d, zeros).dual == pytest.approx(np.abs(gradient).max())
    # Every point is stationary with these; that they push from no bound shows in the gap.
    assert asked(d, -gradient).gap > 0.01
    # At zero, with multipliers zero, there is no gap and no violation, only a gradient.
    qp.lower[...], qp.upper[...] = -0.1, 0.1
    assert asked(zeros, zeros) == Residuals(0.0, np.abs(qp.gradient).max(), 0.0)
    d = np.full(12, 100.0)  # far outside
    assert asked(d, -(dense.hessian @ d + dense.gradient)).primal > 1.0
    for changes in ({"d": BEST.d + 1.0}, {"d": np.full(21, 1e308)}, {"bound_duals": [1e308] * 21}):
        assert ask(raw(**changes), **options).status is INACCURATE  # squares may overflow


def test_what_reaches_a_solver():
    for one in (Scripted(raw()), *(create(name) for name in EVERY)):
        with pytest.raises(InvalidInputError, match=r"qp is 'a QP'; expected a qpmhe.solvers.QP"):
            one.solve("a QP")
    spoilt, ones = QP.copy(), np.ones((7, 3))
    spoilt.row_own[1, 0, 0] = np.nan
    solver = Scripted(raw())
    assert solver.solve(spoilt).message == "the QP's data are not finite"
    # osqp reads as many numbers as there are unknowns, whatever the length of the start.
    for start in (None, np.zeros(3), np.inf * ones):
        solver.solve(QP, start)
        assert solver.starts.pop() is None
    cold = Scripted(raw(), SolverOptions(warm_start=False))
    for one in (solver, cold):
        one.solve(QP, ones)
    assert (cold.starts, solver.starts[0].min()) == ([None], 1.0)
    assert not np.shares_memory(solver.starts[0], ones)


rubbish = st.one_of(
    st.none(), st.booleans(), st.floats(), st.text(max_size=3), st.complex_numbers(),
    st.lists(st.floats(), max_size=5), st.dictionaries(st.text(max_size=1), st.none()),
    st.lists(st.one_of(st.none(), st.text(max_size=2), st.floats()), min_size=4, max_size=4),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).map(np.array),
)


@given(d=rubbish, claimed=st.booleans(), bound_duals=rubbish, row_duals=rubbish)
@settings(max_examples=100, derandomize=True, deadline=None)
def test_any_answer_is_contained(d, claimed, bound_duals, row_duals):
    qp, dense = make(2, 2, 2, bounds="part", sides="two")
    for found in (d, RawSolution(d, claimed, None, bound_duals, row_duals)):
        solution = ask(found, qp)
        assert solution.status is not SOLVED or dense.violation(solution.d) <= 1e-3


def test_residuals_equal_those_of_full_matrices():
    for case in CASES.values():
        qp, dense = make(**case, seed=5)
        rng = np.random.default_rng(6)
        d, duals = rng.standard_normal((qp.stages, qp.n)), rng.standard_normal(dense.low.size)
        bounds, rows = np.split(duals.copy(), [qp.size])
        residuals = Residuals.of(qp, d, bounds, rows)
        # A multiplier without its side does not count.
        duals[np.isinf(np.where(duals > 0, dense.high, dense.low))] = 0.0
        assert residuals.primal == pytest.approx(dense.violation(d))
        assert residuals.dual == pytest.approx(dense.stationarity(d, duals))
        assert residuals.gap == pytest.approx(dense.gap(d, duals))
        assert Residuals.of(qp, d, None, rows).primal == residuals.primal
        assert np.isnan(Residuals.of(qp, d, None, rows).gap)
        assert np.isnan(Residuals.of(qp, d, bounds, None).dual)
