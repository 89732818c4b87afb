"""Outputs and states that wrap: as accurate as with angles that go on beyond plus and minus pi."""

import math
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError, ShapeError
from qpmhe.estimation.snapshot import read

PI = np.pi
EAST, NORTH = np.array([10.0, 0.0]), np.array([0.0, 9.0])  # beacons, outside of the path
DEVIATIONS = {"prior": [0.5, 0.5, 0.3], "disturbance": [0.02] * 3, "noise": [0.1, 0.1, 0.03, 0.03]}
COVARIANCES = {name: np.diag(np.square(values)) for name, values in DEVIATIONS.items()}
GAIN = np.array([[-0.4, 0.0, 0.0, 0.0], [0.0, -0.4, 0.0, 0.0], [0.0, 0.0, -0.25, -0.25]])
ANGLES = {"state_residual": qpmhe.angles([2]), "output_residual": qpmhe.angles([2, 3])}
OBSERVERS = {
    "luenberger": lambda: qpmhe.Luenberger(GAIN),
    "injection": lambda: qpmhe.OutputInjection(lambda z, v: GAIN @ v),
    "extended": lambda: qpmhe.ExtendedKalman(**COVARIANCES),
    "unscented": lambda: qpmhe.UnscentedKalman(**COVARIANCES),
}
each_observer = pytest.mark.parametrize("observer", OBSERVERS)
each_candidate = pytest.mark.parametrize("candidate", ["observer", "reinitialized"])


def wrapped(angle):
    return (angle + PI) % (2.0 * PI) - PI


def step(x, u):
    """Drive a straight line of length u_1, then turn by u_2."""
    heading = x[..., 2]
    return np.stack((
        x[..., 0] + u[..., 0] * np.cos(heading), x[..., 1] + u[..., 0] * np.sin(heading),
        heading + u[..., 1],
    ), axis=-1)


def sight(x):
    """Ranges and bearings of the two beacons."""
    seen = [beacon - x[..., :2] for beacon in (EAST, NORTH)]
    ranges = [np.hypot(one[..., 0], one[..., 1]) for one in seen]
    bearings = [np.arctan2(one[..., 1], one[..., 0]) - x[..., 2] for one in seen]
    return np.stack(ranges + bearings, axis=-1)


def wrapped_step(x, u):
    value = step(x, u)
    value[..., 2] = wrapped(value[..., 2])
    return value


def wrapped_sight(x):
    value = sight(x)
    value[..., 2:] = wrapped(value[..., 2:])
    return value


def record(turn, steps, length=0.5, seed=0, heading=0.4):
    rng = np.random.default_rng(seed)
    u = np.column_stack((np.full(steps, length), np.full(steps, turn)))
    x, y = [np.array([1.0, -0.5, heading])], []
    for one in u:
        y.append(sight(x[-1]) + rng.normal(0.0, DEVIATIONS["noise"]))
        x.append(step(x[-1], one) + rng.normal(0.0, DEVIATIONS["disturbance"]))
    return np.array(x), np.array(y), u


def step_slope(x, u):
    slope = np.zeros((*x.shape, 3))
    slope[...] = np.eye(3)
    slope[..., 0, 2] = -u[..., 0] * np.sin(x[..., 2])
    slope[..., 1, 2] = u[..., 0] * np.cos(x[..., 2])
    return slope


def sight_slope(x):
    slope = np.zeros((*x.shape[:-1], 4, 3))
    for j, beacon in enumerate((EAST, NORTH)):
        seen = beacon - x[..., :2]
        squared = (seen**2).sum(axis=-1)
        slope[..., j, :2] = -seen / np.sqrt(squared)[..., None]
        slope[..., 2 + j, 0] = seen[..., 1] / squared
        slope[..., 2 + j, 1] = -seen[..., 0] / squared
        slope[..., 2 + j, 2] = -1.0
    return slope


SLOPES = {"f_jacobian": step_slope, "h_jacobian": sight_slope}


def plain(**options):
    return qpmhe.System(step, sight, n=3, p=4, m=2, **options)


def wrapping(**options):
    return qpmhe.System(wrapped_step, wrapped_sight, n=3, p=4, m=2, **ANGLES, **options)


def estimator(system, observer="luenberger", start=(0.7, 0.0, 0.9), **options):
    made = OBSERVERS[observer]() if isinstance(observer, str) else observer
    options = {"horizon": 8, "max_qps": 2, **options}
    cost = qpmhe.QuadraticCost.from_covariances(**COVARIANCES)
    return qpmhe.MovingHorizonEstimator(system, made, cost, initial_state=list(start), **options)


def assert_same_errors(found, reference, tolerance=1e-10):
    """Runs on wrapped and on unwrapped data whose states differ by whole turns only."""
    difference = found.states - reference.states
    turns = np.round(difference[:, 2] / (2.0 * PI))
    difference[:, 2] -= 2.0 * PI * turns
    scale = np.abs(reference.states[:, :2]).max()
    assert np.abs(difference).max() < tolerance * scale
    np.testing.assert_allclose(found.costs, reference.costs, rtol=1e-6)
    np.testing.assert_allclose(found.candidate_costs, reference.candidate_costs, rtol=1e-6)
    assert np.array_equal(found.qps, reference.qps)
    assert np.array_equal(found.flags, reference.flags)
    return turns


@each_candidate
@each_observer
def test_a_robot_that_turns_a_hundred_times_loses_nothing(observer, candidate):
    x, y, u = record(2.0, 330)
    seen = y.copy()
    seen[:, 2:] = wrapped(y[:, 2:])
    for j in (2, 3):
        assert (np.abs(np.diff(seen[:, j])) > PI).sum() >= 100
    reference = estimator(plain(**SLOPES), observer, candidate=candidate).run(y, u)
    run = estimator(wrapping(**SLOPES), observer, candidate=candidate).run(seen, u)
    turns = assert_same_errors(run, reference)
    assert np.abs(turns).max() >= 100
    assert (np.abs(np.diff(run.states[:, 2])) > PI).sum() >= 100
    late = (reference.states - x)[100:]
    assert np.sqrt((late**2).mean(axis=0))[2] < 0.05  # and the reference estimates well


@pytest.mark.parametrize("options", [
    {}, {"warm_start": True}, {"arrival": "smoothed"}, {"candidate": "reinitialized"},
    {"max_qps": None, "warm_start": True}, {"max_qps": 1, "warm_start": True}, {"horizon": 1},
])
@pytest.mark.parametrize("sets", [
    {}, {"states": qpmhe.Box([-9.0, -9.0, PI - 0.5], [9.0, 9.0, PI + 0.5])},
    {"disturbances": qpmhe.Box([-0.05, -0.05, 0.0], [0.05, 0.05, 0.0])},
    {"disturbances": qpmhe.Box([-0.05] * 3, [0.05] * 3),
     "noises": qpmhe.Box([-0.4, -0.4, -0.06, -0.06], [0.4, 0.4, 0.06, 0.06])},
])
@pytest.mark.parametrize("observer", ["luenberger", "extended"])
@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
def test_a_heading_that_stays_at_the_seam(observer, sets, options):
    """Prior, candidate, estimate and measurement are on different turns at most samples."""
    _, y, u = record(0.0, 50, 0.05, heading=PI)
    seen = np.column_stack((y[:, :2], wrapped(y[:, 2:])))
    runs = [
        estimator(made, observer, (0.7, 0.0, start), **options).run(data, u)
        for made, data, start in (
            (plain(**sets, **SLOPES), y, PI + 0.2), (wrapping(**sets, **SLOPES), seen, 0.2 - PI),
        )
    ]
    signs = np.sign(runs[1].states[:, 2])
    assert "states" in sets or (signs[1:] != signs[:-1]).sum() >= 2
    converged = "disturbances" in sets or options.get("max_qps", 2) is None
    assert_same_errors(runs[1], runs[0], 1e-6 if converged else 1e-9)


def test_without_residual_functions_each_crossing_costs():
    x, y, u = record(2.0, 100)
    y[:, 2:] = wrapped(y[:, 2:])
    errors = [
        np.sqrt((wrapped(estimator(system).run(y, u).states - x)[20:, 2] ** 2).mean())
        for system in (wrapping(), qpmhe.System(wrapped_step, wrapped_sight, n=3, p=4, m=2))
    ]
    assert errors[1] > 3.0 * errors[0]


@each_observer
def test_states_may_go_on_where_only_the_measurement_wraps(observer):
    _, y, u = record(2.0, 60)
    reference = estimator(plain(**SLOPES), observer).run(y, u)
    y[:, 2:] = wrapped(y[:, 2:])
    run = estimator(plain(**ANGLES, **SLOPES), observer).run(y, u)
    assert np.all(assert_same_errors(run, reference) == 0.0)


@pytest.mark.parametrize("options", [
    {}, {"states": qpmhe.Box([-9.0, -9.0, -2.0], [9.0, 9.0, 3.0])},
    {"disturbances": qpmhe.Box([-0.3] * 3, [0.3] * 3),
     "noises": qpmhe.Polytope(-np.eye(4), [0.3] * 4)},
])
@each_candidate
@each_observer
def test_angles_that_never_wrap_change_no_bit(observer, candidate, options):
    _, y, u = record(0.01, 40, 0.05)
    assert np.abs(y[:, 2:]).max() < 3.0
    runs = [
        estimator(plain(**options, **more), observer, candidate=candidate).run(y, u)
        for more in ({}, ANGLES, {name: lambda a, b: wrapped(a - b) for name in ANGLES})
    ]
    for run in runs[1:]:
        for name in ("states", "filtered", "costs", "candidate_costs", "qps", "flags"):
            assert np.array_equal(getattr(run, name), getattr(runs[0], name)), name


def test_a_function_does_what_angles_do():
    """For outputs of which some are angles, written for one vector."""

    def turned(a, b):
        difference = a - b
        difference[2] = np.arctan2(np.sin(difference[2]), np.cos(difference[2]))
        difference[3] = wrapped(difference[3])
        return difference

    _, y, u = record(2.0, 60)
    runs = [
        estimator(plain(state_residual=qpmhe.angles([2]), output_residual=one, **SLOPES)).run(
            np.column_stack((y[:, :2], wrapped(y[:, 2:]))), u)
        for one in (qpmhe.angles([2, 3]), turned)
    ]
    assert_same_errors(runs[1], runs[0])


def test_degrees_and_turns_side_by_side():
    residual = qpmhe.angles([0, 2], period=[360.0, 1.0])
    np.testing.assert_allclose(
        residual([[359.0, 7.0, 0.9], [-170.0, 7.0, 0.2]], [1.0, -7.0, 0.1]),
        [[-2.0, 14.0, -0.2], [-171.0, 14.0, 0.1]],
    )
    assert residual([180.0, 0.0, 0.5], np.zeros(3)).tolist() == [-180.0, 0.0, -0.5]
    assert residual([-180.0, 0.0, -0.5], np.zeros(3)).tolist() == [-180.0, 0.0, -0.5]


@pytest.mark.parametrize("h", [
    lambda x: np.arctan2(np.sin(x), np.cos(x)), lambda x: wrapped(x),
])
def test_jacobians_do_not_see_the_jump(h):
    """Numerical ones at the seam itself, and given ones when they are compared there."""
    system = qpmhe.System(h, h, n=1, p=1, output_residual=qpmhe.angles([0]),
                          state_residual=qpmhe.angles([0]))
    jumping = qpmhe.System(h, h, n=1, p=1)
    for at in (PI, -PI, np.nextafter(PI, 0.0), 3.0 * PI, PI - 1e-7):
        x = np.array([at])
        for jacobian in (system.f_jacobian, system.h_jacobian):
            np.testing.assert_allclose(jacobian(x, np.zeros(0)), [[1.0]], rtol=1e-8)
    assert abs(jumping.h_jacobian(np.array([PI]), np.zeros(0))[0, 0]) > 1e4
    given = qpmhe.System(
        h, h, n=1, p=1, h_jacobian=lambda x: [[1.0]], f_jacobian=lambda x: [[1.0]],
        output_residual=qpmhe.angles([0]), state_residual=qpmhe.angles([0]), scales=[1.0],
    )
    given.check(np.array([PI]), np.zeros(0))


def test_bounds_near_a_seam_do_not_confuse_inward_differences():
    system = qpmhe.System(
        lambda x: np.arctan2(np.sin(x), np.cos(x)), lambda x: np.arctan2(np.sin(x), np.cos(x)),
        n=1, p=1, states=qpmhe.Box([PI - 1e-9], [PI + 0.1]),
        output_residual=qpmhe.angles([0]), state_residual=qpmhe.angles([0]),
    )
    np.testing.assert_allclose(
        system.f_jacobian(np.array([PI - 1e-9]), np.zeros(0)), [[1.0]], rtol=1e-6)


def compass(states=None, wraps=True, **options):
    """A needle in degrees, seen directly, with a rate."""

    def f(x):
        angle = x[..., 0] + x[..., 1]
        return np.stack((_degrees(angle) if wraps else angle, 0.9 * x[..., 1]), axis=-1)

    residuals = (
        {"output_residual": qpmhe.angles([0], 360.0), "state_residual": qpmhe.angles(0, 360.0)}
        if wraps else {}
    )
    return qpmhe.System(
        f, lambda x: _degrees(x[..., :1]) if wraps else x[..., :1], n=2, p=1, states=states,
        **residuals, **options,
    )


def _degrees(angle):
    return (angle + 180.0) % 360.0 - 180.0


def needle(system, observer=None, start=(180.0, 0.0), **options):
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.diag([25.0, 1.0]), disturbance=np.diag([1.0, 0.1]), noise=[[4.0]])
    options = {"horizon": 6, "max_qps": 3, **options}
    return qpmhe.MovingHorizonEstimator(
        system, observer or qpmhe.Luenberger([0.5, 0.05]), cost, initial_state=list(start),
        **options)


def needle_record(steps=80, seed=1):
    rng = np.random.default_rng(seed)
    t = np.arange(steps)
    return (180.0 + 12.0 * np.sin(0.2 * t) + rng.normal(0.0, 2.0, steps))[:, None]


KALMAN = {"prior": np.diag([25.0, 1.0]), "disturbance": np.diag([1.0, 0.1]), "noise": [[4.0]]}


@pytest.mark.parametrize("options", [
    {}, {"candidate": "reinitialized"}, {"warm_start": True, "max_qps": 1},
])
@pytest.mark.parametrize("observer", [
    qpmhe.Luenberger([0.5, 0.05]), qpmhe.OutputInjection(lambda z, v: [0.5 * v[0], 0.05 * v[0]]),
    qpmhe.ExtendedKalman(**KALMAN), qpmhe.UnscentedKalman(**KALMAN),
])
@pytest.mark.parametrize("sets", [
    {"states": qpmhe.Box([170.0, -np.inf], [190.0, np.inf])},
    {"states": qpmhe.Box([170.0, -9.0], [190.0, 9.0]) & qpmhe.Polytope([[0.0, 1.0]], [2.0])},
    {"disturbances": qpmhe.Box([-0.6, -1.0], [0.6, 1.0]), "noises": qpmhe.Box([-2.5], [2.5])},
    {"disturbances": qpmhe.Box([0.0, -1.0], [0.0, 1.0])},
    {"disturbances": qpmhe.Box([0.0, -1.0], [0.0, 1.0]),
     "states": qpmhe.Box([170.0, -9.0], [190.0, 9.0])},
    {"disturbances": qpmhe.Polytope([[1.0, 1.0], [-1.0, 1.0]], [0.7, 0.7]),
     "states": qpmhe.Box([170.0, -9.0], [190.0, 9.0])},
])
@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
def test_sets_hold_as_they_do_without_a_seam(sets, observer, options):
    y = needle_record(60)
    reference = needle(compass(wraps=False, **sets), observer, **options).run(y)
    run = needle(compass(**sets), observer, **options).run(_degrees(y))
    error = run.states - reference.states
    if "states" not in sets:
        error[:, 0] = _degrees(error[:, 0])
    assert np.abs(error).max() < 1e-6
    np.testing.assert_allclose(run.costs, reference.costs, rtol=1e-6)
    assert np.array_equal(run.flags, reference.flags)
    free = needle(compass(wraps=False), observer, **options).run(y)
    assert not np.allclose(reference.states, free.states, atol=1e-3)  # the sets bind


def test_a_state_written_in_another_turn_is_in_its_bounds():
    states = qpmhe.Box([170.0, -np.inf], [190.0, np.inf])
    mhe = needle(compass(states), start=(-175.0, 0.0))  # a warning would be an error
    assert mhe.initial_state.tolist() == [185.0, 0.0]
    for start in (-175.0, 185.0, 545.0):
        mhe.reset([start, 0.0])
        estimate = mhe.update([-175.0])
        assert qpmhe.Status.OBSERVER_PROJECTED not in estimate.status
        assert estimate.trajectory[:, 0].tolist() == pytest.approx([185.0, 185.0])
        assert estimate.cost < 1e-20
        np.testing.assert_allclose(estimate.filtered, [185.0, 0.0])
    # Beyond them it is not.
    with pytest.warns(qpmhe.ObserverWarning, match="outside of the state set"):
        mhe.reset([-160.0, 0.0])
    assert mhe.initial_state.tolist() == [190.0, 0.0]
    with pytest.warns(qpmhe.ObserverWarning):
        mhe.reset([20.0, 0.0])
    assert mhe.initial_state[0] == 170.0  # the nearer bound


@each_candidate
def test_projections_onto_bounds_across_the_seam(candidate):
    covariances = {"prior": 1e6 * np.eye(2), "disturbance": np.eye(2), "noise": [[1.0]]}

    def needle_at(start, turn, observer):
        system = qpmhe.System(
            lambda x: np.array([_degrees(x[0] + turn), x[1]]), lambda x: x[:1], n=2, p=1,
            states=qpmhe.Box([170.0, -np.inf], [190.0, np.inf]),
            output_residual=qpmhe.angles(0, 360.0), state_residual=qpmhe.angles(0, 360.0))
        cost = qpmhe.QuadraticCost.from_covariances(**covariances)
        return qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=3, initial_state=[start, 0.0], max_qps=0,
            candidate=candidate)

    # The prediction, -175 degrees, is inside; with the correction by 10 degrees it is not.
    half = qpmhe.Luenberger([0.5, 0.0])
    projected = needle_at(185.0, 0.0, half).update([-155.0])
    assert qpmhe.Status.OBSERVER_PROJECTED in projected.status
    assert qpmhe.Status.PREDICTION_OUTSIDE not in projected.status
    assert projected.state[0] == 190.0
    assert projected.disturbances[0, 0] == 5.0
    # From 5 degrees over -9 to the bound at 190 the shorter way is backwards.
    far = needle_at(185.0, 180.0, half).update([157.0])
    assert far.state[0] == 190.0
    assert far.disturbances[0, 0] == -175.0
    # What has used y is beyond the turn, nearer to the other bound.
    kalman = qpmhe.ExtendedKalman(**covariances)
    assert needle_at(189.0, 0.0, kalman).update([8.0]).filtered[0] == 170.0


def test_bounds_a_period_apart_bound_nothing():
    y = _degrees(needle_record())
    free = needle(compass()).run(y)
    for lower, upper in ((-180.0, 180.0), (0.0, 360.0), (-500.0, 500.0)):
        system = compass(qpmhe.Box([lower, -np.inf], [upper, np.inf]))
        assert system.states is None
        assert np.array_equal(needle(system).run(y).states, free.states)
    partly = compass(qpmhe.Box([0.0, -9.0], [360.0, 9.0]))
    assert partly.states.lower.tolist() == [-np.inf, -9.0]
    assert partly.turns is None
    assert compass(qpmhe.Box([0.0, -9.0], [359.0, 9.0])).turns is not None


@each_candidate
def test_a_prediction_far_from_the_measurement_turns_the_short_way(candidate):
    """Half a turn off, corrections and their cost are those of the shorter way round."""
    options = {"max_qps": 0, "candidate": candidate}
    mhe = needle(compass(), qpmhe.Luenberger([1.0, 0.0]), start=(-170.0, 0.0), **options)
    estimate = mhe.update([150.0])
    assert estimate.noises[0].tolist() == [-40.0]
    assert estimate.disturbances[0, 0] == -40.0
    assert estimate.state[0] % 360.0 == pytest.approx(150.0)
    mhe = needle(compass(), qpmhe.Luenberger([7.0, 0.0]), start=(0.0, 0.0), **options)
    estimate = mhe.update([30.0])  # a correction by 210 degrees is one by -150
    assert estimate.disturbances[0, 0] == -150.0
    assert estimate.cost == pytest.approx(150.0**2 + 30.0**2 / 4.0)


def test_missing_and_late_measurements_and_covariances():
    _, y, u = record(2.0, 40)
    seen = np.column_stack((y[:, :2], wrapped(y[:, 2:])))
    runs = []
    for system, data in ((plain(**SLOPES), y), (wrapping(**SLOPES), seen)):
        mhe, out = estimator(system, "extended"), []
        for t in range(40):
            sample = data[t].copy()
            if t % 5 == 2:
                sample[2:] = np.nan
            out.append(mhe.update(sample, u[t]))
            if t % 5 == 4:
                out.append(mhe.amend(t - 2, data[t - 2]))
        runs.append((out, mhe.covariances()))
    for one, other in zip(runs[0][0], runs[1][0], strict=True):
        assert other.cost == pytest.approx(one.cost, rel=1e-6)
        np.testing.assert_allclose(other.noises, one.noises, atol=1e-9)
        np.testing.assert_allclose(other.disturbances, one.disturbances, atol=1e-9)
    np.testing.assert_allclose(runs[1][1], runs[0][1], rtol=1e-9, atol=1e-14)


@each_candidate
@each_observer
def test_a_snapshot_continues_bit_for_bit(observer, candidate):
    _, y, u = record(2.0, 40)
    seen = np.column_stack((y[:, :2], wrapped(y[:, 2:])))
    options = {"candidate": candidate}
    whole = estimator(wrapping(), observer, **options)
    whole.run(seen[:20], u[:20])
    state = pickle.loads(pickle.dumps(whole.state_dict()))
    other = estimator(wrapping(), observer, **options)
    other.load_state_dict(state)
    for mhe in (whole, other):
        mhe.last = mhe.run(seen[20:], u[20:])
    assert np.array_equal(whole.last.states, other.last.states)
    assert np.array_equal(whole.last.costs, other.last.costs)
    for residuals in (
        {}, {"state_residual": qpmhe.angles([2])},
        {**ANGLES, "output_residual": qpmhe.angles([2, 3], period=[2.0 * PI, 6.0])},
        {**ANGLES, "state_residual": qpmhe.angles([0, 2])},
    ):
        different = qpmhe.System(wrapped_step, wrapped_sight, n=3, p=4, m=2, **residuals)
        with pytest.raises(InvalidInputError, match=r"another (output|state)_residual"):
            estimator(different, observer, **options).load_state_dict(state)


def test_snapshots_without_residual_functions_have_no_new_entries():
    described = read(estimator(plain()).state_dict())["estimator"]
    assert described
    assert not [name for name in described if "residual" in name]


def turned(a, b):
    return (a - b + PI) % (2.0 * PI) - PI


@pytest.mark.parametrize("residuals", [ANGLES, dict.fromkeys(ANGLES, turned)])
def test_estimators_and_systems_pickle(residuals):
    system = qpmhe.System(
        wrapped_step, wrapped_sight, n=3, p=4, m=2, **residuals,
        states=qpmhe.Box([-9.0, -9.0, -3.0], [9.0, 9.0, 3.0]),
    )
    _, y, u = record(2.0, 30)
    mhe = estimator(system)
    mhe.run(y[:12], u[:12])
    again = pickle.loads(pickle.dumps(mhe))
    assert np.array_equal(again.run(y[12:], u[12:]).states, mhe.run(y[12:], u[12:]).states)
    # A residual function of one system serves another.
    other = qpmhe.System(
        wrapped_step, wrapped_sight, n=3, p=4, m=2, output_residual=system.output_residual,
        state_residual=system.state_residual,
    )
    pickle.loads(pickle.dumps(other))


def rate(x, u):
    return np.stack((u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[1]))


def symbolic_sight(m):
    def h(x):
        seen = [(b[0] - x[0], b[1] - x[1]) for b in (EAST, NORTH)]
        return [
            *(m.sqrt(e * e + n * n) for e, n in seen),
            *(m.atan2(n, e) - x[2] for e, n in seen),
        ]

    return h


def from_casadi(**options):
    ca = pytest.importorskip("casadi")
    return qpmhe.from_casadi(
        lambda x, u: [u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[1]], symbolic_sight(ca),
        n=3, m=2, dt=0.5, compiled=False, **options)


def from_jax(**options):
    jnp = pytest.importorskip("jax.numpy")

    def h(x):
        seen = [jnp.asarray(b) - x[:2] for b in (EAST, NORTH)]
        return jnp.stack([
            *(jnp.hypot(*one) for one in seen),
            *(jnp.arctan2(one[1], one[0]) - x[2] for one in seen),
        ])

    return qpmhe.from_jax(
        lambda x, u: jnp.stack([u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]]), h,
        n=3, p=4, m=2, dt=0.5, **options)


def from_sympy(**options):
    sp = pytest.importorskip("sympy")
    x, u = sp.symbols("x:3"), sp.symbols("u:2")
    f = [u[0] * sp.cos(x[2]), u[0] * sp.sin(x[2]), u[1]]
    return qpmhe.from_sympy(f, symbolic_sight(sp)(x), x, u, dt=0.5, **options)


def from_control(**options):
    control = pytest.importorskip("control")
    system = control.nlsys(
        lambda t, x, u, params: rate(x, u), lambda t, x, u, params: sight(np.asarray(x)),
        inputs=2, outputs=4, states=3)
    return qpmhe.from_control(system, dt=0.5, **options)


def from_ode(**options):
    return qpmhe.System.from_ode(rate, sight, dt=0.5, n=3, p=4, m=2, **options)


@pytest.mark.parametrize("make", [from_ode, from_casadi, from_jax, from_sympy, from_control])
def test_every_way_to_make_a_system_takes_angles(make):
    """With steps of other lengths, wrapped and not; and pickled."""
    _, _, u = record(2.0, 50)
    u = u / 0.5
    lengths = 0.5 + 0.1 * np.sin(np.arange(50.0))
    truth, x, y = from_ode().timed, np.array([1.0, -0.5, 0.4]), []
    rng = np.random.default_rng(3)
    for one, dt in zip(u, lengths, strict=True):
        y.append(sight(x) + rng.normal(0.0, DEVIATIONS["noise"]))
        x = truth.f(x, np.append(one, dt))
    seen = np.column_stack((np.array(y)[:, :2], wrapped(np.array(y)[:, 2:])))
    system = make(**ANGLES)
    if make in (from_ode, from_casadi, from_sympy):  # the other models here are local functions
        system = pickle.loads(pickle.dumps(system))
    found = []
    for one, data in ((make(), y), (system, seen)):
        mhe = estimator(one)
        found.append([mhe.update(a, b, dt=c) for a, b, c in zip(data, u, lengths, strict=True)])
    for plain_one, angle_one in zip(*found, strict=True):
        np.testing.assert_allclose(angle_one.state, plain_one.state, rtol=1e-8, atol=1e-9)
        assert angle_one.cost == pytest.approx(plain_one.cost, rel=1e-6)
    # Where nothing wraps, not a bit.
    _, y, u = record(0.01, 20, 0.05)
    states = [estimator(make(**more)).run(y, u / 0.5).states for more in ({}, ANGLES)]
    assert np.array_equal(*states)


@pytest.mark.parametrize("residuals", [ANGLES, dict.fromkeys(ANGLES, turned)])
@pytest.mark.parametrize("augment", [
    qpmhe.noisy_inputs,
    lambda system: qpmhe.augment_parameters(system, nominal=[2.0], parameter_bounds=qpmhe.Box(
        [1.5], [2.5])),
])
def test_parameters_and_errors_of_inputs_are_plain_beside_angles(augment, residuals):
    x, y, u = record(2.0, 60)
    seen = np.column_stack((y[:, :2], wrapped(y[:, 2:])))
    runs = []
    for system, data in ((plain(), y), (plain(**residuals), seen)):
        larger = augment(system)
        k = larger.n - 3
        cost = qpmhe.QuadraticCost.from_covariances(
            prior=np.diag([0.25, 0.25, 0.09, *[1e-4] * k]),
            disturbance=np.diag([4e-4] * 3 + [1e-4] * k), noise=COVARIANCES["noise"])
        mhe = qpmhe.MovingHorizonEstimator(
            larger, qpmhe.Luenberger(np.vstack((GAIN, np.zeros((k, 4))))), cost, horizon=8,
            initial_state=[0.7, 0.0, 0.9, *[2.0 if larger.m == 1 else 0.0] * k], max_qps=2)
        runs.append(mhe.run(data, u[:, : larger.m]))
    np.testing.assert_allclose(runs[1].states, runs[0].states, rtol=1e-7, atol=1e-7)
    assert np.abs(runs[1].states[20:, :2] - x[20:, :2]).max() < 0.5


def test_a_smoothed_prior_may_be_on_another_turn():
    _, y, u = record(2.0, 60)
    seen = np.column_stack((y[:, :2], wrapped(y[:, 2:])))
    runs = [
        estimator(system, "extended", arrival="smoothed").run(data, u)
        for system, data in ((plain(**SLOPES), y), (wrapping(**SLOPES), seen))
    ]
    assert_same_errors(runs[1], runs[0])


def within_half_a_turn(a, b):
    """Asks for the numbers' values, which no expression has."""
    values = np.array(a - b, float)
    for value in values.reshape(-1, values.shape[-1]):
        value[2] -= 2.0 * np.pi * math.floor(float(value[2]) / (2.0 * np.pi) + 0.5)
    return values


def test_compiled_code_refuses_functions_without_expression_by_name():
    for name in ANGLES:
        system = from_casadi(**{name: within_half_a_turn})
        with pytest.raises(OptionError, match=f"{name}, a function, has no C form"):
            estimator(system, engine="compiled", backend="auto")
        with pytest.raises(OptionError, match=name):
            qpmhe.codegen.write(estimator(system), "/nonexistent")


def test_a_batch_takes_them():
    _, y, u = record(2.0, 30)
    seen = np.column_stack((y[:, :2], wrapped(y[:, 2:])))
    single = estimator(wrapping()).run(seen, u)
    batch = qpmhe.BatchEstimator(
        wrapping(), qpmhe.Luenberger(GAIN), qpmhe.QuadraticCost.from_covariances(**COVARIANCES),
        members=2, initial_states=[0.7, 0.0, 0.9], horizon=8, max_qps=2)
    for t in range(30):
        found = batch.update(np.tile(seen[t], (2, 1)), u[t])
    assert np.array_equal(batch.states[0], single.states[-1])
    assert found.states.shape == (2, 3)


def test_certificates_refuse_angles_that_may_wrap_by_name():
    certificates = pytest.importorskip("qpmhe.certificates")
    region = qpmhe.Box([-1.0, -1.0, -4.0], [1.0, 1.0, 4.0])
    with pytest.raises(certificates.CertificateError, match=r"wide in the angle x\[2\].*narrower"):
        certificates.certify(
            wrapping(), qpmhe.Luenberger(GAIN),
            qpmhe.QuadraticCost.from_covariances(**COVARIANCES), horizon=5, region=region,
            inputs=qpmhe.Box([0.0, -1.0], [1.0, 1.0]))


def test_a_model_that_fails_and_a_residual_that_raises_fall_back():
    """Bad luck at run time never raises out of update."""
    calls = {"left": 10**9}

    def brittle(a, b):
        calls["left"] -= 1
        if calls["left"] < 0:
            raise RuntimeError("no more")
        return a - b

    for candidate in ("observer", "reinitialized"):
        calls["left"] = 10**9
        mhe = estimator(plain(output_residual=brittle), candidate=candidate)
        _, y, u = record(0.01, 12, 0.05)
        mhe.run(y[:6], u[:6])
        calls["left"] = 0
        failed = mhe.update(y[6], u[6])
        assert qpmhe.Status.MODEL_FAILED in failed.status
        assert "no more" in failed.message
        calls["left"] = 10**9
        run = mhe.run(y[7:], u[7:])
        assert np.isfinite(run.states).all()


def test_divergence_to_infinity_is_a_failed_stage():
    system = qpmhe.System(
        lambda x: 1e200 * x, lambda x: x, n=1, p=1, state_residual=qpmhe.angles([0]),
        output_residual=qpmhe.angles([0]),
    )
    cost = qpmhe.QuadraticCost(prior=[[1.0]], disturbance=[[1.0]], noise=[[1.0]])
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5]), cost, horizon=3, initial_state=[0.1], max_qps=1)
    for _ in range(6):
        assert np.isfinite(mhe.update([0.3]).state).all()


@pytest.mark.parametrize("luck", ["raises", "stops", "shape", "nothing", "nan"])
@pytest.mark.parametrize("kalman", [None, qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
def test_residual_functions_that_fail_at_some_calls_are_bad_luck(kalman, luck):
    rng, share = np.random.default_rng(2), 0.0

    def residual(a, b):
        if rng.random() < share:
            if luck == "raises":
                raise ValueError("here")
            if luck == "stops":
                raise SystemExit(1)
            return {"shape": np.zeros(3), "nothing": None, "nan": a * np.nan}[luck]
        return (a - b + np.pi) % (2.0 * np.pi) - np.pi

    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x, n=1, p=1, states=qpmhe.Box([-1.5], [1.5]),
        state_residual=residual, output_residual=residual)
    covariances = {"prior": 1.0, "disturbance": 1.0, "noise": 1.0}
    for candidate in ("observer", "reinitialized"):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.3]) if kalman is None else kalman(**covariances),
            qpmhe.QuadraticCost.from_covariances(**covariances),
            horizon=3, initial_state=[0.0], max_qps=2, warm_start=True, candidate=candidate)
        for t in range(80):
            share = 0.2 if 3 <= t < 60 else 0.0
            estimate = mhe.update([np.sin(t)])
            assert mhe.time == t + 1
            assert np.isfinite(estimate.trajectory).all()
            if np.isfinite(estimate.candidate_cost):
                assert estimate.cost <= estimate.candidate_cost
        assert not estimate.status & (qpmhe.Status.MODEL_FAILED | qpmhe.Status.FAILED_STAGE)
        share = 0.0


INPUTS = {"n": 3, "p": 4, "m": 2}


@pytest.mark.parametrize(("residual", "error", "text"), [
    (5, ModelError, "expected qpmhe.angles"),
    ("angles", ModelError, "expected qpmhe.angles"),
    (lambda a, b: a - b + 0.1, ModelError, r"\[0.1, .* at a = b = .*expected zeros"),
    (lambda a, b: b - a, ModelError, "expected the same change"),
    (lambda a, b: 2.0 * (a - b), ModelError, "expected the same change"),
    (lambda a, b: np.sin(a - b), ModelError, "expected the same change"),
    (lambda a, b: np.clip(a - b, -1.0, 1.0), ModelError, "expected the same change"),
    (lambda a, b: np.abs(a - b), ModelError, "expected the same change"),
    (lambda a, b: (a - b)[:1], ModelError, r"shape \(1,\).*expected"),
    (lambda a, b: (a - b)[..., None], ModelError, r"shape .*expected"),
    (lambda a, b: 1 / 0, ModelError, "raised ZeroDivisionError"),
    (lambda a, b: np.log(a - b), ModelError, "expected finite numbers"),
    (lambda a: a, ModelError, "takes 1 positional argument.*expected the difference a - b"),
    (lambda a, b, c: a, ModelError, "missing 1 required.*expected the difference a - b"),
    (lambda a, b: a[0] - b[0], ModelError, r"shape \(\) for two vectors of .*their difference"),
    (qpmhe.angles([7]), InvalidInputError, "names component 7"),
])
def test_residual_functions_that_are_none(residual, error, text):
    for name in ANGLES:
        with pytest.raises(error, match=text) as caught:
            qpmhe.System(step, sight, **INPUTS, **{name: residual})
        assert name in str(caught.value)


def test_a_residual_function_of_another_size():
    system = qpmhe.System(step, sight, **INPUTS, output_residual=turned)
    with pytest.raises(ShapeError, match="state_residual is for 4 components; expected 3"):
        qpmhe.System(step, sight, **INPUTS, state_residual=system.output_residual)


@pytest.mark.parametrize("indices", [[], [[0, 1]], [-1], [0.5], [True], "x", None, [1, None]])
def test_indices_that_are_none(indices):
    with pytest.raises(InvalidInputError, match=r"indices is .*expected one or more integers >= 0"):
        qpmhe.angles(indices)


def test_angles_that_are_given_twice():
    with pytest.raises(InvalidInputError, match=r"\[2, 0, 2\], which names a component twice"):
        qpmhe.angles([2, 0, 2])


@pytest.mark.parametrize(("period", "error"), [
    (0.0, OptionError), (-1.0, OptionError), (np.inf, OptionError), (np.nan, OptionError),
    ([1.0, -2.0], OptionError), ([1.0, 2.0, 3.0], ShapeError), ("a", InvalidInputError),
])
def test_periods_that_are_none(period, error):
    with pytest.raises(error, match="period"):
        qpmhe.angles([0, 1], period)


@pytest.mark.parametrize("residual", [qpmhe.angles([2]), lambda a, b: turned(a, b)])
def test_sets_that_mean_nothing_on_a_circle(residual):
    below = qpmhe.Box([-np.inf] * 3, [np.inf, np.inf, 1.0])
    above = qpmhe.Box([-1.0, -1.0, 0.0], [1.0, 1.0, np.inf])
    for states, text in (
        (below, "component 2, an angle, by lower -inf and upper 1.0"),
        (above, "component 2, an angle, by lower 0.0 and upper inf"),
        (qpmhe.Polytope([[1.0, 1.0, 0.0], [0.0, 1.0, 2.0]], [5.0, 5.0]), "row [01] of the matrix"),
    ):
        with pytest.raises(SetError, match=text):
            qpmhe.System(step, sight, **INPUTS, states=states, state_residual=residual)
    both = {"disturbances": below, "noises": qpmhe.Polytope([[0.0, 1.0, 1.0, 0.0]], [1.0])}
    qpmhe.System(step, sight, **INPUTS, **ANGLES, **both)  # of W and V they do mean something


@each_candidate
def test_bounds_that_change_while_running_may_be_written_in_another_turn(candidate):
    def box(lower, upper):
        return {"states": qpmhe.Box([lower, -9.0], [upper, 9.0])}

    y, runs = needle_record(), []
    for wraps, turn in ((False, 0.0), (True, -360.0), (True, 720.0)):
        states = box(150.0 + turn, 230.0 + turn)["states"]
        mhe = needle(compass(states, wraps), candidate=candidate, start=(180.0 + turn, 0.0))
        data, estimates = _degrees(y) if wraps else y, []
        for t, one in enumerate(data):
            narrow = box(170.0 + 0.1 * t, 185.0 + 0.1 * t)
            if wraps:
                narrow = box(*(narrow["states"].lower[0] - 360.0 * (t % 3) + [0.0, 15.0]))
            estimates.append(mhe.update(one, bounds=narrow if t % 4 < 3 else None))
        mhe.set(bounds=box(175.0 - turn, 180.0 - turn))
        runs.append((estimates, mhe.update(data[0]).trajectory - [turn, 0.0]))
    for estimates, last in runs[1:]:
        for one, other in zip(runs[0][0], estimates, strict=True):
            error = other.state - one.state
            assert _degrees(error[0]) == pytest.approx(0.0, abs=1e-6)
            assert other.cost == pytest.approx(one.cost, rel=1e-6)
        np.testing.assert_allclose(last, runs[0][1], atol=1e-6)


@pytest.mark.parametrize(("lower", "upper"), [
    (-np.inf, 190.0), (170.0, np.inf), (-20.0, 20.0), (170.0, 500.0), (-190.0, 190.0),
])
def test_bounds_that_leave_the_turn_are_refused(lower, upper):
    mhe = needle(compass(qpmhe.Box([170.0, -9.0], [190.0, 9.0])))
    before = mhe.update([-179.0])
    with pytest.raises(SetError, match=r"component 0 of the states, an angle.*from 180\.0"):
        mhe.update([-179.0], bounds={"states": qpmhe.Box([lower, -9.0], [upper, 9.0])})
    assert mhe.time == 1
    assert np.array_equal(mhe.state, before.state)
    mhe.update([-179.0], bounds={"states": qpmhe.Box([-np.inf, -9.0], [np.inf, 9.0])})


@each_candidate
@pytest.mark.parametrize("observer", ["luenberger", "extended"])
def test_disturbances_of_lower_dimension_wrap_before_they_are_sized(observer, candidate):
    """With G, also where the observer corrects outside of its range."""
    matrix = np.array([[1.0, 0.0], [0.5, 0.0], [0.0, 1.0]])
    covariances = {**COVARIANCES, "disturbance": COVARIANCES["disturbance"][:2, :2]}
    _, y, u = record(2.0, 120)
    seen, runs = np.column_stack((y[:, :2], wrapped(y[:, 2:]))), []
    for make, data in ((plain, y), (wrapping, seen)):
        made = qpmhe.ExtendedKalman(**covariances) if observer == "extended" else OBSERVERS[
            observer]()
        mhe = qpmhe.MovingHorizonEstimator(
            make(disturbance_matrix=matrix, **SLOPES), made,
            qpmhe.QuadraticCost.from_covariances(**covariances), horizon=8, max_qps=2,
            initial_state=[0.7, 0.0, 0.9], candidate=candidate)
        runs.append(mhe.run(data, u))
    assert_same_errors(runs[1], runs[0], 1e-8)
