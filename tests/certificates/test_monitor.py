"""At run time: the set around the observer, what ends it, and the theorem's hypotheses."""

import re

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import MismatchError, Monitor, Sizes, certify, certify_observer
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.errors import InvalidInputError, OptionError, ShapeError

from .helpers import box, linear, scalar, unit_cost

A = np.array([[0.9, 0.2], [-0.1, 0.7]])
GAIN = np.array([[0.4], [0.1]])
COST = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=100.0 * np.eye(2), noise=25.0)
SIZES = Sizes(box([-0.1, -0.1], [0.1, 0.1]), 0.2)
START = np.array([1.0, -1.0])


def plant(**sets):
    return linear(A, [[1.0, 0.0]], **sets)


@pytest.fixture(scope="module")
def certificate():
    region = box([-10.0, -10.0], [10.0, 10.0])
    return certify(plant(), qpmhe.Luenberger(GAIN), COST, horizon=4, region=region, sizes=SIZES)


def estimator(certificate, **options):
    parts = {name: getattr(certificate, name) for name in ("system", "observer", "cost")}
    usual = {"horizon": 4, "initial_state": np.zeros(certificate.system.n), "max_qps": 1}
    return qpmhe.MovingHorizonEstimator(**parts | usual | options)


def followed(certificate, mhe, start=START, **options):
    return Monitor(certificate.observer_bound, mhe, initial_error=start, **options)


def record(seed=0, steps=30):
    """States and measurements with disturbances and noises of the stated sizes."""
    rng, x = np.random.default_rng(seed), [START]
    for _ in range(steps):
        x.append(A @ x[-1] + rng.uniform(-0.1, 0.1, 2))
    return np.array(x), np.array(x)[:-1, :1] + rng.uniform(-0.2, 0.2, (steps, 1))


@pytest.mark.parametrize("options", [
    {"engine": "python", "arrival": "smoothed", "warm_start": True},
    {"engine": "compiled", "max_qps": 0},
])
def test_the_truth_is_in_the_set_around_the_observer(certificate, options):
    for seed in range(3):
        states, ys = record(seed)
        mhe = estimator(certificate, **options)
        watch = followed(certificate, mhe)
        readings = [watch.check(mhe.update(y)) for y in ys]
        # The same along the run as a whole, and less for the signals that acted.
        run = estimator(certificate, **options).run(ys)
        band = certificate.observer_bound.along(run, initial_error=START)
        assert (watch.lost, band.lost) == (None, None)
        for name in ("radius", "lower", "upper", "error"):
            found = [getattr(one, name) for one in readings]
            np.testing.assert_allclose(getattr(band, name)[1:], found, rtol=1e-9)
        assert ((band.lower <= states) & (states <= band.upper)).all()
        w, v = states[1:] - states[:-1] @ A.T, ys - states[:-1, :1]
        known = certificate.bound(run, w, v, initial_error=START)
        assert (np.linalg.norm(states - run.states, axis=1) <= known).all()
        assert (known <= band.error * (1.0 + 1e-9)).all()


EVENTS = {  # what happens in place of the sample 7, the sample that is lost, and the reason
    "missing": (lambda mhe, y: [mhe.update([np.nan])], 7, "a measurement was missing"),
    "amended": (lambda mhe, y: [mhe.update(y), mhe.amend(6, [3.0])], 7, "late measurement"),
    "began again": (lambda mhe, y: [mhe.reset() or mhe.update(y)], 0, "restarted"),
    "not shown": (
        lambda mhe, y: [mhe.update(y) and mhe.update(y)], 8, "from 7 to 7 were not shown"),
    # z = 10.4, and the truth may be in the region
    "huge": (lambda mhe, y: [mhe.update([26.0])], 8, "the observer was outside of the region"),
}


@pytest.mark.parametrize("event", EVENTS)
def test_each_event_ends_the_bound_at_its_sample(certificate, event):
    what, sample, words = EVENTS[event]
    mhe, ys = estimator(certificate), record()[1]
    watch, readings = followed(certificate, mhe), []
    for t, y in enumerate(ys):
        readings += [watch.check(each) for each in (what(mhe, y) if t == 7 else [mhe.update(y)])]
    lost = [one.lost for one in readings]
    first = lost.index(sample)
    assert (set(lost[:first]), set(lost[first:])) == ({None}, {sample})
    assert np.isfinite(readings[first - 1].error)
    for one in readings[first:]:
        assert words in one.reason
        assert np.isnan([one.radius, one.error, *one.lower, *one.upper]).all()
    if event in ("missing", "huge"):  # a run alone shows it, too
        ys[7] = np.nan if event == "missing" else 26.0
        band = certificate.observer_bound.along(estimator(certificate).run(ys), initial_error=START)
        assert (band.lost, band.reason) == (sample, watch.reason)


def test_weights_do_not_matter_to_the_observer_and_wrong_sizes_are_found_out(certificate):
    mhe = estimator(certificate)
    watch = followed(certificate, mhe)
    assert {watch.check(mhe.update(y, noise_weight=[[9.0]])).lost for y in record()[1]} == {None}
    mhe.reset()
    watch = followed(certificate, mhe, 0.0, sizes=Sizes(0.0, 0.0))
    assert [watch.check(mhe.update([24.0])).lost for _ in range(4)] == [None, 1, 1, 1]
    run = estimator(certificate).run(np.full((4, 1), 24.0))
    band = certificate.observer_bound.along(run, 0.0, 0.0, initial_error=0.0)
    assert (band.lost, band.reason) == (1, watch.reason)
    assert "larger than stated" in band.reason


def test_steps_and_inputs_that_were_not_certified():
    system = qpmhe.System.from_ode(
        lambda x, u: -x + u, lambda x, u: x, dt=0.1, n=1, p=1, m=1, method="euler"
    )
    certificate = certify(
        system, qpmhe.Luenberger([[0.2]]), unit_cost(), horizon=4, region=box(-5.0, 5.0),
        inputs=box(-1.0, 1.0), sizes=Sizes(0.1, 0.1),
    )
    for u, kept, shown, words in (
        (0.3, {}, {"dt": 0.07}, "length 0.07, and 0.1 is certified"),
        (0.3, {"dt": 0.07}, {}, "another length"), (1.5, {}, {}, "input .* outside"),
    ):
        mhe = estimator(certificate)
        watch = followed(certificate, mhe, 0.5)
        for t in range(4):
            assert watch.check(mhe.update([0.2], [0.3]), [0.3], dt=0.1 if t else None).lost is None
        reading = watch.check(mhe.update([0.2], [u], **kept), [u], **shown)
        assert reading.lost == 4
        assert re.search(words, reading.reason)
    run = estimator(certificate).run(np.zeros(9), np.where(np.arange(9) == 5, -1.5, 0.3)[:, None])
    band = certificate.observer_bound.along(run, initial_error=0.5)
    assert (band.lost, band.reason) == (5, "the input [-1.5] is outside of what was certified")
    with pytest.raises(ShapeError, match=r"u has shape \(0,\)"):
        watch.check(mhe.update([0.2], [0.3]))


@pytest.mark.parametrize(("is_certified", "name"), [
    (True, "observer"), (False, "observer"), (True, "diagonal"),
])
def test_a_projection_onto_x_keeps_the_bounds_in_the_certified_metric_alone(is_certified, name):
    projects = is_certified and name == "observer"
    X, projected = box([0.0, -10.0], [10.0, 0.5]), 0  # which the observer often leaves
    system, rng = plant(states=X), np.random.default_rng(0)
    stability = certify_observer(system, qpmhe.Luenberger(GAIN), X, rho=0.9)
    observer = qpmhe.Luenberger(GAIN, metric=stability.P if is_certified else None)
    certificate = certify(system, observer, COST, horizon=4, sizes=SIZES, stability=stability)
    assert (certificate.of().model_lipschitz is not None) is is_certified
    for _ in range(8):
        x = [np.array([1.0, 0.2])]
        mhe = estimator(certificate, initial_state=[0.0, 0.5], projection_metric=name)
        watch = Monitor(certificate, mhe, initial_error=x[0] - mhe.observer_state)
        w, v = rng.choice([-0.1, 0.1], (25, 2)), rng.choice([-0.2, 0.2], (25, 1))
        errors, before = [], projected
        for t in range(25):
            estimate, ahead = mhe.update(x[t][:1] + v[t]), A @ x[t]
            x.append(np.clip(ahead + w[t], X.lower, X.upper))
            w[t] = x[-1] - ahead
            reading, error = watch.check(estimate), np.linalg.norm(x[-1] - estimate.state)
            projected += qpmhe.Status.OBSERVER_PROJECTED in estimate.status
            assert reading.lost is not None or error <= reading.error
            errors.append(error)
        lengths = (np.linalg.norm(e, axis=1) for e in (w, v))
        limit = certificate.of().result.bound(np.linalg.norm(x[0] - [0.0, 0.5]), *lengths)
        assert not projects or (errors <= limit[1:]).all()
        assert watch.applies is (projects or projected == before)
        assert watch.applies or "another metric than the certified one" in watch.reason
    assert projected > 15


def test_a_monitor_continues_from_its_state(certificate):
    mhe, again = estimator(certificate), estimator(certificate)
    whole, watch = followed(certificate, mhe), followed(certificate, again)
    for t, y in enumerate(record()[1]):
        state = watch.state_dict()
        watch = followed(certificate, estimator(certificate), 99.0)
        watch.load_state_dict(state)
        y = [np.nan] if t == 20 else y
        found, expected = watch.check(again.update(y)), whole.check(mhe.update(y))
        np.testing.assert_equal(vars(found), vars(expected))
    # Of another search, with another P.
    watch.load_state_dict(state | {"metric": 4.0 * state["metric"], "radius": 2.0})
    assert watch.state_dict()["radius"] == pytest.approx(1.0, rel=1e-9)
    with pytest.raises(InvalidInputError, match="not come from a monitor of this observer"):
        watch.load_state_dict({**state, "observer": [1.0]})


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
def test_the_measured_cost_may_give_less():
    # An observer that is slow to forget a large initial error, and a model without disturbances.
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1e4, noise=1.0)
    certificate = certify(
        scalar(), qpmhe.Luenberger([[-0.45]]), cost, horizon=5, region=box(-90.0, 90.0),
        sizes=Sizes(1e-6, 1e-6),
    )
    mhe = estimator(certificate, horizon=5, initial_state=[60.0], max_qps=5)
    watch, alone = Monitor(certificate, mhe, initial_error=60.0), followed(certificate, mhe, 60.0)
    x = np.zeros(1)
    for _ in range(12):
        estimate = mhe.update(x)
        reading = watch.check(estimate)
        x = 0.5 * x
        assert np.linalg.norm(x - estimate.state) <= reading.error <= alone.check(estimate).error
    assert reading.kind == "measured"


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
def test_a_restored_estimate_ends_the_theorem_and_leaves_the_measured_bound():
    """The noises' set excludes the candidate, and the prior makes a way into it dear."""
    cost = qpmhe.QuadraticCost(prior=100.0, disturbance=100.0, noise=1.0)
    certificate = certify(
        scalar(noises=box(-3.0, 3.0)), qpmhe.Luenberger([[-0.45]]), cost, horizon=5,
        region=box(-90.0, 90.0), sizes=Sizes(1e-6, 1e-6),
    )
    mhe = estimator(
        certificate, horizon=5, initial_state=[60.0], max_qps=5, infeasible="restore"
    )
    watch, x = Monitor(certificate, mhe, initial_error=60.0), np.zeros(1)
    restored, measured = 0, 0
    for _ in range(20):
        estimate = mhe.update(x)
        reading = watch.check(estimate)
        restored += qpmhe.Status.RESTORED in estimate.status
        measured += reading.kind == "measured"
        assert watch.applies == (not restored)
        assert np.linalg.norm(x - estimate.state) <= reading.error
    assert restored > 2
    assert measured > 10
    assert re.search(r"^from sample \d+ on: .*\(RESTORED\)", watch.barred)
    assert watch.lost is None


def changed(estimate, **values):
    """The estimate with other numbers."""
    for name, value in values.items():
        setattr(estimate, name, value(getattr(estimate, name)))
    return estimate


BARS = {  # the sample 6, and why the theorem's bound ends there; the observer's need not
    "missing": (lambda mhe, y: mhe.update([np.nan]), "a measurement was missing"),
    "cost of less": (lambda mhe, y: changed(mhe.update(y), cost=lambda J: 0.999 * J), "cost is"),
    "estimate": (lambda mhe, y: changed(
        mhe.update(y), trajectory=lambda x: np.add(x, [0.0, 50.0])), "the estimate left"),
    "candidate": (lambda mhe, y: changed(
        mhe.update(y), candidate=lambda z: z + 1e-3 * np.eye(len(z), 2)), "not the observer's"),
    "amended": (lambda mhe, y: mhe.update(y) and mhe.amend(5, y), "was changed|estimated again"),
}


@pytest.mark.parametrize(("unit", "events"), [(1.0, BARS), (1e9, ["cost of less"])])
def test_the_theorem_ends_where_a_hypothesis_does_in_any_unit(unit, events):
    weights = {"prior": np.eye(2), "disturbance": 100.0 * np.eye(2), "noise": np.array([[25.0]])}
    certificate = certify(
        plant(), qpmhe.Luenberger(GAIN), horizon=4, sizes=Sizes(0.2 * unit, 0.2 * unit),
        cost=qpmhe.QuadraticCost(**{name: each / unit**2 for name, each in weights.items()}),
        region=box([-10.0 * unit] * 2, [10.0 * unit] * 2),
    )
    for event in events:
        what, words = BARS[event]
        mhe, ys = estimator(certificate), unit * record()[1]
        watch = Monitor(certificate, mhe, initial_error=unit * START)
        for y in ys[:6]:
            watch.check(mhe.update(y))
        assert watch.summary() == "The observer's bound held at all 6 samples. The theorem applies."
        watch.check(what(mhe, ys[6]))
        assert re.search(f"^from sample 6 on: .*({words})", watch.barred), event
        watch.check(mhe.update(ys[7]))  # the bound goes back to the first sample
        assert f"The theorem does not apply: {watch.barred}" in watch.summary()


def test_what_the_theorem_does_not_cover_leaves_the_observers_bound(certificate):
    for options, words in (
        ({"arrival": "smoothed"}, "smoothed"), ({"candidate": "reinitialized"}, "reinitialized"),
        ({"horizon": 3}, "horizon 3"), ({"cost": unit_cost(2)}, "another cost"),
    ):
        mhe = estimator(certificate, **options)
        watch = Monitor(certificate, mhe, initial_error=START)
        assert words in watch.barred
        reading = watch.check(mhe.update([0.1]))
        assert (reading.lost is not None) == ("candidate" in options)
        mhe.reset()  # a run alone shows it, too
        band = certificate.observer_bound.along(mhe.run([0.1]), initial_error=START)
        assert (band.lost, band.reason) == (reading.lost, reading.reason)


def test_a_monitor_is_for_one_estimator(certificate):
    bound, mhe = certificate.observer_bound, estimator(certificate)
    other = estimator(certificate, observer=qpmhe.Luenberger(2.0 * GAIN))
    nine = box([-9.0, -9.0], [9.0, 9.0])
    for asked, error, words in (
        (lambda: bound.along(other.run(record()[1]), initial_error=START), MismatchError,
         r"\[\[0.4\], \[0.1\]\]; the estimator's is \[\[0.8\]"),
        (lambda: followed(certificate, estimator(certificate, system=plant(states=nine))),
         MismatchError, "the set X differs"),
        (lambda: Monitor(None, mhe, initial_error=START), InvalidInputError, "NoneType; expected"),
        (lambda: Monitor(certificate, mhe, initial_error=1.0).state_dict(), InvalidInputError,
         r"pass certificate\.observer_bound"),
    ):
        with pytest.raises(error, match=words):
            asked()


def test_a_model_is_looked_up_once(certificate, monkeypatch):
    """To look a model up is to compare its traces with the functions again."""
    mhe = estimator(certificate)
    watch = Monitor(certificate, mhe, initial_error=START)
    monkeypatch.setattr(qpmhe.System, "model", lambda *_: pytest.fail("looked up in a sample"))
    readings = [watch.check(mhe.update(y)) for y in record(steps=8)[1]]
    assert readings[-1].reason == ""


def test_arguments_that_are_not_of_the_estimator_are_refused(certificate):
    mhe = estimator(certificate)
    first = mhe.update([0.1])
    other = qpmhe.MovingHorizonEstimator(
        linear(0.9, 1.0), qpmhe.Luenberger([[0.4]]), unit_cost(1), horizon=4, initial_state=[0.0])
    for given, options, error, words in (
        (first, {"u": "word"}, InvalidInputError, "u is 'word', which is not an array"),
        (first, {"u": [1.0]}, ShapeError, r"u has shape \(1,\); expected \(0,\)"),
        (first, {"dt": "word"}, OptionError, "dt is 'word'; expected a finite number > 0"),
        (first, {"dt": -1.0}, OptionError, r"dt is -1\.0; expected"),
        (other.update([0.1]), {}, InvalidInputError, r"\(1, 1\); expected one .* \(2, 1\)"),
    ):
        watch = followed(certificate, estimator(certificate))
        with pytest.raises(error, match=words):
            watch.check(given, **options)
        assert watch.check(first).lost is None  # as if it had not been asked
    with pytest.raises(OptionError, match="sizes is 'word'; expected Sizes"):
        followed(certificate, estimator(certificate), sizes="word")


@pytest.mark.parametrize("value", [
    ZeroDivisionError(), np.array([np.nan, 0.0]), np.array([np.inf, 0.0]), None, "word",
    np.zeros(7),
], ids=["raises", "nan", "huge", "None", "text", "shape"])
def test_a_model_that_fails_in_a_check_ends_the_bound(value):
    """Behind the update that it served: of the observer's step, or of the certified values."""
    fails = []

    def f(x):
        if fails and fails[0](x):
            if isinstance(value, Exception):
                raise value
            return value
        return x @ A.T

    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    bound = bound_observer(
        system, qpmhe.Luenberger(GAIN), COST, box([-10.0, -10.0], [10.0, 10.0]), sizes=SIZES)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), COST, horizon=4, initial_state=[0.5, 0.25], max_qps=0)
    points = bound.stability.model.points
    for where, words in (
        (lambda x: True, "the model could not be evaluated"),
        (lambda x: (x == points[0]).all(), "the system is another than was certified: f "),
    ):
        mhe.reset()
        watch = Monitor(bound, mhe, initial_error=START, guard=True)
        estimate = mhe.update([0.1])
        fails.append(where)
        reading = watch.check(estimate)
        fails.clear()
        assert reading.lost == 0
        assert reading.reason.startswith(words)
        assert reading.unguarded == f"from sample 0 on: {reading.reason}"
        np.testing.assert_array_equal(reading.state, estimate.state)
