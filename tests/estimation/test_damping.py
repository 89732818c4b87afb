"""The damping of a QP where no step has lowered J."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.solvers import RawSolution, Solver, SolverOptions
from tests.oracles.nist import regression

ENGINES = ["python", pytest.param("compiled", marks=pytest.mark.skipif(
    find_compiler() is None, reason="there is no C compiler"
))]
engines = pytest.mark.parametrize("engine", ENGINES)
Y = 2.0 * np.exp(-0.5 * np.arange(12)) + 0.02 * np.random.default_rng(4).standard_normal(12)


def move(x):
    """A decay, its logarithmic rate, and a state beside them."""
    rate = np.exp(x[..., 1])
    return np.stack(
        [x[..., 0] * np.exp(-rate), x[..., 1], 0.5 * x[..., 2] + np.sin(x[..., 0])], axis=-1
    )


def output(x):
    return np.stack([x[..., 0], x[..., 2] * x[..., 0]], axis=-1)


def estimator(engine="python", spread=1e-2, sets=None, start=(30.0, 3.0, -2.0), **options):
    """Far from the truth, where full and shortened steps raise J."""
    system = qpmhe.System(move, output, n=3, p=2, disturbances=sets)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.diag([25.0, 9.0, 1.0]), disturbance=spread**2 * np.eye(3),
        noise=np.diag([4e-4, 1.0]), discount=0.95,
    )
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.zeros((3, 2))), cost, horizon=8, initial_state=start,
        engine=engine, **options,
    )


def samples(count=12):
    return [np.array([y, 0.1 * y]) for y in Y[:count]]


NO_WIDTH = qpmhe.Box([-np.inf, 0.0, -np.inf], [np.inf, 0.0, np.inf])


@pytest.mark.parametrize("sets", [None, NO_WIDTH], ids=["all disturbed", "a constant"])
def test_the_damped_hessian_is_the_formula(sets):
    mhe = estimator(sets=sets, max_qps=0)
    for y in samples(5):
        mhe.update(y)
    other = estimator(sets=sets, max_qps=1)
    other.load_state_dict(mhe.state_dict())
    other.update(samples(6)[-1])
    engine = other._engine
    problem, subproblem = engine.solved().problem, engine._tools.subproblem
    trial = problem.evaluate(problem.candidate.trajectory + 0.01)
    qp = subproblem.at(problem, trial)
    plain, gradient = qp.dense(), qp.gradient.copy()
    n, count, mu = 3, len(trial.residuals), 0.7
    a = problem.model.f_jacobian.batch(trial.trajectory[:-1], problem.inputs)
    c = problem.model.h_jacobian.batch(trial.trajectory[:-1], problem.inputs)
    weights = np.broadcast_to(trial.weights, (count, 5, 5))
    # In d(0) and the disturbances that are free: all other increments follow.
    free = np.delete(np.eye(n), [] if sets is None else [1], axis=1)
    k = free.shape[1]
    follow = np.zeros((count + 1, n, n + count * k))
    follow[0, :, :n] = np.eye(n)
    expected, information = np.zeros_like(plain), np.zeros((n + count * k,) * 2)
    prior = problem.prior.weight_of_first(trial)
    information[:n, :n] = prior
    for i in range(count):
        own, at = slice(n + i * k, n + (i + 1) * k), slice(i * n, (i + 2) * n)
        q, r = weights[i, :n, :n], weights[i, n:, n:]
        follow[i + 1] = a[i] @ follow[i]
        follow[i + 1][:, own] += free
        information[own, own] += free.T @ q @ free
        information += follow[i].T @ c[i].T @ r @ c[i] @ follow[i]
        change = np.hstack((-a[i], np.eye(n)))
        expected[at, at] += change.T @ q @ change
    left = information[:n, n:] @ np.linalg.solve(information[n:, n:], information[n:, :n])
    expected[:n, :n] += np.diag((information[:n, :n] - left).diagonal())
    subproblem.damp(qp, problem, trial, mu)
    size = np.sqrt(np.multiply.outer(*[plain.diagonal()] * 2))
    np.testing.assert_allclose(qp.dense() / size, (plain + mu * expected) / size, atol=1e-9)
    np.testing.assert_array_equal(qp.gradient, gradient)
    subproblem.damp(qp, problem, trial, 0.0)
    np.testing.assert_array_equal(qp.dense(), plain)


def test_a_little_damping_hardly_shortens_the_step_of_a_constant():
    """The diagonal of the trajectory's Hessian would leave a third of it."""
    system = qpmhe.System(lambda x: x, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=[[1e4]], disturbance=[[1e-6]], noise=[[1.0]]
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.0]), cost, horizon=20, initial_state=[0.0]
    )
    for _ in range(20):
        mhe.update([1.0])
    problem, subproblem = mhe._engine.solved().problem, mhe._engine._tools.subproblem
    qp = subproblem.at(problem, problem.candidate)
    full = np.linalg.solve(qp.dense(), -qp.gradient.ravel())
    subproblem.damp(qp, problem, problem.candidate, 1e-6)
    damped = np.linalg.solve(qp.dense(), -qp.gradient.ravel())
    np.testing.assert_allclose(damped / full, 1.0, atol=1e-5)


@engines
def test_a_search_goes_on_until_it_converges(engine):
    mhe, spent = estimator(engine, max_qps=None), 0
    for y in samples():
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost
        assert Status.NO_DECREASE not in estimate.status
        assert Status.CONVERGED in estimate.status
        spent += estimate.qps
    assert spent > 12


@engines
@pytest.mark.parametrize("form", ["wide set", "wide small"])
def test_a_cap_is_called_the_cap(engine, form):
    data, capped = regression("Rat43"), []
    mhe = data.estimator(data.start, form, 3, engine)
    for y, x in zip(data.y, data.x, strict=True):
        estimate = mhe.update([y], [x])
        assert estimate.cost <= estimate.candidate_cost
        if Status.CAP_REACHED in estimate.status:
            assert not estimate.status & (Status.NO_DECREASE | Status.CONVERGED)
            assert estimate.qps == 3
            assert "max_qps" in estimate.explain()
            capped.append(estimate)
    assert capped


@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize("form", ["wide set", "wide small"])
def test_both_engines_decide_alike(form):
    """Along a sequence of QPs of which some are damped, wherever a cap ends it."""
    data, ends = regression("Rat42"), []
    for max_qps in (3, 4, 5, 9):
        expected, found = (
            data.fit(data.start, form, max_qps, engine) for engine in ("python", "compiled")
        )
        seen = ~Status.SOLVER_STOPPED
        assert (found.status & seen, found.qps) == (expected.status & seen, expected.qps)
        np.testing.assert_allclose(found.filtered, expected.filtered, rtol=1e-5)
        ends.append(Status.CAP_REACHED in found.status)
    assert any(ends)
    assert not all(ends)


class Upwards(Solver):
    def _solve(self, qp, start):
        return RawSolution(qp.gradient.copy(), True)


@pytest.mark.parametrize("bounded", [True, False])
def test_steps_of_a_solver_that_lead_upwards_end_before_the_cap(bounded):
    wide = qpmhe.Box(np.full(3, -1e9), np.full(3, 1e9)) if bounded else None
    system = qpmhe.System(move, output, n=3, p=2, states=wide)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.eye(3), disturbance=0.01 * np.eye(3), noise=np.eye(2)
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.zeros((3, 2))), cost, horizon=4, initial_state=[1.0, 0.0, 0.0],
        max_qps=None, backend=Upwards(SolverOptions()),
    )
    for y in samples(5):
        estimate = mhe.update(y)
        seen = estimate.status & ~Status.SOLVER_STOPPED  # its residuals are checked
        assert seen == Status.CANDIDATE | Status.NO_DECREASE
        assert 2 < estimate.qps < 20


@engines
def test_the_damping_is_remembered(engine):
    """By snapshots, and by what undoes a step; a reset forgets it."""
    data = regression("Rat43")
    mhe, other = (data.estimator(data.start, "wide set", 3, engine) for _ in range(2))
    record = [*zip(data.y[:, None], data.x[:, None], strict=True)]
    found = [mhe.update(*one) for one in record[:7]]
    assert Status.CAP_REACHED in found[-1].status
    state = mhe.state_dict()
    rest = [mhe.update(*one) for one in record[7:]]
    for _ in range(2):
        other.load_state_dict(state)
        for one, expected in zip(record[7:], rest, strict=True):
            again = other.update(*one)
            assert (again.cost, again.qps, again.status) == (
                expected.cost, expected.qps, expected.status
            )
            np.testing.assert_array_equal(again.trajectory, expected.trajectory)
    mhe.reset()
    for one, expected in zip(record, found, strict=False):
        again = mhe.update(*one)
        assert (again.cost, again.status) == (expected.cost, expected.status)
