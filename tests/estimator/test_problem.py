import math

import numpy as np
import pytest

import qpmhe

from .plain import assembled, spd

NONE = np.zeros(0)


def nonlinear(n, p, m, **sets):
    generator = np.random.default_rng(n + p + m)
    a, b = 0.6 * generator.standard_normal((n, n)), generator.standard_normal((n, max(m, 1)))
    c = generator.standard_normal((p, n))
    if m:
        return qpmhe.System(
            lambda x, u: np.sin(x @ a.T) + u @ b.T,
            lambda x, u: x @ c.T + u[..., :1] * x[..., :1], n=n, p=p, m=m, **sets,
        )
    return qpmhe.System(
        lambda x: np.sin(x @ a.T), lambda x: x @ c.T + x[..., :1] ** 2, n=n, p=p, **sets
    )


def filled(system, cost, samples, *, horizon=4, observer=None, missing=0.0, seed=1):
    """A window after some samples, and its problem."""
    generator = np.random.default_rng(seed)
    observer = observer or qpmhe.Luenberger(0.1 * np.ones((system.n, system.p)))
    start = generator.standard_normal(system.n)
    window, formulation, _ = assembled(system, observer, cost, horizon, start)
    for _ in range(samples):
        y, u = generator.standard_normal(system.p), generator.standard_normal(system.m)
        y[generator.random(system.p) < missing] = np.nan
        window.push(y, u)
    return window, formulation.problem(window)


def random_cost(n, p, seed=2):
    generator = np.random.default_rng(seed)
    return qpmhe.QuadraticCost(
        prior=spd(generator, n), disturbance=spd(generator, n), noise=spd(generator, p)
    )


def square(vector, weight):
    return sum(
        vector[i] * weight[i, j] * vector[j]
        for i in range(len(vector))
        for j in range(len(vector))
    )


def plain_cost(system, cost, window, trajectory, prior_weight):
    """J from its definition: (eq:costfunction) with the weight of what is there."""
    total = square(trajectory[0] - window.candidate[0], prior_weight)
    for i, (x, u) in enumerate(zip(trajectory[:-1], window.inputs, strict=True)):
        total += square(trajectory[i + 1] - system.f(x, u), cost.disturbance)
        there = window.observed[i]
        v = (window.measurements[i] - system.h(x, u))[there]
        if there.any():
            total += square(v, np.linalg.inv(np.linalg.inv(cost.noise)[np.ix_(there, there)]))
    return total


@pytest.mark.parametrize("missing", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("samples", [1, 2, 4, 9])
@pytest.mark.parametrize("sizes", [(1, 1, 0), (2, 1, 1), (3, 2, 0), (2, 3, 2)])
def test_the_cost_of_any_trajectory(sizes, samples, missing):
    system, cost = nonlinear(*sizes), random_cost(*sizes[:2])
    window, problem = filled(system, cost, samples, missing=missing)
    generator = np.random.default_rng(3)
    for _ in range(5):
        trajectory = window.candidate + generator.standard_normal(window.candidate.shape)
        trial = problem.evaluate(trajectory)
        expected = plain_cost(system, cost, window, trajectory, cost.prior)
        assert trial.cost == pytest.approx(expected, rel=1e-11)
        assert trial.trajectory is trajectory


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("samples", [1, 9])
def test_residuals_and_their_weights(samples, missing):
    n, p = 2, 3
    system, cost = nonlinear(n, p, 1), random_cost(n, p)
    window, problem = filled(system, cost, samples, missing=missing)
    trajectory = window.candidate + np.random.default_rng(4).standard_normal(
        window.candidate.shape
    )
    trial = problem.evaluate(trajectory)
    for i, u in enumerate(window.inputs):
        w = trajectory[i + 1] - system.f(trajectory[i], u)
        v = window.measurements[i] - system.h(trajectory[i], u)
        np.testing.assert_allclose(trial.residuals[i, :n], w, rtol=1e-12, atol=1e-13)
        there = window.observed[i]
        np.testing.assert_allclose(trial.residuals[i, n:][there], v[there], rtol=1e-12)


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("samples", [1, 3, 9])
def test_the_candidate_has_no_prior_cost_and_its_stages_cost(samples, missing):
    system, cost = nonlinear(3, 2, 0), random_cost(3, 2)
    window, problem = filled(system, cost, samples, missing=missing)
    trial = problem.candidate
    np.testing.assert_array_equal(problem.prior, window.candidate[0])
    assert trial.cost == window.candidate_cost
    assert problem.evaluate(window.candidate.copy()).cost == pytest.approx(trial.cost, rel=1e-11)
    assert trial.cost == pytest.approx(
        plain_cost(system, cost, window, window.candidate, cost.prior), rel=1e-11
    )


def test_the_prior_weight_from_the_observer():
    system, generator = nonlinear(3, 2, 0), np.random.default_rng(5)
    observer = qpmhe.ExtendedKalman(
        prior=spd(generator, 3), disturbance=spd(generator, 3), noise=spd(generator, 2)
    )
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior(), disturbance=spd(generator, 3), noise=spd(generator, 2)
    )
    for samples in (1, 4, 9):
        window, problem = filled(system, cost, samples, observer=observer)
        weight = np.linalg.inv(window.prior_covariance)
        trajectory = window.candidate + generator.standard_normal(window.candidate.shape)
        found = problem.prior_weight_at(trajectory[0] - window.candidate[0])
        np.testing.assert_allclose(found, weight, rtol=1e-10, atol=1e-11)
        assert problem.evaluate(trajectory).cost == pytest.approx(
            plain_cost(system, cost, window, trajectory, weight), rel=1e-10
        )


def test_a_constant_prior_weight_ignores_the_observers_covariance():
    system, cost = nonlinear(2, 1, 0), random_cost(2, 1)
    observer = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)
    _, problem = filled(system, cost, 9, observer=observer)
    np.testing.assert_array_equal(problem.prior_weight_at(np.ones(2)), cost.prior)


# Sets


def plain_rows(name, box, points, weight, first):
    """The rows that points miss, each with its miss in the row's scale."""
    spread, found = np.sqrt(np.linalg.inv(weight).diagonal()), {}
    for k, j in np.ndindex(points.shape) if box else ():
        scale, s = min(spread[j], box.upper[j] - box.lower[j]), points[k, j]
        for side, missed in (("lower", box.lower[j] - s), ("upper", s - box.upper[j])):
            if missed > 0.0:
                found[name, j, side, first + k] = missed / scale
    return found


def roomy_sets(n, p):
    """Sets that hold every candidate here, with some open ends."""
    return {
        "states": qpmhe.Box([-20.0] * n, [20.0] * (n - 1) + [np.inf]),
        "disturbances": qpmhe.Box([-np.inf] + [-15.0] * (n - 1), [15.0] * n),
        "noises": qpmhe.Box([-20.0] * p, [25.0] * p),
    }


NAMES = ("states", "disturbances", "noises")


@pytest.mark.parametrize(
    "names",
    [(), ("states",), ("disturbances",), ("noises",), ("states", "noises"), NAMES],
    ids="-".join,
)
@pytest.mark.parametrize("sizes", [(1, 1, 0), (2, 1, 1), (3, 2, 0)])
def test_violation_and_cost_with_sets(sizes, names):
    n, p, _ = sizes
    sets = {name: box for name, box in roomy_sets(n, p).items() if name in names}
    system, cost = nonlinear(*sizes, **sets), random_cost(n, p)
    window, problem = filled(system, cost, 6)
    assert problem.candidate.violation == 0.0
    generator = np.random.default_rng(6)
    seen = set()
    for scale in [0.1, 1.0, 5.0, 10.0, 40.0] * 6:
        trajectory = window.candidate + scale * generator.standard_normal(window.candidate.shape)
        trial = problem.evaluate(trajectory)
        w, v = trial.residuals[:, :n], trial.residuals[:, n:]
        missed = plain_rows("states", system.states, trajectory, cost.prior, 2)
        missed |= plain_rows("disturbances", system.disturbances, w, cost.disturbance, 2)
        missed |= plain_rows("noises", system.noises, v, cost.noise, 2)
        expected = max(missed.values(), default=0.0)
        assert trial.violation == pytest.approx(expected, rel=1e-11, abs=1e-12)
        assert set(problem.missed_rows(trial)) == set(missed)
        seen.add(math.isfinite(trial.cost))
        if missed:
            assert trial.cost == math.inf
        else:
            assert trial.cost == pytest.approx(
                plain_cost(system, cost, window, trajectory, cost.prior), rel=1e-11
            )
    assert seen == ({True, False} if names else {True})


@pytest.mark.parametrize("stage", [0, 2, 4])
@pytest.mark.parametrize("beyond", [-1e-3, -1e-12, 1e-12, 1e-6])
def test_the_last_state_counts_and_rounding_does_not(stage, beyond):
    system = qpmhe.System(
        lambda x: 0.5 * x, lambda x: x, n=1, p=1, states=qpmhe.Box([-100.0], [30.0])
    )
    window, problem = filled(system, random_cost(1, 1), 6)
    trajectory = window.candidate.copy()
    trajectory[stage] = 30.0 + beyond
    assert math.isfinite(problem.evaluate(trajectory).cost) is (beyond < 1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_rows_that_the_candidate_violates_are_left_out_and_come_back(name):
    tight = {
        "states": qpmhe.Box([-3.0], [3.0]),
        "disturbances": qpmhe.Box([-1.0], [1.0]),
        "noises": qpmhe.Box([-4.0], [4.0]),
    }
    # Which y, met at z = 0, leaves just this set: states z+ = L, disturbances L, noises y.
    gain, y = {"states": (1.0, 3.5), "disturbances": (0.5, 3.0), "noises": (0.1, 5.0)}[name]
    sets = dict(tight, disturbances=qpmhe.Box([-9.0], [9.0])) if name == "states" else tight
    system, cost = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=1, p=1, **sets), random_cost(1, 1)
    window, formulation, _ = assembled(
        system, qpmhe.Luenberger([gain]), cost, 2, np.zeros(1), project=False
    )
    history = []
    for value in (0.0, y, None, None, None, None):
        measured = window.candidate[-1] if value is None else np.array([value])
        window.push(measured.copy(), NONE)
        problem, candidate = formulation.problem(window), window.candidate.copy()
        w, v = window.residuals[:, :1], window.residuals[:, 1:]
        first = window.time - window.length
        missed = plain_rows("states", sets["states"], candidate, cost.prior, first)
        missed |= plain_rows("disturbances", sets["disturbances"], w, cost.disturbance, first)
        missed |= plain_rows("noises", sets["noises"], v, cost.noise, first)
        assert set(problem.missed_rows(problem.candidate)) == set(missed)
        assert (problem.evaluate(candidate).cost == math.inf) is bool(missed)
        assert problem.candidate.cost == window.candidate_cost
        relaxed = problem.without_violated()
        assert math.isfinite(relaxed.evaluate(candidate).cost)
        # The other side of such a row holds, and so do the rows of other stages.
        for far in (-30.0, 30.0):
            found = problem.missed_rows(problem.evaluate(candidate + far))
            left = relaxed.missed_rows(relaxed.evaluate(candidate + far))
            assert set(left) == set(found) - set(missed)
        assert (problem.evaluate(candidate).cost == math.inf) is bool(missed)
        history.append({row[0] for row in missed})
    assert {name} in history
    assert history[0] == history[-1] == set()


@pytest.mark.parametrize("fixed", [0.0, 0.3])
def test_noise_free_rows_are_never_left_out(fixed):
    box = qpmhe.Box([fixed, -0.1], [fixed, 0.1])
    system = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=2, p=2, disturbances=box)
    window, problem = filled(system, random_cost(2, 2), 3)
    candidate, relaxed = window.candidate.copy(), problem.without_violated()
    missed = {row.row for row in problem.missed_rows(problem.candidate)}
    assert missed == {0, 1}
    assert {row.row for row in relaxed.missed_rows(problem.candidate)} == {0}
    # A trial is rolled out along them.
    trial = relaxed.evaluate(candidate)
    np.testing.assert_allclose(trial.residuals[:, 0], fixed, atol=1e-15)


def test_a_missing_output_has_no_noise_that_could_leave_its_set():
    system = qpmhe.System(
        lambda x: x, lambda x: x, n=2, p=2, noises=qpmhe.Box([-1.0, -1.0], [1.0, 1.0])
    )
    cost = random_cost(2, 2)
    start = np.array([50.0, -70.0])
    observer = qpmhe.Luenberger(np.zeros((2, 2)))
    window, formulation, _ = assembled(system, observer, cost, 3, start)
    for y in ([50.5, np.nan], [np.nan, np.nan], [np.nan, -70.5], [50.5, -70.5]):
        window.push(np.array(y), NONE)
        problem = formulation.problem(window)
        assert problem.candidate.violation == 0.0
        for inside in (0.0, 0.4):
            trajectory = window.candidate + inside
            assert problem.evaluate(trajectory).cost == pytest.approx(
                plain_cost(system, cost, window, trajectory, cost.prior), rel=1e-11
            )
        outside = window.candidate.copy()
        outside[0] += 2.0
        seen = window.observed[0].any()
        assert (problem.evaluate(outside).cost == math.inf) is bool(seen)


# Models that cannot be evaluated everywhere


@pytest.mark.parametrize("where", ["f", "h"])
@pytest.mark.parametrize(
    "root",
    [
        pytest.param(np.sqrt, id="NaN"),
        pytest.param(lambda x: [math.sqrt(x[0])], id="raises"),
        pytest.param(lambda x: x / (x > 0), id="infinite"),
    ],
)
@pytest.mark.parametrize("stage", [0, 3])
def test_a_trajectory_without_model_costs_infinitely(root, where, stage):
    functions = {"f": lambda x: 0.5 * x + 1.0, "h": lambda x: x, where: root}
    with np.errstate(all="ignore"):
        system = qpmhe.System(functions["f"], functions["h"], n=1, p=1)
        cost = random_cost(1, 1)
        observer = qpmhe.Luenberger([0.1])
        window, formulation, _ = assembled(system, observer, cost, 4, np.ones(1))
        for _ in range(4):
            window.push(np.ones(1), NONE)
        problem = formulation.problem(window)
        assert math.isfinite(problem.evaluate(window.candidate.copy()).cost)
        trajectory = window.candidate.copy()
        trajectory[stage] = -1.0
        assert problem.evaluate(trajectory).cost == math.inf


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200])
@pytest.mark.parametrize("stage", [0, 2, 4])
@pytest.mark.parametrize("bounded", [False, True])
def test_a_trajectory_that_is_not_finite_costs_infinitely(bad, stage, bounded):
    sets = roomy_sets(2, 1) if bounded else {}
    window, problem = filled(nonlinear(2, 1, 0, **sets), random_cost(2, 1), 6)
    trajectory = window.candidate.copy()
    trajectory[stage, 1] = bad
    with np.errstate(all="ignore"):
        assert problem.evaluate(trajectory).cost == math.inf
