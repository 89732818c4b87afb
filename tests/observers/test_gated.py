"""Kalman-type observers that judge innovations, against a filter written out here."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.memory.snapshot import read, written
from tests.estimation import spoil
from tests.estimation.plain import differences, spd
from tests.estimation.spoil import check, cost_of

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
each_filter = pytest.mark.parametrize("make", [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
# 0.997 quantiles of the chi-square distributions with 1, 2 and 3 degrees, from tables.
CHI2 = {1: 8.807468, 2: 11.618286, 3: 13.931419}
DT = 0.1


def f(x):
    """A pendulum, and a constant."""
    return np.array([x[0] + DT * x[1], x[1] - DT * np.sin(x[0]) - 0.02 * x[1] * x[2], x[2]])


def h(x):
    return np.array([np.sin(x[0]), x[1] + 0.1 * x[0] ** 2, x[1], x[0] + x[2]])


P0 = np.diag([0.02, 0.05, 0.01])
Q = np.diag([1e-4, 1e-3, 1e-6])
R = 0.004 * spd(np.random.default_rng(0), 4)
START, FAR = np.array([0.5, 0.0, 0.3]), np.array([1.0, 0.6, 0.8])


def disturbed(seed, steps=90, missing=0.15):
    """Measurements with outliers, gaps, and sensor 2 off for 25 samples."""
    rng = np.random.default_rng(seed)
    x, Y = START, []
    for t in range(steps):
        y = h(x) + np.linalg.cholesky(R) @ rng.standard_normal(4)
        y += (rng.random(4) < 0.05) * rng.choice([-1.5, 1.5], 4)
        y[2] += 1.0 * (30 <= t < 55)
        y[rng.random(4) < missing] = np.nan
        Y.append(y)
        x = f(x) + np.sqrt(np.diag(Q)) * rng.standard_normal(3)
    return np.array(Y)


def watching(innovation, make=qpmhe.ExtendedKalman, **covariances):
    return make(
        **({"prior": P0, "disturbance": Q, "noise": R} | covariances), innovation=innovation
    )


def estimator(observer, start, system=None):
    system = system or qpmhe.System(f, h, n=3, p=4)
    cost = cost_of(system.n, system.p, prior=qpmhe.ObserverPrior())
    return spoil.estimator(system, observer, cost, initial_state=start, horizon=6, max_qps=0)


def conditional(S, v, given, part):
    """The squared norm of v[part] in its covariance, given v[given], by Schur complements."""
    if given:
        T = S[np.ix_(part, given)] @ np.linalg.inv(S[np.ix_(given, given)])
        mean, spread = T @ v[given], T @ S[np.ix_(given, part)]
    else:
        mean, spread = 0.0, 0.0
    rest = v[part] - mean
    return rest @ np.linalg.inv(S[np.ix_(part, part)] - spread) @ rest


def spread(P, C, scale):
    """The innovation's covariance with a scaled P."""
    return C @ scale @ P @ scale @ C.T + R


def plain_gated(z, Y, sensors, reopen):
    """States z(0..T) and rejections of a gated extended Kalman filter, one sample at a time."""
    P, counts, states, rejected = P0, [0] * len(sensors), [z], []
    for y in Y:
        A, C = differences(f, z), differences(h, z)
        v = y - h(z)
        seen = [[j for j in sensor if np.isfinite(y[j])] for sensor in sensors]
        S = C @ P @ C.T + R
        passed = [not s or conditional(S, v, [], s) <= CHI2[len(s)] for s in seen]
        late = [k for k, count in enumerate(counts) if count >= reopen and not passed[k]]
        tried = late if any(counts[k] % reopen == 0 for k in late) else []
        known = [j for k, s in enumerate(seen) if passed[k] for j in s]
        doubted = sum(len(seen[k]) for k in tried)
        opened, T = [], np.eye(3)
        for k in tried:
            part, limit = seen[k], CHI2[len(seen[k])]
            gain = P @ C[part].T
            share = np.diag(gain @ np.linalg.inv(S[np.ix_(part, part)]) @ gain.T) / np.diag(P)

            def scaled(power, share=share):
                return np.diag(np.sqrt(1.0 + (4.0**power - 1.0) * share / share.max()))

            least = next((
                power for power in range(1, 21)
                if all(v[j] ** 2 <= CHI2[1] * spread(P, C, scaled(power))[j, j] for j in part)
            ), None)
            if least is None:
                continue
            given = [] if doubted > len(known) or counts[k] >= 10 * reopen else known
            if conditional(spread(P, C, scaled(least + 1)), v, given, part) <= limit:
                opened.append(k)
                T = np.maximum(T, scaled(least + 1))
        P = T @ P @ T
        used = [j for k, s in enumerate(seen) if passed[k] or k in opened for j in s]
        rejected.append([bool(s) and not passed[k] and k not in opened for k, s in enumerate(seen)])
        counts = [
            count if not s else count + 1 if out else 0
            for count, s, out in zip(counts, seen, rejected[-1], strict=True)
        ]
        z_next = f(z)
        if used:
            K = P @ C[used].T @ np.linalg.inv(C[used] @ P @ C[used].T + R[np.ix_(used, used)])
            z_next, rest = z_next + A @ K @ v[used], np.eye(3) - K @ C[used]
            P = rest @ P @ rest.T + K @ R[np.ix_(used, used)] @ K.T
        z, P = z_next, A @ P @ A.T + Q
        P = 0.5 * (P + P.T)
        states.append(z)
    return np.array(states), np.array(rejected)


@pytest.mark.parametrize("groups", [None, [[0, 1]], [[3, 1], [0, 2]], [[0, 1, 2]]], ids=str)
def test_the_gated_filter_is_the_plain_one(groups):
    gate = qpmhe.Gate(reopen=2, groups=groups)
    mhe = estimator(watching(gate), START)
    for seed, start in ((0, START), (1, FAR), (2, FAR)):
        Y = disturbed(seed)
        states, rejected = plain_gated(start, Y, gate.sensors(4), 2)
        mhe.reset(start)
        run = mhe.run(Y)
        np.testing.assert_array_equal(run.rejected_sensors, rejected)
        # A gate of two sensors that reopens has widened P until few of its digits are left: in
        # arithmetic of 40 digits, both filters are then off by 1e-5.
        accuracy = 1e-4 if seed == 0 and groups and len(groups[0]) == 2 else 1e-10
        np.testing.assert_allclose(run.observer_states, states, rtol=accuracy, atol=accuracy)
        assert rejected.any()


A = np.array([[1.0, DT], [0.0, 1.0]])


@each_filter
@pytest.mark.parametrize("reopen", [1, 7])
def test_a_gate_that_shuts_on_the_truth_opens_after_the_stated_number(make, reopen):
    system = qpmhe.System(lambda x: A @ x, lambda x: x[:1], n=2, p=1)
    covariances = {"disturbance": np.diag([1e-6, 1e-4]), "noise": [[0.01]]}
    gate = watching(qpmhe.Gate(reopen=reopen), make, prior=0.01 * np.eye(2), **covariances)
    truth, begins = 50.0 * (np.arange(140) >= 40), 40  # the only sensor jumps for good
    Y = truth + 0.1 * np.random.default_rng(4).standard_normal(140)
    run = estimator(gate, [0.0, 0.0], system).run(Y)
    shut = run.rejected_sensors[begins:, 0]
    assert shut[:reopen].all()
    assert not shut[reopen]
    errors = np.abs(run.observer_states[:-1, 0] - truth)[begins:]
    assert errors[reopen] > 40.0
    assert errors[reopen + 1] < 15.0
    assert errors[reopen + 40 :].max() < 0.5
    assert shut[reopen + 40 :].mean() < 0.05


def test_sensors_that_pass_keep_a_faulty_one_shut():
    """At most ten times as long; and not where they are in the minority."""
    for outputs, faulty, shut in ((2, 1, 30), (3, 2, 3)):
        C, covariances = np.eye(2)[:1].repeat(outputs, 0), {"noise": 0.01 * np.eye(outputs)}
        system = qpmhe.System(lambda x: A @ x, lambda x, C=C: C @ x, n=2, p=outputs)
        covariances |= {"prior": 0.01 * np.eye(2), "disturbance": np.diag([1e-6, 1e-4])}
        Y = 0.1 * np.random.default_rng(5).standard_normal((75, outputs))
        Y[40:, :faulty] += 20.0
        run = estimator(watching(qpmhe.Gate(reopen=3), **covariances), [0.0, 0.0], system).run(Y)
        assert np.flatnonzero(~run.rejected_sensors[40:, 0])[0] == shut
        assert np.abs(run.observer_states[: 41 + shut, 0]).max() < 0.3


@each_filter
def test_without_any_sensor_the_observer_predicts_and_says_so(make):
    mhe = estimator(watching(qpmhe.Gate(reopen=1000, groups=[[0, 2]]), make), START)
    assert mhe.update([100.0, 0.0, 100.0, np.nan]).rejected_sensors == (0,)
    for y in ([50.0, 50.0, 50.0, 50.0], [50.0, np.nan, np.nan, -1e149]):
        z = mhe.observer_state
        estimate = mhe.update(y)
        assert Status.SENSORS_REJECTED | Status.ALL_REJECTED in estimate.status
        np.testing.assert_allclose(mhe.observer_state, f(z), rtol=0, atol=1e-12)
        np.testing.assert_allclose(estimate.filtered, z, rtol=0, atol=1e-12)
        assert "only predicted" in estimate.explain()
    assert estimate.rejected_sensors == (0, 2)
    assert "Rejected sensors: 0, 2" in estimate.explain()
    assert mhe.run([[50.0] * 4] * 3).share(Status.ALL_REJECTED) == 1.0


@each_filter
def test_huber_by_hand(make):
    """Each output's innovation in its own deviation; the noise grows by what its weight says."""
    C = differences(h, START)
    system = qpmhe.System(f, lambda x: C @ x, n=3, p=4)
    mhe = estimator(watching(qpmhe.HuberInnovation(1.2), make), START, system)
    estimate = mhe.update(C @ START + np.array([0.1, -2.0, np.nan, 0.9]))
    seen = [0, 1, 3]
    C, v, r = C[seen], np.array([0.1, -2.0, 0.9]), R[np.ix_(seen, seen)]
    variances = np.diag(C @ P0 @ C.T + r)
    weights = np.minimum(1.0, 1.2 * np.sqrt(variances) / np.abs(v))
    assert weights[0] == 1.0
    assert (weights[1:] < 0.7).all()
    softened = r + np.diag(variances / weights - variances)
    K = P0 @ C.T @ np.linalg.inv(C @ P0 @ C.T + softened)
    np.testing.assert_allclose(estimate.filtered, START + K @ v, rtol=0, atol=1e-12)
    if make is qpmhe.ExtendedKalman:
        expected = f(START) + differences(f, START) @ K @ v
        np.testing.assert_allclose(mhe.observer_state, expected, rtol=0, atol=1e-12)
    assert not estimate.status & (Status.SENSORS_REJECTED | Status.ALL_REJECTED)


@each_filter
def test_huber_finds_back_from_a_covariance_that_is_too_small(make):
    """Without a way back the correction would be less than 2 standard deviations a sample."""
    system = qpmhe.System(lambda x: x, lambda x: x, n=1, p=1)
    covariances = {"prior": [[1e-8]], "disturbance": [[1e-10]], "noise": [[1.0]]}
    Y = np.random.default_rng(6).standard_normal((120, 1))
    for reopen, settled in ((5, True), (10**6, False)):
        observer = watching(qpmhe.HuberInnovation(reopen=reopen), make, **covariances)
        run = estimator(observer, [30.0], system).run(Y)
        assert (np.abs(run.observer_states[-30:]).max() < 1.0) == settled


def test_what_fits_nothing_is_refused():
    Gate = qpmhe.Gate
    for make, options, text in (
        (Gate, {"probability": 1.0}, "probability is 1.0"),
        (Gate, {"groups": [[0, 1], [1, 2]]}, "one group at most"),
        (watching, {"innovation": 3.0}, "innovation is 3.0; expected qpmhe.Gate(...)"),
        (watching, {"innovation": Gate(groups=[[0, 4]])}, "the output 4; expected outputs from 0"),
    ):
        check(OptionError, [text], make, **options)
    mhe, other = (estimator(watching(Gate(reopen=k)), FAR) for k in (3, 9))
    mhe.run(disturbed(7)[:5])
    check(InvalidInputError, ["observer"], other.load_state_dict, mhe.state_dict())
    state = mhe.state_dict()
    state["window/rejections"][2, 1] += 1
    check(InvalidInputError, ["damaged", "digest"], mhe.load_state_dict, state)
    parts = read(mhe.state_dict())
    parts["window"]["rejections"][2, 1] -= 100
    check(InvalidInputError, ["damaged", "fewer than none"], mhe.load_state_dict, written(parts))
