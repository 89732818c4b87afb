"""Parameters that a window does not see: held, without drift and without getting stiff."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.monitor import _barred
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError, ShapeError

from .spoil import check

DT = 0.1
PRIOR = np.array([1.0, 0.5])  # standard deviations of speed and of gain
NOISE, WANDER = 0.05, 0.01
HORIZON = 10
# Seen; unseen for ten horizons, in which the gain changes after five; seen again.
UNSEEN, CHANGE, AGAIN, END = (k * HORIZON for k in (5, 11, 16, 19))


def estimator(hold, drift=0.1, gain=None, scales=(1.0, 1.0, 1.0), drifting=True, **options):
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
        observer, prior = qpmhe.Luenberger([[0.3], [gain]]), covariances["prior"]
    cost = qpmhe.QuadraticCost.from_covariances(**covariances | {"prior": prior})
    options = {"horizon": HORIZON, "initial_state": [0.0, sg], "max_qps": 2} | options
    return qpmhe.MovingHorizonEstimator(system, observer, cost, **options)


def record(seed):
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
    y, u, gains = record(seed)
    run = estimator(*arguments, **options).run(y, u)
    assert (run.costs <= run.candidate_costs).all()
    found = run.states[1:, 1]
    moved = np.abs(found[UNSEEN:AGAIN] - found[UNSEEN - 1]).max()
    later = AGAIN + 2 * HORIZON - 1
    return moved / PRIOR[1], np.abs(found[later] - gains[later]) / PRIOR[1]


@pytest.mark.parametrize("seed", range(3))
def test_an_unseen_parameter_neither_drifts_nor_gets_stiff(seed):
    moved, _ = drift_and_error(seed, None, 0.1)
    assert moved > 1.0
    _, error = drift_and_error(seed, None, 1e-3)
    assert error > 0.5
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
    mhe, (y, u, _) = estimator(0.1), record(0)
    mhe.run(y[:UNSEEN], u[:UNSEEN])
    mhe.run([None] * HORIZON, np.ones((HORIZON, 1)))
    target = mhe.hold.target
    assert abs(target[0] - 1.3) < 0.5 * PRIOR[1]
    np.testing.assert_allclose(mhe.hold.weight, [[1.0 / (0.1 * PRIOR[1]) ** 2]], rtol=1e-12)
    for _ in range(9 * HORIZON):
        estimate = mhe.update(None, [1.0])
        np.testing.assert_array_equal(mhe.hold.target, target)
        np.testing.assert_array_equal(mhe.hold.values, [0.0])
        np.testing.assert_array_equal(mhe.hold.shares, [1.0])
        assert abs(estimate.trajectory[0, 1] - target[0]) < 0.02 * PRIOR[1]


def test_a_reset_trusts_the_new_start():
    (y, u, _), mhe = record(1), estimator({0: 0.1})
    mhe.run(y[:9], u[:9])
    mhe.reset([0.0, 0.8])
    assert mhe.hold is None
    mhe.update(y[0], u[0])
    np.testing.assert_array_equal(mhe.hold.target, [0.8])


def test_snapshots_of_other_holds_and_damaged_ones_are_refused():
    y, u, _ = record(2)
    for engine in ("python", "compiled")[: 1 + (find_compiler() is not None)]:
        mhe = estimator(0.1, engine=engine)
        mhe.run(y[:14], u[:14])
        assert mhe.update(y[14], u[14]).message == ""
        state = mhe.state_dict()
        for hold in (None, 0.2):
            other = estimator(hold, engine=engine)
            check(InvalidInputError, ["another"], other.load_state_dict, state)
        if engine == "python":
            state["window/trusted"][...] = np.nan
        else:
            state["memory"].view(mhe._engine._memory.dtype)["trusted"] = np.nan
        check(InvalidInputError, ["damaged"], mhe.load_state_dict, state)


@pytest.mark.parametrize("exponents", [(9, -14, 4), (-20, 7, -3)])
def test_no_unit_matters(exponents):
    scales, (y, u, _) = np.ldexp(1.0, exponents), record(5)
    expected = estimator(0.1, engine="python").run(y, u)
    found = estimator(0.1, scales=scales, engine="python").run(scales[2] * y, u)
    np.testing.assert_allclose(found.states / scales[:2], expected.states, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.costs, expected.costs, rtol=1e-12, atol=1e-12)


def test_sensitivity_has_the_hold():
    """By the newest measurement, on which neither target nor weight rests here."""
    y, u, _ = record(6)
    mhe = estimator(0.1, max_qps=None, tolerance=1e-15)
    mhe.run(y[: UNSEEN + 8], u[: UNSEEN + 8])
    state, k = mhe.state_dict(), UNSEEN + 8
    mhe.update(y[k], u[k])
    assert mhe.hold.shares[0] > 0.05
    found = mhe.sensitivity().measurements[-1, :, -1, 0]
    ends = []
    for step in (1e-4, -1e-4):
        mhe.load_state_dict(state)
        ends.append(mhe.update(y[k] + step, u[k]).state)
    np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-4, rtol=1e-5, atol=1e-9)


def same(x, theta):
    return x


def augmented(hold, nominal=(1.0, 2.0, 3.0), estimated=(0, 2)):
    return qpmhe.augment_parameters(
        same, same, n=1, p=1, nominal=nominal, estimated=estimated, hold=hold
    )


def test_what_is_held_survives_pickles_and_further_augmentations():
    system = augmented({2: 0.2})
    assert pickle.loads(pickle.dumps(system)).held == system.held == {2: 0.2}
    system = estimator({0: 0.2}).system
    assert qpmhe.noisy_inputs(system).held == {1: 0.2}
    again = qpmhe.augment_parameters(system, nominal=[0.0], hold=0.3)
    assert again.held == {1: 0.2, 2: 0.3}


def test_the_theorem_does_not_cover_it():
    assert _barred(estimator(None)) == ""
    assert "without hold" in _barred(estimator(0.1))


def test_bad_holds_are_refused():
    for hold, kind, text in (
        (0.0, InvalidInputError, ["hold is 0.0", "above 0"]),
        ([0.1, np.nan], InvalidInputError, ["hold is nan"]),
        ([0.1, np.inf], InvalidInputError, ["hold is inf", "omit it"]),
        (True, InvalidInputError, ["hold is True"]),
        ({0: "stiff"}, InvalidInputError, ["hold is 'stiff'"]),
        ([0.1], ShapeError, ["expected one number, or (2,)"]),
        ([[0.1, 0.1]], ShapeError, ["shape (1, 2)"]),
        ({1: 0.1}, InvalidInputError, ["key 1, which is not an estimated parameter", "[0, 2]"]),
        ({"inertia": 0.1}, InvalidInputError, ["key 'inertia'"]),
        ({True: 0.1}, InvalidInputError, ["key True"]),
        ({-1: 0.1}, InvalidInputError, ["key -1"]),
    ):
        check(kind, text, augmented, hold)
    check(InvalidInputError, ["no parameter is estimated"], augmented, 0.1, [1.0], [])
