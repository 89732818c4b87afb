"""Estimators as blocks of python-control, in its own simulations."""

import control
import numpy as np
import pytest

import qpmhe

A, B, C = np.array([[1.0, 0.1], [0.2, 0.95]]), np.array([[0.0], [0.1]]), np.array([[1.0, 0.0]])
FEEDBACK = np.array([[8.0, 6.0]])
START, GUESS = np.array([1.0, -0.5]), np.array([0.4, 0.2])
NOISES = 0.02 * np.random.default_rng(5).standard_normal((60, 1))


def estimator(**options):
    system = qpmhe.from_control(control.ss(A, B, C, 0, 0.1))
    covariances = {"prior": np.eye(2), "disturbance": 1e-3 * np.eye(2), "noise": 4e-4 * np.eye(1)}
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(**covariances),
        qpmhe.QuadraticCost.from_covariances(**covariances),
        horizon=8, initial_state=GUESS, **options,
    )


def closed_loop(mhe, **options):
    plant = control.ss(A, B, C, 0, 0.1, name="plant", inputs=["u[0]"], outputs=["clean"])
    noise = control.summing_junction(["clean", "v"], "y[0]", name="noise", dt=0.1)
    law = control.ss([], [], [], -FEEDBACK, 0.1, name="law", inputs=["xhat[0]", "xhat[1]"],
                     outputs=["u[0]"])
    block = qpmhe.to_iosystem(mhe, dt=0.1, **options)
    return control.interconnect(
        [plant, noise, law, block], inputs=["v"],
        outputs=["clean", "u[0]", "xhat[0]", "xhat[1]"], dt=0.1,
    )


def by_hand(mhe):
    """The same loop as a plain loop."""
    x, rows = START, []
    for v in NOISES:
        u = -FEEDBACK @ mhe.state
        rows.append([*(C @ x), *u, *mhe.state])
        mhe.update(C @ x + v, u)
        x = A @ x + B @ u
    return np.array(rows).T


def simulated(loop, guess=GUESS):
    time = 0.1 * np.arange(len(NOISES))
    return control.input_output_response(
        loop, time, NOISES.T, np.concatenate([START, guess])
    ).outputs


@pytest.mark.parametrize("engine", ["python", "auto"])
def test_a_closed_loop_is_that_of_a_plain_loop(engine):
    answer = simulated(closed_loop(estimator(engine=engine)))
    np.testing.assert_allclose(answer, by_hand(estimator(engine=engine)), rtol=1e-9, atol=1e-12)
    assert np.abs(answer[0, -10:]).max() < 0.1 * abs(answer[0, 0])


def test_a_simulation_that_starts_anew_starts_the_estimator_anew():
    loop = closed_loop(estimator())
    first = simulated(loop)
    np.testing.assert_array_equal(simulated(loop), first)
    other = simulated(loop, guess=GUESS + 0.3)
    np.testing.assert_array_equal(other[2:, 0], GUESS + 0.3)
    np.testing.assert_array_equal(simulated(loop), first)


def test_a_missing_measurement_is_nan():
    block, other = qpmhe.to_iosystem(estimator()), estimator()
    x = GUESS
    for t, y in enumerate([0.7, np.nan, 0.6]):
        x = block.dynamics(t, x, [y, 0.1])
        np.testing.assert_array_equal(x, other.update([y], [0.1]).state)


def test_an_update_that_is_called_again_is_not_another_sample():
    mhe = estimator()
    block = qpmhe.to_iosystem(mhe)
    seen = np.array([0.7, 0.1])
    once = block.dynamics(0, GUESS, seen)
    np.testing.assert_array_equal(block.dynamics(0, GUESS, seen), once)
    assert mhe.time == 1
    block.dynamics(1, once, seen)
    assert mhe.time == 2


def test_labels_and_sampling_time():
    ode = qpmhe.System.from_ode(lambda x, u: -x + u, lambda x: x, dt=0.2, n=1, p=1, m=1)
    mhe = qpmhe.MovingHorizonEstimator(
        ode, qpmhe.Luenberger([0.3]), qpmhe.QuadraticCost(prior=1, disturbance=1, noise=1),
        horizon=3, initial_state=[0.0],
    )
    block = qpmhe.to_iosystem(
        mhe, name="level", measurement_labels=["h"], control_labels="pump", estimate_labels="x{i}"
    )
    assert (block.dt, block.name) == (0.2, "level")
    assert (block.input_labels, block.output_labels) == (["h", "pump"], ["x0"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"dt": -1.0}, "dt is -1"),
        ({"measurement_labels": ["a", "b"]}, "measurement_labels is"),
        ({"estimate_labels": "x"}, "estimate_labels is 'x'; expected 2 different names"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, words):
    with pytest.raises(qpmhe.errors.OptionError, match=words):
        qpmhe.to_iosystem(estimator(), **options)


def test_other_sampling_times_and_things_are_refused():
    ode = qpmhe.System.from_ode(lambda x: -x, lambda x: x, dt=0.2, n=1, p=1)
    mhe = qpmhe.MovingHorizonEstimator(
        ode, qpmhe.Luenberger([0.3]), qpmhe.QuadraticCost(prior=1, disturbance=1, noise=1),
        horizon=3, initial_state=[0.0],
    )
    with pytest.raises(qpmhe.errors.OptionError, match=r"dt is 0\.1, but the system has 0\.2"):
        qpmhe.to_iosystem(mhe, dt=0.1)
    with pytest.raises(qpmhe.errors.InvalidInputError, match="mhe is a System"):
        qpmhe.to_iosystem(ode)
