"""The converged sequence of QPs against Ipopt, an independent solver of the same program."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.studies import PaperStudy
from tests.properties.problems import Problem

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
BACKENDS = [
    name for name in ("osqp", "proxqp", "piqp", "daqp", "clarabel", "quadprog")
    if name in qpmhe.solvers.available()
]
CHANGING = ("weights", "parameters", "sensors", "inputs")
SETS = ("states", "disturbances", "noises")
# Features of random problems, how many are tried, and at least how many windows are compared.
CASES = {
    "weights, parameters and sensors change": (CHANGING, 6, 20),
    "bounds change, too": ((*CHANGING, *SETS, "bounds"), 6, 8),
    "disturbance matrix": (("matrix", "kalman"), 8, 20),
    "singular covariance": (("covariance", "kalman"), 6, 20),
    "disturbance matrix and sets": (("matrix", "kalman", *SETS), 10, 10),
    "tight sets": (("disturbances", "noises"), 10, 15),
    "tight polytopes": ((*SETS, "rows"), 10, 10),
    "nonlinear constraints": (("constraint", "inputs"), 16, 30),
    "nonlinear constraints and losses": (("constraint", "loss", "discount"), 8, 12),
    "soft sets": ((*SETS, "soft", "rows"), 12, 20),
    "soft sets and losses": ((*SETS, "soft", "loss", "discount", "missing"), 8, 12),
    "losses and gates": (("loss", "kalman", "rules", "outliers", "missing"), 12, 30),
    "uneven samples": (("ode", "irregular", "inputs", "missing", "discount"), 6, 20),
}


def compared(one, most, **options):
    """How many windows were compared, and those whose cost Ipopt undercuts from there as well."""
    options = {"max_qps": None, "horizon": 4, "candidate": "observer"} | options
    mhe, total, above = one.estimator(**options, infeasible="drop_rows"), 0, []
    for t, sample in enumerate(one.samples):
        estimate = one.update(mhe, sample)
        window, x = one.window(estimate), estimate.trajectory
        J, missed = window.judged(x)
        assert estimate.cost <= estimate.candidate_cost
        assert estimate.cost == pytest.approx(J, rel=1e-7, abs=1e-10) or (
            one.how and not estimate.improved  # the candidate's cost is that of its roll-out
        )
        if not one.how:
            J, _ = window.judged(estimate.candidate)
            assert estimate.candidate_cost == pytest.approx(J, rel=1e-7, abs=1e-10)
        assert missed <= 1e-6 or estimate.dropped or not estimate.improved
        if one.how and estimate.improved:
            d = estimate.disturbances if one.how == "covariance" else (
                estimate.disturbances @ one.G.T
            )
            ahead = [one.f(state, s.known, s.dt)
                     for state, s in zip(x, one.samples[t + 2 - len(x) :], strict=False)]
            np.testing.assert_allclose(x[1:], np.array(ahead)[: len(d)] + d, rtol=0, atol=1e-9)
        # While the first window fills, a widened loss is minimised in place of J.
        if t < 3 or t % 3 or total == most or Status.GRADUATED in estimate.status:
            continue
        minimum, _ = window.minimum(estimate.candidate)
        # Sets may leave no trajectory at a cost not above the candidate's.
        if not np.isfinite(minimum) or minimum > estimate.candidate_cost:
            continue
        total += 1
        # A lower local minimum than Ipopt's is none the worse, and a higher one is a minimum, too,
        # if Ipopt stays there.
        if estimate.cost > minimum * (1.0 + 1e-6) + 1e-12:
            minimum, _ = window.minimum(x)
        if estimate.cost > minimum * (1.0 + 1e-6) + 1e-12:
            above.append((t, estimate.cost, minimum, str(estimate.status)))
    return total, above


@pytest.mark.filterwarnings("ignore::qpmhe.ModelWarning")  # random models have long steps
@pytest.mark.parametrize("name", CASES)
def test_converged_cost_is_ipopts(name):
    features, seeds, least = CASES[name]
    total, above = 0, []
    for seed in range(seeds):
        found, more = compared(Problem([seed, 7], dict.fromkeys(features, 1.0)), 4)
        total += found
        above += [(seed, *one) for one in more]
    assert above == []
    assert total >= least


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("features", [
    SETS, (*SETS, "soft", "rows"), ("constraint", "noises"), ("disturbances", "soft", "matrix"),
], ids="+".join)
def test_every_backend_reaches_it(backend, features):
    one = Problem([BACKENDS.index(backend) % 2, 8], dict.fromkeys(features, 1.0))
    _, above = compared(one, 2, backend=backend, solver_tolerance=1e-9)
    assert above == []


@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("more", [("inputs",), ("noises", "soft", "missing")], ids="+".join)
def test_the_compiled_step_reaches_it_within_nonlinear_constraints(more, seed):
    one = Problem([seed, 9], dict.fromkeys(("constraint", *more), 1.0))
    total, above = compared(one, 3, engine="compiled", solver_tolerance=1e-9)
    assert above == []
    assert total >= 1


def test_trajectory_and_disturbances_are_those_of_python_control():
    ct = pytest.importorskip("control")
    opt = pytest.importorskip("control.optimal")
    A, B = np.array([[0.9, 0.2], [-0.1, 0.95]]), np.array([[0.0, 1.0], [1.0, 0.5]])
    P, Q, R = np.eye(2), [[0.01]], 0.04 * np.eye(2)
    rng, times = np.random.default_rng(0), np.arange(8)
    plant = ct.ss(A, B, np.eye(2), 0, True)  # a control and a disturbance
    U = np.vstack((np.sin(times), 0.1 * rng.standard_normal(8)))
    Y = ct.input_output_response(plant, times, U).outputs + 0.2 * rng.standard_normal((2, 8))

    trajectory_cost = opt.gaussian_likelihood_cost(plant, np.array(Q), R)
    problem = opt.OptimalEstimationProblem(
        plant, times, trajectory_cost, terminal_cost=lambda guess, x: (guess - x) @ (guess - x)
    )
    theirs = problem.compute_estimate(Y, U[:1], X0=np.zeros(2), print_summary=False)

    system = qpmhe.from_control(ct.ss(A, B[:, :1], np.eye(2), 0, True), disturbance_matrix=B[:, 1:])
    observer = qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R)
    cost = qpmhe.QuadraticCost.from_covariances(prior=P, disturbance=Q, noise=R)
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=8, initial_state=[0, 0])

    for y, u in zip(Y.T, U[:1].T, strict=True):
        estimate = mhe.update(y, u)
    np.testing.assert_allclose(estimate.trajectory[:-1], theirs.states.T, atol=1e-4)
    np.testing.assert_allclose(estimate.disturbances[:-1], theirs.inputs.T[:-1], atol=1e-4)


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("seed", [0, 1])
def test_converged_sequence_reaches_ipopts_minimum_on_every_window(seed, method):
    study = PaperStudy(seed, 40, method)
    system, observer, cost, scenario = study.model
    ipopt = study.ipopt(None)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=scenario.initial_estimate, max_qps=None
    )
    for y in study.record().measurements:
        ours, theirs = mhe.update(y), ipopt.update(y)
        assert theirs.message == "Solve_Succeeded"
        assert ours.candidate_cost == pytest.approx(theirs.candidate_cost, rel=1e-13)
        assert ours.cost == pytest.approx(theirs.cost, rel=1e-6)
        np.testing.assert_allclose(ours.trajectory, theirs.trajectory, atol=1e-4)


@pytest.mark.slow
def test_statistics_of_the_papers_example():
    """As computed independently: about 0.59, 0.313, 0.311; 0.29 and 0.209 after 3 s."""
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    errors = {i: [] for i in (0, 1, 2, None)}
    for seed in range(20):
        states, measurements = scenario.simulate(seed)
        for i, collected in errors.items():
            mhe = qpmhe.MovingHorizonEstimator(
                system, observer, cost, horizon=10,
                initial_state=scenario.initial_estimate, max_qps=i,
            )
            squares = np.sum((mhe.run(measurements).states - states) ** 2, axis=1)
            collected.append((np.sqrt(squares.mean()), np.sqrt(squares[30:].mean())))
    rmse = {i: np.mean(values, axis=0) for i, values in errors.items()}
    np.testing.assert_allclose(rmse[0], [0.59, 0.29], rtol=0.06)
    np.testing.assert_allclose(rmse[1], [0.313, 0.209], rtol=0.06)
    np.testing.assert_allclose(rmse[2], [0.311, 0.209], rtol=0.06)
    np.testing.assert_allclose(rmse[1], rmse[None], rtol=0.02)
