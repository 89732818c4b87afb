"""Metrics against plain NumPy on estimators that are run by hand."""

import numpy as np
import pytest

import qpmhe
from qpmhe.models.loading import find
from qpmhe.studies import metrics
from qpmhe.studies.cell import OBSERVER, Cell, Task, compute

ALL = frozenset({"accuracy", "time", "covariance"})
STEPS = 40


def by_hand(qps, cap=None, backend="daqp", horizon=10, start="candidate", seed=3, model=None):
    system, observer, cost, scenario = model or qpmhe.models.batch_reactor()
    record = scenario.simulate(seed, STEPS)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=horizon, initial_state=scenario.initial_estimate,
        backend=backend, max_qps=qps, max_solver_iterations=cap, warm_start=start == "best",
    )
    estimates, covariances = [], []
    for y in record.measurements:
        estimates.append(mhe.update(y))
        covariances.append(mhe.covariances()[-1])
    return record.states, scenario.initial_estimate, estimates, covariances


def row_of(qps, cap=None, backend="daqp", horizon=10, start="candidate", seed=3, parts=ALL,
           model="batch_reactor", **options):
    cell = Cell(model, backend, qps, cap, horizon, start, seed, STEPS)
    return compute(Task(cell, find(model), frozenset(parts), timeout=60.0, **options))


@pytest.mark.parametrize(
    ("qps", "cap", "backend", "start"),
    [
        (0, None, OBSERVER, "candidate"), (1, None, "daqp", "candidate"),
        (2, 3, "osqp", "candidate"), (None, 1, "osqp", "best"), (1, 1, "proxqp", "candidate"),
    ],
)
def test_a_cell_is_the_run_of_an_estimator_made_by_hand(qps, cap, backend, start):
    states, initial, estimates, covariances = by_hand(
        qps, cap, "auto" if backend == OBSERVER else backend, start=start
    )
    row = row_of(qps, cap, backend, start=start)
    assert (row["outcome"], row["reason"]) == ("done", "")
    errors = np.array([initial, *(e.state for e in estimates)]) - states
    settled = round(qpmhe.models.batch_reactor().scenario.settling_time / 0.1)
    assert 0 < settled < STEPS
    relative = (errors / np.sqrt(((states - initial) ** 2).mean(axis=0))) ** 2
    assert row["rmse"] == pytest.approx(np.sqrt(relative.mean()), rel=1e-12)
    assert row["rmse_settled"] == pytest.approx(np.sqrt(relative[settled:].mean()), rel=1e-12)
    assert row["rmse_states"] == pytest.approx(np.sqrt((errors**2).mean(axis=0)), rel=1e-12)
    assert row["rmse_settled_states"] == pytest.approx(
        np.sqrt((errors[settled:] ** 2).mean(axis=0)), rel=1e-12
    )
    improved = np.mean([e.improved for e in estimates])
    failed = np.mean([
        not e.improved and any(
            flag in e.status
            for flag in (qpmhe.Status.SOLVER_FAILED, qpmhe.Status.NO_DECREASE)
        )
        for e in estimates
    ])
    assert row["improved"] == pytest.approx(improved)
    assert row["fallback"] == pytest.approx(failed)
    assert row["kept"] == pytest.approx(1.0 - improved - failed)
    assert row["cap_hits"] == pytest.approx(
        np.mean([qpmhe.Status.SOLVER_STOPPED in e.status for e in estimates])
    )
    for flag in qpmhe.Status:
        assert row["reasons"].get(flag.name, 0) == sum(flag in e.status for e in estimates)
    assert row["qps_mean"] == pytest.approx(np.mean([e.qps for e in estimates]))
    told = [e.solver_iterations for e in estimates if e.solver_iterations is not None]
    assert row["solver_iterations_mean"] == pytest.approx(
        np.mean(told) if told else np.nan, nan_ok=True
    )
    _, _, converged, _ = by_hand(None, start=start, backend="auto")
    assert row["cost_ratio"] == pytest.approx(
        np.mean([e.cost / c.cost for e, c in zip(estimates, converged, strict=True)]), rel=1e-9
    )
    expected = [
        error @ np.linalg.inv(covariance) @ error
        for error, covariance in zip(errors[1:], covariances, strict=True)
    ]
    assert row["nees"] == pytest.approx(np.mean(expected), rel=1e-9)


def test_the_observers_cell_is_the_observer():
    row = row_of(0, None, OBSERVER)
    assert (row["improved"], row["kept"], row["fallback"]) == (0.0, 1.0, 0.0)
    assert row["reasons"] == {"CANDIDATE": STEPS, "NO_QPS": STEPS}
    assert row["cost_ratio"] > 2.0
    assert row_of(None)["cost_ratio"] == pytest.approx(1.0, rel=1e-6)


def test_the_reference_is_that_of_its_own_horizon_and_seed():
    for horizon, seed in ((3, 0), (10, 0), (3, 5), (10, 3)):
        assert row_of(None, horizon=horizon, seed=seed)["cost_ratio"] == pytest.approx(1, rel=1e-6)


def test_shares_of_steps_that_fail_are_fallback():
    def run(*flags):
        ones = np.ones(len(flags))
        return qpmhe.Run(
            states=np.zeros((len(flags) + 1, 1)), filtered=ones[:, None], costs=ones,
            candidate_costs=ones, times=ones, solve_times=ones, qps=np.arange(len(flags)),
            solver_iterations=np.array([-1, 4] + [-1] * (len(flags) - 2)),
            delayed=ones[:, None], flags=np.array([flag.value for flag in flags]),
            observer_states=np.zeros((len(flags) + 1, 1)),
        )

    status = qpmhe.Status
    found = metrics.outcomes(run(
        status.IMPROVED | status.CONVERGED, status.CANDIDATE | status.CONVERGED,
        status.CANDIDATE | status.SOLVER_FAILED, status.CANDIDATE | status.NO_DECREASE
        | status.SOLVER_STOPPED, status.IMPROVED | status.SOLVER_FAILED,
        status.CANDIDATE | status.MODEL_FAILED, status.CANDIDATE | status.NO_QPS,
        status.CANDIDATE | status.MISSING | status.CONVERGED,
    ))
    assert (found["improved"], found["kept"], found["fallback"]) == (2 / 8, 3 / 8, 3 / 8)
    assert found["cap_hits"] == 1 / 8
    assert found["solver_iterations_mean"] == 4.0
    assert found["qps_mean"] == 3.5


def test_cost_ratios_leave_out_what_has_no_ratio():
    costs = np.array([2.0, np.inf, 3.0, 1.0, np.nan, 0.0])
    reference = np.array([1.0, 1.0, np.inf, 2.0, 1.0, 0.0])
    assert metrics.cost_ratio(costs, reference) == (2.0 + 0.5) / 2
    assert np.isnan(metrics.cost_ratio(costs, None))
    assert np.isnan(metrics.cost_ratio(np.array([np.inf]), np.array([1.0])))


def test_consistency_leaves_out_covariances_that_say_nothing():
    estimates, states = np.array([[9.0], [1.0], [2.0], [3.0]]), np.zeros((4, 1))
    covariances = np.array([[[0.5]], [[np.nan]], [[0.0]]])
    assert metrics.consistency(estimates, states, covariances) == 2.0
    assert np.isnan(metrics.consistency(estimates, states, covariances[[1, 1, 2]]))


def test_errors_of_different_units_are_summed_up_without_one():
    generator = np.random.default_rng(0)
    states, errors = generator.standard_normal((2, 30, 3))
    estimates, units = states + 0.1 * errors, np.array([2.0**-30, 1.0, 2.0**20])
    plain = metrics.accuracy(estimates, states, 5)
    scaled = metrics.accuracy(estimates * units, states * units, 5)
    assert (scaled["rmse"], scaled["rmse_settled"]) == (plain["rmse"], plain["rmse_settled"])
    for name in ("rmse_states", "rmse_settled_states"):
        assert scaled[name] == (np.array(plain[name]) * units).tolist()
    # Whoever is right about the small numbers only is not ahead.
    wrong = metrics.accuracy(np.where([True, True, False], states, estimates) * units,
                             states * units, 5)
    other = metrics.accuracy(np.where([False, True, True], states, estimates) * units,
                             states * units, 5)
    assert 0.3 < wrong["rmse"] / other["rmse"] < 3.0


def test_keeping_the_initial_estimate_has_an_error_of_one():
    states = np.random.default_rng(1).standard_normal((20, 3)) + 5.0
    found = metrics.accuracy(np.tile([1.0, 7.0, -3.0], (20, 1)), states, 0)
    assert found["rmse"] == pytest.approx(1.0)


def test_states_that_never_leave_their_initial_estimate_have_a_scale():
    states = np.array([[0.0, 4.0, 1.0], [0.0, 4.0, 3.0]])
    assert metrics.scales(states, np.array([0.0, 4.0, 1.0])).tolist() == [1.0, 4.0, 2.0**0.5]
    # A constant that is to be found: the initial error.
    assert metrics.scales(states, np.array([0.0, 1.0, 1.0]))[1] == 3.0


def test_nothing_settled_has_no_settled_error():
    found = metrics.accuracy(np.ones((3, 2)), np.zeros((3, 2)), 7)
    assert found["rmse"] == pytest.approx(1.0)
    assert np.isnan(found["rmse_settled"])
    assert np.isnan(found["rmse_settled_states"]).all()


def test_times_are_those_of_the_steps():
    row = row_of(1)
    times = row["times"]
    assert times.shape == (STEPS,)
    assert times.dtype == np.float32
    assert (times > 0).all()
    for name, share in (("median", 50), ("p95", 95), ("p99", 99), ("max", 100)):
        assert row[f"time_{name}"] == pytest.approx(np.percentile(times, share), rel=1e-5)


@pytest.mark.parametrize("part", sorted(ALL))
def test_only_what_was_asked_for_is_told(part):
    row = row_of(1, parts=[part])
    assert ("times" in row) == (part == "time")
    assert ("cost_ratio" in row) == (part == "accuracy")
    assert ("nees" in row) == (part == "covariance")


def test_models_with_inputs_are_run_with_them():
    name = next(
        name for name, make in qpmhe.models.catalogue().items() if make().system.m
    )
    system, observer, cost, scenario = qpmhe.models.catalogue()[name]()
    record = scenario.simulate(3, STEPS)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=5, initial_state=scenario.initial_estimate, max_qps=1,
        backend="auto",
    )
    run = mhe.run(record.measurements, record.inputs)
    row = row_of(1, backend="auto", horizon=5, model=name, keep=True)
    assert row["trajectory"]["estimates"] == pytest.approx(run.states, rel=1e-9, abs=1e-12)
    np.testing.assert_array_equal(row["trajectory"]["states"], record.states)


def test_errors_of_angles_are_those_of_the_shorter_way_round():
    rng = np.random.default_rng(2)
    t = np.arange(60.0)
    states = np.column_stack((np.sin(0.1 * t), 180.0 + 20.0 * np.sin(0.2 * t)))
    estimates = states + rng.standard_normal((60, 2)) * [0.1, 4.0]
    covariances = np.tile(np.diag([0.01, 16.0]), (59, 1, 1))
    assert np.abs(states[:, 1] - estimates[0, 1]).max() < 180.0  # the same scale, then
    residual = qpmhe.angles([1], 360.0)
    wrapped = [residual(one, np.zeros(2)) for one in (estimates, states)]
    assert np.abs(np.diff(wrapped[1][:, 1])).max() > 300.0
    plain = metrics.accuracy(estimates, states, 20)
    found = metrics.accuracy(*wrapped, 20, residual)
    for name, value in plain.items():
        assert found[name] == pytest.approx(value)
    assert metrics.consistency(*wrapped, covariances, residual) == pytest.approx(
        metrics.consistency(estimates, states, covariances))
    assert metrics.accuracy(*wrapped, 20)["rmse_states"][1] > 5.0 * plain["rmse_states"][1]
