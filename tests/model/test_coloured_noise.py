"""Noise with memory as states: against the joint distribution of all measurements."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.model.signals import Signal, Signals

A = np.array([[0.95, 0.2], [-0.1, 0.9]])
C = np.array([[1.0, 0.3], [0.2, 1.0]])
P, Q, R = np.diag([2.0, 1.0]), np.diag([0.02, 0.01]), np.diag([0.05, 0.04])
RHO, SIGMA, STEPS = np.array([0.9, 0.5]), np.array([0.8, 0.3]), 30
START = np.array([1.0, -1.0])


def step(x):
    return x @ A.T


def output(x):
    return x @ C.T


def base(**options):
    return qpmhe.System(step, output, n=2, p=2, **options)


def record(missing=False):
    rng = np.random.default_rng(3)
    x, c = START + np.sqrt(P.diagonal()) * rng.standard_normal(2), SIGMA * rng.standard_normal(2)
    y = np.empty((STEPS, 2))
    for t in range(STEPS):
        y[t] = C @ x + c + np.sqrt(R.diagonal()) * rng.standard_normal(2)
        x = A @ x + np.sqrt(Q.diagonal()) * rng.standard_normal(2)
        c = RHO * c + SIGMA * np.sqrt(1.0 - RHO**2) * rng.standard_normal(2)
    if missing:
        y[rng.random(y.shape) < 0.3] = np.nan
        y[[0, 9, 10]] = np.nan
    return y


def conditional_means(y):
    """E(x(t+1) | y(0), ..., y(t)) from the joint covariance of all, without a filter or c."""
    powers = [np.linalg.matrix_power(A, t) for t in range(STEPS + 1)]
    variances = [P]
    for _ in range(STEPS):
        variances.append(A @ variances[-1] @ A.T + Q)

    def between(i, j):  # of x(i) and x(j)
        return powers[i - j] @ variances[j] if i >= j else between(j, i).T

    lags = np.abs(np.subtract.outer(np.arange(STEPS), np.arange(STEPS)))
    joint = np.array([
        [
            C @ between(i, j) @ C.T + np.diag(SIGMA**2 * RHO ** lags[i, j]) + (i == j) * R
            for j in range(STEPS)
        ] for i in range(STEPS)
    ]).swapaxes(1, 2).reshape(2 * STEPS, 2 * STEPS)
    errors = (y - np.array([C @ powers[t] @ START for t in range(STEPS)])).ravel()
    found = []
    for t in range(STEPS):
        seen = np.flatnonzero(np.isfinite(errors[: 2 * t + 2]))
        cross = np.hstack([between(t + 1, i) @ C.T for i in range(t + 1)])[:, seen]
        weights = np.linalg.solve(joint[np.ix_(seen, seen)], errors[seen])
        found.append(powers[t + 1] @ START + cross @ weights)
    return np.array(found)


def estimates(noisy, y, engine="python", max_qps=2, unit=1.0):
    given = noisy.covariances(prior=P, disturbance=Q, noise=unit**2 * R)
    weights = {name: given[name] for name in ("disturbance", "noise")}  # the observer has a prior
    return qpmhe.MovingHorizonEstimator(
        noisy.system, qpmhe.ExtendedKalman(**given),
        qpmhe.QuadraticCost.from_covariances(**weights), horizon=8,
        initial_state=noisy.initial_state(START), max_qps=max_qps, engine=engine,
    ).run(unit * y).states


@pytest.mark.parametrize(
    ("missing", "engine", "max_qps"),
    [(True, "python", 2), (True, "compiled", 2), (False, "python", 2), (True, "python", 0)],
)
def test_estimates_are_the_conditional_means(missing, engine, max_qps):
    y = record(missing)
    noisy = qpmhe.augment_noise(base(), [0, 1], correlation=RHO, deviation=SIGMA)
    found = estimates(noisy, y, engine, max_qps)[-STEPS:, :2]
    np.testing.assert_allclose(found, conditional_means(y), rtol=1e-6, atol=1e-7)


def test_noise_without_memory_is_part_of_r():
    y = record()
    noisy = qpmhe.augment_noise(base(), [0, 1], correlation=0.0, deviation=SIGMA)
    given = {"disturbance": Q, "noise": R + np.diag(SIGMA**2)}
    white = qpmhe.MovingHorizonEstimator(
        base(), qpmhe.ExtendedKalman(prior=P, **given),
        qpmhe.QuadraticCost.from_covariances(**given),
        horizon=8, initial_state=START, engine="python",
    ).run(y).states
    np.testing.assert_allclose(estimates(noisy, y)[:, :2], white, rtol=1e-6, atol=1e-8)


def test_another_unit_of_the_outputs_changes_nothing():
    y = record(missing=True)
    other = qpmhe.System(step, lambda x: 1e6 * (x @ C.T), n=2, p=2)
    found = [
        estimates(qpmhe.augment_noise(
            system, [0, 1], correlation=RHO, deviation=unit * SIGMA), y, unit=unit)[:, :2]
        for system, unit in ((base(), 1.0), (other, 1e6))
    ]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6, atol=1e-8)


def opaque(x):
    return np.array([0.9 * float(x[0]), 0.8 * float(x[1]) + 0.1 * float(x[0]) ** 2])


def opaque_jacobian(x):
    return np.array([[0.9, 0.0], [0.2 * float(x[0]), 0.8]])


def opaque_output(x):
    return float(x[0]) ** 2


def opaque_slope(x):
    return np.array([[2.0 * float(x[0]), 0.0]])


def rate(x, u):
    return np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0])], axis=-1)


def position(x, u):
    return x[..., :1]


def of_ode(method="rk4"):
    return qpmhe.System.from_ode(rate, position, n=2, p=1, m=1, dt=0.1, method=method)


def of_casadi():
    ca = pytest.importorskip("casadi")
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    f = ca.Function("f", [x, u], [ca.vertcat(x[1], u - ca.sin(x[0]))])
    return qpmhe.from_casadi(f, ca.Function("h", [x], [x]), dt=0.1, compiled=False)


def of_jax():
    jnp = pytest.importorskip("jax.numpy")
    return qpmhe.from_jax(
        lambda x, u: jnp.array([x[1], u[0] - jnp.sin(x[0])]), lambda x: x[0], n=2, p=1, m=1, dt=0.1
    )


def of_sympy():
    sympy = pytest.importorskip("sympy")
    a, b, c = sympy.symbols("a b c")
    return qpmhe.from_sympy([b, c - sympy.sin(a)], [a, a * b], [a, b], [c], dt=0.1)


def of_dae():
    return qpmhe.System.from_dae(
        lambda x, z: -x + 0.1 * z, lambda x, z: z - x[..., :1] ** 2, lambda x, z: z + x[..., 1:],
        n=2, k=1, p=1, dt=0.1, algebraic_guess=[0.1],
    )


MODELS = {
    "traced": base, "ode": of_ode, "radau": lambda: of_ode("radau"), "casadi": of_casadi,
    "given": lambda: qpmhe.System(
        opaque, opaque_output, n=2, p=1, f_jacobian=opaque_jacobian, h_jacobian=opaque_slope
    ),
    "given rate": lambda: qpmhe.System.from_ode(
        opaque, opaque_output, n=2, p=1, dt=0.1, rate_jacobian=opaque_jacobian,
        h_jacobian=opaque_slope,
    ),
    "jax": of_jax, "sympy": of_sympy, "dae": of_dae,
    "noisy inputs": lambda: qpmhe.noisy_inputs(of_ode()),
    "parameters": lambda: qpmhe.augment_parameters(of_ode(), nominal=[0.5]),
}


@pytest.mark.parametrize("model", MODELS)
def test_each_kind_of_model_keeps_its_derivatives_and_steps(model):
    plain = MODELS[model]()
    larger = qpmhe.augment_noise(plain, [0], correlation=0.6, deviation=0.5).system
    n = plain.n
    z, u = np.linspace(0.3, 0.7, n + 1), np.ones(plain.m)
    assert larger.derivatives == plain.derivatives
    assert (larger.symbolic is None) == (plain.symbolic is None)
    np.testing.assert_allclose(larger.f(z, u), [*plain.f(z[:n], u), 0.42], rtol=1e-13)
    first = np.eye(plain.p)[0]
    np.testing.assert_allclose(larger.h(z, u), plain.h(z[:n], u) + 0.7 * first, rtol=1e-13)
    slopes = np.block([
        [plain.f_jacobian(z[:n], u), np.zeros((n, 1))], [np.zeros((1, n)), np.full((1, 1), 0.6)],
    ])
    np.testing.assert_allclose(larger.f_jacobian(z, u), slopes, atol=1e-8)
    slopes = np.column_stack((plain.h_jacobian(z[:n], u), first))
    np.testing.assert_allclose(larger.h_jacobian(z, u), slopes, atol=1e-8)
    many = np.stack((z, 2.0 * z))
    np.testing.assert_allclose(
        larger.f_jacobian.batch(many, np.stack((u, u)))[0], larger.f_jacobian(z, u), atol=1e-8
    )
    assert larger.dt == plain.dt
    assert larger.has_timed == plain.has_timed
    if plain.has_timed:
        half, usual = np.append(u, 0.05), larger.timed
        found = usual.f(z, half)
        np.testing.assert_allclose(found[:n], plain.timed.f(z[:n], half), rtol=1e-13)
        assert found[n] == pytest.approx(0.7 * np.sqrt(0.6), rel=1e-3)


def test_time_constants_are_of_the_time_of_dt():
    noisy = qpmhe.augment_noise(of_ode(), [0], time_constant=2.0, deviation=0.5)
    rho = np.exp(-0.05)
    np.testing.assert_allclose(noisy.correlation, [rho])
    np.testing.assert_allclose(noisy.prior, [[0.25]])
    np.testing.assert_allclose(noisy.disturbance, [[0.25 * (1.0 - rho**2)]])
    assert noisy.system.f(np.array([0.0, 0.0, 1.0]), np.zeros(1))[2] == pytest.approx(rho)
    finer = noisy.system.discretized("rk4", 4)
    assert finer.steps == 4
    assert finer.f(np.array([0.0, 0.0, 1.0]), np.zeros(1))[2] == pytest.approx(rho)


def test_sets_angles_matrix_scales_and_signals_stay():
    system = base(
        states=qpmhe.Box([-9.0, -8.0], [9.0, 8.0]), disturbances=qpmhe.Box([-1.0], [1.0]),
        noises=qpmhe.Box([-2.0, -3.0], [2.0, 3.0]), scales=[1.0, 10.0],
        disturbance_matrix=[[1.0], [0.5]], output_residual=qpmhe.angles([1], period=360.0),
        state_residual=qpmhe.angles([1], period=360.0),
    ).with_origin(signals=Signals(
        (Signal("level", "m"), Signal("heading", "deg")), (),
        (Signal("gauge", "m"), Signal("compass", "deg")),
    ))
    noisy = qpmhe.augment_noise(system, ["compass"], correlation=0.6, deviation=5.0)
    larger = noisy.system
    assert larger.states.upper.tolist() == [9.0, 8.0, np.inf]
    assert larger.disturbances.lower.tolist() == [-1.0, -np.inf]
    assert larger.noises.upper.tolist() == [2.0, 3.0]
    assert larger.scales.tolist() == [1.0, 10.0, 5.0]
    assert larger.disturbance_matrix.tolist() == [[1.0, 0.0], [0.5, 0.0], [0.0, 1.0]]
    assert str(larger.signals.states[2]) == "noise of compass [deg]"
    assert larger.signals.outputs == system.signals.outputs
    residuals = np.array([[0.0, 350.0, 350.0, 350.0, 350.0]])
    larger.wrap(residuals, np.zeros((1, 3)), np.zeros((1, 2)))
    assert residuals.tolist() == [[0.0, -10.0, 350.0, 350.0, -10.0]]
    given = noisy.covariances(prior=np.eye(2), disturbance=[[1.0]], noise=R)
    np.testing.assert_allclose(given["disturbance"], np.diag([1.0, 16.0]))
    np.testing.assert_allclose(given["prior"], np.diag([1.0, 1.0, 25.0]))
    again = pickle.loads(pickle.dumps(larger))
    assert np.array_equal(again.f(np.arange(3.0)), larger.f(np.arange(3.0)))


def noisy(system=None, outputs=(0,), **options):
    usual = {"deviation": 0.5} if "time_constant" in options else {
        "deviation": 0.5, "correlation": 0.6
    }
    return qpmhe.augment_noise(base() if system is None else system, outputs, **usual | options)


@pytest.mark.whole
@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: noisy(outputs=[2]), "InvalidInputError", "names output 2; expected"),
        (lambda: noisy(outputs=["gps"]), "InvalidInputError", "'gps'; expected indices from 0"),
        (lambda: noisy(outputs=[]), "InvalidInputError", "at least one output"),
        (lambda: noisy(outputs=[True]), "ShapeError", r"mask of shape \(1,\)"),
        (lambda: noisy(correlation=1.0), "InvalidInputError", r"1.0; expected numbers in \[0, 1\)"),
        (lambda: noisy(correlation=-0.1), "InvalidInputError", r"-0.1; expected numbers in"),
        (lambda: noisy(correlation=np.nan), "InvalidInputError", "correlation"),
        (lambda: noisy(deviation=0.0), "InvalidInputError", "deviation is 0.0; expected numbers"),
        (lambda: noisy(deviation=1e200), "InvalidInputError", "with finite squares"),
        (lambda: noisy(deviation=1e-200), "InvalidInputError", "numbers above 0 with finite"),
        (lambda: noisy(deviation=[1.0, 2.0]), "ShapeError", r"shape \(2,\).*each of the 1"),
        (lambda: noisy(correlation=None), "OptionError", "exactly one"),
        (lambda: noisy(of_ode(), correlation=0.5, time_constant=1.0), "OptionError", "exactly"),
        (lambda: noisy(time_constant=2.0), "OptionError", "no sampling time; give correlation"),
        (lambda: noisy(of_ode(), time_constant=0.0), "InvalidInputError", "above 0, in the unit"),
        (lambda: noisy(of_ode(), time_constant=1e20), "InvalidInputError", "is constant at dt"),
        (lambda: noisy(of_ode(), correlation=0.2), "OptionError", "'rk4' .* by 0.27 at least"),
        (lambda: noisy(step), "ModelError", "expected a qpmhe.System"),
        (lambda: noisy().covariances(prior=P, disturbance=Q, noise=1.0), "ShapeError", "noise has"),
        (lambda: noisy().initial_state(np.zeros(3)), "ShapeError", "x has"),
    ],
)
def test_wrong_arguments_are_named(call, error, words):
    with pytest.raises(getattr(qpmhe.errors, error), match=words):
        call()


@pytest.mark.parametrize("method", ["euler", "midpoint"])
def test_methods_that_forget_all_take_noise_without_memory(method):
    larger = noisy(of_ode(method), correlation=0.0).system
    assert abs(larger.f(np.array([0.1, 0.2, 1.0]), np.zeros(1))[2]) < 1e-12


def test_tune_finds_its_disturbance_in_a_record():
    rng, rho, c = np.random.default_rng(0), 0.9, 0.0
    y = np.empty((300, 1))
    for t in range(300):
        y[t] = c + 0.1 * rng.standard_normal()
        c = rho * c + 0.5 * np.sqrt(1.0 - rho**2) * rng.standard_normal()
    still = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=1, p=1)
    noisy = qpmhe.augment_noise(still, [0], correlation=rho, deviation=5.0)
    given = noisy.covariances(prior=[[1.0]], disturbance=[[1e-8]], noise=[[1.0]])
    found = qpmhe.tune(
        noisy.system, [(y,)], **given, initial_state=[0.0, 0.0], horizon=2, objective="likelihood",
        structure={"disturbance": {"memory": [1]}, "noise": "diagonal"},
    )
    assert np.sqrt(found.disturbance[1, 1]) == pytest.approx(0.5 * np.sqrt(1.0 - rho**2), rel=0.2)
