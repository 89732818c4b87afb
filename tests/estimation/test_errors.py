"""What fits nothing is refused where it is given: with its value, the expectation, the remedy.

`tests/test_odd_values.py` gives every argument odd values; here is a message of each kind.
"""

import math
from operator import and_

import numpy as np
import pytest

import qpmhe
from qpmhe import Box, Polytope, Status
from qpmhe.errors import (
    BackendError,
    InvalidInputError,
    ModelError,
    OptionError,
    SetError,
    ShapeError,
    WeightError,
)

from .spoil import check, cost_of, estimator, system_of, unharmed, with_input
from .untraced import untraced

TERMS = ("prior", "disturbance", "noise")


def ode(rate=lambda x: -x, h=lambda x: x[..., :1], **options):
    return qpmhe.System.from_ode(rate, h, **{"n": 2, "p": 1, "dt": 0.1} | options)


def test_parts():
    for name, value, expected in (
        ("system", "part", "qpmhe.System"), ("cost", ("a", "b"), "qpmhe.QuadraticCost"),
        ("observer", Box(0.0, 1.0), "qpmhe.Luenberger"),
    ):
        text = [f"{name} is {value!r}", f"expected a {expected}"]
        check(InvalidInputError, text, estimator, **{name: value})
    text = ["gain has shape (1, 2)", "(n, p) = (2, 1)"]
    check(ShapeError, text, estimator, observer=qpmhe.Luenberger([[0.1, 0.2]]))
    text = ["covariance, but Luenberger has none", "prior=", "qpmhe.ExtendedKalman"]
    check(InvalidInputError, text, estimator, cost=cost_of(prior=qpmhe.ObserverPrior()))
    for kind in (qpmhe.QuadraticCost, qpmhe.QuadraticCost.from_covariances, qpmhe.RobustCost):
        omitted = kind(disturbance=np.eye(2), noise=[[1.0]])
        check(InvalidInputError, ["Luenberger has none", "prior="], estimator, cost=omitted)


def test_initial_states():
    system = system_of(h=lambda x: np.sqrt(x[..., :1]))
    mhe = estimator(system)
    mhe.update([1.0])
    before = mhe.state.copy()
    for state, kind, text in (
        ([math.inf, 1.0], InvalidInputError, ["initial_state", "[inf, 1.0]", "finite"]),
        ([-1.0, 2.0], ModelError, ["h is [nan] at the initial state [-1.0, 2.0]"]),
    ):
        check(kind, text, estimator, system, initial_state=state)
        check(kind, text, mhe.reset, state)
        assert mhe.time == 1
        np.testing.assert_array_equal(mhe.state, before)


def test_weights_and_covariances():
    for value, kind, text in (
        (np.diag([1.0, -2.0]), WeightError, ["eigenvalue -2"]),
        ([[1.0, 0.5], [0.0, 1.0]], WeightError, ["not symmetric", "by 0.5"]),
        ([1.0, 2.0], ShapeError, ["shape (2,)", "np.diag"]),
        ([[1.0, 0.0], [0.0, math.nan]], InvalidInputError, ["nan", "finite"]),
    ):
        for name in TERMS:
            check(kind, [f"{name} ", *text], cost_of, 2, 2, **{name: value})
            given = dict.fromkeys(TERMS, np.eye(2)) | {name: value}
            check(kind, [f"{name} covariance ", *text], qpmhe.ExtendedKalman, **given)
    singular = {name: np.ones((2, 2)) for name in ("prior", "disturbance")}
    qpmhe.ExtendedKalman(**singular, noise=np.eye(2))
    check(WeightError, ["noise ", "positive definite"], cost_of, 2, 2, noise=np.ones((2, 2)))


def test_sets():
    empty = ["the set is empty", "no point satisfies all"]
    quarter = Polytope([[1.0, 0.0]], [0.0]) & Polytope([[0.0, -1.0]], [0.0])
    for build, one, other, kind, text in (
        (Box, [0.0, 0.0], [1.0], SetError, ["(2,)", "(1,)", "equal length"]),
        (Box, [0.0, 2.0], [1.0, 1.0], SetError, ["component 1", "lower 2.0", "upper 1.0"]),
        (Polytope, np.eye(2), [1.0], SetError, ["shape (2, 2)", "bound (1,)", "(r, d) and (r,)"]),
        (and_, quarter, Polytope([[-1.0, 1.0]], [-1.0]), SetError, empty),
    ):
        check(kind, text, build, one, other)
    check(SetError, ["noises is (0.0, 1.0)", "qpmhe.Box"], system_of, noises=(0.0, 1.0))


def double(x, u=None):
    (x if u is None else u)[...] *= 2.0
    return x


def test_systems():
    for make, name, expected, value in (
        (system_of, "n", "integer >= 1", 0), (system_of, "m", "integer >= 0", -1),
        (ode, "dt", "finite number > 0", 0), (ode, "method", "'euler', 'rk4'", "RK4"),
    ):
        check(OptionError, [f"{name} is {value!r}", expected], make, **{name: value})
    for name in ("f", "h"):
        functions = {"f": lambda x: x, "h": lambda x: x[..., :1], name: 3.0}
        check(ModelError, [f"{name} is 3.0", "a function"], qpmhe.System, **functions, n=2, p=1)
        text = [f"{name} returned shape (2, 2) at x = ", "Check n, p"]
        check(ModelError, text, system_of, **{name: lambda x: np.ones((2, 2))})
        text = [f"{name} changes its argument in place", "copy"]
        check(ModelError, text, system_of, **{name: double}, p=2, m=2)


def test_options_out_of_range():
    for name, value, *words in (
        ("horizon", 0, "expected an integer >= 1"), ("max_qps", 1.5, "expected an integer >= 0"),
        ("tolerance", math.nan, "a finite number > 0"), ("time_budget", 0, "finite number > 0"),
        ("warm_start", "best", "True or False"),
        ("infeasible", "drop", "'drop_rows'", "'restore'"),
    ):
        check(OptionError, [f"{name} is {value!r}", *words], estimator, **{name: value})
    names = [entry.name for entry in qpmhe.solvers.backends()]
    for value in ("OSQP", None, ["osqp"]):
        check(BackendError, [f"backend {value!r} is not known", *names], estimator, backend=value)


def test_unknown_options_are_refused_with_the_known_ones():
    for make in (estimator, system_of, cost_of, qpmhe.solvers.SolverOptions):
        with pytest.raises(TypeError, match="has no option 'nonsense'; expect"):
            make(nonsense=1)
    with pytest.raises(OptionError, match="Did you mean max_qps"):
        estimator(max_qp=2)


def begun():
    """The horizon is 3, and two samples are there."""
    mhe = estimator()
    mhe.run([1.0, 1.2])
    return mhe


ONES = np.ones((5, 1))
OF_ONE = [
    (ShapeError, ["y has shape (2,)", "(1,)"], lambda mhe: mhe.update([1.0, 2.0])),
    (InvalidInputError, ["u was given", "no inputs"], lambda mhe: mhe.update([1.0], [0.0])),
    (InvalidInputError, ["is discrete", "from_ode"], lambda mhe: mhe.update([1.0], dt=0.1)),
    (WeightError, ["noise_weight has the eigenvalue 0", "positive definite"],
     lambda mhe: mhe.update([1.0], noise_weight=0.0)),
    (ShapeError, ["measurements has shape (5, 2)", "(T, 1)"], lambda mhe: mhe.run(ONES[:, [0, 0]])),
    (InvalidInputError, ["inputs"], lambda mhe: mhe.run(ONES, ONES)),
    (InvalidInputError, ["time is ", "an integer from ", "samples in the window", "longer"],
     lambda mhe: mhe.amend(mhe.time - 8, [1.0])),
    (ShapeError, ["y has shape (0,)", "(1,)"], lambda mhe: mhe.amend(mhe.time - 1, [])),
]
WITH_INPUT = [
    (InvalidInputError, ["u is missing", "update(y, u)"], lambda mhe: mhe.update([1.0])),
    (InvalidInputError, ["U is missing", "2 inputs", "run(Y, U)"], lambda mhe: mhe.run(ONES)),
    (ShapeError, ["inputs has 1 samples", "expected 5"], lambda mhe: mhe.run(ONES, [[0.0, 0.0]])),
]


@pytest.mark.parametrize(("build", "wrong", "sample"), [
    (begun, OF_ONE, ([1.5],)), (with_input, WITH_INPUT, ([1.5], [0.1, 0.2])),
], ids=["one output", "inputs"])
def test_samples_that_do_not_fit_leave_the_estimator_as_it_was(build, wrong, sample):
    unharmed(build, wrong, sample)
    text = ["time is 0", "no sample yet", "call update first"]
    check(InvalidInputError, text, estimator().amend, 0, [1.0])


# What a model raises during a step is in the estimate's message


def raising(text, above=2.0):
    def g(x):
        if float(np.real(x[0])) > above:
            raise ValueError(text)
        return x * 1.0

    return g


def correction(z, v):
    if v[0] > 10.0:
        raise ValueError("no gain")
    return 0.5 * v


def scalar(f=lambda x: 0.9 * x, h=lambda x: x, observer=None, **slopes):
    return estimator(
        qpmhe.System(f, h, n=1, p=1, **slopes), observer or qpmhe.Luenberger([0.5]),
        cost_of(1, 1, disturbance=10.0), horizon=4, initial_state=[1.0],
    )


def test_what_fails_at_the_newest_stage_is_in_the_message():
    beyond, no_slope = raising("beyond the table"), raising("no slope")
    for parts, text in (  # the observer is at 50 after a measurement of 100
        ({"f": beyond}, "f raised ValueError: beyond the table at x = [50."),
        ({"h": lambda x: np.where(x > 2.0, np.nan, x)}, "h is [nan] at x = [50."),
        ({"f": lambda x: np.where(x > 2.0, np.inf, x)}, "f is [inf] at x = [50."),
        ({"observer": qpmhe.OutputInjection(lambda z, v: np.where(v > 10.0, np.nan, v))},
         "the observer's correction is not finite at x = ["),
        ({"h": untraced(lambda x: x), "h_jacobian": lambda x: no_slope(x).reshape(1, 1) / x},
         "the Jacobian of h raised ValueError: no slope at x = [50."),
        ({"observer": qpmhe.OutputInjection(correction)},
         "the observer's correction raised ValueError: no gain at x = [0.9]"),
    ):
        mhe = scalar(**parts)
        assert mhe.update(1.0).message == ""
        estimate = mhe.update(100.0)
        if "observer" not in parts:
            estimate = mhe.update(1.0)
        assert Status.MODEL_FAILED in estimate.status
        assert text in estimate.message
    mhe.reset()  # a message is of its own step
    assert [mhe.update(1.0).message for _ in range(3)] == ["", "", ""]
