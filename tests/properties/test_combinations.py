"""Every combination of sets, inputs, data, cost and start keeps the promise at every step.

And what becomes of a candidate outside of the sets, and of a step whose time is up.
"""

import itertools

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.errors import ObserverWarning
from qpmhe.solvers import Backend, RawSolution, Solver, SolveStatus

NAN = np.nan
N, P, STEPS, HORIZON = 3, 2, 8, 4
START = np.array([0.6, -0.2, 0.4])
GAIN = np.array([[0.08, 0.0], [0.06, 0.0], [0.0, 0.05]])
PRIOR, DISTURBANCE = np.diag([1.0, 2.0, 1.0]), np.diag([40.0, 60.0, 50.0])
NOISE = np.array([[20.0, 6.0], [6.0, 12.0]])
WEIGHTS = {"prior": PRIOR, "disturbance": DISTURBANCE, "noise": NOISE}


def f(x, u=None):
    one, two, three = x[..., 0], x[..., 1], x[..., 2]
    push = 0.0 if u is None else 0.2 * u[..., 0]
    return np.stack(
        [one + 0.2 * two, two - 0.2 * np.sin(one) * three + push, 0.98 * three], axis=-1
    )


def h(x, u=None):
    shift = 0.0 if u is None else u[..., 1]
    return np.stack([x[..., 0] + shift, x[..., 1] * x[..., 2] + x[..., 2]], axis=-1)


X_BOX = qpmhe.Box([-0.15, -0.7, 0.2], [0.65, 0.4, 0.6])
W_BOX = qpmhe.Box([-0.05] * 3, [0.03] * 3)
V_BOX = qpmhe.Box([-0.7, -0.25], [0.16, np.inf])
SETS = {
    "no sets": {},
    "X": {"states": X_BOX},
    "W": {"disturbances": W_BOX},
    "V": {"noises": V_BOX},
    "polytopes": {
        "states": X_BOX & qpmhe.Polytope([[1.0, 1.0, 1.0]], [0.9]),
        "disturbances": qpmhe.Polytope([[1, 1, 0], [-1, -1, 0], [1, -1, 0]], [0.04, 0.08, 0.03]),
        "noises": qpmhe.Polytope([[1.0, 0.1], [-1.0, 0.2], [0.0, -1.0]], [0.16, 0.8, 0.25]),
    },
    "noise-free": {
        "states": X_BOX, "disturbances": qpmhe.Box([-0.06, -0.05, 0.0], [0.03, 0.03, 0.0])
    },
}
COSTS = {
    "quadratic": lambda: qpmhe.QuadraticCost(**WEIGHTS),
    "huber": lambda: qpmhe.RobustCost(
        prior=PRIOR, disturbance=qpmhe.Huber(DISTURBANCE, 1.0), noise=qpmhe.Huber(NOISE)
    ),
    "norm": lambda: qpmhe.RobustCost(
        **{name: qpmhe.Power(weight, 1.0) for name, weight in WEIGHTS.items()}
    ),
    "discount": lambda: qpmhe.QuadraticCost(**WEIGHTS, discount=0.9),
}
# For each cost rho_p, rho_w and rho_v of the quadratic form q, and the discount.
LOSSES = {
    "quadratic": (lambda q: q, lambda q: q, lambda q: q, 1.0),
    "huber": (lambda q: q, lambda q: _huber(q, 1.0), lambda q: _huber(q, 1.345), 1.0),
    "norm": (np.sqrt, np.sqrt, np.sqrt, 1.0),
    "discount": (lambda q: q, lambda q: q, lambda q: q, 0.9),
}


def _huber(q, k):
    return q if q <= k * k else 2.0 * k * np.sqrt(q) - k * k


def plain_cost(name, trajectory, prior, Y, U):
    """J by a loop, of what is there of Y."""
    prior_loss, w_loss, v_loss, discount = LOSSES[name]
    offset, J = trajectory[0] - prior, 0.0
    for x, following, y, u in zip(trajectory[:-1], trajectory[1:], Y, U, strict=True):
        w, there = following - f(x, u), np.isfinite(y)
        J = discount * J + w_loss(w @ DISTURBANCE @ w)
        if there.any():
            v = (y - h(x, u))[there]
            weight = np.linalg.inv(np.linalg.inv(NOISE)[there][:, there])
            J += v_loss(v @ weight @ v)
    return J + discount ** len(Y) * prior_loss(offset @ PRIOR @ offset)


def missed(one, point, tolerance):
    """The inequalities that a point misses, where all that they need is known."""
    found = set()
    for j in range(one.dimension):
        found |= {(j, "lower")} if one.lower[j] - point[j] > tolerance else set()
        found |= {(j, "upper")} if point[j] - one.upper[j] > tolerance else set()
    rows = zip(one.matrix, one.row_lower, one.row_upper, strict=True)
    for k, (row, low, high) in enumerate(rows, one.dimension):
        value = np.dot(row[row != 0.0], point[row != 0.0])
        found |= {(k, "lower")} if low - value > tolerance else set()
        found |= {(k, "upper")} if value - high > tolerance else set()
    return found


class Case:
    """A record, an estimator for it, and the order in which the data come."""

    def __init__(self, sets, inputs, data, cost):
        rng = np.random.default_rng(21)
        self.sets, self.cost_name = SETS[sets], cost
        self.U = rng.uniform(-0.5, 0.5, (STEPS, 2)) if inputs else [None] * STEPS
        self.Y, x = np.empty((STEPS, P)), START - np.array([0.15, 0.1, -0.05])
        for t, u in enumerate(self.U):
            self.Y[t] = h(x, u) + rng.uniform(-0.3, 0.3, P)
            x = f(x, u) + rng.uniform(-0.1, 0.1, N) * [1, 1, sets != "noise-free"]
        self.Y[5, 0] -= 0.3  # an outlier
        self.in_time = self.Y.copy()
        if data != "complete":
            self.in_time[[2, 4], [0, 1]] = NAN
            self.in_time[3] = NAN
        # What a sample lacks comes two samples later, if it does at all.
        self.late = 2 if data == "late" else STEPS
        self.gain = GAIN.copy()
        if sets == "noise-free":
            self.gain[2] = 0.0
        m = 2 if inputs else 0
        self.system = qpmhe.System(f, h, n=N, p=P, m=m, **self.sets)

    def known(self, now):
        known = self.in_time[: now + 1].copy()
        arrived = max(0, now + 1 - self.late)
        known[:arrived] = self.Y[:arrived]
        return known

    def estimator(self, **options):
        options = {"horizon": HORIZON, "initial_state": START, "max_qps": 2} | options
        return qpmhe.MovingHorizonEstimator(
            self.system, qpmhe.Luenberger(self.gain), COSTS[self.cost_name](), **options
        )

    def estimates(self, **options):
        """Every estimate, those after late measurements too."""
        mhe = self.estimator(**options)
        for t in range(STEPS):
            # What is late comes after the newest sample.
            before = self.known(t - 1) if t else np.empty((0, P))
            yield mhe.update(self.in_time[t], self.U[t]), np.vstack((before, self.in_time[t]))
            sample = t - self.late
            if sample >= 0 and np.isnan(self.in_time[sample]).any():
                yield mhe.amend(sample, self.Y[sample]), self.known(t)

    def check(self, estimate, known):
        """Hold one estimate to the promise."""
        length = len(estimate.noises)
        Y, U = known[-length:], self.U[len(known) - length : len(known)]
        assert np.isfinite(estimate.trajectory).all()
        assert np.isfinite(estimate.cost)
        assert estimate.cost <= estimate.candidate_cost
        prior = estimate.candidate[0]
        for J, trajectory in (
            (estimate.cost, estimate.trajectory), (estimate.candidate_cost, estimate.candidate)
        ):
            assert plain_cost(self.cost_name, trajectory, prior, Y, U) == pytest.approx(
                J, rel=1e-9, abs=1e-12
            )
        improved = Status.IMPROVED in estimate.status
        assert improved == (estimate.cost < estimate.candidate_cost)
        assert improved != (Status.CANDIDATE in estimate.status)
        # Noises and disturbances are those of the trajectory, NaN where y is missing.
        x = estimate.trajectory
        predicted = [f(state, u) for state, u in zip(x[:-1], U, strict=True)]
        np.testing.assert_allclose(estimate.disturbances, x[1:] - predicted, rtol=0, atol=1e-12)
        fitted = [h(state, u) for state, u in zip(x[:-1], U, strict=True)]
        np.testing.assert_allclose(estimate.noises, Y - fitted, rtol=0, atol=1e-12)
        dropped, first = set(estimate.dropped), len(known) - length
        outside = self.outside(estimate.candidate, Y, U, first)
        assert (Status.CANDIDATE_OUTSIDE in estimate.status) == bool(outside)
        assert bool(dropped) == (Status.ROWS_DROPPED in estimate.status)
        assert dropped <= self.outside(estimate.candidate, Y, U, first, 1e-10)
        assert dropped <= self.outside(x, Y, U, first, 1e-10)
        assert not improved or self.outside(x, Y, U, first) <= dropped
        fixed = self.system.disturbances.fixed_components if "disturbances" in self.sets else ()
        assert not any(row.set == "disturbances" and row.row in fixed for row in dropped)

    def outside(self, trajectory, Y, U, first=0, tolerance=1e-8):
        """The rows that a trajectory misses, whose first state is of this time."""
        pairs = list(zip(trajectory[:-1], U, strict=True))
        points = {
            "states": trajectory,
            "disturbances": trajectory[1:] - [f(x, u) for x, u in pairs],
            "noises": Y - [h(x, u) for x, u in pairs],
        }
        return {
            (name, *row, first + k)
            for name, one in self.sets.items()
            for k, point in enumerate(points[name])
            for row in missed(one, point, tolerance)
        }


DATA, STARTS = ("complete", "missing", "late"), (False, True)
COMBINATIONS = list(itertools.product(SETS, (False, True), DATA, COSTS, STARTS))


@pytest.mark.parametrize(("sets", "inputs", "data", "cost", "start"), COMBINATIONS)
def test_every_combination_keeps_the_promise(sets, inputs, data, cost, start):
    case = Case(sets, inputs, data, cost)
    kept = []
    for estimate, known in case.estimates(warm_start=start):
        case.check(estimate, known)
        kept.append(not estimate.dropped)
        assert estimate.improved
    assert len(kept) == STEPS + (3 if data == "late" else 0)
    assert sum(kept) >= 3


@pytest.mark.parametrize("sets", list(SETS)[1:])
def test_the_sets_bind(sets):
    """Otherwise the combinations above would show little."""
    case = Case(sets, True, "complete", "quadratic")
    free = Case("no sets", True, "complete", "quadratic")
    crossed = set()
    for (bound, _), (unbound, Y) in zip(case.estimates(), free.estimates(), strict=True):
        if not bound.dropped:
            length = len(unbound.noises)
            U = case.U[len(Y) - length : len(Y)]
            crossed |= {row[0] for row in case.outside(unbound.trajectory, Y[-length:], U)}
    assert crossed == set(case.sets)


# Sets that the candidate of the plain observer leaves at times.
TIGHT = {
    "X": {"states": qpmhe.Box([0.15, -0.28, 0.34], [0.65, 0.0, 0.45])},
    "rows of X": {"states": qpmhe.Polytope([[-1.0, -1.0, 0.0]], [0.12])},
    "W": {"disturbances": qpmhe.Box([-0.03] * 3, [0.008] * 3)},
    "V": {"noises": qpmhe.Box([-0.4, -0.2], [0.1, 0.1])},
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
INEQUALITY_BACKENDS = [b for b in BACKENDS if qpmhe.solvers.backend(b).inequalities]
quiet = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


def tight(name, **options):
    """Checked estimates in tight sets, each with the plain observer's and whether that is out."""
    case = Case("no sets", True, "complete", "quadratic")
    observer = list(case.estimates(max_qps=0))
    case.sets = TIGHT[name]
    case.system = qpmhe.System(f, h, n=N, p=P, m=2, **case.sets)
    found = []
    estimates = case.estimates(project_observer=False, **options)
    for (estimate, known), (free, _) in zip(estimates, observer, strict=True):
        case.check(estimate, known)
        assert estimate.candidate.tolist() == free.trajectory.tolist()
        assert estimate.candidate_cost == free.cost
        found.append((estimate, free, Status.CANDIDATE_OUTSIDE in estimate.status))
    assert sum(outside for *_, outside in found) >= 2
    return found


def kept(estimate, free):
    """Whether an estimate is the candidate, bit for bit."""
    assert estimate.dropped == ()
    assert estimate.cost == estimate.candidate_cost == free.cost
    assert estimate.disturbances.tolist() == free.disturbances.tolist()
    assert estimate.noises.tolist() == free.noises.tolist()
    return estimate.trajectory.tolist() == free.trajectory.tolist()


@quiet
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("max_qps", [0, 1, None])
@pytest.mark.parametrize("infeasible", ["drop_rows", "keep_candidate"])
@pytest.mark.parametrize("name", TIGHT)
def test_the_rungs_of_the_ladder(name, infeasible, max_qps, start):
    satisfied = 0
    for estimate, free, outside in tight(
        name, infeasible=infeasible, max_qps=max_qps, warm_start=start
    ):
        if max_qps == 0:
            assert kept(estimate, free)
            expected = Status.CANDIDATE_OUTSIDE if outside else Status(0)
            assert estimate.status & ~Status.OBSERVER_FAR == (
                Status.CANDIDATE | Status.NO_QPS | expected
            )
            continue
        assert estimate.improved or kept(estimate, free)
        assert outside or estimate.improved
        assert outside or estimate.nearest_points == 0
        assert not estimate.dropped or infeasible == "drop_rows"
        # With a cap of 1, there is one QP for the rung below, too.
        assert max_qps is None or estimate.qps <= 1 + (infeasible == "drop_rows" and outside)
        satisfied += outside and estimate.improved and not estimate.dropped
    assert satisfied >= 2 or max_qps == 0


@quiet
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", TIGHT)
def test_backends_take_the_same_rung(name, backend):
    estimates, usual = (
        [one for one, *_ in tight(name, backend=given, max_qps=5)] for given in (backend, "auto")
    )
    for estimate, expected in zip(estimates, usual, strict=True):
        # Where linearised rows exclude each other, what a solver ends at is its own.
        if backend in INEQUALITY_BACKENDS and Status.SOLVER_STOPPED not in expected.status:
            assert estimate.dropped == expected.dropped
            assert estimate.cost == pytest.approx(expected.cost, rel=1e-2)


@pytest.mark.parametrize("max_qps", [1, 3])
@pytest.mark.parametrize("backend", BACKENDS)
def test_rows_that_exclude_all_that_is_better_are_dropped_one_by_one(backend, max_qps):
    """The states must stay in X, where y is out of reach of any noise in V."""
    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x, n=1, p=1,
        states=qpmhe.Box(-1.0, 1.0), noises=qpmhe.Box(-2.0, 2.0),
    )
    mhe, other = (
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.01]), qpmhe.QuadraticCost(prior=1, disturbance=1, noise=1),
            horizon=3, initial_state=[0.5], backend=backend, max_qps=max_qps, infeasible=infeasible,
        )
        for infeasible in ("drop_rows", "keep_candidate")
    )
    for one in (mhe, other):
        assert Status.CANDIDATE_OUTSIDE not in one.update([0.7]).status
    for t in range(1, 4):
        if t < 3:
            estimate = mhe.update([5.0])
        else:
            with pytest.warns(ObserverWarning, match="dropped in 3 consecutive samples"):
                estimate = mhe.update([5.0])
        kept = other.update([5.0])
        late = [("noises", 0, "upper", s) for s in range(max(1, t - 2), t + 1)]
        assert list(estimate.dropped) == late
        assert estimate.improved
        assert Status.ROWS_DROPPED in estimate.status
        assert f"upper bound of noises, row 0, at time {t}" in estimate.explain()
        assert np.abs(estimate.trajectory).max() <= 1.0
        assert np.nanmax(estimate.noises[: -len(late)], initial=0.0) <= 2.0 + 1e-8
        assert estimate.qps >= 2
        assert kept.trajectory.tolist() == kept.candidate.tolist() == estimate.candidate.tolist()
        assert kept.dropped == ()
        assert "The estimate violates them as well." in kept.explain()


@quiet
def test_nearest_points_are_counted_apart():
    found = [one for name in TIGHT for one, *_ in tight(name, max_qps=1)]
    assert any(one.nearest_points and one.improved and not one.dropped for one in found)
    assert all(one.nearest_points <= 5 * (1 + one.qps) for one in found)


class Clock:
    """A clock that goes on by one second with each QP that is solved."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        self.limits = []
        for module in ("estimator", "engine", "optimizer"):
            monkeypatch.setattr(f"qpmhe.estimation.{module}.perf_counter", lambda: self.now)

    def solver(self, options):
        clock, inner = self, qpmhe.solvers.create("auto", options)

        class Ticking(Solver):
            def _solve(self, qp, start):
                clock.limits.append(self.time_limit)
                clock.now += 1.0
                found = inner.solve(qp, start)
                return RawSolution(
                    found.d, found.status is SolveStatus.SOLVED, found.iterations,
                    found.bound_duals, found.row_duals,
                )

        return Ticking(options)


@pytest.fixture
def clock(monkeypatch):
    made = Clock(monkeypatch)
    qpmhe.solvers.register(Backend("ticking", made.solver, "a test's"))
    yield made
    qpmhe.solvers.unregister("ticking")


@pytest.mark.parametrize("sets", SETS)
@pytest.mark.parametrize("budget", [0.5, 1.5, 2.5])
def test_no_qp_is_begun_when_the_time_is_up(clock, budget, sets):
    case = Case(sets, True, "missing", "quadratic")
    up = 0
    for estimate, known in case.estimates(
        backend="ticking", max_qps=None, time_budget=budget, tolerance=1e-15
    ):
        case.check(estimate, known)
        solves = estimate.qps + estimate.corrections + estimate.nearest_points
        assert estimate.step_time == estimate.solve_time == solves
        assert estimate.step_time < budget + 1.0
        # All included, each QP got what remained.
        assert clock.limits == [budget - k for k in range(solves)]
        clock.limits.clear()
        up += Status.TIME_UP in estimate.status
    assert up > STEPS // 2


@quiet
@pytest.mark.parametrize("budget", [1.5, 2.5, 9.5])
@pytest.mark.parametrize("name", TIGHT)
def test_all_rungs_share_the_time(clock, name, budget):
    left = []
    for estimate, *_ in tight(name, backend="ticking", time_budget=budget, max_qps=3):
        solves = estimate.qps + estimate.corrections + estimate.nearest_points
        left.extend(budget - k for k in range(solves))
    assert clock.limits == left
    assert min(left) > 0.0


@quiet
@pytest.mark.parametrize("infeasible", ["drop_rows", "keep_candidate"])
@pytest.mark.parametrize("name", TIGHT)
def test_without_time_for_any_qp_the_candidate_is_the_estimate(
    clock, monkeypatch, name, infeasible
):
    monkeypatch.setattr("qpmhe.estimation.optimizer.perf_counter", lambda: clock.now + 2.0)
    found = tight(name, backend="ticking", time_budget=1.0, infeasible=infeasible)
    assert clock.now == 0.0
    for estimate, free, outside in found:
        # The previous estimate, shifted, may satisfy what the candidate violates.
        assert kept(estimate, free) if not estimate.improved else outside
        assert Status.TIME_UP in estimate.status
        assert estimate.dropped == ()
        assert estimate.qps == estimate.nearest_points == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_solvers_with_next_to_no_time_do_no_harm(monkeypatch, backend):
    """Their own clocks run; the one between QPs stands still, so that they are called."""
    monkeypatch.setattr("qpmhe.estimation.optimizer.perf_counter", lambda: 0.0)
    case = Case("polytopes", True, "missing", "quadratic")
    for estimate, known in case.estimates(backend=backend, time_budget=1e-9):
        case.check(estimate, known)
        assert estimate.qps > 0
