"""How much work a step does, counted and not timed, and what remains of the time budget."""

import subprocess
import sys
import tracemalloc

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.solvers import Backend, RawSolution, Solver, create

from .untraced import untraced

REACTOR = qpmhe.models.batch_reactor()
MEASUREMENTS = REACTOR.scenario.simulate(0, 60).measurements


def estimator(system=None, **options):
    return qpmhe.MovingHorizonEstimator(
        system or REACTOR.system, REACTOR.observer, REACTOR.cost,
        **{"horizon": 10, "initial_state": [3.0, 0.0], "backend": "banded"} | options,
    )


@pytest.mark.parametrize("max_qps", [0, 1, 2])
def test_the_model_is_evaluated_once_at_each_new_observer_state(max_qps):
    single, many = {}, {}

    def counting(name, function):
        def counted(x):
            counts = single if x.ndim == 1 else many
            counts[name] = counts.get(name, 0) + 1
            nothing = np.empty((*x.shape[:-1], 0))
            return function.batch(x, nothing) if x.ndim > 1 else function(x, nothing)

        return counted

    given = REACTOR.system
    mhe = estimator(qpmhe.System(
        untraced(counting("f", given.f)), untraced(counting("h", given.h)), n=2, p=1,
        f_jacobian=counting("A", given.f_jacobian), h_jacobian=counting("C", given.h_jacobian),
    ), max_qps=max_qps)
    for y in MEASUREMENTS[:40]:
        mhe.update(y)
    single.clear()
    many.clear()
    for y in MEASUREMENTS[40:]:
        mhe.update(y)
    assert not many  # what is not traced is called state by state
    # One state a sample: the rest of the window is remembered. And a window of ten a trial.
    assert single["f"] == single["h"] == 20 * (1 + 10 * max_qps)
    # The first QP needs no Jacobians but those of the newest stage.
    expected = 20 * (1 + 10 * (max_qps - 1)) if max_qps else 0
    assert single.get("A", 0) == single.get("C", 0) == expected


def test_memory_does_not_grow():
    mhe = estimator(max_qps=2, warm_start=True)

    def steps(count):
        for _ in range(count):
            for y in MEASUREMENTS:
                mhe.update(y)

    steps(10)
    tracemalloc.start()
    steps(3)
    before = tracemalloc.get_traced_memory()[0]
    steps(12)
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 10_000  # bytes: less than one object a step


# What the steps take now, and up to a tenth of slack: a guard against creeping growth that no
# clock has to see.
@pytest.mark.parametrize(("options", "most"), [
    ({"max_qps": 0}, 92), ({"max_qps": 1}, 132), ({"max_qps": 2}, 222),
    ({"engine": "compiled", "backend": "auto"}, 12),
], ids=["no QP", "one QP", "two QPs", "compiled"])
def test_a_step_takes_no_more_calls_than_it_did(options, most):
    mhe, counts = estimator(**options), []
    if mhe.engine != options.get("engine", "python"):
        pytest.skip("no C compiler")
    for y in MEASUREMENTS:
        calls = [0]

        def count(frame, event, argument, calls=calls):
            calls[0] += event in ("call", "c_call")

        sys.setprofile(count)
        mhe.update(y)
        sys.setprofile(None)
        counts.append(calls[0])
    assert np.median(counts[20:]) <= most


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

    for module in ("estimator", "engine", "optimizer", "outcome"):
        monkeypatch.setattr(f"qpmhe.estimation.{module}.perf_counter", lambda: Clock.now)
    qpmhe.solvers.register(Backend("ticking", Ticking, "a test's"))
    yield Clock
    qpmhe.solvers.unregister("ticking")


def test_each_qp_gets_what_remains(clock):
    ticking = {"backend": "ticking", "tolerance": 1e-15}
    mhe = estimator(**ticking, max_qps=9, time_budget=1.0)
    for y in MEASUREMENTS[:12]:
        estimate = mhe.update(y)
        assert clock.limits == [1.0, 0.625, 0.25]
        assert estimate.qps == 3
        assert Status.TIME_UP in estimate.status
        clock.limits.clear()
    assert Status.TIME_UP in mhe.amend(mhe.time - 2, MEASUREMENTS[0]).status
    assert clock.limits == [1.0, 0.625, 0.25]
    estimator(**ticking, max_qps=3).update(MEASUREMENTS[0])
    assert clock.limits[3:] == [None, None, None]


GROWTH = """
import itertools
import sys
import numpy as np
import qpmhe

A = np.array([[1.0, 0.1], [-0.1, 0.9]])
for backend, sets in itertools.product(sys.argv[1:], ({}, {
    "states": qpmhe.Box([-1.0, -1.0], [0.55, 1.0]),
    "disturbances": qpmhe.Box([-0.05, 0.0], [0.05, 0.0]),
})):
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1, **sets),
        qpmhe.Luenberger([[0.3], [0.1]]),
        qpmhe.QuadraticCost(prior=np.eye(2), disturbance=9.0 * np.eye(2), noise=[[4.0]]),
        horizon=4, initial_state=[0.5, 0.0], backend=backend, max_qps=2,
    )
    before = set(sys.modules)
    for y in (1.0, 0.9, np.nan, 0.4, 0.2, 0.1, 0.0):
        mhe.update([y])
    print("grown", backend, sorted(set(sys.modules) - before))
"""


@pytest.mark.parametrize("part", range(5))
def test_no_update_imports_anything(part):
    """In a process of a few backends, which begins with no more than the package."""
    names = qpmhe.solvers.available()[part::5]
    done = subprocess.run(
        [sys.executable, "-c", GROWTH, *names], capture_output=True, text=True, check=True,
        timeout=300,
    )
    found = [line for line in done.stdout.splitlines() if line.startswith("grown ")]
    assert found == [f"grown {name} []" for name in names for _ in range(2)]
