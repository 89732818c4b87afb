"""Which y, u, x, w and v belong together: records in which every number tells its time."""

import numpy as np
import pytest

import qpmhe

STEPS, HORIZON = 9, 4


def integrator(**options):
    """x+ = x + u + w, y = (x + u, x) + v; the first output is exact, the second hardly weighs."""
    system = qpmhe.System(
        lambda x, u: x + u,
        lambda x, u: np.concatenate([x + u, x], axis=-1),
        n=1, p=2, m=1,
    )
    cost = qpmhe.QuadraticCost(prior=1e-8, disturbance=1e-2, noise=np.diag([1e8, 1e-8]))
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.5, 0.0]]), cost, horizon=HORIZON, initial_state=[-3.0],
        **options,
    )


def integrator_record():
    """Inputs in thousands, disturbances in tens, noises in units, each naming its time."""
    t = np.arange(STEPS)
    u, w, v = 1000.0 * (t + 1), 10.0 * (t + 2), 1.0 * (t + 3)
    x = 7e5 + np.concatenate([[0.0], np.cumsum(u + w)])
    y = np.column_stack([x[:-1] + u, x[:-1] + v])
    return x, u[:, None], w, v, y


@pytest.mark.parametrize("backend", ["auto", "piqp", "quadprog"])
def test_every_number_of_an_integrator_is_at_its_time(backend):
    if backend not in qpmhe.solvers.available():
        pytest.skip("not installed")
    x, u, w, v, y = integrator_record()
    mhe = integrator(backend=backend)
    assert mhe.time == 0
    assert mhe.state.tolist() == [-3.0]
    for t in range(STEPS):
        estimate = mhe.update(y[t], u[t])
        first = max(0, t + 1 - HORIZON)
        assert estimate.time == t
        assert mhe.time == t + 1
        # x(t+1) is told by no measurement yet: predicted with u(t), without w(t).
        expected = np.append(x[first : t + 1], x[t] + u[t])
        np.testing.assert_allclose(estimate.trajectory[:, 0], expected, atol=1e-3)
        np.testing.assert_allclose(estimate.state, x[t] + u[t], atol=1e-3)
        np.testing.assert_allclose(estimate.filtered, [x[t]], atol=1e-3)
        np.testing.assert_allclose(
            estimate.disturbances[:, 0], np.append(w[first:t], 0.0), atol=1e-3
        )
        np.testing.assert_allclose(estimate.noises[:, 1], v[first : t + 1], atol=1e-3)
        assert estimate.trajectory.shape == (min(t + 1, HORIZON) + 1, 1)
        assert estimate.disturbances.shape == (min(t + 1, HORIZON), 1)
        assert estimate.noises.shape == (min(t + 1, HORIZON), 2)
        np.testing.assert_array_equal(mhe.state, estimate.state)


def test_rows_of_a_run_are_the_times_they_are_said_to_be():
    x, u, _, _, y = integrator_record()
    mhe = integrator()
    run = mhe.run(y, u)
    assert len(run) == STEPS
    assert run.states.shape == (STEPS + 1, 1)
    assert run.states[0].tolist() == [-3.0]
    np.testing.assert_allclose(run.states[1:], x[:-1, None] + u, atol=1e-3)
    np.testing.assert_allclose(run.filtered, x[:-1, None], atol=1e-3)
    single = integrator()
    for t in range(STEPS):
        estimate = single.update(y[t], u[t])
        assert run.costs[t] == estimate.cost
        assert run.candidate_costs[t] == estimate.candidate_cost
        assert run.statuses[t] == estimate.status


def test_a_run_goes_on_where_the_last_one_ended():
    _, u, _, _, y = integrator_record()
    whole, parts = integrator().run(y, u), integrator()
    first, second = parts.run(y[:6], u[:6]), parts.run(y[6:], u[6:])
    assert parts.time == STEPS
    np.testing.assert_array_equal(np.vstack([first.states, second.states[1:]]), whole.states)
    np.testing.assert_array_equal(second.states[0], first.states[-1])
    parts.reset()
    assert parts.time == 0
    np.testing.assert_array_equal(parts.run(y, u).states, whole.states)


def test_a_delay_chain_keeps_every_sample_in_its_cell():
    # x+ = (u, x1, x2), y = x3: what is shifted in at t is measured at t + 3.
    shift = np.diag([1.0, 1.0], -1)
    system = qpmhe.System(
        lambda x, u: x @ shift.T + u * [1.0, 0.0, 0.0], lambda x: x[..., 2:], n=3, p=1, m=1
    )
    cost = qpmhe.QuadraticCost(prior=1e-8 * np.eye(3), disturbance=1e3 * np.eye(3), noise=1.0)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.0, 0.0, 0.0]), cost, horizon=5, initial_state=[0, 0, 0]
    )
    u = 10.0 * np.arange(1, 13)
    cells = np.concatenate([[9.0, 8.0, 7.0], u])  # x(t) = cells[t + 2], cells[t + 1], cells[t]
    x = np.column_stack([cells[2:], cells[1:-1], cells[:-2]])
    for t in range(12):
        estimate = mhe.update(x[t, 2], u[t])
        first = max(0, t - 4)
        if t >= 2:  # three samples tell the three cells
            np.testing.assert_allclose(estimate.trajectory, x[first : t + 2], atol=1e-4)
            np.testing.assert_allclose(estimate.filtered, x[t], atol=1e-4)
            np.testing.assert_allclose(estimate.disturbances, 0.0, atol=1e-4)
            np.testing.assert_allclose(estimate.noises, 0.0, atol=1e-4)
        # The newest sample tells the last cell at once; u(t) is in the first one at t + 1.
        np.testing.assert_allclose(estimate.filtered[2], cells[t], atol=1e-4)
        np.testing.assert_allclose(estimate.state[0], u[t], atol=1e-4)
        np.testing.assert_array_equal(mhe.state, estimate.state)


def test_the_candidate_and_its_prior_are_those_of_the_window():
    _, u, _, _, y = integrator_record()
    mhe = integrator(max_qps=0)
    z = [-3.0]
    for t in range(STEPS):
        estimate = mhe.update(y[t], u[t])
        z.append(z[-1] + u[t, 0] + 0.5 * (y[t, 0] - (z[-1] + u[t, 0])))
        first = max(0, t + 1 - HORIZON)
        assert estimate.candidate[:, 0].tolist() == z[first : t + 2]
        # Gamma(candidate) is 0: its cost is that of the window's stages alone.
        stages = [
            1e-2 * (z[i + 1] - z[i] - u[i, 0]) ** 2
            + 1e8 * (y[i, 0] - z[i] - u[i, 0]) ** 2
            + 1e-8 * (y[i, 1] - z[i]) ** 2
            for i in range(first, t + 1)
        ]
        assert estimate.candidate_cost == pytest.approx(sum(stages), rel=1e-12)
        assert estimate.cost == estimate.candidate_cost
