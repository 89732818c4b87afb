"""With no QPs the estimator is the observer, to the last bit; and short windows are windows."""

import numpy as np
import pytest

import qpmhe

BACKENDS = qpmhe.solvers.available()
GAIN = np.array([[0.3, 0.05], [-0.1, 0.2], [0.02, 0.4]])


def f(x, u):
    x1, x2, x3 = x[..., 0], x[..., 1], x[..., 2]
    return np.stack(
        [x1 + 0.1 * x2, x2 - 0.1 * np.sin(x1) + 0.05 * u[..., 0], 0.9 * x3 + 0.1 * x1 * x2], axis=-1
    )


def h(x, u):
    return np.stack([x[..., 0] ** 2 + u[..., 1], x[..., 2] + 0.1 * x[..., 1]], axis=-1)


def estimator(observer=None, **options):
    system = qpmhe.System(f, h, n=3, p=2, m=2)
    cost = qpmhe.QuadraticCost(
        prior=np.eye(3), disturbance=np.diag([9.0, 4.0, 1.0]), noise=[[5.0, 1.0], [1.0, 2.0]]
    )
    options = {"horizon": 4, "initial_state": [0.5, -0.2, 1.0], **options}
    return qpmhe.MovingHorizonEstimator(
        system, observer or qpmhe.Luenberger(GAIN), cost, **options
    )


def record(seed, steps=90, missing=True):
    rng = np.random.default_rng(seed)
    Y = rng.standard_normal((steps, 2)) * 0.3 + 1.0
    if missing:
        Y[rng.random((steps, 2)) < 0.2] = np.nan
    return Y, rng.standard_normal((steps, 2))


def plain_observer(z, Y, U, correction=lambda z, v: GAIN @ v):
    states = [z]
    for y, u in zip(Y, U, strict=True):
        v = y - h(z, u)
        v[~np.isfinite(y)] = 0.0
        z = f(z, u) + correction(z, v)
        states.append(z)
    return np.array(states)


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_qps_are_the_observer_to_the_last_bit(backend):
    Y, U = record(1)
    mhe = estimator(backend=backend, max_qps=0)
    run = mhe.run(Y, U)
    expected = plain_observer(np.array([0.5, -0.2, 1.0]), Y, U)
    assert run.states.tolist() == expected.tolist()
    assert run.costs.tolist() == run.candidate_costs.tolist()
    assert not run.qps.any()
    assert all(qpmhe.Status.NO_QPS in s and qpmhe.Status.CANDIDATE in s for s in run.statuses)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_candidate_is_the_observer_whatever_the_qps_do(backend):
    Y, U = record(2, steps=25)
    mhe = estimator(backend=backend, max_qps=2)
    expected = plain_observer(np.array([0.5, -0.2, 1.0]), Y, U)
    for t in range(25):
        estimate = mhe.update(Y[t], U[t])
        assert estimate.candidate.tolist() == expected[max(0, t - 3) : t + 2].tolist()
        if not estimate.improved:
            assert estimate.trajectory.tolist() == estimate.candidate.tolist()


def test_a_nonlinear_correction_is_reproduced_to_the_last_bit():
    def correction(z, v):
        return np.array([np.tanh(v[0]), z[0] * v[1], 0.1 * v[1] ** 3])

    Y, U = record(3)
    run = estimator(qpmhe.OutputInjection(correction), max_qps=0, horizon=7).run(Y, U)
    expected = plain_observer(np.array([0.5, -0.2, 1.0]), Y, U, correction)
    assert run.states.tolist() == expected.tolist()


def test_the_reactor_with_no_qps_is_its_luenberger_observer():
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    Y = scenario.simulate(5).measurements
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=[3.0, 0.0], max_qps=0
    )
    z, paper, no_input = np.array([3.0, 0.0]), np.array([3.0, 0.0]), np.zeros(0)
    for y in Y:
        v = y - np.array([z[0] + z[1]])
        z = system.f(z, no_input) + 0.1 * np.array([[0.5], [0.5]]) @ v
        state = mhe.update(y).state
        assert state.tolist() == z.tolist()
        # The model by the paper's formula, whose order of operations is nobody's promise.
        reaction, v = 0.16 * paper[0] ** 2 - 0.64 * paper[1], y[0] - paper.sum()
        paper = paper + 0.1 * (np.array([-2.0 * reaction, reaction]) + 0.5 * v)
        np.testing.assert_allclose(state, paper, rtol=1e-12)


def test_an_extended_kalman_observer_does_not_depend_on_the_qps():
    observer = qpmhe.ExtendedKalman(
        prior=np.eye(3), disturbance=0.1 * np.eye(3), noise=0.2 * np.eye(2)
    )
    Y, U = record(4)
    pure = estimator(observer, max_qps=0, horizon=1).run(Y, U).states
    mhe = estimator(observer, max_qps=2, horizon=6)
    for t in range(len(Y)):
        candidate = mhe.update(Y[t], U[t]).candidate
        assert candidate.tolist() == pure[max(0, t - 5) : t + 2].tolist()


@pytest.mark.parametrize("backend", BACKENDS)
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
