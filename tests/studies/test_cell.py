"""What a worker makes of a cell, against plain NumPy on estimators that are run by hand."""

import numpy as np
import pytest

import qpmhe
from qpmhe.models.loading import find
from qpmhe.studies import cell as module
from qpmhe.studies import metrics
from qpmhe.studies.cell import OBSERVER, Cell, Task, compute
from qpmhe.studies.experiment import Source

ALL = frozenset({"accuracy", "time", "covariance"})
ODD = "tests/studies/odd_models.py"
STEPS = 40


def by_hand(qps, cap=None, backend="daqp", start="candidate", model="batch_reactor"):
    system, observer, cost, scenario = qpmhe.models.catalogue()[model]()
    record = scenario.simulate(3, STEPS)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=scenario.initial_estimate,
        backend=backend, max_qps=qps, max_solver_iterations=cap, warm_start=start == "best",
    )
    estimates, covariances = [], []
    inputs = [None] * STEPS if record.inputs is None else record.inputs
    for y, u in zip(record.measurements, inputs, strict=True):
        estimates.append(mhe.update(y, u))
        covariances.append(mhe.covariances()[-1])
    return record.states, scenario.initial_estimate, estimates, covariances


def row_of(qps=1, cap=None, backend="daqp", horizon=10, start="candidate", seed=3, parts=ALL,
           model="batch_reactor", steps=STEPS, timeout=60.0, **options):
    cell = Cell(model, backend, qps, cap, horizon, start, seed, steps)
    return compute(Task(cell, Source(find(model)), frozenset(parts), timeout, **options))


@pytest.mark.parametrize(
    ("qps", "cap", "backend", "start"),
    [
        (0, None, OBSERVER, "candidate"), (1, None, "daqp", "candidate"),
        (2, 3, "osqp", "candidate"), (None, 1, "osqp", "best"), (1, 1, "proxqp", "candidate"),
    ],
)
def test_a_cell_is_the_run_of_an_estimator_made_by_hand(qps, cap, backend, start):
    states, initial, estimates, covariances = by_hand(
        qps, cap, "auto" if backend == OBSERVER else backend, start
    )
    row = row_of(qps, cap, backend, start=start)
    assert (row["outcome"], row["reason"]) == ("done", "")
    errors = np.array([initial, *(e.state for e in estimates)]) - states
    settled = round(qpmhe.models.batch_reactor().scenario.settling_time / 0.1)
    assert 0 < settled < STEPS
    relative = (errors / np.sqrt(((states - initial) ** 2).mean(axis=0))) ** 2
    for suffix, first in (("", 0), ("_settled", settled)):
        assert row[f"rmse{suffix}"] == pytest.approx(np.sqrt(relative[first:].mean()), rel=1e-12)
        by_state = np.sqrt((errors[first:] ** 2).mean(axis=0))
        assert row[f"rmse{suffix}_states"] == pytest.approx(by_state, rel=1e-12)
    status = qpmhe.Status
    failed = np.mean([
        not e.improved and any(f in e.status for f in (status.SOLVER_FAILED, status.NO_DECREASE))
        for e in estimates
    ])
    improved = np.mean([e.improved for e in estimates])
    iterations = [e.solver_iterations for e in estimates if e.solver_iterations is not None]
    _, _, converged, _ = by_hand(None, start=start, backend="auto")
    expected = {
        "improved": improved, "fallback": failed, "kept": 1.0 - improved - failed,
        "cap_hits": np.mean([status.SOLVER_STOPPED in e.status for e in estimates]),
        "qps_mean": np.mean([e.qps for e in estimates]),
        "solver_iterations_mean": np.mean(iterations) if iterations else np.nan,
        "cost": np.mean([e.cost for e in estimates]),
        "cost_ratio": np.mean(
            [e.cost / c.cost for e, c in zip(estimates, converged, strict=True)]),
        "nees": np.mean([e @ np.linalg.inv(P) @ e
                         for e, P in zip(errors[1:], covariances, strict=True)]),
    }
    for name, value in expected.items():
        assert row[name] == pytest.approx(value, rel=1e-9, abs=1e-15, nan_ok=True), name
    for flag in status:
        assert row["reasons"].get(flag.name, 0) == sum(flag in e.status for e in estimates)


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
    assert (found["solver_iterations_mean"], found["qps_mean"]) == (4, 3.5)


def test_what_says_nothing_is_left_out():
    costs = np.array([2.0, np.inf, 3.0, 1.0, np.nan, 0.0])
    reference = np.array([1.0, 1.0, np.inf, 2.0, 1.0, 0.0])
    assert metrics.cost_ratio(costs, reference) == (2.0 + 0.5) / 2
    assert np.isnan(metrics.cost_ratio(costs, None))
    assert np.isnan(metrics.cost_ratio(np.array([np.inf]), np.array([1.0])))
    estimates, states = np.array([[9.0], [1.0], [2.0], [3.0]]), np.zeros((4, 1))
    covariances = np.array([[[0.5]], [[np.nan]], [[0.0]]])
    assert metrics.consistency(estimates, states, covariances) == 2.0
    assert np.isnan(metrics.consistency(estimates, states, covariances[[1, 1, 2]]))
    # Where nothing has settled, or the truth is unknown, there is no error.
    found = metrics.accuracy(np.ones((3, 2)), np.array([[0.0, np.nan]] * 3), 7)
    assert found["rmse"] == pytest.approx(1.0)
    assert found["rmse_states"] == pytest.approx([1.0, np.nan], nan_ok=True)
    assert np.isnan([found["rmse_settled"], *found["rmse_settled_states"]]).all()
    assert np.isnan(metrics.accuracy(np.full((3, 1), np.nan), np.ones((3, 1)), 0)["rmse"])


def test_errors_of_different_units_are_summed_up_without_one():
    generator = np.random.default_rng(0)
    states, errors = generator.standard_normal((2, 30, 3))
    estimates, units = states + 0.1 * errors, np.array([2.0**-30, 1.0, 2.0**20])
    plain = metrics.accuracy(estimates, states, 5)
    scaled = metrics.accuracy(estimates * units, states * units, 5)
    assert (scaled["rmse"], scaled["rmse_settled"]) == (plain["rmse"], plain["rmse_settled"])
    for name in ("rmse_states", "rmse_settled_states"):
        assert scaled[name] == (np.array(plain[name]) * units).tolist()
    # Keeping the initial estimate has an error of one.
    kept = metrics.accuracy(np.tile([1.0, 7.0, -3.0], (30, 1)), states, 0)
    assert kept["rmse"] == pytest.approx(1.0)
    # States that never leave their initial estimate have a scale.
    states = np.array([[0.0, 4.0, 1.0], [0.0, 4.0, 3.0]])
    assert metrics.scales(states, np.array([0.0, 4.0, 1.0])).tolist() == [1.0, 4.0, 2.0**0.5]
    # A constant that is to be found: the initial error.
    assert metrics.scales(states, np.array([0.0, 1.0, 1.0]))[1] == 3.0


def test_errors_of_angles_are_those_of_the_shorter_way_round():
    rng, t = np.random.default_rng(2), np.arange(60.0)
    states = np.column_stack((np.sin(0.1 * t), 180.0 + 20.0 * np.sin(0.2 * t)))
    estimates = states + rng.standard_normal((60, 2)) * [0.1, 4.0]
    covariances = np.tile(np.diag([0.01, 16.0]), (59, 1, 1))
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


def test_only_what_was_asked_for_is_measured():
    for part in ALL:
        row = row_of(None, parts=[part], horizon=3)
        assert ("times" in row) == ("time_max" in row) == (part == "time")
        assert ("cost_ratio" in row) == (part == "accuracy")
        assert ("nees" in row) == (part == "covariance")
        assert "trajectory" not in row
        if part == "accuracy":  # the reference has the cell's own horizon
            assert row["cost_ratio"] == pytest.approx(1, rel=1e-6)
        if part == "time":
            times = row["times"]
            assert (times.shape, times.dtype, (times > 0).all()) == ((STEPS,), np.float32, True)
            for name, share in (("median", 50), ("p95", 95), ("p99", 99), ("max", 100)):
                assert row[f"time_{name}"] == pytest.approx(np.percentile(times, share), rel=1e-5)


def test_models_with_inputs_are_run_with_them_and_the_trajectory_is_kept():
    name = next(key for key, make in qpmhe.models.catalogue().items() if make().system.m)
    states, initial, estimates, _ = by_hand(1, backend="auto", model=name)
    kept = row_of(1, backend="auto", model=name, keep=True)["trajectory"]
    found = np.array([initial, *(e.state for e in estimates)])
    assert kept["estimates"] == pytest.approx(found, rel=1e-9, abs=1e-12)
    scenario = qpmhe.models.catalogue()[name]().scenario
    np.testing.assert_array_equal(kept["states"], states)
    np.testing.assert_allclose(kept["times"], scenario.dt * np.arange(STEPS + 1))
    assert (kept["title"], kept["time_unit"]) == (scenario.title, scenario.time_unit)
    assert kept["labels"] == list(scenario.labels)


def test_whatever_is_raised_becomes_a_row_unless_it_is_the_user(monkeypatch):
    for model, timeout, words in (
        (f"{ODD}:raises", 60.0, "ZeroDivisionError: division by zero"),
        (f"{ODD}:leaves", 60.0, "SystemExit: 3"),
        ("batch_reactor", 1e-9, "out of time: 1 of "),
    ):
        row = row_of(model=model, timeout=timeout, seed=1)
        assert (row["outcome"], row["model"]) == ("failed", model)
        assert row["reason"].startswith(words)
        found = row["environment"]
        assert found["versions"]["numpy"] == np.__version__
        assert set(found) == {"versions", "cpu", "cores", "python", "os", "host", "threads"}

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "experiment", interrupted)
    with pytest.raises(KeyboardInterrupt):
        row_of()


def test_a_reference_that_runs_out_of_time_costs_the_ratio_only(monkeypatch):
    def late(*_):
        raise module.OutOfTimeError("3 of 30 steps were done.")

    monkeypatch.setattr(module, "_reference", late)
    row = row_of()
    assert (row["outcome"], np.isfinite(row["rmse"])) == ("done", True)
    assert np.isnan(row["cost_ratio"])
    assert "reference ran out of time" in row["reason"]
