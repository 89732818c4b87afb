"""A sample that does not fit leaves the estimator as it was."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, OptionError, ShapeError, WeightError

from .spoil import A, cases, check, cost_of, estimator, system_of, unharmed, with_input


@pytest.mark.parametrize(
    ("y", "kind", "fragments"),
    cases(
        ([1.0, 2.0], ShapeError, ["y has shape (2,)", "expected (1,)"]),
        ([], ShapeError, ["y has shape (0,)", "expected (1,)"]),
        ([[1.0]], ShapeError, ["y has shape (1, 1)", "expected (1,)"]),
        ([1j], InvalidInputError, ["y is [1j]", "real numbers"]),
        (["high"], InvalidInputError, ["y is ['high']", "real numbers"]),
        ([[1.0], 2.0], InvalidInputError, ["y is [[1.0], 2.0]", "real numbers"]),
    ),
)
def test_measurements(y, kind, fragments):
    unharmed(estimator, [(kind, fragments, lambda mhe: mhe.update(y))], ([1.5],))


def test_a_scalar_is_no_measurement_of_two_outputs():
    def build():
        return estimator(
            system_of(h=lambda x: x, p=2), qpmhe.Luenberger(0.1 * np.eye(2)), cost_of(2, 2)
        )

    unharmed(
        build,
        [
            (ShapeError, ["y has shape ()", "expected (2,)"], lambda mhe: mhe.update(1.0)),
            (ShapeError, ["y has shape (1,)", "expected (2,)"], lambda mhe: mhe.update([1.0])),
        ],
        ([1.0, 2.0],),
    )


@pytest.mark.parametrize(
    ("u", "kind", "fragments"),
    cases(
        ((), InvalidInputError, ["u is missing", "2 inputs", "update(y, u)"]),
        ((None,), InvalidInputError, ["u is missing", "2 inputs", "update(y, u)"]),
        (([1.0],), ShapeError, ["u has shape (1,)", "expected (2,)"]),
        ((1.0,), ShapeError, ["u has shape ()", "expected (2,)"]),
        (([1.0, 2.0, 3.0],), ShapeError, ["u has shape (3,)", "expected (2,)"]),
        (([[1.0, 2.0]],), ShapeError, ["u has shape (1, 2)", "expected (2,)"]),
        (("up",), InvalidInputError, ["u is 'up'", "real numbers"]),
        (([1.0, 1j],), InvalidInputError, ["u is [1.0, 1j]", "real numbers"]),
    ),
)
def test_inputs(u, kind, fragments):
    unharmed(
        with_input, [(kind, fragments, lambda mhe: mhe.update([1.0], *u))], ([1.5], [0.1, 0.2])
    )


@pytest.mark.parametrize("u", [[0.0], 0.0, []], ids=repr)
def test_unexpected_inputs(u):
    unharmed(
        estimator,
        [(InvalidInputError, ["u was given", "no inputs"], lambda mhe: mhe.update([1.0], u))],
        ([1.5],),
    )


@pytest.mark.parametrize(
    ("measurements", "kind", "fragments"),
    [
        (np.ones((5, 2)), ShapeError, ["measurements has shape (5, 2)", "(T, 1)"]),
        (np.ones((5, 1, 1)), ShapeError, ["measurements has shape (5, 1, 1)", "(T, 1)"]),
        (1.0, ShapeError, ["measurements has shape ()", "(T, 1)"]),
        ([[1.0], [1.0, 2.0]], InvalidInputError, ["measurements"]),
        ([[1.0], ["high"]], InvalidInputError, ["measurements", "high"]),
        ([[1.0], [1j]], InvalidInputError, ["measurements", "1j"]),
    ],
    ids=["wide", "deep", "scalar", "ragged", "text", "complex"],
)
def test_records(measurements, kind, fragments):
    unharmed(estimator, [(kind, fragments, lambda mhe: mhe.run(measurements))], ([1.5],))


@pytest.mark.parametrize(
    ("inputs", "kind", "fragments"),
    [
        (None, InvalidInputError, ["u is missing", "2 inputs"]),
        (np.ones((4, 2)), ShapeError, ["inputs has 4 samples", "expected 5"]),
        (np.ones((6, 2)), ShapeError, ["inputs has 6 samples", "expected 5"]),
        (np.ones((5, 1)), ShapeError, ["inputs has shape (5, 1)", "(T, 2)"]),
        (np.ones((5, 3)), ShapeError, ["inputs has shape (5, 3)", "(T, 2)"]),
        (np.ones(5), ShapeError, ["inputs has shape (5,)", "(T, 2)"]),
        ([[1.0, 2.0]] * 4 + [[1.0]], InvalidInputError, ["inputs"]),
    ],
    ids=["none", "short", "long", "narrow", "wide", "vector", "ragged"],
)
def test_records_of_inputs(inputs, kind, fragments):
    unharmed(
        with_input, [(kind, fragments, lambda mhe: mhe.run(np.ones((5, 1)), inputs))],
        ([1.5], [0.1, 0.2]),
    )


@pytest.mark.parametrize("inputs", [np.ones((5, 1)), np.ones((5, 0)), np.ones(5)], ids=str)
def test_unexpected_records_of_inputs(inputs):
    unharmed(
        estimator,
        [(InvalidInputError, ["inputs"], lambda mhe: mhe.run(np.ones((5, 1)), inputs))],
        ([1.5],),
    )


# Steps and weights of single samples


def in_time():
    return estimator(
        qpmhe.System.from_ode(
            lambda x: x @ (A - np.eye(2)), lambda x: x[..., :1], dt=0.1, n=2, p=1
        )
    )


@pytest.mark.parametrize("dt", [0, 0.0, -0.1, math.nan, math.inf, True, "0.1", [0.1]], ids=repr)
def test_lengths_of_steps(dt):
    unharmed(
        in_time,
        [(OptionError, [f"dt is {dt!r}", "finite number > 0"], lambda m: m.update([1.0], dt=dt))],
        ([1.5],),
    )


def test_a_discrete_system_has_one_step():
    unharmed(
        estimator,
        [
            (
                InvalidInputError, ["the system is discrete", "System.from_ode"],
                lambda mhe: mhe.update([1.0], dt=0.1),
            )
        ],
        ([1.5],),
    )


@pytest.mark.parametrize(
    ("weight", "kind", "fragments"),
    cases(
        (-1.0, WeightError, ["noise_weight has the eigenvalue -1", "positive definite"]),
        (0.0, WeightError, ["noise_weight has the eigenvalue 0", "positive definite"]),
        (math.nan, InvalidInputError, ["noise_weight is nan", "finite"]),
        ([1.0, 2.0], ShapeError, ["noise_weight has shape (2,)", "np.diag"]),
        ([[1.0, 0.0], [0.0, 1.0]], ShapeError, ["noise_weight has shape (2, 2)", "(1, 1)"]),
        ("heavy", InvalidInputError, ["noise_weight is 'heavy'", "real numbers"]),
        (1j, InvalidInputError, ["noise_weight is 1j", "real numbers"]),
    ),
)
def test_noise_weights(weight, kind, fragments):
    unharmed(
        estimator, [(kind, fragments, lambda mhe: mhe.update([1.0], noise_weight=weight))],
        ([1.5],),
    )


def test_noise_weights_of_two_outputs():
    def build():
        return estimator(
            system_of(h=lambda x: x, p=2), qpmhe.Luenberger(0.1 * np.eye(2)), cost_of(2, 2)
        )

    def call(weight):
        return lambda mhe: mhe.update([1.0, 2.0], noise_weight=weight)

    unharmed(
        build,
        [
            (WeightError, ["noise_weight is not symmetric", "by 0.5"],
             call([[1.0, 0.5], [0.0, 1.0]])),
            (WeightError, ["noise_weight has the eigenvalue -1"], call(np.diag([1.0, -1.0]))),
            (ShapeError, ["noise_weight has shape (1, 1)", "(2, 2)"], call(3.0)),
        ],
        ([1.0, 2.0],),
    )


# Late measurements


@pytest.mark.parametrize("after", [1, 2, 3, 4, 9])
def test_late_measurements_outside_of_the_window(after):
    # The horizon is 3: after k samples, those from k - 3 on are in the window.
    spoilt, twin = estimator(), estimator()
    for t in range(after):
        spoilt.update([0.1 * t])
        twin.update([0.1 * t])
    oldest = max(0, after - 3)
    before = spoilt.state.copy()
    for time in (oldest - 1, oldest - 100, after, after + 1):
        fragments = [
            f"time is {time}", f"an integer from {oldest} to {after - 1}",
            "samples in the window", "longer horizon",
        ]
        check(InvalidInputError, fragments, lambda time=time: spoilt.amend(time, [1.0]))
        assert spoilt.time == after
        np.testing.assert_array_equal(spoilt.state, before)
    for _ in range(4):
        one, other = spoilt.update([1.5]), twin.update([1.5])
        np.testing.assert_array_equal(one.trajectory, other.trajectory)
        assert (one.cost, one.candidate_cost) == (other.cost, other.candidate_cost)
    for time in range(max(0, spoilt.time - 3), spoilt.time):
        spoilt.amend(time, [1.0])


@pytest.mark.parametrize("time", [1.0, True, False, None, "1", [1]], ids=repr)
def test_times_that_are_no_integer(time):
    def build():
        mhe = estimator()
        mhe.run([1.0, 1.2])
        return mhe

    unharmed(
        build,
        [
            (
                InvalidInputError, [f"time is {time!r}", "an integer"],
                lambda mhe: mhe.amend(time, [1.0]),
            )
        ],
        ([1.5],),
    )


def test_times_may_be_integers_of_numpy():
    one, other = estimator(), estimator()
    for mhe, time in ((one, 1), (other, np.int64(1))):
        mhe.run([1.0, 1.2, 1.1])
        mhe.amend(time, [0.7])
    np.testing.assert_array_equal(one.state, other.state)


@pytest.mark.parametrize(
    ("y", "kind", "fragments"),
    cases(
        ([1.0, 2.0], ShapeError, ["y has shape (2,)", "expected (1,)"]),
        ([], ShapeError, ["y has shape (0,)", "expected (1,)"]),
        ([[1.0]], ShapeError, ["y has shape (1, 1)", "expected (1,)"]),
        ([1j], InvalidInputError, ["y is [1j]", "real numbers"]),
        ("high", InvalidInputError, ["y is 'high'", "real numbers"]),
    ),
)
@pytest.mark.parametrize("age", [0, 1])
def test_late_measurements_that_do_not_fit(age, y, kind, fragments):
    def build():
        mhe = estimator()
        mhe.run([1.0, 1.2])
        return mhe

    unharmed(
        build, [(kind, fragments, lambda mhe: mhe.amend(mhe.time - 1 - age, y))], ([1.5],)
    )


@pytest.mark.parametrize("time", [0, -1, 3])
def test_a_late_measurement_needs_a_first_one(time):
    mhe = estimator()
    fragments = [f"time is {time}", "no sample yet", "update first"]
    check(InvalidInputError, fragments, lambda: mhe.amend(time, [1.0]))
    np.testing.assert_array_equal(
        mhe.update([1.5]).trajectory, estimator().update([1.5]).trajectory
    )
