import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import qpmhe

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


@pytest.mark.parametrize("way", PENDULUMS)
def test_every_way_of_writing_f_gives_equal_values(way):
    f, mode = PENDULUMS[way]
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    assert system.f.mode == mode
    check_values(system.f, pendulum, 2)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize(
    ("write", "mode"),
    [
        pytest.param(lambda a: lambda x: a @ x, "columns", id="A @ x"),
        pytest.param(lambda a: lambda x: np.dot(a, x), "columns", id="dot(A, x)"),
        pytest.param(lambda a: lambda x: x @ a.T, "batched", id="x @ A.T"),
        pytest.param(lambda a: lambda x: np.inner(x, a), "batched", id="inner(x, A)"),
        pytest.param(lambda a: lambda x: np.inner(a, x), "looped", id="inner(A, x)"),
        pytest.param(
            lambda a: lambda x: np.einsum("ij,...j->...i", a, x), "batched", id="einsum"
        ),
        pytest.param(lambda a: lambda x: np.linalg.solve(np.linalg.inv(a), x), None, id="solve"),
    ],
)
def test_linear_maps(n, write, mode):
    a = np.random.default_rng(n).standard_normal((n, n)) + 2.0 * np.eye(n)
    system = qpmhe.System(write(a), lambda x: x[..., :1], n=n, p=1)
    if mode is not None and n > 1:
        assert system.f.mode == mode
    check_values(system.f, lambda x, u: a @ x, n)


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(lambda a: lambda x: (a @ x.T).T, id="(A @ x.T).T"),
        pytest.param(lambda a: lambda x: np.dot(a, x.T).T, id="dot(A, x.T).T"),
        pytest.param(
            lambda a: lambda x: np.stack([row @ x.T for row in a], axis=-1), id="stacked rows"
        ),
    ],
)
def test_functions_right_on_one_leading_dimension_only(write):
    a = np.array([[1.0, 0.1], [-0.2, 0.9]])
    system = qpmhe.System(write(a), lambda x: x[..., :1], n=2, p=1)
    check_values(system.f, lambda x, u: a @ x, 2)


CONSTANTS = {
    "constant component": (lambda x: np.array([x[1], 1.5]), lambda x: [x[1], 1.5]),
    "constant first": (lambda x: [1.5, x[0]], lambda x: [1.5, x[0]]),
    "only constants": (lambda x: np.array([1.0, 2.0]), lambda x: [1.0, 2.0]),
    "added vector": (
        lambda x: np.array([x[1], -x[0]]) + np.array([1.0, 2.0]),
        lambda x: [x[1] + 1.0, -x[0] + 2.0],
    ),
    "scaled by a vector": (
        lambda x: np.array([1.0, 2.0]) * np.array([x[1], -x[0]]),
        lambda x: [x[1], -2.0 * x[0]],
    ),
    "added ones": (
        lambda x: np.array([x[1], -x[0]]) + np.ones(2), lambda x: [x[1] + 1.0, -x[0] + 1.0]
    ),
    "times a multiple of the identity": (
        lambda x: 0.5 * np.eye(2) @ x, lambda x: [0.5 * x[0], 0.5 * x[1]]
    ),
    "zeros like a component": (lambda x: np.array([x[1], 0.0 * x[0]]), lambda x: [x[1], 0.0]),
    "identity": (lambda x: x, lambda x: x),
    "integers": (lambda x: np.array([1, 2]), lambda x: [1, 2]),
}


@pytest.mark.parametrize("case", CONSTANTS)
def test_constants_within_values(case):
    f, plain = CONSTANTS[case]
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    check_values(system.f, lambda x, u: np.array(plain(x), dtype=float), 2)


@pytest.mark.parametrize(
    "f",
    [
        pytest.param(lambda x: x / np.linalg.norm(x), id="norm"),
        pytest.param(lambda x: x - np.mean(x), id="mean"),
        pytest.param(lambda x: x * np.max(x), id="max"),
        pytest.param(lambda x: np.cumsum(x), id="cumsum"),
        pytest.param(lambda x: x[::-1], id="reversed"),
        pytest.param(lambda x: np.roll(x, 1), id="roll"),
        pytest.param(lambda x: np.sort(x), id="sort"),
    ],
)
def test_functions_that_mix_what_they_should_not_on_many_states(f):
    system = qpmhe.System(f, lambda x: x[..., :1], n=3, p=1)
    check_values(system.f, lambda x, u: f(x), 3)


def test_a_function_that_reuses_its_output_array():
    buffer = np.zeros(2)

    def f(x):
        buffer[0], buffer[1] = x[1], -x[0]
        return buffer

    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    check_values(system.f, lambda x, u: np.array([x[1], -x[0]]), 2)


SCALARS = {
    "x[0]": lambda x: x[0],
    "x[..., 0]": lambda x: x[..., 0],
    "x[:1]": lambda x: x[:1],
    "x[..., :1]": lambda x: x[..., :1],
    "array": lambda x: np.array([x[0]]),
    "list": lambda x: [x[0]],
    "float": lambda x: float(x[0]),
    "math": lambda x: math.sqrt(x[0]) ** 2,
    "c @ x": lambda x: np.eye(x.shape[0])[0] @ x,
}


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("way", SCALARS)
def test_a_single_output_may_be_a_scalar(way, n):
    system = qpmhe.System(lambda x: x, SCALARS[way], n=n, p=1)
    check_values(system.h, lambda x, u: x[:1], n)


@pytest.mark.parametrize(
    ("h", "plain"),
    [
        pytest.param(np.sum, sum, id="sum"),
        pytest.param(lambda x: x @ np.array([1.0, 2.0]), lambda x: x[0] + 2 * x[1], id="x @ c"),
        pytest.param(lambda x: np.array([1.0, 2.0]) @ x, lambda x: x[0] + 2 * x[1], id="c @ x"),
        pytest.param(np.linalg.norm, lambda x: math.hypot(*x), id="norm"),
        pytest.param(lambda x: 3.0, lambda x: 3.0, id="constant"),
        pytest.param(lambda x: x[1] * x[0], lambda x: x[0] * x[1], id="product"),
    ],
)
def test_scalar_outputs_of_all_states(h, plain):
    system = qpmhe.System(lambda x: x, h, n=2, p=1)
    check_values(system.h, lambda x, u: np.array([plain(x)]), 2)


@pytest.mark.parametrize(
    "f",
    [
        pytest.param(lambda x: np.sin(x), id="sin(x)"),
        pytest.param(lambda x: np.sin(x[0]), id="sin(x[0])"),
        pytest.param(lambda x: np.sin(x[..., 0]), id="sin(x[..., 0])"),
        pytest.param(lambda x: math.sin(x[0]), id="math.sin(x[0])"),
        pytest.param(lambda x: math.sin(x.item()), id="math.sin(x.item())"),
        pytest.param(lambda x: [np.sin(x[0])], id="[sin(x[0])]"),
        pytest.param(lambda x: [math.sin(x[0])], id="[math.sin(x[0])]"),
        pytest.param(lambda x: np.array([np.sin(x[0])]), id="array"),
        pytest.param(lambda x: np.array([np.sin(x[0])]) + np.array([0.0]), id="array and offset"),
    ],
)
def test_one_state(f):
    system = qpmhe.System(f, lambda x: x, n=1, p=1)
    check_values(system.f, lambda x, u: np.array([math.sin(x[0])]), 1)


INPUT_A = np.array([[1.0, 0.1], [-0.2, 0.9]])
INPUT_B = np.array([[0.5, 0.3], [-0.4, 1.0]])


def with_input(x, u):
    return INPUT_A @ x + INPUT_B @ u + x * u


@pytest.mark.parametrize(
    ("f", "mode"),
    [
        pytest.param(lambda x, u: x @ INPUT_A.T + u @ INPUT_B.T + x * u, "batched", id="batched"),
        pytest.param(lambda x, u: INPUT_A @ x + INPUT_B @ u + x * u, "columns", id="columns"),
        pytest.param(
            lambda x, u: [
                x[0] + 0.1 * x[1] + 0.5 * u[0] + 0.3 * u[1] + x[0] * u[0],
                -0.2 * x[0] + 0.9 * x[1] - 0.4 * u[0] + u[1] + x[1] * u[1],
            ],
            "columns",
            id="list",
        ),
        pytest.param(
            lambda x, u: np.inner(INPUT_A, x) + np.inner(INPUT_B, u) + x * u, "looped", id="looped"
        ),
        pytest.param(
            lambda x, u=None: x @ INPUT_A.T + u @ INPUT_B.T + x * u, "batched", id="u=None"
        ),
        pytest.param(
            lambda *a: a[0] @ INPUT_A.T + a[1] @ INPUT_B.T + a[0] * a[1], "batched", id="*args"
        ),
    ],
)
def test_inputs(f, mode):
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1, m=2)
    assert system.f.mode == mode
    check_values(system.f, with_input, 2, 2)
    check_values(system.h, lambda x, u: x[:1], 2, 2)


@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize(
    ("f", "plain"),
    [
        pytest.param(lambda x, u: x + u[0], lambda x, u: x + u[0], id="x + u[0]"),
        pytest.param(
            lambda x, u: x + u[..., :1], lambda x, u: x + u[0], id="x + u[..., :1]"
        ),
        pytest.param(
            lambda x, u: [x[1], u[0]], lambda x, u: np.array([x[1], u[0]]), id="[x[1], u[0]]"
        ),
        pytest.param(lambda x, u: u[0] * np.ones(2), lambda x, u: u[[0, 0]], id="u alone"),
        pytest.param(
            lambda x, u: [math.sin(x[0]), u[0]],
            lambda x, u: np.array([math.sin(x[0]), u[0]]),
            id="math",
        ),
        pytest.param(lambda x: 2.0 * x, lambda x, u: 2.0 * x, id="no u"),
        pytest.param(lambda x, scale=3.0: scale * x, lambda x, u: 3.0 * x, id="scale=3.0"),
    ],
)
def test_few_and_many_inputs(f, plain, m):
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1, m=m)
    check_values(system.f, plain, 2, m)


def test_more_inputs_than_states_through_a_multiple_of_the_identity():
    system = qpmhe.System(
        lambda x, u: x + (0.5 * np.eye(3) @ u)[..., :2], lambda x: x[..., :1], n=2, p=1, m=3
    )
    check_values(system.f, lambda x, u: x + 0.5 * u[:2], 2, 3)


def test_outputs_that_depend_on_the_input():
    system = qpmhe.System(
        lambda x: 0.5 * x, lambda x, u: x[0] * u[0] + u[1], n=2, p=1, m=2
    )
    check_values(system.f, lambda x, u: 0.5 * x, 2, 2)
    check_values(system.h, lambda x, u: np.array([x[0] * u[0] + u[1]]), 2, 2)


FAR_STATE = np.array([12.0, 13.0])


@pytest.mark.parametrize(
    ("h", "plain"),
    [
        pytest.param(lambda x: np.sqrt(x - 10.0), lambda x: np.sqrt(x - 10.0), id="batched"),
        pytest.param(
            lambda x: [np.sqrt(x[0] - 10.0), x[1]],
            lambda x: [np.sqrt(x[0] - 10.0), x[1]],
            id="columns",
        ),
        pytest.param(
            lambda x: [math.sqrt(x[0] - 10.0), x[1]],
            lambda x: [math.sqrt(x[0] - 10.0), x[1]],
            id="looped",
        ),
        pytest.param(
            lambda x: np.sqrt(x - 10.0) * np.max(x),
            lambda x: np.sqrt(x - 10.0) * np.max(x),
            id="mixing",
        ),
    ],
)
def test_a_function_defined_far_away_is_tried_at_the_initial_state(h, plain):
    system = qpmhe.System(lambda x: x, h, n=2, p=2)
    assert system.h.mode == "unknown"
    system.check(FAR_STATE, NONE)
    x = np.random.default_rng(2).uniform(11.0, 15.0, (4, 2))
    np.testing.assert_allclose(
        system.h.batch(x, np.zeros((4, 0))), [plain(row) for row in x], rtol=1e-12
    )


def test_a_scalar_output_defined_far_away():
    system = qpmhe.System(lambda x: x, lambda x: math.sqrt(x[0] - 10.0), n=2, p=1)
    system.check(FAR_STATE, NONE)
    np.testing.assert_allclose(system.h(FAR_STATE, NONE), [math.sqrt(2.0)], rtol=1e-15)


def test_a_function_of_the_input_defined_far_away():
    system = qpmhe.System(
        lambda x, u: np.sqrt(x - 10.0) + u[0], lambda x: x[..., :1], n=2, p=1, m=1
    )
    system.check(FAR_STATE, np.zeros(1))
    generator = np.random.default_rng(3)
    x, u = generator.uniform(11.0, 15.0, (4, 2)), generator.standard_normal((4, 1))
    np.testing.assert_allclose(system.f.batch(x, u), np.sqrt(x - 10.0) + u, rtol=1e-12)


def test_functions_are_tried_within_the_state_bounds():
    seen = []

    def f(x):
        seen.append(np.array(x))
        return 0.5 * x

    box = qpmhe.Box([-3.0, 5.0, -np.inf], [-2.0, np.inf, -7.0])
    qpmhe.System(f, lambda x: x[..., :1], n=3, p=1, states=box)
    single = np.array([x for x in seen if x.ndim == 1])
    assert len(single) >= 3
    assert box.violation(single) == 0.0


def test_sets_and_sizes_are_kept():
    boxes = [qpmhe.Box(-np.ones(d), np.ones(d)) for d in (2, 2, 3)]
    system = qpmhe.System(
        lambda x, u: x, lambda x: np.ones(3), n=2, p=3, m=4,
        states=boxes[0], disturbances=boxes[1], noises=boxes[2],
    )
    assert (system.n, system.p, system.m) == (2, 3, 4)
    assert [system.states, system.disturbances, system.noises] == boxes
    assert "n=2, p=3, m=4" in repr(system)


# Ordinary differential equations

RATE_A = np.array([[-0.5, 2.0], [-1.0, -0.2]])


def van_der_pol(x, u):
    return np.stack(
        [x[..., 1], (1.0 - x[..., 0] ** 2) * x[..., 1] - x[..., 0] + u[..., 0]], axis=-1
    )


def van_der_pol_jacobian(x, u):
    value = np.zeros((*x.shape, 2))
    value[..., 0, 1] = 1.0
    value[..., 1, 0] = -2.0 * x[..., 0] * x[..., 1] - 1.0
    value[..., 1, 1] = 1.0 - x[..., 0] ** 2
    return value


@pytest.mark.parametrize("dt", [0.01, 0.3])
@pytest.mark.parametrize(("method", "degree"), [("euler", 1), ("rk4", 4)])
def test_linear_rates_give_the_truncated_exponential(method, degree, dt):
    step, term = np.eye(2), np.eye(2)
    for k in range(1, degree + 1):
        term = term @ (dt * RATE_A) / k
        step = step + term
    system = qpmhe.System.from_ode(
        lambda x: x @ RATE_A.T, lambda x: x[..., :1], dt=dt, n=2, p=1, method=method
    )
    check_values(system.f, lambda x, u: step @ x, 2)
    np.testing.assert_allclose(system.f_jacobian(np.ones(2), NONE), step, rtol=1e-13)


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("rk4", 4)])
def test_order_of_convergence(method, order):
    start, u, end = np.array([1.5, -0.5]), np.array([0.7]), 1.0
    exact = solve_ivp(
        lambda t, x: van_der_pol(x, u), (0.0, end), start, method="DOP853", rtol=1e-13, atol=1e-13
    ).y[:, -1]
    errors = []
    for steps in (40, 80, 160):
        system = qpmhe.System.from_ode(
            van_der_pol, lambda x: x[..., :1], dt=end / steps, n=2, p=1, m=1, method=method
        )
        x = start
        for _ in range(steps):
            x = system.f(x, u)
        errors.append(np.linalg.norm(x - exact))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, order, atol=0.12)


def test_the_default_method_is_rk4():
    systems = [
        qpmhe.System.from_ode(lambda x: -(x**3), lambda x: x, dt=0.2, n=1, p=1, **method)
        for method in ({}, {"method": "rk4"}, {"method": "euler"})
    ]
    values = [system.f(np.array([1.3]), NONE)[0] for system in systems]
    assert values[0] == values[1] != values[2]


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_given_rate_jacobians_give_the_exact_derivative_of_the_step(method):
    options = {"dt": 0.2, "n": 2, "p": 1, "m": 1, "method": method}
    computed = qpmhe.System.from_ode(van_der_pol, lambda x: x[..., :1], **options)
    given = qpmhe.System.from_ode(
        van_der_pol, lambda x: x[..., :1], rate_jacobian=van_der_pol_jacobian, **options
    )
    assert computed.derivatives["f"] == "complex step"
    assert given.derivatives["f"] == "given"
    generator = np.random.default_rng(4)
    x, u = generator.standard_normal((6, 2)), generator.standard_normal((6, 1))
    np.testing.assert_allclose(
        given.f_jacobian.batch(x, u), computed.f_jacobian.batch(x, u), rtol=1e-12, atol=1e-13
    )
    np.testing.assert_allclose(
        given.f_jacobian(x[0], u[0]), computed.f_jacobian(x[0], u[0]), rtol=1e-12, atol=1e-13
    )


RATES = {
    "batched": write_pendulum_ellipsis,
    "columns": PENDULUMS["array of components"][0],
    "list": PENDULUMS["list"][0],
    "tuple": PENDULUMS["tuple"][0],
    "math": PENDULUMS["math"][0],
    "list of math": PENDULUMS["list of math"][0],
}


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("way", RATES)
def test_every_way_of_writing_the_rate(way, method):
    dt = 0.1

    def step(x, u):
        k1 = pendulum(x, u)
        if method == "euler":
            return x + dt * k1
        k2 = pendulum(x + dt / 2 * k1, u)
        k3 = pendulum(x + dt / 2 * k2, u)
        k4 = pendulum(x + dt * k3, u)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    system = qpmhe.System.from_ode(
        RATES[way], lambda x: x[..., :1], dt=dt, n=2, p=1, method=method
    )
    check_values(system.f, step, 2)


@pytest.mark.parametrize(
    "jacobian",
    [
        pytest.param(lambda x: np.array([[-3.0 * x[0] ** 2]]), id="array"),
        pytest.param(lambda x: [[-3.0 * x[0] ** 2]], id="list"),
        pytest.param(lambda x: -3.0 * x[..., None] ** 2, id="batched"),
    ],
)
@pytest.mark.parametrize(
    "rate",
    [
        pytest.param(lambda x: -(x**3), id="vector"),
        pytest.param(lambda x: -(x[0] ** 3), id="scalar"),
        pytest.param(lambda x: -math.pow(x[0], 3), id="math"),
    ],
)
def test_rates_of_one_state_with_jacobians(rate, jacobian):
    system = qpmhe.System.from_ode(
        rate, lambda x: x[0], dt=0.1, n=1, p=1, method="euler", rate_jacobian=jacobian
    )
    check_values(system.f, lambda x, u: x - 0.1 * x**3, 1)
    x = np.array([[0.5], [1.5], [2.0]])
    np.testing.assert_allclose(
        system.f_jacobian.batch(x, np.zeros((3, 0))), 1.0 - 0.3 * x[..., None] ** 2, rtol=1e-14
    )


def test_the_input_is_held_over_the_step():
    system = qpmhe.System.from_ode(
        lambda x, u: np.stack([x[..., 1], u[..., 0]], axis=-1), lambda x: x[..., :1],
        dt=0.5, n=2, p=1, m=1,
    )
    check_values(
        system.f,
        lambda x, u: np.array([x[0] + 0.5 * x[1] + 0.125 * u[0], x[1] + 0.5 * u[0]]), 2, 1,
    )


def test_from_ode_hands_on_sets_and_output_jacobian():
    box = qpmhe.Box([0.0], [9.0])
    system = qpmhe.System.from_ode(
        lambda x: -x, lambda x: x**2, dt=0.1, n=1, p=1, h_jacobian=lambda x: 2 * x[..., None],
        states=box, disturbances=box, noises=box,
    )
    assert system.states is system.disturbances is system.noises is box
    assert system.derivatives == {"f": "complex step", "h": "given"}
