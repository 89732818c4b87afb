"""Outputs and states that wrap: as accurate as with angles that go on beyond plus and minus pi."""

import itertools
import math
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError, ShapeError

PI, INF = np.pi, np.inf
BEACONS = np.array([[10.0, 0.0], [0.0, 9.0]])  # outside of the path
DEVIATIONS = {"prior": [0.5, 0.5, 0.3], "disturbance": [0.02] * 3, "noise": [0.1, 0.1, 0.03, 0.03]}
COVARIANCES = {name: np.diag(np.square(values)) for name, values in DEVIATIONS.items()}
GAIN = np.array([[-0.4, 0.0, 0.0, 0.0], [0.0, -0.4, 0.0, 0.0], [0.0, 0.0, -0.25, -0.25]])
ANGLES = {"state_residual": qpmhe.angles([2]), "output_residual": qpmhe.angles([2, 3])}
SIZES = {"n": 3, "p": 4, "m": 2}
OBSERVERS = {
    "luenberger": lambda **_: qpmhe.Luenberger(GAIN),
    "injection": lambda **_: qpmhe.OutputInjection(lambda z, v: GAIN @ v),
    "extended": qpmhe.ExtendedKalman, "unscented": qpmhe.UnscentedKalman,
}
each_observer = pytest.mark.parametrize("observer", OBSERVERS)
each_candidate = pytest.mark.parametrize("candidate", ["observer", "reinitialized"])


def turned(a, b):
    return (a - b + PI) % (2.0 * PI) - PI


FUNCTIONS = dict.fromkeys(ANGLES, turned)


def rate(x, u, m=np):
    return [u[0] * m.cos(x[2]), u[0] * m.sin(x[2]), u[1]]


def drive(x, u):
    """A straight line of length u_1, then a turn by u_2."""
    return np.array([one + step for one, step in zip(x, rate(x, u), strict=True)])


def sight(x, *, root=np.sqrt, angle=np.arctan2):
    """Ranges and bearings of the two beacons."""
    seen = [(east - x[0], north - x[1]) for east, north in BEACONS]
    return [*(root(e * e + n * n) for e, n in seen), *(angle(n, e) - x[2] for e, n in seen)]


def wrapping_drive(x, u):
    value = drive(x, u)
    value[2] = turned(value[2], 0.0)
    return value


def wrapping_sight(x):
    value = np.array(sight(x))
    value[2:] = turned(value[2:], 0.0)
    return value


def plain(**options):
    return qpmhe.System(drive, sight, **SIZES, **options)


PLAIN = plain()
SLOPES = {
    "f_jacobian": lambda x, u: PLAIN.f_jacobian(x, u),
    "h_jacobian": lambda x: PLAIN.h_jacobian(x, np.zeros(2)),
}


def wrapping(residuals=ANGLES, **options):
    return qpmhe.System(wrapping_drive, wrapping_sight, **SIZES, **residuals, **options)


def wrapped(y):
    return np.column_stack((y[:, :2], turned(y[:, 2:], 0.0)))


def record(turn, steps, length=0.5):
    rng = np.random.default_rng(0)
    u = np.column_stack((np.full(steps, length), np.full(steps, turn)))
    x, y = np.array([1.0, -0.5, 0.4]), []
    for one in u:
        y.append(sight(x) + rng.normal(0.0, DEVIATIONS["noise"]))
        x = drive(x, one) + rng.normal(0.0, DEVIATIONS["disturbance"])
    return np.array(y), u


def estimator(system, observer="luenberger", w=COVARIANCES["disturbance"], **options):
    covariances = COVARIANCES | {"disturbance": w}
    return qpmhe.MovingHorizonEstimator(
        system, OBSERVERS[observer](**covariances),
        qpmhe.QuadraticCost.from_covariances(**covariances), initial_state=[0.7, 0.0, 0.9],
        **{"horizon": 8, "max_qps": 2} | options,
    )


def follow(mhe, y, u):
    """Estimates of a record whose bearings come late at times, and the covariances in the end."""
    estimates = []
    for t, sample in enumerate(y.copy()):
        if t % 5 == 2:
            sample[2:] = np.nan
        estimates.append(mhe.update(sample, u[t]))
        if t % 5 == 4:
            estimates.append(mhe.amend(t - 2, y[t - 2]))
    return estimates, mhe.covariances()


def assert_same_errors(found, reference, tolerance):
    """Estimates whose states differ by whole turns only; by how many at most."""
    most = 0.0
    for one, other in zip(found[0], reference[0], strict=True):
        error = one.trajectory - other.trajectory
        turns = np.round(error[:, 2] / (2.0 * PI))
        error[:, 2] -= 2.0 * PI * turns
        assert np.abs(error).max() < tolerance
        for name in ("noises", "disturbances"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-7)
        for name in ("cost", "candidate_cost"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-6)
        assert (one.qps, one.status) == (other.qps, other.status)
        most = max(most, np.abs(turns).max())
    np.testing.assert_allclose(found[1], reference[1], rtol=1e-6, atol=1e-12)
    return most


@each_candidate
@each_observer
def test_a_robot_that_turns_many_times_loses_nothing(observer, candidate):
    y, u = record(2.0, 60)
    assert (np.abs(np.diff(wrapped(y)[:, 2:], axis=0)) > PI).sum(axis=0).min() > 15
    lower = {"disturbance_matrix": np.array([[1.0, 0.0], [0.5, 0.0], [0.0, 1.0]])}
    options = {"observer": observer, "candidate": candidate}
    for arrival, more, w in (
        ("smoothed", lower, 4e-4 * np.eye(2)), ("observer", {}, 4e-4 * np.eye(3)),
    ):
        options |= {"arrival": arrival, "w": w}
        expected = follow(estimator(plain(**more, **SLOPES), **options), y, u)
        found = follow(estimator(wrapping(**more, **SLOPES), **options), wrapped(y), u)
        assert assert_same_errors(found, expected, 1e-7 if more else 1e-9) > 15
    # States may go on where only the measurement wraps, and functions do what angles do.
    for residuals in (ANGLES, FUNCTIONS):
        found = follow(estimator(plain(**residuals, **SLOPES), **options), wrapped(y), u)
        assert assert_same_errors(found, expected, 1e-9) == 0.0


def test_degrees_and_turns_side_by_side():
    residual = qpmhe.angles([0, 2], period=[360.0, 1.0])
    np.testing.assert_allclose(
        residual([[359.0, 7.0, 0.9], [-170.0, 7.0, 0.2]], [1.0, -7.0, 0.1]),
        [[-2.0, 14.0, -0.2], [-171.0, 14.0, 0.1]],
    )
    for half in ([180.0, 0.0, 0.5], [-180.0, 0.0, -0.5]):
        assert residual(half, np.zeros(3)).tolist() == [-180.0, 0.0, -0.5]


@pytest.mark.parametrize("h", [lambda x: np.arctan2(np.sin(x), np.cos(x)), lambda x: turned(x, 0)])
def test_jacobians_do_not_see_the_jump(h):
    """Numerical ones at the seam and inwards from a bound there, and given ones in their check."""
    one, angle = {"n": 1, "p": 1}, {name: qpmhe.angles([0]) for name in ANGLES}
    system, jumping = qpmhe.System(h, h, **one, **angle), qpmhe.System(h, h, **one)
    bounded = qpmhe.System(h, h, states=qpmhe.Box([PI - 1e-9], [PI + 0.1]), **one, **angle)
    for at in (PI, -PI, np.nextafter(PI, 0.0), 3.0 * PI, PI - 1e-7):
        for jacobian in (system.f_jacobian, system.h_jacobian):
            np.testing.assert_allclose(jacobian(np.array([at]), np.zeros(0)), [[1.0]], rtol=1e-8)
    at_bound = bounded.f_jacobian(np.array([PI - 1e-9]), np.zeros(0))
    np.testing.assert_allclose(at_bound, [[1.0]], rtol=1e-6)
    assert abs(jumping.h_jacobian(np.array([PI]), np.zeros(0))[0, 0]) > 1e4
    given = qpmhe.System(
        h, h, h_jacobian=lambda x: [[1.0]], f_jacobian=lambda x: [[1.0]], scales=[1.0],
        **one, **angle,
    )
    given.check(np.array([PI]), np.zeros(0))


# A compass needle in degrees, seen directly, with a rate; its bounds lie across the seam.

NEEDLE = {"prior": np.diag([25.0, 1.0]), "disturbance": np.diag([1.0, 0.1]), "noise": [[4.0]]}
INJECTION = qpmhe.OutputInjection(lambda z, v: [0.5 * v[0], 0.05 * v[0]])
ACROSS = qpmhe.Box([170.0, -9.0], [190.0, 9.0])


def degrees(angle):
    return (angle + 180.0) % 360.0 - 180.0


def compass(states=None, wraps=True, turn=0.0, **options):
    def f(x):
        angle = x[..., 0] + x[..., 1] + turn
        return np.stack((degrees(angle) if wraps else angle, 0.9 * x[..., 1]), axis=-1)

    angle = {name: qpmhe.angles(0, 360.0) for name in ANGLES} if wraps else {}
    return qpmhe.System(
        f, lambda x: degrees(x[..., :1]) if wraps else x[..., :1], n=2, p=1, states=states,
        **angle, **options,
    )


def needle(system, observer=None, start=180.0, **options):
    return qpmhe.MovingHorizonEstimator(
        system, observer or qpmhe.Luenberger([0.5, 0.05]),
        qpmhe.QuadraticCost.from_covariances(**NEEDLE), initial_state=[start, 0.0],
        **{"horizon": 6, "max_qps": 3} | options,
    )


def needle_record(steps=60):
    t = np.arange(steps)
    noise = np.random.default_rng(1).normal(0.0, 2.0, steps)
    return (180.0 + 12.0 * np.sin(0.2 * t) + noise)[:, None]


@pytest.mark.parametrize(("observer", "options"), [
    (None, {}), (INJECTION, {"candidate": "reinitialized"}),
    (qpmhe.ExtendedKalman(**NEEDLE), {"warm_start": True, "max_qps": 1, "arrival": "smoothed"}),
    (qpmhe.UnscentedKalman(**NEEDLE), {"candidate": "reinitialized", "horizon": 2}),
])
@pytest.mark.parametrize("sets", [
    {"states": qpmhe.Box([170.0, -INF], [190.0, INF])},
    {"states": ACROSS & qpmhe.Polytope([[0.0, 1.0]], [2.0])},
    {"disturbances": qpmhe.Box([-0.6, -1.0], [0.6, 1.0]), "noises": qpmhe.Box([-2.5], [2.5])},
    {"disturbances": qpmhe.Box([0.0, -1.0], [0.0, 1.0]), "states": ACROSS},
    {"disturbances": qpmhe.Polytope([[1.0, 1.0], [-1.0, 1.0]], [0.7, 0.7]), "states": ACROSS},
])
@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
def test_sets_hold_as_they_do_without_a_seam(sets, observer, options):
    y = needle_record()
    expected = needle(compass(wraps=False, **sets), observer, **options).run(y)
    run = needle(compass(**sets), observer, **options).run(degrees(y))
    error = run.states - expected.states
    if "states" not in sets:
        error[:, 0] = degrees(error[:, 0])
    assert np.abs(error).max() < 1e-6
    np.testing.assert_allclose(run.costs, expected.costs, rtol=1e-6, atol=1e-12)
    assert np.array_equal(run.flags, expected.flags)
    free = needle(compass(wraps=False), observer, **options).run(y)
    assert not np.allclose(expected.states, free.states, atol=1e-3)  # the sets bind


def test_a_state_written_in_another_turn_is_in_its_bounds():
    states = qpmhe.Box([170.0, -INF], [190.0, INF])
    mhe = needle(compass(states), start=-175.0)  # a warning would be an error
    assert mhe.initial_state.tolist() == [185.0, 0.0]
    for start in (-175.0, 185.0, 545.0):
        mhe.reset([start, 0.0])
        estimate = mhe.update([-175.0])
        assert Status.OBSERVER_PROJECTED not in estimate.status
        np.testing.assert_allclose(estimate.trajectory[:, 0], 185.0)
        assert estimate.cost < 1e-20
        np.testing.assert_allclose(estimate.filtered, [185.0, 0.0])
    # Beyond them it is not: the nearer bound.
    for start, bound in ((-160.0, 190.0), (20.0, 170.0)):
        with pytest.warns(qpmhe.ObserverWarning, match="outside of the state set"):
            mhe.reset([start, 0.0])
        assert mhe.initial_state.tolist() == [bound, 0.0]


@each_candidate
def test_projections_and_corrections_turn_the_short_way(candidate):
    states, options = qpmhe.Box([170.0, -INF], [190.0, INF]), {"max_qps": 0, "candidate": candidate}

    def first(y, start, gain, states=None, turn=0.0):
        observer = qpmhe.Luenberger([gain, 0.0]) if gain else qpmhe.ExtendedKalman(
            prior=1e6 * np.eye(2), disturbance=np.eye(2), noise=[[1.0]]
        )
        system = compass(states, turn=turn)
        return needle(system, observer, start=start, **options).update([y])

    # The prediction, -175 degrees, is inside; with the correction by 10 degrees it is not.
    one = first(-155.0, 185.0, 0.5, states)
    assert Status.OBSERVER_PROJECTED in one.status
    assert Status.PREDICTION_OUTSIDE not in one.status
    assert (one.state[0], one.disturbances[0, 0]) == (190.0, 5.0)
    # From 5 degrees over -9 to the bound at 190 the shorter way is backwards.
    one = first(157.0, 185.0, 0.5, states, 180.0)
    assert (one.state[0], one.disturbances[0, 0]) == (190.0, -175.0)
    # What has used y is beyond the turn, nearer to the other bound.
    assert first(8.0, 189.0, None, states).filtered[0] == 170.0
    # A prediction half a turn off, and a correction by 210 degrees, which is one by -150.
    one = first(150.0, -170.0, 1.0)
    assert (one.noises[0, 0], one.disturbances[0, 0], one.state[0] % 360.0) == (-40.0, -40.0, 150.0)
    one = first(30.0, 0.0, 7.0)
    assert one.disturbances[0, 0] == -150.0
    assert one.cost == pytest.approx(150.0**2 + 30.0**2 / 4.0)


def test_bounds_a_period_apart_bound_nothing():
    for lower, upper in ((-180.0, 180.0), (0.0, 360.0), (-500.0, 500.0)):
        assert compass(qpmhe.Box([lower, -INF], [upper, INF])).states is None
        partly = compass(qpmhe.Box([lower, -9.0], [upper, 9.0]))
        assert (partly.states.lower.tolist(), partly.turns) == ([-INF, -9.0], None)
    assert compass(qpmhe.Box([0.0, -9.0], [359.0, 9.0])).turns is not None


@each_candidate
def test_bounds_that_change_while_running_may_be_written_in_another_turn(candidate):
    def box(lower, upper):
        return {"states": qpmhe.Box([lower, -9.0], [upper, 9.0])}

    y, runs = needle_record(), []
    for wraps, turn in ((False, 0.0), (True, -360.0), (True, 720.0)):
        states = box(150.0 + turn, 230.0 + turn)["states"]
        mhe = needle(compass(states, wraps), candidate=candidate, start=180.0 + turn)
        data, estimates = degrees(y) if wraps else y, []
        for t, one in enumerate(data):
            low = 170.0 + 0.1 * t - 360.0 * (t % 3) * wraps
            estimates.append(mhe.update(one, bounds=box(low, low + 15.0) if t % 4 < 3 else None))
        mhe.set(bounds=box(175.0 - turn, 180.0 - turn))
        runs.append((estimates, mhe.update(data[0]).trajectory - [turn, 0.0]))
    for estimates, last in runs[1:]:
        for one, other in zip(runs[0][0], estimates, strict=True):
            assert degrees(other.state[0] - one.state[0]) == pytest.approx(0.0, abs=1e-6)
            assert other.cost == pytest.approx(one.cost, rel=1e-6)
        np.testing.assert_allclose(last, runs[0][1], atol=1e-6)


def test_bounds_that_leave_the_turn_are_refused():
    mhe = needle(compass(ACROSS))
    before = mhe.update([-179.0])
    for lower, upper in (
        (-INF, 190.0), (170.0, INF), (-20.0, 20.0), (170.0, 500.0), (-190.0, 190.0),
    ):
        with pytest.raises(SetError, match=r"component 0 of the states, an angle.*from 180\.0"):
            mhe.update([-179.0], bounds={"states": qpmhe.Box([lower, -9.0], [upper, 9.0])})
        assert mhe.time == 1
        assert np.array_equal(mhe.state, before.state)
    mhe.update([-179.0], bounds={"states": qpmhe.Box([-INF, -9.0], [INF, 9.0])})


@each_candidate
@each_observer
def test_snapshots_and_pickles_continue_bit_for_bit(observer, candidate):
    y, u = record(2.0, 40)
    seen, options = wrapped(y), {"observer": observer, "candidate": candidate}
    whole, loaded = (estimator(wrapping(FUNCTIONS), **options) for _ in range(2))
    whole.run(seen[:20], u[:20])
    state = whole.state_dict()
    loaded.load_state_dict(state)
    made = [loaded] if observer == "injection" else [loaded, pickle.loads(pickle.dumps(whole))]
    expected = whole.run(seen[20:], u[20:]).states
    for other in made:
        assert np.array_equal(other.run(seen[20:], u[20:]).states, expected)
    for different in (
        {}, ANGLES | {"output_residual": qpmhe.angles([2, 3], period=[2.0 * PI, 6.0])}
    ):
        with pytest.raises(InvalidInputError, match=r"another (output|state)_residual"):
            estimator(wrapping(different), **options).load_state_dict(state)


def from_ode(**options):
    return qpmhe.System.from_ode(rate, sight, **SIZES, dt=0.5, **options)


def from_casadi(**options):
    ca = pytest.importorskip("casadi")
    return qpmhe.from_casadi(
        lambda x, u: rate(x, u, ca), lambda x: sight(x, root=ca.sqrt, angle=ca.atan2),
        n=3, m=2, dt=0.5, compiled=False, **options,
    )


@pytest.mark.parametrize("make", [from_ode, from_casadi])
def test_steps_of_other_lengths_take_angles(make):
    y, u = record(2.0, 50)
    lengths = 0.5 + 0.02 * np.sin(np.arange(50.0))
    found = []
    for one, data in ((make(), y), (make(**ANGLES), wrapped(y))):
        mhe = estimator(one)
        found.append(
            [mhe.update(a, b, dt=c) for a, b, c in zip(data, u / 0.5, lengths, strict=True)]
        )
    for expected, estimate in zip(*found, strict=True):
        np.testing.assert_allclose(estimate.state, expected.state, rtol=1e-8, atol=1e-9)
        assert estimate.cost == pytest.approx(expected.cost, rel=1e-6)


def test_every_way_to_make_a_system_takes_angles():
    jnp, sp = pytest.importorskip("jax.numpy"), pytest.importorskip("sympy")
    control, angle = pytest.importorskip("control"), {name: qpmhe.angles([0]) for name in ANGLES}
    one, plant = sp.symbols("x:1"), control.nlsys(
        lambda t, x, u, params: -x, lambda t, x, u, params: x, inputs=0, outputs=1, states=1
    )
    for system in (
        qpmhe.from_jax(lambda x: -x, jnp.sin, n=1, p=1, dt=0.1, **angle),
        qpmhe.from_sympy([-one[0]], one, one, dt=0.1, **angle),
        qpmhe.from_control(plant, dt=0.1, **angle),
    ):
        for name in ANGLES:
            turned_once = getattr(system, name)(np.array([2.0 * PI + 0.5]), np.zeros(1))
            assert turned_once[0] == pytest.approx(0.5)


@pytest.mark.parametrize("residuals", [ANGLES, FUNCTIONS])
def test_parameters_and_errors_of_inputs_are_plain_beside_angles(residuals):
    system, generator = plain(**residuals), np.random.default_rng(1)
    for larger in (
        qpmhe.noisy_inputs(system), qpmhe.augment_parameters(
            system, nominal=[2.0], parameter_bounds=qpmhe.Box([1.5], [2.5])
        ),
    ):
        a, b = generator.uniform(-9.0, 9.0, (2, 6, larger.n))
        expected = a - b
        expected[:, :3] = system.state_residual(a[:, :3], b[:, :3])
        for found in (larger.state_residual(a, b), larger.state_residual(a[0], b[0])[None]):
            np.testing.assert_allclose(found, expected[: len(found)], atol=1e-14)


def within_half_a_turn(a, b):
    """Asks for the numbers' values, which no expression has."""
    values = np.array(a - b, float)
    for value in values.reshape(-1, values.shape[-1]):
        value[2] -= 2.0 * PI * math.floor(float(value[2]) / (2.0 * PI) + 0.5)
    return values


def test_what_takes_no_angles_refuses_them_by_name():
    for name in ANGLES:
        system = from_casadi(**{name: within_half_a_turn})
        with pytest.raises(OptionError, match=f"{name}, a function, has no C form"):
            estimator(system, engine="compiled", backend="auto")
        with pytest.raises(OptionError, match=name):
            qpmhe.codegen.write(estimator(system), "/nonexistent")
    certificates = pytest.importorskip("qpmhe.certificates")
    with pytest.raises(certificates.CertificateError, match=r"wide in the angle x\[2\].*narrower"):
        certificates.certify(
            wrapping(), qpmhe.Luenberger(GAIN),
            qpmhe.QuadraticCost.from_covariances(**COVARIANCES), horizon=5,
            region=qpmhe.Box([-1.0, -1.0, -4.0], [1.0, 1.0, 4.0]),
            inputs=qpmhe.Box([0.0, -1.0], [1.0, 1.0]),
        )


ONES = {"prior": 1.0, "disturbance": 1.0, "noise": 1.0}


def test_divergence_to_infinity_is_a_failed_stage():
    angle = {name: qpmhe.angles([0]) for name in ANGLES}
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: 1e200 * x, lambda x: x, n=1, p=1, **angle),
        qpmhe.Luenberger([0.5]), qpmhe.QuadraticCost(**ONES), horizon=3, initial_state=[0.1],
    )
    for _ in range(6):
        assert np.isfinite(mhe.update([0.3]).state).all()


@pytest.mark.parametrize("luck", ["raises", "stops", "shape", "nothing", "nan"])
def test_residual_functions_that_fail_at_some_calls_are_bad_luck(luck):
    rng, share = np.random.default_rng(2), 0.0

    def residual(a, b):
        if rng.random() < share:
            if luck == "raises":
                raise ValueError("no more")
            if luck == "stops":
                raise SystemExit(1)
            return {"shape": np.zeros(3), "nothing": None}.get(luck, (a - b) * np.nan)
        return turned(a, b)

    observers = OBSERVERS | {"luenberger": lambda **_: qpmhe.Luenberger([0.3])}
    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x, n=1, p=1, states=qpmhe.Box([-1.5], [1.5]),
        state_residual=residual, output_residual=residual,
    )
    for observer, candidate in itertools.product(
        ("luenberger", "extended", "unscented"), ("observer", "reinitialized")
    ):
        mhe = qpmhe.MovingHorizonEstimator(
            system, observers[observer](**ONES), qpmhe.QuadraticCost(**ONES), horizon=3,
            initial_state=[0.0], max_qps=2, warm_start=True, candidate=candidate,
        )
        messages = []
        for t in range(80):
            share = 0.2 if 3 <= t < 60 else 0.0
            estimate = mhe.update([np.sin(t)])
            assert mhe.time == t + 1
            assert np.isfinite(estimate.trajectory).all()
            if np.isfinite(estimate.candidate_cost):
                assert estimate.cost <= estimate.candidate_cost
            if Status.MODEL_FAILED in estimate.status:
                messages.append(estimate.message)
        assert not estimate.status & (Status.MODEL_FAILED | Status.FAILED_STAGE)
        assert messages
        assert luck != "raises" or any("no more" in message for message in messages)
        share = 0.0


EXPECTED = "expected the same change"


RESIDUALS = [
    (5, ModelError, "expected qpmhe.angles"),
    (lambda a, b: a - b + 0.1, ModelError, r"\[0.1, .* at a = b = .*expected zeros"),
    (lambda a, b: b - a, ModelError, EXPECTED), (lambda a, b: 2.0 * (a - b), ModelError, EXPECTED),
    (lambda a, b: np.sin(a - b), ModelError, EXPECTED),
    (lambda a, b: (a - b)[:1], ModelError, r"shape \(1,\).*expected"),
    (lambda a, b: 1 / 0, ModelError, "raised ZeroDivisionError"),
    (lambda a, b: np.log(a - b), ModelError, "expected finite numbers"),
    (lambda a: a, ModelError, "takes 1 positional argument.*expected the difference a - b"),
    (lambda a, b: a[0] - b[0], ModelError, r"shape \(\) for two vectors of .*their difference"),
    (qpmhe.angles([7]), InvalidInputError, "names component 7"),
    (plain(state_residual=turned).state_residual, ShapeError, "is for 3 components; expected 4"),
]


def test_residual_functions_that_are_none():
    for residual, error, text in RESIDUALS:
        for name in ("output_residual",) if error is ShapeError else ANGLES:
            with pytest.raises(error, match=text) as caught:
                plain(**{name: residual})
            assert name in str(caught.value)


def test_angles_that_are_none():
    indices = r"indices is .*expected one or more integers >= 0"
    for error, text, *arguments in (
        *((InvalidInputError, indices, one)
          for one in ([], [[0, 1]], [-1], [0.5], [True], "x", None, [1, None])),
        (InvalidInputError, r"\[2, 0, 2\], which names a component twice", [2, 0, 2]),
        *((OptionError, "period", [0, 1], one) for one in (0.0, -1.0, INF, np.nan, [1.0, -2.0])),
        (ShapeError, "period", [0, 1], [1.0, 2.0, 3.0]),
        (InvalidInputError, "period", [0, 1], "a"),
    ):
        with pytest.raises(error, match=text):
            qpmhe.angles(*arguments)


@pytest.mark.parametrize("residual", [qpmhe.angles([2]), turned])
def test_sets_that_mean_nothing_on_a_circle(residual):
    below = qpmhe.Box([-INF] * 3, [INF, INF, 1.0])
    for states, text in (
        (below, "component 2, an angle, by lower -inf and upper 1.0"),
        (qpmhe.Box([-1.0, -1.0, 0.0], [1.0, 1.0, INF]),
         "component 2, an angle, by lower 0.0 and upper inf"),
        (qpmhe.Polytope([[1.0, 1.0, 0.0], [0.0, 1.0, 2.0]], [5.0, 5.0]), "row [01] of the matrix"),
    ):
        with pytest.raises(SetError, match=text):
            plain(states=states, state_residual=residual)
    # Of W and V they do mean something.
    plain(disturbances=below, noises=qpmhe.Polytope([[0.0, 1.0, 1.0, 0.0]], [1.0]), **ANGLES)
