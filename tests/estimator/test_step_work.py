"""How much work a step does, counted and not timed, and which rows its QP has."""

import math
import sys
import tracemalloc

import numpy as np
import pytest

import qpmhe

from .plain import assembled
from .untraced import untraced

REACTOR = qpmhe.models.batch_reactor()
MEASUREMENTS = REACTOR.scenario.simulate(0, 60).measurements


def estimator(system=None, **options):
    return qpmhe.MovingHorizonEstimator(
        system or REACTOR.system, REACTOR.observer, REACTOR.cost,
        **{"horizon": 10, "initial_state": [3.0, 0.0], "backend": "banded"} | options,
    )


@pytest.mark.parametrize("max_qps", [0, 1, 2])
def test_the_model_is_evaluated_once_at_each_new_observer_state(max_qps):
    single, many = {}, {}

    def counting(name, function):
        def counted(x):
            counts = single if x.ndim == 1 else many
            counts[name] = counts.get(name, 0) + 1
            nothing = np.empty((*x.shape[:-1], 0))
            return function.batch(x, nothing) if x.ndim > 1 else function(x, nothing)

        return counted

    given = REACTOR.system
    mhe = estimator(qpmhe.System(
        untraced(counting("f", given.f)), untraced(counting("h", given.h)), n=2, p=1,
        f_jacobian=counting("A", given.f_jacobian), h_jacobian=counting("C", given.h_jacobian),
    ), max_qps=max_qps)
    for y in MEASUREMENTS[:40]:
        mhe.update(y)
    single.clear()
    many.clear()
    for y in MEASUREMENTS[40:]:
        mhe.update(y)
    # One state a sample: the rest of the window is remembered.
    assert single["f"] == single["h"] == 20
    assert single.get("A", 0) == single.get("C", 0) == (20 if max_qps else 0)
    # One batch a trial, and now and then one to make sure that batches may be trusted.
    for name in ("f", "h"):
        assert max_qps * 20 <= many.get(name, 0) <= max_qps * 20 + 2
    # The first QP needs no Jacobians but those of the newest stage.
    assert many.get("A", 0) == max(0, max_qps - 1) * 20


def test_memory_does_not_grow():
    mhe = estimator(max_qps=2, warm_start=True)

    def steps(count):
        for _ in range(count):
            for y in MEASUREMENTS:
                mhe.update(y)

    steps(10)
    tracemalloc.start()
    steps(3)
    before = tracemalloc.get_traced_memory()[0]
    steps(12)
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 10_000  # bytes: less than one object a step


# What the steps take now, and a tenth of slack: a guard against creeping growth that no
# clock has to see.
@pytest.mark.parametrize(("options", "most"), [
    ({"max_qps": 0}, 96), ({"max_qps": 1}, 132), ({"max_qps": 2}, 222),
    ({"engine": "compiled", "backend": "auto"}, 12),
], ids=["no QP", "one QP", "two QPs", "compiled"])
def test_a_step_takes_no_more_calls_than_it_did(options, most):
    mhe, counts = estimator(**options), []
    if mhe.engine != options.get("engine", "python"):
        pytest.skip("no C compiler")
    for y in MEASUREMENTS:
        calls = [0]

        def count(frame, event, argument, calls=calls):
            calls[0] += event in ("call", "c_call")

        sys.setprofile(count)
        mhe.update(y)
        sys.setprofile(None)
        counts.append(calls[0])
    assert np.median(counts[20:]) <= most


def test_sides_that_the_candidate_violates_are_left_out_and_come_back():
    box = qpmhe.Box([-2.0], [2.0])
    system = qpmhe.System(
        lambda x: 0.8 * x, lambda x: x, n=1, p=1, states=box, disturbances=box, noises=box
    )
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    window, formulation, subproblem = assembled(
        system, qpmhe.Luenberger([0.8]), cost, 2, np.zeros(1), project=False
    )
    missing = []
    for y in (0.5, 0.5, 9.0, 0.0, 0.0, -9.0, 0.0, 0.0, 0.0, 0.0, 0.0):
        window.push(np.array([y]), np.zeros(0))
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
    # Rounding does not count, and the last state does.
    for beyond in (1e-12, 1e-6):
        trajectory = window.candidate.copy()
        trajectory[-1] = 2.0 + beyond
        cost = formulation.problem(window).without_violated().evaluate(trajectory).cost
        assert math.isfinite(cost) is (beyond < 1e-9)


def test_noise_free_rows_are_never_left_out():
    for fixed in (0.0, 0.3):
        box = qpmhe.Box([fixed, -0.1], [fixed, 0.1])
        system = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=2, p=2, disturbances=box)
        cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(2))
        window, formulation, _ = assembled(
            system, qpmhe.Luenberger(np.eye(2)), cost, 4, np.ones(2)
        )
        for _ in range(3):
            window.push(np.array([4.0, -4.0]), np.zeros(0))
        problem = formulation.problem(window)
        relaxed = problem.without_violated()
        assert {row.row for row in problem.missed_rows(problem.candidate)} == {0, 1}
        assert {row.row for row in relaxed.missed_rows(problem.candidate)} == {0}
        # A trial is rolled out along them.
        trial = relaxed.evaluate(window.candidate.copy())
        np.testing.assert_allclose(trial.residuals[:, 0], fixed, atol=1e-15)
