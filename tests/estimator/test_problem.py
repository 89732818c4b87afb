"""Window, J with its verdict, and the QP of a step, against plain loops and dense algebra."""

import math

import numpy as np

import qpmhe

from .plain import assembled

NONE = np.zeros(0)


# Sets


def filled(observer, samples=3, cost=1.0, horizon=4, start=1.0, f=lambda x: 0.5 * x, **options):
    """Window, problem and subproblem of one state that is measured, after measurements of 1."""
    system = qpmhe.System(f, options.pop("h", lambda x: x), n=1, p=1, **options)
    weights = qpmhe.QuadraticCost(prior=cost, disturbance=cost, noise=cost)
    window, formulation, subproblem = assembled(
        system, observer, weights, horizon, np.full(1, start), project=False
    )
    for _ in range(samples):
        window.push(np.ones(1), NONE)
    return window, formulation, subproblem


def test_the_last_state_counts_and_rounding_does_not():
    states = qpmhe.Box([-100.0], [30.0])
    window, formulation, _ = filled(qpmhe.Luenberger([0.1]), 6, states=states)
    for stage in (0, 2, 4):
        for beyond in (-1e-3, -1e-12, 1e-12, 1e-6):
            trajectory = window.candidate.copy()
            trajectory[stage] = 30.0 + beyond
            cost = formulation.problem(window).evaluate(trajectory).cost
            assert math.isfinite(cost) is (beyond < 1e-9)


def test_sides_that_the_candidate_violates_are_left_out_and_come_back():
    box = qpmhe.Box([-2.0], [2.0])
    window, formulation, subproblem = filled(
        qpmhe.Luenberger([0.8]), 0, horizon=2, start=0.0, f=lambda x: 0.8 * x,
        states=box, disturbances=box, noises=box,
    )
    missing = []
    for y in (0.5, 0.5, 9.0, 0.0, 0.0, -9.0, 0.0, 0.0, 0.0, 0.0, 0.0):
        window.push(np.array([y]), NONE)
        problem, candidate = formulation.problem(window), window.candidate.copy()
        missed = set(problem.missed_rows(problem.candidate))
        assert (problem.evaluate(candidate).cost == math.inf) is bool(missed)
        relaxed = problem.without_violated()
        assert math.isfinite(relaxed.evaluate(candidate).cost)
        for far in (-30.0, 30.0):
            left = relaxed.missed_rows(relaxed.evaluate(candidate + far))
            assert set(left) == set(problem.missed_rows(problem.evaluate(candidate + far))) - missed
        qp = subproblem.at(relaxed, relaxed.candidate)
        sides = (
            (candidate, qp.lower, qp.upper),
            (window.residuals, qp.row_lower[:-1], qp.row_upper[:-1]),
        )
        for points, lower, upper in sides:
            np.testing.assert_array_equal(lower, np.where(points < -2.0, -np.inf, -2.0 - points))
            np.testing.assert_array_equal(upper, np.where(points > 2.0, np.inf, 2.0 - points))
        missing.append([int(np.isinf(side).sum()) for _, *both in sides for side in both])
    assert np.max(missing, axis=0).min() > 0
    assert missing[0] == missing[-1] == [0, 0, 0, 0]


def test_noise_free_rows_are_never_left_out():
    for fixed in (0.0, 0.3):
        box = qpmhe.Box([fixed, -0.1], [fixed, 0.1])
        system = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=2, p=2, disturbances=box)
        cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(2))
        window, formulation, _ = assembled(
            system, qpmhe.Luenberger(np.eye(2)), cost, 4, np.ones(2)
        )
        for _ in range(3):
            window.push(np.array([4.0, -4.0]), NONE)
        problem = formulation.problem(window)
        relaxed = problem.without_violated()
        assert {row.row for row in problem.missed_rows(problem.candidate)} == {0, 1}
        assert {row.row for row in relaxed.missed_rows(problem.candidate)} == {0}
        # A trial is rolled out along them.
        trial = relaxed.evaluate(window.candidate.copy())
        np.testing.assert_allclose(trial.residuals[:, 0], fixed, atol=1e-15)


# Models that cannot be evaluated everywhere
