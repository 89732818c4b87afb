"""Systems with algebraic states: steps, derivatives, start values, the estimator, bad input."""

import pickle
import warnings
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import qpmhe
from qpmhe import Box, ExtendedKalman, Luenberger, MovingHorizonEstimator, QuadraticCost, System
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import ModelError, OptionError, ShapeError
from qpmhe.model.evaluation import NAMES, Evaluator, machine
from qpmhe.model.implicit_steps import COLLOCATIONS

from .ways import evaluated_in_c

INF, NONE = np.inf, np.zeros(0)
ENGINES = ["python", pytest.param("compiled", marks=pytest.mark.skipif(
    not find_compiler(), reason="there is no C compiler"))]


# A swing model: the angle and the voltage of a bus with a load belong to each state.

def flows(x, z):
    angle, voltage = x[..., 0] - z[..., 0], z[..., 1]
    return (
        3.6 * voltage * np.sin(angle), 2.0 * voltage * np.sin(z[..., 0]),
        3.6 * voltage * np.cos(angle) + 2.0 * voltage * np.cos(z[..., 0]) - 5.3 * voltage**2,
    )


def swing(x, z, u):
    return np.stack([x[..., 1], 4.0 * (u[..., 0] - flows(x, z)[0] - 0.3 * x[..., 1])], -1)


def balance(x, z):
    generated, sent, reactive = flows(x, z)
    return np.stack([generated - sent - 0.3 * z[..., 1], reactive - 0.2], -1)


def voltage(x, z, u):
    return np.stack([z[..., 1], z[..., 0] + 0.1 * u[..., 0]], -1)


SIZES = {"n": 2, "k": 2, "p": 2, "m": 1}
X, U = np.array([0.3, 0.4]), np.array([0.8])


def swing_system(**options):
    return System.from_dae(
        swing, balance, voltage,
        **SIZES | {"dt": 0.1, "algebraic_guess": [0.0, 1.0]} | options,
    )


# A cubic equation, whose one solution is known, so that an ODE is the same model.

def force(x, z):
    return z + 0.1 * z**3 + x[..., :1] + 0.5 * x[..., 1:] - 0.2


def pulled(x, z, u):
    return np.stack([x[..., 1], z[..., 0] + u[..., 0] - np.sin(x[..., 0])], -1)


def solved_force(x):
    """Cardano's formula."""
    right = -(x[..., 0] + 0.5 * x[..., 1] - 0.2) / 0.1
    root = np.sqrt(0.25 * right**2 + 1000.0 / 27.0)
    return np.cbrt(0.5 * right + root) + np.cbrt(0.5 * right - root)


def cubic_system(**options):
    return System.from_dae(
        pulled, force, lambda x, z: x[..., :1] + 0.3 * z,
        **{"dt": 0.3, "n": 2, "k": 1, "p": 1, "m": 1, "algebraic_guess": [0.0]} | options,
    )


def reduced_system(**options):
    def rate(x, u):
        return np.stack([x[..., 1], solved_force(x) + u[..., 0] - np.sin(x[..., 0])], -1)

    return System.from_ode(
        rate, lambda x: x[..., :1] + 0.3 * solved_force(x)[..., None],
        **{"dt": 0.3, "n": 2, "p": 1, "m": 1, "method": "radau"} | options,
    )


def robertson(x, z):
    one, two, three = 0.04 * x[..., 0], 1e4 * x[..., 1] * z[..., 0], 3e7 * x[..., 1] ** 2
    return np.stack([two - one, one - two - three], -1)


def conserved(x, z):
    return x[..., :1] + x[..., 1:] + z - 1.0


def robertson_system(**options):
    return System.from_dae(
        robertson, conserved, lambda x, z: z, n=2, k=1, p=1, algebraic_guess=[0.1], **options
    )


def untraced(function):
    """The same function, called state by state: a branch on a value stops the trace."""
    def called(x, z, *u):
        assert float(x[0]) < 1e300
        return function(x, z, *u)

    return (lambda x, z: called(x, z)) if function.__code__.co_argcount == 2 else (
        lambda x, z, u: called(x, z, u)
    )


def evaluated(system, x, u=NONE):
    """F, h and their Jacobians at one state, as an estimator evaluates them."""
    model, states, inputs = system.model(), np.array([x]), np.array([u])
    f, h = model.step(states, inputs)[0], model.output(states, inputs)[0]
    return f, h, *(one[0] for one in model.linear(states, inputs))


@pytest.mark.parametrize("method", COLLOCATIONS)
def test_the_error_falls_with_the_order(method):
    def rate(t, x):
        return pulled(x, solved_force(x)[..., None], U)

    exact = solve_ivp(rate, (0.0, 2.0), X, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    counts = (4, 8, 16)
    errors = [
        np.abs(evaluated(cubic_system(dt=2.0, method=method, steps=one), X, U)[0] - exact).max()
        for one in counts
    ]
    slopes = -np.diff(np.log(errors)) / np.diff(np.log(counts))
    assert slopes.min() > COLLOCATIONS[method].order - 0.4, slopes


@pytest.mark.parametrize("method", COLLOCATIONS)
def test_the_ode_without_the_algebraic_state_has_the_same_step(method):
    """All stages solve the equations, so that both are the same method."""
    options, x = {"method": method, "steps": 2}, np.array([0.7, -0.4])
    for mine, other in zip(
        evaluated(cubic_system(**options), x, U), evaluated(reduced_system(**options), x, U),
        strict=True,
    ):
        np.testing.assert_allclose(mine, other, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(("x", "dt", "steps"), [
    ([0.9664597373, 3.0746e-05], 1.0, 4), ([0.7, 1e-5], 40.0, 2),
])
def test_robertson_as_a_dae(x, dt, steps):
    """Against SciPy's Radau at 1e-12, per component."""
    def rate(t, x):
        return robertson(x, 1.0 - x[..., :1] - x[..., 1:])

    expected = solve_ivp(
        rate, (0.0, dt), x, method="Radau", rtol=1e-12, atol=1e-16, max_step=dt / 100
    ).y[:, -1]
    f, h, _, _ = evaluated(robertson_system(dt=dt, steps=steps), x)
    np.testing.assert_allclose(f, expected, rtol=2e-7)
    np.testing.assert_allclose(h, [1.0 - x[0] - x[1]], rtol=1e-14)


def test_the_step_against_idas():
    ca = pytest.importorskip("casadi")
    x, z, u = ca.MX.sym("x", 2), ca.MX.sym("z", 2), ca.MX.sym("u")
    angle = x[0] - z[0]
    generated, sent = 3.6 * z[1] * ca.sin(angle), 2.0 * z[1] * ca.sin(z[0])
    reactive = 3.6 * z[1] * ca.cos(angle) + 2.0 * z[1] * ca.cos(z[0]) - 5.3 * z[1] ** 2
    integrator = ca.integrator("step", "idas", {
        "x": x, "z": z, "p": u,
        "ode": ca.vertcat(x[1], 4.0 * (u - generated - 0.3 * x[1])),
        "alg": ca.vertcat(generated - sent - 0.3 * z[1], reactive - 0.2),
    }, 0.0, 0.1, {"reltol": 1e-11, "abstol": 1e-12})
    expected = integrator(x0=X, z0=[0.0, 1.0], p=U)
    system = swing_system(steps=4)
    f = evaluated(system, X, U)[0]
    np.testing.assert_allclose(f, expected["xf"].full().ravel(), rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        system.algebraic_states(f, U), expected["zf"].full().ravel(), rtol=0, atol=1e-8
    )


def test_cells_of_a_battery_against_the_circuit_solved_by_hand():
    """Parallel cells: each has a charge and a polarisation; the currents share one voltage."""
    c = 8
    inner, pair = 1.0 + 0.1 * np.arange(c), 10.0 ** -np.linspace(0.0, 3.0, c)

    def source(x):
        return 3.0 + x[..., :c] + 0.2 * np.tanh(3.0 * x[..., :c]) - x[..., c : 2 * c]

    def rate(x, z):
        return np.concatenate((-0.01 * z[..., :c], (z[..., :c] - x[..., c:]) / pair), axis=-1)

    def circuit(x, z, u):
        drop = source(x) - inner * z[..., :c] - z[..., c:]
        total = z[..., :c].sum(axis=-1, keepdims=True) - u
        return np.concatenate((drop, total), axis=-1)

    def currents(x, u):
        voltage = ((source(x) / inner).sum() - u[0]) / (1.0 / inner).sum()
        return (source(x) - voltage) / inner, voltage

    system = System.from_dae(
        rate, circuit, lambda x, z: z[..., c:], dt=1.0, n=2 * c, k=c + 1, p=1, m=1, steps=4,
        algebraic_guess=[*np.zeros(c), 3.0],
    )
    x, u = np.concatenate((np.linspace(0.3, 0.8, c), np.zeros(c))), np.array([2.0])
    expected = solve_ivp(
        lambda t, x: rate(x, currents(x, u)[0]), (0.0, 1.0), x, method="Radau", rtol=1e-12,
        atol=1e-14,
    ).y[:, -1]
    found = system.f(x, u)
    np.testing.assert_allclose(found, expected, rtol=0, atol=3e-5)
    z = system.algebraic_states(found, u)
    np.testing.assert_allclose(z, np.append(*currents(found, u)), rtol=0, atol=1e-12)


def in_complex_numbers(functions, guess, x, u, dt):
    """x+ and y by one step of Radau IIA, all unknowns at once, and their complex-step slopes."""
    rate, algebraic, output = functions
    method, n, k = COLLOCATIONS["radau"], x.size, guess.size
    s = len(method.A)

    def residual(x, unknowns):
        W = unknowns[: s * (n + k)].reshape(s, n + k)
        z = unknowns[s * (n + k) :]
        states, others = x + W[:, :n], W[:, n:]
        us = np.tile(u, (s, 1))
        rates = np.array([rate(*one) for one in zip(states, others, us, strict=True)])
        rest = np.array([algebraic(*one) for one in zip(states, others, us, strict=True)])
        return np.concatenate((
            (W[:, :n] - dt * method.A @ rates).ravel(), rest.ravel(), algebraic(x, z, u)
        ))

    def slope(x, at):
        step = 1e-30
        return np.stack([
            residual(x, at + 1j * step * one).imag / step for one in np.eye(at.size)
        ], -1)

    at = np.concatenate((np.tile(np.concatenate((np.zeros(n), guess)), s), guess))
    for _ in range(30):
        at = at - np.linalg.solve(slope(x, at), residual(x, at).real)
    J, columns = slope(x, at), []
    for j in range(n):
        moved, there = x + 1e-30j * np.eye(n)[j], at.astype(complex)
        for _ in range(4):
            there = there - np.linalg.solve(J, residual(moved, there))
        W, z = there[: s * (n + k)].reshape(s, n + k), there[s * (n + k) :]
        columns.append((moved + method.d @ W[:, :n], output(moved, z, u)))
    first, second = zip(*columns, strict=True)
    return (
        first[0].real, second[0].real,
        np.stack([one.imag / 1e-30 for one in first], -1),
        np.stack([np.asarray(one).imag / 1e-30 for one in second], -1),
    )


def _without_input(function):
    return lambda x, z, u: function(x, z)


@pytest.mark.parametrize(("functions", "guess", "x", "u", "dt"), [
    ((swing, _without_input(balance), voltage), [0.0, 1.0], X, U, 0.1),
    ((swing, _without_input(balance), voltage), [0.0, 1.0], X, U, 2.0),
    ((_without_input(robertson), _without_input(conserved), lambda x, z, u: z), [0.1],
     [0.9, 3e-5], [0.0], 1.0),
], ids=["swing", "swing, long", "robertson"])
def test_values_and_derivatives_against_the_complex_step(functions, guess, x, u, dt):
    x, u, guess = np.array(x), np.array(u), np.array(guess)
    system = System.from_dae(
        *functions, dt=dt, n=x.size, k=guess.size, p=len(functions[2](x, guess, u)), m=1,
        algebraic_guess=guess,
    )
    expected = in_complex_numbers(functions, guess, x, u, dt)
    for mine, theirs in zip(evaluated(system, x, u), expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("kind", ["traced", "called"])
def test_start_values_and_what_was_solved_before_change_nothing(kind):
    change = untraced if kind == "called" else lambda one: one
    found = []
    for guess in ([0.0, 1.0], [0.3, 0.8], [-0.4, 1.4]):
        system = System.from_dae(
            change(swing), change(balance), change(voltage), dt=0.1, **SIZES, algebraic_guess=guess
        )
        model = system.model()
        first = np.concatenate((model.functions.f(X, U), model.functions.h(X, U)))
        for x in np.random.default_rng(0).normal(size=(5, 2)):
            model.functions.f(x, U)
        again = np.concatenate((model.functions.f(X, U), model.functions.h(X, U)))
        np.testing.assert_array_equal(first, again)
        found.append(first)
    for one in found[1:]:
        np.testing.assert_allclose(one, found[0], rtol=0, atol=1e-13)


def test_called_functions_have_the_step_of_traced_ones():
    traced = swing_system(steps=2).model()
    called = System.from_dae(
        untraced(swing), untraced(balance), untraced(voltage), dt=0.1, steps=2, **SIZES,
        algebraic_guess=[0.0, 1.0],
    )
    assert "not traced" in called.explain()
    x, u = 0.3 * np.random.default_rng(0).normal(size=(5, 2)), np.full((5, 1), 0.7)
    other = called.model()
    np.testing.assert_allclose(other.step(x, u), traced.step(x, u), rtol=0, atol=1e-13)
    np.testing.assert_allclose(other.output(x, u), traced.output(x, u), rtol=0, atol=1e-13)
    for mine, theirs in zip(other.linear(x, u), traced.linear(x, u), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-8)


def test_an_output_that_alone_is_traced_is_called_with_the_equations():
    system = System.from_dae(
        swing, untraced(balance), voltage, dt=0.1, **SIZES, algebraic_guess=[0.0, 1.0]
    )
    assert "h: not traced: it needs the algebraic equations" in system.explain()
    for mine, theirs in zip(
        evaluated(system, X, U), evaluated(swing_system(), X, U), strict=True
    ):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-8)


@pytest.mark.parametrize("engine", ENGINES)
def test_any_units_give_the_same_step(engine):
    """Of each state, each algebraic state and each equation, which are inputs here."""
    def parts(u):
        return u[..., 1:3], u[..., 3:5], u[..., 5:]

    def of_units(function, unit):
        def scaled(x, z, u):
            a, b, c = parts(u)
            return {"a": a, "c": c, "": 1.0}[unit] * function(x / a, z / b, u)

        return scaled

    system = System.from_dae(
        of_units(swing, "a"), of_units(lambda x, z, u: balance(x, z), "c"),
        of_units(voltage, ""), dt=0.1, **SIZES | {"m": 7}, algebraic_guess=[0.0, 1.0],
        states=Box(X - 0.3, X + 0.3),
    )
    generator, count = np.random.default_rng(0), 100
    x = X + 0.3 * generator.uniform(-1.0, 1.0, (count, 2))
    u = np.ones((count, 7))
    u[:, 0] = U
    other = u.copy()
    # The guess is the same number in all units.
    other[:, [1, 2, 3, 5, 6]] = 10.0 ** generator.uniform(-12.0, 12.0, (count, 5))
    a = other[:, 1:3]
    model = system.symbolic
    one = evaluated_in_c(model) if engine == "compiled" else Evaluator(machine(model, False)).one
    plain, (f, h, A, C) = (
        [one(name, *at) for name in NAMES] for at in ((x, u), (x * a, other))
    )
    found = f / a, h, A * a[:, None] / a[..., None], C * a[:, None]
    for mine, theirs in zip(found, plain, strict=True):
        assert np.isfinite(theirs).all()
        np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12 * np.abs(theirs).max())


def test_steps_of_other_lengths_and_pickles():
    system = swing_system(dt=0.5, steps=2)
    short = swing_system(dt=0.2, steps=2).model()
    np.testing.assert_array_equal(
        system.model().timed.functions.f(X, np.append(U, 0.2)), short.functions.f(X, U)
    )
    np.testing.assert_allclose(
        system.timed.f(X, np.append(U, 0.2)), short.functions.f(X, U), rtol=0, atol=1e-13
    )
    again = pickle.loads(pickle.dumps(system))
    assert (again.steps, again.method) == (2, "radau")
    np.testing.assert_array_equal(again.f(X, U), system.f(X, U))


@pytest.mark.slow
def test_auto_takes_the_fewest_substeps_that_are_accurate():
    options = {"dt": 1.0, "method": "auto", "scales": [1.0, 3e-5]}
    made = robertson_system(tolerance=1e-6, **options)
    other = robertson_system(**options | {"method": "radau", "steps": made.steps})
    x = np.array([0.7, 1e-5])
    np.testing.assert_array_equal(made.f(x), other.f(x))
    words = made.explain().split("step: ")[1].splitlines()
    assert words[0].startswith(f"radau with {made.steps} substeps, the cheapest")
    errors = {int(one.split()[1]): float(one.split()[3]) for one in words[1:]}
    assert list(errors) == [1, 2, 4, 8, 16]
    assert errors[made.steps] <= 1e-6 < errors[made.steps // 2]


def test_algebraic_states_over_leading_dimensions():
    system = swing_system()
    z = system.algebraic_states(X, U)
    assert np.abs(balance(X, z)).max() < 1e-14
    many = system.algebraic_states(np.tile(X, (3, 4, 1)), U)
    np.testing.assert_allclose(many, np.broadcast_to(z, (3, 4, 2)), rtol=0, atol=1e-15)
    z = root_system().algebraic_states([[4.0], [-1.0]], [0.0])  # x = 0 is a fold
    np.testing.assert_array_equal(z, [[2.0], [np.nan]])
    with pytest.raises(ShapeError, match=r"x has shape \(3,\)"):
        system.algebraic_states([1.0, 2.0, 3.0], U)
    with pytest.raises(qpmhe.errors.InvalidInputError, match="u is missing"):
        system.algebraic_states(X)
    with pytest.raises(qpmhe.errors.InvalidInputError, match="no algebraic states"):
        reduced_system().algebraic_states(X)


def test_parameters_go_through_the_step():
    """The damping as an unknown parameter; the step of the augmented system is the system's own."""
    def rate(x, z, u):
        return np.stack([x[..., 1], 4.0 * (u[..., 0] - flows(x, z)[0] - u[..., 1] * x[..., 1])], -1)

    made = System.from_dae(
        rate, balance, lambda x, z: z, dt=0.1, **SIZES | {"m": 2}, algebraic_guess=[0.0, 1.0]
    )
    augmented = qpmhe.augment_parameters(made, nominal=[0.3])
    assert (augmented.n, augmented.m) == (3, 1)
    assert "f: traced" in augmented.explain()
    f, h, slope, _ = evaluated(augmented, np.append(X, 0.4), U)
    expected = evaluated(made, X, np.append(U, 0.4))
    np.testing.assert_allclose(f, np.append(expected[0], 0.4), rtol=0, atol=1e-14)
    np.testing.assert_allclose(h, expected[1], rtol=0, atol=1e-14)
    moved = [evaluated(made, X, np.append(U, 0.4 + d))[0] for d in (1e-6, -1e-6)]
    np.testing.assert_allclose(slope[:2, 2], (moved[0] - moved[1]) / 2e-6, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_set_of_algebraic_states_goes_into_augmented_models(engine):
    """The load as a parameter: the set bounds z of the augmented state, soft or hard."""
    def loaded(x, z, u):
        return balance(x, z) - u[..., 1:] * np.array([0.1, 0.0])

    box = Box([-INF, 0.99], [0.14, INF]).soften(linear=30.0)
    plain, bounded = (
        System.from_dae(
            lambda x, z, u: swing(x, z, u), loaded, lambda x, z: z, dt=0.1, **SIZES | {"m": 2},
            algebraic_guess=[0.0, 1.0], **options,
        ) for options in ({}, {"algebraic_set": box})
    )
    free, held = (
        qpmhe.augment_parameters(one, nominal=[0.5], drifting=True) for one in (plain, bounded)
    )
    assert held.extensions == ("nonlinear constraints",)
    state, row = np.append(X, 0.7), held.constraints._bound[0]
    z = plain.algebraic_states(X, np.append(U, 0.7))
    np.testing.assert_allclose(row.function(state, U), [z[0] - 0.14, 0.99 - z[1]], atol=1e-13)
    moved = [row.function(state + d, U) for d in np.diag([0, 0, 1e-6])[2] * [[1], [-1]]]
    slope = row.jacobian(state, U)
    np.testing.assert_allclose(slope[:, 2], (moved[0] - moved[1]) / 2e-6, rtol=1e-6)
    covariances = {"disturbance": 1e-4 * np.eye(3), "noise": 1e-3 * np.eye(2)}
    observer = ExtendedKalman(prior=0.1 * np.eye(3), **covariances)
    cost = QuadraticCost.from_covariances(**covariances)
    options = {"horizon": 3, "initial_state": [0.3, 0.0, 0.5], "max_qps": 3}
    Y, inputs = np.tile([0.17, 0.98], (6, 1)), np.full((6, 1), 0.8)
    without, reference, found = (
        MovingHorizonEstimator(system, observer, cost, engine=name, **options).run(Y, inputs)
        for system, name in ((free, "python"), (held, "python"), (held, engine))
    )
    np.testing.assert_allclose(found.states, reference.states, rtol=0, atol=1e-9)
    assert np.abs(found.states - without.states).max() > 1e-3
    assert qpmhe.augment_noise(
        bounded, [0], correlation=0.5, deviation=0.1
    ).system.extensions == ("nonlinear constraints",)
    with pytest.raises(qpmhe.errors.InvalidInputError, match="nonlinear constraints, which an"):
        qpmhe.noisy_inputs(bounded)


def balanced(xdot, x, z, u):
    return np.concatenate((
        xdot[:1] - x[1:], 0.25 * xdot[1:] - u + flows(x, z)[0] + 0.3 * x[1:], balance(x, z)
    ))


def implicit_swing(**options):
    """The swing model with its flow as it is written down, inertia times acceleration."""
    return System.from_implicit(
        balanced, voltage, dt=0.1, **SIZES, algebraic_guess=[0.0, 1.0], **options
    )


def test_an_implicit_equation_is_the_dae_that_it_contains():
    made = implicit_swing(steps=2)
    for mine, other in zip(
        evaluated(made, X, U), evaluated(swing_system(steps=2), X, U), strict=True
    ):
        np.testing.assert_allclose(mine, other, rtol=0, atol=1e-12)
    states = made.algebraic_states(X, U)
    np.testing.assert_allclose(states[:2], swing(X, states[2:], U), rtol=0, atol=1e-13)
    assert "f: traced" in made.explain()


def of_mass(xdot, x, u):
    mass = 1.0 + 0.5 * np.sin(x[:1])
    return np.concatenate((xdot[:1] - x[1:], mass * xdot[1:] + x[:1] - u))


def position(x):
    return x[:1]


def test_an_implicit_ode_has_the_step_of_the_explicit_one():
    def rate(x, u):
        mass = 1.0 + 0.5 * np.sin(x[..., 0])
        return np.stack([x[..., 1], (u[..., 0] - x[..., 0]) / mass], -1)

    made = System.from_implicit(of_mass, position, dt=0.3, n=2, p=1, m=1)
    other = System.from_ode(rate, position, dt=0.3, n=2, p=1, m=1, method="radau")
    for mine, theirs in zip(evaluated(made, X, U), evaluated(other, X, U), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-13)
    again = pickle.loads(pickle.dumps(made))
    np.testing.assert_array_equal(again.f(X, U), made.f(X, U))
    augmented = qpmhe.augment_parameters(made, nominal=[0.3])
    np.testing.assert_allclose(augmented.f(np.append(X, U)), np.append(made.f(X, U), U), atol=1e-13)


@pytest.mark.parametrize(("residual", "k", "options", "error", "words"), [
    (of_mass, 1, {}, qpmhe.errors.InvalidInputError, "algebraic_guess is missing"),
    (lambda x: x, 0, {}, ModelError, r"cannot be called as residual\(xdot, x\)"),
    (of_mass, 0, {"rate_guess": [1.0]}, ShapeError, "rate_guess has shape"),
    (lambda xdot, x, u: x - u, 0, {}, ModelError, "equation 0 depends on no algebraic state"),
    (of_mass, 0, {"algebraic_set": Box([0.0], [1.0])}, qpmhe.errors.SetError,
     "algebraic_set has dimension 1; expected 0, the number of algebraic states"),
    (of_mass, 1, {"algebraic_guess": [0.0], "algebraic_set": [0.0, 1.0]}, qpmhe.errors.SetError,
     r"algebraic_set is \[0.0, 1.0\]; expected a qpmhe.Box"),
])
def test_bad_implicit_equations(residual, k, options, error, words):
    with pytest.raises(error, match=words):
        System.from_implicit(residual, position, dt=0.3, n=2, p=1, m=1, k=k, **options)


# The estimator.


def weights(n, p, filtered=False):
    covariances = {
        "prior": 0.1 * np.eye(n), "disturbance": 0.01 * np.eye(n), "noise": 0.01 * np.eye(p)
    }
    if not filtered:
        return Luenberger(0.3 * np.eye(n, p)), QuadraticCost.from_covariances(**covariances)
    del covariances["prior"]
    return ExtendedKalman(prior=0.1 * np.eye(n), **covariances), (
        QuadraticCost.from_covariances(**covariances)
    )


@cache
def record(samples=25):
    model, generator, x, found = reduced_system().model(), np.random.default_rng(1), X, []
    U = 0.2 * generator.normal(size=(samples, 1))
    for u in U:
        found.append(model.functions.h(x, u) + 0.1 * generator.normal(size=1))
        x = model.functions.f(x, u) + 0.05 * generator.normal(size=2)
    return np.array(found), U


@pytest.mark.parametrize("engine", ENGINES)
def test_estimates_equal_those_of_the_ode_without_the_algebraic_state(engine):
    Y, U = record()
    observer, cost = weights(2, 1, True)
    options = {
        "horizon": 5, "max_qps": None, "initial_state": [0.0, 0.0],
        "states": Box([-2.0, -3.0], [2.0, 3.0]),
    }
    states = options.pop("states")
    mine, other = (
        MovingHorizonEstimator(make(states=states), observer, cost, engine=one, **options).run(Y, U)
        for make, one in ((cubic_system, engine), (reduced_system, "python"))
    )
    np.testing.assert_allclose(mine.states, other.states, rtol=0, atol=1e-8)
    np.testing.assert_allclose(mine.costs, other.costs, rtol=1e-8)
    assert (mine.costs <= mine.candidate_costs + 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("soft", [False, True])
def test_a_set_of_algebraic_states_is_a_constraint_of_the_solution(soft, engine):
    """Against the ODE without the algebraic state, with the same inequality written out."""
    Y, U = record()
    penalty = {"linear": 20.0, "quadratic": 5.0}
    box = Box([-INF], [0.15])
    constraint = qpmhe.Constraint(
        lambda x, u: solved_force(x) - 0.15 + 0.0 * u[..., 0], **(penalty if soft else {})
    )
    mine = cubic_system(algebraic_set=box.soften(**penalty) if soft else box)
    other = reduced_system(constraints=[constraint])
    observer, cost = weights(2, 1)
    options = {"horizon": 4, "initial_state": [0.5, 0.0], "max_qps": 3}
    free, one, two = (
        MovingHorizonEstimator(made, observer, cost, engine=name, **options).run(Y[:10], U[:10])
        for made, name in ((cubic_system(), "python"), (mine, engine), (other, "python"))
    )
    np.testing.assert_allclose(one.states, two.states, rtol=0, atol=1e-9)
    assert np.abs(one.states - free.states).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("held", [
    Box([-INF, 0.99], [0.14, INF]).soften(linear=30.0, quadratic=2.0),
    qpmhe.Polytope([[1.0, 0.5], [0.2, -1.0]], [0.64, -0.97]),
    Box([-INF, 0.97], [INF, 1.1]) & qpmhe.Polytope([[1.0, 0.5]], [0.64]),
], ids=["soft box", "polytope", "both"])
def test_a_set_of_the_algebraic_states_of_an_implicit_equation(held, engine):
    """As of the DAE that it contains; the rates are free."""
    generator = np.random.default_rng(5)
    U = 0.8 + 0.3 * generator.normal(size=(8, 1))
    Y = np.array([0.95, 0.25]) + 0.1 * generator.normal(size=(8, 2))
    observer, cost = weights(2, 2)
    made = implicit_swing(algebraic_set=held)
    rows, other = (one.constraints._bound[0] for one in (made, swing_system(algebraic_set=held)))
    for name in ("function", "jacobian"):
        np.testing.assert_allclose(
            getattr(rows, name)(X, U[0]), getattr(other, name)(X, U[0]), rtol=0, atol=1e-12
        )
    options = {"horizon": 4, "initial_state": [0.3, 0.0], "max_qps": 3}
    found, expected, free = (
        MovingHorizonEstimator(one, observer, cost, engine=name, **options).run(Y, U)
        for one, name in (
            (pickle.loads(pickle.dumps(made)) if engine == "python" else made, engine),
            (swing_system(algebraic_set=held), "python"), (swing_system(), "python"),
        )
    )
    np.testing.assert_allclose(found.states, expected.states, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.costs, expected.costs, rtol=1e-9)
    assert np.abs(found.states - free.states).max() > 1e-3  # the set acts


def test_a_set_of_algebraic_states_of_another_size_is_refused():
    with pytest.raises(qpmhe.errors.SetError, match="algebraic_set has dimension 2; expected 1"):
        cubic_system(algebraic_set=Box([0.0, 0.0], [1.0, 1.0]))


def test_rows_of_algebraic_states_have_exact_derivatives():
    """z + z^3 / 10 = -(x0 + x1 / 2) + 0.2: dz / dx = -(1, 1/2) / (1 + 3 z^2 / 10)."""
    made = cubic_system(algebraic_set=Box([-0.4], [0.15]))
    slopes = made.constraints._bound[0].jacobian(X, U)
    expected = -np.array([1.0, 0.5]) / (1.0 + 0.3 * solved_force(X) ** 2)
    np.testing.assert_allclose(slopes, [expected, -expected], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.skipif(not find_compiler(), reason="there is no C compiler")
@pytest.mark.parametrize("inputs", [False, True])
def test_engines_agree_on_sets_of_algebraic_states(inputs):
    """Rows of several z; without inputs rows of the newest state, beside another constraint."""
    generator = np.random.default_rng(5)
    U = 0.8 + 0.3 * generator.normal(size=(15, 1))
    matrix, limit = np.array([[1.0, 0.5], [-1.0, -0.5], [0.2, -1.0]]), [0.66, -0.55, -0.97]
    held = qpmhe.Polytope(matrix, limit)
    kept = qpmhe.Constraint(lambda x, w: x[0] ** 2 + w[0] - 0.16)
    if inputs:
        made = swing_system(algebraic_set=held, constraints=[kept])
    else:
        made = System.from_dae(
            lambda x, z: swing(x, z, np.array([0.8])), balance, lambda x, z: z[..., ::-1],
            dt=0.1, n=2, k=2, p=2, algebraic_guess=[0.0, 1.0], algebraic_set=held,
            constraints=[kept],
        )
    Y = np.array([0.95, 0.15]) + 0.1 * generator.normal(size=(15, 2))
    observer, cost = weights(2, 2)
    python, compiled = (
        MovingHorizonEstimator(
            made, observer, cost, horizon=4, initial_state=[0.3, 0.0], max_qps=3, engine=engine
        ).run(Y, U if inputs else None) for engine in ("python", "compiled")
    )
    np.testing.assert_allclose(compiled.states, python.states, rtol=0, atol=1e-9)
    np.testing.assert_allclose(compiled.costs, python.costs, rtol=1e-9)
    rows = made.algebraic_states(python.filtered, U if inputs else None) @ matrix.T
    assert np.isclose(rows, limit, rtol=0, atol=1e-6).any()  # the set acts


@pytest.mark.parametrize("engine", ENGINES)
def test_snapshots_continue_bit_by_bit(engine):
    Y, U = record()
    observer, cost = weights(2, 1)
    one, other = (
        MovingHorizonEstimator(
            cubic_system(), observer, cost, horizon=4, initial_state=start, engine=engine
        ) for start in ([0.0, 0.0], [1.0, -1.0])
    )
    for y, u in zip(Y[:12], U, strict=False):
        one.update(y, u)
    other.load_state_dict(one.state_dict())
    for y, u in zip(Y[12:], U[12:], strict=True):
        np.testing.assert_array_equal(one.update(y, u).state, other.update(y, u).state)


def root_system():
    def rate(x, z):
        return -z - 0.1 * x

    return System.from_dae(
        rate, lambda x, z, u: z * z - x + u, lambda x, z: x + z,
        dt=0.1, n=1, k=1, p=1, m=1, algebraic_guess=[1.0],
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_equations_without_a_solution_are_a_failed_stage(engine):
    """A large input takes the state beyond the fold at x = u."""
    observer, cost = weights(1, 1)
    mhe = MovingHorizonEstimator(
        root_system(), observer, cost, horizon=4, initial_state=[4.0], engine=engine
    )
    for _ in range(5):
        mhe.update([5.8], [0.0])
    failed = mhe.update([5.8], [50.0])
    assert qpmhe.Status.MODEL_FAILED in failed.status
    assert np.isfinite(failed.state).all()
    for _ in range(6):
        last = mhe.update([5.0], [0.0])
    assert qpmhe.Status.MODEL_FAILED not in last.status
    assert np.isfinite(last.state).all()


def test_batches():
    Y, U = record()
    observer, cost = weights(2, 1)
    starts = np.random.default_rng(0).normal(size=(3, 2))
    batch = qpmhe.BatchEstimator(
        cubic_system(), observer, cost, horizon=4, initial_states=starts, members=3,
        engine="python"
    )
    single = MovingHorizonEstimator(
        cubic_system(), observer, cost, horizon=4, initial_state=starts[1], engine="python"
    )
    for y, u in zip(Y[:8], U, strict=False):
        found = batch.update(np.tile(y, (3, 1)), np.tile(u, (3, 1)))
        expected = single.update(y, u).state
    np.testing.assert_allclose(found.states[1], expected, rtol=0, atol=1e-12)


def test_certificates_of_algebraic_states_rest_on_samples():
    from qpmhe.certificates import Evidence, certify_observer
    from qpmhe.certificates.reading import expression_of

    for name in ("f", "h"):
        assert "algebraic states" in expression_of(cubic_system(), name).reason
    system = System.from_dae(
        lambda x, z: -z, lambda x, z: z + 0.1 * z**3 - x, lambda x, z: x, dt=0.1, n=1, k=1, p=1,
        algebraic_guess=[0.0],
    )
    found = certify_observer(system, qpmhe.Luenberger([[0.1]]), qpmhe.Box([-1.0], [1.0]))
    assert found.evidence is Evidence.SAMPLED
    assert any("algebraic states" in note for note in found.notes)


# Bad input.


def made(algebraic=force, k=1, guess=(0.0,), **options):
    return System.from_dae(
        options.pop("rate", lambda x, z: x), algebraic, options.pop("h", lambda x, z: x[..., :1]),
        **{"dt": 0.1, "n": 2, "k": k, "p": 1, "algebraic_guess": list(guess)} | options,
    )


@pytest.mark.whole
@pytest.mark.parametrize(("arguments", "error", "words"), [
    ({"guess": [0.0, 1.0]}, ShapeError, r"algebraic_guess has shape \(2,\); expected \(1,\)"),
    ({"guess": [np.nan]}, qpmhe.errors.InvalidInputError, "algebraic_guess"),
    ({"method": "rk4"}, OptionError, "method is 'rk4'; expected .*radau"),
    ({"steps": 0}, OptionError, "steps is 0"),
    ({"algebraic": lambda x, z: z[..., :1] * np.ones(2)}, ModelError,
     r"algebraic returned shape \(2,\)"),
    ({"rate": lambda x, z: z}, ModelError, r"rate returned shape \(1,\)"),
    ({"rate": lambda x: x}, ModelError, r"rate\(x\) cannot be called as rate\(x, z\)"),
    ({"rate": lambda x, z, u: x}, ModelError, "Pass m if there are inputs"),
    ({"m": 1}, ModelError, "m is 1, but neither rate nor algebraic nor h takes an input"),
    ({"algebraic": 3.0}, ModelError, "algebraic is 3.0; expected a function"),
    ({"algebraic": lambda x, z: x[..., :1]}, ModelError,
     "equation 0 depends on no algebraic state.*structurally singular.*index 2"),
    ({"algebraic": lambda x, z: np.stack([z[..., 0] - x[..., 0], 2.0 * z[..., 0]], -1), "k": 2,
      "guess": [0.0, 0.0]}, ModelError, r"equation 1 depends on algebraic states \[0\] alone"),
    ({"algebraic": lambda x, z: np.stack([
        z[..., 0] - z[..., 1] - x[..., 0], 1e6 * (z[..., 1] - z[..., 0]) + x[..., 1]], -1),
      "k": 2, "guess": [0.0, 0.0]}, ModelError, "singular at all points.*equation . depends"),
    ({"algebraic": lambda x, z: z**2 - x[..., :1]}, ModelError,
     r"singular at algebraic_guess = \[0.0\].*a fold"),
])
def test_bad_input_fails_at_construction(arguments, error, words):
    with pytest.raises(error, match="(?s)" + words):
        made(**arguments)


@pytest.mark.parametrize(("algebraic", "guess", "words"), [
    (lambda x, z: z**2 + 1.0 + x[..., :1] ** 2, [1.0],
     "no solution at x = .*equation 0 has the largest residual"),
    (lambda x, z: np.stack([z[..., 0] - 1.0, np.exp(z[..., 1]) + z[..., 0]], -1), [1.0, 0.0],
     "equation 1 has the largest residual"),
    (lambda x, z: np.sqrt(z - 5.0) - 1.0, [1.0], "no finite value.*equation 0 is nan"),
])
def test_an_initial_state_without_algebraic_states_is_an_error(algebraic, guess, words):
    with np.errstate(all="ignore"):
        system = made(algebraic, len(guess), guess)
    observer, cost = weights(2, 1)
    with pytest.raises(ModelError, match="(?s)" + words), np.errstate(all="ignore"):
        MovingHorizonEstimator(system, observer, cost, horizon=3, initial_state=[0.5, 0.2])


@pytest.mark.parametrize("guess", [1.0, -3e-5])
def test_a_solution_that_is_zero_is_found_from_another_guess(guess):
    """A current at rest: nothing else in its equation has a size."""
    system = System.from_dae(
        lambda x, z: z, lambda x, z: z + z**3 + 2.0 * x, lambda x, z: z, dt=0.1, n=1, k=1, p=1,
        algebraic_guess=[guess],
    )
    assert system.algebraic_states([0.0]) == 0.0
    assert system.f(np.zeros(1)) == pytest.approx(0.0, abs=1e-15 * abs(guess))


@pytest.mark.parametrize(("guess", "deviation", "found"), [
    (0.0, 10.0, True), (0.0, 2.0, False), (-10.0, 10.0, False),
])
def test_an_estimator_says_where_the_guess_leads_to_another_branch(guess, deviation, found):
    """Roots of z at x, x + 10 and x + 20: the guess 0 leads to the first, or to the last."""
    def cubic(x, z):
        away = z - x
        return away * (away - 10.0) * (away - 20.0)

    system = System.from_dae(
        lambda x, z: -z, cubic, lambda x, z: z, dt=0.1, n=1, k=1, p=1, algebraic_guess=[guess]
    )
    assert system.algebraic_states([0.0]) == pytest.approx(0.0, abs=1e-12)
    terms = {"disturbance": [[1.0]], "noise": [[1.0]]}
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        MovingHorizonEstimator(
            system, ExtendedKalman(prior=[[deviation**2]], **terms),
            QuadraticCost.from_covariances(**terms), horizon=3, initial_state=[0.0],
        )
    texts = [str(one.message) for one in seen if "two branches" in str(one.message)]
    assert len(texts) == found
    assert not found or "at x = [-10.], a point of the prior" in texts[0]


@pytest.mark.parametrize(("deviation", "found"), [(0.5, False), (2.0, True)])
def test_an_estimator_says_where_the_prior_reaches_beyond_a_fold(deviation, found):
    """z^2 = x has no solution at x = -1, which is within the prior of 1 by 2 alone."""
    system = System.from_dae(
        lambda x, z: -0.1 * x, lambda x, z: z**2 - x, lambda x, z: z, dt=0.1, n=1, k=1, p=1,
        algebraic_guess=[1.0],
    )
    cost = QuadraticCost(
        prior=[[deviation**-2]], disturbance=[[1.0]], noise=[[1.0]])
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        MovingHorizonEstimator(
            system, qpmhe.Luenberger([[0.1]]), cost, horizon=3, initial_state=[1.0])
    texts = [str(one.message) for one in seen if "the prior" in str(one.message)]
    assert len(texts) == found
    assert not found or (
        "no solution at x = [-1.0]" in texts[0] and "equation 0" in texts[0])


@pytest.mark.parametrize("make", [
    lambda **o: qpmhe.System.from_ode(lambda x: -x, lambda x: x, dt=0.1, n=1, p=1, **o),
    lambda **o: qpmhe.System.from_implicit(lambda d, x: d + x, lambda x: x, dt=0.1, n=1, p=1, **o),
    lambda **o: qpmhe.System.from_dae(
        lambda x, z: z - x, lambda x, z: z - 0.5 * x, lambda x, z: x, dt=0.1, n=1, k=1, p=1,
        algebraic_guess=[0.0], **o,
    ),
])
def test_an_option_that_does_not_exist_is_refused(make):
    make(states=qpmhe.Box([0.0], [1.0]))
    with pytest.raises(qpmhe.errors.OptionError, match=r"no option 'statess'.*Did you mean states"):
        make(statess=qpmhe.Box([0.0], [1.0]))


GROWING = "Newton's method finds no stages of {} with 1 substep in dt = 1 at .*{} is the farthest"


def of_ode(rate, n, method):
    return System.from_ode(rate, lambda x: x[..., :1], dt=1.0, n=n, p=1, method=method)


@pytest.mark.parametrize(("make", "words", "start"), [
    (lambda: of_ode(lambda x: np.stack([1e3 * x[..., 0]**2 + 1e6, -x[..., 1]], -1), 2, "radau"),
     GROWING.format("radau", r"the rate of x\[0\]"), [0.5, 0.2]),
    (lambda: of_ode(lambda x: np.stack([-x[..., 0], 1e3 * x[..., 1]**2 + 1e6], -1), 2, "midpoint"),
     GROWING.format("midpoint", r"the rate of x\[1\]"), [0.5, 0.2]),
    (lambda: of_ode(lambda x: np.sqrt(x - 1.0), 1, "radau"),
     r"the rate is \[nan\] at the initial state \[0.5\]", [0.5]),
    (lambda: System.from_dae(
        lambda x, z: -1.0 + 0.0 * x, lambda x, z: z**2 - x, lambda x, z: x, dt=0.1, n=1, k=1, p=1,
        algebraic_guess=[1.0]), "algebraic equation 0 is the farthest.*a fold", [0.05]),
    (lambda: System.from_implicit(
        lambda d, x: d - 1e3 * x**2 - 1e6, lambda x: x, dt=1.0, n=1, p=1),
     "finds no stages of radau", [0.5]),
], ids=["first", "second", "rate", "fold", "implicit"])
def test_steps_without_stages_are_named_at_construction(make, words, start):
    system = make()
    cost = QuadraticCost(prior=np.eye(system.n), disturbance=np.eye(system.n), noise=[[1.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", qpmhe.ModelWarning)
        with pytest.raises(ModelError, match=words):
            MovingHorizonEstimator(
                system, qpmhe.Luenberger(np.zeros((system.n, 1))), cost, horizon=3,
                initial_state=start)


def raising(x):
    if float(x[0]) < 0.45:
        raise ZeroDivisionError("no rate there")
    return -x


@pytest.mark.parametrize(("rate", "h", "words"), [
    (lambda x: -x, lambda x: np.log(x - 3.0), r"h is \[nan\] at the initial state"),
    (raising, lambda x: x, "f raised ZeroDivisionError: no rate there"),
], ids=["output", "rate"])
def test_newtons_method_is_not_to_blame_for_other_functions(rate, h, words):
    system = System.from_ode(rate, h, dt=1.0, n=1, p=1, method="radau")
    cost = QuadraticCost(prior=[[1.0]], disturbance=[[1.0]], noise=[[1.0]])
    with np.errstate(invalid="ignore"), pytest.raises(ModelError, match=words):
        MovingHorizonEstimator(
            system, qpmhe.Luenberger([[0.0]]), cost, horizon=3, initial_state=[0.5])


def test_equations_that_raise_are_named_at_construction():
    system = qpmhe.System.from_dae(
        lambda x, z: z - x, lambda x, z: 1 / 0, lambda x, z: x, dt=0.1, n=1, k=1, p=1,
        algebraic_guess=[0.0],
    )
    terms = {"prior": [[1.0]], "disturbance": [[1.0]], "noise": [[1.0]]}
    with pytest.raises(qpmhe.errors.ModelError, match="equations raised ZeroDivisionError"):
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.ExtendedKalman(**terms), qpmhe.QuadraticCost.from_covariances(**terms),
            horizon=3, initial_state=[0.0],
        )
