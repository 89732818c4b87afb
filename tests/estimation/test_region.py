"""The region of steps of QPs without inequalities, and the dogleg in it."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.estimation.region import Dogleg
from tests.estimation.test_damping import NO_WIDTH, estimator, samples
from tests.oracles.nist import regression
from tests.solvers.problems import registered


def qp_around(sets):
    """A QP around a trajectory that is not the minimum, and its metric."""
    mhe = estimator(sets=sets, max_qps=3)
    for y in samples(6):
        mhe.update(y)
    problem, subproblem = mhe._engine.solved().problem, mhe._engine._tools.subproblem
    trial = problem.evaluate(problem.candidate.trajectory + 0.01)
    return subproblem.at(problem, trial), subproblem.metric(problem, trial)


def test_a_path_without_length_or_numbers_promises_nothing():
    """As where the QP's step is rounding, or weights and steps are beyond the range of numbers."""
    qp, metric = qp_around(None)
    none = np.zeros((len(metric.slopes) + 1, 3))
    lost = metric._replace(spread=lambda _, force: np.full_like(force, np.nan))
    for one, end in ((lost, none), (lost, none * np.nan), (lost, none + 1e200)):
        path = Dogleg(one, qp, end, 1.0)
        for radius in (path.length / 3.0, np.nan):
            assert not path.step(radius)[1] > 0.0


@pytest.mark.parametrize("sets", [None, NO_WIDTH], ids=["all disturbed", "a constant"])
def test_the_dogleg_is_powells(sets):
    """By dense matrices, in d(0) and the disturbances that are free."""
    qp, metric = qp_around(sets)
    n, count = 3, len(metric.slopes)
    weights = np.broadcast_to(metric.weights, (count, *metric.weights.shape[-2:]))[:, :n, :n]
    free = np.delete(np.eye(n), [] if sets is None else [1], axis=1)
    k = free.shape[1]
    follow = np.zeros((count + 1, n, n + count * k))
    follow[0, :, :n] = np.eye(n)
    scale = np.zeros((n + count * k,) * 2)
    scale[:n, :n] = np.diag(metric.information)
    for i, (a, q) in enumerate(zip(-metric.slopes[:, :n], weights, strict=True)):
        own = slice(n + i * k, n + (i + 1) * k)
        follow[i + 1] = a @ follow[i]
        follow[i + 1][:, own] += free
        scale[own, own] = free.T @ q @ free
    follow = follow.reshape(-1, n + count * k)
    hessian, gradient = follow.T @ qp.dense() @ follow, follow.T @ qp.gradient.ravel()
    inner = np.linalg.solve(hessian, -gradient)
    step, predicted = (follow @ inner).reshape(-1, n), -gradient @ inner
    path = Dogleg(metric, qp, step, predicted)
    assert path.length == pytest.approx(np.sqrt(inner @ scale @ inner), rel=1e-9)
    down = -np.linalg.solve(scale, gradient)
    np.testing.assert_allclose(
        metric.descent(qp.gradient).ravel(), follow @ down, rtol=1e-6, atol=1e-9 * abs(down).max()
    )
    cauchy = down * (-(gradient @ down) / (down @ hessian @ down))
    short, lengths = np.sqrt(cauchy @ scale @ cauchy), []
    assert short < path.length
    for radius in (0.3 * short, short, 0.7 * short + 0.3 * path.length, path.length):
        found, gained = path.step(radius)
        lengths.append(metric.length(found))
        assert gained == pytest.approx(-2.0 * qp.objective(found), rel=1e-6)
        if radius <= short:
            expected = follow @ cauchy * (radius / short)
            np.testing.assert_allclose(found.ravel(), expected, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(lengths, [
        0.3 * short, short, 0.7 * short + 0.3 * path.length, path.length,
    ], rtol=1e-6)
    np.testing.assert_allclose(path.step(path.length)[0], step, rtol=1e-6, atol=1e-9)


needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")


def agree(found, expected):
    seen = ~Status.SOLVER_STOPPED
    assert (found.status & seen, found.qps) == (expected.status & seen, expected.qps)
    np.testing.assert_allclose(found.filtered, expected.filtered, rtol=1e-5)
    assert found.cost == pytest.approx(expected.cost, rel=1e-6)


@needs_compiler
@pytest.mark.parametrize("name", ["Eckerle4", "BoxBOD", "MGH17"])
def test_both_engines_decide_alike(name):
    """Along a sequence of QPs of which some have shorter steps, wherever a cap ends it."""
    data = regression(name)
    for max_qps in (1, 2, 3, 5, 9, 14):
        agree(*(data.fit(data.start, "set", max_qps, one) for one in ("compiled", "python")))


@needs_compiler
@pytest.mark.parametrize("sets", [None, NO_WIDTH], ids=["all disturbed", "a constant"])
@pytest.mark.parametrize("max_qps", [2, None])
def test_both_engines_shorten_alike(sets, max_qps):
    """Also where disturbances are part of the metric."""
    found, expected = (estimator(one, sets=sets, max_qps=max_qps) for one in ("compiled", "python"))
    for y in samples():
        agree(found.update(y), expected.update(y))


def test_a_usual_sequence_has_no_region(monkeypatch):
    """Where J falls about as predicted, nothing is computed for a region."""
    def fail(*_):
        raise AssertionError("a usual step has computed a metric")

    monkeypatch.setattr(qpmhe.estimation.subproblem.Subproblem, "metric", fail)
    example = qpmhe.models.van_der_pol()
    _, measurements = example.scenario.simulate(0, 30)
    mhe = qpmhe.MovingHorizonEstimator(
        *example[:3], horizon=example.scenario.horizon, max_qps=None,
        initial_state=example.scenario.initial_estimate, engine="python",
    )
    for y in measurements:
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost


def test_a_step_without_length_is_not_shortened():
    """A solver that stops where it starts, at J = 0: there is no direction of descent either."""
    class Still(qpmhe.solvers.Solver):
        def _solve(self, qp, start):
            return qpmhe.solvers.RawSolution(np.zeros(qp.size), False)

    zero = np.zeros(1)
    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost.from_covariances(prior=[[1.0]], disturbance=[[1.0]], noise=[[1.0]])
    with registered(qpmhe.solvers.Backend("still", Still, "none at all")):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([[0.0]]), cost, horizon=3, initial_state=zero,
            backend="still", max_qps=2,
        )
        for _ in range(4):
            estimate = mhe.update(zero)
            assert (estimate.cost, estimate.filtered) == (0.0, 0.0)
            assert estimate.status & Status.SOLVER_STOPPED
