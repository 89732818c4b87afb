"""States beside the state: unknown parameters, those that are held, and errors of inputs."""

import pickle

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares

import qpmhe
from qpmhe import Box, Luenberger, MovingHorizonEstimator, Polytope, QuadraticCost, Status
from qpmhe.certificates.monitor import _barred
from qpmhe.errors import InvalidInputError, ShapeError
from qpmhe_solvers import backend

from .plain import spd
from .spoil import check

DT = 0.1
TRUE, NOMINAL = np.array([3.0, 0.8]), [2.0, 0.8]  # stiffness and damping
START = np.array([1.0, 0.0])
POSITION_EXACT = Box([0.0, -np.inf], [0.0, np.inf])


def spring(x, theta):
    """Position is the exact sum of speeds; batched."""
    force = -theta[..., 0] * x[..., 0] - theta[..., 1] * x[..., 1]
    return x + DT * np.stack([x[..., 1], force], axis=-1)


def position(x, theta):
    return x[..., 0]


def spring_record(steps=40, disturbance=0.0):
    generator = np.random.default_rng(0)
    states, outputs = [START], []
    for _ in range(steps):
        outputs.append(states[-1][0] + 1e-3 * generator.normal())
        kick = np.array([0.0, disturbance * generator.normal()])
        states.append(spring(states[-1], TRUE) + kick)
    return np.array(states), np.array(outputs)


def spring_mhe(gain=(0.0, -0.05, 0.0), disturbances=POSITION_EXACT, bounds=None, **options):
    system = qpmhe.augment_parameters(
        spring, position, n=2, p=1, nominal=NOMINAL, estimated=[0], disturbances=disturbances,
        parameter_bounds=bounds,
    )
    cost = QuadraticCost(prior=np.diag([10.0, 10.0, 1e-3]), disturbance=1e4 * np.eye(3), noise=1e6)
    return MovingHorizonEstimator(
        system, Luenberger(gain), cost, initial_state=[*START, NOMINAL[0]],
        **{"horizon": 15, "max_qps": None} | options,
    )


def checked(mhe, outputs):
    """All estimates, each held to the promises that are made of every one."""
    estimates = [mhe.update(y) for y in outputs]
    for estimate in estimates:
        x, w = estimate.trajectory, estimate.disturbances
        assert estimate.cost <= estimate.candidate_cost
        assert not estimate.dropped
        assert mhe.system.disturbances.violation(w) <= 1e-8
        assert mhe.system.states is None or mhe.system.states.violation(x) <= 1e-8
        assert np.ptp(x[:, 2:], axis=0).max() <= 1e-12
    return estimates


@pytest.mark.parametrize(
    "options", [{}, {"candidate": "reinitialized", "infeasible": "keep_candidate"}], ids=str
)
@pytest.mark.parametrize("gain", [0.0, 0.5])  # of the parameter, which no gain may move
def test_an_unknown_constant_is_recovered(gain, options):
    states, outputs = spring_record()
    estimates = checked(spring_mhe((0.0, -0.05, gain), **options), outputs)
    if not options:
        outside = [Status.CANDIDATE_OUTSIDE in estimate.status for estimate in estimates]
        assert any(outside) is bool(gain)
    late = np.array([estimate.state for estimate in estimates[20:]])
    np.testing.assert_allclose(late[:, 2], TRUE[0], rtol=0.05)
    np.testing.assert_allclose(late[:, :2], states[21:], atol=0.02)


def test_the_estimate_is_the_minimum_over_state_parameter_and_noisy_disturbance():
    _, outputs = spring_record(8, disturbance=0.02)
    estimate = checked(spring_mhe(tolerance=1e-14), outputs)[-1]

    def residuals(unknown):
        x, theta, kicks = unknown[:2], np.array([unknown[2], NOMINAL[1]]), unknown[3:]
        offset = np.append(x - START, unknown[2] - NOMINAL[0])
        parts = [np.sqrt([10.0, 10.0, 1e-3]) * offset, 1e2 * kicks]
        for y, kick in zip(outputs, kicks, strict=True):
            parts.append([1e3 * (y - x[0])])
            x = spring(x, theta) + np.array([0.0, kick])
        return np.concatenate(parts)

    begin = np.concatenate((START, NOMINAL[:1], np.zeros(8)))
    best = least_squares(residuals, begin, xtol=1e-15, ftol=1e-15, gtol=1e-12)
    assert estimate.cost == pytest.approx(2.0 * best.cost, rel=1e-7)
    np.testing.assert_allclose(estimate.trajectory[0], best.x[:3], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", qpmhe.solvers.available())
def test_every_backend_keeps_parameters_constant(name):
    states, outputs = spring_record(18)
    options = {"horizon": 12, "backend": name, "max_qps": 5}
    mhe = spring_mhe((0.3, 0.3, 0.0), **options)  # the gain moves what has no noise
    # Of a problem scaled like this one, ecos brings nothing useful now and then.
    last = [estimate for estimate in checked(mhe, outputs) if estimate.improved][-1]
    assert last.time >= len(outputs) - (4 if name == "ecos" else 1)
    np.testing.assert_allclose(last.state[:2], states[last.time + 1], atol=0.1)
    if backend(name).inequalities:
        mhe = spring_mhe(bounds=Box([1.5], [2.4]), **options)
        # The true value, 3, is outside: the bound binds.
        assert checked(mhe, outputs)[-1].state[2] == pytest.approx(2.4, abs=1e-3)


def test_sets_are_products_and_numbers_are_copies():
    nominal = np.array(NOMINAL)
    states, bounds = Polytope([[1.0, 1.0]], [1.0]), Polytope([[2.0], [-1.0]], [8.0, 0.0])
    for estimated in (0, [True, False]):
        system = qpmhe.augment_parameters(
            spring, position, n=2, p=1, nominal=nominal, estimated=estimated, states=states,
            disturbances=states, parameter_bounds=bounds,
        )
        for z in np.random.default_rng(2).normal(scale=3.0, size=(200, 3)):
            miss = states.violation(z[:2]), bounds.violation(z[2:])
            assert system.states.violation(z) == pytest.approx(max(miss))
            assert system.disturbances.violation(z) == pytest.approx(max(miss[0], abs(z[2])))
    nominal[:] = np.nan
    z = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(system.f(z, np.zeros(0)), [*spring(z[:2], TRUE), 3.0], rtol=1e-14)


def careless(x, theta):
    theta[0] = 1.0
    return x


WRONG = [
    ({"nominal": []}, "ShapeError", r"shape \(0,\); expected \(k,\)"),
    ({"nominal": [None, 1.0]}, "InvalidInputError",
     r"nominal\[0\] is nan: the parameter has no prior value"),
    ({"nominal": [2.0]}, "ModelError", r"IndexError.*theta = \[2.0\].*Check nominal"),
    ({"estimated": [-1]}, "InvalidInputError", "names parameter -1; expected .* 0 to 1"),
    ({"estimated": [1, 1]}, "InvalidInputError", r"\[1, 1\], which names one parameter twice"),
    ({"estimated": [True]}, "ShapeError", r"mask of shape \(1,\); expected \(2,\)"),
    ({"parameter_bounds": Box([0.0, 1.0], [9.0, 9.0])}, "SetError",
     r"nominal is \[2.0, 0.8\].*outside parameter_bounds"),
    ({"parameter_bounds": Box([0.0] * 2, [9.0] * 2).soften(linear=1.0)}, "SetError",
     "is soft; an augmented model takes only hard sets"),
    ({"m": 1}, "ModelError", r"f\(x, theta\) cannot be called as f\(x, u, theta\).*1 inputs"),
    ({"h": lambda x, theta: x}, "ModelError", r"h returned shape \(2,\).*expected \(1,\)"),
    ({"f": careless}, "ModelError", "changes its argument in place"),
    ({"method": "rk4"}, "OptionError", "method is 'rk4', but dt is missing"),
    ({"drifting": "yes"}, "OptionError", "drifting is 'yes'; expected True or False"),
]


def test_wrong_arguments_are_named():
    for changes, error, words in WRONG:
        given = {"f": spring, "h": position, "n": 2, "p": 1, "nominal": NOMINAL} | changes
        with pytest.raises(getattr(qpmhe.errors, error), match=words):
            qpmhe.augment_parameters(**given)


# Errors of inputs


@pytest.mark.parametrize("horizon", [1, 5])
@pytest.mark.parametrize("noisy", [[0, 1], [1]], ids=str)
def test_noisy_inputs_are_the_kalman_filters_with_their_covariance(noisy, horizon):
    """Its process noise is Q + B Qu B'."""
    rng, n, k = np.random.default_rng(horizon), 3, len(noisy)
    a, B, C = rng.standard_normal((n, n)), rng.standard_normal((n, 2)), rng.standard_normal((2, n))
    A = a * (0.95 / np.abs(np.linalg.eigvals(a)).max())
    S, Q, R, Qu, z = spd(rng, n), 0.1 * spd(rng, n), spd(rng, 2), spd(rng, k), np.zeros(n)
    plant = qpmhe.System(lambda x, u: x @ A.T + u @ B.T, lambda x: x @ C.T, n=n, p=2, m=2)
    covariances = {"disturbance": block_diag(Q, Qu), "noise": R}
    mhe = MovingHorizonEstimator(
        qpmhe.noisy_inputs(plant, noisy),
        qpmhe.ExtendedKalman(prior=block_diag(S, Qu), **covariances),
        QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **covariances),
        horizon=horizon, initial_state=np.zeros(n + k),
    )
    U, Y = rng.standard_normal((40, 2)), 3.0 * rng.standard_normal((40, 2))
    for t, (y, u) in enumerate(zip(Y, U, strict=True)):
        estimate, gain = mhe.update(y, u), S @ C.T @ np.linalg.inv(C @ S @ C.T + R)
        z, S = z + gain @ (y - C @ z), S - gain @ C @ S
        np.testing.assert_allclose(estimate.filtered[:n], z, rtol=1e-9, atol=1e-9)
        z, S = A @ z + B @ u, A @ S @ A.T + Q + B[:, noisy] @ Qu @ B[:, noisy].T
        np.testing.assert_allclose(estimate.state[:n], z, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            mhe.covariances()[-1], block_diag(S, Qu), rtol=1e-8, atol=1e-9
        )
        # What the estimate calls e is what it needs besides w to explain the record.
        x, e = estimate.trajectory[:, :n], estimate.trajectory[:, n:]
        inputs = U[t + 2 - len(x) : t + 1].copy()
        inputs[:, noisy] += e[:-1]
        w = x[1:] - x[:-1] @ A.T - inputs @ B.T
        np.testing.assert_allclose(estimate.disturbances, np.hstack((w, e[1:])), atol=1e-11)
        assert np.abs(e[-1]).max() < 1e-9  # no measurement has seen it yet


# Parameters that a window does not see are held, without drift and without getting stiff.

PRIOR = np.array([1.0, 0.5])  # standard deviations of speed and of gain
NOISE, WANDER, HORIZON = 0.05, 0.01, 10
# Seen; unseen for ten horizons, in which the gain changes after five; seen again.
UNSEEN, CHANGE, AGAIN, END = (k * HORIZON for k in (5, 11, 16, 19))


def motor(hold, drift=0.1, gain=None, scales=(1.0, 1.0, 1.0), drifting=True, **options):
    """Of a motor's speed and gain: with a Kalman filter, or with a constant gain and weight."""
    sx, sg, sy = scales
    states = np.array([sx, sg])
    system = qpmhe.augment_parameters(
        lambda x, u, g: -0.5 * x + (g / sg) * u * sx, lambda x, u, g: x / sx * sy,
        n=1, p=1, m=1, dt=DT, nominal=[sg], hold=hold, drifting=drifting,
    )
    covariances = {
        "prior": np.diag((PRIOR * states) ** 2),
        "disturbance": np.diag(([WANDER, drift] * states) ** 2), "noise": [[(NOISE * sy) ** 2]],
    }
    observer, prior = qpmhe.ExtendedKalman(**covariances), qpmhe.ObserverPrior()
    if gain is not None:
        observer, prior = Luenberger([[0.3], [gain]]), covariances["prior"]
    cost = QuadraticCost.from_covariances(**covariances | {"prior": prior})
    options = {"horizon": HORIZON, "initial_state": [0.0, sg], "max_qps": 2} | options
    return MovingHorizonEstimator(system, observer, cost, **options)


def motor_record(seed):
    """Measurements, inputs and gains; while unseen, a little current that does nothing."""
    generator, x = np.random.default_rng(seed), 0.0
    t = np.arange(END)
    gains = np.where(t < CHANGE, 1.3, 0.7)
    steady = (t >= UNSEEN) & (t < AGAIN)
    u = np.where(steady, 0.0, np.sign(np.sin(t / 4.0)))
    y = np.empty(END)
    for k in t:
        y[k] = x + NOISE * generator.standard_normal()
        x += DT * (-0.5 * x + gains[k] * u[k]) + 0.3 * WANDER * generator.standard_normal()
    return y, (u + 0.02 * steady)[:, None], gains


def drift_and_error(seed, *arguments, **options):
    """In deviations of the prior: how far the gain moves while unseen, and its later error."""
    y, u, gains = motor_record(seed)
    found = motor(*arguments, **options).run(y, u).states[1:, 1]
    moved = np.abs(found[UNSEEN:AGAIN] - found[UNSEEN - 1]).max()
    later = AGAIN + 2 * HORIZON - 1
    return moved / PRIOR[1], np.abs(found[later] - gains[later]) / PRIOR[1]


@pytest.mark.parametrize("seed", range(3))
def test_an_unseen_parameter_neither_drifts_nor_gets_stiff(seed):
    assert drift_and_error(seed, None, 0.1)[0] > 1.0
    assert drift_and_error(seed, None, 1e-3)[1] > 0.5
    moved, error = drift_and_error(seed, 0.1, 0.1)
    assert moved < 0.6
    assert error < 0.3


def test_an_unseen_parameter_does_not_fall_back_to_the_observers():
    for gain, drifting in ((0.0, True), (0.1, False)):
        free, _ = drift_and_error(0, None, 0.02, gain, drifting=drifting)
        moved, error = drift_and_error(0, 0.1, 0.02, gain, drifting=drifting)
        assert free > 0.5
        assert moved < 0.5 * free
        assert error < 0.3


def test_nothing_is_measured_for_ten_horizons():
    mhe, (y, u, _) = motor(0.1), motor_record(0)
    mhe.run(y[:UNSEEN], u[:UNSEEN])
    mhe.run([None] * HORIZON, np.ones((HORIZON, 1)))
    target = mhe.hold.target
    assert abs(target[0] - 1.3) < 0.5 * PRIOR[1]
    for _ in range(9 * HORIZON):
        estimate = mhe.update(None, [1.0])
        np.testing.assert_array_equal(mhe.hold.target, target)
        np.testing.assert_array_equal((*mhe.hold.values, *mhe.hold.shares), (0.0, 1.0))
        assert abs(estimate.trajectory[0, 1] - target[0]) < 0.02 * PRIOR[1]
    mhe.reset([0.0, 0.8])  # trusts the new start
    assert mhe.hold is None
    mhe.update(y[0], u[0])
    np.testing.assert_array_equal(mhe.hold.target, [0.8])


def test_no_unit_of_a_held_parameter_matters():
    scales, (y, u, _) = np.ldexp(1.0, [9, -14, 4]), motor_record(5)
    expected = motor(0.1, engine="python").run(y, u)
    found = motor(0.1, scales=scales, engine="python").run(scales[2] * y, u)
    np.testing.assert_allclose(found.states / scales[:2], expected.states, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.costs, expected.costs, rtol=1e-12, atol=1e-12)


def test_sensitivity_has_the_hold():
    """By the newest measurement, on which neither target nor weight rests here."""
    (y, u, _), k, ends = motor_record(6), UNSEEN + 8, []
    mhe = motor(0.1, max_qps=None, tolerance=1e-15)
    mhe.run(y[:k], u[:k])
    state = mhe.state_dict()
    mhe.update(y[k], u[k])
    assert mhe.hold.shares[0] > 0.05
    found = mhe.sensitivity().measurements[-1, :, -1, 0]
    for step in (1e-4, -1e-4):
        mhe.load_state_dict(state)
        ends.append(mhe.update(y[k] + step, u[k]).state)
    np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-4, rtol=1e-5, atol=1e-9)


def held(hold, nominal=(1.0, 2.0, 3.0), estimated=(0, 2)):
    return qpmhe.augment_parameters(
        lambda x, theta: x, lambda x, theta: x, n=1, p=1, nominal=nominal, estimated=estimated,
        hold=hold,
    )


def test_what_is_held_goes_along_and_is_refused_where_it_does_not_fit():
    assert held({2: 0.2}).held == {2: 0.2}
    system = motor({0: 0.2}).system
    assert qpmhe.noisy_inputs(system).held == {1: 0.2}
    again = qpmhe.augment_parameters(system, nominal=[0.0], hold=0.3)
    assert again.held == {1: 0.2, 2: 0.3}
    # The theorem does not cover it.
    assert _barred(motor(None)) == ""
    assert "without hold" in _barred(motor(0.1))
    mhe, (y, u, _) = motor(0.1, engine="python"), motor_record(2)
    mhe.run(y[:14], u[:14])
    state = pickle.loads(pickle.dumps(mhe.state_dict()))
    for hold in (None, 0.2):
        other = motor(hold, engine="python")
        check(InvalidInputError, ["another"], other.load_state_dict, state)
    state["window/trusted"][...] = np.nan
    check(InvalidInputError, ["damaged"], mhe.load_state_dict, state)
    for hold, kind, text in (
        (0.0, InvalidInputError, ["hold is 0.0", "above 0"]),
        ([0.1, np.inf], InvalidInputError, ["hold is inf", "omit it"]),
        ({0: "stiff"}, InvalidInputError, ["hold is 'stiff'"]),
        ([[0.1, 0.1]], ShapeError, ["shape (1, 2)"]),
        ({1: 0.1}, InvalidInputError, ["key 1, which is not an estimated parameter", "[0, 2]"]),
        ({True: 0.1}, InvalidInputError, ["key True"]),
    ):
        check(kind, text, held, hold)
    check(InvalidInputError, ["no parameter is estimated"], held, 0.1, [1.0], [])
