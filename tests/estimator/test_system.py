"""A model may be written in many ways; its values are those of one state at a time."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import ModelError

from .ways import NONE, PENDULUMS, check_values, pendulum

A = np.array([[1.0, 0.1], [-0.2, 0.9]])
B = np.array([[0.5, 0.3], [-0.4, 1.0]])


@pytest.mark.parametrize("way", PENDULUMS)
def test_every_way_of_writing_f_gives_equal_values(way):
    f, mode = PENDULUMS[way]
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    assert system.f.mode == mode
    check_values(system.f, pendulum, 2)


BUFFER = np.zeros(2)


def buffered(x):
    BUFFER[0], BUFFER[1] = x[1], -x[0]
    return BUFFER


# f of two states, and the same for one state at a time where f is not that.
FUNCTIONS = {
    "constant component": (lambda x: np.array([x[1], 1.5]), None),
    "added vector": (lambda x: np.array([x[1], -x[0]]) + np.array([1.0, 2.0]), None),
    "times a multiple of the identity": (lambda x: 0.5 * np.eye(2) @ x, lambda x: 0.5 * x),
    "identity": (lambda x: x, None),
    # Right on one leading dimension only.
    "A @ x.T": (lambda x: (A @ x.T).T, None),
    "rows @ x.T": (lambda x: np.stack([row @ x.T for row in A], axis=-1), None),
    # What mixes many states
    "norm": (lambda x: x / np.linalg.norm(x), None),
    "max": (lambda x: x * np.max(x), None),
    "cumsum": (lambda x: np.cumsum(x), None),
    "sort": (lambda x: np.sort(x), None),
    # What one array holds
    "the same array": (buffered, lambda x: [x[1], -x[0]]),
    "objects": (lambda x: np.array([0.9 * x[0], 0.8 * x[1]], dtype=object), None),
}


@pytest.mark.parametrize("way", FUNCTIONS)
def test_functions_of_two_states(way):
    f, plain = FUNCTIONS[way]
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    check_values(system.f, lambda x, u: np.array((plain or f)(x), dtype=float), 2)


def test_a_single_output_or_state_may_be_a_scalar():
    for n in (1, 2, 4):
        for h in (
            lambda x: x[0], lambda x: x[..., 0], lambda x: x[:1], lambda x: x[..., :1],
            lambda x: float(x[0]), lambda x: np.eye(x.shape[0])[0] @ x,
        ):
            check_values(qpmhe.System(lambda x: x, h, n=n, p=1).h, lambda x, u: x[:1], n)
    for h, plain in (
        (np.sum, sum), (lambda x: x @ np.array([1.0, 2.0]), lambda x: x[0] + 2 * x[1]),
        (lambda x: np.array([1.0, 2.0]) @ x, lambda x: x[0] + 2 * x[1]),
        (np.linalg.norm, lambda x: math.hypot(*x)), (lambda x: 3.0, lambda x: 3.0),
    ):
        system = qpmhe.System(lambda x: x, h, n=2, p=1)
        check_values(system.h, lambda x, u, plain=plain: np.array([plain(x)]), 2)
    for f in (
        lambda x: np.sin(x), lambda x: math.sin(x.item()), lambda x: [math.sin(x[0])],
    ):
        system = qpmhe.System(f, lambda x: x, n=1, p=1)
        check_values(system.f, lambda x, u: np.array([math.sin(x[0])]), 1)


# Inputs


def test_inputs():
    for f, mode in (
        (lambda x, u: x @ A.T + u @ B.T + x * u, "batched"),
        (lambda x, u: A @ x + B @ u + x * u, "columns"),
        (lambda x, u: np.inner(A, x) + np.inner(B, u) + x * u, "looped"),
        (lambda *a: a[0] @ A.T + a[1] @ B.T + a[0] * a[1], "batched"),
        (lambda x, force=None, gain=1.0: A @ x + gain * (B @ force) + x * force, "columns"),
    ):
        system = qpmhe.System(f, lambda x, u: x[0] * u[0] + u[1], n=2, p=1, m=2)
        assert system.f.mode == mode
        check_values(system.f, lambda x, u: A @ x + B @ u + x * u, 2, 2)
        check_values(system.h, lambda x, u: np.array([x[0] * u[0] + u[1]]), 2, 2)
    for m in (1, 2, 3):
        for f, plain in (
            (lambda x, u: x + u[0], None), (lambda x, u: x + u[..., :1], None),
            (lambda x, u: [x[1], u[0]], lambda x, u: np.array([x[1], u[0]])),
            (lambda x, u: u[0] * np.ones(2), lambda x, u: u[[0, 0]]),
            (lambda x: 2.0 * x, lambda x, u: 2.0 * x),
            (lambda x, u, scale=3.0: scale * x + u[0], None),
            (lambda x, q=0.0: x + q[0], lambda x, u: x + u[0]),
        ):
            system = qpmhe.System(f, lambda x, u: x[..., :1], n=2, p=1, m=m)
            check_values(system.f, plain or f, 2, m)
    system = qpmhe.System(
        lambda x, u: x + (0.5 * np.eye(3) @ u)[..., :2], lambda x: x[..., :1], n=2, p=1, m=3
    )
    check_values(system.f, lambda x, u: x + 0.5 * u[:2], 2, 3)
    alone = qpmhe.System(lambda x, scale=3.0: scale * x, lambda x: x, n=1, p=1)
    assert alone.f(np.ones(1), NONE) == 3.0


def test_what_is_no_clear_input_is_refused():
    for f, words in (
        (lambda x: x, "neither f nor h takes an input"),
        (lambda x, scale=2.0, u=0.0: x, "make u the second"),
        (lambda x, matrix=A: x, "no input of 1 numbers"),
        (lambda x, function=np.sin: x, "no input of 1 numbers"),
        (lambda x, *, u=0.0: x + u, "by keyword only"),
        (lambda x, u, w: x + u + w, "needs 3 arguments"),
        (lambda: 1.0, "takes no argument"),
    ):
        with pytest.raises(ModelError, match=words):
            qpmhe.System(f, lambda x: x, n=1, p=1, m=1)
        if "f nor h" in words:
            with pytest.raises(ModelError, match="neither rate nor h takes an input"):
                qpmhe.System.from_ode(f, lambda x: x, dt=0.1, n=1, p=1, m=1)
            for make in (qpmhe.from_casadi, qpmhe.from_jax):
                with pytest.raises(ModelError, match=words):
                    make(f, lambda x: x, n=1, p=1, m=1)


# Where functions are tried


def test_a_function_defined_far_away_is_tried_at_the_initial_state():
    far = np.array([12.0, 13.0])
    for h in (
        lambda x: np.sqrt(x - 10.0), lambda x: [np.sqrt(x[0] - 10.0), x[1]],
        lambda x: [math.sqrt(x[0] - 10.0), x[1]], lambda x: np.sqrt(x - 10.0) * np.max(x),
    ):
        system = qpmhe.System(lambda x: x, h, n=2, p=2)
        assert system.h.mode == "unknown"
        system.check(far, NONE)
        x = np.random.default_rng(2).uniform(11.0, 15.0, (4, 2))
        found = system.h.batch(x, np.zeros((4, 0)))
        np.testing.assert_allclose(found, [h(row) for row in x], rtol=1e-12)
    system = qpmhe.System(lambda x: x, lambda x, u: math.sqrt(x[0] - 10.0) + u[0], n=2, p=1, m=1)
    system.check(far, np.zeros(1))
    np.testing.assert_allclose(system.h(far, np.ones(1)), [math.sqrt(2.0) + 1.0], rtol=1e-15)


def test_functions_are_tried_within_the_state_bounds():
    seen = []

    def f(x):
        seen.append(np.array(x))
        return 0.5 * x

    box = qpmhe.Box([-3.0, 5.0, -np.inf], [-2.0, np.inf, -7.0])
    system = qpmhe.System(f, lambda x: x[..., :1], n=3, p=1, m=0, states=box)
    # Symbols, which prove what it does with many states, have no values.
    single = np.array([x for x in seen if x.ndim == 1 and x.dtype != object], dtype=float)
    assert len(single) >= 3
    assert box.violation(single) == 0.0
    assert system.states is box
    assert "n=3, p=1" in repr(system)
