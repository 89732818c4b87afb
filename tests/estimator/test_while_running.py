"""Weights, bounds, parameters and sensors that change while the estimator runs."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe import Box, Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError, OptionError, SetError, ShapeError, WeightError

from .same import assert_same, leaves
from .spoil import check

WEIGHTS = {"prior": np.diag([2.0, 1.0]), "disturbance": np.diag([9.0, 4.0]),
           "noise": np.array([[3.0, 0.5, 0.0], [0.5, 2.0, 0.2], [0.0, 0.2, 4.0]])}
ROW = qpmhe.Polytope([[1.0, 1.0]], [2.0])
SETS = {
    "states": Box([-1.5, -2.0], [1.5, np.inf]) & ROW,
    "disturbances": Box([-0.4, -0.5], [0.4, 0.5]),
    "noises": Box([-1.0, -np.inf, -1.0], [1.0, np.inf, 1.0]),
}
PENALTIES = {"linear": 0.5, "quadratic": 2.0}
SOFT = {name: one.soften(**PENALTIES) for name, one in SETS.items()}
NOMINAL = np.array([1.0, 0.1])
OPTIONS = {
    "two": {"max_qps": 2},
    "observer alone": {"max_qps": 0, "discount": 0.9},
    "kalman": {"kalman": "ExtendedKalman"},
    "unscented": {"kalman": "UnscentedKalman", "candidate": "reinitialized"},
    "robust": {"robust": True, "max_qps": 2},
    "soft sets": {"sets": SOFT, "max_qps": 2},
    "sets, reinitialized": {"sets": SETS, "candidate": "reinitialized"},
    "sets, kalman": {"sets": SETS, "kalman": "ExtendedKalman", "max_qps": 2},
}
if find_compiler() is not None:
    names = ("two", "robust", "unscented", "sets, reinitialized", "sets, kalman")
    OPTIONS |= {f"{name}, in C": OPTIONS[name] | {"engine": "compiled"} for name in names}
every = pytest.mark.parametrize("name", OPTIONS)
# The sets are narrow: rows are dropped for long, and a start may lie outside.
pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


class Pendulum:
    """With a push, and its stiffness and damping as parameters."""

    @staticmethod
    def rate(x, u):
        return np.stack(
            (x[..., 1], u[..., 0] - u[..., 1] * np.sin(x[..., 0]) - u[..., 2] * x[..., 1]), axis=-1
        )

    @staticmethod
    def h(x):
        return np.stack((x[..., 0], x[..., 1], x[..., 0] + 0.1 * x[..., 1] ** 2), axis=-1)


def estimator(
    sets=None, kalman=None, robust=False, discount=1.0, weights=WEIGHTS, parameters=NOMINAL,
    prior=None, **options
):
    system = qpmhe.System.from_ode(
        Pendulum.rate, Pendulum.h, dt=0.1, n=2, p=3, m=3, method="euler", **(sets or {})
    )
    weights, observer = dict(weights), qpmhe.Luenberger([[0.3, 0.1, 0.05], [0.1, 0.2, 0.0]])
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
        system, observer, cost, **{
            "horizon": 4, "initial_state": [0.5, 0.0], "parameters": parameters, "engine": "python"
        } | options,
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
                "states": Box(-rng.uniform(0.3, 1.5, 2), [rng.uniform(0.3, 1.5), np.inf]),
                "disturbances": Box([-0.3, -0.2], rng.uniform(0.0, 0.5, 2)),
                "noises": Box([-0.5, -np.inf, -2.0], [0.5, np.inf, 2.0]),
            }
        found.append(((y, rng.normal(0.0, 1.0, 1)), own))
    return found


def feed(mhe, sample):
    return mhe.update(*sample[0], **sample[1])


def has_sets(name):
    return "sets" in OPTIONS[name]


@every
def test_what_is_neutral_changes_no_bit(name):
    mhe, twin = estimator(**OPTIONS[name]), estimator(**OPTIONS[name])
    neutral = [
        {"noise_weight": WEIGHTS["noise"]}, {"disturbance_weight": WEIGHTS["disturbance"]},
        {"parameters": NOMINAL}, {"sensors": [2, 0, 1]}, {"sensors": np.ones(3, np.bool_)},
    ] + [{"bounds": SETS}, {"bounds": {"states": SETS["states"]}}] * has_sets(name)
    for t, ((y, u), own) in enumerate(samples(40, 1, single=False)):
        given = neutral[t % len(neutral)]
        expected, order = twin.update(y, u, **own), given.get("sensors", [0, 1, 2])
        assert_same(mhe.update(y[order], u, **given, **own), expected)
        if t % 9 == 5:
            late = np.array([0.1, np.nan, 0.2])
            assert_same(mhe.amend(t - 1, late), twin.amend(t - 1, late))
        elif t % 9 == 7:
            given = {k: v for k, v in neutral[t // 9].items() if k != "sensors"}
            assert_same(mhe.set(**given), expected)


def test_what_was_not_sampled_is_missing_but_for_the_status():
    mhe, twin = estimator(), estimator()
    kinds = [0], [2, 1], [1, 0, 2], 1, np.int64(1), (1,), np.array([1]), [False, True, False]
    for t, (y, u) in enumerate(one[0] for one in samples(40, 3, single=False)):
        kept = kinds[t % len(kinds)]
        z = np.full(3, np.nan)
        z[np.array(kept)] = y[np.array(kept)]
        found, expected = mhe.update(y[np.array(kept)], u, sensors=kept), twin.update(z, u)
        assert (Status.MISSING in found.status) == bool(np.isnan(y[np.array(kept)]).any())
        assert_same(found, expected, ignoring=Status.MISSING)
        if t % 5 == 4:  # a late measurement of a sensor that was not sampled then
            late = np.array([np.nan, 0.3, np.nan])
            assert_same(mhe.amend(t - 1, late), twin.amend(t - 1, late), ignoring=Status.MISSING)
    # A list of numbers that equals a mask is no mask.
    with pytest.raises(InvalidInputError, match="at most once"):
        mhe.update([0.1], u, sensors=[0, 1, 0])


@every
def test_a_late_measurement_finds_the_sample_as_it_was_taken(name):
    options = OPTIONS[name] | {"candidate": "observer"}
    for delay in (1, 3):
        mhe, intime, taken = estimator(**options), estimator(**options), []
        for t, ((y, u), own) in enumerate(samples(20, 4, has_sets(name))):
            intime.update(y, u, **own)
            mhe.update(None if t % 4 == 0 else y, u, **own)
            late = t - delay
            if late % 4 == 0 and late >= 0:
                mhe.amend(late, taken[late])
                found, expected = mhe.amend(t, [np.nan] * 3), intime.amend(t, [np.nan] * 3)
                if t % 4:
                    assert_same(found, expected, ignoring=Status.MISSING | found.status)
            taken.append(np.full(3, np.nan))
            taken[t][own.get("sensors", [0, 1, 2])] = y


@every
def test_parameters_are_the_last_inputs(name):
    options, sets = OPTIONS[name], has_sets(name)
    mhe, plain = estimator(**options), estimator(**options, parameters=None)
    for (y, u), own in samples(20, 5, sets):
        inputs = np.append(u, own.get("parameters", NOMINAL))
        others = {k: v for k, v in own.items() if k != "parameters"}
        assert_same(mhe.update(y, u, **own), plain.update(y, inputs, **others))
    Y, U = np.zeros((5, 3)), np.ones((5, 1))
    expected = plain.run(Y, np.hstack((U, np.tile(NOMINAL, (5, 1)))))
    np.testing.assert_array_equal(mhe.run(Y, U).states, expected.states)


# Changes for all samples

CHANGES = {
    "noise": {"noise_weight": np.diag([1.0, 5.0, 2.0])},
    "disturbance": {"disturbance_weight": np.array([[5.0, 1.0], [1.0, 2.0]])},
    "bounds": {
        "bounds": {
            "states": Box([-0.4, -1.0], [0.3, np.inf]) & qpmhe.Polytope([[1.0, 1.0]], [0.3]),
            "disturbances": Box([-0.1, -0.2], [0.2, 0.1]),
            "noises": Box([-0.4, -np.inf, -5.0], [0.4, np.inf, 5.0]),
        }
    },
    "everything": {
        "noise_weight": 2.0 * WEIGHTS["noise"], "disturbance_weight": np.diag([1.0, 7.0]),
        "parameters": [0.5, 0.2], "bounds": {"states": Box([-0.3, -0.5], [0.4, np.inf])},
    },
}


def made_with(options, changes, **more):
    """An estimator that was made with the values of a change."""
    weights = WEIGHTS | {
        k: changes[f"{k}_weight"] for k in ("noise", "disturbance") if f"{k}_weight" in changes
    }
    sets = dict(options.get("sets") or {})
    for name, given in changes.get("bounds", {}).items():
        if not given.matrix.size and SETS[name].matrix.size:
            given = given & ROW
        sets[name] = given.soften(**PENALTIES) if options["sets"] is SOFT else given
    own = {"parameters": changes["parameters"]} if "parameters" in changes else {}
    return estimator(**options | {"sets": sets, "weights": weights} | own | more)


def assert_close(found, expected):
    np.testing.assert_allclose(found.candidate, expected.candidate, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.trajectory, expected.trajectory, rtol=0, atol=1e-8)
    assert found.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)
    assert found.cost == pytest.approx(expected.cost, rel=1e-7)


@pytest.mark.parametrize(
    ("name", "change"),
    [(name, change) for name in OPTIONS for change in CHANGES
     if "bounds" not in CHANGES[change] or has_sets(name)],
)
def test_set_gives_the_estimator_that_was_made_with_the_values(name, change):
    changes, options = CHANGES[change], OPTIONS[name]
    mhe, record = estimator(**options), samples(20, 6, has_sets(name))
    for one in record[:12]:
        before = feed(mhe, one)
    window, prior = getattr(mhe._engine, "_window", None), None  # of the Python step
    if "kalman" in options:
        memory = None if window else mhe._engine._memory[0]
        prior = np.array(
            window.prior_covariance if window else memory["stages"]["covariance"][memory["first"]]
        )
    estimate, first = mhe.set(**changes), before.candidate[0]
    states = changes.get("bounds", {}).get("states")
    # The observer is not projected onto a soft X.
    if states is None or options["sets"] is SOFT or states.violation(first) == 0.0:
        np.testing.assert_array_equal(estimate.candidate[0], first)
    made = made_with(options, changes, initial_state=estimate.candidate[0], prior=prior)
    if window is None:
        for field in ("metric", "metric_settled"):
            made._engine._memory[field] = mhe._engine._memory[field]
    elif window.metric is not None:
        made._engine._window.metric.state = window.metric.state
    for (y, u), own in record[8:12]:
        own = {k: v for k, v in own.items() if k == "bounds" or k not in changes}
        own["bounds"] = {
            k: v for k, v in own.get("bounds", {}).items() if k not in changes.get("bounds", {})
        }
        expected = made.update(y, u, **own)
    assert estimate.time == 11
    assert_close(estimate, expected)
    for one in record[12:15]:
        found, expected = feed(mhe, one), feed(made, one)
        if options.get("candidate") != "reinitialized":  # estimates before the change stay
            assert_close(found, expected)


def test_set_before_the_first_sample():
    mhe, states = estimator(sets=SETS), Box([0.6, -1.0], [1.0, np.inf])
    changes = {"bounds": {"states": states}, "noise_weight": np.eye(3)}
    assert mhe.set(**changes) is None
    assert states.violation(mhe.state) == 0.0
    made = made_with({"sets": SETS}, changes, initial_state=mhe.state)
    for one in samples(4, 7, True):
        assert_close(feed(mhe, one), feed(made, one))
    mhe.reset()
    made.reset()
    assert_close(feed(mhe, one), feed(made, one))


# Bad input

UNIT, THREE = Box([-1.0, -1.0], [1.0, 1.0]), np.zeros(3)
WRONG = [
    (OptionError, ["bounds is 3", "dictionary"], {"bounds": 3}),
    (OptionError, ["'outputs'", "'states'"], {"bounds": {"outputs": UNIT}}),
    (SetError, ["bounds['states'] is None", "qpmhe.Box", "Leave it out"],
     {"bounds": {"states": None}}),
    (SetError, ["bounds['states'] is Box", "soften", "keeps its penalties"],
     {"bounds": {"states": UNIT.soften(linear=1.0)}}),
    (SetError, ["dimension 3", "expected 2"], {"bounds": {"states": Box(THREE, THREE + 1.0)}}),
    (OptionError, ["bounds component 1", "as wide as it will ever be"],
     {"bounds": {"noises": Box(-1.0 - THREE, 1.0 + THREE)}}),
    (OptionError, ["general inequalities", "the same matrix"],
     {"bounds": {"states": qpmhe.Polytope([[1.0, 2.0]], [1.0])}}),
    (SetError, ["empty"], {"bounds": {"states": Box([1.2, 1.0], [1.5, np.inf])}}),
    (OptionError, ["fixes component 0"],
     {"bounds": {"disturbances": Box([0.0, -1.0], [0.0, 1.0])}}),
    (WeightError, ["noise_weight", "positive definite"], {"noise_weight": np.diag([1, 1, -1])}),
    (ShapeError, ["noise_weight has shape (2, 2)", "(3, 3)"], {"noise_weight": np.eye(2)}),
    (WeightError, ["disturbance_weight is not symmetric"],
     {"disturbance_weight": [[1.0, 0.5], [0.0, 1.0]]}),
    (ShapeError, ["disturbance_weight has shape (3, 3)", "(2, 2)"],
     {"disturbance_weight": np.eye(3)}),
    (ShapeError, ["parameters has shape (3,)", "(2,)"], {"parameters": THREE}),
    (InvalidInputError, ["parameters is", "finite"], {"parameters": [np.nan, 1.0]}),
]
WRONG_SENSORS = [
    (InvalidInputError, ["sensors is [-1]", "from 0 to 2"], [0.0], [-1]),
    (InvalidInputError, ["sensors is [3]", "from 0 to 2"], [0.0], [3]),
    (InvalidInputError, ["sensors is [1, 1]", "at most once"], [0.0, 0.0], [1, 1]),
    (InvalidInputError, ["sensors is []", "update(None)"], [], []),
    (ShapeError, ["sensors has shape (2,)", "(3,)"], [0.0], [True, False]),
    (InvalidInputError, ["sensors is [0.0]", "indices"], [0.0], [0.0]),
    (InvalidInputError, ["sensors is 'speed'", "indices"], [0.0], "speed"),
    (ShapeError, ["y has shape (3,)", "sensors=[0, 2]"], [0.0, 0.0, 0.0], [0, 2]),
    (InvalidInputError, ["y is", "real numbers"], ["high", 1.0], [0, 2]),
]
Y, U = [0.1, 0.2, 0.3], [0.4]


def unharmed(mhe, kind, fragments, call):
    before = leaves(mhe.state_dict())
    check(kind, fragments, lambda: call(mhe))
    assert leaves(mhe.state_dict()) == before


@pytest.mark.parametrize("count", [0, 6])
@pytest.mark.parametrize("name", [n for n in OPTIONS if n.startswith("sets, kalman")])
def test_wrong_conditions_leave_the_estimator_as_it_was(count, name):
    mhe = estimator(**OPTIONS[name])
    for one in samples(count, 8, True):
        feed(mhe, one)
    right = {"noise_weight": np.eye(3), "disturbance_weight": np.eye(2), "parameters": [1, 1]}
    for kind, fragments, wrong in WRONG:
        for given in (wrong, right | wrong):
            unharmed(mhe, kind, fragments, lambda one, given=given: one.update(Y, U, **given))
            unharmed(mhe, kind, fragments, lambda one, given=given: one.set(**given))
    for kind, fragments, y, sensors in WRONG_SENSORS:
        call = lambda one, y=y, sensors=sensors: one.update(y, U, sensors=sensors)  # noqa: E731
        unharmed(mhe, kind, fragments, call)
    unharmed(mhe, ShapeError, ["u has shape (3,)"], lambda one: one.update(Y, [1.0, 2.0, 3.0]))


def test_what_the_estimator_does_not_have():
    mhe = estimator(parameters=None)
    for given, kind, fragments in (
        ({"parameters": [1.0]}, InvalidInputError, ["parameters is [1.0]", "has none"]),
        ({"bounds": {"states": SETS["states"]}}, OptionError, ["no set of states", "System("]),
    ):
        call = lambda one, given=given: one.update(Y, [0.4, 1.0, 0.1], **given)  # noqa: E731
        unharmed(mhe, kind, fragments, call)
        unharmed(mhe, kind, fragments, lambda one, given=given: one.set(**given))
    for parameters, kind, fragments in (
        ([1.0] * 4, ShapeError, ["parameters has 4 numbers", "at most 3"]),
        ([[1.0]], ShapeError, ["parameters has shape (1, 1)", "(k,)"]),
        ([np.inf], InvalidInputError, ["parameters is [inf]", "finite"]),
    ):
        check(kind, fragments, lambda parameters=parameters: estimator(parameters=parameters))
    with pytest.raises(qpmhe.errors.UnknownOptionError, match=r"'parameters'.*inputs"):
        qpmhe.BatchEstimator(
            mhe.system, mhe.observer, mhe.cost, members=2, horizon=3,
            initial_states=[0.5, 0.0], parameters=[1.0],
        )
    with pytest.raises(InvalidInputError, match="another number of parameters"):
        estimator().load_state_dict(mhe.state_dict())


def test_fixed_components_of_the_disturbance_stay_fixed():
    mhe = estimator(sets={"disturbances": Box([0.0, -1.0], [0.0, 1.0])})
    given = {"bounds": {"disturbances": Box([-0.1, -1.0], [0.1, 1.0])}}
    unharmed(mhe, OptionError, ["frees component 0"], lambda one: one.update(Y, U, **given))
    for _ in range(5):
        narrow = Box([0.0, -0.01], [0.0, 0.01])
        estimate = mhe.update(Y, U, bounds={"disturbances": narrow})
        assert narrow.violation(estimate.disturbances) <= 1e-8
        assert not estimate.disturbances[:, 0].any()


def test_a_robust_loss_per_component_needs_a_diagonal_weight():
    weights = WEIGHTS | {"disturbance": qpmhe.Huber(np.eye(2), per_component=True)}
    mhe, dense = estimator(robust=True, weights=weights), [[2.0, 0.5], [0.5, 1.0]]
    unharmed(mhe, WeightError, ["diagonal"], lambda one: one.update(Y, U, disturbance_weight=dense))
    unharmed(mhe, WeightError, ["diagonal"], lambda one: one.set(disturbance_weight=dense))


# Memory


@every
def test_snapshots_and_pickles_keep_the_conditions(name):
    mhe, record = estimator(**OPTIONS[name]), samples(30, 10, has_sets(name))
    for t, one in enumerate(record[:20]):
        feed(mhe, one)
        if t == 11:
            bounds = {"states": Box([-0.9, -1.0], [0.9, np.inf])} if has_sets(name) else {}
            mhe.set(
                disturbance_weight=np.diag([3.0, 2.0]), parameters=[0.8, 0.2], bounds=bounds or None
            )
    restored, again = estimator(**OPTIONS[name]), pickle.loads(pickle.dumps(mhe))
    restored.load_state_dict(mhe.state_dict())
    assert leaves(restored.state_dict()) == leaves(mhe.state_dict())
    steps = [lambda one, sample=sample: feed(one, sample) for sample in record[20:]]
    steps[4:4] = [lambda one: one.amend(21, [0.1, 0.2, 0.3])]
    steps[7:7] = [lambda one: one.set(noise_weight=np.eye(3))]
    for step in steps:
        expected = step(mhe)
        for other in (restored, again):
            assert_same(step(other), expected)


def test_what_was_given_is_copied():
    mhe, twin = estimator(sets=SETS), estimator(sets=SETS)
    for (y, u), own in samples(12, 11, True):
        twin.update(y, u, **own)
        spoilt = {k: np.array(v) if k not in ("bounds", "dt") else v for k, v in own.items()}
        if "bounds" in own:
            spoilt["bounds"] = {k: Box(v.lower, v.upper) for k, v in own["bounds"].items()}
        mhe.update(y, u, **spoilt)
        for value in spoilt.values():
            if isinstance(value, np.ndarray):
                value[...] = 0
        for box in spoilt.get("bounds", {}).values():
            box.lower[...] = box.upper[...] = 0.0
    assert leaves(mhe.state_dict()) == leaves(twin.state_dict())


# The step's work, and code that is written
