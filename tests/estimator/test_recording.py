"""Recording the QPs of estimators: all are seen, and no estimate is changed by it."""

import numpy as np
import pytest

import qpmhe
from qpmhe.models.batch_reactor import batch_reactor
from qpmhe.solvers import SolverOptions, SolveStatus, available, backend, create
from qpmhe_solvers.files import load
from qpmhe_solvers.recorder import Recording

SYSTEM, OBSERVER, COST, SCENARIO = batch_reactor()
STEPS = 8
_, MEASUREMENTS = SCENARIO.simulate(0, STEPS)
# Bounds that the record drives the estimates into: those above leave one side open.
CONSTRAINED = qpmhe.System(
    lambda x: SYSTEM.f(x, np.zeros(0)), lambda x: SYSTEM.h(x, np.zeros(0)), n=2, p=1,
    states=qpmhe.Box([0.0, 0.0], [3.2, np.inf]), disturbances=qpmhe.Box([-0.02] * 2, [0.02] * 2),
)


def estimator(system, name, **options):
    return qpmhe.MovingHorizonEstimator(
        system, OBSERVER, COST, horizon=6, initial_state=[3.0, 0.5], backend=name, **options,
    )


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@pytest.mark.parametrize(
    ("name", "system"),
    [("auto", SYSTEM), ("banded", SYSTEM), *((name, CONSTRAINED) for name in available())],
    ids=lambda one: one if isinstance(one, str) else "",
)
def test_runs_are_the_same_with_and_without(name, system, tmp_path):
    expected = estimator(system, name, max_qps=2).run(MEASUREMENTS)
    with Recording(tmp_path, name, only="all", limit=1000) as recording:
        run = estimator(system, recording.backend, max_qps=2).run(MEASUREMENTS)
    # proxqp rounds as its memory happens to be aligned.
    rounding = 0.0 if name in ("auto", "banded") else 1e-7
    np.testing.assert_allclose(run.states, expected.states, rtol=rounding)
    np.testing.assert_allclose(run.costs, expected.costs, rtol=rounding)
    if system is SYSTEM:
        assert recording.seen == run.qps.sum() >= STEPS
    else:
        assert recording.seen > run.qps.sum()  # nearest points and corrections are QPs, too
    assert len(recording.files) == recording.seen
    if name == "auto" and system is CONSTRAINED:
        stored = [load(path) for path in recording.files]
        assert any(np.abs(one.solution.bound_duals).max() > 1e-3 for one in stored)


def test_what_failed_in_a_run_is_found_in_the_folder(tmp_path):
    with Recording(tmp_path, "daqp") as recording:
        run = estimator(CONSTRAINED, recording.backend, max_solver_iterations=1).run(MEASUREMENTS)
    failed = [qpmhe.Status.SOLVER_FAILED in status for status in run.statuses]
    stored = [load(path) for path in recording.files]
    assert len(stored) >= sum(failed) > 0
    for one in stored:
        assert one.solution.status is SolveStatus.FAILED
        assert one.options == SolverOptions(max_iterations=1)
        assert create("quadprog").solve(one.qp).status is SolveStatus.SOLVED


def test_a_batch_can_be_recorded(tmp_path):
    def run(name):
        return qpmhe.BatchEstimator(
            SYSTEM, OBSERVER, COST, members=3, horizon=6, initial_states=[3.0, 0.5],
            backend=name, max_qps=1,
        ).run(np.stack([MEASUREMENTS + shift for shift in (-0.1, 0.0, 0.1)]))

    with Recording(tmp_path, "auto", only="all", limit=1000) as recording:
        found = run(recording.backend)
    assert recording.seen == 3 * STEPS
    # With a backend of a name of its own the members are estimated one by one.
    np.testing.assert_allclose(found.states, run("auto").states, rtol=1e-9)


def test_steps_with_a_time_budget_are_recorded_after_them(tmp_path):
    with Recording(tmp_path, "osqp", only="all") as recording:
        mhe = estimator(SYSTEM, recording.backend, time_budget=60.0)
        mhe.run(MEASUREMENTS)
        assert not list(tmp_path.iterdir())
    assert len(recording.files) == STEPS
    assert backend(load(recording.files[0]).backend).name == "osqp"
