"""A solver given to the estimator as an object."""

import copy
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import BackendError, InvalidInputError, OptionError
from qpmhe.solvers import RawSolution, Solver, SolverOptions, create

from .spoil import check, estimator

Y = np.random.default_rng(0).normal(size=(12, 1))
BOX = qpmhe.Box([-0.5, -0.5], [0.5, 0.5])


def step(x):
    return np.array([0.9 * x[0] + 0.1 * x[1], 0.95 * x[1]])


def first(x):
    return x[:1]


def constrained(**options):
    system = qpmhe.System(step, first, n=2, p=1, states=BOX)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=5.0 * np.eye(2), noise=np.eye(1))
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.1], [0.1]]), cost, horizon=4, initial_state=[0.1, 0.1],
        max_qps=2, **options,
    )


def states(mhe, ys=Y):
    return np.array([mhe.update(y).state for y in ys])


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


@pytest.mark.parametrize(
    "name", sorted({"auto", "osqp", "daqp", "piqp", "banded"} & {*qpmhe.solvers.available()})
)
def test_an_object_does_what_its_name_does(name):
    by_name = constrained(backend=name, max_solver_iterations=500, solver_tolerance=1e-6)
    mhe = constrained(backend=create(name, SolverOptions(500, absolute_tolerance=1e-6)))
    assert mhe.settings.max_solver_iterations == 500
    assert mhe.settings.solver_tolerance == 1e-6
    np.testing.assert_array_equal(states(mhe), states(by_name))


def test_limits_that_differ_are_refused():
    for options, given, words in (
        ({}, {"max_solver_iterations": 5}, ["max_solver_iterations is 5", "max_iterations=None"]),
        (
            {"max_iterations": 3}, {"max_solver_iterations": 5},
            ["max_solver_iterations is 5", "max_iterations=3", "SolverOptions(max_iterations=5)"],
        ),
        (
            {"absolute_tolerance": 1e-4}, {"solver_tolerance": 1e-5},
            ["solver_tolerance is 1e-05", "absolute_tolerance=0.0001", "leave"],
        ),
        (
            {"time_limit": 0.5}, {"time_budget": 1.0},
            ["time_budget is 1.0", "time_limit=0.5", "leave one of them out"],
        ),
        ({}, {"isolated": True}, ["isolated is True", "isolated=True)"]),
        ({}, {"engine": "compiled"}, ["engine='compiled'", "leave backend out"]),
    ):
        solver = create("banded", SolverOptions(**options))
        check(OptionError, words, lambda solver=solver, given=given: estimator(
            backend=solver, **given
        ))
    agreeing = {"max_solver_iterations": 7, "solver_tolerance": 1e-5, "time_budget": 2.0}
    solver = create("banded", SolverOptions(7, absolute_tolerance=1e-5, time_limit=2.0))
    estimator(backend=solver, **agreeing).update([1.0])


def test_what_is_no_object_or_has_no_options_is_refused():
    class Bare(Counting):
        def __init__(self):
            pass

    one = estimator()
    with pytest.raises(BackendError, match="is not known"):
        estimator(backend=Counting)
    with pytest.raises(BackendError, match=r"call super\(\).__init__\(options\)"):
        estimator(backend=Bare())
    with pytest.raises(OptionError, match="expected the name of a backend"):
        qpmhe.BatchEstimator(
            one.system, one.observer, one.cost, members=2, horizon=3,
            initial_states=np.zeros((2, 2)), backend=create("banded"),
        )


def test_a_solver_starts_afresh_when_it_passes_to_another_estimator():
    solver = Counting()
    one, other = estimator(backend=solver, horizon=1), estimator(backend=solver, horizon=1)
    for mhe in (one, one, other, one):
        mhe.update([1.0])
    assert [call for call in solver.calls if call != "shift"] == [
        "solve", "solve", "forget", "solve", "forget", "solve",
    ]
    # A shift is one of the trajectory that the solver knows.
    assert solver.calls.count("shift") == 1
    # A time budget ends with its estimator.
    estimator(backend=solver, time_budget=5.0).update([1.0])
    assert solver.time_limit <= 5.0
    estimator(backend=solver).update([1.0])
    assert solver.time_limit is None


def test_a_solver_forgets_where_its_estimator_changes():
    solver = Counting()
    mhe = estimator(backend=solver)
    mhe.update([1.0])
    state = mhe.state_dict()
    for change in (
        mhe.state_dict, lambda: mhe.load_state_dict(state), lambda: mhe.set(noise_weight=2.0),
        mhe.reset,
    ):
        mhe.update([1.0])
        solver.calls.clear()
        change()
        assert "forget" in solver.calls


@pytest.mark.parametrize(
    "way", [lambda mhe: pickle.loads(pickle.dumps(mhe)), copy.copy, copy.deepcopy, None]
)
def test_an_estimator_with_an_object_can_be_copied(way):
    mhe = constrained(backend=create("auto", SolverOptions(40)))
    states(mhe, Y[:6])
    if way is None:  # snapshots do not depend on the object
        twin = constrained(max_solver_iterations=40)
        twin.load_state_dict(mhe.state_dict())
    else:
        twin = way(mhe)
    assert twin.settings.max_solver_iterations == 40
    for y in Y[6:]:
        np.testing.assert_array_equal(twin.update(y).state, mhe.update(y).state)


def test_an_object_that_cannot_be_pickled_is_named():
    class Local(Counting):
        pass

    mhe = estimator(backend=Local())
    mhe.update([1.0])
    with pytest.raises(InvalidInputError, match=r"Local.* cannot be pickled .*state_dict"):
        pickle.dumps(mhe)
