"""At run time: the set around the observer, what ends it, and the theorem's hypotheses."""

import re
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    Detectability,
    MismatchError,
    Monitor,
    ObserverStability,
    Sizes,
    certify,
    certify_observer,
    monitored_run,
)
from qpmhe.certificates.monitor import HYPOTHESES, failed_hypotheses
from qpmhe.errors import InvalidInputError, OptionError, ShapeError

from .helpers import box, scalar, unit_cost

A = np.array([[0.9, 0.2], [-0.1, 0.7]])
GAIN = np.array([[0.4], [0.1]])
COST = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=100.0 * np.eye(2), noise=25.0)
REGION = qpmhe.Box([-10.0, -10.0], [10.0, 10.0])
SIZES = Sizes(qpmhe.Box([-0.1, -0.1], [0.1, 0.1]), 0.2)
START = np.array([1.0, -1.0])
STEPS = 30
ONES = unit_cost()


def linear(**sets):
    return qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1, **sets)


@pytest.fixture(scope="module")
def certificate():
    return certify(linear(), qpmhe.Luenberger(GAIN), COST, horizon=4, region=REGION, sizes=SIZES)


def estimator(certificate, **options):
    n = certificate.system.n
    return qpmhe.MovingHorizonEstimator(
        certificate.system, certificate.observer, certificate.cost,
        **{"horizon": 4 if n == 2 else 3, "initial_state": np.zeros(n), "max_qps": 1} | options,
    )


def followed(certificate, mhe, start=START, **options):
    return Monitor(certificate.observer_bound, mhe, initial_error=start, **options)


def record(seed=0, steps=STEPS):
    """States and measurements with disturbances and noises of the stated sizes."""
    rng, x = np.random.default_rng(seed), [START]
    for _ in range(steps):
        x.append(A @ x[-1] + rng.uniform(-0.1, 0.1, 2))
    return np.array(x), np.array(x)[:-1, :1] + rng.uniform(-0.2, 0.2, (steps, 1))


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
        watch = followed(certificate, mhe)
        readings = [watch.check(mhe.update(y)) for y in ys]
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
        np.testing.assert_array_equal(certificate.bound(run, initial_error=START), band.error)
        known = certificate.bound(
            run, states[1:] - states[:-1] @ A.T, ys - states[:-1, :1], initial_error=START
        )
        assert (np.linalg.norm(states - run.states, axis=1) <= known).all()
        assert (known <= band.error * (1.0 + 1e-9)).all()


EVENTS = {  # what happens in place of the sample 7, the sample that is lost, and the reason
    "missing": (lambda mhe, y: [mhe.update([np.nan])], 7, "a measurement was missing"),
    "amended": (lambda mhe, y: [mhe.update(y), mhe.amend(6, [3.0])], 7, "late measurement"),
    "amended in secret": (
        lambda mhe, y: [mhe.amend(6, [3.0]) and mhe.update(y)], 7, "late measurement"),
    "began again": (lambda mhe, y: [mhe.reset() or mhe.update(y)], 0, "began again"),
    "not shown": (
        lambda mhe, y: [mhe.update(y) and mhe.update(y)], 8, "from 7 to 7 were not shown"),
    # z = 10.4, and the truth may be in the region
    "huge": (lambda mhe, y: [mhe.update([26.0])], 8, "the observer was outside of the region"),
}


@pytest.mark.parametrize("event", EVENTS)
def test_each_event_ends_the_bound_at_its_sample(certificate, event):
    what, sample, words = EVENTS[event]
    mhe = estimator(certificate)
    watch, readings = followed(certificate, mhe), []
    for t, y in enumerate(record()[1]):
        readings += [watch.check(each) for each in (what(mhe, y) if t == 7 else [mhe.update(y)])]
    lost = [one.lost for one in readings]
    first = lost.index(sample)
    assert set(lost[:first]) == {None}
    assert set(lost[first:]) == {sample}
    assert np.isfinite(readings[first - 1].error)
    for one in readings[first:]:
        assert words in one.reason
        assert np.isnan([one.radius, one.error, *one.lower, *one.upper]).all()
    assert (watch.lost, watch.reason) == (sample, readings[-1].reason)


@pytest.mark.parametrize("event", ["missing", "huge"])
def test_a_run_alone_shows_the_same_events(certificate, event):
    (_, sample, words), ys = EVENTS[event], record()[1]
    ys[7] = np.nan if event == "missing" else 26.0
    band = certificate.observer_bound.along(estimator(certificate).run(ys), initial_error=START)
    assert band.lost == sample
    assert words in band.reason
    assert f"up to sample {sample}: there" in str(band)
    assert np.isfinite(band.error[: sample + 1]).all()
    assert np.isnan(band.error[sample + 1 :]).all()


def test_a_candidate_that_starts_again_has_no_such_bound(certificate):
    mhe = estimator(certificate, candidate="reinitialized")
    watch = followed(certificate, mhe)
    reading = watch.check(mhe.update([0.1]))
    assert watch.lost == 0
    assert "starts again at each sample" in reading.reason
    run = estimator(certificate, candidate="reinitialized").run(record()[1])
    band = certificate.observer_bound.along(run, initial_error=START)
    assert (band.lost, band.reason) == (0, reading.reason)


def test_other_weights_do_not_matter(certificate):
    mhe, other = (estimator(certificate) for _ in range(2))
    watch, same = followed(certificate, mhe), followed(certificate, other)
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
    watch = followed(certificate, mhe, 0.0, sizes=Sizes(0.0, 0.0))
    readings = [watch.check(mhe.update([24.0])) for _ in range(4)]
    assert [one.lost for one in readings] == [None, 1, 1, 1]
    assert "larger than stated" in watch.reason


def test_model_failures_end_it(certificate):
    def f(x):
        if np.any(np.abs(x) > 5.0):
            raise ValueError("no")
        return x @ A.T

    bound = certificate.observer_bound
    bound = replace(bound, stability=replace(bound.stability))  # by hand: of any system
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, lambda x: x[..., :1], n=2, p=1), certificate.observer, COST, horizon=4,
        initial_state=[0.0, 0.0],
    )
    watch = Monitor(bound, mhe, initial_error=START)
    readings = [watch.check(mhe.update([y])) for y in (0.1, 16.0, 0.1, 0.1)]
    assert [one.lost for one in readings] == [None, None, 2, 2]
    assert "model failed" in watch.reason


@pytest.fixture(scope="module")
def with_input():
    """Of a system whose steps may have any length, with an input that may be a parameter."""
    system = qpmhe.System.from_ode(
        lambda x, u: -x + u, lambda x, u: x, dt=0.1, n=1, p=1, m=1, method="euler"
    )
    return certify(
        system, qpmhe.Luenberger([[0.2]]), ONES, horizon=3, region=box(-5.0, 5.0),
        inputs=box(-1.0, 1.0), sizes=Sizes(0.1, 0.1),
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
    mhe = estimator(with_input)
    watch = followed(with_input, mhe, 0.5)
    for t in range(4):
        assert watch.check(mhe.update([0.2], [0.3]), [0.3], dt=0.1 if t else None).lost is None
    u = kept.get("u", 0.3)
    options = {name: value for name, value in kept.items() if name != "u"}
    reading = watch.check(mhe.update([0.2], [u], **options), **{"u": [0.3]} | told)
    assert reading.lost == 4
    assert re.search(words, reading.reason)


def test_inputs_of_a_run_and_parameters(with_input):
    us = np.full((9, 1), 0.3)
    us[5] = -1.5
    run = estimator(with_input).run(np.zeros(9), us)
    band = with_input.observer_bound.along(run, initial_error=0.5)
    assert (band.lost, band.reason) == (5, "the input [-1.5] is outside of what was certified")
    mhe = estimator(with_input, parameters=[0.3])
    watch = followed(with_input, mhe, 0.5)
    for _ in range(3):
        assert watch.check(mhe.update([0.2]), [0.3]).lost is None
    mhe.set(parameters=[0.6])
    assert watch.check(mhe.update([0.2]), [0.6]).lost == 3
    mhe = estimator(with_input)
    watch, estimate = followed(with_input, mhe, 0.5), mhe.update([0.2], [0.3])
    with pytest.raises(ShapeError, match=r"u has shape \(0,\)"):
        watch.check(estimate)


def test_a_sensor_that_is_not_sampled_ends_it():
    system = qpmhe.System(lambda x: 0.8 * x, lambda x: x, n=2, p=2)
    certificate = certify(
        system, qpmhe.Luenberger(0.3 * np.eye(2)), unit_cost(2, 2), horizon=2,
        region=qpmhe.Box([-5.0, -5.0], [5.0, 5.0]),
    )
    mhe = estimator(certificate, horizon=2)
    watch = followed(certificate, mhe, 0.5)
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


def test_a_projection_in_the_certified_metric_keeps_all_bounds():
    certificate = corner("certified")
    paper = certificate.of()
    assert paper.model_lipschitz == pytest.approx(np.linalg.norm(A, 2), rel=0.02)
    assert paper.kappa_bar == pytest.approx(
        (0.9 + paper.model_lipschitz + 1.0 / paper.observer.disturbance) / paper.L_bar
    )
    assert paper.kappa_bar != paper.kappa
    spread = np.sqrt(np.linalg.cond(certificate.observer_bound.metric))
    projected = outside = more = 0
    for seed in range(60):
        states, ys = inside(certificate, seed)
        mhe = estimator(certificate, initial_state=[0.0, 0.5])
        watch = Monitor(certificate, mhe, initial_error=states[0] - mhe.observer_state)
        estimates = []
        for x, y in zip(states[1:], ys, strict=True):
            estimates.append(estimate := mhe.update(y))
            reading = watch.check(estimate)
            projected += qpmhe.Status.OBSERVER_PROJECTED in estimate.status
            outside += qpmhe.Status.PREDICTION_OUTSIDE in estimate.status
            correction = estimate.candidate[-1] - A @ estimate.candidate[-2]
            misfit = y - estimate.candidate[-2][:1]
            more += np.linalg.norm(correction) > spread * paper.kappa * np.linalg.norm(misfit)
            assert reading.lost is None
            assert reading.failed == ()
            error = certificate.observer_bound.length(x - estimate.observer_state)
            assert error * (1.0 - 1e-12) <= reading.radius
            assert ((reading.lower <= x) & (x <= reading.upper)).all()
            assert np.linalg.norm(x - estimate.state) <= reading.error
        assert watch.applies
        w, v = states[1:] - states[:-1] @ A.T, ys - states[:-1, :1]
        signals = np.linalg.norm(w, axis=1), np.abs(v[:, 0])
        start = np.linalg.norm(states[0] - estimates[0].candidate[0])
        bound = paper.result.bound(start, *signals)
        for x, limit, estimate in zip(states[1:], bound[1:], estimates, strict=True):
            assert np.linalg.norm(x - estimate.state) <= limit
            # The Lemma's link that has no kappa: (rho + L_f + 1 / C_w) S(t).
            steps = estimate.candidate[1:] - estimate.candidate[:-1] @ A.T
            for i, moved in enumerate(np.linalg.norm(steps, axis=1)):
                t = estimate.time - len(steps) + 1 + i
                assert moved <= paper.kappa_bar * paper.L_bar * newest_sum(paper, start, signals, t)
    assert projected > 100
    assert outside > 20
    assert more > 0  # kappa does not hold of these corrections, whatever the metric makes of it


def newest_sum(paper, start, signals, t):
    """S(t): C_p |e_0| rho^t and the decaying sums of w and v from tau = 0 on."""
    (C_p, C_w, C_v), rho = paper.observer.constants, paper.observer.rate
    decay = rho ** np.arange(t, -1.0, -1.0)
    w, v = (decay @ each[: t + 1] for each in signals)
    return (C_p * start * rho**t + C_w * w + C_v * v) * (1.0 + 1e-9)


@pytest.mark.parametrize("metric", [None, np.eye(2)])
def test_a_projection_in_another_metric_ends_it(metric):
    certificate = corner(metric)
    assert not certificate.observer_bound.projects
    assert certificate.of().model_lipschitz is None
    _, ys = inside(certificate, 0)
    mhe = estimator(certificate, initial_state=[0.0, 0.5])
    watch = Monitor(certificate, mhe, initial_error=2.0)
    for y in ys:
        estimate = mhe.update(y)
        reading = watch.check(estimate)
        if qpmhe.Status.OBSERVER_PROJECTED in estimate.status:
            break
        assert reading.lost is None
    t = estimate.time
    assert reading.lost == t < len(ys) - 1
    assert "observer candidate" in reading.failed
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
    watch, ys = followed(certificate, mhe, 2.0), inside(certificate, 0)[1]
    assert {watch.check(mhe.update(y)).lost for y in ys} == {None}
    mhe.reset()
    run = mhe.run(ys)
    assert run.share(qpmhe.Status.OBSERVER_PROJECTED) > 0.0
    assert certificate.observer_bound.along(run, initial_error=2.0).lost is None


# Snapshots, and the smaller one of two bounds


def test_a_monitor_continues_from_its_state(certificate):
    ys = record()[1]
    ys[20] = np.nan
    mhe = estimator(certificate)
    watch = followed(certificate, mhe)
    expected = [watch.check(mhe.update(y)) for y in ys]
    mhe = estimator(certificate)
    watch = followed(certificate, mhe)
    for t, y in enumerate(ys):
        if t % 7 == 3:
            state = watch.state_dict()
            watch = followed(certificate, estimator(certificate), 99.0)
            watch.load_state_dict(state)
        np.testing.assert_equal(vars(watch.check(mhe.update(y))), vars(expected[t]))
    for wrong in ({}, {**state, "observer": [1.0]}, {**state, "radius": "x"}):
        with pytest.raises(InvalidInputError, match="no monitor of this observer"):
            watch.load_state_dict(wrong)
    with pytest.raises(InvalidInputError, match=r"pass certificate\.observer_bound"):
        Monitor(certificate, estimator(certificate), initial_error=1.0).state_dict()


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
def test_the_measured_cost_may_give_less():
    # An observer that is slow to forget a large initial error, and a model without disturbances.
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1e4, noise=1.0)
    certificate = certify(
        scalar(), qpmhe.Luenberger([[-0.45]]), cost, horizon=5, region=box(-90.0, 90.0),
        sizes=Sizes(1e-6, 1e-6),
    )
    mhe = estimator(certificate, horizon=5, initial_state=[60.0], max_qps=5)
    watch = Monitor(certificate, mhe, initial_error=60.0)
    alone = followed(certificate, mhe, 60.0)
    x, kinds = np.array([0.0]), []
    for _ in range(12):
        estimate = mhe.update(x)
        reading = watch.check(estimate)
        kinds.append(reading.kind)
        x = 0.5 * x
        assert np.linalg.norm(x - estimate.state) <= reading.error <= alone.check(estimate).error
    assert set(kinds) <= {"observer", "measured"}
    assert kinds[-1] == "measured"


# The theorem's hypotheses

IN_REGION = {"candidate in region", "estimate in region"}
ASSUMED = {
    "detectability": Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.01),
    "stability": ObserverStability.assumed(rho=0.5, C_p=1.0, C_w=2.0, C_v=0.6, kappa=0.3),
}


def made(*, f=None, gain=0.3, unit=1.0, side=10.0, m=0, **options):
    """A scalar system whose assumed constants are exact, with its certificate."""
    f = f or ((lambda x, u: 0.8 * x + u) if m else (lambda x: 0.8 * x))
    weight = 1.0 if unit == 1.0 else 1e-12 / unit**2
    cost = qpmhe.QuadraticCost(prior=weight, disturbance=2.0 * weight, noise=weight)
    return certify(
        scalar(f, m=m, **options), qpmhe.Luenberger([gain]), cost, horizon=3,
        region=box(-side * unit, side * unit), inputs=box(-1.0, 1.0) if m else None, **ASSUMED,
    )


def test_on_an_ordinary_run_everything_holds():
    certificate, y = made(), np.random.default_rng(0).standard_normal(20)
    run, watch = monitored_run(certificate, estimator(certificate), y)
    assert len(run) == watch.steps == watch.applied == 20
    assert watch.missed == dict.fromkeys(HYPOTHESES, 0)
    assert watch.summary() == "The certificate applied at 20 of 20 samples."
    assert watch.reason == "there is no bound of the observer"
    np.testing.assert_array_equal(run.states, estimator(certificate).run(y).states)


def model_lost(x):
    return 0.8 * x if x[0] < 2.0 else np.full(1, np.nan)


JACOBIANS = {"f_jacobian": lambda x: np.array([[0.8]]), "h_jacobian": lambda x: np.eye(1)}


@pytest.mark.parametrize(
    ("options", "record", "applied", "failed"),
    [
        ({}, [1.0] * 4 + [np.nan] + [1.0] * 7, 4, "complete"),
        ({"gain": 0.4}, [1.0] * 5, 0, "kappa"),  # the certificate was given 0.3
        ({"f": model_lost, "side": 1.0, **JACOBIANS}, [0.0, 20.0, 20.0, 0.0], 2, "complete"),
    ],
)
def test_a_certificate_ends_at_the_first_failure(options, record, applied, failed):
    certificate = made(**options)
    _, watch = monitored_run(certificate, estimator(certificate, max_qps=0), record)
    assert watch.applied == applied
    assert failed in watch.to_dict()["failed"]
    assert f"at sample {applied} it was lost (" in watch.summary()
    if len(record) == 12:
        assert watch.missed["complete"] == 3  # the window holds it for three samples


def test_leaving_the_region_is_seen_one_step_later():
    certificate = made(side=1.0)
    mhe = estimator(certificate, max_qps=0)
    watch = Monitor(certificate, mhe)
    seen = [set(watch.check(mhe.update(y)).failed) for y in (0.0, 10.0, *[0.0] * 8)]
    # z(2) = 3 is the newest state of the second step, and in the window from the third on.
    assert seen[:3] == [set(), set(), IN_REGION]
    assert seen[-1] == set()
    assert not watch.applies
    assert watch.applied == 2


def test_violated_sets_do_not_matter():
    certificate = made(noises=box(-0.1, 0.1))
    mhe = estimator(certificate, max_qps=0)
    estimate = mhe.update(5.0)
    assert qpmhe.Status.CANDIDATE_OUTSIDE in estimate.status
    assert failed_hypotheses(certificate, estimate) == ()


def test_candidates_of_another_observer_are_seen():
    certificate = made(states=box(-1.0, 1.0))  # projected, in a metric that is not certified
    mhe = estimator(certificate)
    mhe.update(5.0)
    assert "observer candidate" in failed_hypotheses(certificate, mhe.update(0.0))
    # Another gain within kappa: no bound on its size can show it.
    certificate = made()
    mhe = qpmhe.MovingHorizonEstimator(
        certificate.system, qpmhe.Luenberger([0.1]), certificate.cost, horizon=3,
        initial_state=[0.0], max_qps=0,
    )
    assert failed_hypotheses(certificate, mhe.update(1.0)) == ("observer candidate",)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_what_does_not_hold_is_seen_in_any_unit(unit):
    certificate = made(unit=unit)
    mhe = estimator(certificate)
    assert failed_hypotheses(certificate, mhe.update(0.9 * unit)) == ()
    estimate = mhe.update(4.0 * unit)
    for wrong, factor in (("cost", 0.999), ("candidate_cost", 1.001), ("cost", 1e9)):
        stated = getattr(estimate, wrong)
        assert failed_hypotheses(certificate, estimate) == ()
        setattr(estimate, wrong, factor * stated)
        assert failed_hypotheses(certificate, estimate) == ("cost decrease",)
        setattr(estimate, wrong, stated)
    moved = mhe.update(0.5 * unit)
    moved.candidate[-1] += 1e-3 * unit  # a correction that is not the gain's
    assert "observer candidate" in failed_hypotheses(certificate, moved)


def test_inputs_belong_to_the_window_and_to_the_region():
    certificate = made(m=1)
    mhe = estimator(certificate)
    watch = Monitor(certificate, mhe)
    for u in (0.5, -0.5, 0.2, 0.9, 0.1):
        assert watch.check(mhe.update(0.3, [u]), [u]).failed == ()
    late = mhe.update(0.3, [1.5])
    assert set(watch.check(late, [1.5]).failed) == IN_REGION
    with pytest.raises(ShapeError, match="inputs"):
        failed_hypotheses(certificate, late, np.zeros((1, 1)))
    # Other inputs than those that acted do not explain the trajectories.
    assert "cost decrease" in failed_hypotheses(certificate, late, np.zeros((3, 1)))
    with pytest.raises(ShapeError, match="inputs"):
        monitored_run(certificate, estimator(certificate), np.zeros(3), np.zeros((2, 1)))


def test_a_prior_from_the_observer_has_its_lower_bound():
    system = made().system
    observer = qpmhe.SteadyStateKalman(system, [0.0], disturbance=0.5, noise=1.0)
    prior = qpmhe.ObserverPrior(minimum=0.1, maximum=10.0)
    certificate = certify(
        system, observer, qpmhe.QuadraticCost(prior=prior, disturbance=2.0, noise=1.0), horizon=3,
        region=box(-10.0, 10.0), detectability=ASSUMED["detectability"],
    )
    y = np.random.default_rng(1).standard_normal(8)
    assert monitored_run(certificate, estimator(certificate), y, initial_error=1.0)[1].applied == 8


def test_what_the_theorem_does_not_cover_leaves_the_observers_bound(certificate):
    mhe = estimator(certificate, arrival="smoothed")
    watch = Monitor(certificate, mhe, initial_error=START)
    readings = [watch.check(mhe.update(y)) for y in record()[1]]
    assert readings[-1].lost is None
    assert not watch.applies
    assert watch.summary().startswith("The observer's bound held at all 30 samples. The theorem do")
    assert "smoothed" in watch.summary()
    mhe = estimator(certificate)
    watch = Monitor(certificate, mhe, initial_error=START)
    for y in record()[1][:8]:
        watch.check(mhe.update(y))
    assert watch.check(mhe.amend(6, [3.0])).lost == 7
    watch.check(mhe.update([0.0]))
    assert "held up to sample 7: there the observer's state before was changed" in watch.summary()
    assert not watch.applies


def test_a_monitor_is_for_one_estimator_from_its_start(certificate):
    assumed, bound = made(), certificate.observer_bound
    used, mhe = estimator(assumed), estimator(certificate)
    used.update(0.0)
    other = qpmhe.MovingHorizonEstimator(
        certificate.system, qpmhe.Luenberger(2.0 * GAIN), COST, horizon=4, initial_state=[0.0, 0.0]
    )
    twin = qpmhe.MovingHorizonEstimator(
        linear(), certificate.observer, COST, horizon=4, initial_state=[0.0, 0.0]
    )
    for asked, error, words in (
        (lambda: Monitor(assumed, estimator(made())), MismatchError, "another system"),
        (lambda: Monitor(assumed, used), InvalidInputError, "reset"),
        (lambda: Monitor(assumed, estimator(assumed, horizon=4)), OptionError, "horizon"),
        (lambda: Monitor(assumed, estimator(assumed, candidate="reinitialized")), OptionError,
         "reinitialized"),
        (lambda: Monitor(assumed, estimator(assumed, arrival="smoothed")), OptionError, "smoothed"),
        (lambda: bound.along(other.run(record()[1]), initial_error=START), MismatchError,
         r"\[\[0.4\], \[0.1\]\]; the estimator's is \[\[0.8\]"),
        (lambda: Monitor(bound, other, initial_error=START), MismatchError, r"is \[\[0.8\]"),
        (lambda: Monitor(bound, twin, initial_error=START), MismatchError, "another System object"),
        (lambda: Monitor(bound, mhe), OptionError, "initial_error is missing"),
        (lambda: Monitor(None, mhe), InvalidInputError, "NoneType; expected a Certificate or an"),
        (lambda: Monitor(assumed, estimator(assumed)).check(None), InvalidInputError,
         r"NoneType; .* MovingHorizonEstimator\.update"),
        (lambda: certificate.bound(np.ones(3), initial_error=START), InvalidInputError,
         "type ndarray; expected"),
    ):
        with pytest.raises(error, match=words):
            asked()
    watch, short = Monitor(assumed, estimator(assumed)), estimator(assumed, horizon=1)
    watch.check(short.update(0.1))
    with pytest.raises(MismatchError, match="1 stages at time 1; expected 2"):
        watch.check(short.update(0.2))
