"""One model in every language that a `System` can be made from, and its plain evaluation."""

from functools import cache, partial
from importlib import import_module

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from tests.estimation.plain import euler, rk4

NONE = np.zeros(0)
FUNCTIONS = ("f", "h", "f_jacobian", "h_jacobian")
# Sizes n, p, m; the last inputs can be taken for parameters.
N, P, M = 4, 2, 4
THETA = np.array([0.2, 1.3, 0.5])
STEPS = {"discrete": lambda one: lambda x, u, dt=None: one(x, u), "rk4": rk4, "euler": euler}
TIMING = {"discrete": {}, "rk4": {"dt": 0.1}, "euler": {"dt": 0.1, "method": "euler"}}


def rate(x, u, xp):
    """A pendulum on a cart: a force and three parameters are its inputs."""
    place, speed, angle, spin = (x[i] for i in range(N))
    force, drag, pull, gain = (u[i] for i in range(M))
    push = gain * force - drag * speed
    return [speed, push, spin, -pull * xp.sin(angle) / (1 + place**2 / 9) - xp.cos(angle) * push]


def output(x, u, xp):
    return [x[0] + u[3] * xp.sin(x[2]) + u[0] / 100, x[3] * x[2]]


def by_numpy(**options):
    make = qpmhe.System.from_ode if options else qpmhe.System
    return make(numpy_rate, numpy_output, n=N, p=P, m=M, **options)


def numpy_rate(x, u):
    return np.array(rate(x, u, np))


def numpy_output(x, u):
    return np.array(output(x, u, np))


def by_casadi(compiled=True, **options):
    ca = pytest.importorskip("casadi")
    if compiled and find_compiler() is None:
        pytest.skip("no compiler")
    x, u = ca.SX.sym("x", N), ca.SX.sym("u", M)
    f, h = (
        ca.Function(name, [x, u], [ca.vertcat(*entries(x, u, ca))])
        for name, entries in (("f", rate), ("h", output))
    )
    return qpmhe.from_casadi(f, h, compiled=compiled, **options)


def jax_rate(x, u):
    return rate(x, u, import_module("jax.numpy"))


def jax_output(x, u):
    return output(x, u, import_module("jax.numpy"))


def by_jax(**options):
    pytest.importorskip("jax")
    return qpmhe.from_jax(jax_rate, jax_output, n=N, p=P, m=M, **options)


def by_sympy(**options):
    sympy = pytest.importorskip("sympy")
    x, u = sympy.symbols(f"x:{N}"), sympy.symbols(f"u:{M}")
    return qpmhe.from_sympy(rate(x, u, sympy), output(x, u, sympy), x, u, **options)


def by_control(**options):
    control = pytest.importorskip("control")
    system = control.nlsys(
        lambda t, x, u, params: numpy_rate(x, u), lambda t, x, u, params: numpy_output(x, u),
        inputs=M, outputs=P, states=N, dt=0 if options else True,
    )
    return qpmhe.from_control(system, **options)


LANGUAGES = {
    "numpy": by_numpy, "casadi": by_casadi, "interpreted": partial(by_casadi, compiled=False),
    "jax": by_jax, "sympy": by_sympy, "control": by_control,
}


@cache
def made(language, way):
    return LANGUAGES[language](**TIMING[way])


def points(count=6, seed=0):
    generator = np.random.default_rng(seed)
    inputs = np.column_stack((generator.uniform(-1.0, 1.0, count), np.tile(THETA, (count, 1))))
    return generator.uniform(-1.0, 1.5, (count, N)), inputs


def plain(way, x, u, dt=0.1):
    """f and h at one state."""
    return STEPS[way](numpy_rate)(x, u, dt), numpy_output(x, u)


def slopes(values, x):
    """Jacobians of some functions at one state by the complex step: exact to rounding."""
    columns = [[part.imag / 1e-30 for part in values(x + 1e-30j * unit)] for unit in np.eye(len(x))]
    return [np.stack(parts, axis=-1) for parts in zip(*columns, strict=True)]


def check(system, values, xs, us, tolerance=1e-12):
    """Values and Jacobians of f and h state by state, and of all at once."""
    allowed = {"rtol": tolerance, "atol": tolerance}
    for x, u in zip(xs, us, strict=True):
        expected = *values(x, u), *slopes(lambda z, u=u: values(z, u), x)
        for name, value in zip(FUNCTIONS, expected, strict=True):
            np.testing.assert_allclose(getattr(system, name)(x, u), value, **allowed, err_msg=name)
    check_batches(system, xs, us)


def check_batches(system, xs, us):
    for one in (getattr(system, name) for name in FUNCTIONS):
        expected = [one(x, u) for x, u in zip(xs, us, strict=True)]
        np.testing.assert_allclose(one.batch(xs, us), expected, rtol=1e-13, atol=1e-14)


def same(one, other, xs, us, tolerance=1e-12):
    """Whether two systems have the same values and Jacobians."""
    for name in FUNCTIONS:
        np.testing.assert_allclose(
            getattr(one, name).batch(xs, us), getattr(other, name).batch(xs, us), rtol=tolerance,
            atol=tolerance, err_msg=name,
        )
    check_batches(one, xs, us)
