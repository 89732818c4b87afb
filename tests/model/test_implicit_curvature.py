"""Second derivatives of implicit steps, against CasADi's of the same stages."""

import numpy as np
import pytest

from qpmhe import System
from qpmhe.model.implicit_steps import COLLOCATIONS

ca = pytest.importorskip("casadi")


def swing(x, z, u, lib):
    """Rates, residuals and outputs; the voltage and angle of a bus balance the flows."""
    angle, voltage = x[0] - z[0], z[1]
    generated, sent = 3.6 * voltage * lib.sin(angle), 2.0 * voltage * lib.sin(z[0])
    reactive = 3.6 * voltage * lib.cos(angle) + 2.0 * voltage * lib.cos(z[0]) - 5.3 * voltage**2
    return (
        [x[1], 4.0 * (u[0] * (1.0 + 0.1 * x[1]) - generated - 0.3 * x[1])],
        [generated - sent - 0.3 * z[1] - 0.1 * u[0], reactive - 0.2],
        [z[1] * u[0], z[0] * x[1] + x[0] ** 2],
    )


def robertson(x, z, u, lib):
    one, two, three = 0.04 * x[0], 1e4 * x[1] * z[0], 3e7 * x[1] ** 2
    return [two - one + 0.0 * u[0], one - two - three], [x[0] + x[1] + z[0] - 1.0], [x[1] * z[0]]


def oscillator(x, z, u, lib):
    return [x[1], 50.0 * (1.0 - x[0] ** 2) * x[1] - x[0] * u[0]], [], [lib.sin(x[0]) * u[0]]


MODELS = {
    "swing": (swing, [0.0, 1.0], [0.3, 0.4], [0.8], 0.1),
    "robertson": (robertson, [0.1], [0.9, 3e-5], [0.0], 1.0),
    "ode": (oscillator, [], [1.8, -0.3], [0.7], 0.1),
}


def made(equations, guess, n, p, dt, method, steps):
    def part(index, takes_z=True):
        def function(x, z, u):
            x, z, u = ([one[..., i] for i in range(one.shape[-1])] for one in (x, z, u))
            return np.stack(equations(x, z, u, np)[index], -1)

        return function if takes_z else lambda x, u: function(x, np.zeros((*x.shape[:-1], 0)), u)

    sizes = {"dt": dt, "n": n, "p": p, "m": 1, "method": method, "steps": steps}
    if guess:
        return System.from_dae(
            part(0), part(1), part(2), k=len(guess), algebraic_guess=guess, **sizes
        )
    return System.from_ode(part(0, False), part(2, False), **sizes)


def in_casadi(equations, guess, n, dt, method, steps):
    """(f, h) of x and u, by CasADi's Newton method on the stages and the outputs' equations."""
    A, d, _ = COLLOCATIONS[method]
    (s, k), h = (len(A), len(guess)), dt / steps
    x, u, W = ca.SX.sym("x", n), ca.SX.sym("u"), ca.SX.sym("W", len(A) * (n + k))
    stages = [W[i * (n + k) : (i + 1) * (n + k)] for i in range(s)]
    parts = [equations(x + one[:n], one[n:], [u], ca) for one in stages]
    rates = [ca.vertcat(*one[0]) for one in parts]
    rest = [
        ca.vertcat(stages[i][:n] - h * sum(A[i, j] * rates[j] for j in range(s)), *parts[i][1])
        for i in range(s)
    ]
    tight = {"abstol": 1e-15, "abstolStep": 1e-15, "error_on_fail": False}
    solve = ca.rootfinder(
        "stages", "fast_newton", {"x": W, "p": ca.vertcat(x, u), "g": ca.vertcat(*rest)}, tight
    )
    X, U, at = ca.MX.sym("X", n), ca.MX.sym("U"), ca.DM(guess)
    following = X
    for _ in range(steps):
        found = solve(ca.repmat(ca.vertcat(ca.DM.zeros(n), at), s), ca.vertcat(following, U))
        following += sum(d[i] * found[i * (n + k) : i * (n + k) + n] for i in range(s))
    z, own = ca.SX.sym("z", k), X[:0]
    _, residuals, outputs = equations(x, z, [u], ca)
    if k:
        own = ca.rootfinder(
            "own", "fast_newton", {"x": z, "p": ca.vertcat(x, u), "g": ca.vertcat(*residuals)},
            tight,
        )(at, ca.vertcat(X, U))
    output = ca.Function("h", [x, z, u], [ca.vertcat(*outputs)])
    return X, U, ca.vertcat(following, output(X, own, U))


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(("method", "steps"), [("radau", 2), ("midpoint", 1), ("radau", 1)])
def test_second_derivatives_against_casadi(name, method, steps):
    equations, guess, x, u, dt = MODELS[name]
    n, p = len(x), len(equations(x, guess, u, np)[2])
    system = made(equations, guess, n, p, dt, method, steps)
    second = system.model().second_derivatives
    assert second.exact
    forces = np.random.default_rng(1).normal(size=n + p)
    found = [one[0] for one in second.at(np.array([x]), np.array([u]), forces[None])]
    X, U, values = in_casadi(equations, guess, n, dt, method, steps)
    slope = ca.jacobian(ca.dot(ca.DM(forces), values), X)
    evaluate = ca.Function("expected", [X, U], [
        ca.jacobian(slope, X), ca.jacobian(slope, U), ca.jacobian(values, U)
    ])
    for mine, theirs in zip(found, evaluate(x, u), strict=True):
        expected = theirs.full()
        np.testing.assert_allclose(mine, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_other_lengths_and_a_state_without_a_step():
    """Each state of a batch has its own length; where Newton's method fails, there is no number."""
    equations, guess, x, _, dt = MODELS["swing"]
    own, other = (made(equations, guess, 2, 2, one, "radau", 1) for one in (dt, 0.3))
    forces, states = np.ones((3, 4)), np.array([x, x, [np.nan, 0.0]])
    inputs = np.array([[0.8, dt], [0.8, 0.3], [0.8, dt]])
    found = own.model().second_derivatives.at(states, inputs, forces)
    for k, system in ((0, own), (1, other)):
        expected = system.model().second_derivatives.at(
            states[k : k + 1], inputs[k : k + 1, :1], forces[:1]
        )
        for mine, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(mine[k], theirs[0], rtol=1e-12, atol=1e-14)
    assert np.isnan(found.own[2]).all()
