import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import qpmhe

from .ways import NONE, PENDULUMS, check_values, pendulum, write_pendulum_ellipsis

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
    assert computed.f_jacobian.method == "complex step"
    assert given.f_jacobian.method == "given"
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
    assert (system.f_jacobian.method, system.h_jacobian.method) == ("complex step", "given")
