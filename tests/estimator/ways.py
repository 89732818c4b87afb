"""Ways of writing one function, and the comparison of a batched function with a plain one."""

import math

import numpy as np

LEADS = [(), (1,), (2,), (3,), (5,), (1, 2), (2, 1), (2, 2), (2, 3), (3, 2), (4, 5)]
NONE = np.zeros(0)


def check_values(function, plain, n, m=0):
    """The value at one state and over leading dimensions, against plain(x, u) state by state."""
    generator = np.random.default_rng(1)
    for lead in LEADS:
        x = generator.uniform(0.3, 2.0, (*lead, n))
        u = generator.uniform(0.3, 2.0, (*lead, m))
        expected = np.array(
            [plain(xi, ui) for xi, ui in zip(x.reshape(-1, n), u.reshape(-1, m), strict=True)]
            if m
            else [plain(xi, NONE) for xi in x.reshape(-1, n)]
        ).reshape(*lead, -1)
        found = np.asarray(function.batch(x, u)) if lead else np.asarray(function(x, u))
        assert found.shape == expected.shape, lead
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14, err_msg=str(lead))


def pendulum(x, u):
    return np.array([x[0] + 0.1 * x[1], 0.9 * x[1] - 0.2 * math.sin(x[0])])


def write_pendulum_branching(x):
    push = -0.2 * np.sin(x[0])
    if x[0] < -100.0:
        push = 0.0
    return np.array([x[0] + 0.1 * x[1], 0.9 * x[1] + push])


def write_pendulum_into_zeros(x):
    value = np.zeros(2)
    value[0] = x[0] + 0.1 * x[1]
    value[1] = 0.9 * x[1] - 0.2 * np.sin(x[0])
    return value


def write_pendulum_ellipsis(x):
    value = np.empty_like(x)
    value[..., 0] = x[..., 0] + 0.1 * x[..., 1]
    value[..., 1] = 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])
    return value


PENDULUMS = {
    "ellipsis": (write_pendulum_ellipsis, "batched"),
    "stacked": (
        lambda x: np.stack(
            [x[..., 0] + 0.1 * x[..., 1], 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])], axis=-1
        ),
        "batched",
    ),
    "array of components": (
        lambda x: np.array([x[0] + 0.1 * x[1], 0.9 * x[1] - 0.2 * np.sin(x[0])]),
        "columns",
    ),
    "list": (lambda x: [x[0] + 0.1 * x[1], 0.9 * x[1] - 0.2 * np.sin(x[0])], "columns"),
    "tuple": (lambda x: (x[0] + 0.1 * x[1], 0.9 * x[1] - 0.2 * np.sin(x[0])), "columns"),
    "math": (lambda x: np.array([x[0] + 0.1 * x[1], 0.9 * x[1] - 0.2 * math.sin(x[0])]), "looped"),
    "list of math": (lambda x: [x[0] + 0.1 * x[1], 0.9 * x[1] - 0.2 * math.sin(x[0])], "looped"),
    "branch": (write_pendulum_branching, "looped"),
    "into zeros": (write_pendulum_into_zeros, "looped"),
}
