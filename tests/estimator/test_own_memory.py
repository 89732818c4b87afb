"""What is handed out or in is never memory of the estimator."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.estimation.settings import Settings

from .same import assert_same

BOX = {"states": qpmhe.Box([-0.9, -0.9], [0.9, 0.9])}
# Outside of which the candidate is, now and then.
NARROW = {"disturbances": qpmhe.Box([-0.1, -0.1], [0.1, 0.1])}
OPTIONS = {
    "plain": {},
    "observer alone": {"max_qps": 0},
    "best": {"warm_start": True, "max_qps": 2},
    "reinitialized": {"candidate": "reinitialized", "warm_start": True},
    "delayed": {"delay": 2},
    "dropped": {"sets": NARROW, "max_qps": 3},
    "projected": {"sets": BOX, "warm_start": True},
    "kept": {"sets": NARROW, "infeasible": "keep_candidate"},
    "discount": {"discount": 0.8},
    "robust": {"robust": True},
    "smoothed": {"arrival": "smoothed", "discount": 0.8},
    "kalman": {"kalman": True, "candidate": "reinitialized"},
}
HORIZON = 4


def system_of(engine, sets=None):
    if engine == "compiled" and sets:
        sets = NARROW
    if engine == "numpy":
        def rate(x, u):
            return np.stack((x[..., 1], u[..., 0] - np.sin(x[..., 0])), axis=-1)

        return qpmhe.System.from_ode(
            rate, lambda x, u: x[..., :1] + 0.1 * x[..., :1] ** 2, dt=0.1, n=2, p=1, m=1,
            method="euler", **(sets or {}),
        )
    ca = pytest.importorskip("casadi")
    return qpmhe.from_casadi(
        lambda x, u: [x[1], u[0] - ca.sin(x[0])], lambda x, u: x[0] + 0.1 * x[0] ** 2, dt=0.1,
        method="euler", n=2, m=1, **(sets or {}),
    )


def estimator(
    engine, sets=None, discount=1.0, robust=False, kalman=False, system=None, held=None, **options
):
    gain, weights = np.array([[0.3], [0.4]]), [np.eye(2), 10.0 * np.eye(2), np.eye(1)]
    start = np.array([0.5, 0.0])
    given = dict(zip(("prior", "disturbance", "noise"), weights, strict=True))
    cost = qpmhe.QuadraticCost(**given, discount=discount)
    if robust:
        cost = qpmhe.RobustCost(**given | {"noise": qpmhe.Huber(weights[2])}, discount=discount)
    observer = qpmhe.ExtendedKalman(**given) if kalman else qpmhe.Luenberger(gain)
    own = engine if engine == "compiled" else "python"
    system = system or system_of(engine, sets)
    if held:  # as `augment_parameters` does
        system.held = held
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost,
        **{"horizon": HORIZON, "initial_state": start, "engine": own} | options,
    )
    for array in (gain, start, *weights):
        array[...] = np.nan
    return mhe


def samples(count, seed=0):
    generator, found = np.random.default_rng(seed), []
    for t in range(count):
        y, u, own = generator.normal(0.0, 0.6, 1), generator.normal(0.0, 1.0, 1), {}
        if generator.random() < 0.2:
            y[0] = np.nan
        if t % 7 == 3:
            own = {"dt": 0.07, "noise_weight": np.array([[3.0]])}
        found.append((y, u, own))
    return found


# What a run names as its source is what the user made the estimator of.
PARTS = qpmhe.System, qpmhe.Observer, qpmhe.Cost, Settings


def arrays_of(value, depth=0):
    """All arrays that can be reached from a value, but for those of the estimator's own parts."""
    if isinstance(value, PARTS):
        return []
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, dict):
        return [array for item in value.values() for array in arrays_of(item, depth)]
    if isinstance(value, (list, tuple)):
        return [array for item in value for array in arrays_of(item, depth)]
    if depth > 3 or not type(value).__module__.startswith("qpmhe"):
        return []
    parts = [getattr(value, name, None) for name in dir(value) if not name.startswith("__")]
    return [array for part in parts if not callable(part) for array in arrays_of(part, depth + 1)]


def spoil(value):
    found = arrays_of(value)
    for array in found:
        array[...] = np.nan if array.dtype.kind == "f" else 0
    return len(found)


def feed(mhe, arguments, spoilt):
    y, u, own = arguments
    if not spoilt:
        return mhe.update(y, u, **own)
    y, u, own = y.copy(), u.copy(), {k: np.array(v) if k != "dt" else v for k, v in own.items()}
    estimate = mhe.update(y, u, **own)
    spoil([y, u, list(own.values())])
    return estimate


@pytest.mark.parametrize(("engine", "name"), [
    *(("numpy", name) for name in OPTIONS), ("casadi", "reinitialized"),
    *(("compiled", name) for name in ("plain", "reinitialized", "dropped")),
])
def test_a_spoilt_estimator_goes_on_as_its_twin(engine, name):
    if engine == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    options = OPTIONS[name]
    twin, spoilt = estimator(engine, **options), estimator(engine, **options)
    assert spoil(spoilt.initial_state) == 1

    def both(do, *arrays, check=np.testing.assert_array_equal):
        """Do it with copies, which are spoilt afterwards, as is what comes back."""
        given = [array.copy() for array in arrays]
        expected, found = do(twin, *arrays), do(spoilt, *given)
        check(found, expected)
        spoil([found, given])

    for t, arguments in enumerate(samples(60)):
        spoil(spoilt.state)
        expected = feed(twin, arguments, False)
        estimate = feed(spoilt, arguments, True)
        assert_same(estimate, expected)
        assert spoil(estimate) >= 6
        if t % 9 == 5:
            both(lambda mhe, y, t=t: mhe.amend(t - 2, y), np.array([0.1 * t]), check=assert_same)
        if t % 3 == 0:
            both(lambda mhe: mhe.covariances())
        if t % 11 == 8:
            spoil(spoilt.state_dict())
            state = twin.state_dict()
            spoilt.load_state_dict(state)
            spoil(state)
    for name in ("states", "costs", "covariances"):
        both(
            lambda mhe, Y, U, name=name: getattr(mhe.run(Y, U, covariances=True), name),
            np.zeros((20, 1)), np.ones((20, 1)),
        )
    twin.reset()
    spoilt.reset()
    for arguments in samples(10, 1):
        assert_same(feed(spoilt, arguments, True), feed(twin, arguments, False))


BATCHES = {
    "looped": {},
    "looped best": {"warm_start": True, "max_qps": 2, "delay": 1},
    "looped alone": {"max_qps": 0},
    "looped anew": {"candidate": "reinitialized"},
    "compiled": {"engine": "compiled"},
}


def batch_of(name, members=3):
    options, starts = BATCHES[name], np.full((members, 2), 0.5)
    if name == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    found = qpmhe.BatchEstimator(
        system_of("casadi" if name == "compiled" else "numpy"), qpmhe.Luenberger([0.3, 0.4]),
        qpmhe.QuadraticCost(prior=np.eye(2), disturbance=10.0 * np.eye(2), noise=1.0),
        members=members, horizon=HORIZON, initial_states=starts, **options,
    )
    spoil(starts)
    return found


TAKEN = ("trajectories", "candidates", "costs", "candidate_costs", "flags", "qps", "states")


def assert_all_same(found, expected):
    for name in TAKEN:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


@pytest.mark.parametrize("name", BATCHES)
def test_a_spoilt_batch_goes_on_as_its_twin(name):
    twin, spoilt, generator = batch_of(name), batch_of(name), np.random.default_rng(0)
    assert name.startswith(spoilt.mode)
    spoil(spoilt.initial_states)
    for t in range(25):
        if t == 20:
            Y, U = generator.normal(0.0, 0.5, (3, 9, 1)), np.zeros((3, 9, 1))
            expected, found = twin.run(Y.copy(), U.copy()), spoilt.run(Y, U)
            np.testing.assert_array_equal(found.states, expected.states)
            spoil([found, Y, U])
            twin.reset()
            spoilt.reset()
        Y, U = generator.normal(0.0, 0.5, (3, 1)), generator.normal(0.0, 1.0, (3, 1))
        expected = twin.update(Y.copy(), U.copy())
        found = spoilt.update(Y, U)
        assert_all_same(found, expected)
        spoil([found, Y, U, spoilt.states])


def test_state_and_filtered_are_rows_of_the_trajectory():
    """As documented: changing one changes the other, of this estimate alone."""
    estimate = estimator("numpy", delay=1).update([0.1], [0.0])
    estimate.state[...] = 7.0
    assert estimate.trajectory[-1].tolist() == [7.0, 7.0]
    assert np.shares_memory(estimate.filtered, estimate.trajectory)
    assert not np.shares_memory(estimate.candidate, estimate.trajectory)
