"""Weights, bounds, parameters and sensors that change while the estimator runs."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError, OptionError, SetError, ShapeError, WeightError

from .spoil import check
from .test_interrupts import interrupted, leaves
from .test_own_memory import assert_same, numbers

WEIGHTS = {"prior": np.diag([2.0, 1.0]), "disturbance": np.diag([9.0, 4.0]),
           "noise": np.array([[3.0, 0.5, 0.0], [0.5, 2.0, 0.2], [0.0, 0.2, 4.0]])}
SETS = {
    "states": qpmhe.Box([-1.5, -2.0], [1.5, np.inf]) & qpmhe.Polytope([[1.0, 1.0]], [2.0]),
    "disturbances": qpmhe.Box([-0.4, -0.5], [0.4, 0.5]),
    "noises": qpmhe.Box([-1.0, -np.inf, -1.0], [1.0, np.inf, 1.0]),
}
NOMINAL = np.array([1.0, 0.1])
OPTIONS = {
    "plain": {},
    "two": {"max_qps": 2},
    "observer alone": {"max_qps": 0},
    "reinitialized": {"candidate": "reinitialized"},
    "kalman": {"kalman": "ExtendedKalman"},
    "unscented": {"kalman": "UnscentedKalman", "candidate": "reinitialized"},
    "robust": {"robust": True, "max_qps": 2},
    "discount": {"discount": 0.9},
    "sets": {"sets": SETS, "max_qps": 2},
    "sets, reinitialized": {"sets": SETS, "candidate": "reinitialized"},
    "sets, kalman": {"sets": SETS, "kalman": "ExtendedKalman"},
}
every = pytest.mark.parametrize("name", OPTIONS)
# The sets are narrow: rows are dropped for long, and a start may lie outside.
pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


def rate(x, u):
    """A pendulum with a push, and its stiffness and damping as parameters."""
    return np.stack(
        (x[..., 1], u[..., 0] - u[..., 1] * np.sin(x[..., 0]) - u[..., 2] * x[..., 1]), axis=-1
    )


def h(x):
    return np.stack((x[..., 0], x[..., 1], x[..., 0] + 0.1 * x[..., 1] ** 2), axis=-1)


def estimator(
    sets=None, kalman=None, robust=False, discount=1.0, weights=WEIGHTS, parameters=NOMINAL,
    prior=None, **options
):
    system = qpmhe.System.from_ode(
        rate, h, dt=0.1, n=2, p=3, m=3, method="euler", **(sets or {})
    )
    weights = dict(weights)
    observer = qpmhe.Luenberger([[0.3, 0.1, 0.05], [0.1, 0.2, 0.0]])
    if kalman:
        covariances = {k: np.linalg.inv(v) for k, v in weights.items()}
        if prior is not None:
            covariances["prior"] = prior
        observer = getattr(qpmhe, kalman)(**covariances)
        weights["prior"] = qpmhe.ObserverPrior()
    if robust:
        weights["noise"] = qpmhe.Huber(weights["noise"])
    cost = (qpmhe.RobustCost if robust else qpmhe.QuadraticCost)(**weights, discount=discount)
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost,
        **{"horizon": 4, "initial_state": [0.5, 0.0], "parameters": parameters} | options,
    )


def samples(count, seed=0, sets=False, single=True):
    """Arguments of `update`: a sample may have conditions of its own."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        y, own = rng.normal(0.0, 0.5, 3), {}
        y[rng.random(3) < 0.15] = np.nan
        chances = rng.random(6) < 0.3 * single
        if chances[0]:
            own["noise_weight"] = np.diag(rng.uniform(0.5, 9.0, 3))
        if chances[1]:
            own["disturbance_weight"] = np.diag(rng.uniform(0.5, 9.0, 2))
        if chances[2]:
            own["parameters"] = NOMINAL * rng.uniform(0.5, 2.0, 2)
        if chances[3]:
            own["dt"] = 0.07
        if chances[4]:
            own["sensors"] = rng.permutation(3)[: rng.integers(1, 4)]
            y = y[own["sensors"]]
        if chances[5] and sets:
            own["bounds"] = {
                "states": qpmhe.Box(-rng.uniform(0.3, 1.5, 2), [rng.uniform(0.3, 1.5), np.inf]),
                "disturbances": qpmhe.Box([-0.3, -0.2], rng.uniform(0.0, 0.5, 2)),
                "noises": qpmhe.Box([-0.5, -np.inf, -2.0], [0.5, np.inf, 2.0]),
            }
        found.append(((y, rng.normal(0.0, 1.0, 1)), own))
    return found


def feed(mhe, sample):
    return mhe.update(*sample[0], **sample[1])


def has_sets(name):
    return "sets" in OPTIONS[name]


# What is given, but neutral


def neutral(name, t):
    own = [
        {"noise_weight": WEIGHTS["noise"]}, {"disturbance_weight": WEIGHTS["disturbance"]},
        {"parameters": NOMINAL}, {"sensors": [0, 1, 2]}, {"sensors": np.ones(3, np.bool_)},
    ]
    if has_sets(name):
        own += [{"bounds": SETS}, {"bounds": {"states": SETS["states"]}}]
    return own[t % len(own)]


@every
def test_what_is_neutral_changes_no_bit(name):
    mhe, twin = estimator(**OPTIONS[name]), estimator(**OPTIONS[name])
    for t, (arguments, own) in enumerate(samples(50, 1, single=False)):
        given = neutral(name, t)
        found, expected = mhe.update(*arguments, **given, **own), twin.update(*arguments, **own)
        assert_same(numbers(found), numbers(expected))
        if t % 9 == 5:
            late = np.array([0.1, np.nan, 0.2])
            assert_same(numbers(mhe.amend(t - 1, late)), numbers(twin.amend(t - 1, late)))
        if t % 9 == 7:
            found = mhe.set(**{k: v for k, v in neutral(name, t // 9).items() if k != "sensors"})
            assert_same(numbers(found), numbers(expected))


def test_other_orders_of_all_sensors_are_neutral():
    mhe, twin = estimator(), estimator()
    for (y, u), _ in samples(20, 2, single=False):
        expected = numbers(twin.update(y, u))
        assert_same(numbers(mhe.update(y[[2, 0, 1]], u, sensors=[2, 0, 1])), expected)


def test_what_was_not_sampled_is_missing_but_for_the_status():
    mhe, twin = estimator(), estimator()
    for t, (y, u) in enumerate(one[0] for one in samples(30, 3, single=False)):
        kept = [[0], [2, 1], [1, 0, 2]][t % 3]
        z = np.full(3, np.nan)
        z[kept] = y[kept]
        found, expected = mhe.update(y[kept], u, sensors=kept), twin.update(z, u)
        assert (Status.MISSING in found.status) == bool(np.isnan(y[kept]).any())
        assert_same(numbers(found)[:-1], numbers(expected)[:-1])
        assert found.status | Status.MISSING == expected.status | Status.MISSING
        if t % 5 == 4:  # a late measurement of a sensor that was not sampled then
            late = np.array([np.nan, 0.3, np.nan])
            assert_same(numbers(mhe.amend(t - 1, late))[:-1], numbers(twin.amend(t - 1, late))[:-1])


@pytest.mark.parametrize("one", [1, np.int64(1), [1], (1,), np.array([1]), [False, True, False]])
def test_ways_to_name_a_sensor(one):
    mhe, twin = estimator(), estimator()
    for value in (0.3, None, 0.4):
        found = mhe.update(value, [0.1], sensors=one)
        assert_same(
            numbers(found)[:-1], numbers(twin.update([np.nan, value, np.nan], [0.1]))[:-1]
        )
        assert (Status.MISSING in found.status) == (value is None)


# Each sample keeps what it was taken with


@every
def test_a_late_measurement_finds_the_sample_as_it_was_taken(name):
    options = OPTIONS[name] | {"candidate": "observer"}
    for delay in (1, 2, 3):
        mhe, intime = estimator(**options), estimator(**options)
        for t, ((y, u), own) in enumerate(samples(30, 4, has_sets(name))):
            expected, late = intime.update(y, u, **own), t - delay
            mhe.update(None if t % 4 == 0 else y, u, **own)
            if late % 4 == 0 and late >= 0:
                mhe.amend(late, y_before[-delay])
                found, expected = mhe.amend(t, [np.nan] * 3), intime.amend(t, [np.nan] * 3)
                if t % 4:
                    np.testing.assert_array_equal(found.candidate, expected.candidate)
                    assert found.candidate_cost == expected.candidate_cost
                    assert_same(numbers(found)[:-1], numbers(expected)[:-1])
            full = np.full(3, np.nan)
            full[own.get("sensors", [0, 1, 2])] = y
            y_before = [*(y_before if t else []), full]


@every
def test_parameters_are_the_last_inputs(name):
    options, sets = OPTIONS[name], has_sets(name)
    mhe, plain = estimator(**options), estimator(**options, parameters=None)
    for (y, u), own in samples(30, 5, sets):
        expected = plain.update(
            y, np.append(u, own.get("parameters", NOMINAL)),
            **{k: v for k, v in own.items() if k != "parameters"},
        )
        assert_same(numbers(mhe.update(y, u, **own)), numbers(expected))
    Y, U = np.zeros((5, 3)), np.ones((5, 1))
    expected = plain.run(Y, np.hstack((U, np.tile(NOMINAL, (5, 1)))))
    np.testing.assert_array_equal(mhe.run(Y, U).states, expected.states)


def test_a_system_may_have_parameters_as_its_only_inputs():
    system = qpmhe.System(lambda x, u: u * x, lambda x: x, n=1, p=1, m=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    mhe, plain = (
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.2]), cost, horizon=3, initial_state=[1.0], parameters=given
        )
        for given in (0.9, None)
    )
    for t in range(8):
        if t == 5:
            mhe.set(parameters=0.7)
        own = {"parameters": [0.8]} if t == 2 else {}
        found = mhe.update([1.0], **own)
        expected = plain.update([1.0], [0.8 if t == 2 else 0.9 if t < 5 else 0.7])
        if t < 5:
            assert_same(numbers(found), numbers(expected))
    assert mhe.run(np.ones((4, 1))).states.shape == (5, 1)


# Changes for all samples


CHANGES = {
    "noise": ({"noise_weight": np.diag([1.0, 5.0, 2.0])}, False),
    "disturbance": ({"disturbance_weight": np.array([[5.0, 1.0], [1.0, 2.0]])}, False),
    "parameters": ({"parameters": [2.0, 0.3]}, False),
    "states": ({"bounds": {"states": qpmhe.Box([-0.2, -0.5], [0.25, np.inf])}}, True),
    "all bounds": (
        {
            "bounds": {
                "states": qpmhe.Box([-0.4, -1.0], [0.3, np.inf])
                & qpmhe.Polytope([[1.0, 1.0]], [0.3]),
                "disturbances": qpmhe.Box([-0.1, -0.2], [0.2, 0.1]),
                "noises": qpmhe.Box([-0.4, -np.inf, -np.inf], [0.4, np.inf, np.inf]),
            }
        }, True,
    ),
    "everything": (
        {
            "noise_weight": 2.0 * WEIGHTS["noise"], "disturbance_weight": np.diag([1.0, 7.0]),
            "parameters": [0.5, 0.2], "bounds": {"states": qpmhe.Box([-0.3, -0.5], [0.4, np.inf])},
        }, True,
    ),
}


def changed(options, changes, **more):
    """An estimator that was made with the values of a change."""
    weights = WEIGHTS | {
        k: changes[f"{k}_weight"] for k in ("noise", "disturbance") if f"{k}_weight" in changes
    }
    sets = options.get("sets")
    if "bounds" in changes:
        sets = dict(sets)
        for name, given in changes["bounds"].items():
            if not given.matrix.size and sets[name].matrix.size:
                given = given & qpmhe.Polytope([[1.0, 1.0]], [2.0])
            sets[name] = given
    made = {k: v for k, v in options.items() if k != "sets"}
    return estimator(
        sets=sets, weights=weights, parameters=changes.get("parameters", NOMINAL), **made, **more
    )


@pytest.mark.parametrize("change", CHANGES)
@every
def test_set_gives_the_estimator_that_was_made_with_the_values(name, change):
    changes, needs_sets = CHANGES[change]
    if needs_sets and not has_sets(name):
        pytest.skip("no rows to change")
    options = OPTIONS[name]
    mhe, record = estimator(**options), samples(20, 6, has_sets(name))
    for one in record[:12]:
        before = feed(mhe, one)
    window, first = mhe._engine._window, before.candidate[0].copy()
    prior = None if window.prior_covariance is None else window.prior_covariance.copy()
    metric = None if window.metric is None else window.metric.state
    estimate = mhe.set(**changes)
    made = changed(options, changes, initial_state=first, prior=prior)
    if metric is not None:
        made._engine._window.metric.state = metric
    for (y, u), own in record[8:12]:
        own = {k: v for k, v in own.items() if k == "bounds" or k not in changes}
        own["bounds"] = {
            k: v for k, v in own.get("bounds", {}).items() if k not in changes.get("bounds", {})
        }
        expected = made.update(y, u, **own)
    assert estimate.time == 11
    assert_close(estimate, expected)
    reinitialized = options.get("candidate") == "reinitialized"
    for one in record[12:15]:
        found, expected = feed(mhe, one), feed(made, one)
        if not reinitialized:  # estimates made before the change stay in the history
            assert_close(found, expected)


def assert_close(found, expected):
    np.testing.assert_allclose(found.candidate, expected.candidate, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.trajectory, expected.trajectory, rtol=0, atol=1e-8)
    assert found.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)
    assert found.cost == pytest.approx(expected.cost, rel=1e-7)
