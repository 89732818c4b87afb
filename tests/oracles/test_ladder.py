"""Where the candidate violates W or V: Ipopt's constrained minimum from the same start."""

import numpy as np
import pytest

import qpmhe

from .nlp import Model, Window


def made(seed):
    """An estimator with tight W and V, in every third of which 0 is no w; model and record."""
    draw = np.random.default_rng(seed)
    n, horizon = int(draw.integers(1, 4)), int(draw.integers(3, 7))
    p = min(int(draw.integers(1, 3)), n)
    model = Model.drawn(draw, n, p, (0.5, 1.05))
    w_lower, w_upper = -draw.uniform(0.02, 0.3, n), draw.uniform(0.02, 0.3, n)
    if seed % 3 == 0:
        j = int(draw.integers(n))
        w_lower[j], w_upper[j] = 0.02, 0.4
    v_lower, v_upper = -draw.uniform(0.1, 0.6, p), draw.uniform(0.1, 0.6, p)
    low, high = (-draw.uniform(1, 3, n), draw.uniform(1, 3, n)) if seed % 2 else (-9.0, 9.0)
    sets = {"disturbances": qpmhe.Box(w_lower, w_upper), "noises": qpmhe.Box(v_lower, v_upper)}
    if seed % 2:
        sets["states"] = qpmhe.Box(low, high)
    cost = qpmhe.QuadraticCost(
        prior=np.diag(draw.uniform(0.5, 3, n)), disturbance=np.diag(draw.uniform(1, 20, n)),
        noise=np.diag(draw.uniform(1, 20, p)),
    )
    x, measurements = draw.uniform(-1, 1, n), []
    for _ in range(horizon + 6):
        measurements.append(model.h(x) + draw.uniform(v_lower, v_upper))
        x = np.clip(model.f(x) + draw.uniform(w_lower, w_upper), low, high)
    estimator = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: model.f(x), lambda x: model.h(x), n=n, p=p, **sets),
        qpmhe.Luenberger(0.6 * model.a @ np.linalg.pinv(model.c)), cost, horizon=horizon,
        initial_state=np.clip(draw.uniform(-1.5, 1.5, n), low, high), max_qps=None,
    )
    return estimator, model, sets, np.array(measurements)


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@pytest.mark.parametrize("first", range(0, 40, 8))
def test_the_minimum_is_ipopts_where_that_is_feasible_and_not_above_the_candidates(first):
    compared = 0
    for seed in range(first, first + 8):
        mhe, model, sets, measurements = made(seed)
        for t, y in enumerate(measurements):
            estimate, count = mhe.update(y), mhe.horizon
            if t < count - 1 or t % 2 or qpmhe.Status.CANDIDATE_OUTSIDE not in estimate.status:
                continue
            weights = mhe.cost.prior, [mhe.cost.disturbance] * count, [mhe.cost.noise] * count
            minimum, _ = Window(
                model.f, model.h, measurements[t + 1 - count : t + 1], estimate.candidate[0],
                weights, boxes={name: [one] * (count + 1) for name, one in sets.items()},
            ).minimum(estimate.candidate)
            if minimum > estimate.candidate_cost:
                continue
            compared += 1
            assert estimate.improved, (seed, t)
            assert estimate.dropped == (), (seed, t)
            # A lower local minimum than Ipopt's is none the worse.
            assert estimate.cost <= minimum * (1.0 + 1e-6), (seed, t)
    assert compared >= 15
