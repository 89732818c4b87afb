"""Which y, u, x, w and v belong together: records in which every number names its time."""

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


def record():
    """Inputs in thousands, disturbances in tens, noises in units, each naming its time."""
    t = np.arange(STEPS)
    u, w, v = 1000.0 * (t + 1), 10.0 * (t + 2), 1.0 * (t + 3)
    x = 7e5 + np.concatenate([[0.0], np.cumsum(u + w)])
    y = np.column_stack([x[:-1] + u, x[:-1] + v])
    return x, u[:, None], w, v, y


@pytest.mark.parametrize("backend", ["auto", "piqp", "quadprog"])
def test_every_number_is_at_its_time(backend):
    if backend not in qpmhe.solvers.available():
        pytest.skip("not installed")
    x, u, w, v, y = record()
    mhe = integrator(backend=backend)
    assert (mhe.time, mhe.state.tolist()) == (0, [-3.0])
    for t in range(STEPS):
        estimate = mhe.update(y[t], u[t])
        first = max(0, t + 1 - HORIZON)
        assert (estimate.time, mhe.time) == (t, t + 1)
        # No measurement says anything of x(t+1) yet: predicted with u(t), without w(t).
        predicted = x[t] + u[t]
        for found, expected in (
            (estimate.trajectory[:, 0], np.append(x[first : t + 1], predicted)),
            (estimate.state, predicted), (estimate.filtered, x[t : t + 1]),
            (estimate.disturbances[:, 0], np.append(w[first:t], 0.0)),
            (estimate.noises[:, 1], v[first : t + 1]),
        ):
            assert found.shape == expected.shape
            np.testing.assert_allclose(found, expected, atol=1e-3)
        np.testing.assert_array_equal(mhe.state, estimate.state)
    run, single = integrator(backend=backend).run(y, u), integrator(backend=backend)
    assert run.states[0].tolist() == [-3.0]
    np.testing.assert_allclose(run.states[1:], x[:-1, None] + u, atol=1e-3)
    np.testing.assert_allclose(run.filtered, x[:-1, None], atol=1e-3)
    for t in range(STEPS):
        estimate = single.update(y[t], u[t])
        assert run.candidate_costs[t] == estimate.candidate_cost
        assert run.statuses[t] == estimate.status


def test_the_candidate_and_its_prior_are_those_of_the_window():
    _, u, _, _, y = record()
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
