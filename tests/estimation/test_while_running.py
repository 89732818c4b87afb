"""Weights, bounds, parameters and sensors that change while the estimator runs."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe import Box, Polytope, Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError, OptionError, SetError, ShapeError, WeightError

from .same import assert_same, leaves
from .spoil import check

WEIGHTS = {"prior": np.diag([2.0, 1.0]), "disturbance": np.diag([9.0, 4.0]),
           "noise": np.array([[3.0, 0.5, 0.0], [0.5, 2.0, 0.2], [0.0, 0.2, 4.0]])}
ROW = Polytope([[1.0, 1.0]], [2.0])
WIDE = Box([-0.5, -2.0], [1.5, np.inf])
SETS = {
    "states": WIDE & ROW,
    "disturbances": Box([-0.4, -0.5], [0.4, 0.5]),
    "noises": Box([-1.0, -np.inf, -1.0], [1.0, np.inf, 1.0]),
}
PENALTIES = {"linear": 0.5, "quadratic": 2.0}
SOFT = {name: one.soften(**PENALTIES) for name, one in SETS.items()}
NOMINAL = np.array([1.0, 0.1])
OPTIONS = {
    "observer alone": {"sets": SETS, "max_qps": 0, "discount": 0.9},
    "unscented": {"kalman": "UnscentedKalman", "candidate": "reinitialized"},
    "robust": {"robust": True, "max_qps": 2},
    "soft sets": {"sets": SOFT, "max_qps": 2},
    "sets, kalman": {"sets": SETS, "kalman": "ExtendedKalman", "max_qps": 2},
}
if find_compiler() is not None:
    OPTIONS["sets, kalman, in C"] = OPTIONS["sets, kalman"] | {"engine": "compiled"}
every = pytest.mark.parametrize("name", OPTIONS)
ENGINES = ["python"] if find_compiler() is None else ["python", "compiled"]
# The sets are narrow: rows are dropped for long, and a start may lie outside.
pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


def rate(x, u):
    """A pendulum with a push, and its stiffness and damping as parameters."""
    return [x[1], u[0] - u[1] * np.sin(x[0]) - u[2] * x[1]]


def h(x):
    return [x[0], x[1], x[0] + 0.1 * x[1] ** 2]


def estimator(sets=None, kalman=None, robust=False, discount=1.0, weights=WEIGHTS, **options):
    system = qpmhe.System.from_ode(
        rate, h, dt=0.1, n=2, p=3, m=3, method="euler", **(sets or {})
    )
    weights, observer = dict(weights), qpmhe.Luenberger([[0.3, 0.1, 0.05], [0.1, 0.2, 0.0]])
    if kalman:
        covariances = {name: np.linalg.inv(weight) for name, weight in weights.items()}
        observer = getattr(qpmhe, kalman)(**covariances)
        weights["prior"] = qpmhe.ObserverPrior()
    if robust:
        weights["noise"] = qpmhe.Huber(weights["noise"])
    cost = (qpmhe.RobustCost if robust else qpmhe.QuadraticCost)(**weights, discount=discount)
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, **{
            "horizon": 4, "initial_state": [0.5, 0.0], "parameters": NOMINAL, "engine": "python"
        } | options,
    )


def samples(count, seed, sets):
    """Arguments of `update`: a sample may have conditions of its own."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        y, own = rng.normal(0.0, 0.5, 3), {}
        y[rng.random(3) < 0.15] = np.nan
        chances = rng.random(6) < 0.3
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
            }
        found.append(own | {"y": y, "u": rng.normal(0.0, 1.0, 1)})
    return found


@every
@pytest.mark.parametrize("when", [0, 5])
def test_set_gives_the_estimator_that_was_made_with_the_values(name, when):
    """While the window grows, so that both have seen all of the record with these values."""
    options = OPTIONS[name] | {"horizon": 8, "candidate": "observer"}
    weights = {"noise": 2.0 * WEIGHTS["noise"], "disturbance": np.array([[5.0, 1.0], [1.0, 2.0]])}
    changes, other = {f"{k}_weight": one for k, one in weights.items()}, {}
    if name != "observer alone":  # whose metric is of the first sample, and its parameters
        changes["parameters"] = other["parameters"] = [0.5, 0.2]
    other["weights"] = WEIGHTS | weights
    if "sets" in options:
        # Bounds leave the rows as they are, and rows the bounds.
        states = Polytope([[1.0, 1.0]], [0.6]) if when else Box([-0.3, -0.5], [0.6, np.inf])
        changes["bounds"] = {"states": states,
                             "noises": Box([-0.4, -np.inf, -5.0], [0.4, np.inf, 5.0])}
        sets = changes["bounds"] | {"states": states & (WIDE if when else ROW)}
        if options["sets"] is SOFT:
            sets = {k: one.soften(**PENALTIES) for k, one in sets.items()}
        other["sets"] = options["sets"] | sets
    mhe, made = estimator(**options), estimator(**options | other)
    for t, own in enumerate(samples(12, 6, "sets" in options)):
        if t == when:
            assert (mhe.set(**changes) is None) == (when == 0)
        kept = {k: v for k, v in own.items() if t >= when or k not in changes}
        if t < when and "bounds" in own:
            kept["bounds"] = {"disturbances": own["bounds"]["disturbances"]}
        found, expected = mhe.update(**own), made.update(**kept)
        if t >= when:
            np.testing.assert_allclose(found.candidate, expected.candidate, rtol=0, atol=1e-11)
            np.testing.assert_allclose(found.trajectory, expected.trajectory, rtol=0, atol=1e-8)
            assert found.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)
            assert found.cost == pytest.approx(expected.cost, rel=1e-7)


def test_set_before_the_first_sample_projects_the_start():
    for kalman in (None, "ExtendedKalman"):
        mhe, states = estimator(sets=SETS, kalman=kalman), Box([0.6, -1.0], [1.0, np.inf])
        assert mhe.set(bounds={"states": states}) is None
        assert states.violation(mhe.state) == 0.0


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("project", [True, False])
@pytest.mark.parametrize("kalman", [None, "ExtendedKalman"])
def test_a_reset_starts_in_the_present_states(kalman, project, engine):
    """As the estimator that is made with them, whose initial state is projected in any case."""
    states = Box([0.8, 0.3], WIDE.upper) & ROW
    options = {"kalman": kalman, "project_observer": project, "engine": engine}
    mhe, new = estimator(SETS, **options), estimator(SETS | {"states": states}, **options)
    mhe.update([0.1, 0.2, 0.3], [0.4])
    mhe.set(bounds={"states": states})
    mhe.reset()
    assert states.violation(mhe.state) == 0.0
    for sample in samples(6, 3, True):
        one, other = mhe.update(**sample), new.update(**sample)
        assert one.cost == pytest.approx(other.cost, rel=1e-12)
        assert one.candidate == pytest.approx(other.candidate, rel=1e-12)


def test_states_move_into_other_bounds_in_the_observers_metric():
    mhe = estimator(sets=SETS, max_qps=0)
    mhe.update([0.1, 0.2, 0.3], [0.4])
    z, P = mhe.observer_state, mhe._engine._window.metric.covariance
    bounds = {"states": Box([z[0] + 0.1, -2.0], [1.5, np.inf])}
    candidate = mhe.update([0.1, 0.2, 0.3], [0.4], bounds=bounds).candidate
    np.testing.assert_allclose(candidate[1], z + 0.1 * P[:, 0] / P[0, 0], rtol=1e-9)
    assert abs(P[0, 1]) > 1e-3 * P[0, 0]
    first = mhe.set(bounds={"states": Box([0.6, -2.0], [1.5, np.inf])}).candidate[0]
    np.testing.assert_allclose(first, [0.6, 0.1 * P[1, 0] / P[0, 0]], rtol=1e-9)


# Bad input

UNIT, THREE = Box([-1.0, -1.0], [1.0, 1.0]), np.zeros(3)
WRONG = [
    (OptionError, ["'outputs'", "'states'"], {"bounds": {"outputs": UNIT}}),
    (SetError, ["bounds['states'] is Box", "soften", "keeps its penalties"],
     {"bounds": {"states": UNIT.soften(linear=1.0)}}),
    (OptionError, ["bounds component 1", "as wide as it will ever be"],
     {"bounds": {"noises": Box(-1.0 - THREE, 1.0 + THREE)}}),
    (OptionError, ["general inequalities", "the same matrix"],
     {"bounds": {"states": Polytope([[1.0, 2.0]], [1.0])}}),
    (SetError, ["empty"], {"bounds": {"states": Box([1.2, 1.0], [1.5, np.inf])}}),
    (OptionError, ["fixes component 0"],
     {"bounds": {"disturbances": Box([0.0, -1.0], [0.0, 1.0])}}),
    (WeightError, ["noise_weight", "positive definite"], {"noise_weight": np.diag([1, 1, -1])}),
    (ShapeError, ["parameters has shape (3,)", "(2,)"], {"parameters": THREE}),
]
WRONG_SENSORS = [
    (InvalidInputError, ["sensors is [3]", "from 0 to 2"], [0.0], [3]),
    (InvalidInputError, ["sensors is [0, 1, 0]", "at most once"], [0.0], [0, 1, 0]),
    (ShapeError, ["sensors has shape (2,)", "(3,)"], [0.0], [True, False]),
    (ShapeError, ["y has shape (3,)", "sensors=[0, 2]"], [0.0, 0.0, 0.0], [0, 2]),
]
Y, U = [0.1, 0.2, 0.3], [0.4]


def unharmed(mhe, kind, fragments, *arguments, call="update", **options):
    before = leaves(mhe.state_dict())
    check(kind, fragments, getattr(mhe, call), *arguments, **options)
    assert leaves(mhe.state_dict()) == before


@pytest.mark.parametrize("count", [0, 6])
@pytest.mark.parametrize("name", [n for n in OPTIONS if n.startswith("sets, kalman")])
def test_wrong_conditions_leave_the_estimator_as_it_was(count, name):
    mhe = estimator(**OPTIONS[name])
    for own in samples(count, 8, True):
        mhe.update(**own)
    right = {"noise_weight": np.eye(3), "disturbance_weight": np.eye(2), "parameters": [1, 1]}
    for kind, fragments, wrong in WRONG:
        for given in (wrong, right | wrong):
            unharmed(mhe, kind, fragments, Y, U, **given)
            unharmed(mhe, kind, fragments, call="set", **given)
    for kind, fragments, y, sensors in WRONG_SENSORS:
        unharmed(mhe, kind, fragments, y, U, sensors=sensors)
    # Of a sensor that is not sampled nothing is missing.
    missing = [Status.MISSING in mhe.update(y, U, sensors=1).status for y in (0.1, np.nan)]
    assert missing == [False, True]
    unharmed(mhe, ShapeError, ["u has shape (3,)"], Y, [1.0, 2.0, 3.0])


def test_what_the_estimator_does_not_have():
    mhe = estimator(parameters=None)
    for given, kind, fragments in (
        ({"parameters": [1.0]}, InvalidInputError, ["parameters is [1.0]", "has none"]),
        ({"bounds": {"states": SETS["states"]}}, OptionError, ["no set of states", "System("]),
    ):
        unharmed(mhe, kind, fragments, call="set", **given)
    text = ["parameters has 4 numbers", "at most 3"]
    check(ShapeError, text, estimator, parameters=[1.0] * 4)
    text = ["another number of parameters"]
    check(InvalidInputError, text, estimator().load_state_dict, mhe.state_dict())
    # What is fixed stays fixed, and a loss per component needs a diagonal weight.
    mhe = estimator(sets={"disturbances": Box([0.0, -1.0], [0.0, 1.0])})
    given = {"bounds": {"disturbances": Box([-0.1, -1.0], [0.1, 1.0])}}
    unharmed(mhe, OptionError, ["frees component 0"], Y, U, **given)
    narrow = Box([0.0, -0.01], [0.0, 0.01])
    for _ in range(3):
        estimate = mhe.update(Y, U, bounds={"disturbances": narrow})
        assert narrow.violation(estimate.disturbances) <= 1e-8
    loss, dense = qpmhe.Huber(np.eye(2), per_component=True), [[2.0, 0.5], [0.5, 1.0]]
    mhe = estimator(robust=True, weights=WEIGHTS | {"disturbance": loss})
    unharmed(mhe, WeightError, ["diagonal"], Y, U, disturbance_weight=dense)


@every
def test_snapshots_and_pickles_keep_the_conditions(name):
    options, sets = OPTIONS[name], "sets" in OPTIONS[name]
    mhe, record = estimator(**options), samples(26, 10, sets)
    for t, own in enumerate(record[:16]):
        mhe.update(**own)
        if t == 11:
            given = {"bounds": {"states": Box([-0.9, -1.0], [0.9, np.inf])}} if sets else {}
            mhe.set(disturbance_weight=np.diag([3.0, 2.0]), parameters=[0.8, 0.2], **given)
    mhe.forget_warm_start()  # which a snapshot does not have
    several = [mhe, estimator(**options), pickle.loads(pickle.dumps(mhe))]
    several[1].load_state_dict(mhe.state_dict())
    for t, own in enumerate(record[16:]):
        found = [one.update(**own) for one in several]
        if t == 4:
            found = [one.amend(19, [0.1, 0.2, 0.3]) for one in several]
        if t == 6:
            found = [one.set(noise_weight=np.eye(3)) for one in several]
        for other in found[1:]:
            assert_same(other, found[0])
