"""Parameters and noisy inputs as states, in the language of every adapter."""

import pickle
from functools import cache

import numpy as np
import pytest
from estimator.plain import euler, rk4

import qpmhe

THETA = [0.7, 1.3, 0.2]
ESTIMATED = [2, 0]


def rate(x, u, theta, module=np):
    return [
        -theta[0] * x[0] + u[0] + theta[2] * x[1],
        theta[1] * module.sin(x[0]) - 0.3 * x[1],
    ]


def output(x, theta):
    return [x[0] * theta[2] + x[1]]


def numpy_model(**options):
    make = qpmhe.System.from_ode if options else qpmhe.System
    return make(numpy_rate, numpy_output, n=2, p=1, m=4, **options)


def numpy_rate(x, v):
    return np.array(rate(x, v, v[1:]))


def numpy_output(x, v):
    return output(x, v[1:])


def casadi_model(**options):
    ca = pytest.importorskip("casadi")
    x, v = ca.SX.sym("x", 2), ca.SX.sym("v", 4)
    f = ca.Function("f", [x, v], [ca.vertcat(*rate(x, v, v[1:], ca))])
    return qpmhe.from_casadi(f, ca.Function("h", [x, v], output(x, v[1:])), **options)


def interpreted_model(**options):
    ca = pytest.importorskip("casadi")
    return qpmhe.from_casadi(
        lambda x, v: rate(x, v, v[1:], ca), lambda x, v: output(x, v[1:]), n=2, m=4,
        compiled=False, **options,
    )


def jax_rate(x, v):
    import jax.numpy as jnp

    return rate(x, v, v[1:], jnp)


def jax_model(**options):
    pytest.importorskip("jax")
    return qpmhe.from_jax(jax_rate, numpy_output, n=2, p=1, m=4, **options)


def sympy_model(**options):
    sympy = pytest.importorskip("sympy")
    x, u, theta = sympy.symbols("a b"), sympy.symbols("c:1"), sympy.symbols("k:3")
    return qpmhe.from_sympy(
        rate(x, u, theta, sympy), output(x, theta), x, [*u, *theta], **options
    )


def control_model(**options):
    control = pytest.importorskip("control")
    dt = options.get("dt")
    system = control.nlsys(
        lambda t, x, v, params: np.array(rate(x, v, v[1:])),
        lambda t, x, v, params: np.array(output(x, v[1:])),
        inputs=4, outputs=1, states=2, dt=True if dt is None else 0,
    )
    return qpmhe.from_control(system, **options)


MODELS = {
    "numpy": numpy_model, "casadi": casadi_model, "interpreted": interpreted_model,
    "jax": jax_model, "sympy": sympy_model, "control": control_model,
}
WAYS = {"discrete": {}, "rk4": {"dt": 0.1}, "euler": {"dt": 0.1, "method": "euler"}}


@cache
def model_of(name, way):
    return MODELS[name](**WAYS[way])


STEPS = {
    "discrete": lambda one: lambda x, u, _: one(x, u), "rk4": rk4, "euler": euler,
}
POINTS = np.random.default_rng(0).normal(size=(6, 4))
INPUTS = np.random.default_rng(1).normal(size=(6, 1))


def plain(way, z, u, noisy=None, dt=0.1):
    """f and h of the augmented state, one state, by the definition."""
    theta = np.array(THETA, dtype=z.dtype)
    if noisy is None:
        theta[ESTIMATED] = z[2:]
    else:
        u, theta[2] = u + z[2:3], theta[2] + z[3]

    def one(x, v):
        return np.array(rate(x, v[:1], v[1:]))

    v = np.concatenate((u, theta))
    following = STEPS[way](one)(z[:2], v, dt)
    behind = z[2:] if noisy is None else np.zeros(2)
    return np.concatenate((following, behind)), np.array(output(z[:2], theta))


def slopes(way, z, u, noisy=None, dt=0.1):
    columns = [
        [part.imag / 1e-30 for part in plain(way, z + 1e-30j * unit, u, noisy, dt)]
        for unit in np.eye(4)
    ]
    return [np.stack(parts, axis=-1) for parts in zip(*columns, strict=True)]


def check(system, way, inputs, noisy=None):
    for z, u, v in zip(POINTS, INPUTS, inputs, strict=True):
        for found, expected in zip(
            (system.f(z, v), system.h(z, v), system.f_jacobian(z, v), system.h_jacobian(z, v)),
            (*plain(way, z, u, noisy), *slopes(way, z, u, noisy)), strict=True,
        ):
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
    for one in (system.f, system.h, system.f_jacobian, system.h_jacobian):
        expected = [one(z, v) for z, v in zip(POINTS, inputs, strict=True)]
        np.testing.assert_allclose(one.batch(POINTS, inputs), expected, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", MODELS)
def test_parameters_behind_the_inputs_become_states(name, way):
    model = model_of(name, way)
    system = qpmhe.augment_parameters(model, nominal=THETA, estimated=ESTIMATED)
    assert (system.n, system.p, system.m, system.dt) == (4, 1, 1, model.dt)
    assert system.derivatives == model.derivatives or name == "control"
    check(system, way, INPUTS)
    if name != "control":
        check(pickle.loads(pickle.dumps(system)), way, INPUTS)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", MODELS)
def test_noisy_inputs_become_states_without_memory(name, way):
    model = model_of(name, way)
    system = qpmhe.noisy_inputs(model, [0, 3])
    assert (system.n, system.p, system.m, system.dt) == (4, 1, 4, model.dt)
    inputs = np.column_stack((INPUTS, np.tile(THETA, (len(INPUTS), 1))))
    check(system, way, inputs, "noisy")
    if name != "control":
        check(pickle.loads(pickle.dumps(system)), way, inputs, "noisy")


@pytest.mark.parametrize("way", ["rk4", "euler"])
@pytest.mark.parametrize("name", MODELS)
def test_steps_of_other_lengths(name, way):
    model = model_of(name, way)
    parameters = qpmhe.augment_parameters(model, nominal=THETA, estimated=ESTIMATED)
    noisy = qpmhe.noisy_inputs(model, [0, 3])
    for z, u in zip(POINTS, INPUTS, strict=True):
        for system, v, kind in (
            (parameters, u, None), (noisy, np.concatenate((u, THETA)), "noisy"),
        ):
            found = system.timed.f(z, np.append(v, 0.25))
            expected = plain(way, z, u, kind, 0.25)[0]
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
            found = system.timed.f_jacobian(z, np.append(v, 0.25))
            expected = slopes(way, z, u, kind, 0.25)[0]
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", MODELS)
def test_nothing_estimated_is_the_model_at_its_nominal_parameters(name):
    model = model_of(name, "rk4")
    system = qpmhe.augment_parameters(model, nominal=THETA, estimated=[])
    assert (system.n, system.m) == (2, 1)
    v = np.concatenate((INPUTS[0], THETA))
    np.testing.assert_allclose(
        system.f(POINTS[0, :2], INPUTS[0]), model.f(POINTS[0, :2], v), rtol=1e-14
    )


@pytest.mark.parametrize("name", MODELS)
def test_a_model_whose_inputs_are_all_parameters(name):
    model = model_of(name, "discrete")
    system = qpmhe.augment_parameters(model, nominal=[0.5, *THETA], estimated=[1])
    assert (system.n, system.m) == (3, 0)
    z, v = np.array([0.4, -0.2, 0.9]), np.array([0.5, 0.9, *THETA[1:]])
    found = system.f(z, np.zeros(0))
    np.testing.assert_allclose(found, [*model.f(z[:2], v), 0.9], rtol=1e-14)
    np.testing.assert_allclose(
        system.h.batch(np.array([z, z]), np.zeros((2, 0))), [model.h(z[:2], v)] * 2, rtol=1e-14
    )


def test_a_model_that_ignores_its_parameters():
    system = qpmhe.augment_parameters(
        qpmhe.System(lambda x, u: 0.5 * x + u[:1], lambda x: x, n=1, p=1, m=2), nominal=[3.0]
    )
    np.testing.assert_array_equal(system.f(np.array([2.0, 3.0]), np.ones(1)), [2.0, 3.0])
    np.testing.assert_array_equal(
        system.f_jacobian(np.array([2.0, 3.0]), np.ones(1)), [[0.5, 0.0], [0.0, 1.0]]
    )


def test_sets_are_carried_over():
    box, w, v = qpmhe.Box([-1.0], [1.0]), qpmhe.Box([-0.1], [0.1]), qpmhe.Box([-2.0], [2.0])
    model = qpmhe.System(
        lambda x, u: u * x, lambda x: x, n=1, p=1, m=1, states=box, disturbances=w, noises=v
    )
    system = qpmhe.augment_parameters(
        model, nominal=[0.5], parameter_bounds=qpmhe.Box([0.0], [0.9])
    )
    assert system.states.lower.tolist() == [-1.0, 0.0]
    assert system.states.upper.tolist() == [1.0, 0.9]
    assert system.disturbances.upper.tolist() == [0.1, 0.0]
    assert system.noises is v
    noisy = qpmhe.noisy_inputs(model)
    assert noisy.states.upper.tolist() == [1.0, np.inf]
    assert noisy.disturbances.upper.tolist() == [0.1, np.inf]
    assert noisy.noises is v


def compiled_pair(dt):
    """The reactor with an unknown rate, from CasADi and as NumPy functions."""
    ca = pytest.importorskip("casadi")

    def numpy_rate(x, theta):
        reaction = theta[..., 0] * x[..., 0] ** 2 - 0.64 * x[..., 1]
        return np.stack([-2.0 * reaction, reaction], axis=-1)

    x, theta = ca.SX.sym("x", 2), ca.SX.sym("theta")
    reaction = theta * x[0] ** 2 - 0.64 * x[1]
    made = qpmhe.from_casadi(
        ca.Function("f", [x, theta], [ca.vertcat(-2.0 * reaction, reaction)]),
        ca.Function("h", [x, theta], [x[0] + x[1]]), dt=dt,
    )
    return (
        qpmhe.augment_parameters(made, nominal=[0.1], drifting=True),
        qpmhe.augment_parameters(
            numpy_rate, lambda x, theta: x[..., 0] + x[..., 1], n=2, p=1, nominal=[0.1],
            dt=dt, drifting=True,
        ),
        made,
    )


def estimator(system, **options):
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.diag([1.0, 1.0, 0.01]), disturbance=np.diag([0.01, 0.01, 1e-6]), noise=0.04
    )
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.1, 0.1, 0.0]), cost, horizon=8,
        initial_state=[3.0, 0.0, 0.1], max_qps=2, **options,
    )


def test_a_casadi_model_runs_in_the_compiled_step():
    made, plain_system, model = compiled_pair(0.1)
    ys = qpmhe.models.batch_reactor().scenario.simulate(3, 40).measurements
    runs = [
        estimator(made, engine="compiled").run(ys), estimator(made).run(ys),
        estimator(plain_system).run(ys),
    ]
    assert estimator(made, engine="compiled").engine == "compiled"
    for run in runs[:2]:
        np.testing.assert_allclose(run.states, runs[2].states, rtol=1e-7, atol=1e-9)
    assert abs(runs[0].states[-1, 2] - 0.1) > 1e-3
    # Constant parameters are noise-free components.
    constant = qpmhe.augment_parameters(model, nominal=[0.1])
    runs = [
        estimator(constant, engine=engine, solver_tolerance=1e-12).run(ys)
        for engine in ("python", "compiled")
    ]
    np.testing.assert_allclose(runs[1].states, runs[0].states, rtol=1e-5)
    assert (runs[1].costs <= runs[1].candidate_costs).all()
    with pytest.raises(qpmhe.errors.OptionError, match=r"no CasADi form.*noisy_inputs"):
        estimator(qpmhe.noisy_inputs(model), engine="compiled")


def test_snapshots_and_irregular_steps():
    made, plain_system, _ = compiled_pair(0.1)
    ys = qpmhe.models.batch_reactor().scenario.simulate(3, 20).measurements
    for system in (made, plain_system):
        whole, loaded = estimator(system), estimator(system)
        for t, y in enumerate(ys[:12]):
            whole.update(y, dt=0.15 if t == 9 else None)
        loaded.load_state_dict(whole.state_dict())
        for y in ys[12:]:
            one, two = whole.update(y), loaded.update(y)
            assert (one.trajectory == two.trajectory).all()
            np.testing.assert_allclose(
                one.disturbances[-1], one.trajectory[-1] - system.f(one.trajectory[-2], []),
                atol=1e-15,
            )


PLANT = qpmhe.System(lambda x, u: 0.9 * x + u[:1], lambda x: x, n=1, p=1, m=2)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"nominal": [1.0, 2.0, 3.0]}, "ShapeError", "3 values, but the system has 2 inputs"),
        ({"h": lambda x: x}, "OptionError", "h is .* but f is a System"),
        ({"n": 1}, "OptionError", "n is 1, but f is a System"),
        ({"m": 0}, "OptionError", "m is 0, but f is a System"),
        ({"dt": 0.1}, "OptionError", "dt is 0.1, but f is a System"),
        ({"method": "rk4"}, "OptionError", "method is 'rk4', but f is a System"),
        ({"states": qpmhe.Box([0.0], [1.0])}, "OptionError", "states is Box"),
        ({"estimated": [1]}, "InvalidInputError", "names parameter 1; expected indices from 0"),
        ({"drifting": 1}, "OptionError", "drifting is 1; expected True or False"),
        ({"nominal": [np.nan]}, "InvalidInputError", r"nominal\[0\] is nan"),
    ],
)
def test_wrong_arguments_with_a_system_are_named(changes, error, words):
    with pytest.raises(getattr(qpmhe.errors, error), match=words):
        qpmhe.augment_parameters(PLANT, **{"nominal": [1.0], **changes})


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ((lambda x: x,), "ModelError", "expected a qpmhe.System"),
        ((qpmhe.System(lambda x: x, lambda x: x, n=1, p=1),), "InvalidInputError", "no inputs"),
        ((PLANT, [2]), "InvalidInputError", "inputs names input 2; expected indices from 0 to 1"),
        ((PLANT, [0, 0]), "InvalidInputError", "names one input twice"),
        ((PLANT, [True]), "ShapeError", r"mask of shape \(1,\); expected \(2,\)"),
        ((PLANT, "valve"), "InvalidInputError", "'valve'; expected indices of inputs"),
        ((PLANT, []), "InvalidInputError", "inputs is empty"),
    ],
)
def test_wrong_arguments_of_noisy_inputs_are_named(arguments, error, words):
    with pytest.raises(getattr(qpmhe.errors, error), match=words):
        qpmhe.noisy_inputs(*arguments)


def test_functions_of_other_packages_are_to_be_systems_first():
    ca = pytest.importorskip("casadi")
    x, theta = ca.SX.sym("x"), ca.SX.sym("theta")
    f = ca.Function("f", [x, theta], [theta * x])
    for written in (f, [x]):
        with pytest.raises(qpmhe.errors.ModelError, match="Make a System of a model"):
            qpmhe.augment_parameters(written, lambda x, theta: x, n=1, p=1, nominal=[0.5])
