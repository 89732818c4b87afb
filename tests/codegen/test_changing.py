"""What a sample of its own or a change leaves behind in the C step: undoing, and time budgets."""

import ctypes

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.estimation.snapshot import read, written

from .cases import CASES, case

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]


@pytest.mark.parametrize("name", CASES)
def test_a_sample_that_is_undone_leaves_nothing(name):
    """Taken twice, with a step back between, a sample gives the same memory."""
    one = case(name)
    mhe = one.estimator("compiled")
    engine = mhe._engine
    for t, sample in enumerate(one.samples):
        before = engine._memory.tobytes()
        mhe.update(**sample)
        after = engine._memory.tobytes()
        engine._library.undo(*engine._undoing)
        assert engine._memory.tobytes() == before, t
        mhe.update(**sample)
        assert engine._memory.tobytes() == after, t
        if t in one.changes:
            mhe.set(**one.changes[t])


@pytest.mark.parametrize(
    "name", ["inputs conditions", "tank conditions", "states, conditions", "extended conditions"]
)
def test_the_same_covariances(name):
    one = case(name)
    pair = [one.estimator(engine) for engine in ("python", "compiled")]
    for t, sample in enumerate(one.samples):
        for mhe in pair:
            mhe.update(**sample)
            if t in one.changes:
                mhe.set(**one.changes[t])
        if t % 4 == 2:
            expected, found = (mhe.covariances() for mhe in pair)
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8 * abs(expected).max())


class Clock:
    """A clock in place of the C step's, which goes on by one at each look."""

    def __init__(self, mhe):
        self.looks = 0
        self._function = ctypes.CFUNCTYPE(ctypes.c_double)(self._look)
        record = mhe._engine._tools.record
        record["clock"] = ctypes.cast(self._function, ctypes.c_void_p).value

    def _look(self):
        self.looks += 1
        return float(self.looks)


@pytest.mark.parametrize("name", ["inputs converged", "huber", "inputs reinitialized"])
def test_no_qp_is_begun_when_the_time_is_up(name):
    """Without inequalities, the clock is looked at once before each QP."""
    one = case(name).with_options(max_qps=None, tolerance=1e-15)
    free = one.estimator("compiled")
    for sample in one.samples[:6]:
        free.update(**sample)
    for budget in (0.5, 1.5, 2.5):
        mhe = one.estimator("compiled", time_budget=budget)
        mhe.load_state_dict(free.state_dict())
        clock, reference = Clock(mhe), one.estimator("compiled", max_qps=int(budget))
        reference.load_state_dict(free.state_dict())
        estimate, expected = (each.update(**one.samples[6]) for each in (mhe, reference))
        assert estimate.qps == int(budget)
        assert Status.TIME_UP in estimate.status
        assert clock.looks == 2 + estimate.qps  # at the start, before each QP and one more
        if budget > 1.0:  # without any QP there is no warm start either
            np.testing.assert_array_equal(estimate.trajectory, expected.trajectory)


@pytest.mark.parametrize("infeasible", ["drop_rows", "keep_candidate"])
@pytest.mark.parametrize("budget", [0.5, 1.5, 2.5, 4.5, 8.5, 30.5])
def test_the_ladder_keeps_its_promise_whenever_the_time_is_up(budget, infeasible):
    one, up = case("tank conditions").with_options(infeasible=infeasible), 0
    mhe = one.estimator("compiled", time_budget=budget)
    for sample in one.samples:
        clock = Clock(mhe)
        estimate = mhe.update(**sample)
        assert estimate.cost <= estimate.candidate_cost
        assert (Status.IMPROVED in estimate.status) != (Status.CANDIDATE in estimate.status)
        up += Status.TIME_UP in estimate.status
        assert clock.looks < 1000
    assert up > 0 or budget > 30.0


def test_a_budget_that_is_spent_at_once_leaves_the_candidate():
    one = case("inputs")
    mhe = one.estimator("compiled", time_budget=1e-12)
    for sample in one.samples:
        estimate = mhe.update(**sample)
        assert estimate.status == Status.CANDIDATE | Status.TIME_UP
        np.testing.assert_array_equal(estimate.trajectory, estimate.candidate)
        assert estimate.qps == 0
    run = mhe.run(*(np.array([sample[key] for sample in one.samples]) for key in ("y", "u")))
    assert (run.flags == (Status.CANDIDATE | Status.TIME_UP).value).all()


def test_a_batch_has_a_budget_of_its_own_steps():
    one = case("inputs")
    options = one.options | {"engine": "compiled", "members": 3, "initial_states": one.start}
    batch = qpmhe.BatchEstimator(one.system, one.observer, one.cost, **options, time_budget=1e-12)
    for sample in one.samples[:4]:
        estimate = batch.update(*(np.tile(sample[key], (3, 1)) for key in ("y", "u")))
        np.testing.assert_array_equal(estimate.trajectories, estimate.candidates)


@pytest.mark.parametrize("name", ["tank conditions", "inputs changes"])
@pytest.mark.parametrize("part", ["noise_weight", "disturbances", "parameters", "own sides", "own"])
def test_damaged_conditions_are_refused(name, part):
    one = case(name)
    mhe = one.estimator("compiled")
    for t, sample in enumerate(one.samples[:12]):
        mhe.update(**sample)
        if t in one.changes:
            mhe.set(**one.changes[t])
    state = read(mhe.state_dict())
    memory = state["memory"].view(mhe._engine._memory.dtype)[0]
    stages, usual = memory["stages"], state["usual"]
    if part in usual:
        value = usual[part]
        if isinstance(value, dict):
            value["upper"][0] = value["lower"][0] - 1.0
        else:
            value.flat[0] = np.nan
    elif part == "own sides" and stages.dtype.names.count("own_w"):
        at = int(np.argmax(stages["has_own_w"]))
        assert stages["has_own_w"][at]
        stages["own_w"]["upper"][at, 0] = stages["own_w"]["lower"][at, 0] - 1.0
    elif part == "own":
        stages["has_own_disturbance"][0] = 2
    else:
        pytest.skip("it has none")
    before = mhe._engine._memory.tobytes(), mhe._engine.usual
    with pytest.raises(qpmhe.errors.InvalidInputError, match="the state is"):
        mhe.load_state_dict(written(state))
    assert before == (mhe._engine._memory.tobytes(), mhe._engine.usual)
