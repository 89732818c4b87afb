"""What the compiled engine remembers: snapshots, whole records, covariances."""

import copy
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError
from qpmhe.estimation.snapshot import read
from tests.codegen.test_agreement import ARRAYS

from .test_compiled import STEPS, both, estimator, input_at, made
from .test_compiled_data import fragile, outliers, spoilt
from .test_compiled_sets import case_of
from .test_compiled_sets import estimator as with_sets

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]

Status = qpmhe.Status
engines = pytest.mark.parametrize("engine", ["python", "compiled"])


def equal(one, other):
    """Equality of two estimates to the last bit."""
    for name in (*ARRAYS, "cost", "candidate_cost"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert (one.status, one.qps, one.solver_iterations, one.dropped, one.time) == (
        other.status, other.qps, other.solver_iterations, other.dropped, other.time
    )


def saved(mhe):
    return pickle.loads(pickle.dumps(mhe.state_dict()))


@pytest.mark.parametrize("cut", [0, 1, 3, 17])
@pytest.mark.parametrize("name", ["wide", "inputs", "reactor rk4", "n=3"])
def test_a_snapshot_goes_on_bit_for_bit(name, cut):
    model = made(name)
    options = {"warm_start": True, "candidate": "reinitialized", "delay": 1}
    mhe, Y = estimator(model, **options), spoilt(model, 3)
    for t in range(cut):
        dt = 0.07 if model.system.dt and t % 3 == 0 else None
        weight = np.eye(model.system.p) * 2.0 if t % 4 == 0 else None
        mhe.update(Y[t], *input_at(model, t), dt=dt, noise_weight=weight)
    fresh = estimator(model, **options)
    fresh.update(model.Y[0], *input_at(model, 0))
    fresh.load_state_dict(saved(mhe))
    others = [fresh, pickle.loads(pickle.dumps(mhe)), copy.deepcopy(mhe)]
    for t in range(cut, STEPS):
        expected = mhe.update(Y[t], *input_at(model, t))
        for other in others:
            equal(other.update(Y[t], *input_at(model, t)), expected)
        if t % 3 == 0:
            expected = mhe.amend(t, model.Y[t])
            for other in others:
                equal(other.amend(t, model.Y[t]), expected)
    for other in others:
        assert (other.engine, other.time) == ("compiled", STEPS)
        np.testing.assert_array_equal(other.covariances(), mhe.covariances())


@engines
def test_late_measurements_are_no_samples_with_a_far_observer(engine):
    system = qpmhe.from_casadi(lambda x: 0.9 * x, lambda x: x, n=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)

    def build():
        return qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.0]), cost, horizon=3, initial_state=[0.0], engine=engine
        )

    mhe = build()
    mhe.update([1e3])
    for _ in range(4):
        estimate = mhe.amend(0, [1e3])
        assert Status.OBSERVER_FAR not in estimate.status
    build().load_state_dict(saved(mhe))
    assert Status.OBSERVER_FAR not in mhe.update([1e3]).status
    assert Status.OBSERVER_FAR in mhe.update([1e3]).status


@pytest.mark.parametrize("horizon", [1, 2])
@engines
def test_a_snapshot_of_stages_where_the_model_fails(engine, horizon):
    model = fragile("logarithm")
    held = 0
    for seed in range(4):
        mhe = estimator(model, engine, horizon=horizon)
        for y in outliers(model, seed):
            other = estimator(model, engine, horizon=horizon)
            other.load_state_dict(mhe.state_dict())
            expected = mhe.update(y)
            held += Status.MODEL_FAILED in expected.status
            equal(other.update(y), expected)
    assert held > 3


@engines
def test_a_snapshot_tells_only_what_was_learnt(engine):
    """Two snapshots of one estimator are one and the same."""
    model = made("wide")
    mhe = estimator(model, engine)
    for t in range(7):
        mhe.update(model.Y[t])
    one = pickle.dumps(mhe.state_dict())
    junk = [np.full(k, 7.7) for k in range(1, 400)]  # memory that is used again
    del junk
    assert pickle.dumps(mhe.state_dict()) == one


@engines
def test_estimates_can_be_copied(engine):
    model = made("wide")
    mhe = estimator(model, engine, delay=1)
    for t in range(6):
        estimate = mhe.update(model.Y[t])
    for made_anew in (
        copy.copy(estimate), copy.deepcopy(estimate), pickle.loads(pickle.dumps(estimate))
    ):
        equal(made_anew, estimate)
        assert made_anew.step_time == estimate.step_time


def test_damaged_snapshots_are_refused_whole():
    model = made("reactor euler")
    mhe, twin = estimator(model), estimator(model)
    for one in (mhe, twin):
        one.update(model.Y[0])
        one.update(model.Y[1])
    kept = mhe.state_dict()
    good = read(kept)
    memory = good["memory"]
    damaged = [
        {}, {**good, "problem": None}, {**good, "problem": (2, 1, 0, 99)},
        {**good, "problem": [np.zeros(2)] * 4}, {**good, "engine": "python"},
        {**good, "memory": None}, {**good, "memory": "abc"}, {**good, "memory": memory[:-1]},
        {**good, "memory": np.concatenate((memory, memory))}, {**good, "memory": memory[:0]},
        {**good, "memory": memory[None]}, {**good, "memory": np.full_like(memory, 255)},
        {**good, "memory": np.full(memory.shape, 1e300)},
        {**good, "memory": np.full(memory.shape, np.nan)},
        {**good, "memory": [300] * memory.size},
        *({key: value for key, value in good.items() if key != left} for left in good),
    ]
    for state in damaged:
        with pytest.raises(InvalidInputError):
            mhe._engine.load_state_dict(state)
    for state in (
        None, 5, "state", [], {}, {**kept, "structure": "{"}, {**kept, "structure": 3},
        {**kept, "memory": "abc"}, *(
            {key: value for key, value in kept.items() if key != left} for left in kept
        ), estimator(model, "python").state_dict(),
    ):
        with pytest.raises(InvalidInputError, match="the state "):
            mhe.load_state_dict(state)
    for t in range(2, 6):
        equal(mhe.update(model.Y[t]), twin.update(model.Y[t]))


def test_damaged_numbers_do_no_harm():
    """Damage is refused, or too small to matter: the last digits, or what is never read."""
    model, generator = made("inputs"), np.random.default_rng(0)
    mhe, twin = estimator(model, warm_start=True), estimator(model, warm_start=True)
    for t in range(8):
        mhe.update(model.Y[t], *input_at(model, t))
    good, taken = mhe.state_dict(), 0
    memory = good["memory"].view(mhe._engine._memory.dtype)
    for k in range(400):
        damaged = good["memory"].copy()
        if k % 2:  # anywhere
            damaged[generator.integers(0, damaged.size, 2)] = generator.integers(0, 256, 2)
        else:  # in the last digits of a number
            name = ("history", "trajectory")[k // 2 % 2]
            offset = memory.dtype.fields[name][1]
            damaged[offset + 8 * generator.integers(0, memory[0][name].size)] ^= 1
        try:
            mhe.load_state_dict({**good, "memory": damaged})
        except InvalidInputError:
            continue
        taken += 1
        twin.load_state_dict(good)
        for t in range(3):
            found, expected = (
                one.update(model.Y[t], *input_at(model, t)) for one in (mhe, twin)
            )
            np.testing.assert_allclose(found.trajectory, expected.trajectory, rtol=1e-3)
            assert found.status == expected.status
    assert 20 < taken < 380


@pytest.mark.parametrize("name", ["wide", "inputs", "n=1", "chain"])
def test_a_record_is_its_samples(name):
    model = made(name)
    generator = np.random.default_rng(1)
    # Longer than what is handed to C at once, with missing samples.
    count = 600
    Y = np.resize(spoilt(model, 4, share=0.1), (count, model.system.p))
    U = generator.uniform(-1.0, 1.0, (count, model.system.m)) if model.system.m else None
    options = {"warm_start": True, "delay": 2}
    one, other = estimator(model, **options), estimator(model, **options)
    start, run = one.state.copy(), other.run(Y, U)
    estimates = [one.update(Y[t], *(() if U is None else (U[t],))) for t in range(count)]
    np.testing.assert_array_equal(run.states, [start, *(e.state for e in estimates)])
    np.testing.assert_array_equal(run.filtered, [e.filtered for e in estimates])
    np.testing.assert_array_equal(run.costs, [e.cost for e in estimates])
    np.testing.assert_array_equal(run.candidate_costs, [e.candidate_cost for e in estimates])
    assert run.statuses == [e.status for e in estimates]
    np.testing.assert_array_equal(run.qps, [e.qps for e in estimates])
    assert np.isnan(run.delayed[0]).all()
    np.testing.assert_array_equal(run.delayed[1:], [e.delayed for e in estimates[1:]])
    assert len(run.times) == count == other.time
    assert run.times.min() > 0.0
    assert np.isnan(run.solve_times).all()
    assert run.share(Status.MISSING) > 0.0


def test_records_and_samples_in_turn():
    model = made("inputs")
    one, other = estimator(model, delay=1), estimator(model, delay=1)
    empty = other.run(np.empty((0, 1)), np.empty((0, 2)))
    assert (len(empty), empty.states.shape, empty.delayed.shape) == (0, (1, 2), (0, 2))
    assert empty.statuses == []
    for first, last in ((0, 3), (3, 4), (4, 4), (4, 15), (15, STEPS)):
        Y, U = model.Y[first:last], model.U[first:last]
        kept, start = other.state.copy(), other.observer_state
        if first == 3:
            run = qpmhe.Run.of(kept, [other.update(Y[0], U[0])], observer_start=start)
        else:
            run = other.run(Y[::-1][::-1], np.asfortranarray(U))
        expected = [one.update(y, u) for y, u in zip(Y, U, strict=True)]
        np.testing.assert_array_equal(run.states, [kept, *(e.state for e in expected)])
        np.testing.assert_array_equal(
            run.observer_states, [start, *(e.observer_state for e in expected)]
        )
        np.testing.assert_array_equal(other.state, one.state)
        assert other.time == one.time
    equal(other.amend(STEPS - 2, [0.3]), one.amend(STEPS - 2, [0.3]))


def test_a_record_with_covariances():
    model = made("reactor euler")
    expected, found = (mhe.run(model.Y, covariances=True) for mhe in both(model))
    np.testing.assert_allclose(found.covariances, expected.covariances, rtol=1e-9)


def test_a_record_leaves_the_snapshot_that_its_samples_leave():
    Y, dropped = case_of("pendulum", "tight")[0].record(1, STEPS), set()
    for count in range(1, STEPS):
        one, other = with_sets("pendulum", "tight"), with_sets("pendulum", "tight")
        one.run(Y[:count])
        for y in Y[:count]:
            estimate = other.update(y)
        dropped.add(estimate.dropped)
        assert pickle.dumps(one.state_dict()) == pickle.dumps(other.state_dict())
    assert len(dropped) > 1


@pytest.mark.parametrize("name", ["wide", "reactor rk4", "n=3", "n=25"])
def test_covariances(name):
    model = made(name)
    pair, Y = both(model, max_qps=None), spoilt(model, 6)
    for mhe in pair:
        with pytest.raises(InvalidInputError, match="no estimate yet"):
            mhe.covariances()
    for t in range(12):
        weight = 3.0 * np.eye(model.system.p) if t % 3 == 0 else None
        dt = 0.06 if model.system.dt and t in (2, 3, 9) else None
        for mhe in pair:
            mhe.update(Y[t], dt=dt, noise_weight=weight)
            if t % 4 == 3:
                mhe.amend(t - 1, model.Y[t - 1])
        expected, found = (mhe.covariances() for mhe in pair)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())
    pair[1].reset()
    with pytest.raises(InvalidInputError, match="no estimate yet"):
        pair[1].covariances()


def test_covariances_with_sets_discount_and_failures():
    for mhe in (with_sets("reactor", "box", e, max_qps=None) for e in ("python", "compiled")):
        values = []
        for y in case_of("reactor", "box")[0].record(1, 12):
            mhe.update(y)
            values.append(mhe.covariances()[-1])
        if mhe.engine == "python":
            expected = values
    np.testing.assert_allclose(values, expected, rtol=1e-6)
    model = made("wide")
    cost = qpmhe.QuadraticCost(
        prior=model.cost.prior, disturbance=model.cost.disturbance, noise=model.cost.noise,
        discount=0.7,
    )
    for t, pair in enumerate([both(model, cost=cost)] * 9):
        for mhe in pair:
            mhe.update(model.Y[t])
        np.testing.assert_allclose(pair[1].covariances(), pair[0].covariances(), rtol=1e-8)
    pair = both(fragile("logarithm"), max_qps=0)
    for y in (0.1, -2000.0, 0.1):
        for mhe in pair:
            mhe.update([y])
    for mhe in pair:
        with pytest.raises(InvalidInputError, match="finite"):
            mhe.covariances()


def test_reset_starts_anew():
    model = made("wide")
    mhe, Y = estimator(model, warm_start=True), spoilt(model, 9)
    first = [mhe.update(y) for y in Y]
    mhe.reset()
    assert mhe.time == 0
    np.testing.assert_array_equal(mhe.state, model.start)
    for expected, y in zip(first, Y, strict=True):
        equal(mhe.update(y), expected)
    mhe.reset([0.3, -0.2])
    twin = qpmhe.MovingHorizonEstimator(
        model.system, model.observer, model.cost, horizon=model.horizon,
        initial_state=[0.3, -0.2], engine="compiled", max_qps=2, warm_start=True,
    )
    for y in Y:
        equal(mhe.update(y), twin.update(y))
