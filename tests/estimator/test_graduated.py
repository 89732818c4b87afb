"""Graduated non-convexity: widened losses while the first window fills."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

# Five sensors of one state; two of them see a reflection that is 4 away.
STATES = 3.0 * 0.98 ** np.arange(31)
Y = STATES[:-1, None] + 0.1 * np.random.default_rng(0).standard_normal((30, 5))
Y[:, :2] += 4.0


def estimator(start, graduation=50.0, **options):
    cost = qpmhe.RobustCost(
        prior=[[1e-4]], disturbance=[[1e4]],
        noise=qpmhe.GemanMcClure(100.0 * np.eye(5), per_component=True, graduation=graduation),
    )
    system = qpmhe.System(
        lambda x: 0.98 * x, lambda x: np.stack([x[..., 0]] * 5, axis=-1), n=1, p=5
    )
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.zeros((1, 5))), cost, initial_state=[start],
        **{"horizon": 8, "warm_start": True, "max_qps": 3, "engine": "python"} | options,
    )


@pytest.mark.parametrize("max_qps", [1, 3, None])
def test_widened_losses_lead_to_the_sensors_that_agree_from_any_start(max_qps):
    mhe = estimator(7.0, max_qps=max_qps)
    for start in (-10.0, 3.0, 7.0, 40.0):
        mhe.reset([start])
        run = mhe.run(Y)
        assert np.abs(run.states[10:, 0] - STATES[10:]).max() < 0.3
        assert (run.costs <= run.candidate_costs).all()


def test_without_them_the_start_decides():
    run = estimator(7.0, 1.0).run(Y)
    assert np.abs(run.states[10:, 0] - STATES[10:]).min() > 1.5


def test_the_status_names_it_while_the_first_window_fills():
    for t, status in enumerate(estimator(7.0).run(Y).statuses):
        assert (Status.GRADUATED in status) == (t + 1 < 8)
        assert ("widened" in status.explain()) == (t + 1 < 8)


def test_the_surrogate_goes_on_where_the_candidate_is_the_estimate():
    """In a basin that costs less at first, a candidate hides the trajectory that is followed."""
    mhe = estimator(float(Y[0, :2].mean()), max_qps=2)
    kept = [mhe.update(y) for y in Y[:20]]
    assert any(Status.CANDIDATE in estimate.status for estimate in kept[:7])
    assert np.abs(kept[-1].state - STATES[20]).max() < 0.3


def test_a_snapshot_goes_on_bit_for_bit_and_a_reset_graduates_again():
    mhe, other = estimator(7.0), estimator(7.0)
    first = mhe.run(Y)
    mhe.reset()
    for t, y in enumerate(Y):
        if t in (3, 7, 12):
            other.load_state_dict(pickle.loads(pickle.dumps(mhe.state_dict())))
        estimate = mhe.update(y)
        assert (estimate.state == first.states[t + 1]).all()
        if t >= 3:
            found = other.update(y)
            np.testing.assert_array_equal(found.trajectory, estimate.trajectory)
            assert found.status == estimate.status
