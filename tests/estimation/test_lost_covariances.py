"""Observers whose covariance is lost start again from the initial one, and say so."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler

ENGINES = ["python", pytest.param("compiled", marks=pytest.mark.skipif(
    find_compiler() is None, reason="there is no C compiler"
))]
P, Q, R = np.diag([1.0, 1.0, 1e-6]), np.diag([1e-4, 1e-4, 1e-6]), np.array([[1e-4]])
TRUTH = 1.0 - 0.9 ** np.arange(40.0)
Y = TRUTH[:, None] + 1e-2 * np.random.default_rng(0).normal(size=(40, 1))
OBSERVERS = {
    "extended": lambda: qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R),
    "gated": lambda: qpmhe.ExtendedKalman(
        prior=P, disturbance=Q, noise=R, innovation=qpmhe.Gate()
    ),
    "weighted": lambda: qpmhe.ExtendedKalman(
        prior=P, disturbance=Q, noise=R, innovation=qpmhe.HuberInnovation()
    ),
    "unscented": lambda: qpmhe.UnscentedKalman(prior=P, disturbance=Q, noise=R),
}


def steep_until_six(x):
    """A lag; a state that stays at zero, with a slope of 1e100 while the clock is below 6."""
    slope = np.where(x[..., 2] < 6.0, 1e100, 0.5)
    return np.stack(
        [0.9 * x[..., 0] + 0.1, slope * x[..., 1], x[..., 2] + 1.0], axis=-1
    )


def first(x):
    return x[..., :1]


def estimator(observer, engine, qps=0, f=steep_until_six, start=(0.0, 0.0, 0.0), **options):
    n = len(start)
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, first, n=n, p=1, **options), observer,
        qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), disturbance=Q[:n, :n], noise=R
        ),
        horizon=5, initial_state=start, max_qps=qps, engine=engine,
    )
    assert mhe.engine == engine
    return mhe


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("qps", [0, 2])
@pytest.mark.parametrize("name", OBSERVERS)
def test_an_observer_recovers_once_the_model_is_sane_again(name, qps, engine):
    """Where a stage without a covariance is held, so is the clock: the model stays steep."""
    run = estimator(OBSERVERS[name](), engine, qps).run(Y)
    # P overflows at every second step that starts from P(0).
    lost = [Status.OBSERVER_RESET in one for one in run.statuses]
    assert np.flatnonzero(lost).tolist() == [1, 3, 5]
    assert not run.share(Status.MODEL_FAILED)
    assert not run.share(Status.SENSORS_REJECTED)
    assert (run.costs >= 0.0).all()
    assert (run.costs <= run.candidate_costs).all()
    np.testing.assert_allclose(run.filtered[:, 2], np.arange(40.0), atol=1e-6)
    assert np.abs(run.filtered[6:, 0] - TRUTH[6:]).max() < 0.05
    # Without the steep state: a lag alone, from the last reset on.
    lag = estimator(
        qpmhe.ExtendedKalman(prior=P[:1, :1], disturbance=Q[:1, :1], noise=R), "python", 0,
        lambda x: 0.9 * x + 0.1, run.observer_states[6, :1],
    ).run(Y[6:])
    if qps == 0 and name != "weighted":
        np.testing.assert_allclose(
            run.observer_states[7:, 0], lag.observer_states[1:, 0], rtol=1e-9
        )


@pytest.mark.parametrize("engine", ENGINES)
def test_what_was_lost_is_told_with_a_remedy(engine):
    mhe = estimator(OBSERVERS["extended"](), engine)
    mhe.update(Y[0])
    estimate = mhe.update(Y[1])
    assert Status.OBSERVER_RESET in estimate.status
    assert "initial one again" in estimate.explain()
    assert "no derivative is huge" in estimate.explain()
    # The step predicts: its disturbance is zero.
    assert not estimate.disturbances[-1].any()
    state, other = mhe.state_dict(), estimator(OBSERVERS["extended"](), engine)
    other.load_state_dict(state)
    for y in Y[2:12]:
        assert other.update(y).status == mhe.update(y).status
        np.testing.assert_array_equal(other.state, mhe.state)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("qps", [0, 2])
def test_a_derivative_whose_square_overflows_is_taken_nearby(qps, engine):
    """sqrt has the derivative 5e159 at 1e-320: it was the lock of an observer that starts there."""
    def drain(x):
        flow = 0.1 * np.sqrt(np.abs(x[..., 0]))
        return np.stack([0.9 * x[..., 0] + 0.1 - 0.5 * flow, 0.8 * x[..., 1] + flow], axis=-1)

    def second(x):
        return x[..., 1:]

    rng, x, ys, truth = np.random.default_rng(0), np.array([0.5, 0.2]), [], []
    for _ in range(40):
        ys.append(x[1:] + 1e-2 * rng.normal(size=1))
        truth.append(x)
        x = drain(x)
    given = {"disturbance": 1e-4 * np.eye(2), "noise": R}
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(drain, second, n=2, p=1),
        qpmhe.ExtendedKalman(prior=np.eye(2), **given),
        qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **given),
        horizon=5, initial_state=[1e-320, 0.0], max_qps=qps, engine=engine,
    )
    assert mhe.engine == engine
    run = mhe.run(np.array(ys))
    assert [Status.DERIVATIVE_NEARBY in one for one in run.statuses] == [True] + 39 * [False]
    assert not run.share(Status.MODEL_FAILED)
    assert np.abs(run.filtered[20:] - np.array(truth)[20:]).max() < 0.05


@pytest.mark.parametrize("engine", ENGINES)
def test_sigma_points_beyond_the_model_leave_a_prediction(engine):
    """Torricelli's outflow is a root: a sigma point below the outlet has none."""
    def f(x):
        return x - 0.05 * np.sqrt(x - 1.0) + 0.04

    observer = qpmhe.UnscentedKalman(prior=[[1.0]], disturbance=Q[:1, :1], noise=R)
    mhe = estimator(observer, engine, 0, f, (1.5,))
    z = 1.5
    for y in (1.6, 1.7, 1.8):
        estimate, z = mhe.update([y]), f(z)
        assert estimate.status == Status.CANDIDATE | Status.NO_QPS | Status.OBSERVER_RESET
        assert estimate.observer_state == pytest.approx([z], rel=1e-14)
