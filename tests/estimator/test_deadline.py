"""What remains of the time budget, and what waits for the first update."""

import subprocess
import sys

import pytest

import qpmhe
from qpmhe import Status
from qpmhe.estimation.subproblem import Subproblem
from qpmhe.solvers import Backend, RawSolution, Solver, create

SYSTEM, OBSERVER, COST, SCENARIO = qpmhe.models.batch_reactor()
MEASUREMENTS = SCENARIO.simulate(seed=0, steps=12).measurements


def estimator(**options):
    options = {"horizon": 5, "initial_state": [3.0, 0.1], "tolerance": 1e-15} | options
    return qpmhe.MovingHorizonEstimator(SYSTEM, OBSERVER, COST, backend="ticking", **options)


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on with each QP of the backend "ticking", and the limits of these."""

    class Clock:
        now, limits = 0.0, []

    inner = create("banded")

    class Ticking(Solver):
        def _solve(self, qp, start):
            Clock.limits.append(self.time_limit)
            Clock.now += 0.375
            # Half of the way, so that the sequence never converges.
            return RawSolution(0.5 * inner.solve(qp).d, False)

    for module in ("estimator", "engine", "optimizer"):
        monkeypatch.setattr(f"qpmhe.estimation.{module}.perf_counter", lambda: Clock.now)
    qpmhe.solvers.register(Backend("ticking", Ticking, "a test's"))
    yield Clock
    qpmhe.solvers.unregister("ticking")


def test_each_qp_gets_what_remains(clock):
    mhe = estimator(max_qps=9, time_budget=1.0)
    for y in MEASUREMENTS:
        estimate = mhe.update(y)
        assert clock.limits == [1.0, 0.625, 0.25]
        assert estimate.qps == 3
        assert Status.TIME_UP in estimate.status
        clock.limits.clear()
    assert Status.TIME_UP in mhe.amend(mhe.time - 2, MEASUREMENTS[0]).status
    assert clock.limits == [1.0, 0.625, 0.25]
    estimator(max_qps=3).update(MEASUREMENTS[0])
    assert clock.limits[3:] == [None, None, None]


def test_a_qp_that_is_ready_too_late_is_not_begun(clock, monkeypatch):
    mhe, made = estimator(max_qps=2, time_budget=1.0), Subproblem.at

    def slow(self, problem, trial):
        clock.now += 1.0
        return made(self, problem, trial)

    monkeypatch.setattr(Subproblem, "at", slow)
    estimate = mhe.update(MEASUREMENTS[0])
    assert clock.limits == []
    assert (estimate.qps, estimate.solve_time) == (0, 0.0)
    assert estimate.status == Status.CANDIDATE | Status.TIME_UP


GROWTH = """
import sys
import numpy as np
import qpmhe

A = np.array([[1.0, 0.1], [-0.1, 0.9]])
for sets in ({}, {
    "states": qpmhe.Box([-1.0, -1.0], [0.55, 1.0]),
    "disturbances": qpmhe.Box([-0.05, 0.0], [0.05, 0.0]),
}):
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1, **sets),
        qpmhe.Luenberger([[0.3], [0.1]]),
        qpmhe.QuadraticCost(prior=np.eye(2), disturbance=9.0 * np.eye(2), noise=[[4.0]]),
        horizon=4, initial_state=[0.5, 0.0], backend=sys.argv[1], max_qps=2,
    )
    before = set(sys.modules)
    for y in (1.0, 0.9, np.nan, 0.4, 0.2, 0.1, 0.0):
        mhe.update([y])
    print(sorted(set(sys.modules) - before))
"""


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_no_update_imports_anything(backend):
    """In a process of its own, which begins with no more than the package."""
    done = subprocess.run(
        [sys.executable, "-c", GROWTH, backend], capture_output=True, text=True, check=True,
        timeout=300,
    )
    assert done.stdout.splitlines()[-2:] == ["[]", "[]"]
