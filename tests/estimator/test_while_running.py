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
PENALTIES = {"linear": 0.5, "quadratic": 2.0}
SOFT = {name: one.soften(**PENALTIES) for name, one in SETS.items()}
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
    "soft sets": {"sets": SOFT, "max_qps": 2},
    "sets, reinitialized": {"sets": SETS, "candidate": "reinitialized"},
    "sets, kalman": {"sets": SETS, "kalman": "ExtendedKalman"},
}
if find_compiler() is not None:
    OPTIONS |= {
        f"{name}, in C": OPTIONS[name] | {"engine": "compiled"}
        for name in (
            "plain", "two", "observer alone", "reinitialized", "discount", "sets",
            "sets, reinitialized", "sets, kalman", "kalman", "unscented", "robust",
        )
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


def in_casadi(**sets):
    ca = pytest.importorskip("casadi")
    return qpmhe.from_casadi(
        lambda x, u: [x[1], u[0] - u[1] * ca.sin(x[0]) - u[2] * x[1]],
        lambda x: [x[0], x[1], x[0] + 0.1 * x[1] ** 2],
        n=2, m=3, dt=0.1, method="euler", compiled=False, **sets,
    )


def estimator(
    sets=None, kalman=None, robust=False, discount=1.0, weights=WEIGHTS, parameters=NOMINAL,
    prior=None, **options
):
    if options.get("engine") == "compiled":
        system = in_casadi(**(sets or {}))
    else:
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
        mhe, intime, taken = estimator(**options), estimator(**options), []
        for t, ((y, u), own) in enumerate(samples(30, 4, has_sets(name))):
            expected, late = intime.update(y, u, **own), t - delay
            mhe.update(None if t % 4 == 0 else y, u, **own)
            if late % 4 == 0 and late >= 0:
                mhe.amend(late, taken[late])
                found, expected = mhe.amend(t, [np.nan] * 3), intime.amend(t, [np.nan] * 3)
                if t % 4:
                    np.testing.assert_array_equal(found.candidate, expected.candidate)
                    assert found.candidate_cost == expected.candidate_cost
                    assert_same(numbers(found)[:-1], numbers(expected)[:-1])
            taken.append(np.full(3, np.nan))
            taken[t][own.get("sensors", [0, 1, 2])] = y


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
                "noises": qpmhe.Box([-0.4, -np.inf, -5.0], [0.4, np.inf, 5.0]),
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
            if not given.matrix.size and SETS[name].matrix.size:
                given = given & qpmhe.Polytope([[1.0, 1.0]], [2.0])
            soft = isinstance(sets[name], qpmhe.SoftSet)
            sets[name] = given.soften(**PENALTIES) if soft else given
    made = {k: v for k, v in options.items() if k != "sets"}
    return estimator(
        sets=sets, weights=weights, parameters=changes.get("parameters", NOMINAL), **made, **more
    )


@pytest.mark.parametrize(
    ("name", "change"),
    [(name, change) for name in OPTIONS for change in CHANGES
     if has_sets(name) or not CHANGES[change][1]],
)
def test_set_gives_the_estimator_that_was_made_with_the_values(name, change):
    (changes, _), options = CHANGES[change], OPTIONS[name]
    mhe, record = estimator(**options), samples(20, 6, has_sets(name))
    for one in record[:12]:
        before = feed(mhe, one)
    window = getattr(mhe._engine, "_window", None)  # of the Python step
    if window is not None:
        prior = window.prior_covariance
    elif "kalman" in options:
        memory = mhe._engine._memory[0]
        prior = memory["stages"]["covariance"][memory["first"]]
    else:
        prior = None
    prior = None if prior is None else prior.copy()
    metric = None if window is None or window.metric is None else window.metric.state
    estimate, first = mhe.set(**changes), before.candidate[0]
    hard = options.get("sets") is not SOFT  # the observer is not projected onto a soft X
    states = changes.get("bounds", {}).get("states") if hard else None
    if states is None or states.violation(first) == 0.0:
        np.testing.assert_array_equal(estimate.candidate[0], first)
    made = changed(options, changes, initial_state=estimate.candidate[0], prior=prior)
    if metric is not None:
        made._engine._window.metric.state = metric
    if window is None:
        for field in ("metric", "metric_settled"):
            made._engine._memory[field] = mhe._engine._memory[field]
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


def test_set_before_the_first_sample():
    mhe = estimator(sets=SETS)
    states = qpmhe.Box([0.6, -1.0], [1.0, np.inf])
    assert mhe.set(bounds={"states": states}, noise_weight=np.eye(3)) is None
    assert states.violation(mhe.state) == 0.0
    made = changed(
        {"sets": SETS}, {"bounds": {"states": states}, "noise_weight": np.eye(3)},
        initial_state=mhe.state,
    )
    for one in samples(8, 7, True):
        assert_close(feed(mhe, one), feed(made, one))
    mhe.reset()
    made.reset()
    assert_close(feed(mhe, one), feed(made, one))


# Bad input


def wrong():
    box = qpmhe.Box([-1.0, -1.0], [1.0, 1.0])
    three = np.zeros(3)
    bounds = [
        (OptionError, ["bounds is 3", "dictionary"], {"bounds": 3}),
        (OptionError, ["'outputs'", "'states'"], {"bounds": {"outputs": box}}),
        (SetError, ["bounds['states'] is None", "qpmhe.Box", "Leave it out"],
         {"bounds": {"states": None}}),
        (SetError, ["bounds['states'] is Box", "soften", "penalties stay"],
         {"bounds": {"states": box.soften(linear=1.0)}}),
        (SetError, ["bounds['states'] is [0.0, 1.0]", "qpmhe.Box"],
         {"bounds": {"states": [0.0, 1.0]}}),
        (SetError, ["dimension 3", "expected 2"],
         {"bounds": {"states": qpmhe.Box(three, three + 1.0)}}),
        (OptionError, ["bounds component 1", "as wide as it ever is"],
         {"bounds": {"noises": qpmhe.Box(-1.0 - three, 1.0 + three)}}),
        (OptionError, ["general inequalities", "the same matrix"],
         {"bounds": {"states": qpmhe.Polytope([[1.0, 2.0]], [1.0])}}),
        (SetError, ["empty"], {"bounds": {"states": qpmhe.Box([1.2, 1.0], [1.5, np.inf])}}),
        (OptionError, ["leaves no width to component 0"],
         {"bounds": {"disturbances": qpmhe.Box([0.0, -1.0], [0.0, 1.0])}}),
    ]
    weights = [
        (WeightError, ["noise_weight", "positive definite"], {"noise_weight": np.diag([1, 1, -1])}),
        (ShapeError, ["noise_weight has shape (2, 2)", "(3, 3)"], {"noise_weight": np.eye(2)}),
        (WeightError, ["disturbance_weight", "positive definite"],
         {"disturbance_weight": np.zeros((2, 2))}),
        (WeightError, ["disturbance_weight is not symmetric"],
         {"disturbance_weight": [[1.0, 0.5], [0.0, 1.0]]}),
        (ShapeError, ["disturbance_weight has shape (3, 3)", "(2, 2)"],
         {"disturbance_weight": np.eye(3)}),
    ]
    parameters = [
        (ShapeError, ["parameters has shape (3,)", "(2,)"], {"parameters": three}),
        (ShapeError, ["parameters has shape ()", "(2,)"], {"parameters": 1.0}),
        (InvalidInputError, ["parameters is", "finite"], {"parameters": [np.nan, 1.0]}),
    ]
    return bounds + weights + parameters


WRONG_SENSORS = [
    (InvalidInputError, ["sensors is [3]", "from 0 to 2"], [0.0], [3]),
    (InvalidInputError, ["sensors is [-1]", "from 0 to 2"], [0.0], [-1]),
    (InvalidInputError, ["sensors is [1, 1]", "at most once"], [0.0, 0.0], [1, 1]),
    (InvalidInputError, ["sensors is []", "update(None)"], [], []),
    (InvalidInputError, ["sensors is [False, False, False]", "update(None)"], [], [False] * 3),
    (ShapeError, ["sensors has shape (2,)", "(3,)"], [0.0], [True, False]),
    (InvalidInputError, ["sensors is [0.0]", "indices"], [0.0], [0.0]),
    (InvalidInputError, ["sensors is [[0]]", "indices"], [0.0], [[0]]),
    (InvalidInputError, ["sensors is [[0], [1, 2]]", "indices"], [0.0], [[0], [1, 2]]),
    (InvalidInputError, ["sensors is 'speed'", "indices"], [0.0], "speed"),
    (ShapeError, ["y has shape (3,)", "sensors=[0, 2]"], [0.0, 0.0, 0.0], [0, 2]),
    (ShapeError, ["y has shape (1,)", "sensors=[0, 2]"], 0.0, [0, 2]),
    (InvalidInputError, ["y is", "real numbers"], ["high", 1.0], [0, 2]),
]
Y, U = [0.1, 0.2, 0.3], [0.4]


def unharmed(mhe, kind, fragments, call):
    before = leaves(mhe.state_dict())
    check(kind, fragments, lambda: call(mhe))
    assert leaves(mhe.state_dict()) == before


@pytest.mark.parametrize("count", [0, 6])
@pytest.mark.parametrize("name", ["sets, kalman", "sets, in C"])
def test_wrong_conditions_leave_the_estimator_as_it_was(count, name):
    if name not in OPTIONS:
        pytest.skip("there is no C compiler")
    mhe, twin = estimator(**OPTIONS[name]), None
    for one in samples(count, 8, True):
        feed(mhe, one)
    twin = pickle.loads(pickle.dumps(mhe))
    for kind, fragments, given in wrong():
        unharmed(mhe, kind, fragments, lambda one, given=given: one.update(Y, U, **given))
        unharmed(mhe, kind, fragments, lambda one, given=given: one.set(**given))
        right = {"noise_weight": np.eye(3), "disturbance_weight": np.eye(2), "parameters": [1, 1]}
        both = right | given
        unharmed(mhe, kind, fragments, lambda one, both=both: one.update(Y, U, **both))
        unharmed(mhe, kind, fragments, lambda one, both=both: one.set(**both))
    for kind, fragments, y, sensors in WRONG_SENSORS:
        call = lambda one, y=y, sensors=sensors: one.update(y, U, sensors=sensors)  # noqa: E731
        unharmed(mhe, kind, fragments, call)
    for u in ([1.0, 2.0], [1.0, 2.0, 3.0], 1j):
        text = "u has shape" if u != 1j else "u is"
        unharmed(mhe, InvalidInputError, [text], lambda one, u=u: one.update(Y, u))
    for one in samples(9, 9, True):
        assert_same(numbers(feed(mhe, one)), numbers(feed(twin, one)))


@pytest.mark.parametrize(
    ("given", "kind", "fragments"),
    [
        ({"parameters": [1.0]}, InvalidInputError, ["parameters is [1.0]", "has none"]),
        ({"bounds": {"states": SETS["states"]}}, OptionError, ["no set of states", "System("]),
    ],
    ids=["parameters", "bounds"],
)
def test_what_the_estimator_does_not_have(given, kind, fragments):
    mhe = estimator(parameters=None)
    unharmed(mhe, kind, fragments, lambda one: one.update(Y, [0.4, 1.0, 0.1], **given))
    unharmed(mhe, kind, fragments, lambda one: one.set(**given))


@pytest.mark.parametrize(
    ("parameters", "kind", "fragments"),
    [
        ([1.0] * 4, ShapeError, ["parameters has 4 numbers", "at most 3"]),
        ([[1.0]], ShapeError, ["parameters has shape (1, 1)", "(k,)"]),
        ([np.inf], InvalidInputError, ["parameters is [inf]", "finite"]),
        ("stiff", InvalidInputError, ["parameters is 'stiff'", "real numbers"]),
    ],
)
def test_wrong_parameters_of_an_estimator(parameters, kind, fragments):
    check(kind, fragments, lambda: estimator(parameters=parameters))


def test_fixed_components_of_the_disturbance_stay_fixed():
    fixed = qpmhe.Box([0.0, -1.0], [0.0, 1.0])
    mhe = estimator(sets={"disturbances": fixed})
    other = qpmhe.Box([-0.1, -1.0], [0.1, 1.0])
    given = {"bounds": {"disturbances": other}}
    unharmed(mhe, OptionError, ["frees component 0"], lambda one: one.update(Y, U, **given))
    narrow = {"disturbances": qpmhe.Box([0.0, -0.01], [0.0, 0.01])}
    for _ in range(5):
        estimate = mhe.update(Y, U, bounds=narrow)
        assert not estimate.disturbances[:, 0].any()
    assert np.abs(estimate.disturbances[:, 1]).max() <= 0.01 + 1e-8


def test_a_robust_loss_per_component_needs_a_diagonal_weight():
    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=2, p=2)
    cost = qpmhe.RobustCost(
        prior=np.eye(2), disturbance=qpmhe.Huber(np.eye(2), per_component=True), noise=np.eye(2)
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.1 * np.eye(2)), cost, horizon=3, initial_state=[0.0, 0.0]
    )
    dense = [[2.0, 0.5], [0.5, 1.0]]
    for call in (
        lambda one: one.update([1.0, 1.0], disturbance_weight=dense),
        lambda one: one.set(disturbance_weight=dense),
    ):
        unharmed(mhe, WeightError, ["diagonal"], call)


# Memory


@every
def test_snapshots_and_pickles_keep_the_conditions(name):
    mhe, record = estimator(**OPTIONS[name]), samples(40, 10, has_sets(name))
    for t, one in enumerate(record[:20]):
        feed(mhe, one)
        if t == 11:
            own = {"bounds": {"states": qpmhe.Box([-0.9, -1.0], [0.9, np.inf])}}
            mhe.set(
                disturbance_weight=np.diag([3.0, 2.0]), parameters=[0.8, 0.2],
                **(own if has_sets(name) else {}),
            )
    restored, again = estimator(**OPTIONS[name]), pickle.loads(pickle.dumps(mhe))
    restored.load_state_dict(mhe.state_dict())
    assert leaves(restored.state_dict()) == leaves(mhe.state_dict())
    for t, one in enumerate(record[20:]):
        expected = numbers(feed(mhe, one))
        for other in (restored, again):
            assert_same(numbers(feed(other, one)), expected)
        if t == 3:
            expected = numbers(mhe.amend(21, [0.1, 0.2, 0.3]))
            for other in (restored, again):
                assert_same(numbers(other.amend(21, [0.1, 0.2, 0.3])), expected)
        if t == 6:
            expected = numbers(mhe.set(noise_weight=np.eye(3)))
            for other in (restored, again):
                assert_same(numbers(other.set(noise_weight=np.eye(3))), expected)


def test_a_state_with_parameters_is_of_another_estimator():
    mhe = estimator()
    mhe.update(Y, U)
    with pytest.raises(InvalidInputError, match="another number of parameters"):
        estimator(parameters=None).load_state_dict(mhe.state_dict())


def test_what_was_given_is_copied():
    mhe, twin = estimator(sets=SETS), estimator(sets=SETS)
    for one in samples(12, 11, True):
        feed(twin, one)
        (y, u), own = one
        spoilt = {k: np.array(v) if k not in ("bounds", "dt") else v for k, v in own.items()}
        if "bounds" in own:
            spoilt["bounds"] = {k: qpmhe.Box(v.lower, v.upper) for k, v in own["bounds"].items()}
        mhe.update(y, u, **spoilt)
        for value in spoilt.values():
            if isinstance(value, np.ndarray):
                value[...] = 0
        for box in spoilt.get("bounds", {}).values():
            box.lower[...] = box.upper[...] = 0.0
    assert leaves(mhe.state_dict()) == leaves(twin.state_dict())


@pytest.mark.parametrize("name", [
    "plain", "sets", "sets, reinitialized", "sets, kalman", "plain, in C",
    "sets, reinitialized, in C",
])
def test_an_interrupted_change_was_not_made(name):
    if name not in OPTIONS:
        pytest.skip("there is no C compiler")
    mhe, twin = estimator(**OPTIONS[name]), estimator(**OPTIONS[name])
    rng, changes = np.random.default_rng(12), {"noise_weight": np.eye(3), "parameters": [0.7, 0.3]}
    if has_sets(name):
        changes["bounds"] = {"states": qpmhe.Box([-0.4, -1.0], [0.4, np.inf])}
    for t, one in enumerate(samples(14, 13, has_sets(name))):
        do = [lambda each, one=one: feed(each, one)]
        if t in (0, 7):
            do.append(lambda each: each.set(**changes))
        for each in do:
            if t in (0, 3, 4, 7, 12):
                mhe.state_dict()  # in which solvers forget, as they do after an interrupt
                twin.state_dict()
                found, expected = interrupted(mhe, each, rng, 60), each(twin)
                assert_same(numbers(found), numbers(expected))
            else:
                each(mhe)
                each(twin)
    assert leaves(mhe.state_dict()) == leaves(twin.state_dict())


# The step's work


def test_a_sample_of_one_sensor_computes_nothing_twice(monkeypatch):
    mhe, reduced = estimator(), []
    plain = qpmhe.QuadraticCost._reduced
    monkeypatch.setattr(
        qpmhe.QuadraticCost, "_reduced",
        lambda self, *arguments: reduced.append(1) or plain(self, *arguments),
    )
    for t in range(60):
        mhe.update([0.1], U, sensors=[t % 3])
    assert len(reduced) == 3


def test_a_batch_has_no_parameters():
    mhe = estimator()
    with pytest.raises(qpmhe.errors.UnknownOptionError, match=r"'parameters'.*inputs"):
        qpmhe.BatchEstimator(
            mhe.system, mhe.observer, mhe.cost, members=2, horizon=3,
            initial_states=[0.5, 0.0], parameters=[1.0],
        )


@pytest.mark.parametrize(
    "changes",
    [{"noise_weight": 2.0}, {"disturbance_weight": 4.0},
     {"bounds": {"noises": qpmhe.Box(-0.5, 0.5)}}],
    ids=lambda changes: next(iter(changes)),
)
@pytest.mark.parametrize("kalman", [False, True])
def test_the_written_code_has_the_present_weights_and_bounds(changes, kalman, tmp_path):
    ca = pytest.importorskip("casadi")

    def made(noise=1.0, disturbance=1.0, noises=None):
        system = qpmhe.from_casadi(
            lambda x: 0.9 * x + 0.1 * ca.sin(x), lambda x: x, n=1, p=1,
            noises=noises or qpmhe.Box(-1.0, 1.0),
        )
        cost = qpmhe.QuadraticCost(prior=1.0, disturbance=disturbance, noise=noise)
        observer = qpmhe.Luenberger([0.2])
        if kalman:
            observer = qpmhe.ExtendedKalman(
                prior=1.0, disturbance=1.0 / disturbance, noise=1.0 / noise
            )
        return qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=3, initial_state=[0.0]
        )

    def written(mhe):
        return [path.read_text() for path in qpmhe.codegen.write(mhe, tmp_path)]

    mhe, before = made(), written(made())
    mhe.set(**changes)
    values = {name.removesuffix("_weight"): value for name, value in changes.items()}
    assert written(mhe) == written(made(**values.pop("bounds", values))) != before


@pytest.mark.parametrize("kalman", [False, True])
def test_with_a_disturbance_matrix(kalman):
    """The disturbance's weight then has the size of its columns."""
    def made(weight, start=(0.4, 0.0)):
        system = qpmhe.System(
            lambda x: x + 0.1 * np.stack((x[..., 1], -np.sin(x[..., 0])), axis=-1),
            lambda x: x[..., :1], n=2, p=1, disturbance_matrix=[[0.1], [1.0]],
        )
        observer, first = qpmhe.Luenberger([[0.3], [0.2]]), np.eye(2)
        if kalman:
            observer = qpmhe.ExtendedKalman(prior=first, disturbance=1.0 / weight, noise=1.0)
            first = qpmhe.ObserverPrior()
        cost = qpmhe.QuadraticCost(prior=first, disturbance=weight, noise=1.0)
        return qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=4, initial_state=start, max_qps=2
        )

    mhe, twin, rng = made(9.0), made(9.0), np.random.default_rng(14)
    Y = rng.normal(0.0, 0.5, 12)
    wrong = {"disturbance_weight": np.eye(2)}
    unharmed(mhe, ShapeError, ["(2, 2)", "(1, 1)"], lambda one: one.set(**wrong))
    for t, y in enumerate(Y[:8]):
        own = {"disturbance_weight": 9.0} if t % 2 else {}
        found, expected = mhe.update(y, **own), twin.update(y)
        assert_same(numbers(found), numbers(expected))
    assert_same(numbers(mhe.set(disturbance_weight=9.0)), numbers(found))
    other = made(4.0, found.candidate[0])
    for y in Y[4:8]:
        expected = other.update(y)
    found = mhe.set(disturbance_weight=[[4.0]])
    if not kalman:  # the other one's covariance would have to be another from the start
        assert_close(found, expected)
    restored = made(9.0)
    restored.load_state_dict(mhe.state_dict())
    for t, y in enumerate(Y[8:]):
        own = {"disturbance_weight": 20.0} if t == 1 else {}
        found, expected = mhe.update(y, **own), other.update(y, **own)
        if not kalman:
            assert_close(found, expected)
        assert_same(numbers(restored.update(y, **own)), numbers(found))
