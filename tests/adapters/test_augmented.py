"""Parameters and noisy inputs as states: sets, runs in both engines, wrong arguments."""

import numpy as np
import pytest

import qpmhe


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


def test_functions_of_other_packages_must_become_systems_first():
    ca = pytest.importorskip("casadi")
    x, theta = ca.SX.sym("x"), ca.SX.sym("theta")
    f = ca.Function("f", [x, theta], [theta * x])
    for written in (f, [x]):
        with pytest.raises(qpmhe.errors.ModelError, match="make a System with"):
            qpmhe.augment_parameters(written, lambda x, theta: x, n=1, p=1, nominal=[0.5])
