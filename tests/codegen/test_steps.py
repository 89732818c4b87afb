"""The C step where Python is no oracle: time budgets, LAPACK, damaged snapshots, batches."""

import ctypes

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen import write
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError
from qpmhe.estimation.snapshot import read, written

from .cases import case

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]
TIME_UP = Status.CANDIDATE | Status.TIME_UP


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
def test_the_ladder_keeps_its_promise_whenever_the_time_is_up(infeasible):
    one = case("tank conditions").with_options(infeasible=infeasible)
    for budget in (0.5, 1.5, 2.5, 4.5, 8.5, 30.5):
        up, mhe = 0, one.estimator("compiled", time_budget=budget)
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
        assert (estimate.status, estimate.qps) == (TIME_UP, 0)
        np.testing.assert_array_equal(estimate.trajectory, estimate.candidate)
    Y, U = (np.array([sample[key] for sample in one.samples]) for key in ("y", "u"))
    assert (mhe.run(Y, U).flags == TIME_UP.value).all()
    batch = qpmhe.BatchEstimator(
        one.system, one.observer, one.cost, engine="compiled", members=3,
        initial_states=one.start, time_budget=1e-12, **one.options,
    )
    for t in range(4):
        estimate = batch.update(np.tile(Y[t], (3, 1)), np.tile(U[t], (3, 1)))
        np.testing.assert_array_equal(estimate.trajectories, estimate.candidates)


@pytest.mark.parametrize("name", ["many states", "many states, dense"])
def test_only_the_engine_uses_lapack(name, tmp_path):
    compiled = case(name).estimator("compiled")
    assert compiled._engine._library.layout.lapack
    header, _ = write(compiled, tmp_path)
    assert "#define MHE_LAPACK 0" in header.read_text()
    assert not case("inputs").estimator("compiled")._engine._library.layout.lapack


def test_a_hessian_that_is_not_finite_keeps_the_candidate():
    """LAPACK gets infinities: the factorisation fails, and the step goes on."""
    casadi = pytest.importorskip("casadi")
    n = 42
    system = qpmhe.from_casadi(
        lambda x: 0.5 * x + 1e-3 * casadi.sin(1e150 * x), lambda x: x[:3], n=n, compiled=False
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=1e20 * np.eye(n), noise=np.eye(3))
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.1 * np.eye(n, 3)), cost, horizon=4, initial_state=np.ones(n),
        engine="compiled",
    )
    assert mhe._engine._library.layout.lapack
    for y in np.random.default_rng(1).normal(size=(7, 3)):
        found = mhe.update(y)
        assert found.status == Status.CANDIDATE | Status.SOLVER_FAILED
        assert found.cost == found.candidate_cost
        assert np.isfinite(found.trajectory).all()


def test_curved_sets_of_more_outputs_than_states():
    """Where the set bends under a step, the compiled one finds the same cost all the same."""
    one, bent, points = case("more outputs than states"), 0, np.zeros(2)
    python, compiled = one.estimator("python"), one.estimator("compiled")
    for sample in one.samples:
        expected, found = python.update(**sample), compiled.update(**sample)
        assert found.cost <= found.candidate_cost
        points += expected.nearest_points, found.nearest_points
        if Status.CANDIDATE_OUTSIDE in expected.status and expected.corrections > 0:
            bent += 1
            assert found.improved == expected.improved
            assert found.cost == pytest.approx(expected.cost, rel=1e-6, abs=1e-6)
    assert bent > 2
    assert points[1] <= 1.2 * points[0]  # a search that comes no nearer is given up


def taken(name, count):
    """The compiled estimator of a case behind so many samples, and its state."""
    one = case(name)
    mhe = one.estimator("compiled")
    for t, sample in enumerate(one.samples[:count]):
        mhe.update(**sample)
        if t in one.changes:
            mhe.set(**one.changes[t])
    return mhe, read(mhe.state_dict())


def refused(mhe, state, match):
    before = mhe._engine._memory.tobytes(), mhe._engine.usual
    with pytest.raises(InvalidInputError, match=match):
        mhe.load_state_dict(written(state))
    assert before == (mhe._engine._memory.tobytes(), mhe._engine.usual)


def test_damaged_conditions_are_refused():
    for part in ("noise_weight", "disturbances", "parameters", "own sides", "own"):
        mhe, state = taken("tank conditions", 12)
        stages = state["memory"].view(mhe._engine._memory.dtype)[0]["stages"]
        if part == "own":
            stages["has_own_disturbance"][0] = 2
        elif part == "own sides":
            at = int(np.argmax(stages["has_own_w"]))
            assert stages["has_own_w"][at]
            stages["own_w"]["upper"][at, 0] = stages["own_w"]["lower"][at, 0] - 1.0
        elif part == "disturbances":
            value = state["usual"][part]
            value["upper"][0] = value["lower"][0] - 1.0
        else:
            state["usual"][part].flat[0] = np.nan
        refused(mhe, state, "the state is")


@pytest.mark.parametrize("name", ["extended prior", "unscented prior", "steady prior with gaps"])
def test_a_snapshot_with_another_covariance_is_refused(name):
    mhe, state = taken(name, 8)
    case(name).estimator("compiled").load_state_dict(written(state))
    for field, factor, what in (
        ("covariance_end", 1.001, "observer"), ("stages", 1.001, "observer"),
        ("last_good_covariance", np.nan, "finite"),
    ):
        damaged = state | {"memory": state["memory"].copy()}
        record = damaged["memory"].view(mhe._engine._memory.dtype)[0]
        array = record["stages"]["covariance"][1] if field == "stages" else record[field]
        array *= factor
        refused(mhe, damaged, what)


@pytest.mark.parametrize("name", ["extended prior", "unscented", "injection"])
def test_each_member_of_a_batch_is_a_single_estimator(name):
    one = case(name)
    Y, U = (np.array([sample[key] for sample in one.samples]) for key in ("y", "u"))
    Y = np.stack((Y, Y + 0.05))
    batch = qpmhe.BatchEstimator(
        one.system, one.observer, one.cost, members=2, initial_states=one.start,
        engine="compiled", **one.options,
    )
    assert batch.mode == "compiled"
    run = batch.run(Y, np.stack((U, U)))
    for k in range(2):
        alone = one.estimator("compiled").run(Y[k], U)
        np.testing.assert_array_equal(run.states[k], alone.states)
        np.testing.assert_array_equal(run.filtered[k], alone.filtered)
