"""Functions are called state by state, with copies, unless a trace on symbols proves more."""

import math
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.model.functions import BatchedFunction

NOTHING = np.zeros(0)


def low(x):
    return 0.95 * x + 0.4


def high(x):
    return 0.5 * x


def swallowed(x):
    try:
        beyond = bool(x[0] > 12.0)
    except Exception:  # whatever the symbol raises
        beyond = False
    return high(x) if beyond else low(x)


def looped_over(x):
    out = []
    for value in np.asarray(x):
        out += [0.5 * value if value > 12.0 else 0.95 * value + 0.4]
    return np.array(out)


def counted(x):
    k = 0
    while x.flat[0] > 12.0 + k:
        k += 1
    return low(x) if k == 0 else high(x)


# Whether a state, or many, is beyond 12: farther than all points that are tried at construction.
BEYOND = {
    "x[0]": lambda x: x[0] > 12.0,
    "item": lambda x: x.item(0) > 12.0,
    "asarray": lambda x: np.asarray(x).ravel()[0] > 12.0,
    "array": lambda x: np.array(x, dtype=float).ravel()[0] > 12.0,
    "tolist": lambda x: np.ravel(x).tolist()[0] > 12.0,
    "float": lambda x: float(np.ravel(x)[0]) > 12.0,
    "math": lambda x: math.floor(np.ravel(x)[0]) > 12,
    "builtin max": lambda x: max(x.ravel()) > 12.0,
    "all": lambda x: np.all(x > 12.0),
    "norm": lambda x: np.linalg.norm(x) > 12.0,
    "sort": lambda x: np.sort(x.ravel())[-1] > 12.0,
    "mask": lambda x: x[x > 12.0].size,
    "where": lambda x: np.where(x > 12.0)[0].size,
    "searchsorted": lambda x: np.searchsorted([12.0], np.ravel(x)[0]),
    "sign": lambda x: np.sign(np.ravel(x)[0] - 12.0) == 1.0,
    "comparison": lambda x: list(x.ravel()[:1]) > [12.0],
    "text": lambda x: f"{np.ravel(x)[0]:09.5f}" > "012.0",
    "bytes": lambda x: np.frombuffer(x.tobytes())[0] > 12.0,
}
BRANCHES = {
    name: (lambda x, beyond=beyond: high(x) if beyond(x) else low(x))
    for name, beyond in BEYOND.items()
} | {
    "and": lambda x: (x[0] > 12.0 and high(x)) or low(x),
    "dictionary": lambda x: {True: high, False: low}[bool(np.ravel(x)[0] > 12.0)](x),
    "swallowed": swallowed, "loop over values": looped_over, "while": counted,
}


@pytest.mark.parametrize("way", BRANCHES)
def test_a_function_with_a_branch_is_called_state_by_state(way):
    f = lambda x: BRANCHES[way](x)  # noqa: E731
    system = qpmhe.System(f, lambda x: x, n=1, p=1)
    assert system.f.mode == "looped"
    states = np.array([[11.0], [13.0], [9.0], [20.0]])
    found = system.f.batch(states, np.zeros((4, 0)))
    np.testing.assert_array_equal(found, [f(x) for x in states])


def test_a_function_that_mixes_states_is_no_function_of_many():
    for mixing in (
        lambda x: x - x.mean(axis=0), lambda x: x + 0.0 * x[..., :1].sum(axis=0),
        lambda x: np.roll(x, 1, axis=0) if x.ndim > 1 else x,
        lambda x: np.cumsum(x, axis=0) if x.ndim > 1 else x,
    ):
        function = BatchedFunction("f", mixing, (2,), 0, [(np.array([1.0, 2.0]), NOTHING)] * 3)
        states = np.random.default_rng(0).standard_normal((5, 2))
        np.testing.assert_array_equal(
            function.batch(states, np.zeros((5, 0))), [mixing(x) for x in states]
        )
        assert function.mode != "batched"


def test_a_model_that_keeps_its_last_argument_works_on():
    class Model:
        last, value = np.zeros(2), np.zeros(2)

        def f(self, x):
            if not np.array_equal(x, self.last):
                self.last, self.value = x, 0.5 * x
            return self.value

    system = qpmhe.System(Model().f, lambda x: x[..., :1], n=2, p=1)
    states = np.random.default_rng(0).standard_normal((4, 2))
    for x in states:
        np.testing.assert_array_equal(system.f(x, NOTHING), 0.5 * x)
    np.testing.assert_array_equal(system.f.batch(states, np.zeros((4, 0))), 0.5 * states)


# What is written into an argument


def estimator(system, **options):
    cost = options.pop("cost", qpmhe.QuadraticCost(prior=1.0, disturbance=4.0, noise=25.0))
    observer = options.pop("observer", qpmhe.Luenberger([0.8]))
    if not isinstance(system, qpmhe.System):
        system = qpmhe.System(
            system, lambda x: x, n=1, p=1, states=qpmhe.Box([0.0], [np.inf])
        )
    options = {"horizon": 4, "initial_state": [1.0], "max_qps": 2} | options
    return qpmhe.MovingHorizonEstimator(system, observer, cost, **options)


MEASURED = [0.3, -0.6, 0.1, 14.0, 12.5, -0.4, 13.0, 0.2, 0.0, -1.0]


def clipped(x):
    x[x < 0.0] = 0.0
    return low(x)


def clipped_beyond(x):
    if x[0] > 12.0:
        x[0] = 12.0
    return low(x)


def overwritten_input(x, u):
    if x[0] > 12.0:
        u[0] = 0.0
    return low(x) + u


def writing(z, v):
    if z[0] > 5.0:
        z[0], v[0] = 0.0, 0.0
    return 0.8 * v


def copying(function):
    if function is overwritten_input:
        return lambda x, u: function(np.array(x), np.array(u))
    return lambda x: function(np.array(x))


@pytest.mark.parametrize(
    ("way", "options"),
    [
        (clipped, {"warm_start": True}), (clipped_beyond, {"candidate": "reinitialized"}),
        (overwritten_input, {}), (writing, {}), ("rate", {}),
    ],
)
def test_what_is_written_into_an_argument_changes_nothing(way, options):
    def made(wrap):
        if way is writing:
            correction = writing if wrap is None else (lambda z, v: writing(z.copy(), v.copy()))
            return estimator(low, observer=qpmhe.OutputInjection(correction))
        f = clipped_beyond if way == "rate" else way
        f = f if wrap is None else copying(f)
        if way == "rate":
            return estimator(qpmhe.System.from_ode(f, lambda x: x, dt=0.1, n=1, p=1))
        if way is overwritten_input:
            return estimator(qpmhe.System(f, lambda x: x, n=1, p=1, m=1))
        return estimator(f, **options)

    wrong, right, kept = made(None), made(copying), []
    for y in MEASURED:
        given = [y] + [[0.5]] * (way is overwritten_input)
        own = {"dt": 0.2} if way == "rate" else {}
        found, expected = wrong.update(*given, **own), right.update(*given, **own)
        np.testing.assert_array_equal(found.candidate, expected.candidate)
        assert (found.cost, found.candidate_cost) == (expected.cost, expected.candidate_cost)
        assert Status.MODEL_FAILED not in found.status
        kept.append((found.trajectory, expected.trajectory))
    for one, other in kept:
        np.testing.assert_array_equal(one, other)


def raised(error):
    def fail(*_):
        raise error

    return fail


# What leaves a model

RETURNS = {
    "an object": lambda _: object(),
    "SystemExit": lambda _: sys.exit(7),
    "GeneratorExit": raised(GeneratorExit()),
}


@pytest.mark.parametrize("where", ["f", "h"])
@pytest.mark.parametrize("what", RETURNS)
def test_what_a_model_returns_far_out_never_leaves_update(what, where):
    """What properties/test_bad_luck.py does not try."""
    def bent(x):
        return RETURNS[what](x) if x[0] > 12.0 else 1.1 * x

    functions = {"f": lambda x: 1.1 * x, "h": lambda x: 1.0 * x} | {where: bent}
    system, gain = qpmhe.System(**functions, n=1, p=1), qpmhe.Luenberger([0.3])
    mhe = estimator(system, observer=gain, initial_state=[9.0], candidate="reinitialized")
    for t in range(12):
        estimate = mhe.update(10.0 * 1.1**t)
        assert estimate.cost <= estimate.candidate_cost
    assert mhe.time == 12
    assert estimate.status & (Status.MODEL_FAILED | Status.FAILED_STAGE)


def test_a_model_that_wants_arrays_that_it_could_write_to_has_them():
    def wanting(x):
        if not x.flags.writeable:
            raise ValueError("buffer source array is read-only")
        return 0.9 * x

    mhe = estimator(qpmhe.System(wanting, lambda x: x, n=1, p=1))
    assert not mhe._own_system.f.reads_only
    assert [mhe.update([y]).improved for y in (2.0, 3.0, 1.5)] == [True] * 3
