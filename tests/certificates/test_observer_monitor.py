"""The observer's bound beside each estimate, and each event that ends it, at its sample."""

import re
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    Monitor,
    ObserverMonitor,
    ObserverStability,
    SignalBounds,
    certify,
    certify_observer,
)
from qpmhe.certificates.evidence import MismatchError
from qpmhe.errors import InvalidInputError, ShapeError

A = np.array([[0.9, 0.2], [-0.1, 0.7]])
GAIN = np.array([[0.4], [0.1]])
COST = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=100.0 * np.eye(2), noise=25.0)
REGION = qpmhe.Box([-10.0, -10.0], [10.0, 10.0])
SIZES = SignalBounds(qpmhe.Box([-0.1, -0.1], [0.1, 0.1]), 0.2)
START = np.array([1.0, -1.0])
STEPS = 30
ONES = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)


def linear(**sets):
    return qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1, **sets)


@pytest.fixture(scope="module")
def certificate():
    return certify(linear(), qpmhe.Luenberger(GAIN), COST, horizon=4, region=REGION, sizes=SIZES)


def estimator(certificate, **options):
    return qpmhe.MovingHorizonEstimator(
        certificate.system, certificate.observer, certificate.cost,
        **{"horizon": 4, "initial_state": [0.0, 0.0], "max_qps": 2} | options,
    )


def record(seed=0, steps=STEPS):
    """States and measurements with disturbances and noises of the stated sizes."""
    rng, x = np.random.default_rng(seed), [START]
    for _ in range(steps):
        x.append(A @ x[-1] + rng.uniform(-0.1, 0.1, 2))
    return np.array(x), np.array(x)[:-1, :1] + rng.uniform(-0.2, 0.2, (steps, 1))


def followed(certificate, mhe, ys, **options):
    watch = ObserverMonitor(certificate.observer_bound, mhe, initial_error=START)
    return watch, [watch.check(mhe.update(y), **options) for y in ys]


@pytest.mark.parametrize("engine", ["python", "compiled"])
@pytest.mark.parametrize(
    "options", [{}, {"arrival": "smoothed", "warm_start": True}, {"max_qps": 0}]
)
def test_the_truth_is_in_the_set_around_the_observer(certificate, options, engine):
    if engine == "compiled":
        pytest.importorskip("casadi")
    for seed in range(5):
        states, ys = record(seed)
        mhe = estimator(certificate, engine=engine, **options)
        watch, readings = followed(certificate, mhe, ys)
        assert watch.lost is None
        for x, one in zip(states[1:], readings, strict=True):
            assert ((one.lower <= x) & (x <= one.upper)).all()
        # The same along the run as a whole.
        run = estimator(certificate, engine=engine, **options).run(ys)
        band = certificate.observer_bound.along(run, initial_error=START)
        assert (np.linalg.norm(states - run.states, axis=1) <= band.error).all()
        for name in ("radius", "lower", "upper", "error"):
            np.testing.assert_allclose(
                getattr(band, name)[1:], [getattr(one, name) for one in readings], rtol=1e-9
            )
        np.testing.assert_array_equal(
            certificate.bound(run, initial_error=START), band.error
        )
        known = certificate.bound(
            run, states[1:] - states[:-1] @ A.T, ys - states[:-1, :1], initial_error=START
        )
        assert (np.linalg.norm(states - run.states, axis=1) <= known).all()
        assert (known <= band.error * (1.0 + 1e-9)).all()


def drive(mhe, watch, ys, at, what):
    """Samples, with something else at one of them; the readings."""
    readings = []
    for t, y in enumerate(ys):
        if t == at:
            readings += what(mhe, watch, y)
        else:
            readings.append(watch.check(mhe.update(y)))
    return readings


def missing(mhe, watch, _):
    return [watch.check(mhe.update([np.nan]))]


def amended(mhe, watch, y):
    return [watch.check(mhe.update(y)), watch.check(mhe.amend(6, [3.0]))]


def amended_in_secret(mhe, watch, y):
    mhe.amend(6, [3.0])
    return [watch.check(mhe.update(y))]


def began_again(mhe, watch, y):
    mhe.reset()
    return [watch.check(mhe.update(y))]


def not_shown(mhe, watch, y):
    mhe.update(y)
    return [watch.check(mhe.update(y))]


def huge(mhe, watch, _):
    return [watch.check(mhe.update([26.0]))]  # z = 10.4, and the truth may be in the region


@pytest.mark.parametrize(
    ("what", "sample", "words"),
    [
        (missing, 7, "a measurement was missing"),
        (amended, 7, "late measurement"),
        (amended_in_secret, 7, "late measurement"),
        (began_again, 0, "began again"),
        (not_shown, 8, "from 7 to 7 were not shown"),
        (huge, 8, "the observer was outside of the region"),
    ],
)
def test_each_event_ends_the_bound_at_its_sample(certificate, what, sample, words):
    mhe = estimator(certificate)
    watch = ObserverMonitor(certificate.observer_bound, mhe, initial_error=START)
    readings = drive(mhe, watch, record()[1], 7, what)
    lost = [one.lost for one in readings]
    first = lost.index(sample)
    assert set(lost[:first]) == {None}
    assert set(lost[first:]) == {sample}
    assert np.isfinite(readings[first - 1].error)
    for one in readings[first:]:
        assert words in one.reason
        assert np.isnan([one.radius, one.error, *one.lower, *one.upper]).all()
    assert (watch.lost, watch.reason) == (sample, readings[-1].reason)


@pytest.mark.parametrize(
    ("y", "sample", "words"),
    [([np.nan], 7, "a measurement was missing"), ([26.0], 8, "outside of the region")],
)
def test_a_run_alone_shows_the_same_events(certificate, y, sample, words):
    ys = record()[1]
    ys[7] = y
    band = certificate.observer_bound.along(estimator(certificate).run(ys), initial_error=START)
    assert band.lost == sample
    assert words in band.reason
    assert f"up to sample {sample}: there" in str(band)
    assert np.isfinite(band.error[: sample + 1]).all()
    assert np.isnan(band.error[sample + 1 :]).all()


def test_a_candidate_that_starts_again_has_no_such_bound(certificate):
    watch, readings = followed(
        certificate, estimator(certificate, candidate="reinitialized"), record()[1][:3]
    )
    assert watch.lost == 0
    assert "starts again at each sample" in readings[0].reason
    mhe = estimator(certificate, candidate="reinitialized")
    run = mhe.run(record()[1])
    band = certificate.observer_bound.along(run, initial_error=START)
    assert (band.lost, band.reason) == (0, readings[0].reason)
    with pytest.raises(InvalidInputError, match="reinitialized"):
        certificate.bound(run, initial_error=START, source=mhe)


def test_other_weights_do_not_matter(certificate):
    mhe, other = (estimator(certificate) for _ in range(2))
    watch, same = (
        ObserverMonitor(certificate.observer_bound, one, initial_error=START)
        for one in (mhe, other)
    )
    for t, y in enumerate(record()[1]):
        reading, expected = watch.check(mhe.update(y, noise_weight=[[9.0]])), same.check(
            other.update(y)
        )
        if t == 5:
            reading = watch.check(mhe.set(disturbance_weight=np.eye(2)))
        assert reading.lost is None
        assert reading.radius == expected.radius


def test_larger_noises_than_stated_are_found_out(certificate):
    mhe = estimator(certificate)
    small = SignalBounds(0.0, 0.0)
    watch = ObserverMonitor(certificate.observer_bound, mhe, initial_error=0.0, sizes=small)
    readings = [watch.check(mhe.update([24.0])) for _ in range(4)]
    assert [one.lost for one in readings] == [None, 1, 1, 1]
    assert "larger than stated" in watch.reason


def test_a_set_outside_of_the_region_contradicts_what_was_stated():
    system = qpmhe.System(lambda x: 1.0 * x, lambda x: x, n=1, p=1)
    certificate = certify(
        system, qpmhe.Luenberger([[0.5]]), ONES,
        horizon=2, region=qpmhe.Box([-1.0], [1.0]), sizes=SignalBounds(0.01, 0.01),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, certificate.observer, certificate.cost, horizon=2, initial_state=[0.9]
    )
    watch = ObserverMonitor(certificate.observer_bound, mhe, initial_error=0.01)
    reading = watch.check(mhe.update([2.0]))  # z = 1.45, and x in [1.4, 1.5] was no state
    assert reading.lost == 0
    assert "larger than stated" in reading.reason


def test_model_failures_end_it(certificate):
    def f(x):
        if np.any(np.abs(x) > 5.0):
            raise ValueError("no")
        return x @ A.T

    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    bound = certificate.observer_bound
    bound = replace(bound, stability=replace(bound.stability))  # by hand: of any system
    mhe = qpmhe.MovingHorizonEstimator(
        system, certificate.observer, COST, horizon=4, initial_state=[0.0, 0.0]
    )
    watch = ObserverMonitor(bound, mhe, initial_error=START)
    readings = [watch.check(mhe.update([y])) for y in (0.1, 16.0, 0.1, 0.1)]
    assert [one.lost for one in readings] == [None, None, 2, 2]
    assert "model failed" in watch.reason


def timed():
    """A system whose steps may have any length, with an input that is a parameter."""
    return qpmhe.System.from_ode(
        lambda x, u: -x + u, lambda x, u: x, dt=0.1, n=1, p=1, m=1, method="euler"
    )


@pytest.fixture(scope="module")
def with_input():
    return certify(
        timed(), qpmhe.Luenberger([[0.2]]), ONES,
        horizon=3, region=qpmhe.Box([-5.0], [5.0]), inputs=qpmhe.Box([-1.0], [1.0]),
        sizes=SignalBounds(0.1, 0.1),
    )


def driven(certificate, **options):
    return qpmhe.MovingHorizonEstimator(
        certificate.system, certificate.observer, certificate.cost,
        **{"horizon": 3, "initial_state": [0.0]} | options,
    )


@pytest.mark.parametrize(
    ("kept", "told", "words"),
    [
        ({}, {"dt": 0.07}, "length 0.07, and 0.1 is certified"),
        ({"dt": 0.07}, {"dt": 0.07}, "length 0.07"),
        ({"dt": 0.07}, {}, "another length"),
        ({"u": 1.5}, {"u": [1.5]}, "input .* outside"),
    ],
)
def test_steps_that_were_not_certified(with_input, kept, told, words):
    mhe = driven(with_input)
    watch = ObserverMonitor(with_input.observer_bound, mhe, initial_error=0.5)
    for t in range(4):
        assert watch.check(mhe.update([0.2], [0.3]), [0.3], dt=0.1 if t else None).lost is None
    u = kept.pop("u", 0.3)
    reading = watch.check(mhe.update([0.2], [u], **kept), **{"u": [0.3]} | told)
    assert reading.lost == 4
    assert re.search(words, reading.reason)


def test_a_run_shows_inputs_that_were_not_certified(with_input):
    us = np.full((9, 1), 0.3)
    us[5] = -1.5
    run = driven(with_input).run(np.zeros(9), us)
    band = with_input.observer_bound.along(run, initial_error=0.5)
    assert band.lost == 5
    assert band.reason == "the input [-1.5] is outside of what was certified"


def test_parameters_are_inputs(with_input):
    mhe = driven(with_input, parameters=[0.3])
    watch = ObserverMonitor(with_input.observer_bound, mhe, initial_error=0.5)
    for _ in range(3):
        assert watch.check(mhe.update([0.2]), [0.3]).lost is None
    mhe.set(parameters=[0.6])
    assert watch.check(mhe.update([0.2]), [0.6]).lost == 3
    mhe = driven(with_input)
    watch = ObserverMonitor(with_input.observer_bound, mhe, initial_error=0.5)
    estimate = mhe.update([0.2], [0.3])
    with pytest.raises(ShapeError, match=r"u has shape \(0,\)"):
        watch.check(estimate)


def test_a_sensor_that_is_not_sampled_ends_it():
    system = qpmhe.System(lambda x: 0.8 * x, lambda x: x, n=2, p=2)
    certificate = certify(
        system, qpmhe.Luenberger(0.3 * np.eye(2)),
        qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(2)),
        horizon=2, region=qpmhe.Box([-5.0, -5.0], [5.0, 5.0]),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, certificate.observer, certificate.cost, horizon=2, initial_state=[0.0, 0.0]
    )
    watch = ObserverMonitor(certificate.observer_bound, mhe, initial_error=0.5)
    assert watch.check(mhe.update([0.1, 0.1])).lost is None
    assert watch.check(mhe.update([0.1], sensors=0)).reason == "not all outputs were sampled"


# Projection onto X


def corner(metric=None):
    """A system that often leaves its X, with a coupled observer, and its certificate."""
    system = linear(states=qpmhe.Box([0.0, -10.0], [10.0, 0.5]))
    stability = certify_observer(system, qpmhe.Luenberger(GAIN), system.states, rho=0.9)
    own = stability.P if isinstance(metric, str) else metric
    observer = qpmhe.Luenberger(GAIN, metric=own)
    return certify(system, observer, COST, horizon=4, sizes=SIZES, stability=stability)


def inside(certificate, seed):
    """A record whose states stay in X; the disturbance sees to it."""
    rng, X = np.random.default_rng(seed), certificate.system.states
    x, ys = [np.array([1.0, 0.2])], []
    for _ in range(40):
        ys.append(x[-1][:1] + rng.choice([-0.2, 0.2]))
        for _ in range(200):
            ahead = A @ x[-1] + rng.choice([-0.1, 0.1], 2) * rng.random(2) ** 0.2
            if X.violation(ahead) == 0.0:
                break
        else:
            break
        x.append(ahead)
    return np.array(x), np.array(ys)[: len(x) - 1]


def test_a_projection_in_the_certified_metric_keeps_the_bound():
    certificate = corner("certified")
    assert certificate.observer_bound.projects
    projected = 0
    for seed in range(60):
        states, ys = inside(certificate, seed)
        mhe = estimator(certificate, initial_state=[0.0, 0.5], max_qps=1)
        watch = ObserverMonitor(
            certificate.observer_bound, mhe, initial_error=states[0] - mhe.observer_state
        )
        for x, y in zip(states[1:], ys, strict=True):
            estimate = mhe.update(y)
            reading = watch.check(estimate)
            projected += qpmhe.Status.OBSERVER_PROJECTED in estimate.status
            assert reading.lost is None
            error = certificate.observer_bound.length(x - estimate.observer_state)
            assert error * (1.0 - 1e-12) <= reading.radius
            assert ((reading.lower <= x) & (x <= reading.upper)).all()
            assert np.linalg.norm(x - estimate.state) <= reading.error
    assert projected > 100


@pytest.mark.parametrize("metric", [None, np.eye(2)])
def test_a_projection_in_another_metric_ends_it(metric):
    certificate = corner(metric)
    assert not certificate.observer_bound.projects
    _, ys = inside(certificate, 0)
    mhe = estimator(certificate, initial_state=[0.0, 0.5])
    watch = ObserverMonitor(certificate.observer_bound, mhe, initial_error=2.0)
    for y in ys:
        estimate = mhe.update(y)
        reading = watch.check(estimate)
        if qpmhe.Status.OBSERVER_PROJECTED in estimate.status:
            break
        assert reading.lost is None
    t = estimate.time
    assert reading.lost == t < len(ys) - 1
    assert "another metric than the certified one" in reading.reason
    run = estimator(certificate, initial_state=[0.0, 0.5]).run(ys)
    band = certificate.observer_bound.along(run, initial_error=2.0)
    assert (band.lost, band.reason) == (t, reading.reason)


def test_the_certified_metric_can_be_given_to_an_equal_observer():
    certificate = corner()
    observer = qpmhe.Luenberger(GAIN, metric=certificate.observer_bound.metric)
    mhe = qpmhe.MovingHorizonEstimator(
        certificate.system, observer, COST, horizon=4, initial_state=[0.0, 0.5]
    )
    watch = ObserverMonitor(certificate.observer_bound, mhe, initial_error=2.0)
    ys = inside(certificate, 0)[1]
    assert {watch.check(mhe.update(y)).lost for y in ys} == {None}
    mhe.reset()
    run = mhe.run(ys)
    assert run.share(qpmhe.Status.OBSERVER_PROJECTED) > 0.0
    assert certificate.observer_bound.along(run, initial_error=2.0).lost is None


# Snapshots, and the theorem beside it


def test_a_monitor_continues_from_its_state(certificate):
    ys = record()[1]
    ys[20] = np.nan
    _, expected = followed(certificate, estimator(certificate), ys)
    mhe = estimator(certificate)
    watch = ObserverMonitor(certificate.observer_bound, mhe, initial_error=START)
    for t, y in enumerate(ys):
        if t % 7 == 3:
            state = watch.state_dict()
            watch = ObserverMonitor(certificate.observer_bound, estimator(certificate),
                                    initial_error=99.0)
            watch.load_state_dict(state)
        one = watch.check(mhe.update(y))
        np.testing.assert_equal(vars(one), vars(expected[t]))
    for wrong in ({}, {**state, "observer": [1.0]}, {**state, "radius": "x"}):
        with pytest.raises(InvalidInputError, match="no monitor of this observer"):
            watch.load_state_dict(wrong)


def test_the_monitor_of_both_has_the_smaller_bound(certificate):
    states, ys = record(3)
    mhe = estimator(certificate)
    watch = Monitor.of(certificate, mhe, initial_error=START)
    alone = ObserverMonitor(certificate.observer_bound, mhe, initial_error=START)
    for x, y in zip(states[1:], ys, strict=True):
        estimate = mhe.update(y)
        assert watch.check(estimate).held
        assert watch.bound.error <= alone.check(estimate).error
        assert np.linalg.norm(x - estimate.state) <= watch.bound.error
    text = str(watch.summary())
    assert text.startswith(f"The observer's bound held at all {STEPS} samples. The certificate")
    measured = certificate.bound(
        estimator(certificate).run(ys), initial_error=START, kind="weighted"
    )
    assert watch.bound.error < measured[-1]


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
def test_the_measured_cost_may_give_less():
    # An observer that is slow to forget a large initial error, and a model without disturbances.
    system = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1e4, noise=1.0)
    certificate = certify(
        system, qpmhe.Luenberger([[-0.45]]), cost, horizon=5, region=qpmhe.Box([-90.0], [90.0]),
        sizes=SignalBounds(1e-6, 1e-6),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, certificate.observer, cost, horizon=5, initial_state=[60.0], max_qps=5
    )
    watch = Monitor.of(certificate, mhe, initial_error=60.0)
    x, kinds = np.array([0.0]), []
    for _ in range(12):
        estimate = mhe.update(x)
        watch.check(estimate)
        kinds.append(watch.bound.kind)
        x = 0.5 * x
        assert np.linalg.norm(x - estimate.state) <= watch.bound.error
    assert set(kinds) <= {"observer", "measured"}
    assert kinds[-1] == "measured"


def test_what_the_theorem_does_not_cover_leaves_the_observers_bound(certificate):
    mhe = estimator(certificate, arrival="smoothed")
    watch = Monitor.of(certificate, mhe, initial_error=START)
    for y in record()[1]:
        watch.check(mhe.update(y))
    assert watch.bound.lost is None
    assert not watch.applies
    text = str(watch.summary())
    assert text.startswith("The observer's bound held at all 30 samples. The theorem does not")
    assert "smoothed" in text


def test_amended_estimates_are_taken_and_the_reason_is_given(certificate):
    mhe = estimator(certificate)
    watch = Monitor.of(certificate, mhe, initial_error=START)
    for y in record()[1][:8]:
        watch.check(mhe.update(y))
    watch.check(mhe.amend(6, [3.0]))
    assert watch.bound.lost == 7
    watch.check(mhe.update([0.0]))
    assert "held up to sample 7: there the observer's state before was changed" in str(
        watch.summary()
    )
    assert not watch.applies


def test_without_an_initial_error_nothing_is_followed(certificate):
    mhe = estimator(certificate)
    watch = Monitor.of(certificate, mhe)
    watch.check(mhe.update([0.0]))
    assert watch.bound is None
    assert str(watch.summary()) == "The certificate applied at 1 of 1 steps."


def test_stated_constants_have_no_norm_to_follow():
    certificate = certify(
        linear(), qpmhe.Luenberger(GAIN), COST, horizon=4, region=REGION,
        stability=ObserverStability.assumed(rho=0.9, C_p=2.0, C_w=2.0, C_v=1.0, kappa=0.5),
    )
    assert certificate.observer_bound is None
    assert certificate.bounds


def test_a_bound_of_another_observer_is_refused(certificate):
    other = qpmhe.MovingHorizonEstimator(
        certificate.system, qpmhe.Luenberger(2.0 * GAIN), COST, horizon=4, initial_state=[0.0, 0.0]
    )
    bound = certificate.observer_bound
    with pytest.raises(MismatchError, match=r"\[\[0.4\], \[0.1\]\]; the estimator's is \[\[0.8\]"):
        bound.along(other.run(record()[1]), initial_error=START)
    with pytest.raises(MismatchError, match=r"the estimator's is \[\[0.8\]"):
        ObserverMonitor(bound, other, initial_error=START)
    twin = qpmhe.MovingHorizonEstimator(
        linear(), certificate.observer, COST, horizon=4, initial_state=[0.0, 0.0]
    )
    with pytest.raises(MismatchError, match="another System object"):
        ObserverMonitor(bound, twin, initial_error=START)


def test_what_is_no_bound_estimate_or_run_is_named(certificate):
    mhe, bound = estimator(certificate), certificate.observer_bound
    with pytest.raises(InvalidInputError, match=r"Certificate; .* certificate\.observer_bound"):
        ObserverMonitor(certificate, mhe, initial_error=START)
    with pytest.raises(InvalidInputError, match=r"NoneType; .* MovingHorizonEstimator\.update"):
        ObserverMonitor(bound, mhe, initial_error=START).check(None)
    with pytest.raises(InvalidInputError, match="type ndarray; expected"):
        certificate.bound(np.ones(3), initial_error=START)
