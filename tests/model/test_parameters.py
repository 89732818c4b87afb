"""States beside the state: unknown parameters, those that are held, and errors of inputs."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares

import qpmhe
from qpmhe import Box, Luenberger, MovingHorizonEstimator, QuadraticCost
from qpmhe.certificates.monitor import _barred
from qpmhe.errors import InvalidInputError
from tests.estimation.plain import spd
from tests.estimation.spoil import check

PRIOR = np.array([1.0, 0.5])  # standard deviations of speed and of gain
DT, NOISE, WANDER, HORIZON = 0.1, 0.05, 0.01, 10
# Seen; unseen for ten horizons, in which the gain changes after five; seen again.
UNSEEN, CHANGE, AGAIN, END = (k * HORIZON for k in (5, 11, 16, 19))


def motor(hold=None, drift=0.1, gain=None, bounds=None, **options):
    """Of a motor's speed and gain: with a Kalman filter, or with a constant gain and weight."""
    system = qpmhe.augment_parameters(
        lambda x, u, g: -0.5 * x + g * u, lambda x, u, g: x, n=1, p=1, m=1, dt=DT, nominal=[1.0],
        hold=hold, drifting=drift > 0.0, parameter_bounds=bounds, method="euler",
    )
    covariances = {
        "prior": np.diag(PRIOR**2), "disturbance": np.diag([WANDER**2, (drift or 1.0) ** 2]),
        "noise": NOISE**2,
    }
    observer, prior = qpmhe.ExtendedKalman(**covariances), qpmhe.ObserverPrior()
    if gain is not None:
        observer, prior = Luenberger([[0.3], [gain]]), covariances["prior"]
    cost = QuadraticCost.from_covariances(**covariances | {"prior": prior})
    options = {"horizon": HORIZON, "initial_state": [0.0, 1.0], "max_qps": 2} | options
    return MovingHorizonEstimator(system, observer, cost, **options)


def record(seed, count=END):
    """Measurements, inputs and gains; while unseen, a little current that does nothing."""
    generator, x, t = np.random.default_rng(seed), 0.0, np.arange(END)
    gains = np.where(t < CHANGE, 1.3, 0.7)
    steady = (t >= UNSEEN) & (t < AGAIN)
    u = np.where(steady, 0.0, np.sign(np.sin(t / 4.0)))
    y = np.empty(END)
    for k in t:
        y[k] = x + NOISE * generator.standard_normal()
        x += DT * (-0.5 * x + gains[k] * u[k]) + 0.3 * WANDER * generator.standard_normal()
    return y[:count], (u + 0.02 * steady)[:count, None], gains


def constant(mhe, y, u):
    """The last estimate; in all of them the parameter is constant, and no row is dropped."""
    for estimate in map(mhe.update, y, u):
        assert estimate.cost <= estimate.candidate_cost
        assert not estimate.dropped
        assert np.ptp(estimate.trajectory[:, 1]) <= 1e-12
        assert mhe.system.states is None or mhe.system.states.violation(estimate.trajectory) <= 1e-8
    return estimate


@pytest.mark.parametrize("candidate", ["observer", "reinitialized"])
@pytest.mark.parametrize("gain", [None, 0.0, 0.5])  # of the parameter, which no gain may move
def test_an_unknown_constant_is_recovered(gain, candidate):
    y, u, _ = record(0, UNSEEN)
    mhe = motor(drift=0.0, gain=gain, candidate=candidate, horizon=30, max_qps=None)
    assert abs(constant(mhe, y, u).state[1] - 1.3) < 0.1


def spring(x, theta):
    return np.stack([x[..., 1], -theta[..., 0] * x[..., 0] - theta[..., 1] * x[..., 1]], axis=-1)


def augmented(f=spring, h=lambda x, theta: x[..., 0], **changes):
    return qpmhe.augment_parameters(f, h, **{"n": 2, "p": 1, "nominal": [2.0, 0.8]} | changes)


def careless(x, theta):
    theta[0] = 1.0
    return x


WRONG = [
    ({"nominal": [None, 1.0]}, "InvalidInputError", r"nominal\[0\] is nan: .* no prior value"),
    ({"nominal": [2.0]}, "ModelError", r"IndexError.*theta = \[2.0\].*Check nominal"),
    ({"estimated": [-1]}, "InvalidInputError", "names parameter -1; expected .* 0 to 1"),
    ({"estimated": [1, 1]}, "InvalidInputError", r"\[1, 1\], which names one parameter twice"),
    ({"parameter_bounds": Box([0.0, 1.0], [9.0, 9.0])}, "SetError", "outside parameter_bounds"),
    ({"parameter_bounds": Box([0.0] * 2, [9.0] * 2).soften(linear=1.0)}, "SetError", "is soft; "),
    ({"f": careless}, "ModelError", "changes its argument in place"),
    ({"method": "rk4"}, "OptionError", "method is 'rk4', but dt is missing"),
    ({"hold": 0.0}, "InvalidInputError", "hold is 0.0.*above 0"),
    ({"hold": {1: 0.1}, "estimated": [0]}, "InvalidInputError", "key 1, .*not an estimated param"),
    ({"hold": 0.1, "estimated": []}, "InvalidInputError", "no parameter is estimated"),
]


def test_wrong_arguments_are_named():
    for changes, error, words in WRONG:
        with pytest.raises(getattr(qpmhe.errors, error), match=words):
            augmented(**changes)


# Errors of inputs


@pytest.mark.parametrize(("noisy", "horizon"), [([0, 1], 1), ([1], 5), ([0, 1], 5)], ids=str)
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
    U, Y = rng.standard_normal((30, 2)), 3.0 * rng.standard_normal((30, 2))
    for y, u in zip(Y, U, strict=True):
        estimate, gain = mhe.update(y, u), S @ C.T @ np.linalg.inv(C @ S @ C.T + R)
        z, S = z + gain @ (y - C @ z), S - gain @ C @ S
        np.testing.assert_allclose(estimate.filtered[:n], z, rtol=1e-9, atol=1e-9)
        z, S = A @ z + B @ u, A @ S @ A.T + Q + B[:, noisy] @ Qu @ B[:, noisy].T
        np.testing.assert_allclose(estimate.state, [*z, *np.zeros(k)], rtol=1e-9, atol=1e-9)
        found, expected = mhe.covariances()[-1], block_diag(S, Qu)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)


def tank(x, u):
    """A level with a pump and a valve, both nonlinear; y sees the valve, too."""
    return x + 0.1 * (np.tanh(u[..., :1]) - u[..., 1:] * np.sqrt(1.0 + x**2))


def gauge(x, u):
    return x + 0.2 * u[..., 1:] ** 2


def test_least_squares_finds_the_minimum_with_noisy_inputs_of_a_nonlinear_plant():
    """The oracle has the errors themselves as variables, not states: x, e and nothing else."""
    horizon, rng = 6, np.random.default_rng(4)
    P, Q, R, Qu = 0.5, 0.001, 0.002, np.array([[0.05, 0.01], [0.01, 0.04]])
    root = np.linalg.cholesky(Qu)
    system = qpmhe.noisy_inputs(qpmhe.System(tank, gauge, n=1, p=1, m=2))
    cost = QuadraticCost.from_covariances(
        prior=block_diag(P, Qu), disturbance=block_diag(Q, Qu), noise=R
    )
    mhe = MovingHorizonEstimator(
        system, Luenberger([0.2, 0.0, 0.0]), cost, horizon=horizon,
        initial_state=[1.0, 0.0, 0.0], max_qps=None, tolerance=1e-14,
    )
    x, ys, us = np.array([1.5]), [], []
    for t in range(20):
        us.append([np.sin(0.3 * t), 0.5])
        acting = us[-1] + root @ rng.standard_normal(2)
        ys.append(gauge(x, acting) + np.sqrt(R) * rng.standard_normal(1))
        x = tank(x, acting) + np.sqrt(Q) * rng.standard_normal(1)
        estimate = mhe.update(ys[-1], us[-1])
        prior, y, u = estimate.candidate[0], np.array(ys[-horizon:]), np.array(us[-horizon:])

        def residuals(unknown, prior=prior, y=y, u=u):
            x, e = unknown[: len(y) + 1, None], unknown[len(y) + 1 :].reshape(-1, 2)
            off = e - np.vstack((prior[1:], np.zeros((len(y) - 1, 2))))
            return np.concatenate((
                (x[0] - prior[0]) / np.sqrt(P), np.linalg.solve(root, off.T).ravel(),
                (x[1:] - tank(x[:-1], u + e)).ravel() / np.sqrt(Q),
                (y - gauge(x[:-1], u + e)).ravel() / np.sqrt(R),
            ))

        start = np.concatenate((estimate.candidate[:, 0], estimate.candidate[:-1, 1:].ravel()))
        best = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert estimate.cost <= estimate.candidate_cost
        assert estimate.cost == pytest.approx(2.0 * best.cost, rel=1e-8)
        found = np.concatenate((estimate.trajectory[:, 0], estimate.trajectory[:-1, 1:].ravel()))
        np.testing.assert_allclose(found, best.x, atol=1e-6)


# Parameters that a window does not see are held, without drift and without getting stiff.


@pytest.mark.parametrize("seed", range(3))
def test_an_unseen_parameter_neither_drifts_nor_gets_stiff(seed):
    y, u, gains = record(seed)

    def drift_and_error(*arguments):
        found = motor(*arguments).run(y, u).states[1:, 1]
        moved = np.abs(found[UNSEEN:AGAIN] - found[UNSEEN - 1]).max()
        later = AGAIN + 2 * HORIZON - 1
        return moved / PRIOR[1], np.abs(found[later] - gains[later]) / PRIOR[1]

    assert drift_and_error(None, 0.1)[0] > 1.0
    assert drift_and_error(None, 1e-3)[1] > 0.5
    moved, error = drift_and_error(0.1, 0.1)
    assert moved < 0.6
    assert error < 0.3


def test_sensitivity_has_the_hold():
    """By the newest measurement, on which neither target nor weight rests here."""
    (y, u, _), k, ends = record(6), UNSEEN + 8, []
    mhe = motor(0.1, max_qps=None, tolerance=1e-15)
    mhe.run(y[:k], u[:k])
    state = mhe.state_dict()
    mhe.update(y[k], u[k])
    found = mhe.sensitivity().measurements[-1, :, -1, 0]
    for step in (1e-4, -1e-4):
        mhe.load_state_dict(state)
        ends.append(mhe.update(y[k] + step, u[k]).state)
    assert mhe.hold.shares[0] > 0.05
    np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-4, rtol=1e-5, atol=1e-9)


def test_what_is_held_goes_along_and_no_further():
    system = motor({0: 0.2}).system
    assert qpmhe.noisy_inputs(system).held == {1: 0.2}
    again = qpmhe.augment_parameters(system, nominal=[0.0], hold=0.3)
    assert again.held == {1: 0.2, 2: 0.3}
    # The theorem does not cover it.
    assert _barred(motor(None)) == ""
    assert "without hold" in _barred(motor(0.1))
    mhe, (y, u, _) = motor(0.1, engine="python"), record(2, 14)
    mhe.run(y, u)
    state, other = mhe.state_dict(), motor(0.2, engine="python")
    check(InvalidInputError, ["another"], other.load_state_dict, state)
    state["window/trusted"][...] = np.nan
    check(InvalidInputError, ["damaged"], mhe.load_state_dict, state)
