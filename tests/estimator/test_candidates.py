"""Where the sequence of QPs starts, and which of the window's states is asked for."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

from .plain import Record, spd

GENERATOR = np.random.default_rng(1)
P, Q, R = 0.05 * spd(GENERATOR, 2), 5.0 * spd(GENERATOR, 2), spd(GENERATOR, 1)
GAIN = np.array([[0.02], [0.01]])
START = np.array([2.0, -1.0])


def swing(x):
    return np.stack(
        [x[..., 0] + 0.2 * x[..., 1], 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])], axis=-1
    )


def seen(x):
    return x[..., :1] + 0.05 * x[..., 1:] ** 2


def record(count, missing=0.0, seed=2):
    generator = np.random.default_rng(seed)
    x, ys = np.array([0.3, 0.8]), []
    for _ in range(count):
        y = seen(x) + 0.05 * generator.standard_normal(1)
        ys.append(y if generator.random() >= missing else np.full(1, np.nan))
        x = swing(x) + 0.01 * generator.standard_normal(2)
    return ys


def estimator(discount=1.0, **options):
    system = qpmhe.System(swing, seen, n=2, p=1)
    cost = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R, discount=discount)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost,
        **{"horizon": 4, "initial_state": START} | options,
    )


def plain_record(horizon=4, discount=1.0):
    return Record(seen, GAIN, START, (P, Q, R), horizon, discount=discount)


def check_numbers(estimate, kept, trajectory):
    np.testing.assert_allclose(estimate.candidate, kept.candidate, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(estimate.trajectory, trajectory, rtol=1e-7, atol=1e-8)
    assert estimate.candidate_cost == pytest.approx(kept.cost(kept.candidate), rel=1e-7)
    assert estimate.cost == pytest.approx(kept.cost(trajectory), rel=1e-7)


# The start of the sequence


def shifted(kept, before):
    """The previous estimate, moved on by the model to the present window."""
    ahead = np.vstack([before, kept.steps[-1](before[-1])])
    return ahead[len(ahead) - len(kept.candidate) :]


@pytest.mark.parametrize("discount", [1.0, 0.9])
@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("horizon", [1, 4, 7])
def test_the_best_start_is_the_shifted_estimate_where_that_costs_less(horizon, missing, discount):
    options = {"horizon": horizon, "discount": discount}
    mhe, kept = estimator(warm_start=True, **options), plain_record(**options)
    before, starts = None, []
    for y in record(20, missing):
        estimate = mhe.update(y)
        kept.push(swing, y)
        start = kept.candidate
        if before is not None:
            other = shifted(kept, before)
            if kept.cost(other) < kept.cost(start) * (1 - 1e-9):
                start = other
        starts.append(start is not kept.candidate)
        before = kept.improved(start) if kept.cost(start) > 1e-9 else start
        check_numbers(estimate, kept, before)
        assert estimate.qps == 1
        assert estimate.improved is bool(kept.cost(kept.candidate) > 1e-9)
    assert any(starts)


def test_a_better_start_helps_where_one_qp_is_not_enough():
    ys = record(25)
    sums = {
        start: estimator(warm_start=start, horizon=7).run(ys).costs.sum()
        for start in (False, True)
    }
    converged = estimator(max_qps=None, horizon=7).run(ys).costs.sum()
    assert converged * (1 - 1e-9) <= sums[True] < sums[False]


def test_the_start_changes_no_candidate():
    ys = record(20, 0.2)
    runs = [estimator(warm_start=start).run(ys) for start in (False, True)]
    np.testing.assert_array_equal(runs[0].candidate_costs, runs[1].candidate_costs)
    for run in runs:
        assert (run.costs <= run.candidate_costs).all()


def test_without_qps_there_is_nothing_to_start():
    ys = record(10)
    runs = [estimator(warm_start=start, max_qps=0).run(ys) for start in (False, True)]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    np.testing.assert_array_equal(runs[0].costs, runs[1].costs)


def test_the_first_sample_has_no_better_start():
    ys = record(3)
    mhes = [estimator(warm_start=start) for start in (False, True)]
    np.testing.assert_array_equal(*(mhe.update(ys[0]).trajectory for mhe in mhes))
    mhes[1].update(ys[1])
    # Nor is there one after a reset: what came before is forgotten.
    for mhe in mhes:
        mhe.reset()
    np.testing.assert_array_equal(*(mhe.update(ys[0]).trajectory for mhe in mhes))


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_the_best_start_with_a_backend_that_may_fail(backend):
    # Stopped after one iteration, most solvers bring little: the start is the estimate then.
    mhe = estimator(warm_start=True, backend=backend, max_solver_iterations=1)
    kept, before = plain_record(), None
    for y in record(8):
        estimate = mhe.update(y)
        kept.push(swing, y)
        assert estimate.cost <= estimate.candidate_cost
        if before is not None:
            bound = kept.cost(shifted(kept, before))
            assert estimate.cost <= bound * (1 + 1e-9) + 1e-12
        before = estimate.trajectory


def test_a_start_outside_of_the_sets_is_clipped_and_judged():
    box = qpmhe.Box([-0.5, -0.85], [2.5, 0.85])
    system = qpmhe.System(swing, seen, n=2, p=1, states=box)
    cost = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost, horizon=4, initial_state=[2.0, -0.5], warm_start=True
    )
    for y in record(20):
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost
        if not estimate.dropped:
            assert box.violation(estimate.trajectory) <= 1e-8


@pytest.mark.parametrize(
    "root", [lambda x: np.sqrt(x) - 0.3, lambda x: [math.sqrt(x[0]) - 0.3]], ids=["NaN", "raises"]
)
def test_a_start_that_the_model_does_not_reach(root):
    # Where the estimate is below zero, it cannot be moved on.
    system = qpmhe.System(
        root, lambda x: x, n=1, p=1, f_jacobian=lambda x: 0.5 / np.sqrt(x)[..., None]
    )
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=0.01, noise=10.0)
    runs = [
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.9]), cost, horizon=3, initial_state=[1.0], warm_start=start
        ).run([0.9, 0.5, -0.3, 0.5, 0.9, 0.9, 1.0, 1.0, 1.0])
        for start in (False, True)
    ]
    for run in runs:
        assert (run.costs <= run.candidate_costs).all()
        assert any(Status.MODEL_FAILED in status for status in run.statuses)
        assert (run.states < 0.0).any()
        assert np.isfinite(run.costs[-1])


# The re-initialised candidate


@pytest.mark.parametrize("discount", [1.0, 0.9])
@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("horizon", [1, 4, 7])
def test_the_reinitialised_observer_starts_at_the_old_estimate(horizon, missing, discount):
    options = {"horizon": horizon, "discount": discount}
    mhe, kept = estimator(candidate="reinitialized", **options), plain_record(**options)
    made = [START]  # the estimates of x(0), x(1), ..., each made at its own time
    for y in record(20, missing):
        estimate = mhe.update(y)
        kept.push(swing, y)
        kept.observe(kept.first, made[kept.first])
        np.testing.assert_allclose(estimate.candidate[0], made[kept.first], rtol=1e-8)
        trajectory = kept.candidate
        if kept.cost(trajectory) > 1e-9:
            trajectory = kept.improved(trajectory)
        check_numbers(estimate, kept, trajectory)
        made.append(estimate.state)


@pytest.mark.parametrize("horizon", [1, 5])
def test_the_reinitialised_observer_across_the_slides_to_the_front(horizon):
    mhe = estimator(candidate="reinitialized", horizon=horizon)
    kept, made = plain_record(horizon), [START]
    for y in record(150, 0.02):
        estimate = mhe.update(y)
        kept.push(swing, y)
        kept.observe(kept.first, made[kept.first])
        np.testing.assert_allclose(estimate.candidate, kept.candidate, rtol=1e-10, atol=1e-11)
        made.append(estimate.state)


def test_the_first_window_has_the_papers_candidate():
    ys = record(4)
    runs = [
        estimator(candidate=candidate).run(ys) for candidate in ("observer", "reinitialized")
    ]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    np.testing.assert_array_equal(runs[0].candidate_costs, runs[1].candidate_costs)


def test_without_qps_the_reinitialised_observer_is_the_observer():
    ys = record(100, 0.1)
    runs = [
        estimator(candidate=candidate, max_qps=0).run(ys)
        for candidate in ("observer", "reinitialized")
    ]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    np.testing.assert_array_equal(runs[0].costs, runs[1].costs)


def test_a_reinitialised_poor_observer_comes_closer():
    x, errors = np.array([0.3, 0.8]), {"observer": [], "reinitialized": []}
    mhes = {candidate: estimator(candidate=candidate, horizon=6) for candidate in errors}
    for _ in range(40):
        y, x = seen(x), swing(x)
        for candidate, mhe in mhes.items():
            estimate = mhe.update(y)
            errors[candidate].append(np.linalg.norm(estimate.candidate[-1] - x))
    assert errors["reinitialized"][-1] < 0.1 * errors["observer"][-1]


def test_both_options_together():
    mhe = estimator(candidate="reinitialized", warm_start=True)
    kept, made, before = plain_record(), [START], None
    for y in record(15):
        estimate = mhe.update(y)
        kept.push(swing, y)
        kept.observe(kept.first, made[kept.first])
        start = kept.candidate
        if before is not None and kept.cost(shifted(kept, before)) < kept.cost(start):
            start = shifted(kept, before)
        check_numbers(estimate, kept, kept.improved(start))
        before = estimate.trajectory
        made.append(estimate.state)


def test_a_reset_forgets_the_estimates():
    mhe = estimator(candidate="reinitialized")
    first = mhe.run(record(10)).states
    mhe.reset()
    np.testing.assert_array_equal(mhe.run(record(10)).states, first)


# Delay


@pytest.mark.parametrize("delay", [0, 1, 3, 5])
@pytest.mark.parametrize("options", [{}, {"max_qps": 0}, {"warm_start": True}], ids=str)
def test_the_delayed_estimate_is_that_many_states_back(delay, options):
    mhe = estimator(horizon=5, delay=delay, **options)
    for t, y in enumerate(record(12)):
        estimate = mhe.update(y)
        reached = min(t + 1, 5)
        if delay > reached:
            assert estimate.delayed is None
        else:
            np.testing.assert_array_equal(
                estimate.delayed, estimate.trajectory[len(estimate.trajectory) - 1 - delay]
            )
    if delay == 0:
        np.testing.assert_array_equal(estimate.delayed, estimate.state)
    if delay == 1:
        np.testing.assert_array_equal(estimate.delayed, estimate.filtered)


def test_a_delay_changes_nothing_else():
    ys = record(12)
    runs = [estimator(horizon=5, delay=delay).run(ys) for delay in (0, 3)]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    np.testing.assert_array_equal(runs[0].costs, runs[1].costs)


def test_more_measurements_make_a_better_estimate():
    generator, errors = np.random.default_rng(3), []
    mhe = estimator(horizon=8, delay=5, max_qps=None, initial_state=[0.3, 0.8])
    x, states = np.array([0.3, 0.8]), []
    for t in range(200):
        states.append(x)
        y, x = seen(x) + 0.3 * generator.standard_normal(1), swing(x)
        estimate = mhe.update(y)
        if t >= 10:
            # The states of the times t + 1 and t + 1 - 5.
            errors.append(
                [np.abs(estimate.state - x)[0], np.abs(estimate.delayed - states[t - 4])[0]]
            )
    error, delayed = np.mean(errors, axis=0)
    assert delayed < error
