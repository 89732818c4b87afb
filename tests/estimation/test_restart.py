"""An observer that has run away, and the one that takes its place by its predictions."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.certificates import Monitor, Sizes, certify
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import OptionError

ENGINES = pytest.mark.parametrize("engine", ["python", pytest.param(
    "compiled", marks=pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
)])
pytestmark = [
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ModelWarning"),
]


def rate(x):
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    return np.stack([10.0 * (b - a), a * (28.0 - c) - b, a * b - 8.0 / 3.0 * c], axis=-1)


def lorenz(x, dt=0.1):
    one = rate(x)
    two = rate(x + 0.5 * dt * one)
    three = rate(x + 0.5 * dt * two)
    return x + dt / 6.0 * (one + 2.0 * two + 2.0 * three + rate(x + dt * three))


def kalman(f, h, n, start, covariances, horizon, innovation=None, **options):
    prior, q, r = covariances
    terms = {"disturbance": q * np.eye(n), "noise": [[r]]}
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, h, n=n, p=1),
        qpmhe.ExtendedKalman(prior=prior * np.eye(n), innovation=innovation, **terms),
        qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **terms),
        horizon=horizon, initial_state=start, **options,
    )


def restarts(run):
    return np.flatnonzero(run.flags & Status.RESTARTED.value)


def chaos(seed, steps=200):
    """Lorenz's system without X, its first state measured every 0.1 s, and a poor first guess."""
    rng, x = np.random.default_rng(seed), np.array([5.0, 5.0, 20.0])
    for _ in range(500):
        x = lorenz(x, 0.01)
    start, states, outputs = x + 10.0 * rng.standard_normal(3), [x], []
    for _ in range(steps):
        outputs.append(x[0] + rng.standard_normal())
        x = lorenz(x) + 0.1 * rng.standard_normal(3)
        states.append(x)

    def run(**options):
        mhe = kalman(
            lorenz, lambda x: x[..., :1], 3, start, (25.0, 0.01, 1.0), 10, max_qps=2, **options
        )
        return mhe.run(outputs)

    return np.array(states), run


@pytest.mark.parametrize("seed", [0, 1, 2])
@ENGINES
def test_lorenz_without_a_set_of_states(seed, engine):
    states, run = chaos(seed)
    plain, again = run(engine=engine), run(restart=True, engine=engine)
    assert np.abs(plain.states).max() > 1e6  # the filter takes the estimates with it
    assert np.abs(again.states).max() < 100.0
    assert np.sqrt(np.mean((again.states - states)[50:] ** 2)) < 10.0
    times = restarts(again)
    assert 1 <= len(times) <= 8
    assert np.diff(times).min(initial=10) >= 10
    assert np.all(again.costs <= again.candidate_costs)
    # Up to the first one, nothing differs.
    np.testing.assert_array_equal(again.states[: times[0] + 1], plain.states[: times[0] + 1])


def test_a_cubic_sensor():
    """A filter that a flat sensor has made too sure of itself."""
    outputs = 2.0**3 + 0.1 * np.random.default_rng(0).standard_normal(30)

    def run(**options):
        mhe = kalman(
            lambda x: x, lambda x: x**3, 1, [0.05], (1.0, 1e-6, 0.01), 8, max_qps=2, **options
        )
        return mhe.run(outputs)

    plain, again = run(), run(restart=True)
    errors = [np.abs(one.states[12:20] - 2.0).max() for one in (plain, again)]
    assert errors[0] > 0.3
    assert errors[1] < 0.6 * errors[0]
    assert 1 <= len(restarts(again)) <= 2


def test_a_gate_that_has_shut_on_the_truth():
    rng, a = np.random.default_rng(0), np.array([[1.0, 0.1], [0.0, 1.0]])
    x, states, outputs = np.zeros(2), [np.zeros(2)], []
    for t in range(120):
        outputs.append(x[0] + 0.1 * rng.standard_normal())
        x = a @ x + 0.01 * rng.standard_normal(2) + (t == 40) * np.array([5.0, 0.0])
        states.append(x)

    def run(**options):
        mhe = kalman(
            lambda x: x @ a.T, lambda x: x[..., :1], 2, np.zeros(2), (1.0, 1e-4, 0.01), 8,
            qpmhe.Gate(reopen=1000), max_qps=1, **options,
        )
        return mhe.run(outputs)

    plain, again = run(), run(restart=True)
    assert (plain.flags[42:] & Status.ALL_REJECTED.value).all()
    assert np.abs(plain.observer_states - states)[60:, 0].min() > 4.0
    assert np.abs(again.observer_states - states)[60:, 0].max() < 0.5
    assert len(restarts(again)) == 1
    assert 48 <= restarts(again)[0] <= 60


@pytest.mark.parametrize("seed", range(4))
def test_a_filter_that_works_is_left_alone(seed):
    rng, a = np.random.default_rng(seed), np.array([[1.0, 0.1], [-0.1, 0.9]])
    x, outputs = np.zeros(2), []
    for _ in range(200):
        outputs.append(x[0] + 0.1 * rng.standard_normal())
        x = a @ x + 0.03 * rng.standard_normal(2)

    def run(**options):
        mhe = kalman(
            lambda x: x @ a.T, lambda x: x[..., :1], 2, np.zeros(2), (1.0, 9e-4, 0.01), 8,
            max_qps=1, **options,
        )
        return mhe.run(outputs)

    plain, again = run(), run(restart=True)
    assert restarts(again).size == 0
    np.testing.assert_array_equal(again.states, plain.states)
    np.testing.assert_array_equal(again.observer_states, plain.observer_states)


@pytest.mark.parametrize("project", [False, True])
def test_an_observer_that_is_left_alone_filters_as_ever(project):
    """Without a restart, `filtered` equals that of an estimator that has no second observer."""
    rng, found = np.random.default_rng(0), []
    outputs = np.sin(0.3 * np.arange(60)) + 1.5 + 0.05 * rng.standard_normal(60)
    terms = {"prior": [[1.0]], "disturbance": [[0.1]], "noise": [[0.01]]}
    for restart in (False, True):
        system = qpmhe.System(
            lambda x: 0.95 * x + 0.05, lambda x: x**2, n=1, p=1,
            states=qpmhe.Box([0.5], [1.6]) if project else None,
        )
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.ExtendedKalman(**terms), qpmhe.QuadraticCost.from_covariances(**terms),
            horizon=6, initial_state=[1.0], max_qps=0, restart=restart,
        )
        found.append([mhe.update([y]) for y in outputs])
    plain, other = found
    assert not any(Status.RESTARTED in one.status for one in other)
    for one, two in zip(plain, other, strict=True):
        assert (one.status, one.filtered.tolist()) == (two.status, two.filtered.tolist())


def shut(**options):
    """An estimator whose gate has just shut, and what is measured next."""
    mhe = kalman(
        lambda x: x, lambda x: x, 1, [0.0], (1.0, 1e-4, 0.01), 8, qpmhe.Gate(reopen=1000),
        max_qps=1, restart=True, **options,
    )
    for _ in range(10):
        mhe.update([0.0])
    return mhe


@ENGINES
def test_a_restarted_observer_starts_as_the_first_one_did(engine):
    mhe, history = shut(engine=engine), []
    for _ in range(30):
        history.append(mhe.state[0])
        estimate = mhe.update([4.0])
        if Status.RESTARTED in estimate.status:
            break
    assert Status.RESTARTED in estimate.status
    assert "restarted" not in estimate.message
    assert "prior's covariance" in estimate.explain()
    # The candidate is a Kalman filter from the estimate of eight samples before and P(0).
    z, variance = history[-8], 1.0
    assert estimate.candidate[0, 0] == z
    for k in range(8):
        gain = variance / (variance + 0.01)
        z, variance = z + gain * (4.0 - z), (1.0 - gain) * variance + 1e-4
        assert estimate.candidate[k + 1, 0] == pytest.approx(z, rel=1e-12)
    assert estimate.cost <= estimate.candidate_cost
    # Not again within a horizon, whatever comes.
    for _ in range(7):
        assert Status.RESTARTED not in mhe.update([-9.0]).status


@ENGINES
def test_a_snapshot_and_an_undone_step_keep_the_dwell(monkeypatch, engine):
    mhe, other = shut(engine=engine), shut(engine=engine)
    for _ in range(30):
        if Status.RESTARTED in mhe.update([4.0]).status:
            break
    other.load_state_dict(mhe.state_dict())
    for y in (*[-9.0] * 9, *[3.0] * 9):
        one, two = mhe.update([y]), other.update([y])
        assert one.status == two.status
        assert one.trajectory.tolist() == two.trajectory.tolist()
    # An interrupt in the middle of a step that restarts the observer takes it back.
    mhe = shut(engine=engine)
    for _ in range(30):
        last = mhe.state_dict()
        if Status.RESTARTED in mhe.update([4.0]).status:
            break
    mhe.load_state_dict(last)

    def interrupted(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("qpmhe.estimation.optimizer.Optimizer.improve", interrupted)
        if engine == "compiled":
            patched.setattr(mhe._engine, "_collect", interrupted)
        with pytest.raises(KeyboardInterrupt):
            mhe.update([4.0])
    assert str(mhe.state_dict()) == str(last)
    assert Status.RESTARTED in mhe.update([4.0]).status


def test_certificates_end_at_a_restart():
    a = np.array([[0.9, 0.2], [-0.1, 0.7]])
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=100.0)
    system = qpmhe.System(lambda x: x @ a.T, lambda x: x[..., :1], n=2, p=1)
    certificate = certify(
        system, qpmhe.Luenberger([[0.02], [0.0]]), cost, horizon=4,
        region=qpmhe.Box([-50.0, -50.0], [50.0, 50.0]), sizes=Sizes(1e-3, 1e-3),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, certificate.observer, cost, horizon=4, initial_state=[20.0, 20.0], max_qps=1,
        restart=True,
    )
    watch = Monitor(certificate, mhe, initial_error=[20.0, 20.0])
    for _ in range(12):
        estimate = mhe.update([0.0])
        watch.check(estimate)
        if Status.RESTARTED in estimate.status:
            break
        assert watch.lost is None
        assert watch.applies
    assert Status.RESTARTED in estimate.status
    assert watch.lost == estimate.time
    assert "RESTARTED" in watch.reason
    assert not watch.applies
    mhe.reset()
    band = certificate.observer_bound.along(
        mhe.run(np.zeros(12)), initial_error=[20.0, 20.0]
    )
    assert (band.lost, band.reason) == (watch.lost, watch.reason)


def test_options_that_contradict_it():
    with pytest.raises(OptionError, match=r"restart is True, but candidate='reinitialized'"):
        shut(candidate="reinitialized")
