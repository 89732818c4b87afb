"""With no QPs the estimator is the observer, to the last bit; and short windows are windows."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

GAIN, START = np.array([[0.3, 0.05], [-0.1, 0.2], [0.02, 0.4]]), np.array([0.5, -0.2, 1.0])


def f(x, u):
    x1, x2, x3 = x[..., 0], x[..., 1], x[..., 2]
    return np.stack(
        [x1 + 0.1 * x2, x2 - 0.1 * np.sin(x1) + 0.05 * u[..., 0], 0.9 * x3 + 0.1 * x1 * x2], axis=-1
    )


def h(x, u):
    return np.stack([x[..., 0] ** 2 + u[..., 1], x[..., 2] + 0.1 * x[..., 1]], axis=-1)


def estimator(observer=None, **options):
    cost = qpmhe.QuadraticCost(
        prior=np.eye(3), disturbance=np.diag([9.0, 4.0, 1.0]), noise=[[5.0, 1.0], [1.0, 2.0]]
    )
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, h, n=3, p=2, m=2), observer or qpmhe.Luenberger(GAIN), cost,
        **{"horizon": 4, "initial_state": START} | options,
    )


def record(seed, steps=90, missing=True):
    rng = np.random.default_rng(seed)
    Y = rng.standard_normal((steps, 2)) * 0.3 + 1.0
    if missing:
        Y[rng.random((steps, 2)) < 0.2] = np.nan
    return Y, rng.standard_normal((steps, 2))


CORRECTIONS = {
    "luenberger": (qpmhe.Luenberger(GAIN), lambda z, v: GAIN @ v),
    "nonlinear": (qpmhe.OutputInjection(
        correction := lambda z, v: np.array([np.tanh(v[0]), z[0] * v[1], 0.1 * v[1] ** 3])
    ), correction),
}


@pytest.mark.parametrize("name", CORRECTIONS)
def test_no_qps_are_the_observer_to_the_last_bit(name):
    (observer, correction), (Y, U), states = CORRECTIONS[name], record(1), [START]
    for y, u in zip(Y, U, strict=True):
        v = y - h(states[-1], u)
        v[~np.isfinite(y)] = 0.0
        states.append(f(states[-1], u) + correction(states[-1], v))
    run = estimator(observer, max_qps=0).run(Y, U)
    assert run.states.tolist() == np.array(states).tolist()
    assert run.costs.tolist() == run.candidate_costs.tolist()
    assert not run.qps.any()
    assert all(Status.NO_QPS in s and Status.CANDIDATE in s for s in run.statuses)


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
@pytest.mark.parametrize("missing", [False, True], ids=["complete", "missing"])
def test_a_growing_window_is_a_full_one_of_its_length(backend, missing):
    # Remark rem:emtpyN: until N samples are there, the horizon is t.
    Y, U = record(6, steps=5, missing=missing)
    growing = estimator(backend=backend, horizon=9, max_qps=3).run(Y, U)
    for length in range(1, 6):
        full = estimator(backend=backend, horizon=length, max_qps=3)
        for t in range(length):
            estimate = full.update(Y[t], U[t])
        assert estimate.candidate_cost == growing.candidate_costs[length - 1]
        assert estimate.status == growing.statuses[length - 1]
        # Not every solver gives the same bits twice: some depend on how memory is aligned.
        np.testing.assert_allclose(estimate.state, growing.states[length], rtol=1e-9)
        np.testing.assert_allclose(estimate.filtered, growing.filtered[length - 1], rtol=1e-9)
        assert estimate.cost == pytest.approx(growing.costs[length - 1], rel=1e-9)
