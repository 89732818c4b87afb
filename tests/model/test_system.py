"""A model may be written in many ways; its values are those of one state at a time.

Functions are called state by state, with copies; estimators evaluate their expressions.
"""

import math
from functools import partial

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import ModelError

from .ways import NONE, PENDULUMS, check_values, pendulum

A = np.array([[1.0, 0.1], [-0.2, 0.9]])
B = np.array([[0.5, 0.3], [-0.4, 1.0]])
BUFFER = np.zeros(2)


@pytest.mark.whole
@pytest.mark.parametrize("way", PENDULUMS)
def test_every_way_of_writing_f_gives_equal_values(way):
    f, is_traced = PENDULUMS[way]
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    own = system.model().functions
    assert (own.f_jacobian.method == "traced") == is_traced
    assert (system.f.mode, own.f.mode) == ("looped", "batched" if is_traced else "looped")
    for function in (system.f, own.f):
        check_values(function, pendulum, 2)


def buffered(x):
    BUFFER[0], BUFFER[1] = x[1], -x[0]
    return BUFFER


def test_functions_of_two_states():
    for f, plain in (  # and the same for one state at a time where f is not that
        (lambda x: np.array([x[1], 1.5]), None),
        (lambda x: 0.5 * np.eye(2) @ x, lambda x: 0.5 * x),
        (lambda x: (A @ x.T).T, None),  # right on one leading dimension only
        (lambda x: x / np.linalg.norm(x), None),  # what mixes many states
        (buffered, lambda x: [x[1], -x[0]]),
        (lambda x: np.array([0.9 * x[0], 0.8 * x[1]], dtype=object), None),
    ):
        system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
        expected = plain or f
        check_values(system.f, lambda x, u, g=expected: np.array(g(x), dtype=float), 2)


def test_a_single_output_or_state_may_be_a_scalar():
    for h in (lambda x: x[0], lambda x: x[:1], lambda x: float(x[0])):
        check_values(qpmhe.System(lambda x: x, h, n=4, p=1).h, lambda x, u: x[:1], 4)
    for h, plain in (
        (np.sum, sum), (np.linalg.norm, lambda x: math.hypot(*x)), (lambda x: 3.0, lambda x: 3.0),
    ):
        system = qpmhe.System(lambda x: x, h, n=2, p=1)
        check_values(system.h, lambda x, u, plain=plain: np.array([plain(x)]), 2)
    system = qpmhe.System(lambda x: math.sin(x.item()), lambda x: x, n=1, p=1)
    check_values(system.f, lambda x, u: np.array([math.sin(x[0])]), 1)


def test_inputs():
    for f in (
        lambda x, u: x @ A.T + u @ B.T + x * u,
        lambda x, u: np.inner(A, x) + np.inner(B, u) + x * u,
        lambda x, force=None, gain=1.0: A @ x + gain * (B @ force) + x * force,
        partial(lambda x, u, gain: A @ x + gain * (B @ u) + x * u, gain=1.0),
    ):
        system = qpmhe.System(f, lambda x, u: x[0] * u[0] + u[1], n=2, p=1, m=2)
        for own in (system, system.model().functions):
            check_values(own.f, lambda x, u: A @ x + B @ u + x * u, 2, 2)
            check_values(own.h, lambda x, u: np.array([x[0] * u[0] + u[1]]), 2, 2)


def test_rounding_in_odd_units_hides_no_expression():
    """A state of size 1 is far off for a model in nanometres, and a sine of sums all rounding."""
    weights = np.random.default_rng(3).standard_normal((40, 40))
    system = qpmhe.System(lambda x: np.sin(1e9 * (x @ weights)), lambda x: x[:1], n=40, p=1)
    x = np.random.default_rng(4).uniform(-1e-9, 1e-9, (5, 40))
    assert system.derivatives["f"] == "traced"
    np.testing.assert_allclose(
        system.f.batch(x, np.zeros((5, 0))), [np.sin(1e9 * (one @ weights)) for one in x], 1e-12)


def test_what_is_no_clear_input_is_refused():
    for f, words in (
        (lambda x: x, "neither f nor h takes an input"),
        (lambda x, scale=2.0, u=0.0: x, "make u the second"),
        (lambda x, *, u=0.0: x + u, "by keyword only"),
        (lambda x, u, w: x + u + w, "needs 3 arguments"), (lambda: 1.0, "takes no argument"),
        # A constant, which u would replace: a number, or what the input is.
        (lambda x, k=0.1: k * x, r"k=0.1 in the place of the input u.*bind it"),
        (lambda x, k=(1.0,): k * x, "k=.* in the place of the input u"),
        (lambda x, i=0: x[..., i:], "i=0 in the place"), (lambda x, sin=np.sin: sin(x), "sin="),
    ):
        with pytest.raises(ModelError, match=words):
            qpmhe.System(f, lambda x: x, n=1, p=1, m=1)
        if "place" in words:
            qpmhe.System(f, lambda x: x, n=1, p=1)
            with pytest.raises(ModelError, match=words):
                qpmhe.System(lambda x, u: x + u, f, n=1, p=1, m=1)
    with pytest.raises(ModelError, match=r"h has the parameter k=0.1 in the place of the input u"):
        qpmhe.System.from_dae(lambda x, z, u: u - z, lambda x, z: z - x, lambda x, z, k=0.1: k * x,
                              dt=0.1, n=1, k=1, p=1, m=1, algebraic_guess=[0.0])


def test_a_function_defined_far_away_is_tried_at_the_initial_state():
    far = np.array([12.0, 13.0])
    for h in (
        lambda x: np.sqrt(x - 10.0), lambda x: [np.sqrt(x[0] - 10.0), x[1]],
        lambda x: [math.sqrt(x[0] - 10.0), x[1]], lambda x: np.sqrt(x - 10.0) * np.max(x),
    ):
        system = qpmhe.System(lambda x: x, h, n=2, p=2)
        system = system.at(far, NONE)
        x = np.random.default_rng(2).uniform(11.0, 15.0, (4, 2))
        found = system.h.batch(x, np.zeros((4, 0)))
        np.testing.assert_allclose(found, [h(row) for row in x], rtol=1e-12)


def test_functions_are_tried_within_the_state_bounds():
    seen = []

    def f(x):
        seen.append(np.array(x))
        return 0.5 * x

    box = qpmhe.Box([-3.0, 5.0, -np.inf], [-2.0, np.inf, -7.0])
    qpmhe.System(f, lambda x: x[..., :1], n=3, p=1, states=box)
    # Symbols, which prove what it does with many states, have no values.
    single = np.array([x for x in seen if x.ndim == 1 and x.dtype != object], dtype=float)
    assert len(single) >= 2
    assert box.violation(single) == 0.0


# Whether a state, or many, is beyond 12: farther than all points that are tried at construction.
BEYOND = {
    "item": lambda x: x.item(0) > 12.0,
    "array": lambda x: np.array(x, dtype=float).ravel()[0] > 12.0,
    "all": lambda x: np.all(x > 12.0),
    "text": lambda x: f"{np.ravel(x)[0]:09.5f}" > "012.0",
    "bytes": lambda x: np.frombuffer(x.tobytes())[0] > 12.0,
}


def test_a_function_with_a_branch_is_called_state_by_state():
    for way, beyond in BEYOND.items():
        def branch(x, beyond=beyond):
            return 0.5 * x if beyond(x) else 0.95 * x + 0.4

        system = qpmhe.System(lambda x, f=branch: f(x), lambda x: x, n=1, p=1)
        assert system.model().functions.f.mode == "looped", way
        states = np.array([[11.0], [13.0], [9.0], [20.0]])
        found = system.f.batch(states, np.zeros((4, 0)))
        np.testing.assert_array_equal(found, [branch(x) for x in states])


def test_what_is_written_into_an_argument_changes_nothing():
    def clipped(x, u):
        x[x > 12.0] = 12.0
        return 0.5 * x + u

    states = np.array([[20.0], [4.0]])
    system = qpmhe.System(clipped, lambda x: x, n=1, p=1, m=1)
    assert system.f(states[0], np.zeros(1)) == 6.0
    np.testing.assert_array_equal(system.f.batch(states, np.zeros((2, 1))), [[6.0], [2.0]])
    assert states[0] == 20.0
