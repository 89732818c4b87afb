"""Kalman observers beside priors of up to 1e10 noise deviations, against 60 digits."""

import itertools

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler

mp = pytest.importorskip("mpmath")

ENGINES = ["python", pytest.param("compiled", marks=pytest.mark.skipif(
    find_compiler() is None, reason="there is no C compiler"
))]
OBSERVERS = [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman]
SAMPLES = 16
MOVE = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
SEASON = np.array([[1.0, 0, 0, 0], [0, -1, -1, -1], [0, 1, 0, 0], [0, 0, 1, 0]])
# A, C and Q; the noise has variance 1. By the first sample the data say little about most states.
MODELS = {
    "slant": (MOVE[:2, :2], np.array([[1.0, 1.0]]), 0.01 * np.eye(2)),
    "jerk": (MOVE, np.array([[1.0, 0.0, 0.0]]), 0.01 * np.eye(3)),
    # Two of four states are disturbed: Q is singular.
    "season": (SEASON, np.array([[1.0, 1.0, 0.0, 0.0]]), 0.01 * np.diag([1.0, 1.0, 0.0, 0.0])),
    # Two sensors of the same state, and one of nearly the same: S has no digits of its own noise.
    "twice": (MOVE, np.array([[1.0, 0, 0], [1.0, 0, 0], [1.0, 1e-4, 0]]), 0.01 * np.eye(3)),
}
# Largest errors in deviations of the 60-digit filter: of all states, and of the last covariance.
ALLOWED = {"slant": (1e-12, 1e-12), "jerk": (1e-10, 1e-11), "season": (5e-6, 5e-6),
           "twice": (2e-6, 1e-8)}


def predicted(a, c, q, deviation, ys):
    """Predictions (T, n) of a Kalman filter from 0, and their covariances, in 60 digits."""
    with mp.workdps(60):
        move, output, spread = (mp.matrix(one.tolist()) for one in (a, c, q))
        mean, covariance = mp.zeros(len(a), 1), mp.mpf(deviation) ** 2 * mp.eye(len(a))
        means, covariances = [], []
        for y in ys:
            known = [i for i, one in enumerate(y) if np.isfinite(one)]
            mean, cross = move * mean, covariance * move.T
            covariance = move * cross + spread
            if known:
                seen = mp.matrix([[output[i, j] for j in range(len(a))] for i in known])
                there = mp.matrix([float(y[i]) for i in known])
                before = move**-1 * mean
                inner = seen * (cross * move.T**-1) * seen.T + mp.eye(len(known))
                gain = cross.T * seen.T * inner**-1
                mean = mean + gain * (there - seen * before)
                covariance = covariance - gain * inner * gain.T
            means.append([float(one) for one in mean])
            covariances.append([[float(one) for one in row] for row in covariance.tolist()])
        return np.array(means), np.array(covariances)


def nearest(point, covariance, sides):
    """The point nearest in the metric of a covariance, with x[j] at most or at least a side."""
    n = point.rows
    for count in range(n + 1):
        for held in itertools.combinations(sides, count):
            if len({j for j, _, _ in held}) < count:
                continue
            pick = mp.matrix(count, n)
            for i, (j, sign, _) in enumerate(held):
                pick[i, j] = sign
            x, forces = point, mp.matrix(count, 1)
            if count:
                missed = pick * point - mp.matrix([sign * side for _, sign, side in held])
                forces = mp.lu_solve(pick * covariance * pick.T, missed)
                x = point - covariance * pick.T * forces
            tiny = mp.mpf(10) ** -40 * (1 + mp.norm(x))
            if min([0, *forces]) >= 0 and all(
                sign * x[j] <= sign * side + tiny for j, sign, side in sides
            ):
                return x
    raise AssertionError("no point of the set")


def projected(a, c, q, deviation, ys, sides):
    """The predictions of the filter, put into the set after each step."""
    with mp.workdps(60):
        move, output, spread = (mp.matrix(one.tolist()) for one in (a, c, q))
        mean, covariance = mp.zeros(len(a), 1), mp.mpf(deviation) ** 2 * mp.eye(len(a))
        sides, means, active = [(j, s, mp.mpf(float(b))) for j, s, b in sides], [], 0
        for y in ys:
            inner = output * covariance * output.T + mp.eye(output.rows)
            gain = covariance * output.T * inner**-1
            free = move * (mean + gain * (mp.matrix(y.tolist()) - output * mean))
            covariance = move * (covariance - gain * inner * gain.T) * move.T + spread
            mean = nearest(free, covariance, sides)
            active += mean != free
            means.append([float(one) for one in mean])
        assert active > 2
        return np.array(means)


def estimator(model, kind, deviation, engine, units=1.0, states=None, **options):
    a, c, q = model
    n, scale = len(a), np.asarray(units) * np.ones(len(a))
    a, c, q = scale[:, None] * a / scale, c / scale, scale[:, None] * q * scale
    system = qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=n, p=len(c), states=states)
    given = {"disturbance": q, "noise": np.eye(len(c))}
    mhe = qpmhe.MovingHorizonEstimator(
        system, kind(prior=deviation**2 * np.diag(scale**2), **given, **options),
        qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), **given | {"disturbance": q + 1e-9 * np.diag(scale**2)}
        ),
        horizon=5, initial_state=np.zeros(n), max_qps=0, engine=engine,
    )
    assert mhe.engine == engine
    return mhe


def newest_covariance(mhe):
    engine = mhe._engine
    if mhe.engine == "python":
        return engine._window.covariance[engine._window.end]
    return engine._memory[0]["covariance_end"].copy()


def measurements(p):
    ys = 10.0 + np.random.default_rng(0).normal(size=(SAMPLES, p))
    ys[3, 0] = ys[9] = np.nan
    return ys


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", OBSERVERS)
@pytest.mark.parametrize("name", MODELS)
def test_states_and_covariances_are_the_kalman_filters(name, kind, engine):
    """In the deviations of the filter; the two smallest priors need no roots."""
    model, (allowed, spread) = MODELS[name], ALLOWED[name]
    ys = measurements(len(model[1]))
    for deviation in (1.0, 1e3, 1e5, 1e8, 1e10):
        means, covariances = predicted(*model, deviation, ys)
        sizes = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
        mhe = estimator(model, kind, deviation, engine)
        run = mhe.run(ys)
        errors = np.abs(run.observer_states[1:] - means) / sizes
        found = newest_covariance(mhe)
        off = np.abs(found - covariances[-1]) / np.outer(sizes[-1], sizes[-1])
        # Below the threshold, rounding takes what the covariance's own condition takes.
        assert errors.max() < (max(allowed, 3e-8) if deviation < 1e7 else allowed)
        assert off.max() < (max(spread, 1e-8) if deviation < 1e7 else spread)
        assert np.linalg.eigvalsh(found / np.outer(sizes[-1], sizes[-1])).min() > 0.0
        assert not run.share(qpmhe.Status.MODEL_FAILED)
        assert not run.share(qpmhe.Status.OBSERVER_RESET)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", OBSERVERS)
def test_no_unit_matters(kind, engine):
    ys, units = measurements(1), np.array([2.0**30, 2.0**-20, 2.0**3])
    plain, other = (
        estimator(MODELS["jerk"], kind, 1e10, engine, scale).run(ys).observer_states
        for scale in (1.0, units)
    )
    np.testing.assert_allclose(other / units, plain, rtol=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("rule", [qpmhe.Gate(), qpmhe.HuberInnovation(10.0)], ids=["gate", "huber"])
@pytest.mark.parametrize("kind", OBSERVERS)
def test_rules_for_innovations_see_what_roots_say(kind, rule, engine):
    """Of measurements that all pass they change nothing, however vague the prior is."""
    model = MODELS["jerk"]
    ys = 10.0 + 0.1 * np.arange(SAMPLES)[:, None] + measurements(1) - 10.0
    plain, judged = (
        estimator(model, kind, 1e10, engine, innovation=one).run(ys).observer_states
        for one in (None, rule)
    )
    np.testing.assert_allclose(judged, plain, rtol=1e-6)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", OBSERVERS)
def test_snapshots_and_late_measurements_keep_the_roots(kind, engine):
    ys = measurements(1)
    means, covariances = predicted(*MODELS["jerk"], 1e10, ys)
    sizes = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    mhe = estimator(MODELS["jerk"], kind, 1e10, engine)
    for t, y in enumerate(ys):
        if t == 1:  # comes late
            mhe.update([np.nan])
            estimate = mhe.amend(1, y)
        else:
            estimate = mhe.update(y)
        assert (np.abs(estimate.observer_state - means[t]) < 1e-9 * sizes[t]).all()
        if t < 4:
            state, mhe = mhe.state_dict(), estimator(MODELS["jerk"], kind, 1e10, engine)
            mhe.load_state_dict(state)


@pytest.mark.parametrize("kind", OBSERVERS)
def test_a_root_that_is_not_the_covariances_is_refused(kind):
    mhe = estimator(MODELS["jerk"], kind, 1e10, "python")
    mhe.run(measurements(1)[:2])
    state = mhe.state_dict()
    assert state["window/is_vague"].any()
    state["window/root"] *= 2.0
    with pytest.raises(qpmhe.errors.InvalidInputError, match="its digest is another"):
        mhe.load_state_dict(state)


PAIR = np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]])


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", OBSERVERS)
def test_a_group_is_judged_by_what_its_outputs_say_of_each_other(kind, engine):
    """Two sensors of one state: beside the prior their covariance S has no digit of the noise.

    With P = s^2 their squared distance is (y1 + y2)^2 / (4 s^2 + 2) + (y1 - y2)^2 / 2.
    """
    gate, model = qpmhe.Gate(groups=[[0, 1], [2]], reopen=3), (MOVE, PAIR, 0.01 * np.eye(3))
    limit = np.sqrt(2.0 * gate.limits(3)[1])
    rejected = qpmhe.Status.SENSORS_REJECTED
    for deviation in (1e2, 1e4, 1e6, 1e8, 1e10):
        for apart in (0.99 * limit, 1.01 * limit):
            mhe = estimator(model, kind, deviation, engine, innovation=gate)
            status = mhe.update([0.5 * apart, -0.5 * apart, 0.0]).status
            assert bool(status & rejected) == (apart > limit)
            if apart > limit:
                # They contradict each other: no larger P explains that, now or later.
                for _ in range(8):
                    assert mhe.update([0.5 * apart, -0.5 * apart, 0.0]).status & rejected


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", OBSERVERS)
def test_groups_that_pass_change_nothing(kind, engine):
    """However vague the prior is, and whichever outputs the groups have; one opens again, too."""
    rng, model = np.random.default_rng(0), (MOVE, PAIR, 0.01 * np.eye(3))
    times = np.arange(SAMPLES)
    ys = np.stack((10.0 + times, 10.0 + times, np.ones(SAMPLES)), axis=1)
    ys += 0.3 * rng.normal(size=ys.shape)
    for groups in ([[0, 1]], [[0, 2], [1]], [[0, 1, 2]]):
        gate = qpmhe.Gate(groups=groups, reopen=2)
        for deviation in (1e5, 1e8, 1e10):
            plain, judged = (
                estimator(model, kind, deviation, engine, innovation=rule).run(ys)
                for rule in (None, gate)
            )
            np.testing.assert_allclose(
                judged.observer_states, plain.observer_states, rtol=1e-9, atol=1e-9
            )
        # A jump of all outputs: the observer, sure of the place before, is to follow it.
        jump = ys + 1e4 * (times > 8)[:, None] * np.array([1.0, 1.0, 0.0])
        run = estimator(model, kind, 1e8, engine, innovation=gate).run(jump)
        rejected = [bool(one & qpmhe.Status.SENSORS_REJECTED) for one in run.statuses]
        assert rejected[9]
        assert not any(rejected[:9])
        if groups == [[0, 1, 2]]:
            assert not rejected[-1]
            assert abs(run.observer_states[-1, 0] - jump[-1, 0]) < 10.0


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", OBSERVERS)
@pytest.mark.parametrize("name", ["slant", "jerk", "twice"])
def test_projections_take_the_root(name, kind, engine):
    """The nearest point by enumeration in 60 digits; no metric is singular."""
    model, ys = MODELS[name], 10.0 + np.random.default_rng(2).normal(size=(8, 3))
    ys = ys[:, : len(model[1])]
    n = len(model[0])
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    lower[0], upper[0], lower[1], upper[1] = -50.0, 11.0, -0.4, 0.2
    sides = [(0, 1, 11.0), (0, -1, -50.0), (1, 1, 0.2), (1, -1, -0.4)]
    for deviation in (1.0, 1e3, 1e6, 1e8, 1e10):
        states = projected(*model, deviation, ys, sides)
        run = estimator(
            model, kind, deviation, engine, states=qpmhe.Box(lower, upper)
        ).run(ys)
        assert not run.share(qpmhe.Status.METRIC_SINGULAR)
        np.testing.assert_allclose(run.observer_states[1:], states, rtol=2e-8, atol=1e-6)
