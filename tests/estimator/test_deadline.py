"""What remains of the time budget, what waits for the first update, and hostile backends."""

import json
import subprocess
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.solvers import Backend, RawSolution, Solution, Solver, SolveStatus, create

SYSTEM, OBSERVER, COST, SCENARIO = qpmhe.models.batch_reactor()
MEASUREMENTS = SCENARIO.simulate(seed=0, steps=12).measurements


def estimator(system=SYSTEM, **options):
    options = {"horizon": 5, "initial_state": [3.0, 0.1], "tolerance": 1e-15} | options
    return qpmhe.MovingHorizonEstimator(system, OBSERVER, COST, **options)


@pytest.fixture
def registered():
    """Registers backends until the test is over."""
    names = []

    def register(name, factory):
        qpmhe.solvers.register(Backend(name, factory, "a test's"))
        names.append(name)
        return name

    yield register
    for name in names:
        qpmhe.solvers.unregister(name)


class Clock:
    """A clock that goes on when it is told to."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        self.limits = []
        for module in ("estimator", "engine", "optimizer"):
            monkeypatch.setattr(f"qpmhe.estimation.{module}.perf_counter", lambda: self.now)

    def solver(self, options):
        clock, inner = self, create("banded")

        class Ticking(Solver):
            def _solve(self, qp, start):
                clock.limits.append(self.time_limit)
                clock.now += 0.375
                found = inner.solve(qp)
                # Half of the way, so that the sequence never converges.
                return RawSolution(0.5 * found.d, False)

        return Ticking(options)


@pytest.fixture
def clock(monkeypatch, registered):
    made = Clock(monkeypatch)
    registered("ticking", made.solver)
    return made


def test_each_qp_gets_what_remains(clock):
    mhe = estimator(backend="ticking", max_qps=9, time_budget=1.0)
    for y in MEASUREMENTS:
        estimate = mhe.update(y)
        assert clock.limits == [1.0, 0.625, 0.25]
        assert estimate.qps == 3
        assert Status.TIME_UP in estimate.status
        clock.limits.clear()
    late = mhe.amend(mhe.time - 2, MEASUREMENTS[0])
    assert clock.limits == [1.0, 0.625, 0.25]
    assert Status.TIME_UP in late.status


def test_without_a_budget_there_is_no_limit(clock):
    estimator(backend="ticking", max_qps=3).update(MEASUREMENTS[0])
    assert clock.limits == [None, None, None]


def test_time_that_the_model_takes_is_not_left_to_the_solver(clock):
    def f(x):
        if mhe is not None:
            clock.now += 0.25
        return SYSTEM.f.direct(x)

    mhe = None
    system = qpmhe.System(f, SYSTEM.h.direct, n=2, p=1)
    made = estimator(system, backend="ticking", max_qps=1, time_budget=1e9)
    mhe = made
    began = clock.now
    mhe.update(MEASUREMENTS[0])
    (limit,) = clock.limits
    assert limit < 1e9 - 0.2
    assert limit >= 1e9 - (clock.now - began)


@pytest.mark.parametrize("seconds", [1.0, 2.0])
def test_a_qp_that_is_ready_too_late_is_not_begun(clock, monkeypatch, seconds):
    mhe = estimator(backend="ticking", max_qps=2, time_budget=1.0)
    made = qpmhe.estimation.subproblem.Subproblem.at

    def slow(self, problem, trial):
        clock.now += seconds
        return made(self, problem, trial)

    monkeypatch.setattr(qpmhe.estimation.subproblem.Subproblem, "at", slow)
    estimate = mhe.update(MEASUREMENTS[0])
    assert clock.limits == []
    assert (estimate.qps, estimate.solve_time) == (0, 0.0)
    assert estimate.status == Status.CANDIDATE | Status.TIME_UP


# Every backend in a process of its own, all of which begin with no more than the package.
GROWTH = """
import json, os, sys, traceback
import numpy as np
import qpmhe
from qpmhe_solvers.dispatch import DispatchSolver

A = np.array([[1.0, 0.1], [-0.1, 0.9]])
SETS = {
    "free": {},
    "all": {
        "states": qpmhe.Box([-1.0, -1.0], [0.55, 1.0]),
        "disturbances": qpmhe.Box([-0.05, 0.0], [0.05, 0.0]),
    },
}

def growth(backend):
    return [of_one(backend, sets) for sets in SETS]

def of_one(backend, sets):
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1, **SETS[sets])
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=9.0 * np.eye(2), noise=[[4.0]])
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.3], [0.1]]), cost, horizon=4, initial_state=[0.5, 0.0],
        backend=backend, max_qps=2,
    )
    before = set(sys.modules)
    mhe.update([1.0])
    for y in (0.9, np.nan, 0.4, 0.2, 0.1, 0.0):
        mhe.update([y])
    return sorted(set(sys.modules) - before)

def dispatched(name):
    return getattr(qpmhe.solvers.backend(name).factory, "func", None) is DispatchSolver

cases = sorted(qpmhe.solvers.available(), key=dispatched)
found = {}
for case in cases:
    if dispatched(case) and "qpsolvers" not in sys.modules:
        import qpsolvers  # as whoever makes one of these does; once for all children
    reader, writer = os.pipe()
    if os.fork() == 0:
        try:
            answer = growth(case)
        except BaseException:
            answer = traceback.format_exc()
        os.write(writer, json.dumps(answer).encode()[:60000])
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        found[case] = json.loads(pipe.read() or b'"died"')
    os.wait()
print(json.dumps(found))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_no_update_imports_anything():
    done = subprocess.run(
        [sys.executable, "-c", GROWTH], capture_output=True, text=True, check=True,
        timeout=300,
    )
    found = json.loads(done.stdout.splitlines()[-1])
    assert len(found) > 2
    assert {case: grown for case, grown in found.items() if grown != [[], []]} == {}


@pytest.mark.parametrize("horizon", [3, 16, 40])
def test_programs_of_jax_are_compiled_when_the_estimator_is_made(horizon):
    jnp = pytest.importorskip("jax.numpy")
    system = qpmhe.from_jax(
        lambda x: jnp.array([x[0] + 0.1 * x[1], x[1] - 0.1 * jnp.sin(x[0])]), lambda x: x[:1],
        n=2, p=1,
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=[[1.0]])
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.3], [0.1]]), cost, horizon=horizon,
        initial_state=[0.5, 0.0], max_qps=3,
    )
    programs = system.kernel._programs._batches
    before = set(programs)
    for k in range(horizon + 3):
        mhe.update([np.cos(0.1 * k)])
    assert set(programs) == before


@pytest.mark.parametrize("compiled", [False, None])
def test_programs_of_casadi_for_full_windows_are_made_with_the_estimator(compiled):
    ca = pytest.importorskip("casadi")
    x = ca.SX.sym("x", 2)
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [ca.vertcat(x[0] + 0.1 * x[1], x[1] - 0.1 * ca.sin(x[0]))]),
        ca.Function("h", [x], [x[0]]), compiled=compiled,
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=[[1.0]])
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.3], [0.1]]), cost, horizon=4,
        initial_state=[0.5, 0.0], max_qps=3,
    )
    kept = system.kernel._local.kept
    before = set(kept)
    for k in range(7):
        mhe.update([np.cos(0.1 * k)])
    assert {count for count, _ in set(kept) - before} <= {2, 3}  # of the growing window


class Panic(BaseException):
    """As compiled code raises it."""


def hostile(word):
    """A class of solvers that does, wherever it can, what the word says."""
    answers = {
        "something else": lambda qp: "no Solution",
        "nothing": lambda qp: None,
        "short": lambda qp: Solution(np.zeros(3), SolveStatus.SOLVED),
        "not finite": lambda qp: Solution(np.full((qp.stages, qp.n), np.nan), SolveStatus.SOLVED),
        "odd status": lambda qp: Solution(np.zeros((qp.stages, qp.n)), "solved"),
    }

    class Hostile(Solver):
        def _solve(self, qp, start):
            raise NotImplementedError

        def solve(self, qp, start=None):
            if word in answers:
                return answers[word](qp)
            raise {"raises": KeyError, "exits": SystemExit, "panics": Panic}[word](word)

        def shift(self):
            self.solve(None)

        def forget(self):
            self.solve(None)

        def prepare(self, size):
            self.solve(None)

    return Hostile


BOXED = qpmhe.System(
    SYSTEM.f.direct, SYSTEM.h.direct, n=2, p=1, states=qpmhe.Box([0.0, 0.0], [9.0, 9.0]),
    disturbances=qpmhe.Box([-0.1, -0.1], [0.1, 0.1]),
)


@pytest.mark.parametrize("options", [
    {}, {"system": BOXED}, {"system": BOXED, "time_budget": 60.0},
], ids=["free", "bounded", "limited"])
@pytest.mark.parametrize("word", [
    "something else", "nothing", "short", "not finite", "odd status", "raises", "exits", "panics",
])
def test_a_hostile_backend_gets_out_of_no_method(registered, word, options):
    mhe = estimator(backend=registered("hostile", hostile(word)), **options)
    plain = estimator(backend="auto", max_qps=0, system=options.get("system", SYSTEM))
    for k, y in enumerate(MEASUREMENTS):
        estimate = mhe.update(y)
        assert Status.SOLVER_FAILED in estimate.status
        assert Status.CANDIDATE in estimate.status
        assert estimate.message
        plain.update(y)
        np.testing.assert_array_equal(mhe.state, plain.state)
        if k == 6:
            assert mhe.amend(5, MEASUREMENTS[5]).message == estimate.message
            state = mhe.state_dict()
    mhe.load_state_dict(state)
    assert mhe.time == 7
    mhe.reset()
    assert mhe.time == 0
