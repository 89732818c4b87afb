"""What becomes of a candidate outside of the sets, and of a step whose time is up."""

import functools
import re

import numpy as np
import pytest
from scipy.optimize import least_squares

import qpmhe
from qpmhe import Status
from qpmhe.errors import ObserverWarning
from qpmhe.solvers import Backend, RawSolution, Solver, SolveStatus

from .plain import steps

HORIZON, START = 4, np.array([0.6, -0.2, 0.4])
GAIN = np.array([[0.08, 0.0], [0.06, 0.0], [0.0, 0.05]])
WEIGHTS = (
    np.diag([1.0, 2.0, 1.0]), np.diag([40.0, 60.0, 50.0]), np.array([[20.0, 6.0], [6.0, 12.0]])
)
# Sets that the candidate of the plain observer leaves at times.
SETS = {
    "X": {"states": qpmhe.Box([0.15, -0.28, 0.34], [0.65, 0.0, 0.45])},
    "rows of X": {"states": qpmhe.Polytope([[-1.0, -1.0, 0.0]], [0.12])},
    "X, W and V": {
        "states": qpmhe.Box([0.1, -0.33, 0.3], [0.65, 0.0, 0.5]),
        "disturbances": qpmhe.Box([-0.05] * 3, [0.008] * 3),
        "noises": qpmhe.Box([-0.66, -0.25], [0.14, 0.17]),
    },
    # The gain corrects what has no noise.
    "noise-free": {"disturbances": qpmhe.Box([-0.03, -0.03, 0.0], [0.03, 0.03, 0.0])},
    "without zero": {
        "disturbances": qpmhe.Box([-0.1, -0.1, 0.002], [-0.002, 0.1, 0.1]),
        "noises": qpmhe.Box([-0.6, 0.01], [0.4, 0.3]),
    },
}
BACKENDS = qpmhe.solvers.available()
quiet = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


def f(x):
    one, two, three = x[..., 0], x[..., 1], x[..., 2]
    return np.stack([one + 0.2 * two, two - 0.2 * np.sin(one) * three, 0.98 * three], axis=-1)


def h(x):
    return np.stack([x[..., 0], x[..., 1] * x[..., 2] + x[..., 2]], axis=-1)


def record():
    rng, Y = np.random.default_rng(8), np.empty((8, 2))
    x = START - np.array([0.15, 0.1, -0.05])
    for t in range(len(Y)):
        Y[t] = h(x) + rng.uniform(-0.3, 0.3, 2)
        x = f(x) + rng.uniform(-0.1, 0.1, 3)
    Y[5, 0] -= 0.3  # an outlier
    return Y


def estimator(sets, **options):
    prior, disturbance, noise = WEIGHTS
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, h, n=3, p=2, **sets), qpmhe.Luenberger(GAIN),
        qpmhe.QuadraticCost(prior=prior, disturbance=disturbance, noise=noise),
        horizon=HORIZON, initial_state=START, **options,
    )


@functools.cache
def by(name, backend):
    return [one for one, _ in tight(name, backend=backend, max_qps=5)]


def tight(name, **options):
    """Estimates in tight sets, with the plain observer's and whether that is outside."""
    sets, Y, found = SETS[name], record(), []
    boxes = [sets.get(one) for one in ("states", "disturbances", "noises")]
    mhe, free = estimator(sets, project_observer=False, **options), estimator({}, max_qps=0)
    boxes[0] = None if name == "rows of X" else boxes[0]
    for y, estimate in zip(Y, steps(mhe, (f, h), Y, WEIGHTS, boxes), strict=True):
        plain = free.update(y)
        assert estimate.candidate.tolist() == plain.trajectory.tolist()
        assert estimate.candidate_cost == plain.cost
        found.append((estimate, Status.CANDIDATE_OUTSIDE in estimate.status))
    assert sum(outside for _, outside in found) >= 2
    return found


def least_miss(name, estimate):
    """The largest miss of the sets by the trajectory that misses them least, found by SciPy."""
    last, K = estimate.time, len(estimate.disturbances)
    Y = record()[last + 1 - K : last + 1]

    def missed(numbers):
        x = numbers.reshape(K + 1, 3)
        points = {"states": x, "disturbances": x[1:] - f(x[:-1]), "noises": Y - h(x[:-1])}
        return np.concatenate([
            np.maximum(np.maximum(box.lower - points[of], points[of] - box.upper), 0.0).ravel()
            for of, box in SETS[name].items()
        ])

    exact = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return np.abs(least_squares(missed, estimate.trajectory.ravel(), **exact).fun).max()


@quiet
@pytest.mark.parametrize("max_qps", [0, 1, None])
@pytest.mark.parametrize("infeasible", ["drop_rows", "restore"])
@pytest.mark.parametrize("name", SETS)
def test_the_rungs_of_the_ladder(name, infeasible, max_qps):
    satisfied = 0
    for estimate, outside in tight(
        name, infeasible=infeasible, max_qps=max_qps, warm_start=infeasible == "drop_rows"
    ):
        if max_qps == 0:
            expected = Status.CANDIDATE_OUTSIDE if outside else Status(0)
            assert estimate.status & ~Status.OBSERVER_FAR == (
                Status.CANDIDATE | Status.NO_QPS | expected
            )
            continue
        moved = Status.CANDIDATE not in estimate.status
        assert outside or estimate.improved
        assert moved or not estimate.dropped
        assert outside or estimate.nearest_points == 0
        assert Status.RESTORED not in estimate.status or infeasible == "restore"
        # With a cap of 1, there is one QP for the rung below, too.
        assert max_qps is None or estimate.qps <= 1 + outside
        most = 5 * (1 + estimate.qps) + 2 * 20 * (infeasible == "restore")
        assert estimate.nearest_points <= most
        satisfied += outside and moved and not estimate.dropped
        if infeasible == "restore":
            assert moved
            assert not estimate.dropped or least_miss(name, estimate) > 1e-4
    assert satisfied >= 2 or max_qps == 0


@quiet
@pytest.mark.parametrize("backend", [b for b in BACKENDS if qpmhe.solvers.backend(b).inequalities])
@pytest.mark.parametrize("name", ["X, W and V", "without zero"])
def test_backends_take_the_same_rung(name, backend):
    for estimate, expected in zip(by(name, backend), by(name, "auto"), strict=True):
        # Where linearised rows exclude each other, what a solver ends at is its own.
        if Status.SOLVER_STOPPED not in expected.status:
            assert estimate.dropped == expected.dropped
            assert estimate.cost == pytest.approx(expected.cost, rel=1e-2)


@pytest.mark.parametrize("backend", BACKENDS)
def test_rows_that_exclude_all_that_is_better_are_dropped_one_by_one(backend):
    """The states must stay in X, where y is out of reach of any noise in V."""
    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x, n=1, p=1,
        states=qpmhe.Box(-1.0, 1.0), noises=qpmhe.Box(-2.0, 2.0),
    )
    mhe, other = (
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.01]), qpmhe.QuadraticCost(prior=1, disturbance=1, noise=1),
            horizon=3, initial_state=[0.5], backend=backend, max_qps=1, infeasible=infeasible,
        )
        for infeasible in ("drop_rows", "restore")
    )
    for one in (mhe, other):
        assert Status.CANDIDATE_OUTSIDE not in one.update([0.7]).status
    for t in range(1, 4):
        if t < 3:
            estimate = mhe.update([5.0])
            second = other.update([5.0])
        else:
            with pytest.warns(ObserverWarning, match="dropped in 3 consecutive samples"):
                estimate = mhe.update([5.0])
            with pytest.warns(ObserverWarning, match="dropped in 3 consecutive samples"):
                second = other.update([5.0])
        late = [("noises", 0, "upper", s) for s in range(max(1, t - 2), t + 1)]
        assert list(estimate.dropped) == late
        assert estimate.improved
        assert Status.ROWS_DROPPED in estimate.status
        assert f"upper bound of noises, row 0, at time {t}" in estimate.explain()
        assert np.abs(estimate.trajectory).max() <= 1.0
        assert np.nanmax(estimate.noises[: -len(late)], initial=0.0) <= 2.0 + 1e-8
        assert estimate.qps >= 2
        assert "infeasible='restore'" in estimate.explain()
        # No trajectory is in all sets: the other policy ends at the same rung, and says why.
        assert second.candidate.tolist() == estimate.candidate.tolist()
        assert second.dropped == estimate.dropped
        assert second.cost == pytest.approx(estimate.cost, rel=1e-6)
        assert "no trajectory that satisfies all sets was found" in second.message
        assert re.search(rf"misses the .*, row 0, at time {t}", second.message)
        assert second.nearest_points <= 5 * (1 + second.qps) + 2 * 20


@quiet
@pytest.mark.parametrize("budget", [1.5, 2.5, 9.5])
@pytest.mark.parametrize("name", SETS)
def test_all_rungs_share_the_time(monkeypatch, name, budget):
    """A clock goes on by one second with each QP that is solved."""
    class Ticking(Solver):
        now, limits = 0.0, []

        def _solve(self, qp, start):
            Ticking.limits.append(self.time_limit)
            Ticking.now += 1.0
            found = qpmhe.solvers.create("auto", self.options).solve(qp, start)
            return RawSolution(
                found.d, found.status is SolveStatus.SOLVED, found.iterations,
                found.bound_duals, found.row_duals,
            )

    for module in ("estimator", "engine", "optimizer"):
        monkeypatch.setattr(f"qpmhe.estimation.{module}.perf_counter", lambda: Ticking.now)
    qpmhe.solvers.register(Backend("ticking", Ticking, "a test's"))
    left = []
    try:
        for estimate, _ in tight(name, backend="ticking", time_budget=budget, max_qps=3):
            solves = estimate.qps + estimate.corrections + estimate.nearest_points
            # What elimination solves needs no backend.
            asked = int(estimate.solve_time) if name == "noise-free" else solves
            assert estimate.step_time == estimate.solve_time == asked <= solves
            left.extend(budget - k for k in range(asked))
    finally:
        qpmhe.solvers.unregister("ticking")
    assert Ticking.limits == left
    assert min(left) > 0.0


@quiet
@pytest.mark.parametrize("backend", BACKENDS)
def test_solvers_with_next_to_no_time_do_no_harm(monkeypatch, backend):
    """Their own clocks run; the one between QPs stands still, so that they are called."""
    for module in ("optimizer", "outcome"):
        monkeypatch.setattr(f"qpmhe.estimation.{module}.perf_counter", lambda: 0.0)
    assert all(one.qps for one, _ in tight("X, W and V", backend=backend, time_budget=1e-9))
