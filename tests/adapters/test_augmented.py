"""Parameters and noisy inputs as states: runs in both engines, wrong arguments."""

import numpy as np
import pytest

import qpmhe

PLANT = qpmhe.System(lambda x, u: 0.9 * x + u[:1], lambda x: x, n=1, p=1, m=2)


def estimator(system, **options):
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.diag([1.0, 1.0, 0.01]), disturbance=np.diag([0.01, 0.01, 1e-6]), noise=0.04
    )
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.1, 0.1, 0.0]), cost, horizon=8,
        initial_state=[3.0, 0.0, 0.1], max_qps=2, **options,
    )


@pytest.mark.filterwarnings("ignore::qpmhe.ModelWarning")
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


@pytest.mark.whole
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
