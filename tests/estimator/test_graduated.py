"""Graduated non-convexity: widened losses while the first window fills."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

from . import plain
from .plain import Record
from .test_robust_cost import record as outliers
from .test_robust_cost import seen, swing


def fading(x):
    return 0.98 * x


def five(x):
    return np.stack([x[..., 0]] * 5, axis=-1)


SYSTEM = qpmhe.System(fading, five, n=1, p=5)
GAIN = np.zeros((1, 5))
R = 100.0 * np.eye(5)


def record(samples, seed=0):
    """Five sensors of one state; two of them see a reflection that is 4 away."""
    rng = np.random.default_rng(seed)
    states = 3.0 * 0.98 ** np.arange(samples + 1)
    ys = states[:-1, None] + 0.1 * rng.standard_normal((samples, 5))
    ys[:, :2] += 4.0
    return states, ys


def estimator(graduation, start, horizon=8, **options):
    cost = qpmhe.RobustCost(
        prior=[[1e-4]], disturbance=[[1e4]],
        noise=qpmhe.GemanMcClure(R, per_component=True, graduation=graduation),
    )
    return qpmhe.MovingHorizonEstimator(
        SYSTEM, qpmhe.Luenberger(GAIN), cost, horizon=horizon, initial_state=[start],
        **{"warm_start": True, "max_qps": 3, "engine": "python"} | options,
    )


@pytest.mark.parametrize("max_qps", [1, 3, None])
@pytest.mark.parametrize("start", [-10.0, 3.0, 7.0, 40.0])
def test_widened_losses_lead_to_the_sensors_that_agree_from_any_start(start, max_qps):
    states, ys = record(30)
    run = estimator(50.0, start, max_qps=max_qps).run(ys)
    assert np.abs(run.states[10:].ravel() - states[10:]).max() < 0.3
    assert (run.costs <= run.candidate_costs).all()


def test_without_them_the_start_decides():
    states, ys = record(30)
    run = estimator(1.0, 7.0).run(ys)
    assert np.abs(run.states[10:].ravel() - states[10:]).min() > 1.5


def test_the_cost_is_that_of_the_loss_itself_at_every_sample():
    mhe, (_, ys) = estimator(50.0, 7.0), record(20)
    kept = Record(
        five, GAIN, [7.0], ([[1e-4]], [[1e4]], R), 8,
        losses=(plain.quadratic, plain.quadratic, plain.each(plain.geman_mcclure(1.894))),
    )
    for t, y in enumerate(ys):
        estimate = mhe.update(y)
        kept.push(fading, y)
        assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-10)
        assert estimate.candidate_cost == pytest.approx(kept.cost(estimate.candidate), rel=1e-10)
        assert estimate.cost <= estimate.candidate_cost
        assert (Status.GRADUATED in estimate.status) == (t + 1 < 8)
        assert ("widened" in estimate.status.explain()) == (t + 1 < 8)


def test_the_surrogate_goes_on_where_the_candidate_is_the_estimate():
    """In a basin that costs less at first, a candidate hides the trajectory that is followed."""
    states, ys = record(20)
    mhe = estimator(50.0, float(ys[0, :2].mean()), max_qps=2)
    kept = [mhe.update(y) for y in ys]
    assert any(Status.CANDIDATE in estimate.status for estimate in kept[:7])
    assert np.abs(kept[-1].state - states[20]).max() < 0.3


@pytest.mark.parametrize("at", [3, 7, 12])
def test_a_snapshot_within_the_first_window_goes_on_bit_for_bit(at):
    _, ys = record(25)
    one, other = estimator(50.0, 7.0), estimator(50.0, 7.0)
    for y in ys[:at]:
        one.update(y)
    other.load_state_dict(pickle.loads(pickle.dumps(one.state_dict())))
    for y in ys[at:]:
        a, b = one.update(y), other.update(y)
        np.testing.assert_array_equal(a.trajectory, b.trajectory)
        assert a.status == b.status


def test_a_reset_graduates_again():
    _, ys = record(20)
    mhe = estimator(50.0, 7.0)
    first = mhe.run(ys)
    mhe.reset()
    np.testing.assert_array_equal(mhe.run(ys).states, first.states)


@pytest.mark.parametrize("name", ["plain", "discount", "gaps", "sets", "shared"])
def test_the_promise_with_everything_beside_it(name):
    ys = outliers(60, 0.2 if name == "gaps" else 0.0)
    sets = {
        "sets": {
            "states": qpmhe.Box([-1.5, -1.5], [1.5, 1.5]),
            "disturbances": qpmhe.Box([-0.05, -0.05], [0.05, 0.05]),
        },
        "shared": {"disturbance_matrix": [[1.0], [0.5]]},  # w through one channel
    }
    system = qpmhe.System(swing, seen, n=2, p=2, **sets.get(name, {}))
    width = 1 if name == "shared" else 2
    cost = qpmhe.RobustCost(
        prior=np.eye(2), disturbance=qpmhe.Cauchy(100.0 * np.eye(width)),
        noise=qpmhe.GemanMcClure(400.0 * np.eye(2)), discount=0.95 if name == "discount" else 1.0,
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.3, 0.05], [0.1, 0.2]]), cost, horizon=15,
        initial_state=[0.5, 0.0], warm_start=True, engine="python",
    )
    estimates = [mhe.update(y) for y in ys]
    for estimate in estimates:
        assert estimate.cost <= estimate.candidate_cost
        assert Status.MODEL_FAILED not in estimate.status
    assert sum(Status.IMPROVED in estimate.status for estimate in estimates) > 30
