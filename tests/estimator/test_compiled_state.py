"""What a compiled estimator remembers, and what it hands out."""

import copy
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError
from qpmhe.estimation.snapshot import read
from tests.codegen.cases import case

from .test_compiled import NAN, both_engines, equal, loaded, made, spoilt, system_of

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]


@both_engines
def test_late_measurements_are_no_samples_with_a_far_observer(engine):
    system = system_of(lambda x: 0.9 * x, lambda x: x, n=1)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.0]), qpmhe.QuadraticCost(prior=1, disturbance=1, noise=1),
        horizon=3, initial_state=[0.0], engine=engine,
    )
    mhe.update([1e3])
    for _ in range(4):
        assert Status.OBSERVER_FAR not in mhe.amend(0, [1e3]).status
    loaded(mhe, copy.deepcopy(mhe))
    assert Status.OBSERVER_FAR not in mhe.update([1e3]).status
    assert Status.OBSERVER_FAR in mhe.update([1e3]).status


@both_engines
def test_a_snapshot_holds_what_was_learnt_and_nothing_else(engine):
    one = case("inputs")
    mhe = one.estimator(engine)
    for sample in one.samples[:7]:
        mhe.update(**sample)
    before = pickle.dumps(mhe.state_dict())
    junk = [np.full(k, 7.7) for k in range(1, 400)]  # memory that is used again
    del junk
    assert pickle.dumps(mhe.state_dict()) == before


def test_damaged_snapshots_are_refused_whole():
    one = case("reactor")
    mhe, twin = (one.estimator("compiled") for _ in range(2))
    for sample in one.samples[:2]:
        mhe.update(**sample)
        twin.update(**sample)
    kept = mhe.state_dict()
    good = read(kept)
    memory = good["memory"]
    damaged = [{}, *({**good, "problem": one} for one in (None, (2, 1, 0, 99)))]
    damaged += [{**good, "engine": "python"}, *({**good, "memory": one} for one in (
        None, "abc", memory[:-1], memory[None], np.full_like(memory, 255), [300] * memory.size,
    ))]
    for name, value in (
        ("history", NAN), ("z_end", NAN), ("last_good", np.inf), ("trajectory", NAN),
        ("is_observed", 2), ("is_complete", 0), ("step", -1.0), ("first", 9), ("far", -1),
    ):
        changed = memory.copy()
        record = changed.view(mhe._engine._memory.dtype)
        (record if name in record.dtype.names else record["stages"])[name].flat[0] = value
        damaged.append({**good, "memory": changed})
    for state in damaged:
        with pytest.raises(InvalidInputError):
            mhe._engine.load_state_dict(state)
    with pytest.raises(InvalidInputError, match="the state "):
        mhe.load_state_dict(one.estimator("python").state_dict())
    for sample in one.samples[2:6]:
        equal(mhe.update(**sample), twin.update(**sample))


def test_damaged_numbers_do_no_harm():
    """Damage is refused, or too small to matter: the last digits, or what is never read."""
    one, generator, taken = case("inputs"), np.random.default_rng(0), 0
    mhe, twin = (one.estimator("compiled", warm_start=True) for _ in range(2))
    for sample in one.samples[:8]:
        mhe.update(**sample)
    good = mhe.state_dict()
    memory = good["memory"].view(mhe._engine._memory.dtype)
    for k in range(200):
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
        for sample in one.samples[8:11]:
            found, expected = mhe.update(**sample), twin.update(**sample)
            np.testing.assert_allclose(found.trajectory, expected.trajectory, rtol=1e-3)
            assert found.status == expected.status
    assert 10 < taken < 190


@pytest.mark.parametrize("name", ["wide", "N=2", "n=1"])
def test_a_record_is_its_samples(name):
    """Longer than what is handed to C at once, with missing samples, and in several calls."""
    one, options = made(name), {"warm_start": True, "delay": 2}
    samples = spoilt(one, np.random.default_rng(4), share=0.1)
    fields = {field: np.resize([
        sample[field] if sample[field] is not None else np.full(one.system.p, NAN)
        for sample in samples
    ], (600, size)) for field, size in (("y", one.system.p), ("u", one.system.m)) if size}
    single, whole = (one.estimator("compiled", **options) for _ in range(2))
    for first, last in ((0, 550), (550, 550), (550, 551), (551, 600)):
        start, observer = single.state, single.observer_state
        rows = [array[first:last] for array in fields.values()]
        run = whole.run(*(np.asfortranarray(row[::-1][::-1]) for row in rows))
        estimates = [single.update(*row) for row in zip(*rows, strict=True)]
        expected = qpmhe.Run.of(start, estimates, observer_start=observer)
        for field in ("states", "observer_states", "filtered", "costs", "candidate_costs", "flags",
                      "qps", "delayed"):
            np.testing.assert_array_equal(getattr(run, field), getattr(expected, field), field)
        assert len(run.times) == len(run) == last - first
        assert (run.times > 0.0).all()
        assert np.isnan(run.solve_times).all()
        assert whole.time == single.time
    runs = [mhe.run(*rows, covariances=True).covariances for mhe in (single, whole)]
    np.testing.assert_array_equal(*runs)
