"""A solver given to the estimator as an object, or one that records."""

import copy
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import BackendError, InvalidInputError, OptionError
from qpmhe.solvers import RawSolution, Solver, SolverOptions, available, create

from .spoil import check, cost_of, estimator

Y = np.random.default_rng(0).normal(size=(12, 1))
BOX = qpmhe.Box([-0.5, -0.5], [0.5, 0.5])


def step(x):
    return np.array([0.9 * x[0] + 0.1 * x[1], 0.95 * x[1]])


def first(x):
    return x[:1]


def constrained(**options):
    given = {"horizon": 4, "initial_state": [0.1, 0.1], "max_qps": 2} | options
    return estimator(
        qpmhe.System(step, first, n=2, p=1, states=BOX), qpmhe.Luenberger([[0.1], [0.1]]),
        cost_of(disturbance=5.0 * np.eye(2)), **given,
    )


class Counting(Solver):
    """Gives zero, and counts what it is asked for."""

    def __init__(self, options=None):
        super().__init__(options or SolverOptions())
        self.calls = []

    def _solve(self, qp, start):
        self.calls.append("solve")
        return RawSolution(np.zeros(qp.size), False)

    def shift(self):
        self.calls.append("shift")

    def forget(self):
        self.calls.append("forget")


@pytest.mark.parametrize("name", sorted({"auto", "osqp", "daqp", "banded"} & {*available()}))
def test_an_object_does_what_its_name_does(name):
    by_name = constrained(backend=name, max_solver_iterations=500, solver_tolerance=1e-6)
    mhe = constrained(backend=create(name, SolverOptions(500, absolute_tolerance=1e-6)))
    assert mhe.settings.max_solver_iterations == 500
    assert mhe.settings.solver_tolerance == 1e-6
    np.testing.assert_array_equal(mhe.run(Y).states, by_name.run(Y).states)


def test_objects_that_do_not_fit_are_refused():
    for options, given, words in (
        ({"max_iterations": 3}, {"max_solver_iterations": 5},
         ["max_solver_iterations is 5", "max_iterations=3", "SolverOptions(max_iterations=5)"]),
        ({"time_limit": 0.5}, {"time_budget": 1.0},
         ["time_budget is 1.0", "time_limit=0.5", "leave one of them out"]),
        ({}, {"engine": "compiled"}, ["engine='compiled'", "leave backend out"]),
    ):
        solver = create("banded", SolverOptions(**options))
        check(OptionError, words, estimator, backend=solver, **given)
    check(BackendError, ["is not known"], estimator, backend=Counting)


def test_a_solver_starts_afresh_where_its_estimator_changes():
    solver = Counting()
    one, other = estimator(backend=solver, horizon=1), estimator(backend=solver, horizon=1)
    for mhe in (one, one, other, one):
        mhe.update([1.0])
    assert [call for call in solver.calls if call != "shift"] == [
        "solve", "solve", "forget", "solve", "forget", "solve",
    ]
    # A shift is one of the trajectory that the solver knows.
    assert solver.calls.count("shift") == 1
    state = one.state_dict()
    for change in (
        one.forget_warm_start, lambda: one.load_state_dict(state),
        lambda: one.set(noise_weight=2.0),
        one.reset,
    ):
        one.update([1.0])
        solver.calls.clear()
        change()
        assert "forget" in solver.calls
    solver.calls.clear()
    one.state_dict()
    assert not solver.calls
    # A time budget ends with its estimator.
    estimator(backend=solver, time_budget=5.0).update([1.0])
    assert solver.time_limit <= 5.0
    estimator(backend=solver).update([1.0])
    assert solver.time_limit is None


def test_an_estimator_with_an_object_can_be_copied():
    for way in (lambda mhe: pickle.loads(pickle.dumps(mhe)), copy.copy, copy.deepcopy):
        mhe = constrained(backend=create("auto", SolverOptions(40)))
        mhe.run(Y[:6])
        twin = way(mhe)
        assert twin.settings.max_solver_iterations == 40
        for y in Y[6:]:
            np.testing.assert_array_equal(twin.update(y).state, mhe.update(y).state)

    solver = Counting()
    solver.held = lambda: None
    with pytest.raises(InvalidInputError, match=r"Counting.* cannot be pickled .*state_dict"):
        pickle.dumps(estimator(backend=solver))
