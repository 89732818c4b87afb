"""Functions are called state by state, with copies, unless a trace on symbols proves more."""

import math
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe.costs import Loss
from qpmhe.errors import ModelError
from qpmhe.model.functions import BatchedFunction
from qpmhe.model.tracing import trace

from .untraced import untraced

NOTHING = np.zeros(0)
TABLE = np.array([0.0, 1.0, 4.0, 9.0])


def one(labels):
    return np.ones(labels, np.uint64)


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


def buffered(x):
    if x.ravel()[0] > 12.0:
        out = np.empty(x.shape)
        out[...] = high(x)
        return out
    return low(x)


def counted(x):
    k = 0
    while x.flat[0] > 12.0 + k:
        k += 1
    return low(x) if k == 0 else high(x)


# A branch at 12, beyond all points that are tried at construction.
BRANCHES = {
    "x[0]": lambda x: high(x) if x[0] > 12.0 else low(x),
    "item(0)": lambda x: high(x) if x.item(0) > 12.0 else low(x),
    "item()": lambda x: high(x) if x[:1].reshape(-1)[:1].item() > 12.0 else low(x),
    "flat": lambda x: high(x) if x.flat[0] > 12.0 else low(x),
    "asarray": lambda x: high(x) if np.asarray(x).ravel()[0] > 12.0 else low(x),
    "array": lambda x: high(x) if np.array(x, dtype=float).ravel()[0] > 12.0 else low(x),
    "tolist": lambda x: high(x) if np.ravel(x).tolist()[0] > 12.0 else low(x),
    "float": lambda x: high(x) if float(np.ravel(x)[0]) > 12.0 else low(x),
    "int": lambda x: high(x) if int(np.ravel(x)[0]) > 12 else low(x),
    "round": lambda x: high(x) if round(np.ravel(x)[0]) > 12 else low(x),
    "math": lambda x: high(x) if math.floor(np.ravel(x)[0]) > 12 else low(x),
    "max": lambda x: high(x) if x.max() > 12.0 else low(x),
    "builtin max": lambda x: high(x) if max(x.ravel()) > 12.0 else low(x),
    "any": lambda x: high(x) if (x > 12.0).any() else low(x),
    "all": lambda x: high(x) if np.all(x > 12.0) else low(x),
    "asarray any": lambda x: high(x) if np.any(np.asarray(x) > 12.0) else low(x),
    "norm": lambda x: high(x) if np.linalg.norm(x) > 12.0 else low(x),
    "sum": lambda x: high(x) if x.sum() > 12.0 else low(x),
    "argmax": lambda x: low(x) if np.argmax(np.append(np.ravel(x)[:1], 12.0)) else high(x),
    "sort": lambda x: high(x) if np.sort(x.ravel())[-1] > 12.0 else low(x),
    "mask": lambda x: high(x) if x[x > 12.0].size else low(x),
    "where": lambda x: high(x) if np.where(x > 12.0)[0].size else low(x),
    "nonzero": lambda x: high(x) if np.nonzero(x > 12.0)[0].size else low(x),
    "count": lambda x: high(x) if np.count_nonzero(x > 12.0) else low(x),
    "searchsorted": lambda x: high(x) if np.searchsorted([12.0], np.ravel(x)[0]) else low(x),
    "sign": lambda x: high(x) if np.sign(np.ravel(x)[0] - 12.0) == 1.0 else low(x),
    "comparison": lambda x: high(x) if list(x.ravel()[:1]) > [12.0] else low(x),
    "dictionary": lambda x: {True: high, False: low}[bool(np.ravel(x)[0] > 12.0)](x),
    "hash": lambda x: {0.0: low}.get(np.ravel(x)[0] // 12.0, high)(x),
    "and": lambda x: (x[0] > 12.0 and high(x)) or low(x),
    "not": lambda x: low(x) if not x[0] > 12.0 else high(x),
    "text": lambda x: high(x) if f"{np.ravel(x)[0]:09.5f}" > "012.0" else low(x),
    "bytes": lambda x: high(x) if np.frombuffer(x.tobytes())[0] > 12.0 else low(x),
    "range": lambda x: high(x) if len(range(int(np.ravel(x)[0]))) > 12 else low(x),
    "swallowed": swallowed,
    "loop over values": looped_over,
    "buffer in a branch": buffered,
    "while": counted,
}


@pytest.mark.parametrize("way", BRANCHES)
def test_a_function_with_a_branch_is_called_state_by_state(way):
    f = BRANCHES[way]
    system = qpmhe.System(f, lambda x: x, n=1, p=1)
    assert system.f.mode == "looped"
    states = np.array([[11.0], [13.0], [9.0], [20.0]])
    found = system.f.batch(states, np.zeros((4, 0)))
    np.testing.assert_array_equal(found, [f(x) for x in states])


@pytest.mark.parametrize("way", BRANCHES)
def test_the_cost_is_true_where_the_model_branches(way):
    f = BRANCHES[way]
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, lambda x: x, n=1, p=1), qpmhe.Luenberger([0.02]),
        qpmhe.QuadraticCost(prior=0.1, disturbance=1.0, noise=50.0),
        horizon=8, initial_state=[9.0], max_qps=3,
    )
    measured = [11.5, 12.8, 12.1, 13.5, 11.0]
    for t, y in enumerate(measured):
        estimate = mhe.update(y)
        x = estimate.trajectory
        w = x[1:] - [f(row) for row in x[:-1]]
        v = np.array(measured[: t + 1]) - x[:-1, 0]
        prior = 0.1 * (x[0] - estimate.candidate[0]) @ (x[0] - estimate.candidate[0])
        cost = prior + (w**2).sum() + 50.0 * (v**2).sum()
        assert estimate.cost == pytest.approx(cost, rel=1e-10)


def filled(x):
    out = np.empty_like(x)
    out[..., 0], out[..., 1] = x[..., 1], np.clip(x[..., 0], -1.0, 1.0)
    return out


def in_place(x):
    y = 0.5 * x
    y += np.sin(x)
    y[..., 0] *= 2.0
    return y


A = np.array([[0.9, 0.2], [-0.1, 0.8]])

STRAIGHT = {
    "x @ A.T": ("batched", lambda x: x @ A.T),
    "A @ x": ("columns", lambda x: A @ x),
    "dot": ("columns", lambda x: np.dot(A, x)),
    "einsum": ("batched", lambda x: np.einsum("ij,...j->...i", A, x)),
    "list": ("columns", lambda x: np.array([x[1], -np.sin(x[0])])),
    "stack": ("batched", lambda x: np.stack((x[..., 1], np.exp(-x[..., 0] ** 2)), axis=-1)),
    "where": ("batched", lambda x: np.where((x > 0.0) & (x < 9.0), x, 2.0 * x)),
    "maximum": ("batched", lambda x: np.maximum(x, 0.0) + np.minimum(x, 1.0)),
    "abs and sign": ("batched", lambda x: np.abs(x) ** 0.5 * np.sign(x)),
    "clip": ("batched", lambda x: np.clip(x, None, 2.0)),
    "select": ("batched", lambda x: np.select([x < 0.0, x > 3.0], [x, 3.0 + 0.0 * x], 1.0)),
    "interp": ("batched", lambda x: np.interp(x, np.arange(4.0), TABLE)),
    "norm": ("batched", lambda x: x / (1.0 + np.linalg.norm(x, axis=-1, keepdims=True))),
    "sum": ("batched", lambda x: x + x.sum(axis=-1, keepdims=True)),
    "arctan2": ("columns", lambda x: [np.arctan2(x[1], x[0]), np.hypot(x[0], x[1])]),
    "concatenate": ("batched", lambda x: np.concatenate((x[..., 1:], x[..., :1]), axis=-1)),
    "filled": ("batched", filled),
    "in place": ("batched", in_place),
    "asarray": ("batched", lambda x: np.asarray(x) * 2.0 + 1.0),
}


@pytest.mark.parametrize("way", STRAIGHT)
def test_a_function_without_branches_is_called_once_for_many_states(way):
    mode, f = STRAIGHT[way]
    system = qpmhe.System(f, lambda x: x, n=2, p=2)
    assert system.f.mode == mode
    assert system.f.reads_only
    states = 20.0 * np.random.default_rng(0).standard_normal((5, 2))
    found = system.f.batch(states, np.zeros((5, 0)))
    np.testing.assert_allclose(found, [np.asarray(f(x)) for x in states], rtol=1e-14)


@pytest.mark.parametrize(
    "mixing",
    [
        pytest.param(lambda x: x - x.mean(axis=0), id="mean"),
        pytest.param(lambda x: x + 0.0 * x[..., :1].sum(axis=0), id="zero times a sum"),
        pytest.param(lambda x: np.roll(x, 1, axis=0) if x.ndim > 1 else x, id="roll"),
        pytest.param(lambda x: np.cumsum(x, axis=0) if x.ndim > 1 else x, id="cumsum"),
    ],
)
def test_a_function_that_mixes_states_is_no_function_of_many(mixing):
    function = BatchedFunction("f", mixing, (2,), 0, [(np.array([1.0, 2.0]), NOTHING)] * 3)
    states = np.random.default_rng(0).standard_normal((5, 2))
    np.testing.assert_array_equal(
        function.batch(states, np.zeros((5, 0))), [mixing(x) for x in states]
    )
    assert function.mode != "batched"


def test_labels_say_what_a_value_depends_on():
    labels = np.array([1, 2, 4], np.uint64)
    found = trace(lambda x: [x[0] * x[2], x[1] + 1.0, 5.0, np.maximum(x, 0.0).sum()], [labels])
    assert found.tolist() == [5, 2, 0, 7]
    assert trace(lambda x: x[0] if x[1] > 0.0 else x[2], [labels]) is None


def test_a_function_that_does_too_much_with_single_symbols_is_not_traced():
    def long(x):
        for _ in range(10**9):
            x = x + sum(x)
        return x

    assert trace(long, [one(2)]) is None


def test_a_model_that_keeps_its_last_argument_works_on():
    class Model:
        last, value = np.zeros(2), np.zeros(2)

        def f(self, x):
            if not np.array_equal(x, self.last):
                self.last, self.value = x, 0.5 * x
            return self.value

    class Copies(Model):
        def f(self, x):
            if self.last[0] != x[0] or self.last[1] != x[1]:
                self.last, self.value = np.array(x), 0.5 * x
            return self.value

    for kind in (Model, Copies):
        system = qpmhe.System(kind().f, lambda x: x[..., :1], n=2, p=1)
        states = np.random.default_rng(0).standard_normal((4, 2))
        for x in states:
            np.testing.assert_array_equal(system.f(x, NOTHING), 0.5 * x)
        np.testing.assert_array_equal(system.f.batch(states, np.zeros((4, 0))), 0.5 * states)


# What is written into an argument


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


WRITING = {"clip": clipped, "branch": clipped_beyond}


def estimator(f, **options):
    options = {"horizon": 4, "initial_state": [1.0], "max_qps": 2} | options
    system = options.pop("system", None) or qpmhe.System(
        f, lambda x: x, n=1, p=1, states=qpmhe.Box([0.0], [np.inf])
    )
    cost = options.pop("cost", qpmhe.QuadraticCost(prior=1.0, disturbance=4.0, noise=25.0))
    observer = options.pop("observer", qpmhe.Luenberger([0.8]))
    return qpmhe.MovingHorizonEstimator(system, observer, cost, **options)


MEASURED = [0.3, -0.6, 0.1, 14.0, 12.5, -0.4, 13.0, 0.2, 0.0, -1.0]


@pytest.mark.parametrize("options", [{}, {"warm_start": True}, {"candidate": "reinitialized"}])
@pytest.mark.parametrize("way", WRITING)
def test_a_model_that_writes_into_its_argument_changes_nothing(way, options):
    f = WRITING[way]
    wrong, right = estimator(f, **options), estimator(lambda x: f(np.array(x)), **options)
    kept = []
    for y in MEASURED:
        found, expected = wrong.update(y), right.update(y)
        np.testing.assert_array_equal(found.trajectory, expected.trajectory)
        np.testing.assert_array_equal(found.candidate, expected.candidate)
        assert (found.cost, found.candidate_cost) == (expected.cost, expected.candidate_cost)
        assert qpmhe.Status.MODEL_FAILED not in found.status
        kept.append((found, found.trajectory.copy(), found.candidate.copy()))
    for estimate, trajectory, candidate in kept:
        np.testing.assert_array_equal(estimate.trajectory, trajectory)
        np.testing.assert_array_equal(estimate.candidate, candidate)


def test_a_model_that_writes_before_a_step_of_unusual_length_changes_nothing():
    runs = []
    for rate in (clipped_beyond, lambda x: clipped_beyond(np.array(x))):
        system = qpmhe.System.from_ode(rate, lambda x: x, dt=0.1, n=1, p=1)
        mhe = estimator(None, system=system)
        runs.append([mhe.update(y, dt=0.2).trajectory for y in MEASURED])
    for found, expected in zip(*runs, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_model_that_writes_into_its_input_changes_nothing():
    runs = []
    for f in (overwritten_input, lambda x, u: overwritten_input(x, u.copy())):
        mhe = estimator(None, system=qpmhe.System(f, lambda x: x, n=1, p=1, m=1))
        runs.append([mhe.update(y, [0.5]).trajectory for y in MEASURED])
    for found, expected in zip(*runs, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_correction_that_writes_into_its_arguments_changes_nothing():
    def writing(z, v):
        if z[0] > 5.0:
            z[0], v[0] = 0.0, 0.0
        return 0.8 * v

    runs = [
        [mhe.update(y).trajectory for y in MEASURED]
        for mhe in (
            estimator(low, observer=qpmhe.OutputInjection(one))
            for one in (writing, lambda z, v: writing(np.array(z), np.array(v)))
        )
    ]
    for found, expected in zip(*runs, strict=True):
        np.testing.assert_array_equal(found, expected)


class Writing(qpmhe.Luenberger):
    """An observer that writes into what it is shown."""

    def correct(self, z, v, sample):
        z[...] = 0.0
        return super().correct(z, v, sample)


class BadLoss(Loss):
    """A loss that fails after some calls."""

    exponent = None

    def __init__(self, failure):
        super().__init__(np.eye(1))
        self._failure, self.calls = failure, 0

    def cost(self, s, weight):
        self.calls += 1
        if self.calls > 3:
            self._failure(s)
        return super().cost(s, weight)

    def _value(self, q):
        return q

    def _slope(self, q):
        return np.ones_like(q)


def raised(error):
    def fail(*_):
        raise error

    return fail


def overwritten(values):
    values[...] = 0.0


@pytest.mark.parametrize(
    "failure", [raised(ValueError("loss")), raised(SystemExit(3)), overwritten],
    ids=["ValueError", "SystemExit", "overwritten"],
)
def test_a_loss_that_fails_makes_a_step_fall_back(failure):
    cost = qpmhe.RobustCost(prior=np.eye(1), disturbance=np.eye(1), noise=BadLoss(failure))
    mhe = estimator(low, cost=cost)
    for y in MEASURED:
        estimate = mhe.update(y)
    assert qpmhe.Status.MODEL_FAILED in estimate.status
    assert mhe.time == len(MEASURED)


def test_an_observer_cannot_write_into_the_window():
    mhe = estimator(low, observer=Writing([0.8]))
    for y in MEASURED:
        estimate = mhe.update(y)
    assert qpmhe.Status.MODEL_FAILED in estimate.status
    assert np.isfinite(estimate.state).all()


# What leaves a model


def exits(_):
    sys.exit(7)


RETURNS = {
    "None": lambda _: None,
    "a short array": lambda _: np.zeros(0),
    "a long array": lambda _: np.zeros(5),
    "a text": lambda _: "far out",
    "an object": lambda _: object(),
    "complex numbers": lambda x: x * (1.0 + 1.0j),
    "an exception": raised(ZeroDivisionError("far out")),
    "SystemExit": exits,
    "GeneratorExit": raised(GeneratorExit()),
}


@pytest.mark.parametrize("where", ["f", "h"])
@pytest.mark.parametrize("options", [{}, {"warm_start": True}, {"candidate": "reinitialized"}])
@pytest.mark.parametrize("what", RETURNS)
def test_what_a_model_returns_far_out_never_leaves_update(what, options, where):
    far = RETURNS[what]

    def bent(x):
        return far(x) if x[0] > 12.0 else 1.1 * x

    functions = {"f": lambda x: 1.1 * x, "h": lambda x: 1.0 * x} | {where: bent}
    system = qpmhe.System(**functions, n=1, p=1)
    options = {"observer": qpmhe.Luenberger([0.3]), "initial_state": [9.0]} | options
    mhe = estimator(None, system=system, **options)
    for t in range(12):
        estimate = mhe.update(10.0 * 1.1**t)
        assert estimate.cost <= estimate.candidate_cost
    assert mhe.time == 12
    assert qpmhe.Status.MODEL_FAILED in estimate.status or (
        qpmhe.Status.FAILED_STAGE in estimate.status
    )


def test_a_model_that_ends_the_program_after_some_time_does_not():
    left = [math.inf]

    def f(x):
        left[0] -= 1
        if left[0] < 0:
            raise SystemExit(3)
        return 0.9 * x

    mhe = estimator(untraced(f))
    left[0] = 20
    for y in MEASURED:
        estimate = mhe.update(y)
    assert qpmhe.Status.MODEL_FAILED in estimate.status


# What an input is


def test_the_second_parameter_is_the_input_whatever_its_name_and_default():
    for f in (
        lambda x, u: 0.9 * x + u,
        lambda x, q=0.0: 0.9 * x + q,
        lambda x, force=None: 0.9 * x + force,
        lambda x, u, gain=1.0: 0.9 * x + gain * u,
        lambda x, *rest: 0.9 * x + rest[0],
    ):
        system = qpmhe.System(f, lambda x: x, n=1, p=1, m=1)
        np.testing.assert_allclose(system.f(np.ones(1), np.full(1, 2.0)), [2.9])


@pytest.mark.parametrize(
    ("f", "words"),
    [
        pytest.param(lambda x: x, "neither f nor h takes an input", id="no input"),
        pytest.param(lambda x, scale=2.0, u=0.0: x, "make u the second", id="u is third"),
        pytest.param(lambda x, matrix=A: x, "no input of 1 numbers", id="a matrix"),
        pytest.param(lambda x, function=np.sin: x, "no input of 1 numbers", id="a function"),
        pytest.param(lambda x, *, u: x + u, "by keyword only", id="keyword"),
        pytest.param(lambda x, *, u=0.0: x + u, "by keyword only", id="keyword with default"),
        pytest.param(lambda x, u, w: x + u + w, "needs 3 arguments", id="three"),
        pytest.param(lambda: 1.0, "takes no argument", id="none"),
    ],
)
def test_what_is_no_clear_input_is_refused(f, words):
    with pytest.raises(ModelError, match=words):
        qpmhe.System(f, lambda x: x, n=1, p=1, m=1)
    if "f nor h" in words:
        with pytest.raises(ModelError, match="neither rate nor h takes an input"):
            qpmhe.System.from_ode(f, lambda x: x, dt=0.1, n=1, p=1, m=1)


def test_inputs_that_no_function_takes_are_refused_from_casadi_and_jax():
    for make in (qpmhe.from_casadi, qpmhe.from_jax):
        with pytest.raises(ModelError, match="neither f nor h takes an input"):
            make(lambda x: 0.9 * x, lambda x: x, n=1, p=1, m=1)


def test_a_default_without_inputs_is_a_default():
    system = qpmhe.System(lambda x, scale=3.0: scale * x, lambda x: x, n=1, p=1)
    assert system.f(np.ones(1), NOTHING) == 3.0
