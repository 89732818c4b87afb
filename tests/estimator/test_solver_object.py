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
    system = qpmhe.System(
        step, first, n=2, p=1, states=BOX
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=5.0 * np.eye(2), noise=np.eye(1))
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.1], [0.1]]), cost, horizon=4, initial_state=[0.1, 0.1],
        max_qps=2, **options,
    )


def states(mhe):
    return np.array([mhe.update(y).state for y in Y])


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


@pytest.mark.parametrize("name", [n for n in ("auto", "osqp", "daqp", "piqp", "banded")
                                  if n in qpmhe.solvers.available()])
def test_an_object_does_what_its_name_does(name):
    by_name = constrained(backend=name, max_solver_iterations=500, solver_tolerance=1e-6)
    options = SolverOptions(500, absolute_tolerance=1e-6)
    mhe = constrained(backend=create(name, options))
    assert mhe.settings.max_solver_iterations == 500
    assert mhe.settings.solver_tolerance == 1e-6
    np.testing.assert_array_equal(states(mhe), states(by_name))


def test_limits_that_agree_are_accepted():
    solver = create("banded", SolverOptions(7, absolute_tolerance=1e-5, time_limit=2.0))
    estimator(
        backend=solver, max_solver_iterations=7, solver_tolerance=1e-5, time_budget=2.0
    ).update([1.0])


@pytest.mark.parametrize(
    ("options", "given", "words"),
    [
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
    ],
)
def test_limits_that_differ_are_refused(options, given, words):
    solver = create("banded", SolverOptions(**options))
    check(OptionError, words, lambda: estimator(backend=solver, **given))


def test_a_batch_refuses_an_object():
    one = estimator()
    with pytest.raises(OptionError, match="expected the name of a backend"):
        qpmhe.BatchEstimator(
            one.system, one.observer, one.cost, members=2, horizon=3,
            initial_states=np.zeros((2, 2)), backend=create("banded"),
        )


def test_a_class_in_place_of_an_object_is_refused():
    with pytest.raises(BackendError, match="is not known"):
        estimator(backend=Counting)


def test_an_object_without_options_is_refused():
    class Bare(Counting):
        def __init__(self):
            pass

    with pytest.raises(BackendError, match=r"call super\(\).__init__\(options\)"):
        estimator(backend=Bare())


def test_an_object_that_raises_is_contained():
    class Raising(Counting):
        def _solve(self, qp, start):
            raise RuntimeError("not today")

        shift = forget = prepare = _solve

    mhe = estimator(backend=Raising())
    for _ in range(5):
        estimate = mhe.update([1.0])
        assert estimate.cost <= estimate.candidate_cost
    assert "not today" in estimate.message


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


def test_estimators_that_take_turns_with_one_solver_differ_by_rounding_alone():
    if "osqp" not in qpmhe.solvers.available():
        pytest.skip("needs osqp")
    solver = create("osqp", SolverOptions(absolute_tolerance=1e-9))
    one, other = constrained(backend=solver), constrained(backend=solver)
    alone = constrained(backend="osqp", solver_tolerance=1e-9)
    for y in Y:
        found, _ = one.update(y).state, other.update(-y)
        np.testing.assert_allclose(found, alone.update(y).state, atol=1e-6)


def test_a_time_budget_ends_with_its_estimator():
    solver = Counting()
    estimator(backend=solver, time_budget=5.0).update([1.0])
    assert solver.time_limit <= 5.0
    estimator(backend=solver).update([1.0])
    assert solver.time_limit is None


@pytest.mark.parametrize("way", [lambda mhe: pickle.loads(pickle.dumps(mhe)), copy.copy,
                                 copy.deepcopy])
def test_an_estimator_with_an_object_can_be_copied(way):
    mhe = constrained(backend=create("auto", SolverOptions(40)))
    for y in Y[:6]:
        mhe.update(y)
    twin = way(mhe)
    assert twin.settings.max_solver_iterations == 40
    for y in Y[6:]:
        np.testing.assert_array_equal(twin.update(y).state, mhe.update(y).state)


def test_snapshots_do_not_depend_on_the_object():
    mhe = constrained(backend=create("auto"))
    for y in Y[:6]:
        mhe.update(y)
    twin = constrained()
    twin.load_state_dict(mhe.state_dict())
    for y in Y[6:]:
        np.testing.assert_array_equal(twin.update(y).state, mhe.update(y).state)


def test_an_object_that_cannot_be_pickled_is_named():
    class Local(Counting):
        pass

    mhe = estimator(backend=Local())
    mhe.update([1.0])
    with pytest.raises(InvalidInputError, match=r"Local.* cannot be pickled .*state_dict"):
        pickle.dumps(mhe)
