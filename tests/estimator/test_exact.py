"""The exact convex subproblem against QPs, against SciPy, and against its own promises."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import LinearConstraint, linprog, minimize

import qpmhe
from qpmhe import (
    Box,
    ExtendedKalman,
    Huber,
    Luenberger,
    MovingHorizonEstimator,
    ObserverPrior,
    Polytope,
    Power,
    Quadratic,
    QuadraticCost,
    RobustCost,
    System,
)
from qpmhe.estimation.problem import Problem
from qpmhe.estimation.subproblem import Subproblem
from qpmhe.estimation.window import Window
from qpmhe.exact import ExactStep
from qpmhe_solvers import SolverOptions, SolveStatus, create

P0, Q2, R2 = np.diag([2.0, 0.5]), np.array([[30.0, 5.0], [5.0, 20.0]]), np.diag([4.0, 9.0])
R1 = np.array([[4.0]])


def curved(x):
    return np.stack(
        [0.9 * x[..., 0] + 0.2 * np.sin(x[..., 1]), 0.8 * x[..., 1] - 0.1 * x[..., 0] ** 2], -1
    )


def linear(x):
    return x @ np.array([[0.9, 0.2], [-0.1, 0.8]]).T


def both(x):
    return np.stack([x[..., 0] + 0.1 * x[..., 1] ** 2, x[..., 1]], -1)


def first(x):
    return x[..., :1]


def setup(cost, stages, f=curved, h=first, horizon=6, seed=0, missing=(), observer=None, **sets):
    """A window with outliers in it, its problem bound, the candidate, and its Jacobians."""
    generator = np.random.default_rng(seed)
    p = cost.p
    system = System(f, h, n=cost.n, p=p, **sets)
    observer = Luenberger(0.1 * np.ones((cost.n, p))) if observer is None else observer
    window = Window(system, observer, cost, horizon, np.full(cost.n, 0.3), True)
    x = np.full(cost.n, 0.5)
    for t in range(stages):
        y = np.asarray(h(x)) + 0.3 * generator.normal(size=p)
        if t % 3 == 1:
            y += 4.0 * generator.normal(size=p)
        for time, component in missing:
            if time == t:
                y[component] = np.nan
        window.push(y, np.zeros(0))
        x = np.asarray(f(x)) + 0.1 * generator.normal(size=cost.n)
    problem = Problem(system, cost)
    problem.bind(window)
    return SimpleNamespace(
        system=system, cost=cost, window=window, problem=problem, trial=problem.candidate(window),
        jacobian=window.terms.jacobian[window.start : window.end],
    )


def solve(case, step=None):
    step = ExactStep(case.system, case.cost) if step is None else step
    return step.solve(case.problem, case.trial, case.jacobian)


def rho(loss, s, weight):
    """A loss of one residual, written out."""
    if loss.per_component:
        forms = [weight[j, j] * s[j] ** 2 for j in range(s.size)]
    else:
        forms = [s @ weight @ s]
    total = 0.0
    for form in forms:
        size = np.sqrt(form)
        if isinstance(loss, Huber):
            k = loss.threshold
            total += form if size <= k else 2.0 * k * size - k * k
        else:
            total += size ** (2.0 if isinstance(loss, Quadratic) else loss.exponent)
    return total


def losses(cost):
    if isinstance(cost, QuadraticCost):
        return Quadratic(np.eye(cost.n)), Quadratic(np.eye(cost.n)), Quadratic(np.eye(cost.p))
    return cost.prior_loss, cost.disturbance_loss, cost.noise_loss


def objective(case, d):
    """The subproblem's objective, in plain loops."""
    prior, w_loss, v_loss = losses(case.cost)
    n, count, gamma = case.cost.n, case.jacobian.shape[0], case.cost.discount
    offset = case.trial.trajectory[0] + d[0] - case.problem.prior
    total = gamma**count * rho(prior, offset, case.cost.prior)
    for i in range(count):
        r = case.trial.residuals[i] - case.jacobian[i] @ d[i]
        r[:n] += d[i + 1]
        weights = case.problem.stage_weights
        weight = weights if weights.ndim == 2 else weights[i]
        stage = rho(w_loss, r[:n], weight[:n, :n]) + rho(v_loss, r[n:], weight[n:, n:])
        total += gamma ** (count - 1 - i) * stage
    return total


def constraints(case):
    """The sets as bounds on the flat increments and as rows, from plain loops."""
    n, count, problem = case.cost.n, case.jacobian.shape[0], case.problem
    size = (count + 1) * n
    rows, low, high = [], [], []

    def add(one, point, columns):
        matrix = np.vstack((np.eye(one.dimension), one.matrix))
        rows.append(matrix @ columns)
        value = matrix @ point
        low.append(np.append(one.lower, one.row_lower) - value)
        high.append(np.append(one.upper, one.row_upper) - value)

    def pick(i):
        return np.eye(size)[i * n : (i + 1) * n]

    for i in range(count + 1):
        if problem.states is not None:
            add(problem.states, case.trial.trajectory[i], pick(i))
    for i in range(count):
        r, jacobian = case.trial.residuals[i], case.jacobian[i]
        if problem.disturbances is not None:
            add(problem.disturbances, r[:n], pick(i + 1) - jacobian[:n] @ pick(i))
        if problem.noises is not None:
            add(problem.noises, r[n:], -jacobian[n:] @ pick(i))
    if not rows:
        return None
    matrix, lower, upper = np.vstack(rows), np.concatenate(low), np.concatenate(high)
    finite = np.isfinite(lower) | np.isfinite(upper)
    return matrix[finite], lower[finite], upper[finite]


def missed(case, d):
    found = constraints(case)
    if found is None:
        return 0.0
    matrix, low, high = found
    value = matrix @ d.ravel()
    return float(max(0.0, (low - value).max(), (value - high).max()))


def brute_force(case, begin):
    """SciPy's own minimum of the same objective, from its own differences."""
    shape = begin.shape
    found = constraints(case)
    rows = [] if found is None else [LinearConstraint(*found)]
    answer = minimize(
        lambda d: objective(case, d.reshape(shape)), begin.ravel(), method="SLSQP",
        constraints=rows, options={"ftol": 1e-12, "maxiter": 500},
    )
    return answer.x.reshape(shape), answer.fun


ROBUST = {
    "huber": RobustCost(prior=P0, disturbance=Q2, noise=Huber(R1, 0.8)),
    "huber everywhere": RobustCost(
        prior=Huber(P0, 0.1), disturbance=Huber(Q2, 0.3), noise=Huber(R1, 0.8)
    ),
    "huber per component": RobustCost(
        prior=Huber(P0, 0.1, True), disturbance=Huber(np.diag([30.0, 20.0]), 0.3, True),
        noise=Huber(R1, 0.8, True),
    ),
    "power 1.5": RobustCost(prior=Power(P0, 1.5), disturbance=Power(Q2, 1.5), noise=Power(R1, 1.5)),
    "power 2": RobustCost(prior=Power(P0, 2), disturbance=Power(Q2, 2), noise=Power(R1, 2, True)),
    "power 3": RobustCost(prior=P0, disturbance=Power(Q2, 3.0), noise=Power(R1, 3.0)),
    "irrational, per component": RobustCost(
        prior=Power(P0, np.sqrt(2), True), disturbance=Power(np.diag([30.0, 20.0]), 1.7, True),
        noise=Power(R1, np.e, True),
    ),
    "discounted": RobustCost(
        prior=Huber(P0, 0.1), disturbance=Power(Q2, 1.5), noise=Huber(R1, 0.8), discount=0.7
    ),
}
SETS = {
    "free": {},
    "states": {"states": Box([-0.4, -np.inf], [0.45, 0.4])},
    "states, rows": {"states": Polytope([[1.0, 1.0], [-1.0, 2.0]], [0.65, 0.7])},
    "disturbances": {"disturbances": Box([-0.02, -np.inf], [np.inf, 0.03])},
    "noise-free": {"disturbances": Box([0.0, -np.inf], [0.0, np.inf])},
    "noises": {"noises": Box([-2.0], [1.5])},
    "all": {
        "states": Box([-2.0, -2.0], [2.0, 2.0]),
        "disturbances": Polytope([[1.0, 1.0], [-1.0, -1.0]], [0.3, 0.3]) & Box([-1, -1], [1, 1]),
        "noises": Box([-4.0], [4.0]),
    },
}


@pytest.mark.parametrize("stages", [1, 2, 6, 9])
@pytest.mark.parametrize("h", [first, both])
@pytest.mark.parametrize("missing", [(), ((4, 0), (7, 0))])
@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_quadratic_cost_gives_the_solution_of_the_banded_qp(stages, h, missing, discount):
    noise = R1 if h is first else np.array([[4.0, 1.0], [1.0, 9.0]])
    cost = QuadraticCost(prior=P0, disturbance=Q2, noise=noise, discount=discount)
    case = setup(cost, stages, h=h, missing=missing)
    subproblem, banded = Subproblem(case.system, cost, 6), create("banded", SolverOptions())
    step = ExactStep(case.system, cost)
    # At the candidate, and at the trajectory that the first step leads to.
    for qp in (subproblem.at_candidate(case.problem, case.window), None):
        if qp is None:
            qp = subproblem.at(case.problem, case.trial)
            case.jacobian = subproblem._terms.jacobian[: case.window.length].copy()
        expected = banded.solve(qp).d.copy()
        found = solve(case, step)
        assert found.solved
        np.testing.assert_allclose(found.d, expected, rtol=1e-8, atol=1e-8)
        assert found.predicted == pytest.approx(objective(case, expected), rel=1e-9)
        case.trial = case.problem.evaluate(case.trial.trajectory + expected)


@pytest.mark.parametrize("sets", SETS.values(), ids=SETS)
def test_quadratic_cost_with_sets_gives_the_solution_of_the_qp(sets):
    cost = QuadraticCost(prior=P0, disturbance=Q2, noise=R1)
    case = setup(cost, 6, **sets)
    qp = Subproblem(case.system, cost, 6).at_candidate(case.problem, case.window)
    solver = create("daqp", SolverOptions(absolute_tolerance=1e-10))
    expected = solver.solve(qp)
    assert expected.status is SolveStatus.SOLVED
    found = solve(case)
    assert found.solved
    np.testing.assert_allclose(found.d, expected.d, atol=1e-6)


@pytest.mark.parametrize("cost", ROBUST.values(), ids=ROBUST)
@pytest.mark.parametrize("sets", SETS.values(), ids=SETS)
def test_robust_cost_has_the_minimum_that_scipy_finds(cost, sets):
    case = setup(cost, 3, **sets)
    found = solve(case)
    assert found.solved
    assert missed(case, found.d) <= 1e-7
    assert found.predicted == pytest.approx(objective(case, found.d), rel=1e-12)
    # From elsewhere, so that it comes back by itself.
    begin = found.d + 0.1 * np.random.default_rng(1).normal(size=found.d.shape)
    d, least = brute_force(case, begin)
    assert missed(case, d) <= 1e-7
    assert found.predicted == pytest.approx(least, rel=2e-6)
    np.testing.assert_allclose(found.d, d, atol=5e-3)


def test_absolute_values_have_the_minimum_of_the_linear_program():
    cost = RobustCost(
        prior=Power(P0, 1, True), disturbance=Power(np.diag([30.0, 20.0]), 1, True),
        noise=Power(R2, 1, True),
    )
    sets = {"states": Box([-0.4, -np.inf], [0.45, 0.4]), "noises": Box([-3, -3], [9, 9])}
    case = setup(cost, 6, h=both, observer=Luenberger(0.3 * np.eye(2)), **sets)
    # Not everything that the sets allow: outliers in y are beyond V.
    case.problem.leave_out(("noises",))
    found = solve(case)
    assert found.solved
    size = found.d.size
    residuals, slopes = [], []
    unit, roots = np.eye(size), np.sqrt(np.diag(cost.stage_weight))
    residuals.append(np.sqrt(np.diag(P0)) * (case.trial.trajectory[0] - case.problem.prior))
    slopes.append(np.sqrt(np.diag(P0))[:, None] * unit[:2])
    for i in range(6):
        slope = -case.jacobian[i] @ unit[2 * i : 2 * i + 2]
        slope[:2] += unit[2 * i + 2 : 2 * i + 4]
        residuals.append(roots * case.trial.residuals[i])
        slopes.append(roots[:, None] * slope)
    r, slope = np.concatenate(residuals), np.vstack(slopes)
    # Minimise the sum of t over (d, t) with -t <= r + slope d <= t.
    low, high = (np.tile(side, 7) - case.trial.trajectory.ravel()
                 for side in (case.system.states.lower, case.system.states.upper))
    answer = linprog(
        np.append(np.zeros(size), np.ones(r.size)),
        A_ub=np.block([[slope, -np.eye(r.size)], [-slope, -np.eye(r.size)]]),
        b_ub=np.append(-r, r),
        bounds=[*zip(low, high, strict=True), *[(0.0, None)] * r.size],
    )
    assert answer.status == 0
    assert found.predicted == pytest.approx(answer.fun, rel=1e-8)


@pytest.mark.parametrize("per_component", [False, True])
def test_norms_have_no_better_neighbour(per_component):
    cost = RobustCost(
        prior=Power(P0, 1, per_component), disturbance=Power(np.diag([30.0, 20.0]), 1,
        per_component), noise=Power(R2, 1, per_component), discount=0.9,
    )
    case = setup(cost, 5, h=both)
    found = solve(case)
    generator = np.random.default_rng(4)
    for scale in (1e-3, 1e-2, 1e-1):
        for _ in range(300):
            move = generator.normal(size=found.d.shape)
            move *= generator.random(move.shape) < 0.4  # along the edges, too
            worse = objective(case, found.d + scale * move)
            assert worse >= found.predicted * (1.0 - 1e-9)


def test_one_state_one_stage():
    cost = RobustCost(prior=Power([[3.0]], 1.5), disturbance=[[5.0]], noise=Huber([[4.0]], 0.5))
    case = setup(cost, 1, f=lambda x: 0.5 * x, h=lambda x: 2.0 * x, seed=3)
    found = solve(case)
    d, least = brute_force(case, np.zeros((2, 1)))
    assert found.d.shape == (2, 1)
    assert found.predicted == pytest.approx(least, rel=1e-8)
    np.testing.assert_allclose(found.d, d, atol=1e-4)


@pytest.mark.parametrize("cost", ROBUST.values(), ids=ROBUST)
def test_on_a_linear_system_the_prediction_is_the_true_cost(cost):
    case = setup(cost, 6, f=linear)
    found = solve(case)
    after = case.problem.evaluate(case.trial.trajectory + found.d)
    assert after.cost == pytest.approx(found.predicted, rel=1e-12)
    assert after.cost < case.trial.cost
    # There the sequence has converged.
    case.trial = after
    again = solve(case)
    assert again.predicted == pytest.approx(after.cost, rel=1e-7)
    assert again.predicted <= after.cost * (1 + 1e-9)


def test_one_step_does_what_reweighted_qps_converge_to():
    cost = RobustCost(prior=P0, disturbance=Q2, noise=Huber(R1, 0.8))
    case = setup(cost, 6, f=linear)
    mhe = MovingHorizonEstimator(
        case.system, Luenberger(0.1 * np.ones((2, 1))), cost, horizon=6, initial_state=[0.3, 0.3],
        max_qps=None, tolerance=1e-13,
    )
    for y in case.window.measurements:
        estimate = mhe.update(y)
    assert estimate.qps > 1
    found = solve(case)
    assert found.predicted <= estimate.cost * (1 + 1e-10)
    assert found.predicted == pytest.approx(estimate.cost, rel=1e-8)
    np.testing.assert_allclose(
        case.trial.trajectory + found.d, estimate.trajectory, atol=1e-4
    )


@pytest.mark.parametrize("cost", [ROBUST["huber"], ROBUST["power 1.5"]])
@pytest.mark.parametrize(
    "names",
    [("states",), ("disturbances",), ("noises",), ("states", "noises"),
     ("states", "disturbances", "noises")],
)
def test_sets_are_dropped_and_taken_back_without_stating_anew(cost, names, monkeypatch):
    sets = {
        "states": Box([-0.4, -np.inf], [0.45, 0.4]),
        "disturbances": Polytope([[0.0, 1.0]], [0.02]) & Box([0.0, -np.inf], [0.0, np.inf]),
        "noises": Box([-2.0], [4.0]),
    }
    case = setup(cost, 4, observer=Luenberger([0.0, 0.1]), **sets)
    step = ExactStep(case.system, cost)
    before = solve(case, step)
    assert before.solved
    counted = count_compilations(monkeypatch)
    case.problem.leave_out(names)
    without = solve(case, step)
    assert without.solved
    assert not counted
    less = setup(
        cost, 4, observer=Luenberger([0.0, 0.1]),
        **{name: one for name, one in sets.items() if name not in names},
    )
    expected = solve(less)
    assert without.predicted == pytest.approx(expected.predicted, rel=1e-7)
    np.testing.assert_allclose(without.d, expected.d, atol=1e-4)
    if cost is ROBUST["huber"]:  # there, every one of these sets binds
        assert without.predicted < before.predicted * (1 - 1e-6)
    case.problem.bind(case.window)
    after = solve(case, step)
    assert after.predicted == pytest.approx(before.predicted, rel=1e-9)


def count_compilations(monkeypatch):
    from cvxpy.reductions.dcp2cone.dcp2cone import Dcp2Cone

    counted, apply = [], Dcp2Cone.apply

    def counting(self, problem):
        counted.append(problem)
        return apply(self, problem)

    monkeypatch.setattr(Dcp2Cone, "apply", counting)
    return counted


@pytest.mark.parametrize("cost", ROBUST.values(), ids=ROBUST)
def test_compiled_once_for_each_window_length(cost, monkeypatch):
    counted = count_compilations(monkeypatch)
    step = None
    for stages in (2, 5, 6, 7, 8, 9, 5, 2):
        case = setup(cost, stages, **SETS["all"])
        step = ExactStep(case.system, cost) if step is None else step
        assert solve(case, step).d is not None
        case.problem.leave_out(("noises",))
        assert solve(case, step).d is not None
    assert len(counted) == 3  # 2, 5 and 6 stages: longer windows slide


def test_prepare_compiles_beforehand(monkeypatch):
    case = setup(ROBUST["huber"], 6)
    step = ExactStep(case.system, case.cost)
    step.prepare(6)
    counted = count_compilations(monkeypatch)
    assert solve(case, step).solved
    assert not counted


@pytest.mark.parametrize("cost", ROBUST.values(), ids=ROBUST)
@pytest.mark.parametrize("sets", SETS.values(), ids=SETS)
def test_program_follows_the_rules_for_parameters(cost, sets):
    case = setup(cost, 3, **sets)
    step = ExactStep(case.system, cost)
    step.prepare(3)
    assert step._programs[3].problem.is_dcp(dpp=True)


@pytest.mark.parametrize("loss", [Quadratic, Huber, Power])
@pytest.mark.parametrize("per_component", [False, True])
def test_missing_outputs_have_no_say(loss, per_component):
    noise = Quadratic(R2) if loss is Quadratic else loss(R2, 1.5, per_component)
    cost = RobustCost(prior=P0, disturbance=Q2, noise=noise)
    missing = ((0, 1), (2, 0), (3, 0), (3, 1))
    case = setup(cost, 5, h=both, missing=missing)
    found = solve(case)
    assert found.solved
    d, least = brute_force(case, found.d + 0.05)
    assert found.predicted == pytest.approx(least, rel=1e-6)
    np.testing.assert_allclose(found.d, d, atol=1e-3)
    # Any number in place of what is missing gives the same.
    for time, component in missing:
        case.trial.residuals[time, 2 + component] = 1e3
    np.testing.assert_allclose(solve(case).d, found.d, atol=1e-6)


@pytest.mark.parametrize("rows", [[], [[1.0, 1.0], [0.0, -1.0]]])
def test_rows_of_missing_outputs_are_void(rows):
    cost = RobustCost(prior=P0, disturbance=Q2, noise=Huber(R2))
    narrow, free = Box([-3.0, -1e-4], [9.0, 1e-4]), Box([-3.0, -np.inf], [9.0, np.inf])
    for row in rows:
        narrow = narrow & Polytope([row], [1e-4])
    missing = [(time, 1) for time in range(4)]
    found = solve(setup(cost, 4, h=both, missing=missing, noises=narrow))
    expected = solve(setup(cost, 4, h=both, missing=missing, noises=free))
    assert found.solved
    assert found.predicted == pytest.approx(expected.predicted, rel=1e-8)
    # With all of y there, they bind.
    case = setup(cost, 4, h=both, missing=missing, noises=narrow)
    case.problem.observed = None
    bound = solve(case)
    assert not bound.solved or bound.predicted > found.predicted * 1.001


@pytest.mark.parametrize("per_component", [False, True])
def test_weight_of_one_sample_is_used(per_component):
    noise = Huber(R2, 0.8, per_component)
    case = setup(RobustCost(prior=P0, disturbance=Q2, noise=noise), 4, h=both)
    usual = solve(case)
    # A loss per component has no use for what is off the diagonal.
    own = np.array([[900.0, 50.0], [50.0, 40.0]])
    case.window.push(np.array([1.0, 0.0]), np.zeros(0), noise_weight=own)
    case.problem.bind(case.window)
    case.trial = case.problem.candidate(case.window)
    case.jacobian = case.window.terms.jacobian[: case.window.end]
    found = solve(case)
    d, least = brute_force(case, found.d + 0.05)
    assert found.predicted == pytest.approx(least, rel=1e-6)
    np.testing.assert_allclose(found.d, d, atol=1e-3)
    assert found.d.shape != usual.d.shape


def test_weight_of_the_prior_follows_the_observer():
    cost = RobustCost(prior=ObserverPrior(), disturbance=Q2, noise=Huber(R1, 0.8))
    observer = ExtendedKalman(
        prior=np.linalg.inv(P0), disturbance=np.linalg.inv(Q2), noise=np.linalg.inv(R1)
    )
    case = setup(cost, 9, observer=observer)
    weight = np.linalg.inv(case.window.prior_covariance)
    assert not np.allclose(weight, P0)
    found = solve(case)
    case.cost.prior = weight
    d, least = brute_force(case, found.d + 0.05)
    assert found.predicted == pytest.approx(least, rel=1e-6)
    np.testing.assert_allclose(found.d, d, atol=1e-3)


def test_noise_free_components_hold_to_rounding():
    cost = RobustCost(prior=P0, disturbance=Q2, noise=Huber(R1, 0.8))
    case = setup(cost, 6, observer=Luenberger([0.0, 0.1]), **SETS["noise-free"])
    found = solve(case)
    moved = case.trial.residuals[:, 0] + found.d[1:, 0]
    moved -= np.einsum("kj,kj->k", case.jacobian[:, 0], found.d[:-1])
    assert np.abs(moved).max() <= 1e-8
    after = case.problem.evaluate(case.trial.trajectory + found.d)
    assert after.cost < case.trial.cost


@pytest.mark.parametrize("what", ["trajectory", "residuals", "jacobian", "prior"])
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_data_that_are_not_finite_are_refused(what, number):
    case = setup(ROBUST["huber"], 3)
    case.trial.trajectory = case.trial.trajectory.copy()
    case.problem.prior = case.problem.prior.copy()
    array = {
        "trajectory": case.trial.trajectory, "residuals": case.trial.residuals,
        "jacobian": case.jacobian, "prior": case.problem.prior,
    }[what]
    array[0] = number
    found = solve(case)
    assert found.d is None
    assert not found.solved
    assert found.status is SolveStatus.FAILED
    assert found.message == "the subproblem's data are not finite"
    assert np.isnan(found.predicted)


def test_sets_that_exclude_each_other_fail_with_a_message():
    # The state may not move at all, and yet must move by at least 1 against its model.
    case = setup(
        ROBUST["huber"], 3, f=linear, states=Box([0.2, 0.2], [0.4, 0.4]),
        disturbances=Box([1.0, 1.0], [2.0, 2.0]),
    )
    found = solve(case)
    assert found.d is None
    assert found.status is SolveStatus.FAILED
    assert "infeasible" in found.message


@pytest.mark.parametrize(
    ("error", "words"),
    [(RuntimeError("out of luck"), "RuntimeError: out of luck"),
     (MemoryError("too large"), "MemoryError: too large"),
     (None, "Clarabel failed: cannot")],
)
def test_failures_of_the_solver_are_contained(error, words, monkeypatch):
    import cvxpy

    case = setup(ROBUST["huber"], 3)
    step = ExactStep(case.system, case.cost)
    error = cvxpy.SolverError("cannot") if error is None else error

    def fail(self, **options):
        raise error

    monkeypatch.setattr(cvxpy.Problem, "solve", fail)
    found = solve(case, step)
    assert found.d is None
    assert found.status is SolveStatus.FAILED
    assert found.message == words
    monkeypatch.undo()
    assert solve(case, step).solved


def test_second_tolerance_is_tried_where_the_first_fails(monkeypatch):
    import cvxpy

    case, tolerances, given = setup(ROBUST["huber"], 3), [], cvxpy.Problem.solve

    def fussy(self, **options):
        tolerances.append(options["tol_feas"])
        if len(tolerances) == 1:
            raise cvxpy.SolverError("too tight")
        return given(self, **options)

    monkeypatch.setattr(cvxpy.Problem, "solve", fussy)
    assert solve(case).solved
    assert tolerances == [1e-10, 1e-8]


def test_iterate_without_the_solvers_word_is_handed_on_as_stopped(monkeypatch):
    import cvxpy

    case, given = setup(ROBUST["huber"], 3), cvxpy.Problem.solve

    def capped(self, **options):
        value = given(self, **options)
        self._status = cvxpy.OPTIMAL_INACCURATE
        return value

    monkeypatch.setattr(cvxpy.Problem, "solve", capped)
    found = solve(case)
    assert found.status is SolveStatus.STOPPED
    assert not found.solved
    assert found.message == "Clarabel reports optimal_inaccurate"
    assert found.predicted == pytest.approx(objective(case, found.d), rel=1e-12)


class Mine(Huber):
    """A subclass may mean another function."""


def test_losses_that_it_does_not_know_are_named():
    system = System(curved, first, n=2, p=1)
    cost = RobustCost(prior=P0, disturbance=Q2, noise=Mine(R1))
    with pytest.raises(qpmhe.errors.OptionError, match=r"the loss Mine .*expected Quadratic"):
        ExactStep(system, cost)


def test_costs_that_it_does_not_know_are_named():
    with pytest.raises(qpmhe.errors.OptionError, match=r"cost is 3; .*QuadraticCost"):
        ExactStep(System(curved, first, n=2, p=1), 3)


@pytest.mark.parametrize("cost", ROBUST.values(), ids=ROBUST)
@pytest.mark.parametrize("seed", range(3))
def test_sequence_of_exact_steps_lowers_the_true_cost(cost, seed):
    """Judged as the optimizer judges, with the step halved where it is too long."""
    case = setup(cost, 6, seed=seed, states=Box([-3.0, -3.0], [3.0, 3.0]))
    step, subproblem = ExactStep(case.system, cost), Subproblem(case.system, cost, 6)
    begun = case.trial.cost
    for _ in range(30):
        found = solve(case, step)
        assert found.predicted <= case.trial.cost * (1 + 1e-8)
        for length in 0.5 ** np.arange(12.0):
            trial = case.problem.evaluate(case.trial.trajectory + length * found.d)
            if trial.cost < case.trial.cost:
                break
        else:
            break
        case.trial = trial
        assert subproblem.at(case.problem, trial) is not None
        case.jacobian = subproblem._terms.jacobian[:6].copy()
    assert case.trial.cost < 0.9 * begun
    # Where it ends, linearised and true cost have the same minimum.
    assert solve(case, step).predicted == pytest.approx(case.trial.cost, rel=1e-5)
