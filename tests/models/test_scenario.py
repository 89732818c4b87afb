"""How a scenario simulates: truncation to sets, inputs, digital outputs, and what it refuses."""

import numpy as np
import pytest

import qpmhe
from qpmhe import models
from qpmhe.errors import InvalidInputError, ModelError, OptionError, ShapeError, WeightError


def system(m=0, f=lambda x: 0.9 * x, **sets):
    if m:
        return qpmhe.System(lambda x, u: 0.9 * x + u, lambda x: x, n=1, p=1, m=1, **sets)
    return qpmhe.System(f, lambda x: x, n=1, p=1, **sets)


def scenario(of=None, **changes):
    arguments = {
        "initial_state": [0.5], "initial_estimate": [0.2], "disturbance_covariance": [[0.04]],
        "noise_covariance": [[0.01]], "dt": 0.1, "horizon": 5, "steps": 400, "labels": ("x",),
    }
    return models.Scenario(system() if of is None else of, **(arguments | changes))


def test_feedback_sees_the_true_state_and_cannot_change_it():
    def control(t, x):
        u = -0.5 * x + 0.1 * t
        x[:] = 99.0
        return u

    X, Y, U = record = scenario(system(1), inputs=control).simulate(1, 50)
    assert np.array_equal(U, -0.5 * X[:-1] + 0.1 * np.arange(50)[:, None])
    assert X is record.states
    assert Y is record.measurements
    assert scenario().simulate(0).inputs is None


def test_angles_are_recorded_in_one_turn():
    def made(states=None, **changes):
        of = system(
            f=lambda x: x + 40.0, states=states, output_residual=qpmhe.angles([0], 360.0),
            state_residual=qpmhe.angles([0], 360.0),
        )
        changes = {"disturbance_covariance": [[4.0]], "initial_state": [200.0]} | changes
        return scenario(of, **changes)

    X, Y = made().simulate(0, 200)
    assert X[0] == -160.0
    for angle in (X, Y):
        assert -180.0 <= angle.min() < -150.0 < 150.0 < angle.max() < 180.0
    assert np.abs(qpmhe.angles([0], 360.0)(X[1:], X[:-1]) - 40.0).max() < 10.0
    # Where X bounds the angle, in the turn about its bounds.
    bounds = qpmhe.Box([10.0], [350.0])
    X, _ = made(bounds, initial_state=[-160.0], initial_estimate=[-300.0]).simulate(0, 3)
    assert X[0] == 200.0
    assert (np.diff(X[:, 0]) > 30.0).all()
    with pytest.raises(InvalidInputError, match="outside of the state set"):
        made(bounds, initial_estimate=[5.0])


def test_noise_is_truncated_to_its_sets():
    of = system(disturbances=qpmhe.Box([-0.2], [0.1]), noises=qpmhe.Box([-0.05], [0.1]))
    X, Y = scenario(of, steps=4000).simulate(0)
    w, v = X[1:] - 0.9 * X[:-1], Y - X[:-1]
    assert -0.2 - 1e-12 <= w.min() < -0.19 < 0.09 < w.max() <= 0.1 + 1e-12
    assert -0.05 - 1e-12 <= v.min() < -0.04 < 0.09 < v.max() <= 0.1 + 1e-12
    # Means of normal distributions truncated at -1 and 1/2, and at -1/2 and 1, deviations;
    # the divisor is sqrt(2 pi) times the probability of [-1, 1/2].
    mean = (np.exp(-0.5) - np.exp(-0.125)) / 1.33572
    assert w.mean() == pytest.approx(0.2 * mean, abs=0.01)
    assert v.mean() == pytest.approx(-0.1 * mean, abs=0.005)


def test_components_without_disturbance_and_digital_outputs():
    of = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x, n=2, p=2,
        disturbances=qpmhe.Box([0.0, -np.inf], [0.0, np.inf]),
    )
    X, Y = scenario(
        of, initial_state=[1.0, 1.0], initial_estimate=[0.0, 0.0], labels=("a", "b"),
        disturbance_covariance=0.1 * np.eye(2), noise_covariance=0.01 * np.eye(2),
        resolution=[0.0, 0.25],
    ).simulate(0)
    np.testing.assert_allclose(X[:, 0], 0.9 ** np.arange(401), rtol=1e-12)
    noise = Y - X[:-1]
    assert np.array_equal(Y[:, 1] % 0.25, np.zeros(400))
    assert 0.12 < np.abs(noise[:, 1]).max() <= 0.125
    assert noise.var(axis=0) == pytest.approx([0.01, 0.25**2 / 12], rel=0.25)


OPTIONS = [
    ({"initial_state": [1.0, 2.0]}, ShapeError, "initial_state has shape"),
    ({"disturbance_covariance": [[-1.0]]}, WeightError, "disturbance covariance"),
    ({"dt": 0.0}, OptionError, "dt is 0"),
    ({"labels": ("a", "b")}, OptionError, "labels is .* expected 1 names"),
    ({"settling_time": np.nan}, OptionError, "settling_time is nan"),
    ({"inputs": lambda t, x: x}, OptionError, "the system has 0 inputs"),
    ({"of": system(1)}, OptionError, "inputs is None, and the system has 1 inputs"),
    ({"resolution": [-0.1]}, OptionError, "resolution is"),
    ({"region": qpmhe.Box([0.0] * 2, [1.0] * 2)}, OptionError, "region .* a set of dimension 1"),
    ({"of": system(states=qpmhe.Box([0.0], [0.4]))}, InvalidInputError, "initial_state .* outside"),
    ({"seed": 0.5}, OptionError, r"seed is 0\.5; expected an integer >= 0"),
    ({"length": True}, OptionError, "steps is True; expected an integer >= 0"),
    ({"of": system(1), "inputs": lambda t, x: [0.0, 1.0]}, ShapeError,
     r"inputs\(t, x\) has shape \(2,\); expected \(1,\)"),
    ({"of": system(1), "inputs": lambda t, x: [np.nan]}, InvalidInputError,
     r"inputs\(t, x\) is \[nan\]"),
    ({"of": system(noises=qpmhe.Box([5.0], [6.0]))}, ModelError, "no noise of sample 0 lies in"),
    ({"of": system(f=lambda x: x + 1.0, states=qpmhe.Box([0.0], [3.0])),
      "disturbance_covariance": [[1e-6]]}, ModelError, "stay inside the sets at sample 2"),
    ({"of": system(f=lambda x: 1e200 * x)}, ModelError, r"disturbance it is \[inf\]"),
]  # fmt: skip


@pytest.mark.whole
@pytest.mark.parametrize(("changes", "error", "words"), OPTIONS)
def test_what_cannot_be_simulated_is_refused(changes, error, words):
    changes = dict(changes)
    seed, length = changes.pop("seed", 0), changes.pop("length", None)
    with pytest.raises(error, match=words), np.errstate(over="ignore"):
        scenario(**changes).simulate(seed, length)
