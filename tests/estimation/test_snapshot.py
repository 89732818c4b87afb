"""Snapshots continue bit for bit, and those of other estimators or damaged ones are refused."""

import copy
import json
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError
from qpmhe.memory.snapshot import read, written

from .same import assert_same, leaves
from .systems import pendulum
from .untraced import untraced

OPTIONS = {
    "observer alone": {"max_qps": 0},
    "smoothed": {"arrival": "smoothed", "candidate": "reinitialized"},
    "kalman": {"kalman": True, "candidate": "reinitialized"},
    "sets": {"states": qpmhe.Box([-0.9, -0.9], [0.9, 0.9]), "robust": 0.3, "warm_start": True},
}
COMPILED = ["compiled"] * (find_compiler() is not None)
engines = pytest.mark.parametrize("engine", ["untraced", *COMPILED])
WEIGHTS = {"prior": np.eye(2), "disturbance": 10.0 * np.eye(2), "noise": np.eye(1)}
RECORD = np.random.default_rng(0).normal(0.0, 0.6, (30, 2))
RECORD[7, 0] = np.nan


def made(
    engine="untraced", kalman=False, robust=0.0, system=None, observer=None, weights=None,
    states=None, **options,
):
    weights = WEIGHTS | (weights or {})
    if robust:
        weights["noise"] = qpmhe.Huber(weights["noise"], robust)
    if kalman:
        observer = qpmhe.ExtendedKalman(**WEIGHTS)
        weights["prior"] = qpmhe.ObserverPrior()
    return qpmhe.MovingHorizonEstimator(
        system or pendulum(engine, states=states), observer or qpmhe.Luenberger([0.3, 0.4]),
        (qpmhe.RobustCost if robust else qpmhe.QuadraticCost)(**weights),
        **{"horizon": 4, "initial_state": [0.5, 0.0],
           "engine": engine if engine == "compiled" else "python"} | options,
    )


def feed(mhe, first, last):
    """A record with irregular steps, own noises and a late measurement at stated times."""
    estimates = []
    for t in range(first, last):
        own = {9: {"dt": 0.15}, 10: {"noise_weight": [[4.0]]}}.get(t, {})
        estimates.append(mhe.update(RECORD[t, :1], RECORD[t, 1:], **own))
        if t == 11:
            estimates.append(mhe.amend(9, [0.7]))
    return estimates


def fed(count=15, *arguments, **options):
    mhe = made(*arguments, **options)
    feed(mhe, 0, count)
    return mhe


def same(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert_same(one, other)


@pytest.mark.parametrize("engine", ["untraced", "traced", *COMPILED])
@pytest.mark.parametrize("name", OPTIONS)
def test_a_restored_estimator_continues_bit_for_bit(name, engine):
    options = OPTIONS[name]
    for stop in (0, 1, 12):
        whole = fed(stop, engine, **options)
        others = [made(engine, **options), pickle.loads(pickle.dumps(whole))]
        whole.forget_warm_start()
        state = whole.state_dict()
        others[0].load_state_dict(state)
        for value in state.values():  # the estimator has taken a copy
            if isinstance(value, np.ndarray) and value.dtype == np.float64:
                value[...] = np.nan
        expected, covariances = feed(whole, stop, 20), whole.covariances()
        for mhe in others:
            same(feed(mhe, stop, 20), expected)
            np.testing.assert_array_equal(mhe.covariances(), covariances)
    whole.reset()
    same(feed(whole, 0, 14), feed(made(engine, **options), 0, 14))


@engines
def test_files_without_pickle_keep_every_bit(engine, tmp_path):
    mhe, others = fed(15, engine, kalman=True), [made(engine, kalman=True) for _ in range(2)]
    np.savez(tmp_path / "state.npz", **mhe.state_dict())
    with np.load(tmp_path / "state.npz") as file:
        others[0].load_state_dict(file)
    text = json.dumps(mhe.state_dict(), default=np.ndarray.tolist)
    others[1].load_state_dict(json.loads(text))
    expected = feed(mhe, 15, 20)
    for other in others:
        same(feed(other, 15, 20), expected)


def injection(gain):
    return qpmhe.OutputInjection(lambda z, v: gain * np.tanh(v[0]) * np.ones(2))


@engines
def test_the_state_of_another_estimator_is_refused_by_name(engine):
    others = {  # estimators that differ in one thing, with the word that must name it
        "cost.prior": {"weights": {"prior": 1.1 * np.eye(2)}},
        "cost.disturbance": {"weights": {"disturbance": 9.0 * np.eye(2)}},
        "cost.noise": {"weights": {"noise": 1.001 * np.eye(1)}},
        "cost.discount": {"weights": {"discount": 0.9}},
        "observer.gain": {"observer": qpmhe.Luenberger([0.3, 0.41])},
        "another observer": {"kalman": True}, "another cost": {"robust": 1.0},
        "set of states": {"states": qpmhe.Box([-5.0, -5.0], [5.0, 5.0])},
        "model": {"system": pendulum(engine, swing=1.001)},
        "(h)": {"system": pendulum(engine, bend=0.1001)},
    }
    for count in (0, 15):
        state = fed(count, engine).state_dict()
        for name, options in others.items():
            mhe = fed(3, engine, **options)
            before = leaves(mhe.state_dict())
            with pytest.raises(InvalidInputError) as error:
                mhe.load_state_dict(state)
            assert name in str(error.value), (name, str(error.value))
            assert leaves(mhe.state_dict()) == before
    # Functions that a user has written are compared by their values.
    with pytest.raises(InvalidInputError, match=r"another observer \(its correction\)"):
        made(observer=injection(0.31)).load_state_dict(fed(9, observer=injection(0.3)).state_dict())


@engines
def test_caps_and_policies_may_change(engine):
    """The observer's part is the same then; terms that were not there are computed."""
    for first, second in (
        ({"max_qps": 0}, {"max_qps": 2}), ({"max_qps": 3}, {"max_qps": 0}),
        ({}, {"max_qps": None, "tolerance": 1e-6, "solver_tolerance": 1e-5}),
        ({}, {"warm_start": True, "max_qps": None, "max_solver_iterations": 70}),
        *[({"infeasible": "restore"}, {"infeasible": "drop_rows"})] * (engine != "compiled"),
    ):
        other, fresh = made(engine, **second), fed(12, engine, **second)
        other.load_state_dict(fed(12, engine, **first).state_dict())
        for found, expected in zip(feed(other, 12, 20), feed(fresh, 12, 20), strict=True):
            np.testing.assert_allclose(found.candidate, expected.candidate, rtol=1e-12)
            np.testing.assert_allclose(found.trajectory, expected.trajectory, rtol=1e-6, atol=1e-7)
            assert found.cost <= found.candidate_cost


def leaf_paths(value, path=()):
    items = (
        value.items() if isinstance(value, dict)
        else enumerate(value) if isinstance(value, (list, tuple)) else ()
    )
    return [path] * bool(path) + [
        one for key, item in items for one in leaf_paths(item, (*path, key))
    ]


def replaced(value, path, new):
    if not path:
        return new
    if isinstance(value, dict):
        return value | {path[0]: replaced(value.get(path[0], {}), path[1:], new)}
    return type(value)(
        replaced(v, path[1:], new) if k == path[0] else v for k, v in enumerate(value)
    )


JUNK = [
    None, 3, -1, 2**70, 0.5, np.nan, True, "text", b"bytes", [], {}, [[1, 2], [3]], object(),
    np.zeros(0), np.zeros((3, 3)), np.array(1.25), np.array(["a"]), np.full(2, np.nan),
]
def mutated(state, generator):
    """A state with some part of it replaced, and where."""
    paths = leaf_paths(state)
    path, old = paths[generator.integers(len(paths))], state
    for key in path:
        old = old[key]
    kind, new = generator.integers(5), JUNK[generator.integers(len(JUNK))]
    if isinstance(old, np.ndarray) and kind:
        new = old.copy()
        if kind == 1 and old.ndim:
            new = new[:-1] if old.shape[0] else np.zeros((1, *old.shape[1:]), old.dtype)
        elif kind == 2:
            new = new.astype(np.float32 if old.dtype == np.float64 else np.int64)
        elif new.size and new.dtype == np.float64:
            k = generator.integers(new.size)
            new.flat[k] = generator.choice([np.nan, np.inf, -7.0, 1.5 * new.flat[k] + 0.1])
        elif new.size:
            k = generator.integers(new.size)
            new.flat[k] = ~new.flat[k]
    elif isinstance(old, (list, tuple)) and kind == 1 and old:
        new = old[:-1]
    elif isinstance(old, int) and kind == 1:
        new = old + int(generator.integers(1, 50)) * (1 if generator.random() < 0.5 else -1)
    return path, replaced(state, path, new)


@engines
def test_what_is_not_whole_is_refused(engine):
    """Whatever changes in a snapshot, if only one bit of it."""
    generator, mhe = np.random.default_rng(5), fed(11, engine, kalman=True)
    state, before = fed(15, engine, kalman=True).state_dict(), leaves(mhe.state_dict())
    for _ in range(60):
        _, damaged = mutated(state, generator)
        if leaves(damaged) != leaves(state):
            with pytest.raises(InvalidInputError, match=r"the state (is|has)"):
                mhe.load_state_dict(damaged)
    names = [name for name, value in state.items() if np.size(value) and name != "structure"]
    for name in names:
        damaged = {key: np.array(value) for key, value in state.items()}
        place = int(np.flatnonzero(damaged[name] == damaged[name])[0])  # not at NaN
        damaged[name].reshape(-1)[place : place + 1].view(np.uint8)[0] ^= 1
        with pytest.raises(InvalidInputError, match="its digest is another"):
            mhe.load_state_dict(damaged)
    assert len(names) > 9
    assert leaves(mhe.state_dict()) == before


@engines
@pytest.mark.parametrize("name", ["smoothed", "kalman"])
def test_damage_with_the_right_digest_is_refused_or_harmless(name, engine):
    options, generator, refused = OPTIONS[name], np.random.default_rng(3), 0
    mhe, twin = (fed(11, engine, **options) for _ in range(2))
    state = read(fed(15, engine, **options).state_dict())
    for _ in range(90):
        _, damaged = mutated(state, generator)
        if leaves(damaged) == leaves(state):
            continue
        try:
            mhe._engine.load_state_dict(damaged)
        except InvalidInputError:
            refused += 1
        else:
            mhe.update(np.zeros(1), np.zeros(1))
            mhe = fed(11, engine, **options)
        np.testing.assert_array_equal(mhe.state, twin.state)
    assert refused > 45
    same(feed(mhe, 11, 16), feed(twin, 11, 16))


def test_snapshots_of_the_version_before_are_refused():
    """Their text had no format, but the parts of the memory themselves."""
    before = {"structure": json.dumps({"problem": [2, 1, 1, 4], "engine": "python"})}
    words = (
        r"^the state has the format 1 of another version of qpmhe; expected 2\. Continue from it "
        r"with the version that saved it, or give this estimator the last samples again\.$"
    )
    with pytest.raises(InvalidInputError, match=words):
        made().load_state_dict(before)


def test_damage_that_was_seen():
    state, mhe = read(fed().state_dict()), fed(6)
    before, own = leaves(mhe.state_dict()), ("window", "own")
    half = state["window"]["trajectory"].copy()
    half[0] = np.nan
    for path, value in (
        (own, None), (own, {-3: {"noise_weight": np.eye(1)}}),
        (own, {14: {"noise_weight": -np.eye(1)}}), (own, {14: []}),
        (("usual",), {"noise_weight": -3.0 * np.eye(1)}), (("window", "time"), -1),
        (("window", "z"), np.zeros((4, 2))), (("window", "watched"), (0, 16)), (("estimator",), {}),
        (("problem",), (2, 1)), (("window", "history"), [[1.0, 2.0, 3.0]]),
        (("window", "trajectory"), half), (("window", "y"), np.zeros((4, 1), np.float32)),
    ):
        with pytest.raises(InvalidInputError, match="the state is"):
            mhe._engine.load_state_dict(replaced(state, path, value))
        assert leaves(mhe.state_dict()) == before
    for wrong, words in (
        (3, "the state is a int; expected the dict that state_dict returned"),
        ({}, r"the state has no 'structure' \(it is empty\); expected the whole dict"),
        (written({"problem": (2, 1, 1, 7)}), r"2, 1, 1, 7.; expected .2, 1, 1, 4"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            made().load_state_dict(wrong)


def test_estimators_of_one_system_do_not_change_each_other():
    def branching(x):  # decides for all states by the first one
        return x[..., :1] * (1.0 if np.ravel(x)[0] < 1.5 else 1.1)

    def bent(x):  # a kink
        return np.where(x.real < 50.0, 0.9 * x, np.abs(x))

    def estimator(system, start=(1.0, 1.0)):
        return made(system=system, initial_state=start, observer=qpmhe.Luenberger([0.3, 0.1]))

    system, twin = (qpmhe.System(untraced(bent), branching, n=2, p=1) for _ in range(2))
    before = dict(vars(system))
    one, other, alone = estimator(system), estimator(system), estimator(twin)
    estimator(system, (80.0, 90.0))  # differentiates in another way there
    state, generator = read(one.state_dict()), np.random.default_rng(0)
    for t in range(40):
        y = generator.uniform(0.0, 4.0, 1)
        assert_same(other.update(y), alone.update(y))
        one.update(generator.uniform(0.0, 4.0, 1))
        if t % 10 == 5:
            one.load_state_dict(written(state))
        assert vars(system) == before


class Ramp(qpmhe.Loss):
    """Linear from a point on that is no attribute: Huber's loss, but for rounding."""

    bend = 1.0

    def value(self, q):
        bend = type(self).bend
        return np.where(q < bend, q, 2.0 * np.sqrt(bend * q) - bend)

    def slope(self, q):
        bend = type(self).bend
        return np.where(q < bend, 1.0, np.sqrt(bend / np.maximum(q, 1e-9)))


def test_a_loss_with_other_values_is_another():
    def robust(kind):
        return qpmhe.RobustCost(**WEIGHTS | {"noise": kind(WEIGHTS["noise"])})

    class Other(Ramp):
        bend = 1.1

    Other.__qualname__ = Ramp.__qualname__
    system, observer = pendulum("untraced"), qpmhe.Luenberger([0.3, 0.4])
    one, same_loss, another = (
        qpmhe.MovingHorizonEstimator(
            system, observer, robust(kind), horizon=4, initial_state=[0.5, 0.0], engine="python"
        )
        for kind in (Ramp, Ramp, Other)
    )
    one.run(RECORD[:6, :1], RECORD[:6, 1:])
    same_loss.load_state_dict(one.state_dict())
    assert same_loss.time == 6
    with pytest.raises(InvalidInputError, match=r"another cost \(its values\)"):
        another.load_state_dict(one.state_dict())


def square_of(value):
    return qpmhe.Box([-value] * 2, [value] * 2)


@pytest.mark.parametrize("form", ["traced", "opaque"])
def test_a_copy_after_set_and_reset_goes_on_as_the_estimator(form):
    """It has the new initial state, and calls and scales the model as the original does."""
    def f(x):
        x = x if form == "traced" else [float(one) for one in x]
        return np.stack([0.9 * x[0] + 0.1 * np.sin(x[1]), 0.8 * x[1] + 0.1 * x[0]])

    def g(x, v):
        return x[0] ** 2 + v[0] - 4.5

    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(
            f, lambda x: x[0] + 0.1 * x[1] ** 2, n=2, p=1, states=square_of(1.0),
            constraints=[qpmhe.Constraint(g)],
        ),
        qpmhe.Luenberger([0.3, 0.1]),
        qpmhe.QuadraticCost(prior=1e-8 * np.eye(2), disturbance=10.0 * np.eye(2), noise=20.0),
        horizon=4, initial_state=[0.1, 0.1], max_qps=2, engine="python",
    )
    mhe.set(bounds={"states": square_of(3.0)})
    mhe.reset([2.0, 0.5])
    for y in (2.1, 1.9, 1.6):
        mhe.update(y)
    mhe.forget_warm_start()
    copied = copy.deepcopy(mhe)
    np.testing.assert_array_equal(copied.initial_state, [2.0, 0.5])
    for y in np.random.default_rng(0).normal(1.0, 0.3, 12):
        assert_same(copied.update(y), mhe.update(y))
    for one in (mhe, copied):
        one.reset()
        np.testing.assert_array_equal(one.state, [2.0, 0.5])
