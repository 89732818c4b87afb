"""Options and samples that do not fit are refused by name, and leave the estimator as it was."""

import dataclasses
import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import BackendError, InvalidInputError, OptionError, ShapeError, WeightError

from .spoil import A, check, cost_of, estimator, system_of, unharmed, with_input

BACKENDS = [entry.name for entry in qpmhe.solvers.backends()]


def refused(name, values, *words):
    return [(OptionError, {name: value}, [f"{name} is {value!r}", *words]) for value in values]


WRONG = [
    *refused("horizon", (0, 1.5, True, "3", None), "expected an integer >= 1"),
    *refused("max_qps", (-1, 1.5, True), "expected an integer >= 0"),
    *refused("max_solver_iterations", (0, True), "expected an integer >= 1", "max_qps=0"),
    *refused("tolerance", (0, -1e-9, math.nan, True, None), "a finite number > 0"),
    *refused("solver_tolerance", (math.inf, "tight", [1e-7]), "a finite number > 0"),
    *refused("time_budget", (0, math.nan, True, "1"), "expected a finite number > 0"),
    *refused("delay", (-1, 1.0, True, None), "expected an integer >= 0"),
    *refused("delay", (4, 100), "at most the horizon, 3"),
    *refused("engine", ("Python", None), "expected one of", "'python'"),
    *refused("infeasible", ("drop", None, ["drop_rows"]), "'drop_rows'", "'keep_candidate'"),
    *refused("candidate", ("reinitialised", 0), "'observer'", "'reinitialized'"),
    *refused("arrival", ("smooth", None), "'observer'", "'smoothed'"),
    *refused("warm_start", ("best", 1), "True or False"),
    *refused("project_observer", (None,), "True or False"),
    (BackendError, {"backend": "OSQP"}, ["backend 'OSQP' is not known", *BACKENDS]),
    (BackendError, {"backend": None}, ["backend None is not known"]),
    (BackendError, {"backend": ["osqp"]}, ["backend ['osqp'] is not known"]),
]


def test_options_out_of_range():
    for error, options, words in WRONG:
        check(error, words, lambda options=options: estimator(**options))


def test_settings_are_kept_and_frozen():
    given = {
        "horizon": 4, "backend": "banded", "max_qps": 2, "max_solver_iterations": 7,
        "solver_tolerance": 1e-5, "tolerance": 1e-6, "engine": "python",
        "infeasible": "keep_candidate", "project_observer": False,
        "warm_start": True, "candidate": "reinitialized", "time_budget": 3.5, "delay": 1,
        "arrival": "smoothed",
    }
    settings = estimator(**given).settings
    assert given.items() <= dataclasses.asdict(settings).items()
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.horizon = 5

def test_a_horizon_beyond_the_memory(monkeypatch):
    def exhausted(*_):
        raise MemoryError("Unable to allocate 745. GiB")

    monkeypatch.setattr("qpmhe.estimation.estimator.engine_for", exhausted)
    words = ["horizon is 10000000", "745. GiB", "take a shorter horizon"]
    check(OptionError, words, lambda: estimator(horizon=10_000_000))


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("MovingHorizonEstimator", estimator), ("System", system_of), ("QuadraticCost", cost_of),
        ("SolverOptions", qpmhe.solvers.SolverOptions),
        ("RobustCost", lambda **options: qpmhe.RobustCost(
            prior=np.eye(1), disturbance=np.eye(1), noise=np.eye(1), **options
        )),
    ],
)
def test_unknown_options_are_refused_with_the_known_ones(name, make):
    for kind in (OptionError, TypeError):
        with pytest.raises(kind, match=f"{name} has no option 'nonsense'; expect"):
            make(nonsense=1)
    with pytest.raises(OptionError, match="Did you mean max_qps"):
        estimator(max_qp=2)


# Samples


def in_time():
    return estimator(qpmhe.System.from_ode(
        lambda x: x @ (A - np.eye(2)), lambda x: x[..., :1], dt=0.1, n=2, p=1
    ))


def two_outputs():
    observer = qpmhe.Luenberger(0.1 * np.eye(2))
    return estimator(system_of(h=lambda x: x, p=2), observer, cost_of(2, 2))


def update(*arguments, **own):
    return lambda mhe: mhe.update(*arguments, **own)


def run(*arguments):
    return lambda mhe: mhe.run(*arguments)


ONES = np.ones((5, 1))
OF_ONE = [
    (ShapeError, ["y has shape (2,)", "expected (1,)"], update([1.0, 2.0])),
    (ShapeError, ["y has shape (0,)", "expected (1,)"], update([])),
    (InvalidInputError, ["y is [1j]", "real numbers"], update([1j])),
    (InvalidInputError, ["y is [[1.0], 2.0]", "real numbers"], update([[1.0], 2.0])),
    (InvalidInputError, ["u was given", "no inputs"], update([1.0], [0.0])),
    (InvalidInputError, ["u was given", "no inputs"], update([1.0], [])),
    (InvalidInputError, ["the system is discrete", "System.from_ode"], update([1.0], dt=0.1)),
    (WeightError, ["noise_weight has the eigenvalue 0", "positive definite"],
     update([1.0], noise_weight=0.0)),
    (InvalidInputError, ["noise_weight is nan", "finite"], update([1.0], noise_weight=math.nan)),
    (ShapeError, ["noise_weight has shape (2,)", "np.diag"], update([1.0], noise_weight=[1, 2])),
    (InvalidInputError, ["noise_weight is 'heavy'", "real"], update([1.0], noise_weight="heavy")),
    (ShapeError, ["measurements has shape (5, 2)", "(T, 1)"], run(np.ones((5, 2)))),
    (ShapeError, ["measurements has shape ()", "(T, 1)"], run(1.0)),
    (InvalidInputError, ["measurements"], run([[1.0], [1.0, 2.0]])),
    (InvalidInputError, ["measurements", "high"], run([[1.0], ["high"]])),
    (InvalidInputError, ["inputs"], run(ONES, ONES)),
    (InvalidInputError, ["inputs"], run(ONES, np.ones((5, 0)))),
]
OF_TWO = [
    (ShapeError, ["y has shape ()", "expected (2,)"], update(1.0)),
    (ShapeError, ["y has shape (1,)", "expected (2,)"], update([1.0])),
    (WeightError, ["noise_weight is not symmetric", "by 0.5"],
     update([1.0, 2.0], noise_weight=[[1.0, 0.5], [0.0, 1.0]])),
    (ShapeError, ["noise_weight has shape (1, 1)", "(2, 2)"], update([1.0, 2.0], noise_weight=3.0)),
]
WITH_INPUT = [
    (InvalidInputError, ["u is missing", "2 inputs", "update(y, u)"], update([1.0])),
    (ShapeError, ["u has shape (1,)", "expected (2,)"], update([1.0], [1.0])),
    (ShapeError, ["u has shape ()", "expected (2,)"], update([1.0], 1.0)),
    (ShapeError, ["u has shape (1, 2)", "expected (2,)"], update([1.0], [[1.0, 2.0]])),
    (InvalidInputError, ["u is 'up'", "real numbers"], update([1.0], "up")),
    (InvalidInputError, ["u is missing", "2 inputs"], run(ONES, None)),
    (ShapeError, ["inputs has 4 samples", "expected 5"], run(ONES, np.ones((4, 2)))),
    (ShapeError, ["inputs has shape (5, 3)", "(T, 2)"], run(ONES, np.ones((5, 3)))),
    (InvalidInputError, ["inputs"], run(ONES, [[1.0, 2.0]] * 4 + [[1.0]])),
]
IN_TIME = [
    (OptionError, [f"dt is {dt!r}", "finite number > 0"], update([1.0], dt=dt))
    for dt in (0, -0.1, math.nan, True, "0.1", [0.1])
]


def amend(age, y=(1.0,)):
    return lambda mhe: mhe.amend(mhe.time - 1 - age if isinstance(age, int) else age[0], y)


# The horizon is 3, and two samples are there before the first of these.
LATE = [
    (InvalidInputError, ["time is ", "an integer from ", "samples in the window", "longer horizon"],
     amend(7)),
    (InvalidInputError, ["time is ", "an integer from "], amend(-1)),
    *((InvalidInputError, [f"time is {time!r}", "an integer"], amend([time]))
      for time in (1.0, True, None, "1", [1])),
    (ShapeError, ["y has shape (2,)", "expected (1,)"], amend(0, [1.0, 2.0])),
    (ShapeError, ["y has shape (0,)", "expected (1,)"], amend(1, [])),
    (InvalidInputError, ["y is [1j]", "real numbers"], amend(1, [1j])),
]


def begun():
    mhe = estimator()
    mhe.run([1.0, 1.2])
    return mhe


@pytest.mark.parametrize(
    ("build", "wrong", "sample"),
    [
        (estimator, OF_ONE, ([1.5],)), (two_outputs, OF_TWO, ([1.0, 2.0],)),
        (with_input, WITH_INPUT, ([1.5], [0.1, 0.2])), (in_time, IN_TIME, ([1.5],)),
        (begun, LATE, ([1.5],)),
    ],
)
def test_samples_that_do_not_fit_leave_the_estimator_as_it_was(build, wrong, sample):
    unharmed(build, wrong, sample)


def test_a_late_measurement_needs_a_sample():
    text = ["time is 0", "no sample yet", "call update first"]
    check(InvalidInputError, text, estimator().amend, 0, [1.0])
