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


def run(system, name, **options):
    return qpmhe.MovingHorizonEstimator(
        system, OBSERVER, COST, horizon=6, initial_state=[3.0, 0.5], backend=name, **options
    ).run(MEASUREMENTS)


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@pytest.mark.parametrize(
    ("name", "system"),
    [("auto", SYSTEM), *((name, CONSTRAINED) for name in available())],
    ids=lambda one: one if isinstance(one, str) else "",
)
def test_runs_are_the_same_with_and_without(name, system, tmp_path):
    expected = run(system, name, max_qps=2)
    with Recording(tmp_path, name, only="all", limit=1000) as recording:
        found = run(system, recording.backend, max_qps=2)
    # proxqp rounds as its memory happens to be aligned.
    rounding = 0.0 if name in ("auto", "banded") else 1e-7
    np.testing.assert_allclose(found.states, expected.states, rtol=rounding)
    np.testing.assert_allclose(found.costs, expected.costs, rtol=rounding)
    # In sets, nearest points and corrections are QPs, too.
    assert recording.seen - found.qps.sum() == 0 if system is SYSTEM else recording.seen > STEPS
    assert len(recording.files) == recording.seen


def test_what_failed_in_a_run_is_found_in_the_folder(tmp_path):
    with Recording(tmp_path, "daqp") as recording:
        found = run(CONSTRAINED, recording.backend, max_solver_iterations=1)
    failed = [qpmhe.Status.SOLVER_FAILED in status for status in found.statuses]
    stored = [load(path) for path in recording.files]
    assert len(stored) >= sum(failed) > 0
    for one in stored:
        assert one.solution.status is SolveStatus.FAILED
        assert one.options == SolverOptions(max_iterations=1)
        assert create("quadprog").solve(one.qp).status is SolveStatus.SOLVED


def test_a_batch_and_steps_with_a_time_budget_are_recorded_after_them(tmp_path):
    with Recording(tmp_path, "osqp", only="all") as recording:
        qpmhe.BatchEstimator(
            SYSTEM, OBSERVER, COST, members=3, horizon=6, initial_states=[3.0, 0.5],
            backend=recording.backend, max_qps=1, time_budget=60.0,
        ).run(np.stack([MEASUREMENTS] * 3))
        assert not list(tmp_path.iterdir())
    assert recording.seen == 3 * STEPS
    assert backend(load(recording.files[0]).backend).name == "osqp"
