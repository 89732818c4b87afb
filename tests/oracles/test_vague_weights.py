"""The prior's weight from an observer's covariance, beside vague priors, against 60 digits."""

import numpy as np
import pytest

import qpmhe

from .test_vague_observers import ENGINES, MODELS, OBSERVERS, measurements, mp, predicted

# From this sample on the data determine all states; the largest errors of states and covariances
# then, in deviations of the filter.
KNOWN = {"slant": (2, 1e-9), "jerk": (5, 1e-9), "season": (7, 1e-5), "twice": (5, 1e-5)}


def estimator(model, kind, deviation, engine, **options):
    a, c, q = model
    system = qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=len(a), p=len(c))
    system.held.update(options.pop("held", {}))
    given = {"disturbance": q, "noise": np.eye(len(c))}
    cost = options.pop("cost", None)
    mhe = qpmhe.MovingHorizonEstimator(
        system, kind(prior=deviation**2 * np.eye(len(a)), **given),
        qpmhe.QuadraticCost.from_covariances(**given) if cost is None else cost,
        horizon=3, initial_state=np.zeros(len(a)), max_qps=5, engine=engine, **options,
    )
    assert mhe.engine == engine
    return mhe


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", OBSERVERS)
@pytest.mark.parametrize("name", MODELS)
def test_the_estimate_is_the_kalman_filters(name, kind, engine):
    """Of priors from 1 to 1e10 deviations of the noise; with Q singular in "season"."""
    model, (known, allowed) = MODELS[name], KNOWN[name]
    ys = measurements(len(model[1]))
    for deviation in (1.0, 1e3, 1e5, 1e7, 1e8, 1e10):
        means, covariances = predicted(*model, deviation, ys)
        sizes = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
        mhe = estimator(model, kind, deviation, engine)
        for t, y in enumerate(ys):
            estimate = mhe.update(y)
            assert 0.0 <= estimate.cost <= estimate.candidate_cost
            if t < known:
                continue
            found = mhe.covariances()[-1]
            assert (np.abs(estimate.state - means[t]) < allowed * sizes[t]).all()
            assert (np.abs(found - covariances[t]) < allowed * np.outer(sizes[t], sizes[t])).all()


def exact_costs(model, deviation, mhe, ys):
    """J of each estimate, reported and in 60 digits; the observer's own states are the prior."""
    with mp.workdps(60):
        move, output, spread = (mp.matrix(one.tolist()) for one in model)
        covariance, covariances, states = mp.mpf(deviation) ** 2 * mp.eye(len(model[0])), [], []
        found, noise = [], mp.eye(len(model[1]))
        for t, y in enumerate(ys):
            states.append(mp.matrix(mhe.observer_state.tolist()))
            covariances.append(covariance)
            gain = covariance * output.T * (output * covariance * output.T + noise) ** -1
            covariance = move * (covariance - gain * output * covariance) * move.T + spread
            estimate = mhe.update(y)
            xs = [mp.matrix(one.tolist()) for one in estimate.trajectory]
            first = t + 1 - (len(xs) - 1)
            offset = xs[0] - states[first]
            cost = (offset.T * covariances[first] ** -1 * offset)[0]
            for k in range(len(xs) - 1):
                w = xs[k + 1] - move * xs[k]
                v = mp.matrix(ys[first + k].tolist()) - output * xs[k]
                cost += (w.T * spread**-1 * w)[0] + (v.T * v)[0]
            found.append((estimate.cost, float(cost)))
    return np.array(found).T


@pytest.mark.parametrize("engine", ENGINES)
def test_the_cost_is_exact_where_the_prior_is_far_off(engine):
    """A state as far off as a prior says: in its weight as one matrix, J would be rounding."""
    move, output, spread = model = MODELS["jerk"]
    for deviation in (1e6, 1e8, 1e10):
        rng, ys = np.random.default_rng(1), []
        x = deviation * rng.standard_normal(3)
        for _ in range(12):
            ys.append(output @ x + rng.standard_normal(1))
            x = move @ x + rng.multivariate_normal(np.zeros(3), spread)
        mhe = estimator(model, OBSERVERS[0], deviation, engine)
        reported, right = exact_costs(model, deviation, mhe, np.array(ys))
        # The states themselves have no more digits.
        np.testing.assert_allclose(reported, right, rtol=1e-6, atol=1e-13 * deviation)


COSTS = {
    "discount": {"discount": 0.9}, "Huber": {"noise": qpmhe.Huber([[1.0]], threshold=1.5)},
}


@pytest.mark.parametrize("name", ["discount", "Huber", "held", "smoothed"])
def test_both_engines_agree(name):
    _, _, q = model = MODELS["jerk"]
    weights = {"disturbance": np.linalg.inv(q), "noise": np.eye(1)}
    options = {"held": {"held": {2: 1.0}}, "smoothed": {"arrival": "smoothed"}}.get(name, {})
    ys = measurements(1)
    for deviation in (1e6, 1e9):
        runs = []
        for one in ENGINES:
            engine = one if isinstance(one, str) else one.values[0]
            if engine == "compiled" and name == "smoothed":
                continue
            cost = qpmhe.RobustCost(**weights | COSTS.get(name, {}))
            runs.append(estimator(model, OBSERVERS[0], deviation, engine, cost=cost, **options))
        found = [mhe.run(ys) for mhe in runs]
        for run in found:
            assert (run.costs <= run.candidate_costs).all()
            assert (run.costs >= 0.0).all()
            np.testing.assert_allclose(run.states[6:], found[0].states[6:], rtol=1e-6)
