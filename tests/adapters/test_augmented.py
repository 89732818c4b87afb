"""Parameters and noisy inputs as states: sets, runs in both engines, wrong arguments."""

import numpy as np
import pytest

import qpmhe

PLANT = qpmhe.System(lambda x, u: 0.9 * x + u[:1], lambda x: x, n=1, p=1, m=2)


def test_some_all_or_none_of_the_parameters():
    x, u = np.array([2.0]), np.array([1.0, 3.0])
    some = qpmhe.augment_parameters(PLANT, nominal=[3.0])  # which the model ignores
    np.testing.assert_allclose(some.f(np.array([2.0, 3.0]), u[:1]), [2.8, 3.0])
    jacobian = some.f_jacobian(np.array([2.0, 3.0]), u[:1])
    np.testing.assert_allclose(jacobian, [[0.9, 0.0], [0.0, 1.0]])
    none = qpmhe.augment_parameters(PLANT, nominal=[3.0], estimated=[])
    assert (none.n, none.m) == (1, 1)
    np.testing.assert_array_equal(none.f(x, u[:1]), PLANT.f(x, u))
    whole = qpmhe.augment_parameters(PLANT, nominal=u, estimated=[0])
    assert (whole.n, whole.m) == (2, 0)
    np.testing.assert_allclose(whole.f(np.array([2.0, 5.0]), np.zeros(0)), [6.8, 5.0])


def test_sets_are_carried_over():
    box, w, v = qpmhe.Box([-1.0], [1.0]), qpmhe.Box([-0.1], [0.1]), qpmhe.Box([-2.0], [2.0])
    model = qpmhe.System(
        lambda x, u: u * x, lambda x: x, n=1, p=1, m=1, states=box, disturbances=w, noises=v
    )
    bounds = qpmhe.Box([0.0], [0.9])
    system = qpmhe.augment_parameters(model, nominal=[0.5], parameter_bounds=bounds)
    noisy = qpmhe.noisy_inputs(model)
    for one, lower, upper, most in (
        (system, [-1.0, 0.0], [1.0, 0.9], [0.1, 0.0]),
        (noisy, [-1.0, -np.inf], [1.0, np.inf], [0.1, np.inf]),
    ):
        assert one.states.lower.tolist() == lower
        assert one.states.upper.tolist() == upper
        assert one.disturbances.upper.tolist() == most
        assert one.noises is v


def estimator(system, **options):
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.diag([1.0, 1.0, 0.01]), disturbance=np.diag([0.01, 0.01, 1e-6]), noise=0.04
    )
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.1, 0.1, 0.0]), cost, horizon=8,
        initial_state=[3.0, 0.0, 0.1], max_qps=2, **options,
    )


def test_a_casadi_model_runs_in_the_compiled_step():
    ca = pytest.importorskip("casadi")

    def rate(x, theta):
        reaction = theta[..., 0] * x[..., 0] ** 2 - 0.64 * x[..., 1]
        return np.stack([-2.0 * reaction, reaction], axis=-1)

    x, theta = ca.SX.sym("x", 2), ca.SX.sym("theta")
    reaction = theta * x[0] ** 2 - 0.64 * x[1]
    model = qpmhe.from_casadi(
        ca.Function("f", [x, theta], [ca.vertcat(-2.0 * reaction, reaction)]),
        ca.Function("h", [x, theta], [x[0] + x[1]]), dt=0.1,
    )
    made = qpmhe.augment_parameters(model, nominal=[0.1], drifting=True)
    plain = qpmhe.augment_parameters(
        rate, lambda x, theta: x[..., 0] + x[..., 1], n=2, p=1, nominal=[0.1], dt=0.1,
        drifting=True,
    )
    ys = qpmhe.models.batch_reactor().scenario.simulate(3, 40).measurements
    expected = estimator(plain).run(ys).states
    assert abs(expected[-1, 2] - 0.1) > 1e-3
    for options in ({"engine": "compiled"}, {}):
        found = estimator(made, **options).run(ys).states
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)
    # Constant parameters are noise-free components.
    constant = qpmhe.augment_parameters(model, nominal=[0.1])
    runs = [
        estimator(constant, engine=engine, solver_tolerance=1e-12).run(ys)
        for engine in ("python", "compiled")
    ]
    np.testing.assert_allclose(runs[1].states, runs[0].states, rtol=1e-5)
    with pytest.raises(qpmhe.errors.OptionError, match=r"no CasADi form.*noisy_inputs"):
        estimator(qpmhe.noisy_inputs(model), engine="compiled")


def augmented(*functions, **options):
    return qpmhe.augment_parameters(*(functions or (PLANT,)), **{"nominal": [1.0], **options})


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: augmented(nominal=[1.0] * 3), "ShapeError", "3 values, but .* has 2 inputs"),
        (lambda: augmented(dt=0.1), "OptionError", "dt is 0.1, but f is a System"),
        (lambda: augmented(estimated=[1]), "InvalidInputError", "names parameter 1; expected"),
        (lambda: augmented(drifting=1), "OptionError", "drifting is 1; expected True or False"),
        (lambda: augmented([1.0], lambda x: x, n=1, p=1), "ModelError", "make a System with"),
        (lambda: qpmhe.noisy_inputs(lambda x: x), "ModelError", "expected a qpmhe.System"),
        (lambda: qpmhe.noisy_inputs(PLANT, [2]), "InvalidInputError", "names input 2; expected"),
        (lambda: qpmhe.noisy_inputs(PLANT, [True]), "ShapeError", r"mask of shape \(1,\)"),
        (lambda: qpmhe.noisy_inputs(PLANT, []), "InvalidInputError", "inputs is empty"),
    ],
)
def test_wrong_arguments_are_named(call, error, words):
    with pytest.raises(getattr(qpmhe.errors, error), match=words):
        call()
