"""How a scenario simulates: truncation to sets, inputs, digital outputs, and what it refuses."""

import numpy as np
import pytest

import qpmhe
from qpmhe import models
from qpmhe.errors import InvalidInputError, ModelError, OptionError, ShapeError, WeightError


def system(m=0, **sets):
    if m:
        return qpmhe.System(lambda x, u: 0.9 * x + u, lambda x: x, n=1, p=1, m=1, **sets)
    return qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1, **sets)


def scenario(of=None, **changes):
    arguments = {
        "initial_state": [0.5], "initial_estimate": [0.2], "disturbance_covariance": [[0.04]],
        "noise_covariance": [[0.01]], "dt": 0.1, "horizon": 5, "steps": 400, "labels": ("x",),
    }
    return models.Scenario(system() if of is None else of, **(arguments | changes))


def residuals(of, record):
    return record.states[1:] - 0.9 * record.states[:-1], record.measurements - record.states[:-1]


def test_a_record_unpacks():
    X, Y = record = scenario().simulate(0)
    assert X is record.states
    assert Y is record.measurements
    assert record.inputs is None
    X, Y, U = scenario(system(1), inputs=lambda t, x: [0.1 * t]).simulate(0, 3)
    assert U.tolist() == [[0.0], [0.1], [0.2]]
    with pytest.raises(AttributeError):
        record.states = X


def test_feedback_sees_the_true_state_and_cannot_change_it():
    def control(t, x):
        u = -0.5 * x
        x[:] = 99.0
        return u

    X, _, U = scenario(system(1), inputs=control).simulate(1, 50)
    assert np.array_equal(U, -0.5 * X[:-1])


def test_angles_are_recorded_in_one_turn():
    def made(states=None, **changes):
        of = qpmhe.System(
            lambda x: x + 40.0, lambda x: x, n=1, p=1, states=states,
            output_residual=qpmhe.angles([0], 360.0), state_residual=qpmhe.angles([0], 360.0))
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
    record = scenario(of, steps=4000).simulate(0)
    w, v = residuals(of, record)
    assert -0.2 - 1e-12 <= w.min() < -0.19
    assert 0.09 < w.max() <= 0.1 + 1e-12
    assert -0.05 - 1e-12 <= v.min() < -0.04
    assert 0.09 < v.max() <= 0.1 + 1e-12
    # Means of normal distributions truncated at -1 and 1/2, and at -1/2 and 1, deviations.
    density = lambda s: np.exp(-0.5 * s * s)  # noqa: E731
    share = 1.33572  # sqrt(2 pi) times the probability of [-1, 1/2]
    mean = (density(1.0) - density(0.5)) / share
    assert w.mean() == pytest.approx(0.2 * mean, abs=0.01)
    assert v.mean() == pytest.approx(-0.1 * mean, abs=0.005)


def test_the_state_stays_in_its_set():
    of = system(states=qpmhe.Box([0.0], [0.6]))
    record = scenario(of).simulate(0)
    assert of.states.violation(record.states) == 0.0
    free = scenario().simulate(0)
    # Draws are the free ones up to the first that had to be repeated.
    first = int(np.argmax((free.states < 0.0) | (free.states > 0.6)))
    assert first > 0
    assert np.array_equal(free.states[:first], record.states[:first])
    assert not np.array_equal(free.states[first], record.states[first])


def test_components_without_disturbance_are_set():
    of = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x[..., :1], n=2, p=1,
        disturbances=qpmhe.Box([0.0, -np.inf], [0.0, np.inf]),
    )
    record = scenario(
        of, initial_state=[1.0, 1.0], initial_estimate=[0.0, 0.0],
        disturbance_covariance=np.eye(2), labels=("a", "b"),
    ).simulate(0, 20)
    np.testing.assert_allclose(record.states[:, 0], 0.9 ** np.arange(21), rtol=1e-12)
    assert np.abs(np.diff(record.states[:, 1])).max() > 0.5


def test_digital_outputs():
    of = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=2, p=2)
    record = scenario(
        of, initial_state=[1.0, 1.0], initial_estimate=[0.0, 0.0],
        disturbance_covariance=0.1 * np.eye(2), noise_covariance=0.01 * np.eye(2),
        labels=("a", "b"), resolution=[0.0, 0.25],
    ).simulate(0)
    noise = record.measurements - record.states[:-1]
    assert np.array_equal(record.measurements[:, 1] % 0.25, np.zeros(400))
    assert 0.12 < np.abs(noise[:, 1]).max() <= 0.125
    assert noise[:, 1].var() == pytest.approx(0.25**2 / 12, rel=0.2)
    assert noise[:, 0].var() == pytest.approx(0.01, rel=0.3)
    assert np.unique(record.measurements[:, 0]).size == 400


def test_a_state_that_cannot_stay_inside():
    of = qpmhe.System(
        lambda x: x + 1.0, lambda x: x, n=1, p=1, states=qpmhe.Box([0.0], [3.0])
    )
    with pytest.raises(ModelError, match="cannot stay inside the sets at sample 2"):
        scenario(of, disturbance_covariance=[[1e-6]]).simulate(0)
    exploding = qpmhe.System(lambda x: 1e200 * x, lambda x: x, n=1, p=1)
    with pytest.raises(ModelError, match=r"disturbance it is \[inf\]"), np.errstate(over="ignore"):
        scenario(exploding).simulate(0)


def test_noise_that_cannot_be_inside():
    of = system(noises=qpmhe.Box([5.0], [6.0]))
    with pytest.raises(ModelError, match="no noise of sample 0 lies in Box"):
        scenario(of).simulate(0)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((-1,), "seed is -1; expected an integer >= 0"),
        ((0.5,), r"seed is 0\.5"),
        ((None,), "seed is None"),
        ((0, -1), "steps is -1; expected an integer >= 0"),
        ((0, 2.0), r"steps is 2\.0"),
        ((0, True), "steps is True"),
    ],
)
def test_seeds_and_lengths_that_are_none(arguments, named):
    with pytest.raises(OptionError, match=named):
        scenario().simulate(*arguments)


def test_inputs_of_the_wrong_length():
    with pytest.raises(ShapeError, match=r"inputs\(t, x\) has shape \(2,\); expected \(1,\)"):
        scenario(system(1), inputs=lambda t, x: [0.0, 1.0]).simulate(0)
    with pytest.raises(InvalidInputError, match=r"inputs\(t, x\) is \[nan\]"):
        scenario(system(1), inputs=lambda t, x: [np.nan]).simulate(0)


@pytest.mark.parametrize(
    ("changes", "error", "named"),
    [
        ({"initial_state": [1.0, 2.0]}, ShapeError, "initial_state has shape"),
        ({"initial_estimate": [np.nan]}, InvalidInputError, "initial_estimate is"),
        ({"disturbance_covariance": [[-1.0]]}, WeightError, "disturbance covariance"),
        ({"noise_covariance": np.eye(2)}, ShapeError, "noise covariance"),
        ({"dt": 0.0}, OptionError, "dt is 0"),
        ({"horizon": 0}, OptionError, "horizon is 0"),
        ({"steps": 0}, OptionError, "steps is 0"),
        ({"labels": ("a", "b")}, OptionError, "labels is .* expected 1 names"),
        ({"settling_time": -1.0}, OptionError, "settling_time is -1"),
        ({"settling_time": np.nan}, OptionError, "settling_time is nan"),
        ({"inputs": lambda t, x: x}, OptionError, "the system has 0 inputs"),
        ({"of": system(1)}, OptionError, "inputs is None, and the system has 1 inputs"),
        ({"resolution": [-0.1]}, OptionError, "resolution is"),
        (
            {"region": qpmhe.Box([0.0] * 2, [1.0] * 2)}, OptionError,
            "region is .* a set of dimension 1",
        ),
        ({"resolution": [0.1, 0.1]}, ShapeError, "resolution has shape"),
        (
            {"of": system(states=qpmhe.Box([0.0], [0.4]))},
            InvalidInputError, "initial_state is .* outside of the state set",
        ),
        (
            {"of": system(states=qpmhe.Box([0.3], [1.0]))},
            InvalidInputError, "initial_estimate is .* outside of the state set",
        ),
    ],
)
def test_scenarios_that_do_not_fit(changes, error, named):
    with pytest.raises(error, match=named):
        scenario(**changes)
