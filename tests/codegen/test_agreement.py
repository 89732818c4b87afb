"""The compiled step and the Python one give the same estimates, with every feature."""

import pickle
import re

import numpy as np
import pytest

from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler, optimisation
from qpmhe.errors import InvalidInputError
from qpmhe.estimation.limits import NEAREST_POINTS, RESTORING

from .cases import CASES, FEATURES, STEPS, case, excluding, vanishing

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]

ARRAYS = (
    "state", "filtered", "trajectory", "candidate", "observer_state", "disturbances", "noises",
)
EVENTS = (
    "status", "qps", "dropped", "time", "corrections", "nearest_points", "rejected_sensors",
)


def same(found, expected, tolerance, name):
    """Equality up to rounding, relative to the largest of the finite numbers."""
    assert found.shape == expected.shape, name
    size = 1.0 + np.abs(expected[np.isfinite(expected)]).max(initial=0.0)
    np.testing.assert_allclose(
        found, expected, rtol=tolerance, atol=tolerance * size, err_msg=name
    )


def agree(expected, found, tolerance):
    """Equality up to rounding of all that two estimates of a window say."""
    for name in EVENTS:
        assert getattr(found, name) == getattr(expected, name), name
    for name in ARRAYS:
        one, other = getattr(expected, name), getattr(found, name)
        assert (one is None) == (other is None), name
        if one is None:
            continue
        same(other, one, tolerance, name)
    for name in ("cost", "candidate_cost", "restored_cost"):
        one, other = getattr(expected, name), getattr(found, name)
        assert other == pytest.approx(one, rel=tolerance, abs=tolerance, nan_ok=True), name
    if Status.MODEL_FAILED in found.status or "constraints[" in expected.message:
        assert _words(found.explain()) == _words(expected.explain())
        assert pickle.loads(pickle.dumps(found)).message == found.message
    restored = Status.RESTORED in found.status
    assert found.cost <= (found.restored_cost if restored else found.candidate_cost)


def _words(text):
    """A message without the numbers in it, which are equal up to rounding."""
    return re.sub(r"-?\d+\.\d*(e[+-]\d+)?", "#", text)


def _interrupt(_time):
    raise KeyboardInterrupt


def same_estimates(name, monkeypatch):
    """Sample by sample, with a snapshot in the middle, and with a late measurement.

    Whatever is interrupted is undone bit for bit, and gives the same when it is taken again.
    """
    one = case(name)
    reference, compiled = one.estimator("python"), one.estimator("compiled")
    assert (reference.engine, compiled.engine) == ("python", "compiled")
    # Code that the compiler refuses there is left for the next level, where parts may be missing.
    assert optimisation(compiled._engine._library.path).startswith("-O3")
    for t, sample in enumerate(one.samples):
        engine = compiled._engine
        before = engine._memory.tobytes()
        with monkeypatch.context() as patch:
            patch.setattr(engine, "_collect", _interrupt)
            with pytest.raises(KeyboardInterrupt):
                compiled.update(**sample)
        assert engine._memory.tobytes() == before
        agree(reference.update(**sample), compiled.update(**sample), one.tolerance)
        if t in one.changes:
            changed = (mhe.set(**one.changes[t]) for mhe in (reference, compiled))
            agree(*changed, one.tolerance)
        if t == len(one.samples) // 2:
            state = compiled.state_dict()
            compiled = one.estimator("compiled")
            compiled.load_state_dict(state)
        if (t % 8 == 2 and t < STEPS) or t == len(one.samples) - 1:
            same_covariances(reference, compiled)
    time = len(one.samples) - min(2, one.options["horizon"])
    late = np.resize(one.samples[time]["y"], one.system.p) + 0.1
    agree(reference.amend(time, late), compiled.amend(time, late), one.tolerance)
    same_covariances(reference, compiled)


def same_covariances(reference, compiled):
    try:
        expected = reference.covariances()
    except InvalidInputError as error:  # where the model has no finite values
        with pytest.raises(InvalidInputError, match=str(error)):
            compiled.covariances()
        return
    found = compiled.covariances()
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7 * np.abs(expected).max())


def _agreements(feature):
    """A test of its own for each feature: a sample has cases of all of them."""

    @pytest.mark.parametrize("name", FEATURES[feature])
    def test(name, monkeypatch):
        same_estimates(name, monkeypatch)

    return test


for _feature in FEATURES:
    globals()[f"test_the_same_estimates_{_feature}"] = _agreements(_feature)


@pytest.mark.usefixtures("as_users_compile")
@pytest.mark.parametrize("name", list(CASES)[::6])
def test_the_same_runs(name):
    """Whole records, of measurements and inputs only."""
    one = case(name)
    Y = np.array([np.resize(sample["y"], one.system.p) for sample in one.samples])
    U = np.array([sample["u"] for sample in one.samples]) if "u" in one.samples[0] else None
    expected, found = (one.estimator(engine).run(Y, U) for engine in ("python", "compiled"))
    np.testing.assert_array_equal(found.flags, expected.flags)
    np.testing.assert_array_equal(found.rejected_sensors, expected.rejected_sensors)
    for array in ("states", "filtered", "observer_states", "costs", "candidate_costs"):
        same(getattr(found, array), getattr(expected, array), one.tolerance, array)
    restored = (found.flags & Status.RESTORED.value) > 0
    assert restored.any() == ("restored" in name)
    assert (found.flags & Status.RESTARTED.value).any() == ("restarted" in name)
    assert (found.costs <= found.candidate_costs)[~restored].all()


def test_the_same_derivatives_behind_a_change():
    """Of the window as the compiled step has it, which a second run of the observer misses."""
    one, found = case("angles across the seam"), []
    for engine in ("python", "compiled"):
        mhe = one.estimator(engine)
        for t, sample in enumerate(one.samples[:17]):
            mhe.update(**sample)
            if t in one.changes:
                mhe.set(**one.changes[t])
        found.append(mhe.sensitivity())
    for name in ("prior_weight", "discount", "measurements"):
        expected, compiled = (getattr(each, name) for each in found)
        same(np.asarray(compiled), np.asarray(expected), 1e-9, name)
    assert np.abs(found[0].discount).max() > 0.01


def test_vanishing_weights():
    """Where a loss leaves a singular QP, its flat directions are arbitrary; both engines step."""
    one = vanishing()
    reference, compiled = one.estimator("python"), one.estimator("compiled")
    for sample in one.samples:
        expected, found = reference.update(**sample), compiled.update(**sample)
        assert Status.IMPROVED in found.status
        assert Status.SOLVER_FAILED not in expected.status | found.status
        assert found.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)
        assert found.cost < 1.2 * expected.cost


@pytest.mark.parametrize(("infeasible", "more"), [("drop_rows", 0), ("restore", 2 * RESTORING)])
def test_searches_for_feasible_points_end(infeasible, more):
    """Of all QPs for feasible points in a step, both engines solve at most as many as they say."""
    one, most = excluding().with_options(infeasible=infeasible), 0.0
    reference, compiled = one.estimator("python"), one.estimator("compiled")
    for sample in one.samples:
        for found in (reference.update(**sample), compiled.update(**sample)):
            allowed = NEAREST_POINTS * (1 + found.qps)
            assert found.nearest_points <= allowed + more
            assert Status.ROWS_DROPPED in found.status
            most = max(most, found.nearest_points / allowed)
    assert most >= 1.0  # else this test says nothing
    assert (most > 1.0) == (more > 0)


@pytest.mark.parametrize("cap", [1, 2, 4])
@pytest.mark.parametrize("name", ["constraints and soft sets", "soft disturbances and noises"])
def test_the_promise_with_capped_iterations(name, cap):
    """Caps count iterations of each engine's own solver: estimates differ, the promise holds.

    J of the compiled step's trajectory is evaluated once more by the Python step's problem.
    """
    one, stopped = case(name), 0
    reference, compiled = (
        one.estimator(engine, max_solver_iterations=cap) for engine in ("python", "compiled")
    )
    for sample in one.samples:
        found = compiled.update(**sample)
        expected = reference.update(**sample)
        for each in (found, expected):
            assert each.cost <= each.candidate_cost
            assert each.improved == (each.cost < each.candidate_cost)
        problem = compiled._engine.solved().problem
        if not found.dropped:  # a trajectory outside of sets has no finite J there
            again = problem.evaluate(found.trajectory.copy(), roll_out=False)
            assert again.cost == pytest.approx(found.cost, rel=1e-9)
        assert problem.candidate.cost == pytest.approx(found.candidate_cost, rel=1e-9)
        stopped += Status.SOLVER_STOPPED in found.status
        assert found.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)
    assert stopped
