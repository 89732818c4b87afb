"""Each term of J against differences of its cost: its quadratic model, and its derivatives."""

import math
from copy import copy

import numpy as np
import pytest

import qpmhe
from qpmhe.terms import soft
from qpmhe.terms.base import Derivatives, QuadraticModel
from qpmhe.terms.linearization import Span, StageTerms
from qpmhe.terms.soft import Softened
from qpmhe.terms.sum import weight_of_first
from qpmhe_solvers import QP, SolverOptions, SolveStatus
from qpmhe_solvers.backend import make_solver
from qpmhe_solvers.native import NATIVE
from qpmhe_solvers.qp import band_of
from tests.codegen.cases import case

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")

CASES = {
    "inputs": {"Stages", "Prior"},  # with a discount
    "huber everywhere": {"Stages", "Prior"},
    "extended prior": {"Stages", "Prior"},  # about a smoothed mean
    "angles, conditions": {"Stages", "Prior"},
    "held with gaps": {"Stages", "Prior", "WindowHold"},
    "held, graduated": {"Stages", "Prior", "WindowHold"},
}


def solved(name, samples=12):
    """The problem of the last window, without a verdict of sets, and a trajectory near it."""
    one = case(name)
    mhe = one.estimator("python")
    for sample in one.samples[:samples]:
        mhe.update(**sample)
    problem = copy(mhe._engine.solved().problem)
    problem.constrained = False
    generator = np.random.default_rng(samples)
    x = problem.candidate.trajectory
    away = 0.05 * generator.standard_normal(x.shape) * (1.0 + np.abs(x))
    return problem, x + away, away


def at(problem, x):
    trial = problem.evaluate(x, roll_out=False)
    assert np.isfinite(trial.cost)
    return trial


def model_of(problem, term, trial):
    """Band and gradient of one term."""
    count, n = trial.trajectory.shape[0] - 1, trial.trajectory.shape[1]
    qp = QP(count + 1, n, 0)
    qp.band[...] = qp.gradient[...] = 0.0
    model = QuadraticModel(qp)
    model.span, model.is_candidate, model.slopes = linearised(problem, trial), False, None
    term.add_model(model, trial)
    return qp.band, qp.gradient


def linearised(problem, trial):
    states, count = trial.trajectory[:-1], len(trial.residuals)
    p = trial.residuals.shape[1] - states.shape[1]
    terms = StageTerms(count, states.shape[1], p)
    terms.linear[:, :, 0] = trial.residuals
    terms.linear[:, :, 1:] = -jacobian(problem, states)
    terms.set_all(count, trial.weights)
    return Span(terms, 0, count)


def jacobian(problem, states):
    both = problem.model.f_jacobian, problem.model.h_jacobian
    return np.concatenate([np.asarray(one.batch(states, problem.inputs)) for one in both], axis=1)


def derivatives(term, trial):
    """The derivatives of one term along a trial."""
    sums = Derivatives(len(trial.residuals), trial.trajectory.shape[1], trial.residuals.shape[1])
    term.derivative(trial).add_to(sums)
    return sums


def difference(function, step):
    """The derivative of a function of a number at 0, by differences of fourth order."""
    near, far = (function(k * step) - function(-k * step) for k in (1, 2))
    return (8.0 * near - far) / (12.0 * step)


def slope(problem, term, x, d):
    """The derivative of a term at x along d."""
    return difference(lambda s: term.cost(at(problem, x + s * d)), 1e-3)


@pytest.mark.parametrize("name", CASES)
def test_models_and_derivatives_are_those_of_the_costs(name):
    problem, x, d = solved(name)
    assert {type(term).__name__ for term in problem.terms} == CASES[name]
    trial, n = at(problem, x), x.shape[1]
    assert trial.cost == pytest.approx(sum(term.cost(trial) for term in problem.terms), rel=1e-14)
    slopes = jacobian(problem, x[:-1])
    for term in problem.terms:
        expected = slope(problem, term, x, d)
        band, gradient = model_of(problem, term, trial)
        size = 1e-6 * (1e-3 + abs(expected))
        assert 2.0 * np.vdot(gradient, d) == pytest.approx(expected, rel=1e-6, abs=size)
        # The derivative by states and residuals is the same, and so is the model's Hessian.
        sums = derivatives(term, trial)
        moved = -np.einsum("kqn,kn->kq", slopes, d[:-1])
        moved[:, :n] += d[1:]
        found = np.vdot(sums.on_states, d) + np.vdot(sums.on_residuals, moved)
        assert found == pytest.approx(2.0 * np.vdot(gradient, d), rel=1e-9, abs=size)
        own = sums.majorised_states.copy()
        own[:-1] += slopes.transpose(0, 2, 1) @ sums.majorised_residuals @ slopes
        own[1:] += sums.majorised_residuals[:, :n, :n]
        columns = np.concatenate((own, np.zeros_like(own)), axis=1)
        columns[:-1, n:] = -(sums.majorised_residuals @ slopes)[:, :n]
        np.testing.assert_allclose(
            2.0 * band, band_of(columns), rtol=1e-9, atol=1e-11 * np.abs(band).max()
        )


@pytest.mark.parametrize("name", CASES)
def test_second_derivatives_are_those_of_the_first_ones(name):
    problem, x, d = solved(name)
    for term in problem.terms:
        def first(s, term=term):
            trial = at(problem, x + s * d)
            sums = derivatives(term, trial)
            return np.append(sums.on_states.ravel(), sums.on_residuals.ravel()), trial.residuals

        sums = derivatives(term, at(problem, x))
        moved = difference(lambda s: first(s)[1], 1e-3)
        expected = difference(lambda s: first(s)[0], 1e-3)
        found = np.append(
            np.einsum("kij,kj->ki", sums.bent_states, d).ravel(),
            np.einsum("kij,kj->ki", sums.bent_residuals, moved).ravel(),
        )
        np.testing.assert_allclose(
            found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max(), err_msg=name
        )


@pytest.mark.parametrize(
    "name", ["fewer disturbances", "held, fewer disturbances", "constraints, noise-free"]
)
def test_an_elimination_solves_the_qp_of_all_terms(name):
    """Its rows are not made from the QP, but beside it."""
    one = case(name)
    mhe = one.estimator("python")
    for sample in one.samples[:12]:
        mhe.update(**sample)
    problem, subproblem = mhe._engine.solved().problem, mhe._engine._tools.subproblem
    qp = subproblem.at(problem, problem.candidate)
    found = subproblem._elimination.of(subproblem._around, qp, subproblem._w)
    assert np.abs(found.step).max() > 1e-6
    # Of half of J, in the directions that are free: no slope, and the identity for curvature.
    slope = np.einsum("kij,ki->j", found.along, qp.hessian_times(found.step) + qp.gradient)
    size = np.abs(np.einsum("kij,ki->j", np.abs(found.along), np.abs(qp.gradient))).max()
    np.testing.assert_allclose(slope, 0.0, atol=1e-10 * size)
    along = found.along.reshape(qp.size, -1)
    np.testing.assert_allclose(along.T @ qp.dense() @ along, np.eye(along.shape[1]), atol=1e-10)


def test_the_weight_of_the_first_state_is_that_of_prior_and_hold():
    problem, x, _ = solved("held with gaps")
    trial = at(problem, x)
    expected = problem.prior.weight.copy()
    held = np.ix_(problem.hold.components, problem.hold.components)
    expected[held] += problem.hold.weight
    np.testing.assert_allclose(weight_of_first(problem.terms, trial), expected, rtol=1e-14)


def test_soft_rows_are_a_term():
    soft = qpmhe.Box([-0.1], [0.2]).soften(linear=3.0, quadratic=5.0)
    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1, noises=soft)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.3]), cost, horizon=3, initial_state=[0.0], engine="python"
    )
    for y in (0.3, -0.4, 0.1):
        mhe.update([y])
    problem = mhe._engine.solved().problem
    trial = at(problem, np.zeros((4, 1)))  # so that each noise is its measurement
    penalty = problem.terms[-1]
    missed = np.array([0.3 - 0.2, 0.4 - 0.1, 0.0])
    assert penalty.cost(trial) == pytest.approx(np.sum(3.0 * missed + 5.0 * missed**2), rel=1e-14)
    (rows,) = penalty.soft_rows(trial)
    np.testing.assert_array_equal(rows.values[:, 0], [0.3, -0.4, 0.1])
    assert trial.penalty == penalty.cost(trial)


@pytest.mark.parametrize(
    "name", ["soft disturbances and noises", "soft angles", "soft constraints"]
)
def test_each_correction_shifts_soft_rows_to_their_true_values(name):
    """Also the second one, which finds the rows of the first."""
    one = case(name)
    mhe = one.estimator("python")
    for sample in one.samples[:8]:
        mhe.update(**sample)
    problem, subproblem = mhe._engine.solved().problem, mhe._engine._tools.subproblem
    around, generator = problem.candidate, np.random.default_rng(1)
    qp = subproblem.at(problem, around)
    for size in (0.3, 0.2):
        away = size * generator.standard_normal(around.trajectory.shape)
        trial = at(problem, around.trajectory + away)
        subproblem.correct_rows(qp, problem, around, trial)
        rows = subproblem._penalties.values(trial.trajectory, trial.residuals, trial.values)
        np.testing.assert_allclose(subproblem._softened.at(away), rows, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", [
    "soft states, hard noises", "soft noises, hard states", "constraints and soft sets",
    "soft states, narrow noises",
])
@pytest.mark.parametrize("backend", [None, "piqp"])
def test_soft_rows_are_solved_exactly_beside_active_hard_ones(monkeypatch, name, backend):
    """Without a named backend from no forces, otherwise from those in its answer."""
    exact, beside = Softened._exact, []

    def watched(self, base, d, forces, deadline):
        found = exact(self, base, d, forces, deadline)
        hard = (forces if d is not None or found is None else found[1])[:, :, self._size :]
        beside.append((hard.max(initial=0.0) > 1e-3, found is not None))
        return found

    monkeypatch.setattr(Softened, "_exact", watched)
    one = case(name)
    mhe = one.estimator("python", **({} if backend is None else {"backend": backend}))
    for sample in one.samples:
        mhe.update(**sample)
    solved = [is_exact for is_active, is_exact in beside if is_active]
    assert len(solved) > 2
    assert all(solved)


@pytest.mark.parametrize("name", [
    "soft states, hard noises", "soft noises, hard states", "constraints and soft sets",
    "soft states, narrow noises", "soft disturbances and noises", "soft constraints",
])
def test_solutions_found_directly_are_those_with_slack_variables(monkeypatch, name):
    directly, found = Softened.directly, []
    solver, largest = make_solver(NATIVE["piqp"], SolverOptions()), 0.0

    def watched(self, base, deadline):
        nonlocal largest
        one = directly(self, base, deadline)
        other = self.lowered(base, solver.solve(self.lifted(base)))
        assert other.status is SolveStatus.SOLVED
        largest = max(largest, np.abs(other.d).max())  # steps of later QPs vanish
        if one is not None:
            assert np.abs(one.d - other.d).max() <= 1e-9 * largest
            forces = np.abs(other.row_duals).max()
            assert np.abs(one.row_duals - other.row_duals).max() <= 1e-6 * forces
        found.append(one is not None)
        return one

    monkeypatch.setattr(Softened, "directly", watched)
    one = case(name)
    mhe = one.estimator("python")
    for sample in one.samples:
        mhe.update(**sample)
    assert len(found) > 5
    assert np.mean(found) > 0.9


def test_no_search_for_active_rows_goes_on_behind_the_deadline(monkeypatch):
    directly, late = Softened.directly, []

    def watched(self, base, deadline):
        found = directly(self, base, deadline)
        if found is not None and found.iterations > 1:
            self.start()
            late.append(directly(self, base, -math.inf))
        return found

    monkeypatch.setattr(Softened, "directly", watched)
    one = case("soft disturbances and noises")
    mhe = one.estimator("python")
    for sample in one.samples:
        mhe.update(**sample)
    assert late
    assert not any(late)


@pytest.mark.parametrize("error", [MemoryError, np.linalg.LinAlgError])
def test_a_search_for_active_rows_that_fails_does_not_leave_update(monkeypatch, error):
    """The QP with slack variables takes its place, and its answer stays as it is."""
    def failing(*_):
        raise error

    one = case("soft states, hard noises")
    plain, mhe = one.estimator("python"), one.estimator("python")
    expected = [plain.update(**sample) for sample in one.samples]
    monkeypatch.setattr(soft, "minimised", failing)
    found = [mhe.update(**sample) for sample in one.samples]
    np.testing.assert_allclose(
        [each.cost for each in found], [each.cost for each in expected], rtol=1e-4
    )
