"""A sample that does not fit leaves the estimator as it was."""

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ShapeError

from .spoil import cases, cost_of, estimator, system_of, unharmed, with_input


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
