"""Batches of estimators against single ones, member by member and step by step."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError, ModelError, OptionError, ShapeError
from tests.estimation.spoil import check
from tests.estimation.untraced import untraced

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
NAN = np.nan
A = np.array([[1.0, 0.1], [-0.1, 0.95]])
ENGINES = ("python", "compiled") if find_compiler() is not None else ("python",)
KALMAN = qpmhe.ExtendedKalman(
    prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=0.1 * np.eye(2),
    innovation=qpmhe.Gate(reopen=2),
)


def turn(x):
    return x @ A.T


def driven(x, u):
    return np.sin(x @ A.T) + u @ np.array([[0.3, 0.1], [0.0, 0.2], [0.1, -0.1]])


def parts(f=turn, h=lambda x: x[..., :1], p=1, observer=None, **system):
    cost = qpmhe.QuadraticCost(
        prior=10.0 * np.eye(2), disturbance=100.0 * np.eye(2), noise=25.0 * np.eye(p), discount=0.8
    )
    gain = [[0.3], [0.2]] if p == 1 else 0.1 * np.eye(2)
    return qpmhe.System(f, h, n=2, p=p, **system), observer or qpmhe.Luenberger(gain), cost


def batch_of(one, members=3, starts=(0.5, 0.0), **options):
    return qpmhe.BatchEstimator(
        *one, members=members, initial_states=starts, **{"horizon": 3} | options
    )


FIELDS = {
    "candidates": "candidate", "trajectories": "trajectory", "states": "state",
    "filtered": "filtered", "observer_states": "observer_state", "costs": "cost",
    "candidate_costs": "candidate_cost", "statuses": "status", "qps": "qps",
    "improved": "improved",
}
RUNS = ("states", "filtered", "observer_states", "costs", "qps", "rejected_sensors")
CASES = {
    "observers": (3, {}, {"max_qps": 0, "threads": 1, "horizon": 1}),
    # Fewer members would share a thread.
    "threads": (40, {}, {"max_qps": None, "warm_start": True, "threads": 2}),
    "sets": (3, {"disturbances": qpmhe.Box([-0.1] * 2, [0.1] * 2)}, {"max_qps": 2}),
    # Each member's rows have the units that they have where it starts.
    "constraints": (3, {"constraints": [qpmhe.Constraint(lambda x: x @ x - 0.2)]}, {"max_qps": 2}),
    "gates": (5, {"h": turn, "p": 2, "observer": KALMAN}, {"candidate": "reinitialized"}),
    "inputs": (3, {"f": driven, "h": lambda x, u: x[..., :1] + u[..., :1], "m": 3}, {}),
    "shared": (3, {"f": driven, "m": 3}, {"max_qps": 2}),
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", CASES)
def test_members_with_gaps_are_single_estimators(name, engine):
    """Updates and then a run, all bits."""
    members, given, options = CASES[name]
    options, one = {"horizon": 5, "engine": engine} | options, parts(**given)
    generator, seen = np.random.default_rng(5), Status(0)
    starts = 0.1 * np.arange(2 * members).reshape(-1, 2)
    Y = 3.0 * generator.standard_normal((members, 20, one[0].p))
    Y[generator.random(Y.shape) < 0.15] = NAN
    Y[0, 2:6], Y[1], Y[-1, 7, 0], Y[2, 12] = np.inf, NAN, -1e200, 90.0
    U = generator.standard_normal((20, 3) if name == "shared" else (members, 20, 3))
    if name == "inputs":
        U[1, 15] = NAN
    own = np.broadcast_to(U, (members, 20, 3))
    batch = batch_of(one, members, starts, **options)
    assert batch.mode == ("compiled" if engine == "compiled" else "looped")
    options.pop("threads", None)
    singles = [qpmhe.MovingHorizonEstimator(*one, initial_state=z, **options) for z in starts]

    def inputs(of, which):
        return {"U" if of is U else "u": of[..., which, :]} if one[0].m else {}

    for t in range(10):
        found = batch.update(Y[:, t], **inputs(U, t))
        expected = [
            mhe.update(y[t], **inputs(u, t)) for mhe, y, u in zip(singles, Y, own, strict=True)
        ]
        for several, single in FIELDS.items():
            values = [getattr(each, single) for each in expected]
            np.testing.assert_array_equal(getattr(found, several), values, several)
        assert (len(found), found.time) == (members, t)
    run = batch.run(Y[:, 10:], **inputs(U, slice(10, None)))
    runs = [
        mhe.run(y[10:], *(u[10:],) * bool(one[0].m))
        for mhe, y, u in zip(singles, Y, own, strict=True)
    ]
    for field in RUNS:
        np.testing.assert_array_equal(getattr(run, field), [getattr(each, field) for each in runs])
    np.testing.assert_array_equal(run.statuses, [each.flags for each in runs])
    assert run.share(Status.IMPROVED) == (run.costs < run.candidate_costs).mean()
    for flags in np.unique(run.statuses).tolist():
        seen |= Status(flags)
    assert Status.MISSING in seen
    assert (Status.MODEL_FAILED in seen) == (name == "inputs")
    assert (Status.SENSORS_REJECTED in seen) == (name == "gates")


def test_short_ways_of_saying_it():
    found = [batch_of(parts(), 2).update(y).trajectories for y in ([[NAN]] * 2, None)]
    np.testing.assert_array_equal(*found)
    one = (
        qpmhe.System(lambda x, u: 0.9 * x + u, lambda x: x, n=1, p=1, m=1),
        qpmhe.Luenberger([0.3]), qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0),
    )
    short, full = batch_of(one, 2, 0.5), batch_of(one, 2, [[0.5], [0.5]])
    found, expected = short.update([1.0, None], 0.1), full.update([[1.0], [None]], [[0.1], [0.1]])
    np.testing.assert_array_equal(found.trajectories, expected.trajectories)
    run = short.run([[1.0, 2.0], [0.5, 0.7]], [0.1, 0.2])
    other = full.run([[[1.0], [2.0]], [[0.5], [0.7]]], [[[0.1], [0.2]]] * 2)
    np.testing.assert_array_equal(run.states, other.states)


NOT_MADE = [
    (OptionError, ["members is 0", ">= 1"], {"members": 0}),
    (OptionError, ["threads is 0"], {"threads": 0, "engine": "compiled"}),
    (OptionError, ["from_casadi"], {"f": untraced(turn), "engine": "compiled"}),
    (ShapeError, ["1 to 2 states", "same"], {"starts": [[1.0, 2.0], [1.0], [1, 2]]}),
    (InvalidInputError, ["initial_states", "finite"], {"starts": [1.0, NAN]}),
    # What a single estimator would not take.
    (ModelError, ["initial_states[1]", "raised"],
     {"f": lambda x: [math.sqrt(x[0]), x[1]], "starts": [[0.5, 0.0], [-0.5, 0.1], [1.0, 0.0]]}),
]


def test_what_cannot_be_made(monkeypatch):
    for error, fragments, given in NOT_MADE:
        options = {key: value for key, value in given.items() if key != "f"}
        one = parts(given.get("f", turn))
        check(error, fragments, batch_of, one, **options)
        if "starts" in options:
            good = batch_of(one, starts=[0.5, 0.1])
            states = good.update([0.5, 0.4, 0.6]).states
            check(error, fragments, good.reset, options["starts"])
            np.testing.assert_array_equal(good.states, states)
    check(InvalidInputError, ["observer is None"], batch_of, (one[0], None, one[2]))

    def too_much(*_):
        raise MemoryError("Unable to allocate 1.49 TiB")

    monkeypatch.setattr("qpmhe.batch._Looped", too_much)
    text = ["1000 members with a horizon of 9", "1.49 TiB", "fewer"]
    check(OptionError, text, batch_of, parts(), 1000, horizon=9)


def test_initial_states_outside_of_the_set_are_projected_with_a_warning():
    starts, states = [[0.5, 0.0], [9.5, 0.0]], qpmhe.Box([-9.0, -9.0], [9.0, 9.0])
    with pytest.warns(qpmhe.ObserverWarning, match=r"initial_states\[1\] is \[9.5, 0.0\]"):
        batch = batch_of(parts(states=states), 2, starts)
    np.testing.assert_array_equal(batch.states, np.clip(starts, -9.0, 9.0))
    with pytest.warns(qpmhe.ObserverWarning, match=r"initial_states\[0\]"):
        batch.reset(starts[::-1])
    np.testing.assert_array_equal(batch.states[0], [9.0, 0.0])


def test_initial_states_are_clipped_in_the_diagonal_metric():
    """In the metric of a prior that ties the states, the other one moves along."""
    system, observer, _ = parts(states=qpmhe.Box([-9.0, -9.0], [9.0, 9.0]))
    tied = qpmhe.QuadraticCost(prior=[[2.0, 1.0], [1.0, 2.0]], disturbance=np.eye(2), noise=1.0)
    for metric, clips in (("observer", False), ("diagonal", True)):
        with pytest.warns(qpmhe.ObserverWarning, match="outside of the state set"):
            batch = batch_of((system, observer, tied), 1, [[9.5, 0.0]], projection_metric=metric)
        assert batch.states[0][0] == 9.0
        assert bool(batch.states[0][1] == 0.0) is clips
        with pytest.warns(qpmhe.ObserverWarning, match="outside of the state set"):
            batch.reset([[9.5, 0.0]])
        assert bool(batch.states[0][1] == 0.0) is clips


ONES = np.ones((3, 5, 1))
REFUSED = [
    (ShapeError, ["Y has shape (2, 1)", "(3, 1)", "member"], "update", [[1.0], [2.0]]),
    (InvalidInputError, ["U was given", "leave it out"], "update", [1.0] * 3, [1.0]),
    (ShapeError, ["4 to 6 samples", "NaN"], "run", [np.ones(5), np.ones(4), np.ones(6)]),
]
REFUSED_WITH_INPUTS = [
    (InvalidInputError, ["U is missing", "3 inputs", "update(Y, U)"], "update", ONES[:, 0]),
    (ShapeError, ["(4, 3)", "(3, 5, 3)"], "run", ONES, np.ones((4, 3))),
]


def test_bad_samples_and_records_are_refused_before_any_is_taken():
    for one, wrong, *u in (
        (parts(), REFUSED), (parts(driven, m=3), REFUSED_WITH_INPUTS, [0.1, 0.2, 0.3]),
    ):
        spoilt, twin = batch_of(one), batch_of(one)
        for _ in range(3):
            for error, fragments, call, *arguments in wrong:
                check(error, fragments, getattr(spoilt, call), *arguments)
            found, expected = spoilt.update(ONES[:, 0], *u), twin.update(ONES[:, 0], *u)
            np.testing.assert_array_equal(found.trajectories, expected.trajectories)
