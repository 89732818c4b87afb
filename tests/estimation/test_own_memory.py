"""What is handed out or in is never memory of the estimator; an interrupted step was not taken."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.estimation.settings import Settings

from .same import assert_same, interrupted
from .systems import pendulum

BOX = {"states": qpmhe.Box([-0.9, -0.9], [0.9, 0.9])}
# Outside of which the candidate is, now and then.
NARROW = {"disturbances": qpmhe.Box([-0.1, -0.1], [0.1, 0.1])}
CASES = {
    "discounted": {"discount": 0.8, "held": {1: 0.5}},
    "reinitialized in a set": {"candidate": "reinitialized", "sets": BOX, "warm_start": True},
    "dropped": {"sets": NARROW, "max_qps": 2},
    "smoothed": {"arrival": "smoothed", "discount": 0.8, "warm_start": True},
    "kalman": {"kalman": True, "robust": True, "candidate": "reinitialized", "max_qps": 2},
    "compiled": {"engine": "compiled", "candidate": "reinitialized", "sets": NARROW},
}
NEW = [0.2, 0.1]


def estimator(sets=None, discount=1.0, robust=False, kalman=False, held=None, **options):
    """Of arrays that are spoilt afterwards."""
    if options.get("engine") == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    gain, weights = np.array([[0.3], [0.4]]), [np.eye(2), 10.0 * np.eye(2), np.eye(1)]
    start = np.array([0.5, 0.0])
    given = dict(zip(("prior", "disturbance", "noise"), weights, strict=True))
    cost = qpmhe.QuadraticCost(**given, discount=discount)
    if robust:
        cost = qpmhe.RobustCost(**given | {"noise": qpmhe.Huber(weights[2])}, discount=discount)
    observer = qpmhe.ExtendedKalman(**given) if kalman else qpmhe.Luenberger(gain)
    system = pendulum("traced", **(sets or {}))
    if held:  # as `augment_parameters` does
        system = system.with_origin(held=held)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost,
        **{"horizon": 4, "initial_state": start, "engine": "python"} | options,
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
    if isinstance(value, (dict, list, tuple)):
        items = value.values() if isinstance(value, dict) else value
        return [array for item in items for array in arrays_of(item, depth)]
    if depth > 3 or not type(value).__module__.startswith("qpmhe"):
        return []
    parts = [getattr(value, name, None) for name in dir(value) if not name.startswith("__")]
    return [array for part in parts if not callable(part) for array in arrays_of(part, depth + 1)]


def spoil(value):
    found = arrays_of(value)
    for array in found:
        array[...] = np.nan if array.dtype.kind == "f" else 0
    return len(found)


def feed(mhe, arguments, spoilt=False):
    y, u, own = arguments
    if not spoilt:
        return mhe.update(y, u, **own)
    y, u, own = y.copy(), u.copy(), {k: np.array(v) if k != "dt" else v for k, v in own.items()}
    estimate = mhe.update(y, u, **own)
    spoil([y, u, list(own.values())])
    return estimate


@pytest.mark.parametrize("name", CASES)
def test_a_spoilt_estimator_goes_on_as_its_twin(name):
    twin, spoilt = estimator(**CASES[name]), estimator(**CASES[name])
    assert spoil(spoilt.initial_state) == 1

    def both(do, *arrays, check=np.testing.assert_array_equal):
        """Do it with copies, which are spoilt afterwards, as is what comes back."""
        given = [array.copy() for array in arrays]
        expected, found = do(twin, *arrays), do(spoilt, *given)
        check(found, expected)
        spoil([found, given])

    for t, arguments in enumerate(samples(40)):
        spoil(spoilt.state)
        estimate = feed(spoilt, arguments, True)
        assert_same(estimate, feed(twin, arguments))
        assert spoil(estimate) >= 6
        if t % 9 == 5:
            both(lambda mhe, y, t=t: mhe.amend(t - 2, y), np.array([0.1 * t]), check=assert_same)
        if t % 3 == 0:
            both(lambda mhe: mhe.covariances())
        if t % 11 == 8:
            spoil(spoilt.state_dict())
            twin.forget_warm_start()
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
        assert_same(feed(spoilt, arguments, True), feed(twin, arguments))


# Interrupts


@pytest.fixture
def stride(pytestconfig):
    """Lines from one interrupt to the next, at most."""
    return 150 if pytestconfig.option.all else 300


@pytest.mark.shortened
@pytest.mark.parametrize("name", ["reinitialized in a set", "smoothed", "kalman", "compiled"])
def test_an_interrupted_step_was_not_taken(name, stride):
    options, generator = CASES[name], np.random.default_rng(1)
    mhe, twin = estimator(**options), estimator(**options)
    for one in (mhe, twin):  # a step of another length decides how the model is called
        feed(one, samples(4)[3])
        one.reset()

    def both(do):
        twin.forget_warm_start()  # as solvers do after an interrupt
        expected, found = do(twin), interrupted(mhe, do, generator, stride)
        if expected is None:
            assert found is None
        else:
            assert_same(found, expected)
        np.testing.assert_array_equal(mhe.state, twin.state)
        np.testing.assert_array_equal(mhe.initial_state, twin.initial_state)

    other = estimator(**options).state_dict()
    actions = {
        22: lambda one: one.set(noise_weight=[[2.0]]), 26: lambda one: one.reset(),
        24: lambda one: one.load_state_dict(other),
        28: lambda one: one.reset(NEW),
    }
    for t, arguments in enumerate(samples(38)):
        if t in (0, 3, 36):  # the first move of stages to the front is at 36
            both(lambda one, a=arguments: feed(one, a))
        else:
            for one in (mhe, twin):
                one.forget_warm_start()
            assert_same(feed(mhe, arguments), feed(twin, arguments))
        if t in (2, 20):
            both(lambda one, t=t: one.amend(t - 1, [0.3]))
            np.testing.assert_array_equal(mhe.covariances(), twin.covariances())
        if t in actions:
            both(actions[t])


@pytest.mark.parametrize("missing", [np.nan, 1e200])
def test_an_interrupt_leaves_no_missing_components_behind_the_window(missing):
    class Interrupting(qpmhe.QuadraticCost):
        is_ready = False

        def partial_weight(self, *arguments):
            if self.is_ready:
                self.is_ready = False
                raise KeyboardInterrupt
            return super().partial_weight(*arguments)

    cost = Interrupting(prior=1.0, disturbance=10.0, noise=np.eye(2))
    mhe, twin = (
        qpmhe.MovingHorizonEstimator(
            qpmhe.System(lambda x: 0.9 * x, lambda x: np.repeat(x, 2), n=1, p=2),
            qpmhe.Luenberger([[0.3, 0.1]]), cost, horizon=5, initial_state=[1.0],
        ) for _ in range(2)
    )
    cost.is_ready = True
    with pytest.raises(KeyboardInterrupt):
        mhe.update([missing, 1.0])
    for y in ([1.0, 1.0], [1.0, np.nan]):
        assert_same(mhe.update(y), twin.update(y))


@pytest.mark.parametrize("observer", [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
def test_an_interrupted_step_leaves_no_root_of_a_covariance(observer):
    near = 1.0 - 1e-10  # two states that are known to be nearly equal
    given = {"disturbance": 1e-12 * np.eye(2), "noise": np.eye(1)}
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: 1.0 * x, lambda x: x @ [[1.0], [1.0]], n=2, p=1),
        observer(prior=np.array([[1.0, near], [near, 1.0]]), **given),
        qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **given),
        horizon=3, initial_state=np.zeros(2), engine="python",
    )
    generator = np.random.default_rng(0)
    for y in (1.0, 3.0):
        interrupted(mhe, lambda one, y=y: one.update([y]), generator, 60)
    assert mhe._engine._window.is_vague[:3].all()
