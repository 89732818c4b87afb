"""Every combination of sets, inputs, data, cost and start keeps the promise at every step.

And what becomes of a candidate outside of the sets, and of a step whose time is up.
"""

import itertools

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
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


def missed(one, points):
    """The most by which points leave a set, where all that an inequality needs is known."""
    worst = 0.0
    for point in points:
        gaps = [*(one.lower - point), *(point - one.upper)]
        for row, low, high in zip(one.matrix, one.row_lower, one.row_upper, strict=True):
            value = np.dot(row[row != 0.0], point[row != 0.0])
            gaps += [low - value, value - high]
        worst = max(worst, np.nanmax([0.0, *gaps]))
    return worst


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
        outside = self.outside(estimate.candidate, Y, U)
        if Status.PROJECTED not in estimate.status:
            assert estimate.dropped == outside
        assert bool(estimate.dropped) == (Status.SETS_DROPPED in estimate.status)
        assert set(self.outside(x, Y, U)) <= set(estimate.dropped)

    def outside(self, trajectory, Y, U):
        """Names of the sets that a trajectory is outside of."""
        pairs = list(zip(trajectory[:-1], U, strict=True))
        points = {
            "states": trajectory,
            "disturbances": trajectory[1:] - [f(x, u) for x, u in pairs],
            "noises": Y - [h(x, u) for x, u in pairs],
        }
        return tuple(
            name for name in points
            if name in self.sets and missed(self.sets[name], points[name]) > 1e-8
        )


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
            crossed |= set(case.outside(unbound.trajectory, Y[-length:], U))
    assert crossed == set(case.sets)


# Sets that the candidate leaves at times, and their names.
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
}
BACKENDS = qpmhe.solvers.available()
INEQUALITY_BACKENDS = [b for b in BACKENDS if qpmhe.solvers.backend(b).inequalities]


def tight(name, **options):
    """Estimates of a case in tight sets, each with its data and whether its candidate is out."""
    case = Case("no sets", True, "complete", "quadratic")
    case.sets = TIGHT[name]
    case.system = qpmhe.System(f, h, n=N, p=P, m=2, **case.sets)
    observer = list(Case("no sets", True, "complete", "quadratic").estimates(max_qps=0))
    found, outsiders = [], 0
    for (estimate, known), (free, _) in zip(case.estimates(**options), observer, strict=True):
        length = len(estimate.noises)
        data = known[-length:], case.U[len(known) - length : len(known)]
        outside = case.outside(free.trajectory, *data)
        found.append((estimate, free, data, outside))
        outsiders += bool(outside)
    assert 2 <= outsiders <= STEPS - 2
    return case, found


@pytest.mark.parametrize("max_qps", [0, 1, None])
@pytest.mark.parametrize("name", TIGHT)
def test_drop_leaves_out_the_violated_sets_and_no_others(name, max_qps):
    case, found = tight(name, outside="drop", max_qps=max_qps)
    for estimate, free, data, outside in found:
        assert estimate.dropped == outside
        assert (Status.SETS_DROPPED in estimate.status) == bool(outside)
        assert estimate.candidate.tolist() == free.trajectory.tolist()
        assert estimate.candidate_cost == free.cost
        assert set(case.outside(estimate.trajectory, *data)) <= set(outside)
        assert estimate.improved == (max_qps != 0)
        assert not estimate.status & (Status.PROJECTED | Status.CANDIDATE_OUTSIDE)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("name", TIGHT)
def test_keep_returns_the_candidate_bit_for_bit(name, start):
    case, found = tight(name, outside="keep", warm_start=start)
    for estimate, free, data, outside in found:
        assert estimate.dropped == ()
        assert estimate.candidate.tolist() == free.trajectory.tolist()
        if outside:
            assert estimate.status == Status.CANDIDATE | Status.CANDIDATE_OUTSIDE
            assert estimate.trajectory.tolist() == free.trajectory.tolist()
            assert estimate.disturbances.tolist() == free.disturbances.tolist()
            assert estimate.noises.tolist() == free.noises.tolist()
            assert estimate.cost == estimate.candidate_cost == free.cost
            assert estimate.qps == estimate.corrections == 0
        else:
            assert Status.IMPROVED in estimate.status
            assert case.outside(estimate.trajectory, *data) == ()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", TIGHT)
def test_project_puts_the_candidate_inside(name, backend):
    case, found = tight(name, outside="project", backend=backend)
    for estimate, free, data, outside in found:
        if not outside:
            assert estimate.candidate.tolist() == free.trajectory.tolist()
            assert estimate.dropped == ()
            assert Status.PROJECTED not in estimate.status
        elif backend in INEQUALITY_BACKENDS:
            assert Status.PROJECTED in estimate.status
            assert estimate.dropped == ()
            assert case.outside(estimate.candidate, *data) == ()
            # The prior is the observer's, not that of the projection.
            prior = free.candidate[0]
            cost = plain_cost("quadratic", estimate.candidate, prior, *data)
            assert estimate.candidate_cost == pytest.approx(cost, rel=1e-9)
        else:
            # Nothing but the box of X is kept by clipping; else the sets are dropped.
            assert (Status.PROJECTED in estimate.status) != bool(estimate.dropped)
        assert estimate.cost <= estimate.candidate_cost
        assert set(case.outside(estimate.trajectory, *data)) <= set(estimate.dropped)
        assert bool(estimate.dropped) == (Status.SETS_DROPPED in estimate.status)


def test_the_projection_into_a_box_of_states_is_the_nearest_point():
    _, found = tight("X", outside="project")
    box = TIGHT["X"]["states"]
    for estimate, free, _, _ in found:
        nearest = np.clip(free.trajectory, box.lower, box.upper)
        np.testing.assert_allclose(estimate.candidate, nearest, rtol=0, atol=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_without_anything_inside_the_violated_sets_are_dropped(backend):
    """The states must stay in X, where y is out of reach of any noise in V."""
    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x, n=1, p=1,
        states=qpmhe.Box(-1.0, 1.0), noises=qpmhe.Box(-2.0, 2.0),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.01]), qpmhe.QuadraticCost(prior=1, disturbance=1, noise=1),
        horizon=3, initial_state=[0.5], outside="project", backend=backend, max_qps=2,
    )
    assert Status.SETS_DROPPED not in mhe.update([0.7]).status
    for _ in range(3):
        estimate = mhe.update([5.0])
        assert Status.SETS_DROPPED in estimate.status
        assert Status.PROJECTED not in estimate.status
        assert estimate.dropped == ("noises",)
        assert estimate.improved
        assert np.abs(estimate.trajectory).max() <= 1.0


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
        assert estimate.improved
        assert estimate.step_time == estimate.solve_time == estimate.qps + estimate.corrections
        assert estimate.step_time < budget + 1.0
        # Corrections included, each QP got what remained.
        assert clock.limits == [budget - k for k in range(estimate.qps + estimate.corrections)]
        clock.limits.clear()
        up += Status.TIME_UP in estimate.status
    assert up > STEPS // 2


@pytest.mark.parametrize("budget", [1.5, 2.5, 9.5])
@pytest.mark.parametrize("name", TIGHT)
def test_a_projection_and_what_follows_share_the_time(clock, name, budget):
    _, found = tight(name, backend="ticking", time_budget=budget, outside="project", max_qps=3)
    left = []
    for estimate, *_ in found:
        solves = round(estimate.solve_time)
        left.extend(budget - k for k in range(solves))
    assert any(Status.PROJECTED in estimate.status for estimate, *_ in found)
    assert clock.limits == left
    assert min(left) > 0.0


@pytest.mark.parametrize("outside", ["drop", "project", "keep"])
@pytest.mark.parametrize("name", TIGHT)
def test_without_time_for_any_qp_the_candidate_is_the_estimate(clock, monkeypatch, name, outside):
    monkeypatch.setattr("qpmhe.estimation.optimizer.perf_counter", lambda: clock.now + 2.0)
    _, found = tight(name, backend="ticking", time_budget=1.0, outside=outside)
    assert clock.now == 0.0
    for estimate, free, _, outsider in found:
        assert estimate.trajectory.tolist() == free.trajectory.tolist()
        assert Status.CANDIDATE in estimate.status
        assert (Status.TIME_UP in estimate.status) == (outside != "keep" or not outsider)
        assert Status.PROJECTED not in estimate.status
        assert estimate.dropped == (() if outside == "keep" else outsider)
        assert estimate.qps == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_solvers_with_next_to_no_time_do_no_harm(monkeypatch, backend):
    """Their own clocks run; the one between QPs stands still, so that they are called."""
    monkeypatch.setattr("qpmhe.estimation.optimizer.perf_counter", lambda: 0.0)
    case = Case("polytopes", True, "missing", "quadratic")
    for estimate, known in case.estimates(backend=backend, time_budget=1e-9):
        case.check(estimate, known)
        assert estimate.qps > 0
